r"""Odometry of a tracked robot fitted to legs of a drive and judged on runs held out, with the slip model of all runs.

**Legs.**  A leg begins and ends at a pose, by lidar or cameras, beside the robot's own sensors.  Poses of one fixed
frame are cut into legs one after the other; those of the windows of DRIVE are legs as they are, and chained over a
whole command: what was driven from the last pose of a window to the first of the next, some tenths of a second, is
predicted by the speeds that the lidar shows there.

**Fit.**  Each kind of odometry is one slip model with other parts free.  The observed point lies at l in the body, and
its sensor is turned by :math:`\gamma`; with the pose of the body :math:`(p, \psi)` that the odometry sums from 0,

.. math:: moved = R(\gamma)^T \big(p + R(\psi)\, l - l\big),

and parameters minimise the distance from the measured end of each leg, bounded in its influence (soft L1, at
the median distance that is left), with the prior of unknown ground
(:func:`~terrain.estimation.models.slip_model.unknown_ground`) as a ridge.  All kinds have the same
scale of the tracks, l and :math:`\gamma` fitted, which are no slip.

**The adaptive observer** is judged on a command's last window by efficiencies of the first ones.  The lidar poses of
all windows but the last are fixes for it, brought to the body by the mount that odometry was fitted with; the
motion over the last one is dead reckoning with the efficiencies of the tracks that it came to, without another fix
and without the gyro.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import unwrapped
from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.errors import DataError
from terrain.estimation.models.observer import ObserverStatus, observe, rows_of
from terrain.estimation.models.slip_model import (
    ANGLE,
    COMPACTION,
    EXPONENT,
    GRADE,
    N_MODEL,
    N_PARAMETERS,
    PARAMETERS,
    SIDE,
    TRACK_RATIO,
    TURN_GRADE,
    TURN_SHIFT,
    TURN_SIDE,
    SlipModel,
    body_velocity,
    model_of,
    next_displacement,
    unknown_ground,
)
from terrain.estimation.models.slip_odometry import ROWS as ODOMETRY_ROWS
from terrain.estimation.models.tracked import ROWS, TrackedObserver, TrackedSettings
from terrain.identify import Fit, Parameter, deal, folds, identify
from terrain.kernels import njit
from terrain.logs.drive import WindowPoses
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

STEP_S = 0.05  #: Longest step within a leg: that of the logs of DRIVE.
GAP_S = 0.25  #: Longest time without a sample within a leg, and without a pose at its ends.
MAX_WINDOW_GAP_S = 0.5  #: Longest gap between two windows of a command.


class Leg(NamedTuple):
    """A stretch of a run."""

    run: int  #: number of the run
    moved: Array  #: (3,) measured change of pose of the observed point, in the frame of its first pose
    step_s: float  #: from sample to sample
    speeds_mps: Array  #: (n, 2) of the tracks
    yaw_rate_radps: Array  #: (n,) of the gyro
    tilt_rad: Array  #: (n, 2) roll and pitch; 0 where they are not measured
    length_s: float  #: of the leg


def odometry_rows(run: RunLog, robot: TrackedRobot) -> tuple[Array, Array]:
    """Return the ticks (n,) of a run's encoders, and what an odometry takes at each (n, 5)."""
    return rows_of(run, robot, ODOMETRY_ROWS)[:2]


def legs_over(
    run: RunLog, number: int, robot: TrackedRobot, spans: Sequence[tuple[float, float, Array]], delay_s: float
) -> list[Leg | None]:
    """Return the leg from each start to each end with the change of pose; None where tracks or gyro have gaps.

    Poses are of an earlier time than their stamps by the delay behind gyro and tracks; before its first sample a run is
    taken to have driven as at that.
    """
    if not spans:
        return []
    time_s, rows = odometry_rows(run, robot)
    known, found = np.isfinite(rows), list[Leg | None]()
    if not known[:, 2].any():
        raise DataError(f"run {run.run_id!r} has no gyro_z_radps, which odometry with slip needs")
    for start_s, end_s, moved in spans:
        from_s, to_s, n = start_s - delay_s, end_s - delay_s, max(math.ceil((end_s - start_s) / STEP_S), 1)
        gaps = False  # a run may begin a delay after the first
        for column in (0, 1, 2):
            stamps_s = time_s[known[:, column]]
            inside = stamps_s[(stamps_s > from_s - GAP_S) & (stamps_s < to_s + GAP_S)]
            gaps |= len(inside) < 2 or bool(np.diff(inside).max() > GAP_S)
            gaps |= not gaps and bool(inside[-1] < to_s - GAP_S or inside[0] > from_s + MAX_WINDOW_GAP_S)
        if gaps:
            found.append(None)
            continue
        step_s = (end_s - start_s) / n
        at_s = from_s + (np.arange(n) + 0.5) * step_s
        left, right, rate, *tilt = (
            np.interp(at_s, time_s[known[:, k]], rows[known[:, k], k]) if known[:, k].any() else np.zeros(n)
            for k in range(5)
        )
        speeds, tilts = np.column_stack([left, right]), np.column_stack(tilt)
        found.append(Leg(number, moved, step_s, speeds, rate, tilts, end_s - start_s))
    return found


def window_origins(run: RunLog, windows: Sequence[WindowPoses]) -> list[Array]:
    """Return the pose (3,) at the start of each window, from the first; none where a gap is not known.

    Over the gap from one window to the next a robot drives as fast as its lidar shows around it.
    """
    lidar, origins = run.streams.get("lidar"), [np.zeros(3)][: len(windows)]
    for before, after in itertools.pairwise(windows):
        from_s, to_s = before.time_s[-1], after.time_s[0]
        if lidar is None or not 0.0 <= to_s - from_s <= MAX_WINDOW_GAP_S:
            return []
        near = np.abs(lidar.time_s - 0.5 * (from_s + to_s)) < 2.0 * MAX_WINDOW_GAP_S
        near &= np.isfinite(lidar.values).all(axis=1)
        if near.sum() < 3:
            return []
        speed_x, speed_y, rate = lidar.values[near].mean(axis=0) * (to_s - from_s)
        gap = composed(np.array([0.0, 0.0, 0.5 * rate]), np.array([speed_x, speed_y, 0.5 * rate]))
        origins.append(composed(composed(origins[-1], before.pose[-1]), gap))
    return origins


def legs_of_poses(run: RunLog, number: int, robot: TrackedRobot, length_s: float) -> list[Leg]:
    """Return legs of a run with poses in one frame, one after the other."""
    pose, spans = run.streams["pose"], []
    values = np.column_stack([pose.values[:, :2], unwrapped(pose.values[:, 2])])
    known = np.isfinite(values).all(axis=1)
    time_s, values = pose.time_s[known], values[known]
    if not len(time_s):
        return []
    for begin_s in np.arange(time_s[0], time_s[-1] - length_s + 1e-9, length_s):
        first, last = np.searchsorted(time_s, [begin_s - 1e-9, begin_s + length_s - 1e-9]).tolist()
        last = min(last, len(time_s) - 1)
        late_s = max(time_s[first] - begin_s, abs(time_s[last] - begin_s - length_s))
        if late_s <= GAP_S:  # else no pose there
            x, y, turn = values[last] - values[first]
            cos, sin = math.cos(values[first, 2]), math.sin(values[first, 2])
            moved = np.array([cos * x + sin * y, cos * y - sin * x, turn])
            spans.append((time_s[first], time_s[last], moved))
    return [leg for leg in legs_over(run, number, robot, spans, 0.0) if leg is not None]


def composed(first: Array, then: Array) -> Array:
    """Return the pose (3,) after one change of pose and another in its frame.

    Examples
    --------
    >>> composed(np.array([1.0, 0.0, np.pi / 2]), np.array([1.0, 0.0, 0.0])).round(6).tolist()
    [1.0, 1.0, 1.570796]
    """
    cos, sin = math.cos(first[2]), math.sin(first[2])
    x, y = cos * then[0] - sin * then[1], sin * then[0] + cos * then[1]
    return np.array([first[0] + x, first[1] + y, first[2] + then[2]])


#: What is known of a mount before: on the robot, and mounted straight within 6 degrees.
MOUNT = (
    Parameter("lever_x_m", 0.0, prior_std=0.3),
    Parameter("lever_y_m", 0.0, prior_std=0.3),
    Parameter("turned_rad", 0.0, prior_std=0.1),
)
LOWEST = {EXPONENT: 0.0, TRACK_RATIO: 0.05}  #: Bounds of parameters of the slip model.
SCALE_STD_RATIO = 0.1  #: Of the sprocket's radius beside the described one.
FIRST_ERROR_M, LEAST_ERROR_M = 0.1, 1e-4  #: Of a leg of 2 s: what a fit begins with, and the least.
MIN_LEGS = 10

FLAT_RAD = 0.02  #: Root mean square tilt, a degree, below which the ground counts as level.


class Kind(NamedTuple):
    """A kind of odometry: its free places of the slip model, and whether its yaw rate is the gyro's or the tracks'."""

    name: str
    free: tuple[int, ...]
    by_gyro: bool


ENCODER = Kind("encoder odometry", (COMPACTION, TRACK_RATIO), False)
GYRODOMETRY = Kind("gyrodometry", (COMPACTION,), True)
ENDO = Kind("Endo", (COMPACTION, EXPONENT), True)
SLIP = Kind("slip-compensated", tuple(k for k in range(N_MODEL) if k != TRACK_RATIO), True)
KINDS = (ENCODER, GYRODOMETRY, ENDO, SLIP)  #: Encoder odometry has the best single effective track.


class FittedOdometry(NamedTuple):
    """A kind of odometry fitted to legs."""

    kind: Kind  #: which
    model: SlipModel  #: its slip model, with the covariance of what was fitted, clustered by runs
    fit: Fit  #: of the free parameters of the model, and of :data:`MOUNT`

    @property
    def mount(self) -> Array:
        """Place of the observed point in the body, and angle of its sensor (3,)."""
        return self.fit.value[-len(MOUNT) :]


def fit_odometry(kind: Kind, legs: Sequence[Leg], robot: TrackedRobot) -> FittedOdometry:
    """Fit a kind of odometry to legs, of which longer ones count by the inverse of their length.

    ``DataError`` if there are fewer than ten legs.
    """
    if len(legs) < MIN_LEGS:
        raise DataError(f"{len(legs)} legs have poses at both ends, {MIN_LEGS} or more are required")
    prior = unknown_ground()
    vector = np.where(np.isin(np.arange(N_MODEL), kind.free), prior.vector, SlipModel().vector)
    std = np.sqrt(np.diag(prior.covariance))
    std[COMPACTION] = SCALE_STD_RATIO
    free = np.array(kind.free)
    parameters = [
        Parameter(PARAMETERS[k], float(vector[k]), LOWEST.get(k, -math.inf), math.inf, float(std[k]))
        for k in free
    ]
    ends, measured = _predictor(kind, legs, robot), np.array([leg.moved[:2] for leg in legs])
    longer = np.array([max(leg.length_s / 2.0, 1.0) for leg in legs])
    runs, number = np.unique([leg.run for leg in legs], return_inverse=True)

    def errors_m(values: Array) -> Array:
        vector[free] = values[: -len(MOUNT)]
        return np.asarray((ends(vector, values[-len(MOUNT) :])[:, :2] - measured) / longer[:, None])

    fit = identify(errors_m, [*parameters, *MOUNT], number, True, scale=(FIRST_ERROR_M, LEAST_ERROR_M))
    left_m = np.hypot(*errors_m(fit.value).T) * longer
    covariance = np.zeros((N_MODEL, N_MODEL))
    covariance[np.ix_(free, free)] = fit.cov[: len(free), : len(free)]
    path_m = np.array([np.abs(leg.speeds_mps.mean(axis=1)).sum() * leg.step_s for leg in legs])
    ratio = float(np.sqrt((left_m**2).mean() / max((path_m**2).mean(), 1e-12)))
    model = model_of(
        vector,
        covariance=covariance,
        run_slip_std_ratio=ratio / math.sqrt(2.0),
        run_angle_std_rad=ratio / math.sqrt(2.0),
        found=f"{len(runs)} runs, {len(legs)} legs",
    )
    return FittedOdometry(kind, model, fit)


def without_tilt(legs: Sequence[Leg]) -> bool:
    """Return whether legs show no slopes: the rms of their mean tilts is below :data:`FLAT_RAD`."""
    tilts = np.array([leg.tilt_rad.mean(axis=0) for leg in legs])
    return bool(np.sqrt((tilts**2).mean(axis=0)).max() < FLAT_RAD)


def level(kind: Kind) -> Kind:
    """Return a kind without the parameters that only slopes show."""
    tilt = {GRADE, TURN_GRADE, SIDE, TURN_SIDE, TURN_SHIFT, *(ANGLE + k for k in (4, 5, 7))}
    return kind._replace(free=tuple(place for place in kind.free if place not in tilt))


def _predictor(kind: Kind, legs: Sequence[Leg], robot: TrackedRobot) -> Callable[[Array, Array], Array]:
    """Return what gives the end (n, 3) of each leg by the numbers of a slip model and a mount."""
    each = ("speeds_mps", "yaw_rate_radps", "tilt_rad")
    samples = tuple(np.concatenate([getattr(leg, name) for leg in legs]) for name in each)
    end, step_s = np.cumsum([len(leg.yaw_rate_radps) for leg in legs]), np.array([leg.step_s for leg in legs])
    geometry, theta = np.array([robot.half_track_m, robot.contact_length_m]), np.zeros(N_PARAMETERS)

    def ends(vector: Array, mount: Array) -> Array:
        theta[:N_MODEL] = vector
        return np.asarray(_sum_legs(theta, mount, geometry, kind.by_gyro, *samples, end, step_s))

    return ends


@njit
def _sum_legs(
    theta: Array,
    mount: Array,
    geometry: Array,
    by_gyro: bool,
    speeds: Array,
    rate: Array,
    tilt: Array,
    end: Array,
    step_s: Array,
) -> Array:
    """Return the change of pose (legs, 3) of the observed point; ``geometry`` is d and the length."""
    half_track_m, length_m = geometry
    out, first = np.empty((len(end), 3)), 0
    by_track = 2.0 * half_track_m * theta[TRACK_RATIO]
    for leg in range(len(end)):
        x, y, yaw, displaced = 0.0, 0.0, 0.0, 0.0
        for k in range(first, end[leg]):
            pair = (speeds[k, 0], speeds[k, 1])
            turn = rate[k] if by_gyro else (pair[1] - pair[0]) * (1.0 - theta[COMPACTION]) / by_track
            displaced = next_displacement(displaced, pair, turn, length_m, step_s[leg])
            if by_gyro:
                v_x, v_y = body_velocity(theta, half_track_m, pair, turn, (tilt[k, 0], tilt[k, 1]), displaced)
            else:
                v_x, v_y = 0.5 * (pair[0] + pair[1]) * (1.0 - theta[COMPACTION]), 0.0
            middle = yaw + 0.5 * turn * step_s[leg]
            x += step_s[leg] * (v_x * math.cos(middle) - v_y * math.sin(middle))
            y += step_s[leg] * (v_x * math.sin(middle) + v_y * math.cos(middle))
            yaw += turn * step_s[leg]
        first = end[leg]
        cos, sin = math.cos(yaw), math.sin(yaw)
        x += (cos - 1.0) * mount[0] - sin * mount[1]
        y += sin * mount[0] + (cos - 1.0) * mount[1]
        turned_cos, turned_sin = math.cos(mount[2]), math.sin(mount[2])
        out[leg, 0] = turned_cos * x + turned_sin * y
        out[leg, 1] = turned_cos * y - turned_sin * x
        out[leg, 2] = yaw
    return out


DRAWS = 2000  #: Bootstrap samples of runs.


@dataclass(frozen=True, slots=True)
class KindScore:
    """Error of a kind of odometry over legs of one length."""

    kind: str  #: name
    rmse_m: float  #: root mean square distance from the measured end, held out, and its 95 % interval
    rmse_ci_m: tuple[float, float]
    median_m: float  #: of the distances
    yaw_rmse_rad: float  #: root mean square error of the heading
    gain_encoder: float  #: by how much the RMSE is below that of encoder odometry, as a ratio
    gain_encoder_ci: tuple[float, float]
    gain_gyro: float  #: the same against gyrodometry
    gain_gyro_ci: tuple[float, float]


@dataclass(frozen=True, slots=True)
class LegScores:
    """Scores of all kinds over legs of one length."""

    length_s: float  #: of the legs, their mean
    n_legs: int  #: how many
    n_runs: int
    path_m: float  #: root mean square of the distance between the ends of a leg
    kinds: tuple[KindScore, ...]  #: in the order of :data:`~terrain.calibration.odometry.KINDS`


def held_out_ends(
    groups: Mapping[str, Sequence[Leg]],
    robot: TrackedRobot,
    n_folds: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, dict[str, Array]]:
    """Return by kind and group the predicted ends (n, 3) of legs whose runs were held out of the fit.

    Groups are legs by length; whole runs are dealt into folds by the seed.  ``DataError`` if there are fewer runs than
    folds.
    """
    every = [leg for legs in groups.values() for leg in legs]
    run = np.array([leg.run for leg in every])
    if (n_runs := len(np.unique(run))) < n_folds:
        raise DataError(f"{n_runs} runs have legs, at least {n_folds} are required for {n_folds} folds")
    fold = deal(run, n_folds, np.random.default_rng(seed))
    kinds = [level(kind) for kind in KINDS] if without_tilt(every) else list(KINDS)
    ends = {kind.name: np.full((len(every), 3), np.nan) for kind in kinds}
    for done, ((train, test), kind) in enumerate(itertools.product(folds(fold), kinds), start=1):
        fitted = fit_odometry(kind, [every[k] for k in train], robot)
        tested = _predictor(kind, [every[k] for k in test], robot)
        ends[kind.name][test] = tested(fitted.model.vector, fitted.mount)
        progress(done, n_folds * len(kinds))
    edges = np.cumsum([len(legs) for legs in groups.values()])[:-1]
    return {name: dict(zip(groups, np.split(end, edges), strict=True)) for name, end in ends.items()}


def score_legs(legs: Sequence[Leg], ends: Mapping[str, Array], seed: int) -> LegScores:
    """Return the scores of kinds over n legs of one length, by predicted ends (n, 3) and a bootstrap over runs."""
    measured = np.array([leg.moved for leg in legs])
    runs, number = np.unique([leg.run for leg in legs], return_inverse=True)
    counts, legs_of_run = bootstrap_counts(len(runs), DRAWS, seed), np.bincount(number)
    squares = {name: ((end[:, :2] - measured[:, :2]) ** 2).sum(axis=1) for name, end in ends.items()}
    rmse = {name: math.sqrt(square.mean()) for name, square in squares.items()}
    drawn = {
        name: np.sqrt((counts @ np.bincount(number, square)) / (counts @ legs_of_run))
        for name, square in squares.items()
    }

    def gain(name: str, against: Kind) -> tuple[float, tuple[float, float]]:
        over = 1.0 - drawn[name] / drawn[against.name]
        return 1.0 - rmse[name] / rmse[against.name], percentile_interval(over)

    scores = tuple(
        KindScore(
            name,
            rmse[name],
            percentile_interval(drawn[name]),
            float(np.median(np.sqrt(squares[name]))),
            math.sqrt(np.mean((end[:, 2] - measured[:, 2]) ** 2)),
            *gain(name, ENCODER),
            *gain(name, GYRODOMETRY),
        )
        for name, end in ends.items()
    )
    length_s = float(np.mean([leg.length_s for leg in legs]))
    path_m = math.sqrt((measured[:, :2] ** 2).sum(axis=1).mean())
    return LegScores(length_s, len(legs), len(runs), path_m, scores)


#: Gains that settle within four seconds at any speed, and about the noise of these poses.
SETTINGS = TrackedSettings(
    observation_gain_ps=(2.0, 2.0, 2.0), normalised=True, position_std_m=0.03, yaw_std_rad=0.04
)


#: A command's leg that is so much shorter than the longest of all is left out: its windows are not whole.
SHORT_RATIO = 0.8
ADAPTIVE = "adaptive observer"


@dataclass(frozen=True, slots=True)
class ParameterFound:
    """A parameter of a slip model: its value and its 95 % interval, NaN where it was not fitted."""

    value: float
    low: float
    high: float


def judge_odometry(
    runs: Sequence[RunLog],
    windows: Mapping[str, tuple[WindowPoses, ...]],
    robot: TrackedRobot,
    lengths_s: Sequence[float],
    folds: int,
    seed: int,
    count: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[SlipModel, bool, dict[str, Any]]:
    """Fit kinds of odometry to folds of whole runs, judge them on the others, and fit the slip model to all.

    Returned are the slip model of slip-compensated odometry fitted to all runs, whether no slope was driven or no tilt
    measured, so that what slopes do is not fitted, and the figures by name: ``n_runs`` with poses, ``scores`` by length
    of the legs, ``parameters`` of the model, ``observed_point_m`` and ``observed_angle_rad`` of the sensor of the poses
    in the body, ``adaptive`` scores of the last windows of commands (None without), and ``delay_s`` of the poses behind
    the gyro.

    Runs have poses, compared after some lengths, or are commands of DRIVE with the poses of their windows by run.
    ``DataError`` if fewer runs than folds have poses.
    """
    delay_s, groups = 0.0, dict[str, list[Leg]]()
    if windows:
        delay_s = robot.identified.get("lidar_delay_s", 0.0)
        single, chained = list[Leg](), list[Leg]()
        for number, run in enumerate(runs):
            own = windows.get(run.run_id, ())
            spans, origins = [(w.time_s[0], w.time_s[-1], w.pose[-1]) for w in own], window_origins(run, own)
            if len(origins) > 1:  # all of them in a row
                spans.append((spans[0][0], spans[-1][1], composed(origins[-1], own[-1].pose[-1])))
            for place, leg in enumerate(legs_over(run, number, robot, spans, delay_s)):
                if leg is not None:
                    (single if place < len(own) else chained).append(leg)
        longest_s = max((leg.length_s for leg in chained), default=0.0)
        whole = [leg for leg in chained if leg.length_s > SHORT_RATIO * longest_s]
        groups = {"window": single, "command": whole}
    for length_s in () if windows else lengths_s:
        groups[f"{length_s:g} s"] = [
            leg
            for number, run in enumerate(runs)
            if "pose" in run.streams
            for leg in legs_of_poses(run, number, robot, length_s)
        ]
    groups = {name: legs for name, legs in groups.items() if legs}
    if not groups:
        raise DataError(
            "no run has poses of a camera or lidar, beside tracks and gyro, over "
            f"{' or '.join(f'{length:g}' for length in lengths_s)} s"
        )
    ends = held_out_ends(groups, robot, folds, seed, count)
    scores = tuple(
        score_legs(legs, {kind: by[name] for kind, by in ends.items()}, seed) for name, legs in groups.items()
    )
    every = [leg for legs in groups.values() for leg in legs]
    flat = without_tilt(every)
    fitted = fit_odometry(level(SLIP) if flat else SLIP, every, robot)
    adaptive = None
    if windows:
        single = groups["window"]
        last, chosen, predicted = {leg.run: k for k, leg in enumerate(single)}, [], []
        for number, run in enumerate(runs):
            eta = efficiencies_before(run, windows.get(run.run_id, ()), robot, delay_s, fitted.mount)
            if eta is not None and number in last:
                leg = single[last[number]]
                slipping = leg._replace(speeds_mps=leg.speeds_mps * eta)  # Tazzari (5)
                chosen.append(last[number])
                predicted.append(_predictor(ENCODER, [slipping], robot)(SlipModel().vector, fitted.mount)[0])
        if len(chosen) > 1:
            compared = {kind.name: ends[kind.name]["window"][chosen] for kind in (ENCODER, GYRODOMETRY)}
            compared[ADAPTIVE] = np.array(predicted)
            adaptive = score_legs([single[k] for k in chosen], compared, seed)
    x_m, y_m, angle_rad = map(float, fitted.mount)
    rows = zip(fitted.fit.parameters, fitted.fit.value.tolist(), *fitted.fit.interval.tolist(), strict=True)
    found = {p.name: ParameterFound(*row) for p, *row in rows if p.name in PARAMETERS}
    figures = {
        "n_runs": len({leg.run for leg in every}),
        "scores": scores,
        "parameters": found,
        "observed_point_m": (x_m, y_m),
        "observed_angle_rad": angle_rad,
        "adaptive": adaptive,
        "delay_s": delay_s,
    }
    return fitted.model, flat, figures


def efficiencies_before(
    run: RunLog, windows: Sequence[WindowPoses], robot: TrackedRobot, delay_s: float, mount: Array
) -> Array | None:
    """Return the efficiencies (2,) of the left and the right track before a command's last window.

    None where there are fewer than two windows, gaps that are too long, or too few fixes.
    """
    origins = window_origins(run, windows)
    if len(origins) < 2:
        return None
    time_s, own = odometry_rows(run, robot)
    rows = np.full((len(time_s), len(ROWS)), np.nan)
    rows[:, :2], rows[:, 5] = own[:, :2], own[:, 2]
    lever, turned = complex(mount[0], mount[1]), np.exp(1j * mount[2])
    for origin, window in zip(origins[:-1], windows, strict=False):
        for stamp_s, pose in zip(window.time_s - delay_s, window.pose, strict=True):
            tick = int(np.argmin(np.abs(time_s - stamp_s)))
            if abs(time_s[tick] - stamp_s) < 0.5 * (time_s[1] - time_s[0]) + 1e-9:
                x, y, yaw = composed(origin, pose)
                body = complex(x, y) * turned + lever - lever * np.exp(1j * yaw)
                rows[tick, 2:5] = body.real, body.imag, yaw
    until = int(np.searchsorted(time_s, windows[-2].time_s[-1] - delay_s, side="right"))
    if until < 2:
        return None
    observed = observe(TrackedObserver(robot, SETTINGS), time_s[:until], rows[:until])
    if observed.status[-1] == ObserverStatus.STARTING:
        return None
    return np.array([observed.state(f"eta_{side}_ratio")[-1] for side in ("left", "right")])
