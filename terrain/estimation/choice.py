"""The filter or observer of a robot that runs sample by sample, and the streams that its estimates are."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from terrain.estimation.live import LiveEstimate, LiveFilter
from terrain.estimation.observers.choice import OBSERVERS, make_observer
from terrain.estimation.observers.rows import LiveObserver, LiveObserverEstimate
from terrain.extension import Correction
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import Array
from terrain.robots import Robot

Estimate = LiveEstimate | LiveObserverEstimate
Estimator = LiveFilter | LiveObserver

#: Filters and observers that run sample by sample, by drive, without a file of their own; the first is used where
#: none is named.
LIVE_FILTERS: Mapping[str, tuple[str, ...]] = {
    "swerve": ("vio15", "vio12", "slip14", "encoder12"),
    "skid_steer": ("skid",),
    "tracked": ("skid", "tracked", "slip-learning", "gyrodometry", "encoder-odometry"),
    "bicycle": ("sideslip-multi", "sideslip-dynamic", "sideslip-kinematic"),
}


def make_live_filter(
    name: str,
    robot: Robot,
    channels: Mapping[str, tuple[str, ...]],
    rate_hz: Mapping[str, float],
    correction: Correction | None = None,
) -> Estimator:
    """Return a filter of :data:`LIVE_FILTERS`, or an observer, of a corrected robot before its first sample.

    ``channels`` of each stream that is measured are in the order of the columns of its readings; ``rate_hz`` are of the
    streams where they are not those of the robot's description.  ``ConfigError`` if a channel that is needed is not
    measured.
    """
    if name in OBSERVERS:
        return LiveObserver(make_observer(name, robot), robot, channels, correction)
    return LiveFilter(robot, name, channels, rate_hz=rate_hz if name == "skid" else {}, correction=correction)


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
    if stream == "slip":
        return estimate.slip_ratio
    motion = [getattr(estimate, channel) for channel in ESTIMATOR_CHANNELS]
    return np.array(motion if math.isfinite(estimate.speed_y_mps) else [estimate.yaw_rate_radps])
