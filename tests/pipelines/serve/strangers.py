"""Messages to a service, and connections that keep to no rule."""

import json
import socket
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import msgpack
from websockets.frames import Frame, Opcode

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


def frame(payload, fin=True):
    """A frame as a client sends it."""
    return Frame(Opcode.TEXT, payload, fin).serialize(mask=True)


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
