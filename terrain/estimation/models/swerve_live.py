"""The filters of swerve robots as observers, and their feed, sample by sample with the numbers of a whole log."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation import feed
from terrain.estimation.clocks import Due
from terrain.estimation.filter import GATE_PROBABILITY, REOPEN_AFTER_S, Filter, FilterSettings
from terrain.estimation.health import FeedEvidence, HealthMonitor, sensors_of
from terrain.estimation.models.observer import Feed, Observer, ObserverOutput
from terrain.estimation.models.swerve import make_filter, scheduled, statuses
from terrain.estimation.wheel_slip import STALE_AFTER_S, WheelSlip
from terrain.extension import RegionMonitor, check_corrected
from terrain.records import Array
from terrain.robots import Robot

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)  #: Those of the batch.

#: A block of samples of each stream where none came.
_NOTHING = {
    name: (np.empty(0), np.empty(0, np.bool_), np.empty((0, len(names))))
    for name, names in feed.STREAMS.items()
}


class SwerveFeed(Feed):
    """Rows of a swerve robot's filter from samples as they come, by the loop of whole logs over one tick.

    Parameters
    ----------
    robot, channels, initial_yaw_rad : of :func:`swerve_live`
    filter : whose clock judges the stamps
    """

    def __init__(
        self,
        robot: Robot,
        filter: Filter,
        channels: Mapping[str, tuple[str, ...]],
        initial_yaw_rad: float | None,
    ) -> None:
        has = {"gnss": initial_yaw_rad is not None, "odometry": robot.describes("camera")}
        read = {name: names for name, names in feed.STREAMS.items() if has.get(name, True)}
        super().__init__(robot, channels, read)
        self._filter = filter
        sensors, camera = robot.completed.sensors, robot.completed.camera
        rates = {
            "wheels": sensors.wheels_rate_hz,
            "imu": sensors.imu_rate_hz,
            "gnss": 1.0 / feed.GNSS_PERIOD_S,
        }
        rates |= {"steering": sensors.steering_rate_hz, "odometry": camera.rate_hz}
        period_s = {stream: 1.0 / rate for stream, rate in rates.items() if rate > 0.0}
        self.period_s = period_s["wheels"]
        self._settings = feed.feed_settings(
            robot, period_s, initial_yaw_rad or 0.0, is_causal=True, is_live=True
        )
        self.memory, self.numbers = feed.new_feed(), np.full((1, feed.N_NUMBERS), np.nan)
        self.wheels = np.full(len(channels["wheels"]), math.nan)

    @property
    def dropped(self) -> Counter[str]:
        """What was left out, as counts by stream and kind."""
        counts = feed.counts_of(self.memory, self.queues)
        counts["wheels: not finite"] = int(self.memory["wheels_not_finite"][0])
        counts["wheels: beyond the motors"] = int(self.memory["wheels_beyond"][0])
        return counts

    def begin(self) -> None:
        """Begin anew after a clock was set back."""
        feed.forget_times(self.memory)

    def follows(self, time_s: float) -> int:
        """Return what a stamp of the wheels is, as :class:`~.observer.Feed`."""
        follows = self._filter.follows(time_s)
        if follows == 0:  # to count it, and remember a jump
            self._filter.step(time_s, np.full(len(self._filter.model.rows), np.nan))
        return follows

    def tick(self, time_s: float, wheels: Array | None, due: Mapping[str, Due]) -> Array:
        """Return the row of a tick, of the samples that came since the last; None of wheels that gave nothing."""
        blocks = []
        for name, nothing in _NOTHING.items():
            came = due.get(name)
            blocks.append(tuple(map(np.array, zip(*came, strict=True))) if came else nothing)
        stamps, are_whole, samples = zip(*blocks, strict=True)
        self.last_s = time_s
        self.wheels = np.full(self.wheels.size, math.nan) if wheels is None else wheels
        rates = self.wheels[self._rate_columns]
        unknown = ~np.isfinite(rates)
        rates[unknown] = np.nan
        self.memory["wheels_not_finite"] += wheels is not None and unknown.any()
        clock = np.array([time_s])
        feed.run_feed(
            clock, rates[None], stamps, samples, are_whole, self._settings, self.memory, self.numbers
        )
        self.motor_radps = rates
        self.speeds_mps = self._robot.wheel_speeds_mps(rates / self._robot.reduction_ratio)
        return self.numbers[0, : len(feed.ROWS)].copy()

    def snapshot(self) -> Any:
        """Return all that is remembered, for :meth:`restore`."""
        return self.last_s, self.memory.view(np.uint8).copy()  # bytes are copied at once

    def restore(self, memory: Any) -> None:
        """Go back to a snapshot."""
        self.last_s, self.memory.view(np.uint8)[:] = memory


class SwerveObserver(Observer):
    """A filter of a swerve robot as an observer: its states, the slip of its wheels, and the health of its sensors."""

    rows = feed.ROWS

    def __init__(
        self, robot: Robot, filter: Filter, source: SwerveFeed, channels: Mapping[str, tuple[str, ...]]
    ) -> None:
        self.kept = self._filter = filter
        self._feed, self._robot, model = source, robot, filter.model
        self.name, self.states = model.name, model.states
        self.slips = tuple(f"slip_{wheel}_ratio" for wheel in robot.wheels)
        sensors = sensors_of(robot, channels)
        self._monitor, self._evidence = HealthMonitor(sensors), FeedEvidence(robot, filter, sensors)
        self._slip, self._region = WheelSlip(robot, self.states), RegionMonitor(robot)
        self._places = [feed.ROWS.index(row) for row in model.rows]
        self._turn = self.states.index("yaw_rate_radps")

    def step(self, row: Array, _: float) -> ObserverOutput:
        """Take the row of the feed's last tick."""
        source, filter_, time_s, numbers = self._feed, self._filter, self._feed.last_s, self._feed.numbers
        now = scheduled(filter_.model, numbers[:, : len(feed.ROWS)], numbers[:, len(feed.ROWS) :])
        filter_.step(time_s, row[self._places], *(None if part is None else part[0] for part in now))
        measured = source.wheels, source.motor_radps, numbers[0], source.memory
        known = self._evidence.at(time_s, *measured, self._monitor.health)
        self.health = np.array(self._monitor.judge(known), np.int8)
        mean, std = filter_.mean.copy(), np.sqrt(filter_.cov.diagonal())
        self.reference_age_s = age_s = filter_.reference_age_s
        speeds = self._robot.wheel_speeds_mps(numbers[:, : len(self._robot.wheels)])
        unmeasured_s = time_s - source.memory["received_s"].min(axis=1)
        slip, slip_std = self._slip(mean[None], filter_.cov[None], speeds, np.array([age_s]), unmeasured_s)
        self.reason = ""
        if not np.isfinite(slip).any():
            self.reason = f"the last speed over ground is {age_s:.1f} s old"
            if age_s <= STALE_AFTER_S:
                self.reason = "the wheels stand"
            elif age_s == math.inf:
                self.reason = "no speed over ground has come yet"
        if self._region.compares:
            self._region.step(time_s, float(source.speeds_mps.mean()), float(mean[self._turn]))
        status = statuses(filter_.model, filter_.use[None], numbers, np.array([age_s]))
        return ObserverOutput(mean, std, slip[0], slip_std[0], int(status[0]))

    @property
    def dropped(self) -> dict[str, int]:
        """What the filter did not take."""
        return self._filter.dropped

    @property
    def health_names(self) -> dict[str, str]:
        """Health of each sensor by name."""
        return self._monitor.by_name

    def ahead(self, mean: Array, dt_s: float) -> Array:
        """Return the mean (d,) predicted to a later time."""
        d, model = len(self.states), self._filter.model
        later, params = np.empty(d), np.append(model.params, np.zeros(len(model.inputs)))
        model.propagate(mean, dt_s, params, later, np.zeros((d, d)))
        return later

    def snapshot(self) -> Any:
        """Return all that is remembered, for :meth:`restore`."""
        state = self._filter.state.view(np.uint8).copy()  # bytes are copied at once
        return state, self._monitor.health, self._evidence.memory, self._region.memory

    def restore(self, memory: Any) -> None:
        """Go back to a snapshot."""
        state, self._monitor.health, self._evidence.memory, self._region.memory = memory
        self._filter.state.view(np.uint8)[:] = state


def swerve_live(
    name: str,
    robot: Robot,
    channels: Mapping[str, tuple[str, ...]],
    initial_yaw_rad: float | None,
) -> tuple[SwerveObserver, SwerveFeed]:
    """Return a filter of a swerve robot before its first sample, and its feed; as of :func:`.live.make_live_filter`."""
    check_corrected(robot)
    if not math.isfinite(initial_yaw_rad or 0.0):
        raise ConfigError(f"initial_yaw_rad is {initial_yaw_rad}, a finite number is required")
    has_gnss = initial_yaw_rad is not None and "gnss" in channels
    model = make_filter(name, robot, with_gnss=has_gnss)
    robot.require("motors", "steering", "sensors")
    filter_ = Filter(model, SETTINGS)
    source = SwerveFeed(robot, filter_, channels, initial_yaw_rad)
    return SwerveObserver(robot, filter_, source, channels), source
