"""Messages to a service, and connections that keep to no rule."""

import json
import socket
import struct
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import msgpack

CHANNELS = {"imu": ["accel_z_mps2"], "wheels": ["speed_left_mps"]}

HANDSHAKE = (
    "GET /robots HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def until(fact, timeout_s=10.0):
    """Wait for something to become true."""
    end_s = time.monotonic() + timeout_s
    while not fact():
        assert time.monotonic() < end_s, "it did not become true"
        time.sleep(0.005)


def ask(robot, content, *, packed=False):
    """Send a message, whole or to be encoded, and return the answer."""
    encode = msgpack.packb if packed else json.dumps
    robot.send(content if isinstance(content, str | bytes) else encode(content))
    answer = robot.recv(30)
    return msgpack.unpackb(answer) if isinstance(answer, bytes) else json.loads(answer)


def frame(payload, opcode=1, fin=True):
    """A masked frame as a client sends it."""
    length = len(payload)
    head = bytes([opcode | (0x80 if fin else 0)])
    if length < 126:
        head += bytes([0x80 | length])
    elif length < 65536:
        head += b"\xfe" + struct.pack("!H", length)
    else:
        head += b"\xff" + struct.pack("!Q", length)
    return head + b"\x00" * 4 + payload


@contextmanager
def raw(service, first=None, buffer=None):
    """A TCP connection on which the WebSocket has begun."""
    place = urlsplit(service.http)
    with socket.socket() as connection:
        connection.settimeout(10)
        if buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        connection.connect((place.hostname, place.port))
        connection.sendall(HANDSHAKE.format(place.netloc).encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += connection.recv(4096)
        assert b" 101 " in answer
        if first is not None:
            connection.sendall(frame(json.dumps(first).encode()))
            assert b"welcome" in connection.recv(8192)
        yield connection
