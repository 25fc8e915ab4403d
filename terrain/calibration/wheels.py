"""Steering zeros and the motors' reduction ratio, from steady driving on hard ground with a camera.

The camera's twist tells in which direction a wheel's centre travels, ``(v_x - w y_i, v_y + w x_i)``; the
encoder tells where the wheel points, up to its zero.  Their difference is that zero and the wheel's side
slip::

    off_i = zero_i + s_i

Side slip is no noise that averages out.  Three wheels whose plays stand differently, or that are steered by
encoders with wrong zeros, push against each other; the plays stand alike whenever the manoeuvre before was
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

import numpy as np

from terrain.calibration.finding import Finding, half_width, undetermined
from terrain.calibration.steady import Steady, direction_of
from terrain.records import Array
from terrain.robots import Robot

HUBER = 1.345
"""Residuals of more standard deviations weigh less; 95 % efficient where there is none (Huber 1964)."""

ROUNDS = 30
"""Of reweighting."""

MIN_DOF = 3
"""With fewer equations to spare, their scatter is not known."""

SLIP_RATIO = (0.0, 0.002)
"""Of a driven wheel in steady driving on hard ground: a rolling resistance of 0.01 to 0.02 of the load over
a slip stiffness of 10 to 20 loads."""


def steering_zeros(stretches: Sequence[Steady], robot: Robot) -> list[Finding]:
    """Return the zero of each steering encoder.

    Parameters
    ----------
    stretches : steady, of any runs
    robot : swerve robot with all sections

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
                    Finding(
                        name, float(z), float(z - h), float(z + h), len(stretches), "stretches", runs, ZEROS
                    )
                    for name, z, h in zip(names, zero, half, strict=True)
                ]
    driven = " and ".join(dict.fromkeys(map(direction_of, stretches))) or "nowhere"
    return undetermined(
        names, f"{len(stretches)} steady stretches, driven {driven}, undetermined: {REQUIRED_MOTION}"
    )


def reduction_ratio(stretches: Sequence[Steady], robot: Robot) -> Finding:
    """Return the reduction ratio from motor rates and the speed over ground, with the described wheel radius.

    Parameters
    ----------
    stretches : steady, of any runs
    robot : swerve robot with all sections

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
