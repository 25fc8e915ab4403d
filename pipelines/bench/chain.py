"""Latency of the chain in one process: control steps beside the thread that classifies, and windows."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic, perf_counter, sleep

from pipelines.bench.results import Spread, spread
from pipelines.live.classifying import ClassifierThread, classify_window
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import Classifier
from pipelines.models.model_files import TerrainModel
from pipelines.serve.server import SWITCH_S
from terrain.logs.replay import replay
from terrain.records import RunLog, Windows
from terrain.robots import Robot

REPEATS = 5
STEP_RATE_HZ = 50.0
N_WINDOWS = 400


@contextmanager
def _switching() -> Iterator[None]:
    """Let threads take turns as they do in the service."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def step_times_us(robot: Robot, model: TerrainModel, run: RunLog, repeats: int = REPEATS) -> Spread:
    """Return the time of a step as fast as the log goes; the windows are classified on their thread."""
    samples, times_us = list(replay(run, STEP_RATE_HZ)), []
    thread = ClassifierThread()
    try:
        with _switching():
            for number in range(repeats + 1):
                pilot = LivePilot(robot, source=Classifier(model, robot, thread.robot()))
                for sample in samples:
                    begun_s = perf_counter()
                    pilot.step(sample)
                    if number:  # the first run compiles and loads
                        times_us.append((perf_counter() - begun_s) * 1e6)
    finally:
        thread.stop()
    return spread(times_us)


def paced_step_times_us(robot: Robot, model: TerrainModel, run: RunLog, seconds: float) -> Spread:
    """Return the time of a step at its own rate in real time: between two of them the memory goes cold."""
    thread, times_us = ClassifierThread(), []
    try:
        with _switching():
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
