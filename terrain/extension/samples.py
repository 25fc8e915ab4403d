"""Taking effects off the samples of a log: the inverse that the entry of each effect states."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from terrain.angles import unwrapped, wrapped
from terrain.effects import OTHER_LOGGER, PARAMETER
from terrain.extension.description import AnyRobot, apply_homes, corrected
from terrain.extension.region import warn_outside
from terrain.kinematics.camera import turned
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot


def correct(run: RunLog, robot: AnyRobot) -> tuple[RunLog, AnyRobot]:
    """Return a log and its robot without the effects that can be taken off them, as filters take both.

    A robot without effects, or one that was corrected, is returned as it is, and so is its log.

    Warns
    -----
    OutsideRegionWarning
        if the run leaves the region that the robot's effects were validated in.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = replace(load_robot("husky"), effects={"wheel_radius_ratio": 0.1})
    >>> wheels = Stream([0.0, 0.1], [[1.0], [1.0]], ("speed_left_mps",))
    >>> run, robot = correct(RunLog("a", "husky", {"wheels": wheels}), robot)
    >>> run.streams["wheels"].values[:, 0], dict(robot.effects)
    (array([1.1, 1.1]), {})
    """
    warn_outside(run, robot)
    return corrected_log(run, robot), corrected(robot)


def correct_live(robot: AnyRobot) -> tuple[AnyRobot, Correction | None]:
    """Return a robot as live filters take it, and what corrects the samples that come; None without effects.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> correct_live(load_robot("husky"))[1] is None
    True
    """
    return corrected(robot), Correction(robot) if robot.effects else None


def corrected_log(run: RunLog, robot: Robot) -> RunLog:
    """Return a log as the robot would have written it without the effects that have an inverse on samples.

    Parameters
    ----------
    run : a log of the robot, as measured
    robot : with its effects; without any the log is returned as it is

    Notes
    -----
    Commands, estimates and labels are left alone; of a simulated truth the wheels' rates become those of
    wheels of one radius.
    """
    if not robot.effects:
        return run
    wheels = run.streams.get("wheels")
    correction = Correction(robot, float(wheels.time_s[0]) if wheels is not None and len(wheels) else 0.0)
    streams = {
        name: Stream(*correction(name, stream.channels, stream.time_s, stream.values), stream.channels)
        for name, stream in run.streams.items()
    }
    delay_s = robot.effects.get("yaw_delay_s", 0.0)
    if delay_s and "wheels" in streams:
        streams["wheels"] = _delay_turning(streams["wheels"], delay_s)
    return replace(run, streams=streams)


def _delay_turning(wheels: Stream, delay_s: float) -> Stream:
    """Delay the difference of the sides' wheel speeds, and leave their mean."""
    names = [f"speed_{side}_mps" for side in ("left", "right")]
    if not set(names) <= set(wheels.channels):
        return wheels
    left, right = (wheels.channel(name) for name in names)
    half = 0.5 * (right - left)
    known = np.isfinite(half)
    if not known.any():
        return wheels
    change = np.interp(wheels.time_s - delay_s, wheels.time_s[known], half[known]) - half
    values = np.array(wheels.values)
    values[:, wheels.channels.index(names[0])] -= change
    values[:, wheels.channels.index(names[1])] += change
    return Stream(wheels.time_s, values, wheels.channels)


class Correction:
    """Takes a robot's effects off samples, a run in one block or block by block.

    The integral of the gyro as it is, bias and scale included, is assumed to be the fused yaw.

    Parameters
    ----------
    robot : with its effects
    start_s : first stamp of the wheels, from which drifts count; the first stamp that comes by default
    """

    def __init__(self, robot: Robot, start_s: float = math.nan) -> None:
        self._start_s = start_s
        self._p = dict.fromkeys(PARAMETER, 0.0) | dict(robot.effects)
        applied = apply_homes(robot)
        homeless = applied.effects
        self._gyro_bias = applied.completed.sensors.gyro_bias_z_radps
        self._gyro_offset = homeless.get("gyro_bias_radps", 0.0)
        self._accel_offset = homeless.get("accel_bias_mps2", 0.0)
        self._imu_late_s = homeless.get("imu_latency_s", 0.0)
        self._current = 1.0 + homeless.get("motor_constant_ratio", 0.0)
        half = 0.5 * self._p["one_sided_radius_ratio"]
        self._side = {wheel: 1.0 + half if wheel in ("3", "right") else 1.0 - half for wheel in robot.wheels}
        self._scale = {wheel: 1.0 + self._p.get(f"wheel_scale_{wheel}_ratio", 0.0) for wheel in robot.wheels}
        self._has_backlash = self._p["steering_backlash_rad"] > 0.0
        self._steered, n = robot.steer_channels, len(robot.steer_channels)
        self._follower, self._angle, self._yaw = np.full(n, np.nan), np.full(n, np.nan), (np.nan, np.nan)
        self._inverses: Mapping[str, Callable[[tuple[str, ...], Array, Array], None]] = {
            "wheels": self._wheels,
            "steering": self._steering,
            "imu": self._imu,
            "odometry": self._camera,
            "lidar": self._camera,
            "pose": self._pose,
            "truth": self._true_wheels,
        }

    def __call__(
        self, name: str, channels: tuple[str, ...], time_s: Array, values: Array
    ) -> tuple[Array, Array]:
        """Return stamps (k,) and values (k, c) of the samples that follow on those given before.

        Parameters
        ----------
        name, channels : of the stream
        time_s, values : (k,), (k, c) as measured
        """
        if math.isnan(self._start_s):
            finite = time_s[np.isfinite(time_s)]
            if not finite.size:
                return time_s, values
            self._start_s = float(finite[0])
        if name in self._inverses:
            values = np.array(values, dtype=float)
            with np.errstate(invalid="ignore", over="ignore"):  # samples may be no finite numbers
                self._inverses[name](channels, np.asarray(time_s), values)
        return self._stamps(name, time_s), values

    def _stamps(self, name: str, time_s: Array) -> Array:
        p = self._p
        if name == "imu" and self._imu_late_s:
            time_s = time_s - self._imu_late_s
        if name in OTHER_LOGGER and (p["clock_offset_s"] or p["clock_rate_ratio"]):
            since_s = (time_s - self._start_s - p["clock_offset_s"]) / (1.0 + p["clock_rate_ratio"])
            return np.asarray(self._start_s + since_s)
        if name == "steering" and p["steering_delay_s"]:
            return np.asarray(time_s + p["steering_delay_s"])
        return time_s

    def _wheels(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        warm = 1.0 + self._p["motor_drift_ratio"] * (time_s - self._start_s) / 60.0
        wheel_speed = 1.0 + self._p["wheel_radius_ratio"]
        for i, channel in enumerate(channels):
            quantity, _, rest = channel.partition("_")
            wheel = rest.rpartition("_")[0]
            if quantity == "current":
                values[:, i] -= self._p["current_offset_a"]
                values[:, i] /= self._current * warm
            elif wheel in self._side and quantity in ("motor", "speed"):
                metres = wheel_speed if quantity == "speed" else 1.0
                values[:, i] *= self._side[wheel] * self._scale[wheel] * metres

    def _true_wheels(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        for i, channel in enumerate(channels):
            quantity, _, rest = channel.partition("_")
            wheel = rest.rpartition("_")[0]
            if quantity == "wheel" and wheel in self._side:
                values[:, i] *= self._side[wheel]

    def _steering(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        if self._p["steering_offset_front_rad"] and "angle_front_rad" in channels:
            values[:, channels.index("angle_front_rad")] += self._p["steering_offset_front_rad"]
        if not self._has_backlash:
            return
        half = self._p["steering_backlash_rad"]
        for wheel, name in enumerate(self._steered):
            if name not in channels:
                continue
            column = channels.index(name)
            angles = unwrapped(np.concatenate([[self._angle[wheel]], values[:, column]]))[1:]
            follower = self._follower[wheel]
            known = np.isfinite(angles)
            for k in np.flatnonzero(known).tolist():
                angle = float(angles[k])
                follower = angle if math.isnan(follower) else min(max(follower, angle - half), angle + half)
                self._angle[wheel] = angle
                values[k, column] = follower
            self._follower[wheel] = follower
            values[known, column] = wrapped(values[known, column])

    def _imu(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        scale = 1.0 + self._p["gyro_scale_ratio"]
        if "gyro_z_radps" in channels:
            gyro = values[:, channels.index("gyro_z_radps")]
            gyro -= self._gyro_offset
            if scale != 1.0:
                gyro -= self._gyro_bias
                gyro /= scale
                gyro += self._gyro_bias
        if "accel_x_mps2" in channels:
            values[:, channels.index("accel_x_mps2")] -= self._accel_offset
        bias = self._p["gyro_bias_radps"]
        if "yaw_rad" in channels and (scale != 1.0 or bias):
            column = channels.index("yaw_rad")
            first_rad, last_rad = self._yaw
            yaw = unwrapped(np.concatenate([[last_rad], values[:, column]]))[1:]
            known = np.isfinite(yaw)
            if known.any():
                first_rad = float(yaw[known][0]) if math.isnan(first_rad) else first_rad
                self._yaw = first_rad, float(yaw[known][-1])
            turned_rad = yaw[known] - first_rad - bias * (time_s[known] - self._start_s)
            values[known, column] = wrapped(first_rad + turned_rad / scale)

    def _camera(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        if self._p["camera_yaw_rad"]:
            turned(values, channels, -self._p["camera_yaw_rad"])

    def _pose(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        scale, angle = 1.0 + self._p["camera_scale_ratio"], self._p["camera_yaw_rad"]
        for i, channel in enumerate(channels):
            if channel.startswith("position_") and scale != 1.0:
                values[:, i] /= scale
            elif channel == "yaw_rad" and angle:
                values[:, i] += angle
