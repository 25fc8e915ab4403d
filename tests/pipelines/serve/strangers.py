"""A service in this process, messages of robots to it, and connections that keep to no rule."""

import json
import socket
import threading
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import httpx
import msgpack
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from pipelines.serve.serve import Settings
from pipelines.serve.service import Service
from terrain.logs.replay import replay

CHANNELS = {"imu": ["accel_z_mps2"], "wheels": ["speed_left_mps"]}

HANDSHAKE = (
    "GET /robots HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


class Running:
    """A service in this process, its address, and its hub."""

    def __init__(self, service):
        self.hub, self.http = service.hub, service.url
        self.ws = service.url.replace("http", "ws")

    def socket(self, place="/robots", **options):
        return connect(self.ws + place, compression=None, max_size=None, open_timeout=30, **options)

    def get(self, place, method="GET", **options):
        """Status and text of an answer."""
        answer = httpx.request(method, self.http + place, timeout=30, verify=False, **options)
        return answer.status_code, answer.text

    def put(self, place, content):
        body = content if isinstance(content, str) else json.dumps(content)
        kind = "application/yaml" if place == "/table" else "application/json"
        return self.get(place, "PUT", content=body, headers={"Content-Type": kind})


@contextmanager
def running(limits=None, **options):
    """A service of these settings until the block ends."""
    service, ready = Service(Settings(**{"port": 0, **options})), threading.Event()
    if limits is not None:
        service.hub.limits = limits
    thread = threading.Thread(target=service.run, args=(lambda url: ready.set(),))
    thread.start()
    try:
        assert ready.wait(60.0)
        yield Running(service)
    finally:
        service.stop()
        thread.join(30.0)
        assert not thread.is_alive()


def hello(session, **changed):
    """The first message of a robot that asks for each step."""
    first = {"type": "hello", "session": session, "robot": "mower", "streams": CHANNELS, "rate_hz": 0}
    return {**first, **changed}


def messages(run, rate_hz=50.0):
    """The messages of a run, each asking for a step."""
    for sample in replay(run, rate_hz):
        streams = {name: [t.tolist(), values.tolist()] for name, (t, values) in sample.readings.items()}
        yield {"type": "samples", "streams": streams, "step": True, "time_s": sample.time_s}


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
