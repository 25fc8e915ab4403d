"""The windows of a model on a robot: by which filter live, of logs that lack its estimates, and filtered over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from features.stream import WindowFeed
from features.windows import (
    Layout,
    WindowCut,
    check_layout,
    cut_windows,
    holds_a_window,
    join_windows,
    label_windows,
)
from pipelines.live.model import ModelInfo, TerrainModel
from terrain.classify.terrain_filter import FilterSettings, check_settings
from terrain.errors import ConfigError, DataError
from terrain.estimation.live import LIVE_FILTERS, Live, estimated_channels, make_live_filter
from terrain.extension import correct_live
from terrain.logs.replay import SENSORS, replay
from terrain.logs.schema import ESTIMATED
from terrain.records import Array, RunLog
from terrain.robots import Robot, robot_named

STRIDE_S = 0.25  #: From window to window of a model whose outputs are filtered over time, in place of a dwell


def needs_filter(info: ModelInfo, streams: Container[str]) -> bool:
    """Say whether a model needs a stream that only a filter gives, and that is not among some streams."""
    return any(stream in info.channels and stream not in streams for stream in ESTIMATED)


def live_filter(info: ModelInfo, robot: Robot) -> str:
    """Return the filter that gives what a model was trained on; of one that does not name it the first that gives that.

    Raises
    ------
    DataError
        if that filter is none of the robot's.
    """
    filters = LIVE_FILTERS.get(robot.drive, ())
    giving = (name for name in filters if _gives(name, robot, info))
    name = info.filter or next(giving, filters[0] if filters else "")
    if name not in filters:
        raise DataError(
            f"the model was trained on estimates of the filter {name!r}, which robot {robot.name} does not "
            f"run live (its filters: {', '.join(filters) or 'none'})"
        )
    return name


def _gives(name: str, robot: Robot, info: ModelInfo) -> bool:
    """Say whether a filter or observer that needs nothing else gives all estimates that a model takes."""
    try:
        found = estimated_channels(name, robot)
    except ConfigError:  # one that needs a slip model, or that the description leaves out
        return False
    return all(set(info.channels.get(stream, ())) <= set(found[stream]) for stream in ESTIMATED)


def live_estimator(
    info: ModelInfo, robot: Robot, channels: Mapping[str, Sequence[str]]
) -> tuple[Live | None, Robot]:
    """Return the filter whose estimates a model needs, or None, and the robot as filters take it."""
    driven, correction = correct_live(robot)
    if not needs_filter(info, channels):
        return None, driven
    known = {stream: tuple(names) for stream, names in channels.items()}
    return make_live_filter(live_filter(info, driven), driven, known, correction), driven


def feed_of(
    info: ModelInfo, channels: Mapping[str, Sequence[str]], robot: Robot | None, filter_name: str
) -> WindowFeed:
    """Return what cuts the windows of a model from samples as they come.

    Parameters
    ----------
    info : of the model
    channels : of each stream that is measured, in the order of the columns of its readings
    robot : corrected; may be missing where every channel of the model is measured
    filter_name : filter that runs here; empty for none

    Raises
    ------
    DataError
        if the model needs a channel that is neither measured nor estimated, or another filter.
    """
    estimated, name = {}, filter_name
    if needs_filter(info, channels) and robot is not None and robot.drive in LIVE_FILTERS:
        name = live_filter(info, robot)
        estimated = estimated_channels(name, robot)
    feed = WindowFeed(info.rule, info.layout, channels, estimated, robot)
    if name != filter_name:
        raise DataError(
            f"the model was trained on estimates of the filter {info.filter!r}; "
            f"{filter_name or 'none'!r} runs here"
        )
    return feed


def windows_of_log(
    run: RunLog, info: ModelInfo, robot: Robot | None = None, *, skip_short: bool = False
) -> WindowCut:
    """Return the windows of a log that a model takes; of one without estimates, as the live observer cuts them.

    Parameters
    ----------
    run : log of a robot
    info : of the model
    robot : description of the robot of runs that bear its name; the package's by default
    skip_short : leave out and count a run that is shorter than a window instead of refusing it

    Returns
    -------
    WindowCut
        windows with the run and its labels, and what was dropped

    Raises
    ------
    DataError
        if the log lacks what the model or its filter needs, or a stream has a lower rate than the model takes.
    """
    if not needs_filter(info, run.streams):
        return cut_windows([run], info.rule, layout=info.layout, skip_short=skip_short)
    robot = robot_named(run.robot, robot)
    streams = {name: stream for name, stream in run.streams.items() if name in SENSORS}
    channels = {name: stream.channels for name, stream in streams.items()}
    try:
        estimator, corrected = live_estimator(info, robot, channels)
        feed = feed_of(info, channels, corrected, "" if estimator is None else estimator.name)
    except (ConfigError, DataError) as error:
        raise DataError(f"run {run.run_id}: {error}") from error
    names = [name for name in info.channels if name in channels]
    measured = Layout(
        {name: tuple(c for c in info.channels[name] if c in channels[name]) for name in names},
        *({name: rates[name] for name in names} for rates in (info.rate_hz, info.layout.least_hz)),
    )
    own = check_layout(run, measured)
    nothing = cut_windows([], info.rule, layout=info.layout).windows
    if not holds_a_window(run, own, info.window_s, skip_short=skip_short):
        return WindowCut(nothing, {"run too short": 1})
    found = [nothing]
    for sample in replay(RunLog(run.run_id, run.robot, streams)):
        estimates = [] if estimator is None else estimator.step(sample.readings)
        found += feed.push(sample.readings, estimates)
    if estimator is not None:
        found += feed.push({}, estimator.settle(all_of_them=True))
    windows = join_windows(found)
    labelled = replace(
        windows,
        run_id=np.full(len(windows), run.run_id, dtype=object),
        session=np.full(len(windows), run.session, dtype=object),
        terrain=label_windows(run, windows.start_s, windows.length_s),
    )
    reasons = {
        kind.removeprefix("window: "): n for kind, n in feed.dropped.items() if kind.startswith("window: ")
    }
    return WindowCut(labelled, Counter(reasons), Counter(feed.resampled), feed.filled)


def prior_of(info: ModelInfo) -> Array:
    """Return the shares (k,) of a model's classes in training, equal ones where it has none."""
    shares = [float(info.class_ratio.get(name, 1.0 / len(info.classes))) for name in info.classes]
    return check_settings(shares).prior


def filter_of(info: ModelInfo) -> FilterSettings | None:
    """Return the settings of a model's terrain filter; None where single windows are better."""
    if info.share_power is None:
        return None
    return check_settings(prior_of(info).tolist(), info.share_power, info.novelty_weight)


def filtered(model: TerrainModel, stride_s: float | None = STRIDE_S) -> TerrainModel:
    """Return a model whose windows begin every ``stride_s`` and are filtered; the model itself for None.

    One whose single windows are better than filtered ones is not filtered.

    Raises
    ------
    ConfigError
        if the stride is not above zero, or longer than a window, or a setting of the filter is not accepted.
    """
    if stride_s is None:
        return model
    if not 0.0 < stride_s <= model.info.window_s:
        raise ConfigError(
            f"filter stride is {stride_s:g} s: above zero and at most a window, {model.info.window_s:g} s, "
            "is required"
        )
    info = replace(model.info, stride_s=stride_s)
    return model._replace(info=info, over_time=filter_of(model.info))
