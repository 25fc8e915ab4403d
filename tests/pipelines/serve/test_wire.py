"""What strangers and faulty robots send: the service keeps its limits, commands stay fresh, others go on."""

import json
import math
import re
import socket
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus

from pipelines.serve import connection, guard
from pipelines.serve.client import ServiceError, TerrainClient
from pipelines.serve.hub import Limits

from .strangers import CHANNELS, ask, frame, hello, raw, running, until

TOKEN = "a token of the tests"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
DRIVEN = {
    "type": "hello",
    "protocol": 2,
    "robot": "agrimaro",
    "control": True,
    "streams": {"wheels": [f"motor_{i}_radps" for i in (1, 2, 3)]},
}


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.fixture(scope="module")
def guarded(model_folder, tmp_path_factory):
    """A service that requires a token, whose wrong tokens wait for a twentieth of a second."""
    file = tmp_path_factory.mktemp("token") / "token"
    file.write_text(TOKEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.serve.hub.WRONG_TOKEN_S", 0.05)
        with running(model=str(model_folder), host="::1", token_file=file) as service:
            yield service


@pytest.fixture
def decoded(monkeypatch):
    """Size of each message that was decoded, and whether that was in a thread beside the event loop's."""
    found, decode = [], connection.decode

    def noted(message):
        found.append((len(message), "Pool" in threading.current_thread().name))
        return decode(message)

    monkeypatch.setattr(connection, "decode", noted)
    return found


def samples(stamp_s, **more):
    content = {"type": "samples", "streams": {"wheels": [[stamp_s], [[20.0] * 3]]}, "twist": [0.5, 0.0, 0.0]}
    return {**content, **more}


def test_a_robot_that_is_gone_without_a_message_leaves_nothing_behind(service):
    """In the middle of its hello's answer, of a frame, between frames and fragments; in order or by a reset."""
    whole = frame(json.dumps({"type": "samples", "streams": {}, "step": True}).encode())
    for name, reset, last in (
        ("gone-half", False, whole[: len(whole) // 2]),
        ("gone-whole", True, whole),
        ("gone-fragment", True, frame(b'{"type": ', fin=False)),
        ("gone-greeted", False, None),
    ):
        for k in range(5):
            first = hello(f"{name}-{k}")
            with raw(service, None if last is None else first) as line:
                line.sendall(frame(json.dumps(first).encode()) if last is None else last)
                if reset:
                    line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    time.sleep(0.1)
    until(lambda: not [one for one in service.hub.sessions if one.startswith("gone")])
    assert service.hub.trouble == {}


STRANGE = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.text(max_size=20)
    | st.sampled_from([
        [[0.0], [[0.0, 1.0]]], [["1"], [["1"]]], [[True], [[False]]], [[[0.0]], [[0.0]]],
        {"imu": [[0.0], [[0.0]]]}, {"": [[0.0], [[0.0]]]}, {"imu": [[0.0, -5.0, 3.0], [[0.0], [1e300], [None]]]},
        {"imu": {"time_s": [0], "values": [[0]]}}, {"imu": [[2**62], [[2**62]]]}, [0.5, 0.0, 0.0], [1e400, 0, 0],
    ]),
    lambda value: st.lists(value, max_size=4) | st.dictionaries(st.text(max_size=6), value, max_size=4),
    max_leaves=12,
)  # fmt: skip
KEYS = st.sampled_from(["streams", "twist", "time_s", "step", "type", "session", "unknown"])
CONTENT = STRANGE | st.dictionaries(KEYS, STRANGE, max_size=3).map(
    lambda changed: {"type": "samples", "streams": {}, "step": True, **changed}
)
MESSAGE = st.one_of(
    st.text(st.characters(exclude_categories=["Cs"]), max_size=50),
    st.binary(max_size=50),
    st.sampled_from(["[" * 10_000, '{"a":' * 10_000, b"\x91" * 10_000, b"\x81\xa1a" * 10_000, "9" * 5000]),
    CONTENT.map(json.dumps),
    CONTENT.map(lambda value: msgpack.packb(value, unicode_errors="replace")),
    st.tuples(CONTENT.map(json.dumps), st.integers(0, 40)).map(lambda cut: cut[0][: cut[1]]),
)


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(MESSAGE, min_size=1, max_size=20), st.sampled_from([0, 50]), st.booleans())
def test_each_message_is_answered_or_taken(driving, given_messages, rate_hz, packed):
    """Of a robot that gets commands: they are numbers, whatever is sent."""
    with driving.socket() as stranger:
        first = {**DRIVEN, "session": "stranger", "rate_hz": rate_hz}
        assert ask(stranger, first, packed=packed)["type"] == "welcome"
        for message in given_messages:
            stranger.send(message)
        answer = ask(stranger, {"type": "THE END"})
        while "THE END" not in str(answer):
            if answer["type"] == "step":
                assert np.isfinite(
                    [answer["command"][name] for name in ("wheel_radps", "steer_rad", "twist")]
                ).all()
            else:
                assert answer["type"] == "error"
                assert answer["code"] in ("malformed", "unknown-type")
                assert 5 < len(answer["message"]) < 500
            text = stranger.recv(10)
            answer = msgpack.unpackb(text) if isinstance(text, bytes) else json.loads(text)
    until(lambda: "stranger" not in driving.hub.sessions)
    assert driving.hub.trouble == {}


def test_large_messages_are_decoded_in_a_thread_too_large_ones_refused_and_larger_ones_close_the_connection(
    service, decoded, monkeypatch
):
    patient = Limits()._replace(bytes_per_s=1e9, decoding_s_per_s=100.0)
    monkeypatch.setattr(service.hub, "limits", patient)
    with service.socket() as robot:
        assert ask(robot, hello("large"))["type"] == "welcome"
        for size in (1_000, 100_000):
            assert ask(robot, {"type": "x" * size})["code"] == "unknown-type"
        assert [in_thread for _, in_thread in decoded] == [False, False, True]
        for filling in ("x" * patient.message_bytes, "x" * 1_000_000):
            answer = ask(robot, {"type": filling})
            assert (answer["code"], answer["fatal"]) == ("too-large", False)
        assert ask(robot, b"\xc0" * (patient.message_bytes + 1))["code"] == "too-large"
    with raw(service) as line:
        line.sendall(frame(b"x" * 1_100_000)[:14])
        assert line.recv(4)[2:] == struct.pack("!H", 1009)
    until(lambda: "large" not in service.hub.sessions)


def test_before_its_token_nothing_of_a_client_is_decoded_and_wrong_tokens_wait_and_are_counted(
    guarded, decoded
):
    wrong = '{"type": "samples", "streams": {"imu": [' + "0.123," * 40_000
    for first in (wrong, json.dumps(hello("x")), "", TOKEN[:-1], TOKEN + TOKEN, TOKEN.encode()):
        begun_s = time.monotonic()
        with guarded.socket() as stranger:
            answer = ask(stranger, first)
            assert (answer["code"], answer["fatal"]) == ("token", True)
            assert time.monotonic() - begun_s > 0.049
            with pytest.raises(ConnectionClosed):
                stranger.recv(10)
    another = {"Authorization": "Bearer another"}
    with pytest.raises(InvalidStatus, match="401"):
        guarded.socket(additional_headers=another)
    for headers, place, method in (
        (BEARER, "/state", "GET"), ({}, "/state", "GET"), (another, "/model", "GET"), (another, "/model", "PUT"),
    ):  # fmt: skip
        status, text = guarded.get(place, method, content="{}", headers=headers)
        assert (status == 401) == ("a token is required" in text) == (headers is not BEARER)
    assert decoded == []
    assert guarded.hub.metrics.totals()["wrong_tokens"] == 10


def test_a_token_comes_in_the_header_or_as_the_first_frame(guarded, monkeypatch):
    """And its robot is served for longer than a request may take."""
    with monkeypatch.context() as patch, guarded.socket() as robot:
        patch.setattr(guard, "REQUEST_S", 0.2)
        robot.send(TOKEN)
        assert ask(robot, hello("by-frame"))["type"] == "welcome"
        time.sleep(0.4)
        assert ask(robot, {"type": "samples", "streams": {}, "step": True})["type"] == "step"
    with TerrainClient(guarded.ws, "by-header", "mower", CHANNELS, token=TOKEN) as robot:
        assert robot.welcome["session"] == "by-header"
    with pytest.raises(ServiceError, match="a token is required"):
        TerrainClient(guarded.ws, "x", "mower", CHANNELS, token="another")


def test_before_its_hello_a_client_is_answered_once_at_a_time_and_large_messages_are_not_decoded(
    service, decoded, monkeypatch
):
    monkeypatch.setattr(connection, "PAUSE_S", 0.2)
    with service.socket() as stranger:
        begun_s = time.monotonic()
        assert ask(stranger, '{"type": [' + "0.1," * 60_000)["code"] == "too-large"
        assert decoded == []
        assert ask(stranger, "{")["code"] == "malformed"
        assert ask(stranger, {**hello("old"), "protocol": 1})["code"] == "malformed"
        assert time.monotonic() - begun_s > 1.9 * connection.PAUSE_S
        assert ask(stranger, hello("greeted"))["type"] == "welcome"


def test_more_robots_than_are_accepted_wait_until_one_has_left(guarded, monkeypatch):
    until(lambda: not guarded.hub.sessions)
    monkeypatch.setattr(guarded.hub, "limits", Limits()._replace(sessions=1))
    with guarded.socket(additional_headers=BEARER) as late:
        with guarded.socket(additional_headers=BEARER) as robot:
            assert ask(robot, hello("first"))["type"] == "welcome"
            assert ask(late, hello("late"))["code"] == "too-many"
        until(lambda: not guarded.hub.sessions)
        assert ask(late, hello("late"))["type"] == "welcome"


def test_requests_that_do_not_come_whole_are_ended(driving, monkeypatch):
    """A thousand connections that say nothing, half a head, half a body, a WebSocket without a hello."""
    monkeypatch.setattr(guard, "REQUEST_S", 1.0)
    place = urlsplit(driving.http)
    body = f"PUT /table HTTP/1.1\r\nHost: {place.netloc}\r\nContent-Length: 9\r\n\r\nhalf"
    parts = [*[b""] * 1000, b"GET /health HT", body.encode()]
    lines = [socket.create_connection((place.hostname, place.port), 10) for _ in parts]
    begun_s = time.monotonic()
    for line, part in zip(lines, parts, strict=True):
        line.sendall(part)
    with raw(driving) as greeted:
        assert b"no hello came in time" in greeted.recv(1000)
    for line in lines:
        line.settimeout(10)
        with suppress(ConnectionResetError):
            assert line.recv(10) in (b"", b"HTTP/1.1 4")
        line.close()
    assert 0.5 < time.monotonic() - begun_s < 8.0
    assert driving.get("/health")[0] == 200


def test_a_body_of_any_size_takes_no_memory(service):
    """Also of one that does not say its size, in chunks."""
    place, before = urlsplit(service.http), resident_bytes()
    for length, chunk in (
        (b"Content-Length: 600000000", b"x" * 65_536),
        (b"Transfer-Encoding: chunked", b"10000\r\n" + b"x" * 65_536 + b"\r\n"),
    ):
        with socket.create_connection((place.hostname, place.port), 10) as line, suppress(ConnectionError):
            line.sendall(b"PUT /model HTTP/1.1\r\nHost: %s\r\n%s\r\n\r\n" % (place.netloc.encode(), length))
            for _ in range(2000):
                line.sendall(chunk)
    assert resident_bytes() - before < 20e6


@pytest.mark.slow
def test_a_receiver_that_does_not_read_is_ended_and_disturbs_no_other(driving):
    with raw(driving, {**DRIVEN, "rate_hz": 200, "session": "slow"}, buffer=8192) as slow:
        until(lambda: "slow" in driving.hub.sessions)
        with driving.socket() as other:
            assert ask(other, {**DRIVEN, "session": "reads", "rate_hz": 0})["type"] == "welcome"
            begun_s = time.monotonic()
            while "slow" in driving.hub.sessions:
                sent_s = time.monotonic()
                assert sent_s - begun_s < 5.0
                step = ask(other, samples(sent_s, step=True, time_s=sent_s))
                assert step["command"]["status"] == "ok"
                assert time.monotonic() - sent_s < 0.3
                time.sleep(0.005)
        time.sleep(guard.FLUSH_S + 0.5)
        with suppress(ConnectionResetError):  # its end is in order, or not even that
            slow.setblocking(True)
            while slow.recv(65536):
                pass
    assert b'terrain_errors_total{code="too-slow"}' in driving.hub.metrics.text()


def test_a_slow_receiver_that_goes_on_gets_fresh_commands(driving, monkeypatch):
    """Of what came while it did not read, only what the line held already is old."""
    monkeypatch.setattr(driving.hub, "limits", driving.hub.limits._replace(too_slow_s=5.0))
    with raw(driving, {**DRIVEN, "rate_hz": 100, "session": "resumes"}, buffer=4096) as slow:
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            slow.sendall(frame(json.dumps(samples(time.monotonic())).encode()))
            time.sleep(0.02)
        ages, received = [], b""
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
    n_old = sum(age > 0.25 for age in ages)
    assert n_old <= 40, "of 100 steps that it did not read"
    assert len(ages) > n_old + 20
    assert max(ages[n_old:]) <= 0.25


def test_a_message_of_which_a_part_is_refused_gives_an_error_and_a_step_of_the_rest(driving):
    with driving.socket() as robot:
        assert ask(robot, {**DRIVEN, "session": "twist", "rate_hz": 0})["type"] == "welcome"
        twists = ([math.nan] * 3, [0.5, None, 0.0], [0.5, 0.0], [1e999, 0, 0], "x", {})
        odd = [
            *(({"twist": twist}, "twist that is not three numbers") for twist in twists),
            *(({"streams": streams}, "samples that are not given by stream") for streams in ("text", [1])),
            ({"streams": {"lidar": [[0.0], [[1.0]]]}}, "stream that was not announced"),
            ({"streams": {"wheels": 5}}, "sample that is no pair of stamps and rows"),
            ({"streams": {"wheels": [[0.0], [[1.0]]]}}, "wheels: not rows of 3 numbers"),
        ]
        for k, (changed, why) in enumerate(odd):
            robot.send(json.dumps(samples(0.02 * k, step=True, time_s=0.02 * k, **changed)))
            answers = {answer["type"]: answer for answer in (json.loads(robot.recv(3)) for _ in range(2))}
            assert answers["error"]["message"] == f"samples: {why}"
            assert answers["step"]["message"] == answers["step"]["number"] == k + 1
    assert driving.hub.trouble == {}


@pytest.mark.parametrize(
    ("most", "content", "sentence"),
    [
        ({"messages_per_s": 50.0}, {"type": "samples", "streams": {}}, "more than 50 messages a second"),
        ({"bytes_per_s": 500.0}, {"type": "samples", "streams": {}}, "more than 500 bytes a second"),
        ({"decoding_s_per_s": 1e-6}, {"type": "samples", "streams": {}}, "more than 1e-06 s of decoding a second"),
        ({"rows_per_s": 20.0}, samples(1.0, streams={"imu": [[0.1] * 30, [[0.1]] * 30]}), "more than 20 rows a second"),
    ],
)  # fmt: skip
def test_what_is_over_a_budget_is_named_and_the_rest_is_taken(
    service, decoded, monkeypatch, most, content, sentence
):
    monkeypatch.setattr(service.hub, "limits", Limits()._replace(**most))
    with service.socket(close_timeout=0.1) as robot:
        assert ask(robot, hello(f"fast-{sentence.split()[3]}"))["limits"].items() >= most.items()
        for _ in range(100):
            robot.send(json.dumps(content))
        answer = json.loads(robot.recv(10))
        assert (answer["code"], sentence in answer["message"]) == ("too-fast", True)
        assert re.fullmatch(r".*: dropped \d+ of them", answer["message"])
        assert len(decoded) < 95, "what is dropped is not decoded"
