"""Latency of the live chain by stage, and of the service with one robot and with many."""

from __future__ import annotations

import asyncio
import gc
import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, perf_counter, sleep
from typing import Any, NamedTuple

from features.windows import cut_windows
from pipelines.learn.model_file import read_model
from pipelines.live.classifying import Classifier, classify_window
from pipelines.live.pilot import LivePilot
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Pairs, Report, Table
from studies import service as serving
from studies.service import ROBOT, Packed, Spread, spread
from terrain.estimation.estimate import enriched, estimate_run
from terrain.logs.replay import replay
from terrain.records import RunLog, Windows
from terrain.robots import Robot, load_robot

EXAMPLE = "python tests/studies live --robots 25 --seconds 20"
SHARES = (1, 0.4, 1.6)  #: Of the robots that were asked for, in this order
REPEATS = 5
STEP_RATE_HZ = 50.0
N_WINDOWS = 400


class Settings(BaseSettings):
    """What is measured, and for how long."""

    model: str | None = setting(
        None, "Model of AgriMaRo, as of train; by default one trained on four short simulated runs."
    )
    robots: int = setting(25, "Robots at once.", ge=1, le=200)
    seconds: float = setting(20.0, "Length of each measurement.", gt=1.0, le=600.0)
    seed: int = setting(0, "Of the simulated drive.", ge=0)


class SessionsLatency(NamedTuple):
    """Round trip of control steps with so many robots, and what was lost."""

    sessions: int
    p99_ms: float
    median_ms: float
    lost_samples: int


class LiveLatencies(Result):
    """Latencies of the live chain and the service."""

    step_us: Spread = described("one control step, as fast as a log goes, the thread idle", "us")
    step_beside_window_us: Spread = described("the same while the thread classifies a window", "us")
    step_paced_us: Spread = described("one at 50 Hz in real time, where nothing is warm", "us")
    window_ms: Spread = described("from a whole window to its terrain", "ms")
    websocket_ms: Spread = described("round trip of one robot at 100 Hz", "ms")
    sessions: int = described("robots at once that were asked for")
    by_sessions: tuple[SessionsLatency, ...] = described("round trip of as many robots, of fewer and of more")
    start_s: float = described("from the start of the service's process to its first observation", "s")
    rss_mb: float = described("resident memory then", "MB")
    rss_loaded_mb: float = described("resident memory after all robots", "MB")


@contextmanager
def _as_served() -> Iterator[None]:
    """Let no collection look at what is loaded, as in the service."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class _Thread(ThreadPoolExecutor):
    """A classifier's thread that says whether it has something to do."""

    last: Future[Any] | None = None

    def submit(self, *work: Any) -> Future[Any]:  # type: ignore[override]
        self.last = super().submit(*work)
        return self.last

    @property
    def busy(self) -> bool:
        return self.last is not None and not self.last.done()


def step_times_us(
    robot: Robot, model: Any, run: RunLog, *, waits: bool = True, seconds: float = math.inf
) -> dict[bool, list[float]]:
    """Return the times of the steps of a log, of those beside a window that the thread classifies by True.

    By default as fast as it goes.  That is hundreds of times faster than a robot drives, and its windows with it; a
    robot's thread is at a window for a five hundredth of the time.

    Parameters
    ----------
    waits : whether a step waits until the thread has nothing to do
    seconds : of the log, at its own rate in real time: between two steps the memory goes cold
    """
    thread, times_us = _Thread(1), {False: [], True: []}
    try:
        with _as_served():
            pilot, begin_s = LivePilot(robot, source=Classifier(model, robot, thread)), monotonic()
            for sample in replay(run, STEP_RATE_HZ):
                if sample.time_s > seconds:
                    break
                if math.isfinite(seconds):
                    sleep(max(begin_s + sample.time_s - monotonic(), 0.0))
                beside = thread.busy
                begun_s = perf_counter()
                pilot.step(sample)
                times_us[beside].append((perf_counter() - begun_s) * 1e6)
                while waits and thread.busy:
                    sleep(0.0)
    finally:
        thread.shutdown(cancel_futures=True)
    return times_us


def window_times_ms(windows: Windows, model: Any) -> Spread:
    """Return the time from a whole window to its terrain, each window alone."""
    times_ms = []
    for k in range(N_WINDOWS):
        output = classify_window(model, windows[k % len(windows)])
        times_ms.append(output.took_s * 1e3)
    return spread(times_ms[10:])


def run(settings: Settings, progress: Progress = silent) -> LiveLatencies:
    """Measure the live chain and the service on this machine."""
    robot, log = load_robot(ROBOT), serving.study_drive(settings.seed)
    n_stages = 5 + len(SHARES)
    with TemporaryDirectory() as folder:
        uri = serving.model_folder(settings.model, settings.seed, Path(folder) / "model")
        model = read_model(uri)
        progress("live", 1, n_stages)
        step_times_us(robot, model, log)  # compiles and loads
        steps, beside = (
            [
                us
                for _ in range(REPEATS)
                for us in step_times_us(robot, model, log, waits=not at_once)[at_once]
            ]
            for at_once in (False, True)
        )
        progress("live", 2, n_stages)
        paced = step_times_us(robot, model, log, waits=False, seconds=settings.seconds)
        paced_us = [us for each in paced.values() for us in each]
        progress("live", 3, n_stages)
        cut = cut_windows(
            [enriched(estimate_run(log, robot, "vio15"))], model.info.rule, layout=model.info.layout
        )
        window_ms = window_times_ms(cut.windows, model)
        progress("live", 4, n_stages)
        channels = serving.sent_channels(log)
        begun_s = perf_counter()
        with serving.ServiceProcess(["--model", uri, "--robot", ROBOT]) as service:
            each = _within(serving.messages_of(log, 100.0, 100.0), settings.seconds)
            asyncio.run(serving.drive(service.socket_url, serving.hello("first", channels), each[:3]))
            start_s, rss_mb = perf_counter() - begun_s, service.rss_mb
            one = asyncio.run(serving.drive(service.socket_url, serving.hello("one", channels), each))
            progress("live", 5, n_stages)
            messages = _within(serving.messages_of(log), settings.seconds)
            by_sessions = []
            for stage, share in enumerate(SHARES):
                n = max(math.ceil(share * settings.robots), 1)
                before = service.figure("terrain_rows_total")
                driven = asyncio.run(serving.drive_all(service.socket_url, channels, messages, n))
                taken = service.figure("terrain_rows_total") - before
                times = spread([ms for found in driven for ms in found.times_ms])
                lost = sum(found.rows for found in driven) - int(taken)
                by_sessions.append(SessionsLatency(n, times.p99, times.median, lost))
                progress("live", 6 + stage, n_stages)
            rss_loaded_mb = service.rss_mb
    return LiveLatencies(
        *(spread(steps), spread(beside), spread(paced_us), window_ms, spread(one.times_ms[20:])),
        *(by_sessions[0].sessions, tuple(sorted(by_sessions)), start_s, rss_mb, rss_loaded_mb),
    )


def _within(messages: list[Packed], seconds: float) -> list[Packed]:
    return [one for one in messages if one.time_s - messages[0].time_s <= seconds]


def report(result: LiveLatencies) -> Report:
    """Return each latency with its unit, and what many robots see."""
    stages = (
        ("control step", "us", result.step_us),
        ("control step while a window is classified", "us", result.step_beside_window_us),
        ("control step at 50 Hz in real time", "us", result.step_paced_us),
        ("window to terrain", "ms", result.window_ms),
        ("round trip, one robot at 100 Hz", "ms", result.websocket_ms),
    )
    latencies = tuple((name, unit, *found) for name, unit, found in stages)
    many = tuple((one.sessions, one.median_ms, one.p99_ms, one.lost_samples) for one in result.by_sessions)
    columns = ("robots", Column("median", ".2f", "ms"), Column("99 %", ".2f", "ms"), "samples lost")
    asked = next(each for each in result.by_sessions if each.sessions == result.sessions)
    return Report(
        "The live chain and the service",
        f"A control step takes {result.step_us.median:.3g} us, a window {result.window_ms.median:.3g} ms; of "
        f"{asked.sessions} robots 99 % of the answers come within {asked.p99_ms:.3g} ms, and "
        f"{asked.lost_samples} samples are lost.",
        parts=(
            Table(("stage", "unit", "median", "99 %", "largest"), latencies, title="Latency"),
            Table(columns, many, title="Control steps at 20 Hz, samples at 100 Hz"),
            Pairs(
                (
                    ("start to the first observation", result.start_s, ".2f", "s"),
                    ("memory then", result.rss_mb, ".0f", "MB"),
                    ("memory after all robots", result.rss_loaded_mb, ".0f", "MB"),
                )
            ),
        ),
    )
