"""What strangers send: each message is answered or taken, and the robot beside them goes on."""

import json
import random
import re
import socket
import struct
import time

import msgpack
import pytest

from pipelines.serve.hub import LIMITS
from pipelines.serve.metrics import resident_bytes

from .strangers import beside, frame, raw, until

AT_ONCE = 100
GENEROUS = LIMITS._replace(messages_per_s=1e6, rows_per_s=1e7)


@pytest.mark.parametrize("reset", [False, True], ids=["closed", "reset"])
@pytest.mark.parametrize("when", ["in a frame", "between frames", "between fragments", "with the welcome"])
def test_a_robot_that_is_gone_without_a_word_leaves_nothing_behind(service, hello, reset, when):
    for k in range(5):
        name = f"gone-{reset}-{when.replace(' ', '')}-{k}"
        with raw(service, None if when == "with the welcome" else hello(name)) as connection:
            whole = frame(json.dumps({"type": "samples", "streams": {}, "step": True}).encode())
            if when == "in a frame":
                connection.sendall(whole[: len(whole) // 2])
            elif when == "between fragments":
                connection.sendall(frame(b'{"type": ', fin=False))
            elif when == "with the welcome":
                connection.sendall(frame(json.dumps(hello(name)).encode()))
            else:
                connection.sendall(whole)
            if reset:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    time.sleep(0.1)
    until(lambda: not [one for one in service.hub.sessions if one.startswith("gone")])
    assert service.hub.trouble == {}


def test_fragments_and_pings_between_them_are_one_message(service, hello):
    with raw(service, hello("fragments")) as connection:
        text = json.dumps({"type": "samples", "streams": {}, "step": True}).encode()
        connection.sendall(frame(text[:5], fin=False) + frame(b"still there", 9))
        for k in range(5, len(text)):
            connection.sendall(frame(text[k : k + 1], 0, fin=k == len(text) - 1))
        answer = connection.recv(8192)
        while b'"step"' not in answer:
            answer += connection.recv(8192)
    assert b"\x8a\x0bstill there" in answer


def test_text_that_is_no_text_closes_the_connection(service, hello):
    with raw(service, hello("no text")) as connection:
        connection.sendall(frame(b"\xff\xfe\xfd"))
        assert connection.recv(100)[:4] == b"\x88\x02" + struct.pack("!H", 1007)
    until(lambda: "no text" not in service.hub.sessions)


def nested(random_, depth):
    value = random_.choice([0, None, "x"])
    for _ in range(depth):
        value = [value] if random_.random() < 0.7 else {"a": value}
    return value


def strange(random_):
    """A value of any kind."""
    return random_.choice(
        [
            None, True, False, 0, -1, 2**63, -(2**63), 1e308, -1e308, 1e-320, "", "x" * 300, "\x00", "\ud800",
            [], {}, [[]], [[], []], [[0.0], [[0.0]]], [[0.0], [[0.0, 1.0]]], [[None], [[None]]],
            [["1"], [["1"]]],
            [[1e308], [[1e308]]], [[-1e308, 1e308], [[0.0], [0.0]]], [[True], [[False]]], [[[0.0]], [[0.0]]],
            {"imu": None}, {"imu": [[0.0], [[0.0]]]}, {"": [[0.0], [[0.0]]]}, {"wheels": [[0, 1], [[0.0]]]},
            {"imu": [[0.0, -5.0, 3.0], [[0.0], [1e300], [None]]]}, {"imu": {"time_s": [0], "values": [[0]]}},
            {"imu": [[float("nan")], [[float("inf")]]]}, {"imu": [[2**62], [[2**62]]]},
            {"nothing": [[0], [[0]]]},
            {"imu": [[0.0] * 400, [[0.1]] * 400]}, [0.5, 0.0, 0.0], [float("nan")] * 3, [1e400, 0, 0],
            "samples",
            nested(random_, random_.choice([1, 5, 40, 500])),
        ]
    )  # fmt: skip


def content(random_, first):
    """A hello or samples with something strange in it, and what is no object at all."""
    if random_.random() < 0.1:
        return strange(random_)
    message = dict(first) if random_.random() < 0.4 else {"type": "samples", "streams": {}, "step": True}
    for _ in range(random_.choice([1, 1, 2, 4])):
        key = random_.choice(["type", "session", "robot", "streams", "control", "rate_hz", "record", "token"])
        if message["type"] == "samples":
            key = random_.choice(["streams", "twist", "time_s", "step", "type", "streams", "streams"])
        message[random_.choice([key, key, key, key, "unknown"])] = strange(random_)
    if message.get("type") == "hello":
        message["session"] = random_.choice([None, 7, "../../etc", "", "a" * 65, "a\n", " a", ["x"]])
    return message


def malformed(random_, first):
    """Return a message: text or bytes."""
    kind = random_.random()
    if kind < 0.1:
        return random_.randbytes(random_.choice([0, 1, 2, 10, 300]))
    if kind < 0.2:
        return random_.randbytes(random_.choice([1, 2, 10, 300])).decode("latin-1")
    if kind < 0.25:
        deep = random_.choice([10, 1000, 100_000])
        return random_.choice(
            ["[" * deep, '{"a":' * deep, b"\x91" * deep, b"\x81\xa1a" * deep, "9" * 5000, "1e" * 9]
        )
    if kind < 0.35:
        extra = random_.choice(
            [
                msgpack.ExtType(5, b"x"),
                msgpack.Timestamp(1, 2),
                b"bytes",
                {1: 2},
                {b"k": 1},
                {None: 0},
                2**64 - 1,
            ]
        )
        place = random_.choice(["type", "streams", "twist", "time_s"])
        packed = msgpack.packb({"type": "samples", "streams": {}, "step": True, place: extra})
        return packed[: random_.choice([len(packed), len(packed), len(packed) - 1, 3])]
    value = content(random_, first)
    try:
        message = msgpack.packb(value) if random_.random() < 0.4 else json.dumps(value)
    except (ValueError, OverflowError, UnicodeEncodeError):
        message = json.dumps(value)
    if isinstance(message, str) and random_.random() < 0.2:
        message = message.replace("1e+308", "1e999").replace('"', random_.choice(['"', "'", '"\x01']))
    return message[: random_.randrange(len(message) + 1)] if random_.random() < 0.15 else message


def drain(stranger, mark):
    """Read up to the answer to the last message; return the answers before it."""
    answers = []
    while True:
        text = stranger.recv(20)
        answer = (
            msgpack.unpackb(text) if isinstance(text, bytes) else json.loads(text, parse_constant=pytest.fail)
        )
        if answer["type"] == "error" and mark in answer["message"]:
            return answers
        answers.append(answer)


@pytest.mark.parametrize("n_malformed", [2_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_thousands_of_malformed_messages(running, model_folder, hello, messages, two_drives, n_malformed):
    random_ = random.Random(0)
    codes = set()
    with running(GENEROUS, model=str(model_folder)) as service:
        resident = []
        with beside(service, hello, messages, two_drives[4]):
            n_sent = 0
            while n_sent < n_malformed:
                begun = (n_sent // AT_ONCE) % 3
                with service.socket() as stranger:
                    if begun:
                        first = hello("stranger", rate_hz=0 if begun == 1 else 50)
                        stranger.send(json.dumps(first))
                        assert json.loads(stranger.recv(10))["type"] == "welcome"
                    n = AT_ONCE if begun else 4  # before its hello a client is answered twice a second
                    for _ in range(n):
                        stranger.send(malformed(random_, hello("other")))
                    n_sent += AT_ONCE
                    stranger.send(json.dumps({"type": "THE END"}))
                    for answer in drain(stranger, "THE END"):
                        if answer["type"] == "error":
                            codes.add(answer["code"])
                            assert 5 < len(answer["message"]) < 500
                            assert "Traceback" not in answer["message"]
                        else:
                            assert answer["type"] in ("step", "welcome")
                until(lambda: "stranger" not in service.hub.sessions)
                resident.append(resident_bytes() / 1e6)
        assert codes == {"malformed", "unknown-type", "hello-first", "too-large"}
        assert resident[-1] < resident[len(resident) // 3] + 30.0
        assert json.loads(service.get("/ready")[1]) == {"ready": True, "sessions": 0, "trouble": {}}


def test_too_large_messages_are_refused_and_larger_ones_close_the_connection(service, hello):
    with service.socket() as robot:
        robot.send(json.dumps(hello("large")))
        assert json.loads(robot.recv(10))["type"] == "welcome"
        for filling in ("x" * LIMITS.message_bytes, b"\xc0" * (LIMITS.message_bytes + 1), "x" * 1_000_000):
            robot.send(json.dumps({"type": filling}) if isinstance(filling, str) else filling)
            text = robot.recv(10)
            answer = msgpack.unpackb(text) if isinstance(text, bytes) else json.loads(text)
            assert (answer["code"], answer["fatal"]) == ("too-large", False)
    with raw(service) as connection:
        connection.sendall(frame(b"x" * 4_200_000)[:14])
        assert connection.recv(4)[2:] == struct.pack("!H", 1009)
    until(lambda: "large" not in service.hub.sessions)
    with service.socket() as robot:
        robot.send(json.dumps({"type": "x" * LIMITS.message_bytes}))
        assert json.loads(robot.recv(10))["code"] == "too-large"
        robot.send(json.dumps(hello("large")))
        assert json.loads(robot.recv(10))["type"] == "welcome"


def test_too_many_messages_and_rows_are_named_and_the_rest_is_taken(running, model_folder, hello):
    limits = LIMITS._replace(messages_per_s=50.0, rows_per_s=200.0)
    with running(limits, model=str(model_folder)) as service, service.socket() as robot:
        robot.send(json.dumps(hello("fast")))
        assert json.loads(robot.recv(10))["limits"]["messages_per_s"] == 50.0
        for k in range(100):
            robot.send(json.dumps({"type": "samples", "streams": {"imu": [[k / 100], [[0.1]]]}}))
        n_dropped = 0
        while n_dropped < 40:
            answer = json.loads(robot.recv(10))
            assert answer["code"] == "too-fast"
            dropped = re.fullmatch(
                r"more than 50 messages a second: dropped (\d+) of them", answer["message"]
            )
            n_dropped += int(dropped[1])
        time.sleep(0.5)
        many = [[0.001 * k for k in range(300)], [[0.1]] * 300]
        robot.send(json.dumps({"type": "samples", "streams": {"imu": many}}))
        answer = json.loads(robot.recv(10))
        while "messages a second" in answer["message"]:
            answer = json.loads(robot.recv(10))
        assert "more than 200 rows a second" in answer["message"]
        robot.send(json.dumps({"type": "samples", "streams": {"imu": [[9.0], [[0.1]]]}, "step": True}))
        assert json.loads(robot.recv(10))["type"] == "step"
