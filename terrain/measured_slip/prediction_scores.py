"""How well slip is predicted from currents and wheel speeds alone, on runs that were held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.folds import split_runs
from terrain.classify.response import ResponseColumns
from terrain.errors import DataError
from terrain.measured_slip.predict import PredictedSlip, SlipRegressor
from terrain.records import Array

N_FOLDS = 5
N_DRAWS = 1000


@dataclass(frozen=True, slots=True)
class PredictionFigures:
    """How well slip is predicted, without any measurement from outside.

    Parameters
    ----------
    held_out : what is on the other side of each split: ``runs``, ``regimes`` (speeds and directions), or
        the name of what was never trained on
    n_runs, n_windows : that were predicted
    rms, rms_interval : error of the slip of the body, and its 95 % interval over runs
    bias : mean error
    coverage : ratio of windows whose slip is inside the 95 % interval of its prediction
    width : median width of these intervals
    by_terrain : rms error on each terrain
    """

    held_out: str
    n_runs: int
    n_windows: int
    rms: float
    rms_interval: tuple[float, float]
    bias: float
    coverage: float
    width: float
    by_terrain: Mapping[str, float]


class Cases(NamedTuple):
    """Windows with their measured slip, and what predicts it.

    Parameters
    ----------
    matrix : (n, columns) means of wheel speeds and currents
    columns : of the matrix
    slip : (n,) measured, of the body
    run_id, terrain, session, regime : (n,) of each window
    """

    matrix: Array
    columns: ResponseColumns
    slip: Array
    run_id: Array
    terrain: Array
    session: Array
    regime: Array

    def at(self, rows: Array) -> Cases:
        """Return some of the windows."""
        return Cases(
            self.matrix[rows],
            self.columns,
            *(getattr(self, name)[rows] for name in ("slip", "run_id", "terrain", "session", "regime")),
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
        for done, (train, test) in enumerate(_folds(usual.terrain, group, rng), start=1):
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


def _folds(terrain: Array, group: Array, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    if len(np.unique(terrain)) > 1:
        return list(split_runs(terrain, group, N_FOLDS, rng))
    names = rng.permutation(np.unique(group))
    fold = {name: i % N_FOLDS for i, name in enumerate(names)}
    number = np.array([fold[name] for name in group])
    return [(np.flatnonzero(number != k), np.flatnonzero(number == k)) for k in range(N_FOLDS)]


def _fitted(cases: Cases) -> SlipRegressor:
    return SlipRegressor(cases.columns).fit(cases.matrix, cases.slip, cases.terrain, cases.run_id)


def _figures(
    name: str, cases: Cases, predicted: PredictedSlip, rng: np.random.Generator
) -> PredictionFigures:
    known = np.isfinite(predicted.slip_ratio)
    error = (predicted.slip_ratio - cases.slip)[known]
    inside = ((cases.slip >= predicted.low) & (cases.slip <= predicted.high))[known]
    run, terrain = cases.run_id[known], cases.terrain[known]
    names, run_of = np.unique(run, return_inverse=True)
    squares, counts = np.bincount(run_of, error**2), np.bincount(run_of)
    interval = (np.nan, np.nan)
    if len(names) > 1:
        rows = bootstrap_rows(len(names), N_DRAWS, rng)
        interval = percentile_interval(np.sqrt(squares[rows].sum(axis=1) / counts[rows].sum(axis=1)))
    return PredictionFigures(
        held_out=name,
        n_runs=len(names),
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
