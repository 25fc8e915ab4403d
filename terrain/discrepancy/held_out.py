"""Runs held out of a diagnosis: which, their repair, and what an extension gains on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.diagnose import MIN_RUNS
from terrain.discrepancy.evidence import N_BLOCKS, Evidence, evidence_at
from terrain.discrepancy.health import Excluded, Fault, unfit_runs
from terrain.discrepancy.runs import LowPass, Signals, Simulation, low_pass_of, measured_channels, rows_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.selection import MIN_CLUSTERS
from terrain.effects import CHANNELS
from terrain.errors import DataError, TerrainError
from terrain.estimation.estimate import Estimate, estimate_run, summarize
from terrain.records import Array, RunLog
from terrain.robots import Robot

HOLD_OUT_FROM, HOLD_OUT_EVERY = 6, 4  #: With so many runs or more, one in every so many is held out

N_BOOTSTRAP = 2000

MIN_JUDGED = 3  #: Least number of runs among which an unfit one can be found


def split_runs(runs: Sequence[RunLog], hold_out: int | None, seed: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return the runs for the diagnosis and those held out.

    Runs are put in a random order, terrain after terrain, and of ``n`` that are held out every
    ``len(runs) / n``-th is taken, so that each terrain contributes in proportion.

    Parameters
    ----------
    hold_out : number of runs held out; by default a quarter of six or more
    seed : of the order

    Raises
    ------
    DataError
        if too few would be left for the diagnosis.
    """
    n = hold_out
    if n is None:
        n = math.ceil(len(runs) / HOLD_OUT_EVERY) if len(runs) >= HOLD_OUT_FROM else 0
    elif n and len(runs) - n < MIN_RUNS:
        raise DataError(f"--hold-out is {n} of {len(runs)} runs; the diagnosis requires at least {MIN_RUNS}")
    if not n:
        return list(runs), []
    drawn = np.random.default_rng(seed).permutation(len(runs))
    order = sorted(drawn, key=lambda i: runs[i].terrains)
    held_out = {order[k * len(runs) // n] for k in range(n)}
    used = [run for i, run in enumerate(runs) if i not in held_out]
    return used, [run for i, run in enumerate(runs) if i in held_out]


def repair_held_out(
    signals: Sequence[Signals],
    faults: Sequence[Fault],
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
) -> tuple[Signals, ...]:
    """Return runs held out without the faults that were found in the others, in the order of their repair.

    A run has a fault if it is nearer to the simulation, with the causes built in, without it: by squares over the
    ``noise`` of each channel.  A channel whose readings could not be distinguished is left out of all of them.
    """
    size = np.array([noise.get(name) or math.nan for name in CHANNELS])

    def misfit(run: Signals) -> float:
        planar = simulation.planar_on(run.terrain)
        residual = rows_of(run, planar, simulation.vector, (), low_pass).residual
        return float(np.nansum((residual / size) ** 2))

    fixed = []
    for run in signals:
        for fault in faults:
            right = fault.change.applied(run)
            run = right if math.isnan(fault.change.factor) else min(run, right, key=misfit)
        fixed.append(run)
    return tuple(fixed)


# -- What an extension gains: the part of the square that it removes, by bootstrap over clusters -----------


class ChannelGain(NamedTuple):
    """Measured minus simulated in one channel, before and after."""

    rms_before: float  #: behind the common low-pass, in the channel's unit
    rms_after: float
    white_before: float  #: behind the whitening filter, too; noise alone has 1
    white_after: float
    reduction: float  #: ratio of the square behind the low-pass that is removed
    ci: tuple[float, float]  #: its 95 % interval
    refused: bool  #: whether no gain can be claimed: the interval includes zero, or lies below


class Gain(NamedTuple):
    """What an extension gains."""

    runs: tuple[str, ...]  #: ids of those on which it was measured
    excluded_runs: tuple[Excluded, ...]  #: that were given and are unfit
    clusters: str  #: ``runs``, or ``thirds of runs`` where runs are few
    channels: dict[str, ChannelGain]
    reduction: float  #: of the whitened square of all channels, with variations from run to run marginalised
    ci: tuple[float, float]
    refused: bool


def gain_of_signals(
    simulation: Simulation, extended: Simulation, runs: Sequence[Signals], seed: int = 0
) -> Gain:
    """Return by how much an extension reduces the residual of runs that were not used to find it.

    One low-pass and one whitening filter serve before and after: fitted to the residual that
    remains with the whole library freed around the extension.
    """
    signals, excluded, after = fit_to_judge(extended, runs)
    before = evidence_at(signals, simulation, simulation.vector, (), low_pass_of(signals), after.statistics)
    by_run = len(signals) >= MIN_CLUSTERS
    weights = bootstrap_counts(len(signals) * (1 if by_run else N_BLOCKS), N_BOOTSTRAP, seed)
    channels = {}
    for name in measured_channels(after.rows):
        c, rms, squares = CHANNELS.index(name), [], []
        for info in (before, after):
            white = [np.where(run[-1, :, c] == 0.0, np.nan, run[-1, :, c]) for run in info.white]
            for residuals in ([run.residual[:, c] for run in info.rows], white):
                parts = [part for values in residuals for part in _clusters(values, by_run)]
                square = np.array([np.nansum(part**2) for part in parts])
                known = sum(int(np.isfinite(part).sum()) for part in parts)
                rms.append(float(np.sqrt(square.sum() / known)) if known else math.nan)
                squares.append(square)
        sizes = rms[0], rms[2], rms[1], rms[3]
        channels[name] = ChannelGain(*sizes, *_reduction(squares[0], squares[2], weights))
    of_all = _reduction(_costs(before, by_run), _costs(after, by_run), weights)
    ids = tuple(run.run_id for run in signals)
    return Gain(ids, excluded, "runs" if by_run else "thirds of runs", channels, *of_all)


def fit_to_judge(
    simulation: Simulation, runs: Sequence[Signals]
) -> tuple[tuple[Signals, ...], tuple[Excluded, ...], Evidence]:
    """Return the runs that are fit to be judged on, those that are not, and the evidence of the first.

    Raises
    ------
    DataError
        if there is no run, or none is fit.
    """
    signals = tuple(runs)
    if not signals:
        raise DataError("gain: there is no run that was not used in the diagnosis")
    low_pass, names = low_pass_of(signals), names_of(simulation.library)
    info = evidence_at(signals, simulation, simulation.vector, names, low_pass)
    excluded = unfit_runs(signals, info) if len(signals) >= MIN_JUDGED else ()
    if excluded:
        gone = {run.run_id for run in excluded}
        signals = tuple(run for run in signals if run.run_id not in gone)
        if not signals:
            raise DataError(f"gain: none of {len(runs)} runs is fit to be compared ({excluded[0].reason})")
        info = evidence_at(signals, simulation, simulation.vector, names, low_pass)
    return signals, tuple(excluded), info


def _costs(info: Evidence, by_run: bool) -> Array:
    """Return what each cluster (n,) adds to minus twice the log-likelihood, its own scatter integrated out.

    Each third of a run has a scatter of its own, since parts of a common one need not be positive.
    """
    prior = np.diag(1.0 / info.nuisance_std**2)
    costs = []
    for white in info.white:
        columns = white[[*info.nuisances, -1]].transpose(
            1, 0, 2
        )  # rows first, so that clusters are cut of all
        for part in _clusters(columns, by_run):
            gram = np.einsum("mqc,mpc->qp", part, part)
            shown = gram[:-1, -1]
            costs.append(float(gram[-1, -1] - shown @ np.linalg.solve(gram[:-1, :-1] + prior, shown)))
    return np.array(costs)


def _clusters(values: Array, by_run: bool) -> list[Array]:
    return [values] if by_run else np.array_split(values, N_BLOCKS)


def _reduction(before: Array, after: Array, weights: Array) -> tuple[float, tuple[float, float], bool]:
    """Return the part of the square that is removed, its 95 % interval, and whether no gain can be claimed."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = 1.0 - (weights @ after) / (weights @ before)
        ratio = float(1.0 - after.sum() / before.sum())
    if not np.isfinite(ratios).any():
        return math.nan, (math.nan, math.nan), True
    low, high = percentile_interval(ratios)
    return ratio, (low, high), not low > 0.0


# -- What an extension gains for the robot's filter, against the truth of runs that have one ---------------

FILTERS = {"swerve": "vio12", "skid_steer": "skid", "tracked": "skid"}
"""By kind of drive, the filter whose errors are compared."""

ERRORS = ("speed_mps", "yaw_rate_radps", "slip_ratio")
"""Errors that are compared: root mean squares of speed and yaw rate, and the error of the mean slip."""


class Change(NamedTuple):
    """A figure before and after an extension, and the 95 % interval of its change (None for one run)."""

    before: float
    after: float
    change_ci: tuple[float, float] | None


class Comparison(NamedTuple):
    """What an extension changes for a filter or a classifier (recipe) on held-out runs."""

    name: str
    reason: str | None  #: why there are no errors; None where there are
    n_runs: int  #: that were compared
    errors: Mapping[str, Change]  #: by figure
    terrains: tuple[str, ...] | None = None  #: of the runs; None where they do not matter

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return {key: value for key, value in self._asdict().items() if key != "terrains" or value is not None}


def filter_gain(runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int) -> Comparison | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs; the interval is that of the difference, by bootstrap over runs.
    """
    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    rows: list[list[tuple[float, ...]]] = []
    try:
        for run in known:
            rows.append([_errors(estimate_run(run, one, name)) for one in (robot, better)])
    except TerrainError as error:
        return Comparison(name, str(error), len(known), {})
    counts, errors = bootstrap_counts(len(rows), N_BOOTSTRAP, seed), {}
    for key, both in zip(ERRORS, np.array(rows).transpose(2, 1, 0), strict=True):
        if np.isfinite(both).all():
            changes = counts @ (both[1] - both[0]) / len(rows)
            interval = percentile_interval(changes) if len(rows) > 1 else None
            errors[key] = Change(float(both[0].mean()), float(both[1].mean()), interval)
    return Comparison(name, None, len(rows), errors)


def _errors(estimate: Estimate) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    summary, track, truth = summarize(estimate), estimate.track, estimate.run.streams["truth"]
    squares = dict.fromkeys(("speed", "yaw_rate"), np.zeros(len(track.time_s)))
    for state in track.states:
        kind = state.removesuffix("_mps").removesuffix("_radps").removesuffix("_x").removesuffix("_y")
        if kind in squares:
            true = truth.channel("speed_x_mps" if state == "speed_mps" else state)
            error = track.state(state) - np.interp(track.time_s, truth.time_s, true)
            squares[kind] = squares[kind] + error**2
    rms = [math.sqrt(float(np.nanmean(square))) for square in squares.values()]
    slip_error = abs(summary.slip_mean - summary.slip_true_mean)
    return (*rms, slip_error if summary.slip_observable else math.nan)


def accuracy_change(before: Array, after: Array, run_id: Array, seed: int) -> Change:
    """Return accuracies before and after (n,), and the 95 % interval of their difference by bootstrap over runs (n,).

    Examples
    --------
    >>> before, after = np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1])
    >>> accuracy_change(before, after, np.array(["a", "a", "b", "b"]), 0)
    Change(before=0.5, after=1.0, change_ci=(0.0, 1.0))
    """
    runs, of = np.unique(run_id, return_inverse=True)
    n = len(runs)
    windows = np.bincount(of, minlength=n)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=n)
    counts = bootstrap_counts(n, N_BOOTSTRAP, seed)
    interval = percentile_interval((counts @ change) / (counts @ windows))
    return Change(float(before.mean()), float(after.mean()), interval)


# -- What a black-box reference reaches on the runs held out: how much of the residual is there to be found -
# Measured minus simulated of each channel is regressed on the inputs of the simulation, their products,
# magnitudes and rates, a few rows before and after, by Bayesian linear regression, whose two variances are
# set by the data (MacKay, Bayesian interpolation, Neural Computation 1992; ``BayesianRidge`` of scikit-learn).
# It is fitted to the runs behind the diagnosis and judged on the others: what it removes there and the named
# causes do not, some cause without a name makes.

DRIVEN = ("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad", "sideways_mps")
"""Inputs that are logged; the force is the simulation's own."""

LAGS = (-2, -1, 1, 2)
"""Rows by which inputs are taken later and earlier: a third of a second at the rate of a 50 Hz log, where any
sensor may be the late one."""

LEAST_RANGE = 1e-6  #: Spread of a column that counts as constant


class ChannelReference(NamedTuple):
    """Residual of one channel on the runs held out, and behind the reference, in the channel's unit."""

    rms_before: float
    rms_after: float
    reduction: float  #: part of the square that the reference removes; below 0 where it adds to it
    named_reduction: float  #: part that the named causes remove; NaN where none was named
    left_to_find_from: float
    """Lower end of the 95 % interval, by bootstrap over runs, of what the reference removes beyond the named
    causes; NaN where runs are too few: what one run has in common in itself is no cause."""


class Reference(NamedTuple):
    """What a black-box reference reaches, beside the named causes."""

    n_runs: int  #: held out, on which it is judged
    reduction: float  #: of the squares of all channels, each over its noise
    named_reduction: float
    channels: Mapping[str, ChannelReference]


def black_box_reference(
    used: Sequence[ComparedRun],
    held_out: Sequence[ComparedRun],
    noise: Mapping[str, float],
    seed: int = 0,
) -> Reference | None:
    """Return what a black-box reference, fitted to the runs used, reaches on runs held out; None without any.

    Squares of channels are added over the ``noise`` of each.
    """
    if not used or not held_out:
        return None
    columns, test = (np.concatenate([_columns(run) for run in runs]) for runs in (used, held_out))
    run_of_row = np.repeat(np.arange(len(held_out)), [len(run.time_s) for run in held_out])
    channels, total = {}, np.zeros(3)
    for name in measured_channels(used):
        c = CHANNELS.index(name)
        before = np.concatenate([run.residual(False)[:, c] for run in held_out])
        known = np.isfinite(before)
        if not known.any():
            continue
        target = np.concatenate([run.residual(False)[:, c] for run in used])
        after = before[known] - _predicted(columns, target, test[known])
        named = rival = before[known]
        if held_out[0].after is None:
            named = np.full(after.size, np.nan)
        else:
            named = rival = np.concatenate([run.residual(True)[:, c] for run in held_out])[known]
        squares = np.array([float(x @ x) for x in (before[known], after, named)])
        rms_before, rms_after, _ = np.sqrt(squares / known.sum()).tolist()
        left_low = _left_low(before[known] ** 2, rival**2 - after**2, run_of_row[known], seed)
        channels[name] = ChannelReference(rms_before, rms_after, *_removed(squares), left_low)
        if noise.get(name, math.nan) > 0:
            total += squares / noise[name] ** 2
    return Reference(len(held_out), *_removed(total), channels)


def _left_low(before: Array, more: Array, run_of_row: Array, seed: int) -> float:
    """Return the lower end of the interval of what is removed more (n,), over the square before (n,)."""
    parts = [run_of_row == run for run in np.unique(run_of_row)]
    if len(parts) < MIN_CLUSTERS:
        return math.nan
    sums = np.array([[more[part].sum(), before[part].sum()] for part in parts])
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.divide(*(bootstrap_counts(len(parts), N_BOOTSTRAP, seed) @ sums).T)
    return float(percentile_interval(ratios)[0]) if np.isfinite(ratios).any() else math.nan


def _removed(squares: Array) -> tuple[float, float]:
    """Return the parts of the first square that are removed in the second and in the third."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = 1.0 - squares[1:] / squares[0]
    return float(ratios[0]), float(ratios[1])


def _columns(run: ComparedRun) -> Array:
    """Return the regressors (m, k) of a run: a row at its ends takes the last input that there is."""
    inputs = [run.inputs[name] for name in DRIVEN]
    driven = [*inputs[:2], inputs[-1]]  # that is 0, and left out, but of omni robots
    plain = [*inputs, *(np.abs(x) for x in driven), *(np.tanh(x / 0.05) for x in driven)]
    products = [a * b for a, b in combinations_with_replacement(inputs, 2)]
    signed = [x * np.abs(x) for x in driven]
    at = np.arange(len(run.time_s))
    rates = [np.gradient(x) if at.size > 1 else np.zeros_like(x) for x in inputs]
    moving = np.column_stack([*inputs[:3], inputs[-1], inputs[0] * inputs[1], *signed])
    late = [moving[np.clip(at - lag, 0, at.size - 1)] for lag in LAGS]
    return np.hstack([np.column_stack([*plain, *products, *signed, *rates]), *late])


def _predicted(columns: Array, target: Array, test: Array) -> Array:
    """Return what a Bayesian linear regression of the target (n,) predicts for the test rows (m, k)."""
    from sklearn.linear_model import BayesianRidge

    known = np.isfinite(target) & np.isfinite(columns).all(axis=1)
    mean, spread = columns[known].mean(axis=0), columns[known].std(axis=0)
    use = spread > LEAST_RANGE
    if not use.any() or not target[known].std() > 0.0:
        return np.full(len(test), float(target[known].mean()) if known.any() else 0.0)
    ridge = BayesianRidge()
    ridge.fit((columns[known][:, use] - mean[use]) / spread[use], target[known])
    out: Array = ridge.predict(np.nan_to_num((test[:, use] - mean[use]) / spread[use]))
    return out
