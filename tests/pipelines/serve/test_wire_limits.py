"""Too many, too slow, clocks that are set: the service keeps its limits, and commands stay fresh."""

import asyncio
import json
import math
import socket
import time
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import pytest
from websockets.asyncio.client import connect

from pipelines.serve import guard
from pipelines.serve.hub import LIMITS
from terrain.control.slip_table import load_slip_table

from .strangers import beside, frame, raw, until

DRIVEN = {
    "robot": "agrimaro",
    "control": True,
    "streams": {"wheels": [f"motor_{i}_radps" for i in (1, 2, 3)]},
}
MANY = 1000


@pytest.fixture(scope="module")
def driving(running, model_folder):
    """A service without a model, which gives commands to robots of any channels."""
    limits = LIMITS._replace(hello_s=1.0, too_slow_s=0.6)
    with running(limits, model=str(model_folder)) as service:
        service.hub.swap(None, "", load_slip_table())
        yield service


def samples(stamp_s, speed=20.0, **more):
    content = {"type": "samples", "streams": {"wheels": [[stamp_s], [[speed] * 3]]}, "twist": [0.5, 0.0, 0.0]}
    return {**content, **more}


def assert_finite(step):
    command = step["command"]
    numbers = [*command["wheel_radps"], *command["steer_rad"], *command["twist"]]
    assert len(numbers) == 9
    assert all(isinstance(one, float) and math.isfinite(one) for one in numbers)


def test_a_thousand_robots_at_once(service, hello):
    async def come(k):
        socket_ = await connect(service.ws + "/robots", compression=None, open_timeout=60)
        await socket_.send(json.dumps(hello(f"many-{k}")))
        return socket_, json.loads(await socket_.recv())

    async def all_come():
        found = await asyncio.gather(*(come(k) for k in range(MANY)))
        answers = [answer["type"] if "code" not in answer else answer["code"] for _, answer in found]
        refused = next(one for one, answer in found if answer.get("code") == "too-many")
        for one, answer in found:
            if answer["type"] == "welcome":
                await one.close()
        until(lambda: not service.hub.sessions)
        await refused.send(json.dumps(hello("many-later")))
        later = json.loads(await refused.recv())
        await asyncio.gather(*(one.close() for one, _ in found))
        return answers, later

    answers, later = asyncio.run(all_come())
    assert {kind: answers.count(kind) for kind in set(answers)} == {"welcome": 64, "too-many": MANY - 64}
    assert later["type"] == "welcome"
    until(lambda: not service.hub.sessions)
    assert service.hub.trouble == {}


def test_connections_that_say_nothing_are_ended(driving, monkeypatch):
    monkeypatch.setattr(guard, "REQUEST_S", 1.0)
    place = urlsplit(driving.http)
    silent = [socket.create_connection((place.hostname, place.port), 10) for _ in range(MANY)]
    begun_s = time.monotonic()
    with raw(driving) as greeted:
        assert b"no hello came in time" in greeted.recv(1000)
    for one in silent:
        one.settimeout(10)
        with suppress(ConnectionResetError):
            assert one.recv(10) == b""
        one.close()
    assert time.monotonic() - begun_s < 8.0
    assert driving.get("/health")[0] == 200


@pytest.mark.parametrize(
    ("first", "rest"),
    [
        ("", "GET /health HT"),
        ("", "PUT /table HTTP/1.1\r\nHost: {host}\r\nContent-Length: 9\r\n\r\nhalf"),
    ],
    ids=["head", "body"],
)
def test_a_request_that_does_not_come_whole_is_ended(driving, monkeypatch, first, rest):
    monkeypatch.setattr(guard, "REQUEST_S", 1.0)
    place = urlsplit(driving.http)
    with socket.create_connection((place.hostname, place.port), 10) as one:
        if first:
            one.sendall(first.format(host=place.netloc).encode())
            answer = b""
            while not answer.endswith(b"}"):  # head and body may come one after another
                answer += one.recv(10_000)
            assert answer.startswith(b"HTTP/1.1 200")
        begun_s = time.monotonic()
        one.sendall(rest.format(host=place.netloc).encode())
        with suppress(ConnectionResetError):
            assert one.recv(10) in (b"", b"HTTP/1.1 4")
        assert 0.5 < time.monotonic() - begun_s < 4.0
    assert driving.get("/health")[0] == 200


@pytest.mark.slow
def test_a_receiver_that_does_not_read_is_ended_and_disturbs_no_other(driving):
    begun = {**DRIVEN, "type": "hello", "rate_hz": 200}
    with raw(driving, {**begun, "session": "slow"}, buffer=8192) as slow:
        until(lambda: "slow" in driving.hub.sessions)
        with driving.socket() as other:
            other.send(json.dumps({**begun, "session": "reads", "rate_hz": 0}))
            assert json.loads(other.recv(10))["type"] == "welcome"
            begun_s = time.monotonic()
            while "slow" in driving.hub.sessions:
                sent_s = time.monotonic()
                assert sent_s - begun_s < 5.0
                other.send(json.dumps(samples(sent_s, step=True, time_s=sent_s)))
                assert json.loads(other.recv(10))["command"]["status"] == "ok"
                assert time.monotonic() - sent_s < 0.3
                time.sleep(0.005)
        time.sleep(guard.FLUSH_S + 0.5)
        with suppress(ConnectionResetError):  # its end is in order, or not even that
            slow.setblocking(True)
            while slow.recv(65536):
                pass
    assert b'terrain_errors_total{code="too-slow"}' in driving.hub.metrics.text()


def test_a_slow_receiver_that_goes_on_gets_fresh_commands(driving):
    """Of what came while it did not read, only what the line held already is old."""
    driving.hub.limits = driving.hub.limits._replace(too_slow_s=5.0)
    try:
        hello = {**DRIVEN, "type": "hello", "rate_hz": 100, "session": "resumes"}
        with raw(driving, hello, buffer=4096) as slow:
            end_s = time.monotonic() + 1.5
            while time.monotonic() < end_s:
                slow.sendall(frame(json.dumps(samples(time.monotonic())).encode()))
                time.sleep(0.02)
            ages, received, n_old = [], b"", 0
            end_s = time.monotonic() + 0.5
            while time.monotonic() < end_s:
                slow.sendall(frame(json.dumps(samples(time.monotonic())).encode()))
                received += slow.recv(65536)
                *whole, received = received.split(b'{"type":"step",')
                for text in whole:
                    if text.startswith(b'"time_s":') and not text.startswith(b'"time_s":null'):
                        ages.append(time.monotonic() - float(text[9:].split(b",")[0]))
                if not received.startswith(b'{"type'):
                    received = b'{"type":"step",' + received
    finally:
        driving.hub.limits = driving.hub.limits._replace(too_slow_s=0.6)
    n_old = sum(age > 0.25 for age in ages)
    assert n_old <= 40, "of 150 steps that it did not read"
    assert len(ages) > n_old + 20
    assert max(ages[n_old:]) <= 0.25


@pytest.mark.parametrize("rate_hz", [0, pytest.param(100, marks=pytest.mark.slow)])
def test_clocks_that_are_set_and_stamps_that_are_none(driving, rate_hz):
    """After each the session goes on, with commands that are finite and as new as the robot's last stamp."""
    strange = [None, 1e308, -1e308, 1e15, -1e15, 1e9, 5.0, 5.0, 4.99, 2**62, 0.0, -7200.0, 7200.0]
    with driving.socket() as robot:
        robot.send(
            json.dumps({**DRIVEN, "type": "hello", "session": f"clocks-{rate_hz}", "rate_hz": rate_hz})
        )
        assert json.loads(robot.recv(10))["type"] == "welcome"

        def say(content):
            robot.send(json.dumps({**content, "step": rate_hz == 0}))
            answer = json.loads(robot.recv(10))
            while rate_hz and answer["type"] != "error" and answer["message"] < n_sent:
                answer = json.loads(robot.recv(10))
            return answer

        n_sent, begun_s = 0, time.monotonic() - 100.0
        for stamp in strange:
            n_sent += 1
            step = say(samples(stamp))
            assert step["type"] == "step", step
            assert_finite(step)
            for _ in range(12):
                base_s = time.monotonic() - begun_s
                n_sent += 1
                step = say(samples(base_s, time_s=base_s) if rate_hz == 0 else samples(base_s))
                assert_finite(step)
                time.sleep(0.01)
            assert step["command"]["status"] == "ok", stamp
            assert abs(step["time_s"] - base_s) < 0.5, stamp
    assert driving.hub.trouble == {}


REFUSED_TWISTS = ([math.nan] * 3, [0.5, None, 0.0], [0.5, 0.0], [1e999, 0, 0], "x", {})


def test_a_desired_motion_that_is_none_is_refused_and_the_last_one_ends(driving):
    with ExitStack() as stack:
        robots = [stack.enter_context(driving.socket()) for _ in REFUSED_TWISTS]
        for k, robot in enumerate(robots):
            hello = {**DRIVEN, "type": "hello", "session": f"twist-{k}", "rate_hz": 0}
            robot.send(json.dumps(hello))
            assert json.loads(robot.recv(10))["type"] == "welcome"
        begun_s, statuses = time.monotonic(), []
        while time.monotonic() - begun_s < 0.7:
            now_s = time.monotonic() - begun_s
            content, first = samples(now_s, step=True, time_s=now_s), not statuses
            for robot, twist in zip(robots, REFUSED_TWISTS, strict=True):
                robot.send(json.dumps(content if first else {**content, "twist": twist}))
                answers = [json.loads(robot.recv(3)) for _ in range(1 if first else 2)]
                step = next(one for one in answers if one["type"] == "step")
                if not first:
                    refusal = next(one["message"] for one in answers if one["type"] == "error")
                    assert "twist that is not three numbers" in refusal
                assert_finite(step)
                statuses.append((now_s, step["command"]["status"]))
            time.sleep(0.02)
    assert {status for now_s, status in statuses if now_s < 0.45} == {"ok"}
    assert {status for now_s, status in statuses if now_s > 0.55} == {
        "stopped: the desired motion is too old"
    }
    until(lambda: not any(name.startswith("twist") for name in list(driving.hub.sessions)))


def test_a_huge_desired_motion_gives_finite_commands(driving, service, hello, messages, two_drives):
    with beside(service, hello, messages, two_drives[4]), driving.socket() as robot:
        robot.send(json.dumps({**DRIVEN, "type": "hello", "session": "huge", "rate_hz": 0}))
        robot.recv(10)
        for k, size in enumerate((1e3, 1e9, 1e150, 1e308, -1e308, 1e-308, 0.5)):
            for speed in (20.0, 1e9, 1e308, None, -1e308):
                now_s = 1.0 + 0.1 * k
                twist = [size, size, size]
                robot.send(json.dumps(samples(now_s, speed, step=True, time_s=now_s) | {"twist": twist}))
                assert_finite(json.loads(robot.recv(10)))
