"""Constant offsets of sensors that no bias of the catalogue reaches: sensors not zeroed, or turned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.common import MIN_FAULTY_RATIO
from terrain.discrepancy.health.faults import LOGGED, Change, Column, Fault, FaultKind, in_runs
from terrain.discrepancy.health.response import LEAST, A, G, H, Response, X

LARGEST: dict[Column, tuple[int, float, str]] = {
    Column.GYRO: (G, 0.3, "rad/s"),
    Column.HEADING: (H, 0.3, "rad/s"),
    Column.SPEED: (X, 0.3, "m/s"),
    Column.ACCEL: (A, 3.0, "m/s^2"),
}
"""Channel, offset and unit: half more than the bounds of the catalogue's biases, and for a heading rate and a
speed, which have none, as much and a slow robot's speed."""

SIGMAS = 4.0
"""An offset is over the largest by so many standard deviations."""

MIN_ROWS = 10


def offset_faults(responses: Sequence[Response]) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, in all runs or in some of them."""
    every = [run.run_id for run in responses]
    found = []
    for column, (c, largest, unit) in LARGEST.items():
        offsets = np.array([_offset(run, c) for run in responses])
        has = np.flatnonzero(np.abs(offsets[:, 0]) > largest + SIGMAS * offsets[:, 1])
        if has.size < max(MIN_FAULTY_RATIO * np.isfinite(offsets[:, 0]).sum(), 1):
            continue
        offset = float(np.median(offsets[has, 0]))
        ids = tuple(every[i] for i in has)
        what = f"the {column.value} has an offset of {offset:.3g} {unit} {in_runs(ids, every)}"
        logged = LOGGED[column].split(" and ")[0]
        repair = f"subtract {offset:.3g} {unit} from {logged} (mapping file: offset: {-offset:.3g})"
        sentence = f"{what}, where a sensor's is below {largest:g}; {repair}"
        change = Change(FaultKind.OFFSET, column, offset=-offset)
        found.append(Fault(FaultKind.OFFSET, column, ids, 1.0, sentence, repair, change))
    return tuple(found)


def _offset(run: Response, c: int) -> tuple[float, float]:
    """Return what a channel measures where nothing is predicted, and its error; NaN if unknown."""
    known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
    if known.sum() < MIN_ROWS:
        return np.nan, np.nan
    measured, predicted = run.measured[known, c], run.predicted[known, c]
    if np.std(predicted) < LEAST[c] and np.sqrt(np.mean(predicted**2)) > LEAST[c]:
        return np.nan, np.nan  # of one motion throughout, a gain looks the same
    columns = [np.ones(measured.size)]
    if np.std(predicted) > LEAST[c]:
        columns.append(predicted)
    basis = np.column_stack(columns)
    value, *_ = np.linalg.lstsq(basis, measured, rcond=None)
    left = measured - basis @ value
    n_independent = max(measured.size * min(run.period_s, 1.0), 1.0)  # what is left changes within seconds
    spread = np.linalg.inv(basis.T @ basis / measured.size)[0, 0] / n_independent
    return float(value[0]), float(np.std(left) * np.sqrt(spread))
