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
unknowns.

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
from terrain.identify import half_width
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
    """Means over a steady stretch, or over consecutive ones with the wheels steered alike."""

    run_id: str  #: of its run
    travel: Array  #: (3, 2) unit vectors along which the wheel centres travel, body axes
    speed_mps: Array  #: (3,) of the wheel centres
    off_rad: Array  #: (3,) raw steering angle minus the direction in which the wheel rolls
    motor_radps: Array  #: (3,) positive where they move the wheel along its travel
    current_a: Array
    steering_rad: Array  #: (3,) unwrapped raw angle, and whether the motor turns forward
    forward: Array
    n: int  #: samples


def steady_stretches(run: RunLog, robot: Robot, hard: Sequence[str]) -> list[Steady]:
    """Return the steady stretches of a run where it is labelled as hard ground; none without a camera.

    Notes
    -----
    A wheel rolls along its centre's travel when its motor turns forward, and against it otherwise: the full
    turn is known, and not only half of it.  Consecutive stretches with the wheels steered alike are one,
    because the steering backlash is unchanged.
    """
    found: list[Steady] = []
    for label in run.labels:
        if label.terrain not in hard:
            continue
        for steady in _within(Stretch(run, label.start_s, label.end_s), robot):
            last = found[-1] if found else None
            if last is not None and _alike(last, steady):
                found[-1] = _mean(last, steady)
            else:
                found.append(steady)
    return found


def why_none(runs: Sequence[RunLog], robot: Robot, hard: Sequence[str]) -> str:
    """Return why runs have neither steady stretches nor starts and stops."""
    if not any("odometry" in run.streams for run in runs):
        return "no run has a camera (stream 'odometry')"
    on_hard = [run for run in runs if any(label.terrain in hard for label in run.labels)]
    if not on_hard:
        return f"no run is labelled with hard ground ({', '.join(hard)})"
    slow_radps = MIN_SPEED_MPS / robot.wheel_radius_m * robot.equipment.motors.reduction_ratio
    channels = [f"motor_{i}_radps" for i in robot.wheels]
    wheels = [stream for run in on_hard if (stream := Stretch(run).of("wheels", channels))]
    if not wheels:
        return "no run on hard ground has the wheels' motor rates"
    if not any((np.abs(stream.values) > slow_radps).any() for stream in wheels):
        return f"the wheels never move at {MIN_SPEED_MPS:g} m/s on hard ground"
    return "no straight driving on hard ground with camera, IMU, wheels, currents and steering all there"


def _within(stretch: Stretch, robot: Robot) -> list[Steady]:
    wheels = stretch.of("wheels", [f"{kind}_{i}_{unit}" for kind, unit in _WHEELS for i in robot.wheels])
    steering = stretch.of("steering", [f"angle_{i}_rad" for i in robot.wheels])
    seen = origin_twist(stretch, robot)
    if wheels is None or steering is None or seen is None:
        return []
    time_s = wheels.time_s
    twist = at_times(seen.time_s, seen.values, time_s, MAX_GAP_S)
    angle = at_times(steering.time_s, np.unwrap(steering.values, axis=0), time_s, MAX_GAP_S)
    motor, current = wheels.values[:, :3], wheels.values[:, 3:]
    wheel_speed = motor / robot.equipment.motors.reduction_ratio * robot.wheel_radius_m
    known = np.isfinite(twist).all(axis=1) & np.isfinite(angle).all(axis=1)
    centre = np.full((len(time_s), 3, 2), np.nan)
    v_x, v_y, rate = twist[known].T[..., None]
    centre[known] = np.stack(point_velocity(v_x, v_y, rate, *robot.wheel_positions_m.T), axis=-1)
    sign = np.sign(motor)
    direction = np.arctan2(sign * centre[..., 1], sign * centre[..., 0])
    n = max(round(STEADY_S * wheels.rate_hz), 2)
    steady = known & (np.abs(twist[:, 2]) <= MAX_YAW_RATE_RADPS)
    steady &= (np.linalg.norm(centre, axis=2) >= MIN_SPEED_MPS).all(axis=1)
    steady &= _change(np.nan_to_num(angle), n) <= MAX_STEER_CHANGE_RAD
    steady &= _change(wheel_speed, n) <= MAX_SPEED_CHANGE_MPS
    found = []
    for first, end in true_stretches(steady):
        if time_s[end - 1] - time_s[first] < MIN_LENGTH_S:
            continue
        rows = slice(first, end)
        mean = centre[rows].mean(axis=0)
        forward = sign[rows].mean(axis=0) > 0
        along = np.where(forward, 1.0, -1.0)
        found.append(
            Steady(
                stretch.run.run_id,
                mean / np.linalg.norm(mean, axis=1)[:, None],
                np.linalg.norm(mean, axis=1),
                np.angle(np.exp(1j * (angle - direction)[rows]).mean(axis=0)),
                along * motor[rows].mean(axis=0),
                along * current[rows].mean(axis=0),
                angle[rows].mean(axis=0),
                forward,
                int(end - first),
            )
        )
    return found


_WHEELS = (("motor", "radps"), ("current", "a"))


def _change(values: Array, n: int) -> Array:
    """Return by how much (k,) the means of ``n`` samples before and after differ; infinite near the ends."""
    total = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(axis=0)])
    change = np.full(len(values), np.inf)
    if len(values) > 2 * n:
        means = (total[n:] - total[:-n]) / n
        change[n : len(values) - n + 1] = np.abs(means[n:] - means[:-n]).max(axis=1)
    return change


def direction_of(steady: Steady) -> str:
    """Return in which direction of the body a stretch was driven, in a word."""
    x, y = steady.travel.mean(axis=0)
    if abs(x) > 2 * abs(y):
        return "forward" if x > 0 else "backward"
    if abs(y) > 2 * abs(x):
        return "left" if y > 0 else "right"
    return "diagonally"


def _alike(one: Steady, other: Steady) -> bool:
    turned = np.abs(one.steering_rad - other.steering_rad).max()
    return bool(turned <= MAX_STEER_CHANGE_RAD and (one.forward == other.forward).all())


def _mean(one: Steady, other: Steady) -> Steady:
    n = one.n + other.n
    mixed = {
        name: (one.n * getattr(one, name) + other.n * getattr(other, name)) / n
        for name in ("travel", "speed_mps", "motor_radps", "current_a", "steering_rad")
    }
    off = np.angle(one.n * np.exp(1j * one.off_rad) + other.n * np.exp(1j * other.off_rad))
    travel = mixed["travel"] / np.linalg.norm(mixed["travel"], axis=1)[:, None]
    return one._replace(**mixed | {"travel": travel, "off_rad": off, "n": n})


#: Residuals of more standard deviations weigh less; 95 % efficient where there is none (Huber 1964).
HUBER = 1.345
ROUNDS = 30  #: Of reweighting.
MIN_DOF = 3  #: With fewer equations to spare, their scatter is not known.
#: Of a driven wheel in steady driving on hard ground: a rolling resistance of 0.01 to 0.02 of the load over a slip
#: stiffness of 10 to 20 loads.
SLIP_RATIO = (0.0, 0.002)


def steering_zeros(stretches: Sequence[Steady], robot: Robot) -> list[Finding]:
    """Return the zero of each steering encoder.

    Notes
    -----
    Least squares with Huber's weights on the equations of this module's head.  The interval is that of
    their scatter and of half a step, to which an encoder may be off everywhere.  Zeros known no better than
    the backlash are undetermined.
    """
    names = [f"steering.zero_{i}_rad" for i in robot.wheels]
    off = np.array([stretch.off_rad for stretch in stretches]).reshape(-1, 3)
    about = np.angle(np.exp(1j * off).mean(axis=0)) if len(off) else np.zeros(3)
    equations = [
        _balance(stretch, np.angle(np.exp(1j * (stretch.off_rad - about))), robot) for stretch in stretches
    ]
    n_spare = 2 * len(equations) - 6
    step_rad = 2 * math.pi / robot.equipment.sensors.steering_steps_ratio
    if n_spare >= MIN_DOF:
        rows, seen = (np.concatenate(part) for part in zip(*equations, strict=True))
        if np.linalg.cond(rows / np.linalg.norm(rows, axis=0)) < 1e6:
            found, cov = _huber(rows, seen)
            half = np.hypot(half_width(np.sqrt(np.diag(cov)[:3]), n_spare), step_rad / 2)
            if half.max() <= robot.equipment.steering.dead_band_rad:
                zero = np.angle(np.exp(1j * (about + found[:3])))
                runs = tuple(dict.fromkeys(stretch.run_id for stretch in stretches))
                return [
                    around(name, z, h, len(stretches), "stretches", runs, ZEROS)
                    for name, z, h in zip(names, zero, half, strict=True)
                ]
    driven = " and ".join(dict.fromkeys(map(direction_of, stretches))) or "nowhere"
    return undetermined(
        names, f"{len(stretches)} steady stretches, driven {driven}, undetermined: {REQUIRED_MOTION}"
    )


def reduction_ratio(stretches: Sequence[Steady], robot: Robot) -> Finding:
    """Return the reduction ratio from motor rates and the speed over ground, with the described wheel radius.

    Notes
    -----
    ``ratio = (1 - s) motor rate * radius / speed``, means over the three wheels, between which pushing
    cancels; the slip s lies in :data:`SLIP_RATIO`.  The interval is that over runs, or over single wheels
    with fewer than three runs, because tyres differ.  Motor rates and speeds tell the ratio over the radius
    and no more (thesis 3.3.2 turns wheels by hand).
    """
    name = "motors.reduction_ratio"
    runs = tuple(dict.fromkeys(stretch.run_id for stretch in stretches))
    if not runs:
        return undetermined([name], f"there is no steady stretch: {REQUIRED_MOTION}")[0]
    single = np.array(
        [
            np.average(
                [s.motor_radps * robot.wheel_radius_m / s.speed_mps for s in stretches if s.run_id == run_id],
                axis=0,
                weights=[s.n for s in stretches if s.run_id == run_id],
            )
            for run_id in runs
        ]
    )
    scatter = single.mean(axis=1) if len(runs) >= 3 else single.ravel()
    half = float(half_width(scatter.std(ddof=1) / math.sqrt(len(scatter)), len(scatter) - 1))
    low, high = ((1 - slip) * float(single.mean()) for slip in reversed(SLIP_RATIO))
    return Finding(name, (low + high) / 2, low - half, high + half, len(stretches), "stretches", runs, RATIO)


ZEROS = "tyres and motors taken for alike, the camera for square to the body"
RATIO = "with the described wheel radius: only ratio over radius is to be seen; slip 0 to 0.2 %"
REQUIRED_MOTION = "drive straight forward, backward and to both sides on hard ground, with the camera"


def _balance(stretch: Steady, slip_rad: Array, robot: Robot) -> tuple[Array, Array]:
    """Return two equations (2, 6), (2,) for the zeros, the stiffness and the force of a slope."""
    body = robot.equipment.body
    com_m = np.array([body.com_x_m, body.com_y_m])
    arm = robot.wheel_positions_m - com_m
    share = 3 * np.linalg.solve(np.vstack([np.ones(3), arm.T]), [1.0, 0.0, 0.0])
    left = stretch.travel[:, ::-1] * [-1.0, 1.0]
    length_m = math.sqrt((arm**2).sum() / 3)

    def wrench(force: Array) -> Array:
        """Columns: force x, force y and moment, over a length, of a force on each wheel."""
        return np.vstack([force.T, (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]) / length_m])

    across, along = wrench(share[:, None] * left), wrench(stretch.travel)
    common = along.sum(axis=1)
    apart = np.linalg.svd(common[None, :])[2][1:]  # two directions to which the common pull adds nothing
    rows = np.column_stack([across, -along @ stretch.current_a, np.eye(3)[:, :2]])
    return apart @ rows, apart @ across @ slip_rad


def _huber(rows: Array, seen: Array) -> tuple[Array, Array]:
    """Return the solution of ``rows @ x = seen`` with Huber's weights, and its covariance."""
    spare = len(seen) - rows.shape[1]
    weight = np.ones(len(seen))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(root[:, None] * rows, root * seen, rcond=None)[0]
        residual = np.abs(seen - rows @ found)
        scale = max(1.4826 * float(np.median(residual)) * math.sqrt(len(seen) / spare), 1e-9)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(residual, 1e-12))
    cov = np.linalg.inv(rows.T @ (weight[:, None] * rows)) * float(weight @ residual**2) / spare
    return found, cov
