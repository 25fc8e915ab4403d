r"""Friction of the motors, load, rolling radius and wheel distance of an omni robot.

*Motors alone*, lifted off the ground, take the current of their own friction.  At steady speeds

.. math:: |I| = I_c + b\,|\omega| ,

and ``friction_nm`` is :math:`I_c` times the torque that an ampere gives at the wheel.  A run is taken for
one of motors alone where it has no terrain, nothing measured its motion from outside, and each motor turned
at several speeds and took no less current at the higher ones.

*Driving runs* under a camera show by their slip over many directions which share :math:`n_i` of the weight
each wheel carries (:mod:`terrain.slip_learning.rollers`), and so the centre of mass
:math:`\sum_i n_i p_i`; a slip that is the same in all directions is a wheel that rolls on a radius
:math:`(1 - \kappa) r`, or an outside measurement whose scale is off, which they do not distinguish.  The
distance of the wheels follows from how small turns agree (:mod:`terrain.slip_learning.rollers`),
surface by surface: slip in turning makes it too large, what else turns the robot moves it up or down, so that
the mean is given with the intervals of all surfaces.

The friction of the rollers is one of a terrain and no number of the robot: ``terrain estimate --filter pose --rollers``
shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.calibration.finding import Finding, around, undetermined
from terrain.errors import DataError
from terrain.identify import half_width
from terrain.records import Array, RunLog
from terrain.robots import OmniRobot
from terrain.slip_learning.measured import MeasuredSlip, estimate_delay, measured_slip, outside_source
from terrain.slip_learning.rollers import MIN_RUNS, RollerFindings, distance_bound, roller_findings

FRICTION = "motors.friction_nm"
COM_X, COM_Y = "body.com_x_m", "body.com_y_m"
RADIUS, DISTANCE = "identified.rolling_radius_m", "identified.wheel_distance_m"

#: Over which speed and current of a motor are averaged: the steps of either are small over 16 samples.
BLOCK_S = 0.5
MIN_RATE_RADPS = 1.0  #: Of a wheel; slower, the speed of a motor alone is mostly its resolution.
#: Standard deviation of a motor's rate over a block, over its mean: beyond, it speeds up or slows down.
MAX_SPREAD_RATIO = 0.1
MIN_SPEED_RATIO = 2.0  #: Fastest over slowest steady speed of each motor, of motors that are tried alone.
MIN_BLOCKS = 8  #: Of each motor: two unknowns.


def identify_omni(runs: Sequence[RunLog], robot: OmniRobot, seed: int = 0) -> list[Finding]:
    """Return a finding for each number of an omni robot that runs can determine.

    They are of motors alone, driving runs under a camera, or both; runs of a session (with weights, say) are not those
    of the robot as described, and are left out.
    """
    measured = [run for run in runs if outside_source(run) is not None]
    own = [run for run in measured if not run.session and len(run.terrains) == 1]
    alone = [run for run in runs if outside_source(run) is None and not run.terrains]
    return [motor_friction(alone, robot), *_driven(own, robot, seed)]


class MotorFriction(NamedTuple):
    """No-load current of one motor in one run, extrapolated to rest, and its growth per rad/s."""

    motor: str
    run_id: str
    current_a: float
    slope_a_per_radps: float
    n: int


def motor_friction(runs: Sequence[RunLog], robot: OmniRobot) -> Finding:
    """Return the friction of the motors, from runs of motors that turn nothing but the wheels.

    The interval is that of the mean over motors: another motor of the kind may differ by more than that.
    """
    fits = [fit for run in runs for fit in no_load_currents(run, robot)]
    by_motor = {
        wheel: np.array([(f.current_a, f.slope_a_per_radps) for f in fits if f.motor == wheel])
        for wheel in robot.wheels
    }
    if not fits or not all(map(len, by_motor.values())):
        return undetermined(
            [FRICTION], "no run of motors alone: none without a pose whose motors all turn at several speeds"
        )[0]
    nm_per_a = robot.motors.nm_per_a
    means = np.array([each.mean(axis=0) for each in by_motor.values()])
    mean_a, slope = means.mean(axis=0)
    half = float(half_width(means[:, 0].std(ddof=1) / math.sqrt(len(means)), len(means) - 1))
    each = ", ".join(f"{a:.3f}" for a in means[:, 0])
    return around(
        FRICTION,
        mean_a * nm_per_a,
        half * nm_per_a,
        sum(fit.n for fit in fits),
        "stretches",
        tuple(dict.fromkeys(fit.run_id for fit in fits)),
        f"no-load currents of {each} A, and {1000 * slope:.2f} mA more per rad/s of the motor, which the "
        "description leaves out; torque constant and efficiency as described",
    )


def no_load_currents(run: RunLog, robot: OmniRobot) -> list[MotorFriction]:
    """Return the no-load current of each motor in a run; none where it is no run of motors alone."""
    wheels = run.streams.get("wheels")
    names = [(wheel, f"motor_{wheel}_radps", f"current_{wheel}_a") for wheel in robot.wheels]
    if wheels is None or any(not {rate, amps} <= set(wheels.channels) for _, rate, amps in names):
        return []
    fits = []
    for wheel, rate, amps in names:
        speed, current = _steady_blocks(wheels.time_s, wheels.channel(rate), wheels.channel(amps), robot)
        if len(speed) < MIN_BLOCKS or speed.max() < MIN_SPEED_RATIO * speed.min():
            return []
        intercept_a, slope = np.polynomial.Polynomial.fit(speed, current, 1).convert().coef.tolist()
        if intercept_a <= 0.0 or slope < 0.0:
            return []
        fits.append(MotorFriction(wheel, run.run_id, intercept_a, slope, len(speed)))
    return fits


def _steady_blocks(
    time_s: Array, rate_radps: Array, current_a: Array, robot: OmniRobot
) -> tuple[Array, Array]:
    """Return magnitudes of mean rate and current (k,) over the blocks at steady speed of one motor."""
    block = np.floor((time_s - time_s[0]) / BLOCK_S).astype(np.int64)
    known = np.isfinite(rate_radps) & np.isfinite(current_a)
    speeds, currents = [], []
    for number in np.unique(block[known]):
        rows = known & (block == number)
        mean = float(np.abs(rate_radps[rows].mean()))
        if mean < MIN_RATE_RADPS * robot.motors.reduction_ratio:
            continue
        if rate_radps[rows].std() <= MAX_SPREAD_RATIO * mean:
            speeds.append(mean)
            currents.append(float(np.abs(current_a[rows]).mean()))
    return np.array(speeds), np.array(currents)


def _driven(runs: Sequence[RunLog], robot: OmniRobot, seed: int) -> list[Finding]:
    """Return what driving runs under a camera show."""
    names = [COM_X, COM_Y, RADIUS]
    slips = _slips(runs, robot, seed)
    surfaces = {
        name: [slip for slip, of in slips if of == name] for name in dict.fromkeys(t for _, t in slips)
    }
    fitted = [name for name, members in surfaces.items() if _n_steady(members) >= MIN_RUNS]
    if not fitted:
        reason = f"no surface on which {MIN_RUNS} runs in steady motion were measured from outside"
        return undetermined([*names, DISTANCE], reason)
    kept = [(slip, of) for slip, of in slips if of in fitted]
    found = roller_findings([slip for slip, _ in kept], [of for _, of in kept], robot, fitted)
    ids = tuple(slip.run_id for slip, _ in kept)
    return [
        *_load(found, robot, ids),
        _radius(found, robot, ids),
        _distance({name: surfaces[name] for name in fitted}, robot, seed),
    ]


def _slips(runs: Sequence[RunLog], robot: OmniRobot, seed: int) -> list[tuple[MeasuredSlip, str]]:
    """Return the slip of each run that has one, behind the delay of all, and its surface."""
    delay_s = estimate_delay(runs, robot, seed).applied_s if runs else 0.0
    slips = []
    for run in runs:
        try:
            slips.append((measured_slip(run, robot, delay_s=delay_s), run.terrains[0]))
        except DataError:  # too short, or never seen: the filter pose names it
            continue
    return slips


def _n_steady(slips: Sequence[MeasuredSlip]) -> int:
    return sum(bool((slip.steady & np.isfinite(slip.body_slip)).any()) for slip in slips)


def _load(found: RollerFindings, robot: OmniRobot, ids: tuple[str, ...]) -> list[Finding]:
    """Return the centre of mass of the loads, and what the intervals of the loads leave open of it.

    Loads sum to 1, so that the centre is ``q + sum n_i (p_i - q)`` for any point q: the best bounds it.
    """
    note = "by the loads " + ", ".join(f"{load:.3f}" for load in found.load_ratio) + " of the wheels"
    com_m = np.array(found.load_ratio) @ robot.wheel_positions_m
    half = np.array([(high - low) / 2 for low, high in found.load_interval])
    apart_m = np.abs(robot.wheel_positions_m - robot.wheel_positions_m[:, None])  # q at each of the wheels
    half_m = np.einsum("i,qia->qa", half, apart_m).min(axis=0)
    return [
        around(name, m, wide, len(ids), "runs", ids, note)
        for name, m, wide in zip((COM_X, COM_Y), com_m, half_m, strict=True)
    ]


def _radius(found: RollerFindings, robot: OmniRobot, ids: tuple[str, ...]) -> Finding:
    low, high = found.scale_interval
    return Finding(
        RADIUS,
        (1.0 - found.scale_error) * robot.wheel_radius_m,
        (1.0 - high) * robot.wheel_radius_m,
        (1.0 - low) * robot.wheel_radius_m,
        len(ids),
        "runs",
        ids,
        "or the scale of the outside measurement is off by as much: the runs do not distinguish them",
    )


def _distance(surfaces: Mapping[str, Sequence[MeasuredSlip]], robot: OmniRobot, seed: int) -> Finding:
    """Return the distance of the wheels: the mean over surfaces, its interval that of all of them."""
    bounds = {
        name: bound
        for name, slips in surfaces.items()
        if (bound := distance_bound(slips, robot, np.random.default_rng(seed))) is not None
    }
    if not bounds:
        return undetermined([DISTANCE], "on no surface do the robot's turns follow its wheels")[0]
    each = ", ".join(f"{bound.distance_m:.4f} m on {name}" for name, bound in bounds.items())
    return Finding(
        DISTANCE,
        float(np.mean([bound.distance_m for bound in bounds.values()])),
        min(bound.interval_m[0] for bound in bounds.values()),
        max(bound.interval_m[1] for bound in bounds.values()),
        sum(bound.n_runs for bound in bounds.values()),
        "runs",
        tuple(slip.run_id for name in bounds for slip in surfaces[name]),
        f"{each}: too large by the slip of turning, and off by what else turns the robot; the interval "
        "holds those of all surfaces",
    )
