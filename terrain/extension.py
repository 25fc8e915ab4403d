"""Extended robots: a description with what its simulation lacked, and what filters make of it.

An effect (:mod:`terrain.effects.catalogue`) either has a home in the description, as a wheel's radius has,
or it can be taken from the samples, as a gyro's scale can, or it is one of the ground or of the way the
robot turns, which filters do not model.  :func:`corrected` deals with the first, :class:`Correction` with the
second; together they are a robot and a log without those effects::

    run, robot = corrected_log(run, robot), corrected(robot)

========================= ===================================================================================
effect                    where it goes
========================= ===================================================================================
wheel_radius              wheel_radius_m, and wheel speeds that a log has
steering_offset_i         steering.zero_i_rad, less by d0: the true angle is raw - zero + d0
gyro_bias                 sensors.gyro_bias_z_radps; and off the fused yaw, which sums it
accel_bias                sensors.accel_bias_x_mps2
camera_latency, lever_arm camera.latency_s, camera.lever_x_m and lever_y_m
encoder_lag               sensors.encoder_time_constant_s: behind as much of a low-pass goes all else
payload                   mass_kg, and with it the yaw inertia
motor_constant            motors.torque_constant_nmpa
effective_track           track_m of a skid-steer robot, where its filter starts
one_sided_radius          rates and wheel speeds of each side
steering_backlash, -_delay    the steering angles go through the play; their stamps are later
yaw_delay                 the difference of the sides' wheel speeds comes later
gyro_scale                gyro about its bias, and the fused yaw
camera_yaw                the camera's frames are turned back
clock_offset, -_rate      stamps of imu, odometry, gnss and lidar, on the clock of the wheels
motor_drift               currents, from the first stamp of the wheels
all others                stay: of the ground, or of turning
========================= ===================================================================================

Where a description has no section, samples are corrected instead if they can be: gyro, accelerometer and
currents.  That the fused yaw is the integral of the gyro as it is, bias and scale included, is assumed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from terrain.angles import unwrapped, wrapped
from terrain.effects.described import SCHEMA, checked_covariance, checked_effects, parameters_of
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.files.descriptions import read_yaml
from terrain.kinematics.camera import turned
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot, description_file, robot_from

OTHER_LOGGER = ("imu", "odometry", "gnss", "lidar")
"""Streams that are not stamped by the logger of the wheels."""

DIGITS = 7
"""Significant digits that a file has of each number."""


def _part(robot: Robot, section: str, **added: float) -> Robot:
    part = getattr(robot, section)
    changed = {name: getattr(part, name) + value for name, value in added.items()}
    return replace(robot, **{section: replace(part, **changed)})


def _payload(robot: Robot, ratio: float) -> Robot:
    body = robot.body
    if body is not None:
        body = replace(body, yaw_inertia_kgm2=body.yaw_inertia_kgm2 * (1.0 + ratio))
    return replace(robot, mass_kg=robot.mass_kg * (1.0 + ratio), body=body)


def _motor_constant(robot: Robot, ratio: float) -> Robot:
    assert robot.motors is not None
    constant = robot.motors.torque_constant_nmpa / (1.0 + ratio)
    return replace(robot, motors=replace(robot.motors, torque_constant_nmpa=constant))


def _accel_bias(robot: Robot, bias_mps2: float) -> Robot:
    assert robot.sensors is not None
    return _part(robot, "sensors", accel_bias_x_mps2=bias_mps2 * robot.sensors.accel_scale_x_ratio)


def _steering_offset(wheel: int) -> Callable[[Robot, float], Robot]:
    return lambda robot, offset_rad: _part(robot, "steering", **{f"zero_{wheel}_rad": -offset_rad})


HOMES: Mapping[str, tuple[str | None, Callable[[Robot, float], Robot]]] = {
    "wheel_radius_ratio": (None, lambda r, e: replace(r, wheel_radius_m=r.wheel_radius_m * (1.0 + e))),
    "effective_track_ratio": (None, lambda r, e: replace(r, track_m=r.track_m * (1.0 + e))),
    "payload_ratio": (None, _payload),
    "motor_constant_ratio": ("motors", _motor_constant),
    "gyro_bias_radps": ("sensors", lambda r, b: _part(r, "sensors", gyro_bias_z_radps=b)),
    "accel_bias_mps2": ("sensors", _accel_bias),
    "encoder_lag_s": ("sensors", lambda r, lag: _part(r, "sensors", encoder_time_constant_s=lag)),
    "camera_latency_s": ("camera", lambda r, late: _part(r, "camera", latency_s=late)),
    "lever_x_m": ("camera", lambda r, x: _part(r, "camera", lever_x_m=x)),
    "lever_y_m": ("camera", lambda r, y: _part(r, "camera", lever_y_m=y)),
    **{f"steering_offset_{i}_rad": ("steering", _steering_offset(i)) for i in (1, 2, 3)},
}
"""Section that an effect needs, if any, and what it makes of a robot."""

_IN_SAMPLES = (
    *("one_sided_radius_ratio", "steering_backlash_rad", "steering_delay_s", "yaw_delay_s"),
    *("gyro_bias_radps", "gyro_scale_ratio", "accel_bias_mps2", "camera_yaw_rad"),
    *("clock_offset_s", "clock_rate_ratio", "motor_constant_ratio", "motor_drift_ratio"),
)


def moved(robot: Robot, names: tuple[str, ...] = tuple(HOMES)) -> Robot:
    """Return a robot with those of its effects that have a home in its description moved there.

    Parameters
    ----------
    robot : any; without effects it comes back as it is
    names : parameters that are moved, as far as the robot has them and their section

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = moved(replace(load_robot("agrimaro"), effects={"payload_ratio": 0.1, "camera_yaw_rad": 0.02}))
    >>> round(robot.mass_kg, 3), dict(robot.effects)
    (99.0, {'camera_yaw_rad': 0.02})
    """
    gone = []
    for name, value in robot.effects.items():
        section, move = HOMES.get(name, (None, None))
        if move is not None and name in names and (section is None or getattr(robot, section) is not None):
            robot = move(robot, value)
            gone.append(name)
    return _without(robot, gone)


def corrected(robot: Robot) -> Robot:
    """Return the robot as its filters should believe it to be, on a log that is :func:`corrected_log`.

    Effects that have a home in the description are moved there; of the others those are left that no
    correction of a log takes off.  A robot without effects comes back as it is, and so does one that is
    corrected already.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = corrected(replace(load_robot("agrimaro"), effects={"wheel_radius_ratio": 0.05}))
    >>> round(robot.wheel_radius_m, 3), dict(robot.effects)
    (0.21, {})
    """
    return _without(moved(robot), _IN_SAMPLES)


def _without(robot: Robot, names: Any) -> Robot:
    kept = [i for i, name in enumerate(robot.effects) if name not in names]
    if len(kept) == len(robot.effects):
        return robot
    left = list(robot.effects.items())
    return replace(
        robot, effects=dict(left[i] for i in kept), effects_cov=robot.effects_cov[np.ix_(kept, kept)]
    )


def corrected_log(run: RunLog, robot: Robot) -> RunLog:
    """Return a log as the robot would have written it without those of its effects that samples show.

    Parameters
    ----------
    run : a log of the robot, as measured
    robot : with its effects; without any the log comes back as it is.  With those of :func:`corrected`
        nothing is corrected twice

    Notes
    -----
    Commands and what was estimated are left alone, and so are the labels; of a simulated truth the wheels'
    rates become those of wheels of one radius.
    """
    if not robot.effects:
        return run
    wheels = run.streams.get("wheels")
    correction = Correction(robot, float(wheels.time_s[0]) if wheels is not None and len(wheels) else 0.0)
    streams = {
        name: Stream(*correction(name, stream.channels, stream.time_s, stream.values), stream.channels)
        for name, stream in run.streams.items()
    }
    late_s = robot.effects.get("yaw_delay_s", 0.0)
    if late_s and "wheels" in streams:
        streams["wheels"] = _turning_later(streams["wheels"], late_s)
    return replace(run, streams=streams)


def _turning_later(wheels: Stream, late_s: float) -> Stream:
    """Delay the difference of the sides' wheel speeds, and leave their mean."""
    names = [f"speed_{side}_mps" for side in ("left", "right")]
    if not set(names) <= set(wheels.channels):
        return wheels
    left, right = (wheels.channel(name) for name in names)
    half = 0.5 * (right - left)
    known = np.isfinite(half)
    if not known.any():
        return wheels
    change = np.interp(wheels.time_s - late_s, wheels.time_s[known], half[known]) - half
    values = np.array(wheels.values)
    values[:, wheels.channels.index(names[0])] -= change
    values[:, wheels.channels.index(names[1])] += change
    return Stream(wheels.time_s, values, wheels.channels)


class Correction:
    """Takes from samples what a robot's effects did to them, a run in one block or block by block.

    Parameters
    ----------
    robot : with its effects
    start_s : first stamp of the wheels, from which drifts count
    """

    def __init__(self, robot: Robot, start_s: float) -> None:
        self._start_s = start_s
        self._p = dict.fromkeys(parameters_of(robot.drive), 0.0) | dict(robot.effects)
        believed = moved(robot)
        left = believed.effects
        self._gyro_bias = believed.sensors.gyro_bias_z_radps if believed.sensors else 0.0
        self._gyro_rest, self._accel_rest = left.get("gyro_bias_radps", 0.0), left.get("accel_bias_mps2", 0.0)
        self._current = 1.0 + left.get("motor_constant_ratio", 0.0)
        half = 0.5 * self._p["one_sided_radius_ratio"]
        swerve = robot.drive == "swerve"
        self._side = {wheel: 1.0 + half if wheel in ("3", "right") else 1.0 - half for wheel in robot.wheels}
        self._has_backlash = swerve and self._p["steering_backlash_rad"] > 0.0
        self._follower, self._angle, self._yaw = np.full(3, np.nan), np.full(3, np.nan), (np.nan, np.nan)
        self._steps: Mapping[str, Callable[[tuple[str, ...], Array, Array], None]] = {
            "wheels": self._wheels,
            "steering": self._steering,
            "imu": self._imu,
            "odometry": self._camera,
            "lidar": self._camera,
            "truth": self._wheels,
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
        if name in self._steps:
            values = np.array(values, dtype=float)
            with np.errstate(invalid="ignore", over="ignore"):  # of samples that are no numbers
                self._steps[name](channels, np.asarray(time_s), values)
        return self._stamps(name, time_s), values

    def _stamps(self, name: str, time_s: Array) -> Array:
        p = self._p
        if name in OTHER_LOGGER and (p["clock_offset_s"] or p["clock_rate_ratio"]):
            since_s = (time_s - self._start_s - p["clock_offset_s"]) / (1.0 + p["clock_rate_ratio"])
            return np.asarray(self._start_s + since_s)
        if name == "steering" and p.get("steering_delay_s"):
            return np.asarray(time_s + p["steering_delay_s"])
        return time_s

    def _wheels(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        warm = 1.0 + self._p["motor_drift_ratio"] * (time_s - self._start_s) / 60.0
        wheel_speed = 1.0 + self._p["wheel_radius_ratio"]
        for i, channel in enumerate(channels):
            quantity, _, rest = channel.partition("_")
            wheel = rest.rpartition("_")[0]
            if quantity == "current":
                values[:, i] /= self._current * warm
            elif wheel in self._side and quantity in ("motor", "speed", "wheel"):
                values[:, i] *= self._side[wheel] * (wheel_speed if quantity == "speed" else 1.0)

    def _steering(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        if not self._has_backlash:
            return
        half = self._p["steering_backlash_rad"]
        for wheel in range(3):
            if f"angle_{wheel + 1}_rad" not in channels:
                continue
            column = channels.index(f"angle_{wheel + 1}_rad")
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
            gyro -= self._gyro_rest
            if scale != 1.0:
                gyro -= self._gyro_bias
                gyro /= scale
                gyro += self._gyro_bias
        if "accel_x_mps2" in channels:
            values[:, channels.index("accel_x_mps2")] -= self._accel_rest
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


def extended_yaml(
    robot_name: str | Path,
    values: Mapping[str, float],
    covariance: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str,
) -> str:
    """Return the description of a robot with a section ``effects``, as YAML.

    All else stays as it is to the last comment; a section ``effects`` that is there gives way to the new one.

    Parameters
    ----------
    robot_name : name of a robot or path of its YAML file
    values : by parameter
    covariance : (n, n) of the values in their order
    intervals : 95 % of each value, by parameter
    source : of the numbers, in words

    Raises
    ------
    ConfigError
        if the robot, a value, the covariance or an interval is not accepted.

    Examples
    --------
    >>> value, interval = {"gyro_scale_ratio": 0.02}, {"gyro_scale_ratio": (0.016, 0.024)}
    >>> text = extended_yaml("husky", value, np.array([[4e-6]]), interval, "me")
    >>> print("".join(text.partition("effects:")[1:]), end="")
    effects:
      schema: 1
      gyro_scale_ratio: {value: 0.02, unit: ratio, source: me, interval: [0.016, 0.024]}
      covariance:
        gyro_scale_ratio: {gyro_scale_ratio: 4.0e-06}
    """
    path = description_file(robot_name)
    described = read_yaml(path)
    robot = robot_from(path.name, described)
    values = checked_effects("effects", values, robot.drive)
    names = list(values)
    cov = checked_covariance("effects: covariance", np.asarray(covariance, dtype=float))
    if cov.shape != (len(names), len(names)):
        raise ConfigError(
            f"effects: covariance has the shape {cov.shape}, {(len(names), len(names))} is required"
        )
    known = parameters_of(robot.drive)
    section: dict[str, Any] = {"schema": SCHEMA}
    for name in names:
        low, high = (float(edge) for edge in intervals.get(name, (math.nan, math.nan)))
        if not low <= values[name] <= high < math.inf:
            raise ConfigError(
                f"effects: {name} is {values[name]:g}, its interval {low:g} to {high:g} must hold it"
            )
        numbers = [_rounded(low), _rounded(high)]
        section[name] = {
            "value": _rounded(values[name]),
            "unit": known[name].unit,
            "source": source,
            "interval": numbers,
        }
    rows = {
        row: {column: _rounded(cov[i, j]) for j, column in enumerate(names)} for i, row in enumerate(names)
    }
    lines = ["effects:", *(f"  {name}: {_flow(entry)}" for name, entry in section.items())]
    lines += ["  covariance:" if rows else "  covariance: {}"]
    lines += [f"    {name}: {_flow(row)}" for name, row in rows.items()]
    text = _without_effects(path.read_text(encoding="utf-8")) + "\n".join(lines) + "\n"
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError:
        content = None
    others = {name: entry for name, entry in described.items() if name != "effects"}
    if not isinstance(content, dict) or {n: e for n, e in content.items() if n != "effects"} != others:
        raise ConfigError(f"{path}: cannot be extended as it is written: one section a line is required")
    robot_from(path.name, content)
    return text


def write_extended(
    out: str | Path,
    robot_name: str | Path,
    values: Mapping[str, float],
    covariance: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str,
) -> Robot:
    """Write the description of :func:`extended_yaml` to a file, and return the robot.

    Raises
    ------
    ConfigError
        as :func:`extended_yaml` does, or if the file is no YAML by its name, or is there already.
    """
    out = Path(out)
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a robot's description is a .yaml file")
    if out.exists():
        raise ConfigError(f"{out}: is there already, and is left as it is; choose another name")
    text = extended_yaml(robot_name, values, covariance, intervals, source)
    atomic_write(out, text)
    return robot_from(out.name, yaml.safe_load(text))


def _without_effects(text: str) -> str:
    """Return the text of a description without its section ``effects``."""
    kept, inside = [], False
    for line in text.splitlines():
        if inside and line.strip() and not line.startswith((" ", "#")):
            inside = False
        if line.startswith("effects:"):
            inside = True
        if not inside:
            kept.append(line)
    return "\n".join(kept).rstrip() + "\n"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _flow(entry: Any) -> str:
    text = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)
    return str(text).removesuffix("...\n").strip()
