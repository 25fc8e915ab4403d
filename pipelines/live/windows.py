"""The windows of a model, cut from samples as they come: measured channels, and those that a filter adds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from features.stream import WindowStream
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
from pipelines.live.model import WindowsInfo
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.clocks import readable
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.estimator import CHANNELS, LiveEstimator
from terrain.estimation.live.skid_live import LiveSkidEstimate, LiveSkidEstimator
from terrain.estimation.observers.choice import OBSERVERS, make_observer
from terrain.estimation.observers.live import LiveObserver, LiveObserverEstimate
from terrain.extension import correct_live
from terrain.logs.replay import SENSORS, replay
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import Array, Reading, RunLog, Windows
from terrain.robots import Robot

Estimate = LiveEstimate | LiveSkidEstimate | LiveObserverEstimate
Filter = LiveEstimator | LiveSkidEstimator | LiveObserver

LIVE_FILTERS: Mapping[str, tuple[str, ...]] = {
    "swerve": ("vio15", "vio12", "slip14", "encoder12"),
    "skid_steer": ("skid",),
    "tracked": ("skid", "tracked", "slip-learning", "gyrodometry", "encoder-odometry"),
    "bicycle": ("sideslip-multi", "sideslip-dynamic", "sideslip-kinematic"),
}
"""Filters and observers that run sample by sample, by drive, without a file of their own; the first is used
where a model names none."""

ESTIMATED = ("estimator", "slip")
"""Streams that a filter adds to what is measured."""


def needs_filter(info: WindowsInfo, channels: Mapping[str, Sequence[str]]) -> bool:
    """Say whether a model needs a stream that only a filter gives."""
    return any(stream in info.channels and stream not in channels for stream in ESTIMATED)


def live_filter(info: WindowsInfo, robot: Robot) -> str:
    """Return the filter that gives what a model was trained on.

    Raises
    ------
    DataError
        if that filter is none of the robot's.
    """
    filters = LIVE_FILTERS.get(robot.drive, ())
    name = info.filter or (filters[0] if filters else "")
    if name not in filters:
        raise DataError(
            f"the model was trained on estimates of the filter {name!r}, which robot {robot.name} does not "
            f"run live (its filters: {', '.join(filters) or 'none'})"
        )
    return name


def live_estimator(
    info: WindowsInfo, robot: Robot, channels: Mapping[str, Sequence[str]]
) -> tuple[Filter | None, Robot]:
    """Return the filter whose estimates a model needs, or None, and the robot as filters take it.

    Raises
    ------
    DataError
        if the robot does not run the filter that the model was trained with.
    ConfigError
        if a channel that the filter needs is not measured.
    """
    driven, correction = correct_live(robot)
    if not needs_filter(info, channels):
        return None, driven
    name = live_filter(info, driven)
    known = {stream: tuple(names) for stream, names in channels.items()}
    if name in OBSERVERS:
        return LiveObserver(make_observer(name, driven), driven, known, correction), driven
    if name != "skid":
        read = {stream: names for stream, names in known.items() if stream in CHANNELS}
        return LiveEstimator(driven, name, read, correction=correction), driven
    periods = {stream: 1.0 / rate for stream, rate in info.rate_hz.items()}
    return LiveSkidEstimator(
        driven,
        known,
        wheels_period_s=periods.get("wheels"),
        imu_period_s=periods.get("imu"),
        correction=correction,
    ), driven


class WindowFeed:
    """Cut the windows of a model from readings and estimates.

    Wheel speeds are computed from motor rates as :func:`terrain.kinematics.wheel_speed.with_wheel_speeds`
    does, ``estimator`` and ``slip`` are those of :func:`terrain.estimation.enriched.enriched`; all else is
    measured.  The windows are those that :func:`features.windows.cut_windows` cuts from such a log.

    Parameters
    ----------
    info : of the model
    channels : of each stream that is measured, in the order of the columns of its readings
    robot : corrected; may be missing where every channel of the model is measured

    Attributes
    ----------
    unreadable : number of readings that were no arrays of the right shape, by stream

    Raises
    ------
    DataError
        if the model needs a channel that is neither measured nor estimated.

    Examples
    --------
    >>> from pipelines.learn.model_file import ModelInfo
    >>> info = ModelInfo(("grass",), 1.0, None, None, {"imu": ("gyro_z_radps",)}, {"imu": 10.0}, ())
    >>> feed = WindowFeed(info, {"imu": ("accel_x_mps2", "gyro_z_radps")})
    >>> time_s = np.arange(12) / 10
    >>> window, = feed.push({"imu": Reading(time_s, np.column_stack([time_s, -time_s]))})
    >>> float(window.values["imu"][0, 0, -1])
    -0.9
    """

    def __init__(
        self, info: WindowsInfo, channels: Mapping[str, Sequence[str]], robot: Robot | None = None
    ) -> None:
        self.info = info
        self.unreadable: Counter[str] = Counter()
        self._stream = WindowStream(info.rule, info.layout)
        self._measured: dict[str, tuple[int, Callable[[Array], Array]]] = {}
        self._estimated: dict[str, Callable[[Any], Array]] = {}
        for stream, needed in info.channels.items():
            if stream in channels:
                self._measured[stream] = (
                    len(channels[stream]),
                    _columns(stream, needed, list(channels[stream]), robot),
                )
            elif stream in ESTIMATED and robot is not None and robot.drive in LIVE_FILTERS:
                self._estimated[stream] = _estimates(stream, needed, robot, live_filter(info, robot))
            else:
                raise DataError(
                    f"the model requires {needed[0]!r} of the stream {stream!r}, which is neither measured "
                    f"nor estimated here (there are {', '.join(channels) or 'no streams'})"
                )

    def suits(self, info: WindowsInfo) -> bool:
        """Say whether another model takes the same windows."""
        return all(
            getattr(info, name) == getattr(self.info, name)
            for name in ("channels", "rate_hz", "rule", "filter")
        )

    @property
    def dropped(self) -> dict[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        counts = {f"window: {reason}": n for reason, n in self._stream.dropped.items()}
        counts |= {f"{name}: {why}": n for (name, why), n in self._stream.dropped_samples.items()}
        return counts | {f"{name}: unreadable": n for name, n in self.unreadable.items()}

    @property
    def due_s(self) -> float:
        """No sample before this time can finish a window; minus infinity before all streams have begun."""
        return self._stream.due_s

    def push(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate] = ()) -> list[Windows]:
        """Take what was measured and estimated since the last call; return the windows it completes."""
        windows: list[Windows] = []
        push = self._stream.push
        for stream, (n_columns, columns) in self._measured.items():
            if stream not in readings:
                continue
            reading = readable(readings[stream])
            if reading is None or not reading.time_s.size or reading.values.shape[1] != n_columns:
                self.unreadable[stream] += 1
                continue
            for time_s, values in zip(reading.time_s.tolist(), columns(reading.values), strict=True):
                windows += push(stream, time_s, values)
        for estimate in estimates:
            for stream, compute in self._estimated.items():
                windows += push(stream, estimate.time_s, compute(estimate))
        return windows


def _columns(
    stream: str, needed: Sequence[str], measured: list[str], robot: Robot | None
) -> Callable[[Array], Array]:
    """Return what takes the channels of a model out of the columns that are measured."""
    rates = () if robot is None else tuple(f"motor_{wheel}_radps" for wheel in robot.wheels)
    if robot is not None and stream == "wheels" and rates and set(rates) <= set(measured):
        speeds = [f"speed_{wheel}_mps" for wheel in robot.wheels]
        kept = [i for i, channel in enumerate(measured) if channel not in speeds]
        motors = [measured.index(rate) for rate in rates]
        ratio, radius_m = robot.motors.reduction_ratio, robot.wheel_radius_m
        order = _places(stream, needed, [*(measured[i] for i in kept), *speeds])

        def with_speeds(values: Array) -> Array:
            speed_mps = values[:, motors] / ratio * radius_m
            return np.hstack([values[:, kept], speed_mps])[:, order]

        return with_speeds
    places = _places(stream, needed, measured)
    return lambda values: values[:, places]


def _estimates(stream: str, needed: Sequence[str], robot: Robot, name: str) -> Callable[[Any], Array]:
    """Return what takes the channels of a model out of an estimate of the filter of that name."""
    if name in OBSERVERS:
        observer = make_observer(name, robot)
        if stream == "slip":
            places = _places(stream, needed, list(observer.slips))
            return lambda estimate: np.asarray(estimate.slip)[places]
        places = _places(stream, needed, list(observer.states))
        return lambda estimate: np.asarray(estimate.mean)[places]
    if stream == "slip":
        places = _places(stream, needed, [f"slip_{wheel}_ratio" for wheel in robot.wheels])
        if robot.skids:  # nothing sees the ground go by
            unknown = np.full(len(places), np.nan)
            return lambda _: unknown
        return lambda estimate: np.asarray(estimate.slip_ratio)[places]
    known = [
        channel for channel in ESTIMATOR_CHANNELS if robot.drive == "swerve" or channel == "yaw_rate_radps"
    ]
    _places(stream, needed, known)
    return lambda estimate: np.array([getattr(estimate, channel) for channel in needed])


def _places(stream: str, needed: Sequence[str], known: list[str]) -> list[int]:
    lacking = [channel for channel in needed if channel not in known]
    if lacking:
        raise DataError(
            f"the model requires {lacking[0]!r} of the stream {stream!r}, which is neither measured nor "
            f"estimated here (there are {', '.join(known)})"
        )
    return [known.index(channel) for channel in needed]


def lacking_estimates(run: RunLog, info: WindowsInfo) -> tuple[str, ...]:
    """Return the streams of estimates that a model uses and a run does not have."""
    return tuple(stream for stream in ESTIMATED if stream in info.channels and stream not in run.streams)


def windows_of_log(run: RunLog, info: WindowsInfo, robot: Robot, *, skip_short: bool = False) -> WindowCut:
    """Return the windows of a log that lacks estimates, as the live observer cuts them.

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
        estimator, corrected = live_estimator(info, robot, channels)
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
        estimates = [] if estimator is None else estimator.step(sample.readings)
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
