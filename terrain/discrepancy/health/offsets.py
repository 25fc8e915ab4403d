"""Zeros of sensors: offsets that no bias of the catalogue reaches, of sensors not zeroed, and zeros that drift."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.agreement import LEAST, G, H
from terrain.discrepancy.health.fault import KINDS, Change, Column, Fault, FaultKind, FaultStatus, fault_of
from terrain.discrepancy.health.sessions import faulty_runs, halves
from terrain.discrepancy.runs import Rows
from terrain.records import Array
from terrain.robots import Robot

OFFSET_SIGMAS = 4.0  #: An offset is over the largest by so many standard deviations.
MIN_ROWS = 10
#: A constant is identified only where the prediction comes so near to zero, over its range: beyond, it is that of the
#: gain.
NEAR_ZERO = 0.1
SAME_RATIO = 0.25  #: Offsets of two halves of the runs differ by less, relative.
WITNESS = {G: H, H: G}  #: Channel that measures the same motion: what it has too is no offset of a sensor.


def offset_faults(runs: Sequence[Rows], sessions: Sequence[str], robot: Robot) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, of sessions or of successive runs of one.

    It is what a channel measures where nothing is predicted.  It is within the range of what was measured, it is the
    same in two halves of the runs, and no channel of the same motion has it.
    """
    faults, ids = [], [run.run_id for run in runs]
    for column, kind in KINDS.items():
        if not math.isfinite(kind.largest):
            continue
        c = kind.channels[0]
        constants = np.array([constant_of(run, c) for run in runs])
        value, std = constants.T
        far = np.abs(value) > kind.largest + OFFSET_SIGMAS * std
        if c in WITNESS:
            other = np.array([constant_of(run, WITNESS[c])[0] for run in runs])
            far &= ~(np.abs(other - value) < 0.5 * np.abs(value))
        has = faulty_runs(sessions, np.where(np.isfinite(value), np.where(far, 1, -1), 0))
        shown = [i for i in has if far[i]]
        parts = [float(np.median(value[part])) if part else math.nan for part in halves(shown)]
        if not shown or abs(parts[1] - parts[0]) > SAME_RATIO * abs(parts[0]):
            continue
        change = Change(FaultKind.OFFSET, column, offset=-float(np.median(value[shown])))
        fault = fault_of(change, has, ids, f", where a sensor's is below {kind.largest:g}", robot)
        confirmed = FaultStatus.CONFIRMED if len(shown) > 1 else FaultStatus.NOT_CONFIRMED
        faults.append(fault._replace(status=confirmed))
    return tuple(faults)


#: A zero drifts by that over a run, in the unit of the column, and by so many standard deviations; in runs that
#: contradict it does so by less than half, to an error of a third.
DRIFTS = {Column.GYRO: 0.05, Column.ACCEL: 0.5}
DRIFT_SIGMAS = 6.0


def drift_faults(runs: Sequence[Rows], sessions: Sequence[str], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose zero drifts along runs, by the same rate in two halves of them, and no channel beside it."""
    faults, ids = [], [run.run_id for run in runs]
    for column, least in DRIFTS.items():
        c = KINDS[column].channels[0]
        rate, std, other = (np.array(each) for each in zip(*(_drift_of(run, c) for run in runs), strict=True))
        last_s = np.array([run.time_s[-1] - run.time_s[0] if run.time_s.size else 0.0 for run in runs])
        clear = (np.abs(rate) > DRIFT_SIGMAS * std) & ~(np.abs(other - rate) < 0.5 * np.abs(rate))
        shows = clear & (np.abs(rate) * last_s > least)
        against = (std * last_s < least / 3) & (np.abs(rate) * last_s < least / 2)
        has = faulty_runs(sessions, np.where(shows, 1, np.where(against, -1, 0)))
        shown = [i for i in has if shows[i]]
        if len(shown) < 2:
            continue
        middle = [float(np.median(rate[part])) for part in halves(shown)]
        if abs(middle[1] - middle[0]) > SAME_RATIO * abs(middle[0]):
            continue
        change = Change(FaultKind.DRIFT, column, drift=-float(np.median(rate[shown])))
        faults.append(fault_of(change, has, ids, "", robot))
    return tuple(faults)


def _drift_of(run: Rows, channel: int) -> tuple[float, float, float]:
    """Return the rate of a channel's zero, its standard deviation, and that of the channel of the same motion."""
    found: list[tuple[float, float]] = []
    for c in (channel, WITNESS.get(channel, channel)):
        known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
        measured, predicted = run.measured[known, c], run.predicted[known, c]
        if known.sum() < MIN_ROWS:
            return (*(found or [(math.nan, math.nan)])[0], math.nan)
        time_s = run.time_s[known] - run.time_s[known].mean()
        found.append(_first_of_fit([time_s, np.ones(measured.size)], predicted, measured, c, run.period_s))
    return *found[0], found[1][0] if channel in WITNESS else math.nan


def constant_of(run: Rows, channel: int) -> tuple[float, float]:
    """Return what a channel measures where nothing is predicted, and its standard deviation.

    They are NaN where the prediction does not come near zero, or where the constant is out of the range of what was
    measured: then it is an extrapolation.
    """
    known = np.isfinite(run.measured[:, channel]) & np.isfinite(run.predicted[:, channel])
    measured, predicted = run.measured[known, channel], run.predicted[known, channel]
    if known.sum() < MIN_ROWS:
        return math.nan, math.nan
    low, high = float(predicted.min()), float(predicted.max())
    margin = NEAR_ZERO * (high - low) + LEAST[channel]
    if low > margin or high < -margin:
        return math.nan, math.nan
    value, std = _first_of_fit([np.ones(measured.size)], predicted, measured, channel, run.period_s)
    return (value, std) if measured.min() <= value <= measured.max() else (math.nan, math.nan)


def _first_of_fit(
    columns: list[Array], predicted: Array, measured: Array, channel: int, period_s: float
) -> tuple[float, float]:
    """Return the coefficient of the first column, fitted beside a gain where the prediction varies, and its error."""
    varies = np.std(predicted) > LEAST[channel]
    basis = np.column_stack([*columns, *([predicted] if varies else [])])
    fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
    n_independent = max(measured.size * min(period_s, 1.0), 1.0)  # what is left changes within seconds
    spread = np.linalg.pinv(basis.T @ basis / measured.size)[0, 0] / n_independent
    return float(fit[0]), float(np.std(measured - basis @ fit) * np.sqrt(spread))
