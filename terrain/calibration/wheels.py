"""Steering zeros and the motors' reduction ratio, from steady driving on hard ground with a camera.

The camera's twist tells in which direction a wheel's centre travels, ``(v_x - w y_i, v_y + w x_i)``; the
encoder tells where the wheel points, up to its zero.  Their difference is that zero and the wheel's side
slip::

    off_i = zero_i + s_i

Side slip is no noise that averages out.  Three wheels whose backlashes stand differently, or that are steered by
encoders with wrong zeros, push against each other; the backlashes stand alike whenever the manoeuvre before was
the same; and the part of the zeros that sets two wheels against the third does not show in directions at
all as long as all drive straight on.  But all that pushing adds up to nothing::

    sum_i (share_i s_i n_i + c I_i t_i) = b + p sum_i t_i

and so do its moments about the centre of mass, with ``t_i`` along the travel of wheel i, ``n_i`` to its left,
``share_i`` its share of the load, ``I_i`` its current.  The common pull p against rolling resistance and
friction is projected out.  The force b of a side slope, which looks like a zero that changes sign with the
direction of driving, and the stiffness c are found together with the zeros: two equations a stretch, six
unknowns, by the robust fit of :mod:`terrain.identify`.

Assumed: tyres and motors that are alike, a camera square to the body, a level floor or one slope for all.
(Danzi, AgriMaRo thesis, 3.3.1, sets the wheels straight by hand.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.calibration.finding import Finding, around, undetermined
from terrain.calibration.sensors import MAX_GAP_S, Stretch, origin_twist
from terrain.identify import Parameter, half_width, identify
from terrain.kinematics.wheels import point_velocity
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.signals import at_times, true_stretches

#: Steady driving: the means over this time before and after an instant differ by no more than the two below.
STEADY_S = 0.5
MAX_SPEED_CHANGE_MPS = 0.02
MAX_STEER_CHANGE_RAD = 0.003

MAX_YAW_RATE_RADPS = 0.1  #: In bends, side forces turn the wheels' travel away from where they point.
MIN_SPEED_MPS = 0.2  #: Of each wheel's centre: below, the camera's noise shows in the direction.
MIN_LENGTH_S = 0.8


class Steady(NamedTuple):
    """Means over steady driving with the wheels steered alike, so that the steering backlash is unchanged."""

    run_id: str  #: of its run
    travel: Array  #: (3, 2) unit vectors along which the wheel centres travel, body axes
    speed_mps: Array  #: (3,) of the wheel centres
    off_rad: Array  #: (3,) raw steering angle minus the direction in which the wheel rolls
    motor_radps: Array  #: (3,) positive where they move the wheel along its travel
    current_a: Array
    n: int  #: samples

    @property
    def direction(self) -> str:
        """In which direction of the body it was driven, in a word."""
        x, y = self.travel.mean(axis=0)
        if abs(x) > 2 * abs(y):
            return "forward" if x > 0 else "backward"
        if abs(y) > 2 * abs(x):
            return "left" if y > 0 else "right"
        return "diagonally"


def hard_stretches(run: RunLog, hard: Sequence[str]) -> list[Stretch]:
    """Return the stretches of a run that are labelled as hard ground."""
    return [Stretch(run, label.start_s, label.end_s) for label in run.labels if label.terrain in hard]


def steady_stretches(stretch: Stretch, robot: Robot) -> list[Steady]:
    """Return the steady driving in a stretch on hard ground; none without a camera.

    Notes
    -----
    A wheel rolls along its centre's travel when its motor turns forward, and against it otherwise: the full
    turn is known, and not only half of it.  Consecutive ones with the wheels steered alike are one.
    """
    channels = [
        f"{name}_{i}_{unit}" for name, unit in (("motor", "radps"), ("current", "a")) for i in robot.wheels
    ]
    wheels, seen = stretch.of("wheels", channels), origin_twist(stretch, robot)
    steering = stretch.of("steering", [f"angle_{i}_rad" for i in robot.wheels])
    if wheels is None or steering is None or seen is None:
        return []
    time_s, (motor, current) = wheels.time_s, np.hsplit(wheels.values, 2)
    twist = at_times(seen.time_s, seen.values, time_s, MAX_GAP_S)
    angle = at_times(steering.time_s, np.unwrap(steering.values, axis=0), time_s, MAX_GAP_S)
    wheel_speed = motor / robot.motors.reduction_ratio * robot.wheel_radius_m
    known = np.isfinite(twist).all(axis=1) & np.isfinite(angle).all(axis=1)
    centre = np.full((len(time_s), 3, 2), np.nan)
    v_x, v_y, rate = twist[known].T[..., None]
    centre[known] = np.stack(point_velocity(v_x, v_y, rate, *robot.wheel_positions_m.T), axis=-1)
    sign = np.sign(motor)
    off = angle - np.arctan2(sign * centre[..., 1], sign * centre[..., 0])
    n = max(round(STEADY_S * wheels.rate_hz), 2)
    steady = known & (np.abs(twist[:, 2]) <= MAX_YAW_RATE_RADPS)
    steady &= (np.linalg.norm(centre, axis=2) >= MIN_SPEED_MPS).all(axis=1)
    steady &= _change(np.nan_to_num(angle), n) <= MAX_STEER_CHANGE_RAD
    steady &= _change(wheel_speed, n) <= MAX_SPEED_CHANGE_MPS
    alike: list[Array] = []  # rows of each
    for first, end in true_stretches(steady):
        rows = np.arange(first, end)
        if time_s[end - 1] - time_s[first] < MIN_LENGTH_S:
            continue
        if alike and (np.sign(motor[alike[-1]].mean(axis=0)) == np.sign(motor[rows].mean(axis=0))).all():
            turned = np.abs(angle[alike[-1]].mean(axis=0) - angle[rows].mean(axis=0)).max()
            if turned <= MAX_STEER_CHANGE_RAD:
                alike[-1] = np.concatenate([alike[-1], rows])
                continue
        alike.append(rows)
    found = []
    for rows in alike:
        mean, along = centre[rows].mean(axis=0), np.sign(motor[rows].mean(axis=0))
        speed, off_rad = np.linalg.norm(mean, axis=1), np.angle(np.exp(1j * off[rows]).mean(axis=0))
        moved = along * motor[rows].mean(axis=0), along * current[rows].mean(axis=0)
        found.append(Steady(stretch.run.run_id, mean / speed[:, None], speed, off_rad, *moved, len(rows)))
    return found


def _change(values: Array, n: int) -> Array:
    """Return by how much (k,) the means of ``n`` samples before and after differ; infinite near the ends."""
    total = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(axis=0)])
    change = np.full(len(values), np.inf)
    if len(values) > 2 * n:
        means = (total[n:] - total[:-n]) / n
        change[n : len(values) - n + 1] = np.abs(means[n:] - means[:-n]).max(axis=1)
    return change


def why_none(runs: Sequence[RunLog], robot: Robot, hard: Sequence[str]) -> str:
    """Return why runs have neither steady stretches nor starts and stops."""
    if not any("odometry" in run.streams for run in runs):
        return "no run has a camera (stream 'odometry')"
    on_hard = [run for run in runs if hard_stretches(run, hard)]
    if not on_hard:
        return f"no run is labelled with hard ground ({', '.join(hard)})"
    slow_radps = MIN_SPEED_MPS / robot.wheel_radius_m * robot.motors.reduction_ratio
    channels = [f"motor_{i}_radps" for i in robot.wheels]
    wheels = [stream for run in on_hard if (stream := Stretch(run).of("wheels", channels))]
    if not wheels:
        return "no run on hard ground has the wheels' motor rates"
    if not any((np.abs(stream.values) > slow_radps).any() for stream in wheels):
        return f"the wheels never move at {MIN_SPEED_MPS:g} m/s on hard ground"
    return "no straight driving on hard ground with camera, IMU, wheels, currents and steering all there"


MIN_DOF = 3  #: With fewer equations to spare, their scatter is not known.
FIRST_ERROR_RAD, LEAST_ERROR_RAD = 0.003, 1e-9  #: Of an equation, by which outliers weigh less.
#: Of a driven wheel in steady driving on hard ground: a rolling resistance of 0.01 to 0.02 of the load over a slip
#: stiffness of 10 to 20 loads.
SLIP_RATIO = (0.0, 0.002)
ZEROS = "tyres and motors taken for alike, the camera for square to the body"
RATIO = "with the described wheel radius: only ratio over radius is to be seen; slip 0 to 0.2 %"
REQUIRED_MOTION = "drive straight forward, backward and to both sides on hard ground, with the camera"

#: Of each wheel's steering, what an ampere is in radians of side slip, and the force of a slope as such.
UNKNOWNS = (
    *(Parameter(f"zero_{i}_rad", 0.0, step=0.01) for i in (1, 2, 3)),
    Parameter("current_radpa", 0.0, step=0.01),
    *(Parameter(f"slope_{axis}_rad", 0.0, step=0.01) for axis in "xy"),
)


def steering_zeros(stretches: Sequence[Steady], robot: Robot) -> list[Finding]:
    """Return the zero of each steering encoder.

    The interval is that of the scatter over stretches and of half a step, within which an encoder may be off
    everywhere.  Zeros known no better than the backlash are undetermined.
    """
    names = [f"steering.zero_{i}_rad" for i in robot.wheels]
    off = np.array([stretch.off_rad for stretch in stretches]).reshape(-1, 3)
    about = np.angle(np.exp(1j * off).mean(axis=0)) if len(off) else np.zeros(3)
    n_spare = 2 * len(stretches) - len(UNKNOWNS)
    if n_spare >= MIN_DOF:
        balances = [
            _balance(stretch, np.angle(np.exp(1j * (stretch.off_rad - about))), robot)
            for stretch in stretches
        ]
        rows, seen = (np.concatenate(part) for part in zip(*balances, strict=True))
        if np.linalg.cond(rows / np.linalg.norm(rows, axis=0)) < 1e6:
            fit = identify(
                lambda x: rows @ x - seen, UNKNOWNS, robust=True, scale=(FIRST_ERROR_RAD, LEAST_ERROR_RAD)
            )
            # of stretches so few each weighs too much to be left out: the scatter is that of all equations
            squares = fit.residual**2 / np.sqrt(1.0 + fit.residual**2)
            std = fit.std[:3] * math.sqrt(squares.sum() / n_spare)
            step_rad = 2 * math.pi / robot.sensors.steering_steps_ratio
            half = half_width(std, n_spare, bounded=step_rad / 2)
            if half.max() <= robot.steering.dead_band_rad:
                zero, runs = (
                    np.angle(np.exp(1j * (about + fit.value[:3]))),
                    [each.run_id for each in stretches],
                )
                return [
                    around(name, z, h, len(stretches), "stretches", runs, ZEROS)
                    for name, z, h in zip(names, zero, half, strict=True)
                ]
    driven = " and ".join(dict.fromkeys(stretch.direction for stretch in stretches)) or "nowhere"
    return undetermined(
        names, f"{len(stretches)} steady stretches, driven {driven}, undetermined: {REQUIRED_MOTION}"
    )


def _balance(stretch: Steady, slip_rad: Array, robot: Robot) -> tuple[Array, Array]:
    """Return two equations (2, 6), (2,) for the zeros, the stiffness and the force of a slope."""
    body = robot.body
    arm = robot.wheel_positions_m - np.array([body.com_x_m, body.com_y_m])
    share = 3 * np.linalg.solve(np.vstack([np.ones(3), arm.T]), [1.0, 0.0, 0.0])
    left = stretch.travel[:, ::-1] * [-1.0, 1.0]
    length_m = math.sqrt((arm**2).sum() / 3)

    def wrench(force: Array) -> Array:
        """Columns: force x, force y and moment, over a length, of a force on each wheel."""
        return np.vstack([force.T, (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]) / length_m])

    across, along = wrench(share[:, None] * left), wrench(stretch.travel)
    # two directions to which the common pull adds nothing
    apart = np.linalg.svd(along.sum(axis=1)[None, :])[2][1:]
    rows = np.column_stack([across, -along @ stretch.current_a, np.eye(3)[:, :2]])
    return apart @ rows, apart @ across @ slip_rad


def reduction_ratio(stretches: Sequence[Steady], robot: Robot) -> Finding:
    """Return the reduction ratio from motor rates and the speed over ground, with the described wheel radius.

    Notes
    -----
    ``ratio = (1 - s) motor rate * radius / speed``, means over the three wheels, between which pushing
    cancels; the slip s lies anywhere in :data:`SLIP_RATIO`.  The interval is that over runs, or over stretches
    with fewer than three runs.  Motor rates and speeds tell the ratio over the radius and no more: wheels that
    differ from the described radius are not in it (thesis 3.3.2 turns wheels by hand).
    """
    name = "motors.reduction_ratio"
    if len(stretches) < 2:
        return undetermined([name], f"{len(stretches)} steady stretches: {REQUIRED_MOTION}")[0]
    run_of_stretch = [each.run_id for each in stretches]
    runs, number = np.unique(run_of_stretch, return_inverse=True)
    group = number if len(runs) >= 3 else np.arange(len(stretches))
    weight = np.array([each.n for each in stretches])
    single = np.array(
        [(each.motor_radps * robot.wheel_radius_m / each.speed_mps).mean() for each in stretches]
    )
    scatter = np.bincount(group, weight * single) / np.bincount(group, weight)
    least, most = ((1 - slip) * float(scatter.mean()) for slip in reversed(SLIP_RATIO))
    std = scatter.std(ddof=1) / math.sqrt(len(scatter))
    half = float(half_width(std, len(scatter) - 1, bounded=(most - least) / 2))
    return around(name, (least + most) / 2, half, len(stretches), "stretches", run_of_stretch, RATIO)
