"""The filter whose estimates the windows of a model need, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipelines.models.results import ModelInfo
from pipelines.streaming.window_feed import live_filter, needs_filter
from terrain.estimation.live.estimator import CHANNELS, LiveEstimator
from terrain.estimation.live.skid_live import LiveSkidEstimator
from terrain.estimation.observers.choice import OBSERVERS, make_observer
from terrain.estimation.observers.live import LiveObserver
from terrain.extension import correct_live
from terrain.robots import Robot


def live_estimator(
    info: ModelInfo, robot: Robot, channels: Mapping[str, Sequence[str]]
) -> tuple[LiveEstimator | LiveSkidEstimator | LiveObserver | None, Robot]:
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
