"""A service in a process of its own, a small model for it, and robots that drive against it."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple, Self

import msgpack
import numpy as np
from websockets.asyncio.client import connect

from terrain.errors import TerrainError
from terrain.estimation.estimate import enriched, estimate_run
from terrain.estimation.live import CHANNELS
from terrain.logs.replay import replay
from terrain.records import Array, RunLog
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = "agrimaro"
STEP_RATE_HZ, IMU_RATE_HZ = 20.0, 100.0
DRIVE_S, TRAINING_S = 40.0, 25.0
ANSWER_S = 5.0
APART_S = 2.0  #: Robots do not start at one instant, and their windows do not end at one
COMMAND = (sys.executable, "-c", "from pipelines.cli.main import main; main()", "serve")


class Spread(NamedTuple):
    """Median, 99th percentile and largest of a figure; NaN of none."""

    median: float
    p99: float
    largest: float


def spread(values: Array | list[float]) -> Spread:
    """Return the spread of some figures."""
    if not len(values):
        return Spread(np.nan, np.nan, np.nan)
    median, p99 = np.percentile(values, [50, 99])
    return Spread(float(median), float(p99), float(np.max(values)))


def study_drive(seed: int) -> RunLog:
    """Return a drive on grass at changing speeds."""
    return simulate_run(load_robot(ROBOT), "grass", "survey", seed, duration_s=DRIVE_S)


def model_folder(uri: str | None, seed: int, into: Path) -> str:
    """Return what the service is given as its model: the URI, or a folder with one of four short runs."""
    if uri is not None:
        return uri
    from pipelines.learn.model_file import write_model
    from pipelines.learn.settings import RecipeSettings
    from pipelines.learn.training_data import fitted_model

    robot = load_robot(ROBOT)
    simulated = [
        simulate_run(robot, soil, "survey", seed, number, duration_s=TRAINING_S)
        for soil in ("grass", "tiles")
        for number in (1, 2)
    ]
    runs = [enriched(estimate_run(run, robot, "vio15")) for run in simulated]
    into.mkdir(parents=True, exist_ok=True)
    write_model(into, fitted_model(runs, RecipeSettings(seed=seed), "simulated"))
    return str(into)


def sent_channels(run: RunLog) -> dict[str, list[str]]:
    """Return the streams that a robot sends of a run, with their channels."""
    return {name: list(run.streams[name].channels) for name in CHANNELS if name in run.streams}


class Packed(NamedTuple):
    """A message as it is sent; its time on the robot's clock, whether it asks for a step, and its rows."""

    message: bytes
    time_s: float
    step: bool
    rows: int


def messages_of(
    run: RunLog, rate_hz: float = IMU_RATE_HZ, step_rate_hz: float = STEP_RATE_HZ, ahead_s: float = 0.0
) -> list[Packed]:
    """Return the messages of a robot whose clock is ahead: samples at one rate, of which some ask for a step."""
    every, messages = round(rate_hz / step_rate_hz), []
    for k, sample in enumerate(replay(run, rate_hz)):
        streams = {
            name: [
                (reading.time_s + ahead_s).tolist(),
                [[None if v != v else v for v in row] for row in reading.values.tolist()],
            ]
            for name, reading in sample.readings.items()
        }
        time_s, step = float(sample.time_s) + ahead_s, k % every == 0
        content: dict[str, Any] = {"type": "samples", "streams": streams, "time_s": time_s}
        if step:
            content |= {"twist": sample.twist.tolist(), "step": True}
        rows = sum(len(reading.time_s) for reading in sample.readings.values())
        messages.append(Packed(msgpack.packb(content), time_s, step, rows))
    return messages


def hello(session: str, channels: dict[str, list[str]]) -> bytes:
    """Return the first message of a robot that asks for each of its steps."""
    content = {"type": "hello", "session": session, "robot": ROBOT, "streams": channels}
    message: bytes = msgpack.packb({**content, "control": True, "follows": False, "rate_hz": 0.0})
    return message


class Driven(NamedTuple):
    """What a robot saw: round trips, and rows sent."""

    times_ms: list[float]
    rows: int


async def drive(url: str, first: bytes, messages: Sequence[Packed], delay_s: float = 0.0) -> Driven:
    """Drive one robot in real time; return the round trips of its steps.

    Raises
    ------
    TimeoutError
        if a step is not answered.
    """
    times_ms: list[float] = []
    async with connect(f"{url}/robots", compression=None, max_size=None) as socket:
        await socket.send(first)
        answer = msgpack.unpackb(await socket.recv())
        if answer.get("type") != "welcome":
            raise TerrainError(f"the service refuses a robot: {answer.get('message')}")
        begin_s = monotonic() + delay_s - messages[0].time_s
        for one in messages:
            await asyncio.sleep(max(begin_s + one.time_s - monotonic(), 0.0))
            sent_s = monotonic()
            await socket.send(one.message)
            if one.step:
                async with asyncio.timeout(ANSWER_S):
                    while msgpack.unpackb(await socket.recv()).get("type") != "step":
                        pass
                times_ms.append((monotonic() - sent_s) * 1e3)
    return Driven(times_ms, sum(one.rows for one in messages))


async def drive_all(
    url: str, channels: dict[str, list[str]], messages: Sequence[Packed], n: int
) -> list[Driven]:
    """Drive several robots at once, their starts spread over the time of a window."""
    tasks = [drive(url, hello(f"bench-{k}", channels), messages, 0.5 + APART_S * k / n) for k in range(n)]
    return list(await asyncio.gather(*tasks))


class ServiceProcess:
    """A running service, which ends with a ``with`` block.

    Attributes
    ----------
    url : of its HTTP side
    process : that runs it
    """

    def __init__(self, options: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "--port", "0", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if " at http" not in line:
            _, text = self.process.communicate(timeout=30)
            lines = text.strip().splitlines()
            raise TerrainError(f"the service did not start: {lines[-1] if lines else 'it says nothing'}")
        self.url = line.rsplit(" at ", 1)[1].strip()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.stop()

    @property
    def socket_url(self) -> str:
        """Address of its WebSockets."""
        return self.url.replace("http", "ws", 1)

    @property
    def rss_mb(self) -> float:
        """Resident memory of the process in MB; 0 where the system does not tell."""
        return self.figure("process_resident_memory_bytes") / 1e6

    def figure(self, name: str) -> float:
        """Return one of its Prometheus figures; 0 where there is none yet."""
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=10) as answer:
            text: str = answer.read().decode()
        values = [line.rsplit(" ", 1)[1] for line in text.splitlines() if line.startswith(f"{name} ")]
        return float(values[0]) if values else 0.0

    def stop(self, timeout_s: float = 10.0) -> int:
        """End it in order; return its exit code."""
        self.process.terminate()
        try:
            self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
        return int(self.process.returncode)
