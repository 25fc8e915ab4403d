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
from collections.abc import Sequence

import numpy as np

from terrain.calibration.finding import Finding, around, undetermined
from terrain.identify import half_width
from terrain.records import RunLog
from terrain.robots import OmniRobot
from terrain.slip_learning.measured import STRIDE_S, WINDOW_S, measure, outside_source
from terrain.slip_learning.rollers import MIN_RUNS, distances_of, roller_findings

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
    of the robot as described, and are left out.  Loads sum to 1, so that the centre of mass is
    ``q + sum n_i (p_i - q)`` for any point q: the best of the wheels bounds it.
    """
    alone = [run for run in runs if outside_source(run) is None and not run.terrains]
    own = [
        run for run in runs if outside_source(run) is not None and not run.session and len(run.terrains) == 1
    ]
    friction = undetermined(
        [FRICTION], "the description has no section 'motors', by which currents are torques"
    )[0]
    if robot.describes("motors"):
        friction = motor_friction(alone, robot)
    measured = measure(own, robot, window_s=WINDOW_S, stride_s=STRIDE_S, seed=seed)
    surfaces = {
        name: on_it
        for name, on_it in measured.by_terrain().items()
        if sum(bool(slip.known.size) for slip in on_it.slips) >= MIN_RUNS
    }
    if not surfaces:
        reason = f"no surface on which {MIN_RUNS} runs in steady motion were measured from outside"
        return [friction, *undetermined([COM_X, COM_Y, RADIUS, DISTANCE], reason)]
    chosen = [
        pair for pair in zip(measured.runs, measured.slips, strict=True) if pair[0].terrains[0] in surfaces
    ]
    names, ids = [run.terrains[0] for run, _ in chosen], [run.run_id for run, _ in chosen]
    found = roller_findings([slip for _, slip in chosen], names, robot, list(surfaces))
    loads = "by the loads " + ", ".join(f"{load:.3f}" for load in found.load_ratio) + " of the wheels"
    place_m, half = robot.wheel_positions_m, np.diff(found.load_interval)[:, 0] / 2
    apart_m = np.abs(place_m - place_m[:, None])  # q at each of the wheels
    centre = np.array(found.load_ratio) @ place_m, np.einsum("i,qia->qa", half, apart_m).min(axis=0)
    findings = [friction] + [
        around(name, m, half_m, len(ids), "runs", ids, loads)
        for name, m, half_m in zip((COM_X, COM_Y), *centre, strict=True)
    ]
    ratio, (low, high) = found.scale_error, found.scale_interval
    value, least, most = ((1.0 - each) * robot.wheel_radius_m for each in (ratio, high, low))
    or_scale = "or the scale of the outside measurement is off by as much: the runs do not distinguish them"
    findings.append(Finding(RADIUS, value, least, most, len(ids), "runs", tuple(ids), or_scale))
    bounds = {name: bound for name, bound in distances_of(measured, robot, seed).items() if name in surfaces}
    if not bounds:
        return [*findings, *undetermined([DISTANCE], "on no surface do the robot's turns follow its wheels")]
    each = ", ".join(f"{bound.distance_m:.4f} m on {name}" for name, bound in bounds.items())
    low, high = np.array([bound.interval_m for bound in bounds.values()]).T
    distance = Finding(
        DISTANCE,
        float(np.mean([bound.distance_m for bound in bounds.values()])),
        float(low.min()),
        float(high.max()),
        sum(bound.n_runs for bound in bounds.values()),
        "runs",
        tuple(slip.run_id for name in bounds for slip in surfaces[name].slips),
        f"{each}: too large by the slip of turning, and off by what else turns the robot; the interval "
        "holds those of all surfaces",
    )
    return [*findings, distance]


def motor_friction(runs: Sequence[RunLog], robot: OmniRobot) -> Finding:
    """Return the friction of the motors, from runs of motors that turn nothing but the wheels.

    The interval is that of the mean over motors: another motor of the kind may differ by more than that.
    """
    fits = {run.run_id: lines for run in runs if (lines := no_load_lines(run, robot))}
    if not fits:
        return undetermined(
            [FRICTION], "no run of motors alone: none without a pose whose motors all turn at several speeds"
        )[0]
    means = np.mean([[line[:2] for line in lines] for lines in fits.values()], axis=0)
    n = sum(line[2] for lines in fits.values() for line in lines)
    (mean_a, slope), nm_per_a = means.mean(axis=0), robot.motors.nm_per_a
    half = float(half_width(means[:, 0].std(ddof=1) / math.sqrt(len(means)), len(means) - 1))
    each = ", ".join(f"{a:.3f}" for a in means[:, 0])
    note = (
        f"no-load currents of {each} A, and {1000 * slope:.2f} mA more per rad/s of the motor, which the "
        "description leaves out; torque constant and efficiency as described"
    )
    return around(FRICTION, mean_a * nm_per_a, half * nm_per_a, n, "stretches", fits, note)


def no_load_lines(run: RunLog, robot: OmniRobot) -> list[tuple[float, float, int]]:
    """Return the current of each motor extrapolated to rest, its growth per rad/s, and the stretches behind them.

    None where it is no run of motors alone; stretches are blocks at steady speed, by magnitude.
    """
    wheels, lines = run.streams.get("wheels"), []
    names = [(f"motor_{wheel}_radps", f"current_{wheel}_a") for wheel in robot.wheels]
    if wheels is None or any(not set(pair) <= set(wheels.channels) for pair in names):
        return []
    block = np.floor((wheels.time_s - wheels.time_s[0]) / BLOCK_S).astype(np.int64)
    for pair in names:
        rate, current = (wheels.channel(name) for name in pair)
        known, steady = np.isfinite(rate) & np.isfinite(current), []
        for number in np.unique(block[known]):
            rows = known & (block == number)
            mean = float(np.abs(rate[rows].mean()))
            fast = mean >= MIN_RATE_RADPS * robot.motors.reduction_ratio
            if fast and rate[rows].std() <= MAX_SPREAD_RATIO * mean:
                steady.append((mean, float(np.abs(current[rows]).mean())))
        if len(steady) < MIN_BLOCKS:
            return []
        speed, current = np.array(steady).T
        rest_a, slope = np.polynomial.Polynomial.fit(speed, current, 1).convert().coef.tolist()
        if speed.max() < MIN_SPEED_RATIO * speed.min() or rest_a <= 0.0 or slope < 0.0:
            return []
        lines.append((rest_a, slope, len(speed)))
    return lines
