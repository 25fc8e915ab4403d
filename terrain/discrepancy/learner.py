"""What a learner without names reaches on runs held out, and what of it goes into the extended robot.

**The black-box reference** states how much of the residual is there to be found.  Measured minus simulated of each
channel is regressed on the inputs of the simulation, their products, magnitudes and rates, a few rows before and
after, by Bayesian linear regression, whose two variances are set by the data (MacKay, Bayesian interpolation, Neural
Computation 1992; ``BayesianRidge`` of scikit-learn).  It is fitted to the runs behind the diagnosis and judged on the
others: what it removes there and the named causes do not, some cause without a name makes.

**Learned terms** (:mod:`terrain.learned_term`) are learned channel by channel on what the named causes leave: products
of a dictionary are selected one after the other, by what each takes off the square beside those before (orthogonal
least squares: Chen, Billings and Luo, Int. J. Control 1989).  How many there are is decided by cross-validation over
sessions, or runs where there are few: the fewest whose error is within one standard error of the least (Breiman et
al., Classification and Regression Trees, 1984, 3.4.3), or as many as have the least where the fewest do not reach
:data:`ENOUGH` of the black-box reference.  None is the answer where none is within it, where none gains clearly, or
where less than :data:`ENOUGH` of that gain is left with larger parts left out, each session where there are two.  Runs
held out decide nothing of a term.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.gain import Gain, Interval, removed_by
from terrain.discrepancy.runs import (
    LowPass,
    Signals,
    Simulation,
    measured_channels,
    rows_of,
    term_inputs,
    term_rows,
)
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.learned_term import (
    INPUTS,
    MOTION,
    OF_WHEELS,
    LearnedTerm,
    columns_of,
    factors_of,
    inputs_used,
    where_it_acts,
)
from terrain.records import Array

DRIVEN = ("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad", "sideways_mps")
"""Inputs that are logged; the force is the simulation's own."""

LAGS = (-2, -1, 1, 2)
"""Rows by which inputs are taken later and earlier: a third of a second at the rate of a 50 Hz log, where any
sensor may be the late one."""

LEAST_RANGE = 1e-6  #: Spread of a column that counts as constant


def predicted_residuals(used: Sequence[ComparedRun], judged: Sequence[ComparedRun]) -> list[Array]:
    """Return what a learner fitted to the runs used predicts of measured minus simulated (m, channels) of others.

    Channels that no run used measured are NaN.
    """
    from sklearn.linear_model import BayesianRidge

    predicted = [np.full((len(run.time_s), len(CHANNELS)), np.nan) for run in judged]
    if not used or not judged:
        return predicted
    columns, test = [np.concatenate([_regressors(run) for run in runs]) for runs in (used, judged)]
    ends = np.cumsum([len(run.time_s) for run in judged])[:-1]
    for name in measured_channels(used):
        c = CHANNELS.index(name)
        target = np.concatenate([run.residual(False)[:, c] for run in used])
        known = np.isfinite(target) & np.isfinite(columns).all(axis=1)
        if not known.any():
            continue
        mean, spread = columns[known].mean(axis=0), columns[known].std(axis=0)
        use = spread > LEAST_RANGE
        values = np.full(len(test), float(target[known].mean()))  # a constant where nothing varies
        if use.any() and target[known].std() > 0.0:
            x, there = [(rows[:, use] - mean[use]) / spread[use] for rows in (columns[known], test)]
            values = BayesianRidge().fit(x, target[known]).predict(np.nan_to_num(there))
        for run, own in zip(predicted, np.split(values, ends), strict=True):
            run[:, c] = own
    return predicted


def _regressors(run: ComparedRun) -> Array:
    """Return the regressors (m, k) of a run: a row at its ends takes the last input that there is."""
    inputs = [run.inputs[name] for name in DRIVEN]
    driven = [*inputs[:2], inputs[-1]]  # that is 0, and left out, but of omni robots
    plain = [*inputs, *[np.abs(x) for x in driven], *[np.tanh(x / 0.05) for x in driven]]
    products = [a * b for a, b in combinations_with_replacement(inputs, 2)]
    signed = [x * np.abs(x) for x in driven]
    at = np.arange(len(run.time_s))
    rates = [np.gradient(x) if at.size > 1 else np.zeros_like(x) for x in inputs]
    moving = np.column_stack([*inputs[:3], inputs[-1], inputs[0] * inputs[1], *signed])
    late = [moving[np.clip(at - lag, 0, at.size - 1)] for lag in LAGS]
    return np.hstack([np.column_stack([*plain, *products, *signed, *rates]), *late])


# -- Terms that are learned -------------------------------------------------------------------------------------

#: Part of the black-box reference's gain that few products have to reach, to be preferred to more, and of the gain on
#: single groups left out that they have to have on larger parts: what holds in one of two sessions is no law of both.
ENOUGH = 0.9
MAX_PRODUCTS = 30  #: Products of a term; the black-box reference has some eighty.
#: Groups of runs, or sessions, of the cross-validation; with fewer nothing is learned.
MAX_GROUPS, MIN_GROUPS = 12, 3
REFERENCE_FOLDS = 4  #: Folds of the black-box reference.

#: Edges of a run's range: single samples, as of a wheel that spun, are not what it drove.
PERCENTILES = (1.0, 99.0)
#: Quantiles of an input's magnitude, where it moves, from which a product may begin.
KNOTS = (0.25, 0.5, 0.75)
LEAST_SPREAD = 0.02  #: Standard deviation of an input that can be learned on, in its own unit.
LAGS_S = (0.1, 0.3, 1.0)  #: Lags over which changes of an input are taken.
LEVEL = 0.997  #: Probability with which a term gains at all on groups left out: of seven channels 2 % err.
CHANCE = 9.0  #: Quantile of chi square of one degree of freedom with that probability.
RIDGE = 1e-4  #: Over the square of each product, added to it: products of a dictionary are nearly dependent.
COLLINEAR = 1e-4  #: Part of a product's square that has to be its own, beside those selected.

ORDER = (HEADING, SPEED_X, SPEED_Y, GYRO, ACCEL, CURRENT, TURNING_CURRENT)
"""Channels in the order in which they are learned: sensors see the motion, so that comes first."""


class Learned(NamedTuple):
    """What was learned of one channel."""

    term: LearnedTerm | None  #: None where none is better than none
    #: part of the square, before the causes, that causes and term remove in the inner folds
    inner_gain: float
    reference_gain: float  #: that the black-box reference removes there; NaN where there are too few runs
    #: by run (m,), what the term adds to its rows over what it would without the run's group
    left_out: Mapping[str, Array]


def learn_terms(
    simulation: Simulation,
    signals: Sequence[Signals],
    compared: Sequence[ComparedRun],
    low_pass: LowPass,
    scatter: Array,
    seed: int = 0,
) -> dict[str, Learned]:
    """Return by channel what was learned on runs; of channels that none of them measured nothing.

    What differs from run to run by itself has a mean over few of them, which is no law: of ``n`` runs it takes up
    to ``CHANCE / n`` of its square away, and a term has to gain more.

    Parameters
    ----------
    simulation : with all named causes built in, and what was learned before
    signals, compared : of the runs, faults repaired; and the same beside the simulation before the causes
    scatter : (channels,) of :func:`scatter_square`
    seed : of the groups of the cross-validation, where runs are not of several sessions
    """
    by_id = {run.run_id: run for run in compared}
    runs = [run for run in signals if run.run_id in by_id]
    compared = [by_id[run.run_id] for run in runs]
    groups = groups_of(runs, seed)
    if groups.max(initial=-1) + 1 < MIN_GROUPS:
        return {}
    measured, learned = measured_channels(compared), {}
    steps_inputs = [term_inputs(run, simulation, low_pass) for run in runs]
    every = np.concatenate([inputs for _, inputs in steps_inputs])
    ranges = driven_ranges([inputs for _, inputs in steps_inputs])
    folds = folds_of(runs, groups)
    references = _reference_errors(compared, folds)
    residuals = [left_by(simulation, run, low_pass) for run in runs]
    known: dict[tuple[str, ...], list[Array]] = {}  # of the last dictionary: those of motion are one
    for channel in ORDER:
        # without a heading of its own the gyro shows the motion
        shown = GYRO if channel == HEADING and HEADING not in measured else channel
        if shown not in measured or (channel == GYRO and HEADING not in measured):
            continue
        products, grams, rows = dictionary(every, channel), [], []
        if products not in known:
            known = {products: [columns_of(products, x, np.full(len(x), dt)) for dt, x in steps_inputs]}
        for run, columns, left in zip(runs, known[products], residuals, strict=True):
            seen = term_rows(run, simulation, low_pass, shown, channel, columns)
            rows.append(seen)
            table = np.hstack([seen, left[:, [CHANNELS.index(shown)]]])
            table = table[np.isfinite(table).all(axis=1)]
            grams.append(table.T @ table)
        sums = np.zeros((groups.max() + 1, len(products) + 1, len(products) + 1))
        np.add.at(sums, groups, np.array(grams))
        c = CHANNELS.index(shown)
        before = sum(float(np.nansum(run.residual(False)[:, c] ** 2)) for run in compared)
        there = sums[:, -1, -1] > 0.0
        if there.sum() < MIN_GROUPS or not before > 0.0:
            continue
        group, sums = np.cumsum(there)[groups] - 1, sums[there]  # of a run without the channel, another's
        errors = cross_validated(sums)
        reference = float(references[c])
        n = size_of(errors, (1.0 - ENOUGH) * before + ENOUGH * reference)
        by_chance, gained = CHANCE / len(runs) * float(scatter[c]), errors[:, 0].sum() - errors[:, n].sum()
        n = n if gained > by_chance and left_out_gain(np.array(grams), folds, n) >= ENOUGH * gained else 0
        term, left_out = None, {}
        if n:
            total = sums.sum(axis=0)
            chosen = selected(total, n)
            coefficients, covariance = fitted(sums, chosen)
            names = tuple(products[i] for i in chosen)
            used = region_of_term(names, ranges)
            term = LearnedTerm(channel, names, coefficients, covariance, used)
            added = [term.predict(inputs, np.full(len(inputs), dt))[0] for dt, inputs in steps_inputs]
            term = replace(term, says=where_it_acts(channel, names, np.concatenate(added), every))
            simulation = simulation.with_learned([term])
            residuals = [left_by(simulation, run, low_pass) for run in runs]
            without = [_weights(total - own, n) for own in sums]
            change = [_weights(total, n) - each for each in without]
            left_out = {run.run_id: seen @ change[g] for run, seen, g in zip(runs, rows, group, strict=True)}
        inner_gain, reference_gain = (1.0 - np.array([errors[:, n].sum(), reference]) / before).tolist()
        learned[shown] = Learned(term, inner_gain, reference_gain, left_out)
    return learned


def left_by(simulation: Simulation, run: Signals, low_pass: LowPass) -> Array:
    """Return what a simulation leaves of a run (m, channels), measured minus predicted."""
    return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass).residual


def scatter_square(info: Evidence) -> Array:
    """Return the square (channels,), over all rows, of what differs from run to run by itself."""
    std = info.nuisance_std[:, None, None]
    return np.asarray(
        sum([np.nansum((std * rows.sensitivity[info.nuisances]) ** 2, axis=(0, 1)) for rows in info.rows])
    )


def kept_terms(learned: Mapping[str, Learned]) -> tuple[LearnedTerm, ...]:
    """Return the terms that are built into an extended robot."""
    return tuple([each.term for each in learned.values() if each.term is not None])


class LearnedGain(NamedTuple):
    """What a learned term gains on runs held out, as parts of the square of its channel before."""

    channel: str
    says: str  #: where the term acts, in words
    named_reduction: float  #: that what is built in beside it removes; 0 where nothing is
    reduction: float  #: that both remove
    ci: Interval  #: 95 % interval of what the term adds to that
    learner_reduction: float  #: that the black-box learner removes


def learned_gains(
    learned: Mapping[str, Learned],
    named: Sequence[ComparedRun],
    both: Gain,
    runs: Sequence[ComparedRun],
    seed: int,
) -> tuple[LearnedGain, ...]:
    """Return the gain of each term on runs held out.

    Parameters
    ----------
    named : the runs beside what was named alone, if anything
    both, runs : gain with the terms, and the runs beside both
    seed : of the bootstrap
    """
    gains, others = [], [run if run.after is not None else run._replace(after=run.before) for run in named]
    removed = removed_by(runs, others, np.ones(len(CHANNELS)))
    for shown, each in learned.items():
        if each.term is None or shown not in both.channels:
            continue
        added, ci = removed.gain(np.array([name == shown for name in CHANNELS], dtype=float), seed)
        of = both.channels[shown]
        about = of.reduction - added, of.reduction, ci, of.learner_reduction
        gains.append(LearnedGain(shown, each.term.says, *about))
    return tuple(gains)


def groups_of(runs: Sequence[Signals], seed: int) -> Array:
    """Return the group (runs,) of each run in the cross-validation: its session, or one that is drawn."""
    sessions = sorted({run.session for run in runs})
    if len(sessions) >= MIN_GROUPS:
        return np.array([sessions.index(run.session) for run in runs]) % MAX_GROUPS
    return np.random.default_rng(seed).permutation(len(runs)) % MAX_GROUPS


def folds_of(runs: Sequence[Signals], groups: Array) -> Array:
    """Return the fold (runs,) of each run: its session where there are two, too few to be groups, else of groups."""
    sessions = sorted({run.session for run in runs})
    if len(sessions) == 2:
        return np.array([sessions.index(run.session) for run in runs])
    return groups % REFERENCE_FOLDS


def left_out_gain(grams: Array, folds: Array, n: int) -> float:
    """Return by how much ``n`` products, selected and fitted without them, reduce the square of folds.

    Parameters
    ----------
    grams : (runs, p + 1, p + 1) sums of products of each run, of the residual last
    folds : (runs,)
    """
    total, gain = grams.sum(axis=0), 0.0
    for fold in np.unique(folds):
        own = grams[folds == fold].sum(axis=0)
        x = _weights(total - own, n)
        gain += float(2.0 * x @ own[:-1, -1] - x @ own[:-1, :-1] @ x)
    return gain


def dictionary(inputs: Array, channel: str) -> tuple[str, ...]:
    """Return the products that a term of a channel may have, of inputs (n, len(INPUTS)) that were driven.

    Simpler ones come first: of two that are as good the first is selected.
    """
    motion, shapes, singles = channel in MOTION, {}, ["moving"]
    for name in OF_WHEELS if motion else INPUTS:
        x = inputs[:, INPUTS.index(name)]
        x = x[np.isfinite(x)]
        if not x.size or x.std() < LEAST_SPREAD:
            continue
        shapes[name] = [name, f"abs({name})", f"sign({name})", f"max({name}, 0)", f"max(-{name}, 0)"]
        size = np.abs(x[np.abs(x) > LEAST_SPREAD])
        for knot in np.quantile(size, KNOTS):
            shapes[name] += [f"max({name} - {knot:.2g}, 0)", f"max(-{name} - {knot:.2g}, 0)"]
        singles += [*shapes[name], f"{name} * abs({name})"]
        if name in OF_WHEELS:
            singles += [f"change({name}, {lag_s:g})" for lag_s in LAGS_S]
    pairs = []
    for one, other in combinations(shapes, 2):
        few = 5 if len(shapes) > 2 else None  # hinges in products of two inputs alone
        pairs += [
            f"{a} * {b}"
            for i, a in enumerate(shapes[one])
            for j, b in enumerate(shapes[other])
            if (few is None and (i < 5 or j < 5)) or (i < 5 and j < 5)
        ]
    return tuple(dict.fromkeys([*([] if motion else ["1"]), *singles, *pairs]))


def driven_ranges(runs: Sequence[Array]) -> dict[str, tuple[float, float]]:
    """Return the range of each input that at least two of runs (n, len(INPUTS)) drove."""
    edges = np.array([np.nanpercentile(inputs, PERCENTILES, axis=0) for inputs in runs])
    low, high = np.sort(edges[:, 0], axis=0)[1], np.sort(edges[:, 1], axis=0)[-2]
    high = np.maximum(high, low + LEAST_RANGE)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(INPUTS)}


def region_of_term(
    products: Sequence[str], ranges: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return the region of a term: the ranges of its inputs.

    Where products hold for turns to either side alike, a turn to one side shows what one to the other does.

    Examples
    --------
    >>> region_of_term(["speed_mps * abs(turn_radps)"], {"speed_mps": (0.0, 1.0), "turn_radps": (-0.2, 1.5)})
    {'speed_mps': (0.0, 1.0), 'turn_radps': (-1.5, 1.5)}
    """
    region = {name: ranges[name] for name in inputs_used(products)}
    factors = [factor for product in products for factor in factors_of(product)]
    if "turn_radps" in region and not any(
        each.kind == "max" and each.name == "turn_radps" for each in factors
    ):
        widest = max(map(abs, region["turn_radps"]))
        region["turn_radps"] = (-widest, widest)
    return region


def selected(gram: Array, n: int) -> list[int]:
    """Return the places of the products that are selected one after the other, ``n`` at the most.

    Parameters
    ----------
    gram : (k + 1, k + 1) sums of products of the k products, and of the residual last

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal((50, 3))
    >>> table = np.column_stack([x, 2.0 * x[:, 2] - x[:, 0]])
    >>> selected(table.T @ table, 3)
    [2, 0]
    """
    left, chosen = gram.copy(), []
    own = gram.diagonal()[:-1]
    for _ in range(min(n, len(own))):
        size, shown = left.diagonal()[:-1], left[:-1, -1]
        gains = np.where(size > COLLINEAR * own, shown**2 / np.maximum(size, 1e-300), 0.0)
        best = int(np.argmax(gains))
        if not gains[best] > 1e-12 * gram[-1, -1]:
            break
        chosen.append(best)
        left -= np.outer(left[best], left[best]) / left[best, best]
    return chosen


def _coefficients(gram: Array, chosen: Sequence[int]) -> tuple[Array, Array]:
    """Return coefficients (k,) of selected products, and the inverse (k, k) that they follow from."""
    own = gram[np.ix_(chosen, chosen)]
    inverse = np.linalg.inv(own + RIDGE * np.diag(own.diagonal()))
    return inverse @ gram[list(chosen), -1], inverse


def _weights(gram: Array, n: int) -> Array:
    """Return the coefficients (k,) of all products where the best ``n`` are selected; 0 of the others."""
    weights, chosen = np.zeros(len(gram) - 1), selected(gram, n)
    weights[chosen] = _coefficients(gram, chosen)[0]
    return weights


def fitted(sums: Array, chosen: Sequence[int]) -> tuple[Array, Array]:
    """Return coefficients (k,) of selected products, and their covariance (k, k) by how groups differ.

    Residuals within a run are not independent, so that groups are what scatters (sandwich; Liang and Zeger,
    Biometrika 1986), with the correction for few of them.

    Parameters
    ----------
    sums : (groups, p + 1, p + 1) sums of products by group, of the residual last
    """
    total, n = sums.sum(axis=0), len(sums)
    coefficients, inverse = _coefficients(total, chosen)
    scores = sums[:, list(chosen), -1] - sums[:, list(chosen)][:, :, list(chosen)] @ coefficients
    return coefficients, n / (n - 1) * inverse @ (scores.T @ scores) @ inverse


def cross_validated(sums: Array) -> Array:
    """Return the squared error (groups, sizes) of each group by products that are selected on the others."""
    total, errors = sums.sum(axis=0), np.empty((len(sums), MAX_PRODUCTS + 1))
    for g, own in enumerate(sums):
        order = selected(total - own, MAX_PRODUCTS)
        errors[g] = own[-1, -1]
        for n in range(1, MAX_PRODUCTS + 1):
            chosen = order[:n]
            x = np.append(-_coefficients(total - own, chosen)[0], 1.0)
            places = [*chosen, -1]
            errors[g, n] = x @ own[np.ix_(places, places)] @ x
    return errors


def size_of(errors: Array, enough: float) -> int:
    """Return how many products a term has, by errors (groups, sizes) of the cross-validation.

    Where a few groups have most of the error, those of the fewest within a standard error may not gain clearly, which
    more of them do.
    """
    total, freedom = errors.sum(axis=0), len(errors) - 1
    best = int(np.argmin(total))

    def gains(n: int) -> tuple[Array, Array]:
        """Return what each size has more than ``n`` and its standard error (sizes,), of ratios of sums over groups."""
        apart = errors - errors[:, [n]]
        ratio = apart.sum(axis=0) / total[0]
        scatter = ((apart - ratio * errors[:, [0]]) ** 2).sum(axis=0) * (1.0 + 1.0 / freedom)
        return ratio, np.sqrt(scatter) / total[0]

    def is_clear(n: int) -> bool:
        more, error = gains(n)
        return bool(more[0] > student.ppf(LEVEL, freedom) * error[0])

    more, error = gains(best)
    within = np.flatnonzero(more <= error).tolist()
    if not within[0]:
        return 0
    few = next((n for n in within if is_clear(n)), 0)
    return best if few and total[few] > enough and is_clear(best) else few


def _reference_errors(compared: Sequence[ComparedRun], fold: Array) -> Array:
    """Return the squared error (channels,) of the black-box reference, in folds (runs,)."""
    errors = np.zeros(len(CHANNELS))
    for k in np.unique(fold):
        inside = [run for run, own in zip(compared, fold, strict=True) if own == k]
        others = [run for run, own in zip(compared, fold, strict=True) if own != k]
        for run, predicted in zip(inside, predicted_residuals(others, inside), strict=True):
            errors += np.nansum((run.residual(False) - np.nan_to_num(predicted)) ** 2, axis=0)
    return errors
