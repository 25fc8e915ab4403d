"""The service for minutes or hours under robots that misbehave at random."""

from __future__ import annotations

import asyncio
import json
import math
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import msgpack
import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Report, Table, Text
from studies.service import (
    ROBOT,
    Packed,
    ServiceProcess,
    hello,
    messages_of,
    model_folder,
    sent_channels,
    study_drive,
)

EXAMPLE = "python tests/studies soak --robots 8 --minutes 30"
ANSWER_S, DROPPED_S = 5.0, 1.0  #: For an answer; for that of a request that was dropped, if it was not

MEMORY_GROWTH_MOST = 0.05

MEMORY_FROM_MINUTES = 2.0
"""A shorter soak measures how buffers of the first sessions fill (5 % in half a minute), not a leak."""
FAULTS = (
    *("garbage", "oversized", "wrong rows", "not finite", "clock set"),
    *("gone", "half a message", "silent", "flood", "swap"),
)
"""What robots and the operator do, each with the same chance."""

FAULTS_PER_MINUTE = 20.0


CLOCKS_APART_S = 1000.0
"""Each robot has a clock of its own: a window by another's clock is one of another robot."""


class Settings(BaseSettings):
    """How long the service is loaded, and with what."""

    model: str | None = setting(
        None, "Model of AgriMaRo, as of train; by default one trained on four short simulated runs."
    )
    robots: int = setting(8, "Robots at once.", ge=1, le=100)
    minutes: float = setting(30.0, "Length of the soak.", gt=0.0, le=6000.0)
    seed: int = setting(0, "Of the faults and the drives.", ge=0)
    out: Path | None = setting(None, "Folder of the service's states; a temporary one by default.")


class Soak(Result):
    """What the service did under load and faults."""

    minutes: float = described("as asked for", "min")
    seed: int = described("of the faults and the drives")
    steps: int = described("answers that robots got")
    not_finite: int = described("commands that are not finite; none is accepted")
    stale: int = described("commands that were no longer valid when they came; none is accepted")
    wrong_session: int = described("answers with a window of another robot; none is accepted")
    unanswered: int = described("steps that were asked for on a sound connection and did not come in time")
    crashes: int = described("how often the process ended")
    faults: Mapping[str, int] = described("by kind, how often it was made")
    errors: Mapping[str, int] = described("by code, how often the service named one")
    rss_mb: tuple[float, ...] = described("resident memory once a minute, from the first", "MB")
    memory_growth: float = described(
        "of the mean of the last third over the first; judged from two minutes on", "1"
    )
    problems: tuple[str, ...] = described("what is not accepted, in sentences")

    @property
    def refused(self) -> str:
        """What is not accepted; the study ends with exit code 1 where it is not empty."""
        return "; ".join(self.problems)


class _Seen:
    """What all robots saw."""

    def __init__(self) -> None:
        self.steps = self.not_finite = self.stale = self.wrong_session = self.unanswered = self.crashes = 0
        self.faults: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()
        self.rss_mb: list[float] = []
        self.problems: list[str] = []


class _Robot:
    """One robot that drives again and again, and meets the faults that are due."""

    def __init__(
        self, number: int, channels: dict[str, list[str]], messages: Sequence[Packed], seen: _Seen, seed: int
    ) -> None:
        self._first, self._messages = hello(f"soak-{number}", channels), messages
        self._seen, self._rng = seen, np.random.default_rng([seed, number])
        self._own_clock, self._waits_for_itself = True, False
        self.due: list[str] = []

    async def drive(self, url: str, end_s: float) -> None:
        """Drive until a time; a connection that ends is made anew."""
        while monotonic() < end_s:
            try:
                async with connect(f"{url}/robots", compression=None, max_size=None) as socket:
                    await self._session(socket, end_s)
            except (OSError, ConnectionClosed, InvalidHandshake, TimeoutError, EOFError):
                await asyncio.sleep(0.3)

    async def _session(self, socket: ClientConnection, end_s: float) -> None:
        await socket.send(self._first)
        while True:
            answer = msgpack.unpackb(await asyncio.wait_for(socket.recv(), ANSWER_S))
            if answer["type"] == "welcome":
                break
            self._seen.errors[answer.get("code", "?")] += 1
            await asyncio.sleep(0.5)
            await socket.send(self._first)
        self._own_clock = True
        begin_s = monotonic() - self._messages[0].time_s
        for one in self._messages:
            if monotonic() > end_s:
                return
            await asyncio.sleep(max(begin_s + one.time_s - monotonic(), 0.0))
            if self.due and await self._fault(socket, self.due.pop()):
                return
            await socket.send(one.message)
            if one.step:
                await self._answer(socket, one.time_s, asked_s=monotonic())

    async def _answer(self, socket: ClientConnection, time_s: float, asked_s: float) -> None:
        """Wait for the step that was asked for at a time of the robot's clock, and judge it."""
        dropped = False  # the request may be among the messages that came too fast
        while True:
            try:
                limit_s = DROPPED_S if dropped else ANSWER_S
                answer = msgpack.unpackb(await asyncio.wait_for(socket.recv(), limit_s))
            except TimeoutError:
                self._seen.unanswered += not dropped
                return
            if answer["type"] == "error":
                self._seen.errors[answer["code"]] += 1
                if answer["fatal"]:
                    return
                dropped = dropped or answer["code"] == "too-fast"
            elif abs(answer["time_s"] - time_s) < 1e-6:  # and not that of a request before
                self._judge(answer, asked_s)
                return

    def _judge(self, answer: dict[str, Any], asked_s: float) -> None:
        seen, command = self._seen, answer["command"]
        seen.steps += 1
        numbers = [*command["wheel_radps"], *command["steer_rad"], *command["twist"]]
        if not all(isinstance(value, float) and math.isfinite(value) for value in numbers):
            seen.not_finite += 1
        if monotonic() - asked_s > command["valid_s"] and not self._waits_for_itself:
            seen.stale += 1
        self._waits_for_itself = False
        window = answer["observation"]["window"]
        if window is not None and self._own_clock:
            first_s, last_s = self._messages[0].time_s - 1.0, self._messages[-1].time_s + CLOCKS_APART_S / 2
            if not first_s < window["start_s"] < window["end_s"] < last_s:
                seen.wrong_session += 1

    async def _fault(self, socket: ClientConnection, kind: str) -> bool:
        """Make a fault; say whether the connection has ended by it."""
        self._seen.faults[kind] += 1
        rng, streams = self._rng, None
        if kind == "garbage":
            for _ in range(20):
                await socket.send(rng.bytes(int(rng.integers(1, 200))))
        elif kind == "oversized":
            await socket.send(b"\x00" * 300_000)
        elif kind == "wrong rows":
            streams = {"imu": [[1.0], [[1.0, "a"]]], "x": 3}
        elif kind == "not finite":
            streams = {"imu": [[math.nan], [[math.nan if rng.random() < 0.5 else math.inf] * 9]]}
        elif kind == "clock set":
            self._own_clock = False
            streams = {"imu": [[float(rng.choice([-1e4, 1e4, 1e9]))], [[0.0] * 9]]}
        elif kind == "flood":
            self._waits_for_itself = True  # its own next step is behind three thousand messages
            for number in range(3000):
                await socket.send(msgpack.packb({"type": "samples", "streams": {}}))
                if number % 16 == 0:
                    await asyncio.sleep(0)  # the other robots of this process read their answers meanwhile
        elif kind == "silent":
            await asyncio.sleep(3.0)
        else:
            if kind == "half a message":
                socket.transport.write(b"\x82\xfe\x04\x00half")
            socket.transport.abort()
            return True
        if streams is not None:
            await socket.send(msgpack.packb({"type": "samples", "streams": streams}))
        return False


async def _run(
    service: ServiceProcess,
    robots: list[_Robot],
    uri: str,
    settings: Settings,
    seen: _Seen,
    progress: Progress,
) -> None:
    begin_s, length_s = monotonic(), 60.0 * settings.minutes
    rng, every_s = np.random.default_rng(settings.seed), min(60.0, length_s / 12)
    tasks = [asyncio.create_task(robot.drive(service.socket_url, begin_s + length_s)) for robot in robots]
    while (passed_s := monotonic() - begin_s) < length_s:
        if passed_s >= every_s * (len(seen.rss_mb) + 1):
            seen.rss_mb.append(service.rss_mb)
        progress("soak", int(passed_s), int(length_s))
        await asyncio.sleep(float(rng.exponential(60.0 / FAULTS_PER_MINUTE)))
        kind = str(rng.choice(FAULTS))
        if kind == "swap":
            seen.faults[kind] += 1
            await asyncio.to_thread(_swap, service, uri if rng.random() < 0.5 else "/nowhere", seen)
        else:
            robots[int(rng.integers(len(robots)))].due.append(kind)
        if service.process.poll() is not None:
            seen.crashes += 1
            seen.problems.append("the service ended by itself")
            break
    await asyncio.wait(tasks, timeout=30.0)
    for task in tasks:
        task.cancel()
    for error in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(error, Exception):
            seen.problems.append(f"a robot failed: {type(error).__name__}: {error}")


def _swap(service: ServiceProcess, uri: str, seen: _Seen) -> None:
    """Put in another model, or one that does not exist."""
    body = json.dumps({"uri": uri}).encode()
    request = urllib.request.Request(
        f"{service.url}/model", body, {"Content-Type": "application/json"}, method="PUT"
    )
    try:
        with urllib.request.urlopen(request, timeout=30):
            pass
    except urllib.error.HTTPError as error:
        with error:
            seen.errors[f"HTTP {error.code}"] += 1
    except OSError as error:
        seen.problems.append(f"the service does not answer: {error}")


def run(settings: Settings, progress: Progress = silent) -> Soak:
    """Load a service of its own process with robots and faults, and judge what it did."""
    log, seen = study_drive(settings.seed), _Seen()
    with TemporaryDirectory() as folder:
        uri = model_folder(settings.model, settings.seed, Path(folder) / "model")
        states = Path(folder) / "states" if settings.out is None else settings.out
        service = ServiceProcess(["--model", uri, "--robot", ROBOT, "--state", str(states)])
        try:
            robots = [
                _Robot(
                    k, sent_channels(log), messages_of(log, ahead_s=CLOCKS_APART_S * k), seen, settings.seed
                )
                for k in range(settings.robots)
            ]
            asyncio.run(_run(service, robots, uri, settings, seen, progress))
            seen.rss_mb.append(service.rss_mb)
        finally:
            code = service.stop()
    if code != 0 and not seen.crashes:
        seen.crashes += 1
        seen.problems.append(f"the service ended with code {code}")
    return judged(settings, seen)


def judged(settings: Settings, seen: _Seen) -> Soak:
    """Return what was seen, and what of it is not accepted."""
    third = max(len(seen.rss_mb) // 3, 1)
    growth = float(np.mean(seen.rss_mb[-third:]) / np.mean(seen.rss_mb[:third]) - 1.0)
    counts = {
        "commands were not finite": seen.not_finite,
        "commands were stale": seen.stale,
        "answers were of another robot": seen.wrong_session,
        "steps were not answered": seen.unanswered,
    }
    problems = [*seen.problems, *(f"{n} {words}" for words, n in counts.items() if n)]
    if growth > MEMORY_GROWTH_MOST and settings.minutes >= MEMORY_FROM_MINUTES:
        problems.append(f"memory grew by {growth:.1%}, {MEMORY_GROWTH_MOST:.0%} are accepted")
    if not seen.steps:
        problems.append("no step was answered")
    counts = {name: value for name, value in vars(seen).items() if isinstance(value, int)}
    return Soak(
        minutes=settings.minutes,
        seed=settings.seed,
        faults=dict(sorted(seen.faults.items())),
        errors=dict(sorted(seen.errors.items())),
        rss_mb=tuple(seen.rss_mb),
        memory_growth=growth,
        problems=tuple(problems),
        **counts,
    )


def report(result: Soak) -> Report:
    """Return what the service did, and what is not accepted of it."""
    answer = f"Not accepted: {result.refused}." if result.problems else "Nothing that is not accepted."
    return Report(
        f"A soak of {result.minutes:g} minutes, seed {result.seed}",
        answer,
        parts=(
            Text(
                f"{result.steps} steps: {result.not_finite} not finite, {result.stale} stale, {result.wrong_session} "
                f"of another robot, {result.unanswered} unanswered; {result.crashes} crashes. Memory "
                f"{result.rss_mb[0]:.0f} MB at first, {result.rss_mb[-1]:.0f} MB at last: {result.memory_growth:+.1%} "
                "from the first third to the last."
            ),
            Table(("fault", "made"), tuple(sorted(result.faults.items()))),
        ),
    )
