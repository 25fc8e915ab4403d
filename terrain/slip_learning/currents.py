r"""Slip from wheel speeds and motor currents alone, learned from runs whose slip was measured from outside.

For each terrain of the training runs, currents and slip of the body are expected together, at the regime of
motion, with one covariance of what is left (:mod:`terrain.classify.response`).  A window's currents
then say two things of its slip: which terrain expects them, by the classifier's probabilities
:math:`p_c` (:mod:`terrain.classify.response`), and, on each, how far slip is from its expectation where the
currents are,

.. math:: \hat s_c = m_{s,c} + S_{sI} S_{II}^{-1} (I - m_{I,c}), \qquad
          v_c = S_{ss} - S_{sI} S_{II}^{-1} S_{Is} .

What is predicted is the mixture: mean :math:`\sum p_c \hat s_c`, variance
:math:`\sum p_c (v_c + \hat s_c^2) - \hat s^2`, and the interval that leaves 2.5 % of it on each side.
Between terrains that currents do not tell apart it spans both.  How well it is predicted is judged on runs, on
regimes and on sessions that were held out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import norm
from sklearn.base import BaseEstimator, RegressorMixin

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.folds import split_runs
from terrain.classify.response import GroupedResponse, ResponseColumns, fit_ground, regimes
from terrain.errors import DataError
from terrain.identify import deal, folds
from terrain.records import Array

TAIL = 0.025  #: Probability on each side of an interval
MIN_RUNS = 3  #: Fewer runs on a terrain do not show how runs differ: it is not learned

_BISECTIONS = 40


class PredictedSlip(NamedTuple):
    """Slip of windows: mean, standard deviation, and 95 % interval, (n,) each; NaN where nothing is known."""

    slip_ratio: Array
    slip_std: Array
    low: Array
    high: Array


class SlipRegressor(RegressorMixin, BaseEstimator):
    """Slip of the body by wheel speeds and responses of the wheels.

    Parameters
    ----------
    columns : :class:`~terrain.classify.response.ResponseColumns` of the matrix

    Attributes
    ----------
    terrains_ : (k,) names; one, empty, where none was given
    """

    def __init__(self, columns: ResponseColumns) -> None:
        self.columns = columns

    def fit(
        self, X: Array, y: Array, terrain: Array | None = None, groups: Array | None = None
    ) -> SlipRegressor:
        """Learn currents and slip of each terrain.

        Parameters
        ----------
        X : (n, columns) wheel speeds and responses, NaN where missing
        y : (n,) measured slip; windows where it is NaN are not used
        terrain : (n,) names; without any, all windows are of one; of fewer than :data:`MIN_RUNS` runs it is not learned
        groups : (n,) run of each window

        Raises
        ------
        DataError
            if no window has a slip and all its responses, or no terrain has enough runs.
        """
        terrain = np.full(len(y), "") if terrain is None else np.asarray(terrain).astype(str)
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        n_wheels = self.columns.n_wheels
        usable = np.isfinite(y) & np.isfinite(X).all(axis=1)
        usable &= np.linalg.norm(np.nan_to_num(X[:, :n_wheels]), axis=1) > 0.0
        if not usable.any():
            raise DataError("no window has a measured slip beside all its wheel speeds and responses")
        names = np.unique(np.column_stack([terrain, groups.astype(str)])[usable], axis=0)[:, 0]
        usable &= np.isin(terrain, [name for name in set(names) if (names == name).sum() >= MIN_RUNS])
        if not usable.any():
            raise DataError(
                f"no terrain has {MIN_RUNS} runs with a slip in steady motion, the least that show how runs differ"
            )
        X, y, terrain, groups = X[usable], y[usable], terrain[usable], groups[usable]
        self.terrains_, self.classifier_ = np.unique(terrain), None
        self.fastest_mps_ = float(np.linalg.norm(X[:, :n_wheels], axis=1).max())
        if len(self.terrains_) > 1:
            self.classifier_ = GroupedResponse(self.columns).fit(X, terrain, groups, y[:, None])
            self.grounds_ = self.classifier_.grounds_
        else:
            regime, both = regimes(X[:, :n_wheels], self.fastest_mps_), np.column_stack([X[:, n_wheels:], y])
            self.grounds_ = (fit_ground(regime, both, groups, n_body=1)[0],)
        return self

    def predict(self, X: Array) -> Array:
        """Return the expected slip (n,)."""
        return self.predict_slip(X).slip_ratio

    def predict_slip(self, X: Array) -> PredictedSlip:
        """Return the slip of windows with its interval; NaN where the robot stands or a wheel speed lacks."""
        n_wheels = self.columns.n_wheels
        speed, responses = np.split(X, [n_wheels], axis=1)
        known = np.isfinite(speed).all(axis=1) & (np.linalg.norm(np.nan_to_num(speed), axis=1) > 0.0)
        out, rows = np.full((4, len(X)), np.nan), np.flatnonzero(known)
        if rows.size:
            weight = np.ones((rows.size, 1))
            if self.classifier_ is not None:
                weight = self.classifier_.predict_proba(X[rows])
            regime = regimes(speed[rows], self.fastest_mps_)
            parts = [
                _given(ground.expected(regime), ground.covariance, responses[rows])
                for ground in self.grounds_
            ]
            mean, variance = (np.column_stack(part) for part in zip(*parts, strict=True))
            slip = (weight * mean).sum(axis=1)
            std = np.sqrt((weight * (variance + mean**2)).sum(axis=1) - slip**2)
            # the quantiles of the mixtures, by bisection
            each, probability = np.sqrt(variance), np.array([[TAIL], [1.0 - TAIL]])
            low, high = (mean - 8.0 * each).min(axis=1), (mean + 8.0 * each).max(axis=1)
            for _ in range(_BISECTIONS):
                middle = (low + high) / 2
                within = norm.cdf((middle[..., None] - mean) / each)
                below = (weight * within).sum(axis=-1) < probability
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            out[:, rows] = slip, std, *((low + high) / 2)
        return PredictedSlip(*out)


def _given(expected: Array, covariance: Array, responses: Array) -> tuple[Array, Array]:
    """Return mean and variance (n,) of the last of jointly normal numbers, by those of the others known."""
    mean, variance = expected[:, -1].copy(), np.full(len(expected), covariance[-1, -1])
    apart = responses - expected[:, :-1]
    known = np.isfinite(apart)
    for pattern in np.unique(known, axis=0):
        rows = (known == pattern).all(axis=1)
        if pattern.any():
            slope = np.linalg.solve(
                covariance[:-1, :-1][np.ix_(pattern, pattern)], covariance[:-1, -1][pattern]
            )
            mean[rows] += apart[rows][:, pattern] @ slope
            variance[rows] -= covariance[:-1, -1][pattern] @ slope
    return mean, variance


N_FOLDS = 5
N_DRAWS = 1000


@dataclass(frozen=True, slots=True)
class PredictionFigures:
    """How well slip is predicted, without any measurement from outside."""

    #: what is on the other side of each split: ``runs``, ``regimes`` (speeds and directions), or the name of what was
    #: never trained on
    held_out: str
    n_runs: int  #: n_runs, n_windows: that were predicted
    n_windows: int
    #: rms, rms_interval: error of the slip of the body, and its 95 % interval over sessions, or over the runs of one
    rms: float
    rms_interval: tuple[float, float]
    bias: float  #: mean error
    coverage: float  #: ratio of windows whose slip is inside the 95 % interval of its prediction
    width: float  #: median width of these intervals
    by_terrain: Mapping[str, float]  #: rms error on each terrain


class Cases(NamedTuple):
    """Windows with their measured slip, and what predicts it."""

    matrix: Array  #: (n, columns) means of wheel speeds and currents
    columns: ResponseColumns  #: of the matrix
    slip: Array  #: (n,) measured, of the body
    run_id: Array  #: run_id, terrain, session, regime: (n,) of each window
    terrain: Array
    session: Array
    regime: Array

    def at(self, rows: Array) -> Cases:
        """Return some of the windows."""
        return self._replace(
            **{name: getattr(self, name)[rows] for name in self._fields if name != "columns"}
        )


def predictions(
    cases: Cases,
    hold_out: Sequence[str],
    seed: int,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> list[PredictionFigures]:
    """Return how well slip is predicted on runs, on regimes, and on what was never trained on.

    Raises
    ------
    DataError
        if a session to hold out is not there, or fewer than :data:`N_FOLDS` runs are labelled.
    """
    unknown = [name for name in hold_out if name not in cases.session]
    if unknown:
        raise DataError(f"there is no session {unknown[0]!r} to hold out")
    training = (cases.terrain != "") & ~np.isin(cases.session, hold_out)
    usual = cases.at(np.flatnonzero(training))
    if len(np.unique(usual.run_id)) < N_FOLDS:
        raise DataError(f"{len(np.unique(usual.run_id))} labelled runs are fewer than {N_FOLDS} folds")
    found = []
    for number, (name, group) in enumerate((("runs", usual.run_id), ("regimes", usual.regime))):
        if len(np.unique(group)) < N_FOLDS:
            continue
        predicted = np.full((4, len(usual.slip)), np.nan)
        rng = np.random.default_rng((seed, number))
        if len(np.unique(usual.terrain)) > 1:
            parts = split_runs(usual.terrain, group, N_FOLDS, rng)
        else:
            parts = folds(deal(group, N_FOLDS, rng))
        for done, (train, test) in enumerate(parts, start=1):
            predicted[:, test] = _fitted(usual.at(train)).predict_slip(usual.matrix[test])
            progress(f"predict by {name}", done, N_FOLDS)
        found.append(_figures(name, usual, PredictedSlip(*predicted), rng))
    rest = cases.at(np.flatnonzero(~training))
    if len(rest.slip):
        fitted = _fitted(usual)
        for session in np.unique(rest.session):
            part = rest.at(np.flatnonzero(rest.session == session))
            rng = np.random.default_rng((seed, 9))
            found.append(
                _figures(session or "runs without a label", part, fitted.predict_slip(part.matrix), rng)
            )
    return found


def _fitted(cases: Cases) -> SlipRegressor:
    return SlipRegressor(cases.columns).fit(cases.matrix, cases.slip, cases.terrain, cases.run_id)


def _figures(
    name: str, cases: Cases, predicted: PredictedSlip, rng: np.random.Generator
) -> PredictionFigures:
    known = np.isfinite(predicted.slip_ratio)
    error = (predicted.slip_ratio - cases.slip)[known]
    inside = ((cases.slip >= predicted.low) & (cases.slip <= predicted.high))[known]
    run, session, terrain = cases.run_id[known], cases.session[known], cases.terrain[known]
    unit = np.unique(session if len(np.unique(session)) > 1 else run, return_inverse=True)[1]
    squares, counts = np.bincount(unit, error**2), np.bincount(unit)
    interval = (np.nan, np.nan)
    if len(counts) > 1:
        rows = bootstrap_rows(len(counts), N_DRAWS, rng)
        rms = np.sqrt(squares[rows].sum(axis=1) / counts[rows].sum(axis=1))
        interval = percentile_interval(rms, freedom=len(counts) - 1, ends=(0.0, np.inf))
    return PredictionFigures(
        held_out=name,
        n_runs=len(np.unique(run)),
        n_windows=len(error),
        rms=float(np.sqrt(np.mean(error**2))),
        rms_interval=interval,
        bias=float(error.mean()),
        coverage=float(inside.mean()),
        width=float(np.median((predicted.high - predicted.low)[known])),
        by_terrain={
            str(each): float(np.sqrt(np.mean(error[terrain == each] ** 2)))
            for each in np.unique(terrain)
            if each
        },
    )
