r"""Motor constant and resistance of a robot that drives straight on, from the currents of its motors.

The traction by all currents is :math:`F = k \sum I_i / r`, with k the torque at a wheel for an ampere, and

.. math:: m f = \tfrac{k}{r} \sum_i I_i - F_r\,\mathrm{sign}(v) + f_0 ,

where f is the specific force ahead: by the accelerometer, which has the slope in it, or else the change of wheel speed.
Both sides have noise, and the slope, which is most of it where there is no accelerometer, acts on the currents: they
are the side that is explained.  What turns beside the mass m, wheels and rotors, acts as more of it: :data:`ROTATING`.

**What is not separated.**  The mass scales both k and the resistance, so that it is that of the description; k is
torque constant, reduction and efficiency as one; the resistance is that of the ground and of the drive as one, and of
the turns left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.integrate import cumulative_trapezoid

from terrain.calibration.finding import Finding, around, undetermined
from terrain.calibration.sensors import SPAN_S, Stretch, with_rolled
from terrain.identify import Parameter, half_width, identify
from terrain.records import Array, RunLog
from terrain.robots import Robot

CONSTANT, RESISTANCE = "identified.torque_per_current_nmpa", "identified.resistance_n"
ROTATING = 0.0, 0.1  #: Inertia of wheels and rotors over their radius squared, over the mass; assumed.
MAX_YAW_RATE_RADPS = 0.1  #: A turn takes a current of its own.
MIN_SPEED_MPS = 0.05
MAX_WIDTH_RATIO = 0.5  #: Interval of a number over it from which on it is not stated.
MIN_SPANS = 40
BLOCKS = 8


def motor_constant(runs: Sequence[RunLog], robot: Robot) -> list[Finding]:
    """Return torque at the wheel for an ampere, and resistance, or why these runs do not show them."""
    names, channels = [CONSTANT, RESISTANCE], [f"current_{wheel}_a" for wheel in robot.wheels]
    if robot.sideways or not any(channel in _of_wheels(run) for run in runs for channel in channels):
        why = f"no run has currents ({', '.join(channels)}), which show it beside the acceleration"
        return undetermined(names, "sideways forces share the currents" if robot.sideways else why)
    parts, ids = list[Array](), list[str]()
    for run in runs:
        part = spans(run, robot, [channel for channel in channels if channel in _of_wheels(run)])
        if len(part):
            parts.append(part)
            ids.append(run.run_id)
    if sum(map(len, parts)) < MIN_SPANS:
        return undetermined(names, "too little straight driving with currents")
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    if len(parts) < BLOCKS:
        number = np.arange(len(number)) * BLOCKS // len(number)
    force, direction, current = np.concatenate(parts).T
    if current.min() >= 0.0 and (force * direction).min() < 0.0 < direction.max():
        return undetermined(names, "the currents have no sign: what brakes looks like what drives")
    per_n = Parameter(
        "current_per_force_apn", 0.0, step=0.1 * float(current.std()) / max(float(force.std()), 1e-9)
    )
    others = [Parameter(name, 0.0, step=0.1 * float(current.std())) for name in ("resistance_a", "offset_a")]
    fit = identify(
        lambda p: current - p[0] * force - p[1] * direction - p[2],
        [per_n, *others],
        number,
        True,
        scale=(float(current.std()), 1e-3),
    )
    value, (low, high) = fit.derived(lambda p: np.array([robot.wheel_radius_m / p[0], p[1] / p[0]]))
    notes = (
        "the mass as described, and 0 to 10 % more that turns; torque constant, reduction and efficiency as one",
        "of ground and drive as one",
    )
    found, (least, most) = list[Finding](), ROTATING
    for name, by_mass, apart, note in zip(names, value, (high - low) / 2 / 1.96, notes, strict=True):
        at = by_mass * (1.0 + (least + most) / 2)
        half = float(half_width(apart, math.inf, bounded=abs(by_mass) * (most - least) / 2))
        if at > 0.0 and fit.identified[0] and 2.0 * half < MAX_WIDTH_RATIO * at:
            found.append(around(name, at, half, len(force), "spans", ids, note))
        else:
            found += undetermined([name], "currents and acceleration do not follow each other in these runs")
    return found


def _of_wheels(run: RunLog) -> tuple[str, ...]:
    return run.streams["wheels"].channels if "wheels" in run.streams else ()


def spans(run: RunLog, robot: Robot, channels: Sequence[str]) -> Array:
    """Return force, direction of driving and sum of the currents (n, 3) of spans straight on."""
    driven, currents = with_rolled(run, robot), Stretch(run).of("wheels", channels) if channels else None
    if driven is None or currents is None:
        return np.empty((0, 3))
    time_s, twist = driven
    imu = Stretch(run).of("imu", ("accel_x_mps2",))
    ends = [time_s, currents.time_s] + ([imu.time_s] if imu is not None else [])
    edges_s = np.arange(max(each[0] for each in ends), min(each[-1] for each in ends), SPAN_S)
    if len(edges_s) < 3:
        return np.empty((0, 3))

    def mean(at_s: Array, values: Array) -> Array:
        return np.asarray(
            np.diff(np.interp(edges_s, at_s, cumulative_trapezoid(values, at_s, initial=0.0))) / SPAN_S
        )

    at_edges = np.interp(edges_s, time_s, twist[:, 0])
    accel = np.diff(at_edges) / SPAN_S if imu is None else mean(imu.time_s, imu.values[:, 0])
    speed, total = mean(time_s, twist[:, 0]), mean(currents.time_s, currents.values.sum(axis=1))
    straight = mean(time_s, np.abs(twist[:, 2])) <= MAX_YAW_RATE_RADPS
    straight &= (at_edges[1:] * at_edges[:-1] > 0.0) & (np.abs(speed) >= MIN_SPEED_MPS)
    table = np.column_stack([robot.mass_kg * accel, np.sign(speed), total])
    return np.asarray(table[straight])
