r"""Kinematics of a robot by poses of a sensor on its body: what its wheels roll on, how it steers, where the sensor is.

Between two instants of a log the wheels, through the simulation's own motion without slip of the ground and its own
sensors (:func:`~terrain.simulation.plants.planar.move`, :func:`~terrain.simulation.plants.planar.sense`), move the
sensor by a change of pose; the log has the same change as measured.  Over legs of a second, which overlap,

.. math:: r_i = \big(R(-\psi_a)(p_b - p_a),\ \psi_b - \psi_a\big)_\mathrm{measured}
    - \big(R(-\psi_a)(p_b - p_a),\ \psi_b - \psi_a\big)_\mathrm{simulated}

are least squares (soft L1) in the parameters of :mod:`terrain.effects` that are kinematic on that drive.  Neither
accelerations nor rates are differentiated, and a pose, at both ends the mean over a fifth of a second of what is
measured and of what is simulated, may be noisy.

**Intervals.**  What legs near to each other have in common (slip, a wave of the floor, a camera that drifts) makes
their errors alike: clusters are blocks of time, and the covariance is that of leaving each out
(:mod:`terrain.identify`).  They hold other parts of the same drive; another ground or load is not in them.

**What is not separated.**  Where a wheel that is not steered drives, the gain of the steering and the wheelbase act as
one while the angles stay small: the effective wheelbase L over the gain is stated.  A wheel that drives and is steered
shows both.  A car that speeds up slips by its traction, which over a second looks like
earlier poses: the slip is fitted beside the delay, whose interval holds that.  A number is stated only where its
interval is below half of the plausible range.  Radius, ticks a turn and gear are one number too, that of the described
ticks and gear.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from terrain.angles import unwrapped
from terrain.calibration.finding import Finding, undetermined
from terrain.effects import CHANNELS, HEADING, PARAMETER, SPEED_X, SPEED_Y, library_of, vector_of
from terrain.errors import DataError
from terrain.identify import IDENTIFIED_RATIO, Fit, Parameter, identify
from terrain.logs.schema import POSE_CHANNELS
from terrain.records import Array, RunLog
from terrain.robots import BicycleRobot, Robot
from terrain.simulation.plants.planar import Ground, Planar, make_planar, move, sense

LEG_S = 1.0  #: Length of a leg: a robot of 0.1 m/s moves by a hundred times the noise of motion capture.
#: Legs begin so often within the length of one, so that a fit hardly depends on where the first does.
STRIDES = 4
CLOCK_S = 0.02  #: Step of the simulation.
AVERAGED_S = 0.1  #: Poses are averaged over that on either side of an end.
#: A leg whose wheels move the sensor by less, and turn it by less, shows nothing.
STILL_M, STILL_RAD = 0.02, 0.02
BLOCKS = 12  #: Clusters of a fit at the least, where a block is then longer than a leg.
LONGEST_BLOCK_S = 20.0  #: Of a cluster: slower than that, grounds and temperatures change.
MIN_LEGS = 48
DELAY_S = (-0.5, 1.0)  #: Bounds of the delay of poses behind the wheels, of either sign: clocks differ.
#: Bounds that are not those of the library; a firm ground has no slip that others could have less of.
BOUNDS = {"camera_latency_s": DELAY_S, "force_slip_ratio": (0.0, PARAMETER["force_slip_ratio"].high)}
FIRST_ERROR = (0.02, 0.02, 0.02)  #: Sizes of residuals that a fit begins with, in m and rad.
LEAST_ERROR = (1e-4, 1e-4, 1e-4)
PASSES = 3  #: Of a fit that finds the sizes of its residuals.
FIRM = Ground(slip_ratio=1e-6, rolling_ratio=0.0, scrub_ratio=0.0)  #: On which wheels roll without slip.

#: What changes of pose do not show of a drive: beside the gain of a steering, and at the speeds of a tricycle.
UNSEEN = {"bicycle": ("wheelbase_ratio",), "tricycle": ("understeer_s2pm", "cornering_stiffness_ratio")}


def kinematic_of(robot: Robot) -> tuple[str, ...]:
    """Return the parameters of a robot that changes of pose show; none of a drive that is not fitted to them.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> kinematic_of(load_robot("omnirobot"))[-2:], kinematic_of(load_robot("husky"))
    (('force_slip_ratio', 'wheel_distance_ratio'), ())
    """
    if not (robot.on_omni_wheels or isinstance(robot, BicycleRobot)):
        return ()
    names = [p.name for effect in library_of(robot.drive) if effect.kinematic for p in effect.parameters]
    return tuple(name for name in names if name not in UNSEEN.get(robot.drive, ()))


class Numbers(NamedTuple):
    """A number of the section ``identified`` that follows from fitted parameters."""

    name: str  #: in the section
    of: tuple[str, ...]  #: parameters
    value: Callable[..., float]  #: of the robot, and their values


def _camera(robot: Robot, name: str) -> float:
    return float(getattr(robot.completed.camera, name))


NUMBERS = (
    Numbers("rolling_radius_m", ("wheel_radius_ratio",), lambda robot, e: robot.wheel_radius_m * (1.0 + e)),
    Numbers(
        "wheel_distance_m", ("wheel_distance_ratio",), lambda robot, e: robot.wheel_distance_m * (1.0 + e)
    ),
    Numbers("wheelbase_m", ("wheelbase_ratio",), lambda robot, e: robot.wheelbase_m * (1.0 + e)),
    Numbers("steering_gain_ratio", ("steering_gain_ratio",), lambda robot, e: 1.0 + e),
    Numbers(
        "effective_wheelbase_m", ("steering_gain_ratio",), lambda robot, e: robot.wheelbase_m / (1.0 + e)
    ),
    Numbers("steering_offset_rad", ("steering_offset_front_rad",), lambda robot, e: e),
    Numbers("understeer_s2pm", ("understeer_s2pm",), lambda robot, e: e + robot.understeer_s2pm),
    Numbers("pose_x_m", ("lever_x_m",), lambda robot, e: _camera(robot, "lever_x_m") + e),
    Numbers("pose_y_m", ("lever_y_m",), lambda robot, e: _camera(robot, "lever_y_m") + e),
    Numbers("pose_yaw_rad", ("camera_yaw_rad",), lambda robot, e: -e),  # of the sensor in the body
    Numbers("pose_delay_s", ("camera_latency_s",), lambda robot, e: _camera(robot, "latency_s") + e),
)


#: The gain of a steering and the wheelbase of a robot that does not drive by it are one number, the other's.
NOT_OF: Mapping[str, Callable[[Robot], bool]] = {
    "steering_gain_ratio": lambda robot: robot.drive == "bicycle",
    "effective_wheelbase_m": lambda robot: robot.drive != "bicycle",
}


class Legs(NamedTuple):
    """A run on the simulation's clock, and its legs between averaged poses."""

    wheel_speed_mps: Array  #: (n, wheels), (n, wheels) on the clock
    steer_rad: Array
    start_s: float  #: of the clock
    stamps_s: Array  #: (m,) of the poses that ends average
    end_of: Array  #: (m,) number of the end of each, from 0 to e - 1
    ends: Array  #: (e, 3) averaged poses
    pairs: Array  #: (legs, 2) numbers of the ends of each leg
    moved: Array  #: (legs, 3) measured change of pose


class PoseFit(NamedTuple):
    """Kinematic parameters fitted to legs."""

    names: tuple[str, ...]  #: of the parameters
    fit: Fit
    error: tuple[float, float, float]  #: usual residual of a leg ahead, to the left, in yaw
    n_legs: int
    n_blocks: int

    @property
    def values(self) -> dict[str, float]:
        """The fitted values by name."""
        return dict(zip(self.names, self.fit.value.tolist(), strict=True))


def legs_of(run: RunLog, robot: Robot, leg_s: float = LEG_S) -> Legs:
    """Return the legs of a run.

    Raises
    ------
    DataError
        if the run lacks wheels, steering or poses.
    """
    wheels, pose, steering = (run.streams.get(name) for name in ("wheels", "pose", "steering"))
    names = [f"speed_{wheel}_mps" for wheel in robot.logged_wheels]
    if wheels is None or not set(names) <= set(wheels.channels):
        raise DataError(f"run {run.run_id}: it has no wheel speeds ({', '.join(names)})")
    if robot.steered and (steering is None or not set(robot.steer_channels) <= set(steering.channels)):
        raise DataError(f"run {run.run_id}: it has no steering angles ({', '.join(robot.steer_channels)})")
    if pose is None or not set(POSE_CHANNELS) <= set(pose.channels):
        raise DataError(f"run {run.run_id}: it has no poses (stream 'pose')")
    values = pose.columns(POSE_CHANNELS)
    values[:, 2] = unwrapped(values[:, 2])
    known = np.isfinite(values).all(axis=1)
    stamps_s, values = pose.time_s[known], values[known]
    start_s, end_s = wheels.time_s[0], wheels.time_s[-1]
    clock_s = np.arange(start_s, end_s, CLOCK_S)

    def on_clock(time_s: Array, column: Array) -> Array:
        there = np.isfinite(column)
        return np.interp(clock_s, time_s[there], column[there]) if there.any() else np.zeros(len(clock_s))

    speeds = np.column_stack([on_clock(wheels.time_s, wheels.channel(name)) for name in names])
    steer = np.zeros((len(clock_s), len(robot.wheels)))
    if steering is not None and robot.steered:
        for i, name in enumerate(robot.steer_channels):
            zero = robot.steering_zeros_rad[i]
            steer[:, i] = on_clock(steering.time_s, unwrapped(steering.channel(name))) - zero
    margin_s = max(DELAY_S[1], -DELAY_S[0])  # poses show what was a delay before
    first_s = max(start_s + margin_s, stamps_s[0] if len(stamps_s) else start_s) + AVERAGED_S
    last_s = min(end_s - margin_s, stamps_s[-1] if len(stamps_s) else end_s)
    at_s = np.arange(first_s, last_s, leg_s / STRIDES)
    nearest = np.abs(stamps_s[:, None] - at_s).argmin(axis=1) if len(at_s) else np.zeros(0, int)
    near = np.abs(stamps_s - at_s[nearest]) <= AVERAGED_S if len(at_s) else np.zeros(len(stamps_s), bool)
    stamps_s, end_of, values = stamps_s[near], nearest[near], values[near]
    ends, first = averaged(values, end_of, len(at_s)), np.arange(max(len(at_s) - STRIDES, 0))
    pairs = np.column_stack([first, first + STRIDES])
    pairs = pairs[np.isfinite(ends[pairs]).all(axis=(1, 2))]
    legs = Legs(speeds, steer, float(start_s), stamps_s, end_of, ends, pairs, changes(ends, pairs))
    moved = simulated(legs, make_planar(robot, FIRM), vector_of({}))
    moves = (np.hypot(*moved[:, :2].T) > STILL_M) | (np.abs(moved[:, 2]) > STILL_RAD)
    return legs._replace(pairs=pairs[moves], moved=legs.moved[moves])


def averaged(values: Array, end_of: Array, n: int) -> Array:
    """Return the mean pose (n, 3) at each end of poses (m, 3); NaN at one without any."""
    count = np.bincount(end_of, minlength=n)
    sums = np.column_stack([np.bincount(end_of, column, minlength=n) for column in values.T])
    out: Array = np.full((n, 3), np.nan)
    np.divide(sums, count[:, None], out=out, where=count[:, None] > 0)
    return out


def changes(ends: Array, pairs: Array) -> Array:
    """Return the change of pose (legs, 3) from end to end, in the frame of the first.

    Examples
    --------
    >>> changes(np.array([[0.0, 0.0, np.pi / 2], [0.0, 1.0, np.pi]]), np.array([[0, 1]])).round(3)
    array([[1.   , 0.   , 1.571]])
    """
    first, then = ends[pairs[:, 0]], ends[pairs[:, 1]]
    (x, y, turn), (cos, sin) = (then - first).T, (np.cos(first[:, 2]), np.sin(first[:, 2]))
    return np.column_stack([cos * x + sin * y, cos * y - sin * x, turn])


def simulated(legs: Legs, planar: Planar, vector: Array) -> Array:
    """Return the change of pose (legs, 3) of the sensor, as the simulation has it at a vector of parameters."""
    still = np.zeros(len(legs.wheel_speed_mps))
    truth = move(planar, vector, CLOCK_S, legs.wheel_speed_mps, legs.steer_rad, still, still)
    seen = sense(planar.body, vector, CLOCK_S, truth)
    ahead, left, rate = (seen[:, CHANNELS.index(name)] for name in (SPEED_X, SPEED_Y, HEADING))
    path = np.zeros((len(still), 3))
    path[1:, 2] = np.cumsum(0.5 * CLOCK_S * (rate[1:] + rate[:-1]))
    middle = 0.5 * (path[1:, 2] + path[:-1, 2])
    along, across = (0.5 * CLOCK_S * (speed[1:] + speed[:-1]) for speed in (ahead, left))
    path[1:, 0] = np.cumsum(along * np.cos(middle) - across * np.sin(middle))
    path[1:, 1] = np.cumsum(along * np.sin(middle) + across * np.cos(middle))
    clock_s = legs.start_s + CLOCK_S * np.arange(len(still))
    at = np.column_stack([np.interp(legs.stamps_s, clock_s, column) for column in path.T])
    return changes(averaged(at, legs.end_of, len(legs.ends)), legs.pairs)


def fit_poses(
    runs: Sequence[RunLog], robot: Robot, names: Sequence[str] | None = None, leg_s: float = LEG_S
) -> PoseFit:
    """Return the kinematic parameters of a robot by its runs.

    Parameters
    ----------
    runs : with wheels, steering where it is steered, and poses
    robot : that they are of
    names : of the parameters; those of :func:`kinematic_of` by default
    leg_s : length of a leg

    Raises
    ------
    DataError
        if the drive has no kinematic parameters here, a run lacks a stream, or there are too few legs that move.
    """
    chosen = kinematic_of(robot) if names is None else tuple(names)
    if not chosen:
        raise DataError(f"robot {robot.name}: drive {robot.drive!r} is not fitted to poses")
    planar, found = make_planar(robot, FIRM), [legs_of(run, robot, leg_s) for run in runs]
    n_legs = sum(len(legs.pairs) for legs in found)
    if n_legs < MIN_LEGS:
        raise DataError(
            f"robot {robot.name}: {n_legs} legs of {leg_s:g} s in which it moves have poses at both ends, "
            f"at least {MIN_LEGS} are required"
        )
    measured, block = np.concatenate([legs.moved for legs in found]), _blocks(found, leg_s, n_legs)
    parameters = []
    for name in chosen:
        known = PARAMETER[name]
        low, high = BOUNDS.get(name, (known.low, known.high))
        parameters.append(Parameter(name, 0.0, low, high, step=4.0 * known.step))
    error = np.array(FIRST_ERROR)

    def residual(values: Array) -> Array:
        vector = vector_of(dict(zip(chosen, values.tolist(), strict=True)))
        return np.asarray(np.concatenate([simulated(legs, planar, vector) for legs in found]) - measured)

    starts = [np.zeros(len(chosen))]
    for _ in range(PASSES):
        by_size = partial(lambda size, values: np.asarray(residual(values) / size), error.copy())
        fit = identify(by_size, parameters, block, True, starts, diff_step=1e-3)
        starts = [fit.value]
        error = np.maximum(1.48 * np.median(np.abs(residual(fit.value)), axis=0), LEAST_ERROR)
    usual = float(error[0]), float(error[1]), float(error[2])
    return PoseFit(chosen, fit, usual, n_legs, int(block.max()) + 1)


def leg_errors(runs: Sequence[RunLog], robot: Robot, values: Mapping[str, float]) -> Array:
    """Return measured minus simulated change of pose (legs, 3) of runs at values of parameters, 0 of the others."""
    planar, vector = make_planar(robot, FIRM), vector_of(values)
    found = [legs_of(run, robot) for run in runs]
    return np.concatenate([legs.moved - simulated(legs, planar, vector) for legs in found])


def _blocks(found: Sequence[Legs], leg_s: float, n_legs: int) -> Array:
    """Return the number of the cluster of each leg: blocks of time, none over two runs."""
    length = max(min(n_legs // BLOCKS, round(LONGEST_BLOCK_S / leg_s) * STRIDES), 2 * STRIDES)
    block, last = [], 0
    for legs in found:
        own = np.arange(len(legs.pairs)) // length
        own = np.minimum(own, max(round(len(own) / length), 1) - 1)  # no short one at the end
        block.append(last + own)
        last += int(own[-1]) + 1 if len(own) else 0
    return np.concatenate(block)


def pose_findings(runs: Sequence[RunLog], robot: Robot) -> list[Finding]:
    """Return a finding for each number of the section ``identified`` that poses show."""
    used = [run for run in runs if "pose" in run.streams]
    if not used:
        raise DataError(f"robot {robot.name}: no run has poses (stream 'pose'), by which it is calibrated")
    fitted, ids = fit_poses(used, robot), tuple(run.run_id for run in used)
    return findings_by(fitted, robot, ids)


def findings_by(fitted: PoseFit, robot: Robot, run_ids: tuple[str, ...] = ()) -> list[Finding]:
    """Return the findings of a fit; those that it does not determine without a value."""
    fit, found = fitted.fit, list[Finding]()
    clusters = f"{fitted.n_blocks} blocks of time are the clusters of its interval"
    for name, of, value in NUMBERS:
        if not set(of) <= set(fitted.names) or (name in NOT_OF and NOT_OF[name](robot)):
            continue
        places = [fitted.names.index(each) for each in of]
        by = partial(lambda at, of_robot, p: np.array([of_robot(robot, *p[at])]), places, value)
        number, (low, high) = fit.derived(by)
        place = f"identified.{name}"
        lowest, highest = (value(robot, *(PARAMETER[each].plausible[end] for each in of)) for end in (0, 1))
        seen = fit.identified[places].all()
        if not seen or not (high[0] - low[0]) < IDENTIFIED_RATIO * abs(highest - lowest):
            found += undetermined([place], "these drives do not show it apart from the other numbers")
            continue
        ends = float(number[0]), float(low[0]), float(high[0])
        found.append(Finding(place, *ends, fitted.n_legs, "legs", run_ids, clusters))
    return found
