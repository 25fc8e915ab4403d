"""The filter or observer of a robot that runs sample by sample, and the streams that its estimates are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.estimator import CHANNELS, LiveEstimator
from terrain.estimation.live.skid_live import LiveSkidEstimate, LiveSkidEstimator
from terrain.estimation.observers.choice import OBSERVERS, make_observer
from terrain.estimation.observers.live import LiveObserver, LiveObserverEstimate
from terrain.extension import Correction
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import Array
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
where none is named."""


def make_live_filter(
    name: str,
    robot: Robot,
    channels: Mapping[str, tuple[str, ...]],
    rate_hz: Mapping[str, float],
    correction: Correction | None = None,
) -> Filter:
    """Return a filter or an observer of a robot, before its first sample.

    Parameters
    ----------
    name : one of :data:`LIVE_FILTERS` of the robot's drive
    robot : corrected
    channels : of each stream that is measured, in the order of the columns of its readings
    rate_hz : of the streams, where they are not those of the robot's description
    correction : takes the effects of an extended robot off what arrives

    Raises
    ------
    ConfigError
        if a channel that the filter needs is not measured.
    """
    if name in OBSERVERS:
        return LiveObserver(make_observer(name, robot), robot, channels, correction)
    if name != "skid":
        read = {stream: names for stream, names in channels.items() if stream in CHANNELS}
        return LiveEstimator(robot, name, read, correction=correction)
    wheels_s, imu_s = (1.0 / rate_hz[stream] if stream in rate_hz else None for stream in ("wheels", "imu"))
    return LiveSkidEstimator(
        robot, channels, wheels_period_s=wheels_s, imu_period_s=imu_s, correction=correction
    )


def estimated_channels(name: str, robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the channels of the streams :data:`ESTIMATED` that a filter or an observer of a robot gives.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimated_channels("skid", load_robot("husky"))
    {'estimator': ('yaw_rate_radps',), 'slip': ('slip_left_ratio', 'slip_right_ratio')}
    """
    if name in OBSERVERS:
        observer = make_observer(name, robot)
        return {"estimator": observer.states, "slip": observer.slips}
    motion = ("yaw_rate_radps",) if name == "skid" else ESTIMATOR_CHANNELS
    return {"estimator": motion, "slip": tuple(f"slip_{wheel}_ratio" for wheel in robot.wheels)}


def estimated_values(stream: str, estimate: Estimate) -> Array:
    """Return a row of one of :data:`ESTIMATED`, in the order of :func:`estimated_channels`."""
    if isinstance(estimate, LiveObserverEstimate):
        return estimate.slip if stream == "slip" else estimate.mean
    if isinstance(estimate, LiveSkidEstimate):  # nothing sees the ground go by: slip is not known
        return np.full(2, np.nan) if stream == "slip" else np.array([estimate.yaw_rate_radps])
    if stream == "slip":
        return estimate.slip_ratio
    return np.array([getattr(estimate, channel) for channel in ESTIMATOR_CHANNELS])
