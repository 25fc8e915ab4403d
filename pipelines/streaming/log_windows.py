"""The windows of a log that no filter has run over yet: the live chain makes what is missing."""

from __future__ import annotations

from collections import Counter

import numpy as np

from features.windows import (
    TIME_TOLERANCE_S,
    Layout,
    WindowCut,
    check_layout,
    cut_windows,
    join_windows,
    label_windows,
    span_of,
)
from pipelines.models.results import ModelInfo
from pipelines.streaming.estimator import live_estimator
from pipelines.streaming.window_feed import ESTIMATED, WindowFeed
from terrain.errors import ConfigError, DataError
from terrain.logs.replay import SENSORS, replay
from terrain.records import RunLog, Windows
from terrain.robots import Robot


def lacking_estimates(run: RunLog, info: ModelInfo) -> tuple[str, ...]:
    """Return the streams of estimates that a model uses and a run does not have."""
    return tuple(stream for stream in ESTIMATED if stream in info.channels and stream not in run.streams)


def windows_of_log(run: RunLog, info: ModelInfo, robot: Robot, *, skip_short: bool = False) -> WindowCut:
    """Return the windows of a log that lacks estimates, as :class:`TerrainObserver` cuts them.

    Parameters
    ----------
    run : log of the robot's sensors
    info : of the model
    robot : whose log it is
    skip_short : leave out a run that is shorter than a window instead of refusing it

    Returns
    -------
    WindowCut
        windows with the run and its labels, and what was dropped

    Raises
    ------
    DataError
        if the log lacks what the model or its filter needs, or a stream has another rate.
    """
    streams = {name: stream for name, stream in run.streams.items() if name in SENSORS}
    channels = {name: stream.channels for name, stream in streams.items()}
    try:
        filtered, corrected = live_estimator(info, robot, channels)
        feed = WindowFeed(info, channels, corrected)
    except (ConfigError, DataError) as error:
        raise DataError(f"run {run.run_id}: {error}") from error
    measured = {
        name: tuple(c for c in info.channels[name] if c in channels[name])
        for name in info.channels
        if name in channels
    }
    check_layout(run, Layout(measured, {name: info.rate_hz[name] for name in measured}))
    begin_s, end_s = span_of(run, Layout(measured, info.rate_hz))
    if end_s - begin_s + TIME_TOLERANCE_S < info.window_s:
        if skip_short:
            return WindowCut(cut_windows([], info.rule, layout=info.layout).windows, {"run too short": 1})
        raise DataError(
            f"run {run.run_id} lasts {max(end_s - begin_s, 0):.2f} s, "
            f"shorter than a window of {info.window_s:g} s"
        )
    found: list[Windows] = [cut_windows([], info.rule, layout=info.layout).windows]
    for sample in replay(RunLog(run.run_id, run.robot, streams)):
        estimates = [] if filtered is None else filtered.step(sample.readings)
        found += feed.push(sample.readings, estimates)
    windows = join_windows(found)
    n = len(windows)
    labelled = Windows(
        windows.values,
        windows.channels,
        windows.rate_hz,
        windows.length_s,
        windows.start_s,
        np.full(n, run.run_id, dtype=object),
        label_windows(run, windows.start_s, windows.length_s),
    )
    reasons = {
        kind.removeprefix("window: "): k for kind, k in feed.dropped.items() if kind.startswith("window: ")
    }
    return WindowCut(labelled, Counter(reasons))
