"""Latency of the chain in one process: control steps beside the thread that classifies, and windows."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic, perf_counter, sleep

from pipelines.bench.results import Spread, spread
from pipelines.live.classifying import ClassifierThread, classify_window
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import Classifier
from pipelines.models.model_files import TerrainModel
from terrain.logs.replay import replay
from terrain.records import RunLog, Windows
from terrain.robots import Robot

REPEATS = 5
STEP_RATE_HZ = 50.0
N_WINDOWS = 400


@contextmanager
def _as_served() -> Iterator[None]:
    """Let no collection look at what is loaded, as in the service."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def step_times_us(
    robot: Robot, model: TerrainModel, run: RunLog, repeats: int = REPEATS
) -> tuple[Spread, Spread]:
    """Return the times of steps as fast as a log goes: alone, and while the thread classifies a window.

    The log goes by hundreds of times faster than a robot drives, and its windows with it; a robot's thread is
    at a window for a five hundredth of the time.  Steps alone wait until the thread has nothing to do, those
    beside a window do not.
    """
    samples = list(replay(run, STEP_RATE_HZ))
    thread = ClassifierThread()
    times_us: dict[bool, list[float]] = {False: [], True: []}
    try:
        with _as_served():
            for waiting in (True, False):
                for number in range(repeats + 1):
                    pilot = LivePilot(robot, source=Classifier(model, robot, thread.robot()))
                    for sample in samples:
                        beside = thread.busy
                        begun_s = perf_counter()
                        pilot.step(sample)
                        took_us = (perf_counter() - begun_s) * 1e6
                        if number and beside is not waiting:  # the first run compiles and loads
                            times_us[beside].append(took_us)
                        while waiting and thread.busy:
                            sleep(0.0)
    finally:
        thread.stop()
    return spread(times_us[False]), spread(times_us[True])


def paced_step_times_us(robot: Robot, model: TerrainModel, run: RunLog, seconds: float) -> Spread:
    """Return the time of a step at its own rate in real time: between two of them the memory goes cold."""
    thread, times_us = ClassifierThread(), []
    try:
        with _as_served():
            pilot = LivePilot(robot, source=Classifier(model, robot, thread.robot()))
            begin_s = monotonic()
            for sample in replay(run, STEP_RATE_HZ):
                if sample.time_s > seconds:
                    break
                sleep(max(begin_s + sample.time_s - monotonic(), 0.0))
                begun_s = perf_counter()
                pilot.step(sample)
                times_us.append((perf_counter() - begun_s) * 1e6)
    finally:
        thread.stop()
    return spread(times_us[len(times_us) // 10 :])


def window_times_ms(windows: Windows, model: TerrainModel) -> Spread:
    """Return the time from a whole window to its terrain, each window alone."""
    times_ms = []
    for k in range(N_WINDOWS):
        output = classify_window(model, windows[k % len(windows)])
        times_ms.append(output.took_s * 1e3)
    return spread(times_ms[10:])
