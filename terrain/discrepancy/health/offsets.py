"""Zeros and scales of sensors beyond those of the catalogue: sensors not zeroed, zeros that drift, a gyro's scale.

Where a second channel measures the same motion, it is the witness: what the wheels make of the body, and what ground
and slip do to it, is in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.agreement import (
    LARGEST,
    LEAST,
    MIN_ROWS,
    OFFSET_SIGMAS,
    G,
    H,
    agreement_of,
    first_of_fit,
    joined,
    zero_of,
)
from terrain.discrepancy.health.fault import KINDS, Change, Column, Fault, FaultKind, FaultStatus, fault_of
from terrain.discrepancy.health.response import FOLLOWS
from terrain.discrepancy.health.sessions import faulty_runs, halves
from terrain.discrepancy.runs import Rows
from terrain.effects import PARAMETER
from terrain.records import Array
from terrain.robots import Robot

SAME_RATIO = 0.25  #: Offsets of two halves of the runs differ by less, relative.
#: An offset is that of all runs if so many of those that measure its column show it.
MIN_SHOWN_RATIO = 1 / 3
MIN_BESIDE = 5  #: Samples of a run in which its witness is known, at the least.
MIN_SHOWN = 6  #: Runs that show a scale, at the least.
WITNESS = {G: H, H: G}  #: Channel that measures the same motion: what it has too is no offset of a sensor.


def offset_faults(runs: Sequence[Rows], sessions: Sequence[str], robot: Robot) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, of sessions or of successive runs of one.

    It is what a channel measures beside one of the same motion, or where nothing is predicted.  It is within the range
    of what was measured, and the same in two halves of the runs.
    """
    faults, ids, ratio = [], [run.run_id for run in runs], _common_ratio(runs)
    columns = {kind.channels[0]: column for column, kind in KINDS.items() if kind.channels}
    for c, largest in LARGEST.items():
        column = columns[c]
        constants = np.array([_zero_beside(run, c, ratio) for run in runs])
        value, std = constants.T
        far = np.abs(value) > largest + OFFSET_SIGMAS * std
        if c in WITNESS:
            # of the two, that whose zero the wheels do not have either; a heading is an angle, whose rate has none
            own, its = (abs(zero_of(joined(runs), each)[0]) for each in (c, WITNESS[c]))
            far &= c == G if math.isnan(own - its) else own > its
        against = ~far & (OFFSET_SIGMAS * std < largest)
        has = faulty_runs(sessions, np.where(far, 1, np.where(against, -1, 0)))
        shown = [i for i in has if far[i]]
        if len(shown) < MIN_SHOWN_RATIO * sum(np.isfinite(runs[i].measured[:, c]).any() for i in has):
            continue  # a run or two of many are of a body that slides
        parts = [float(np.median(value[part])) if part else math.nan for part in halves(shown)]
        if not shown or abs(parts[1] - parts[0]) > SAME_RATIO * abs(parts[0]):
            continue
        change = Change(FaultKind.OFFSET, column, offset=-float(np.median(value[shown])))
        fault = fault_of(change, has, ids, f", where a sensor's is below {largest:g}", robot)
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
        found.append(first_of_fit([time_s, np.ones(measured.size)], predicted, measured, c, run.period_s))
    return *found[0], found[1][0] if channel in WITNESS else math.nan


def drifting_zeros(runs: Sequence[Rows], robot: Robot) -> tuple[Fault, ...]:
    """Return the gyro where its zero, beside the heading, drifts from the first run to the last, and in two halves."""
    ratio, column, ids = _common_ratio(runs), Column.GYRO, [run.run_id for run in runs]
    zero = np.array([_beside_witness(run, G, ratio)[0] for run in runs])
    known, fits = np.flatnonzero(np.isfinite(zero)), []
    for part in map(np.asarray, (known, *halves(known.tolist()))):
        if len(part) < MIN_ROWS:
            return ()
        place = part - part.mean()
        slope = float(place @ zero[part] / (place @ place))
        left = zero[part] - zero[part].mean() - slope * place
        fits.append((slope, float(np.std(left) / np.linalg.norm(place))))
    (slope, std), *parts = fits
    alike = abs(parts[1][0] - parts[0][0]) <= SAME_RATIO * abs(slope)
    if not (alike and abs(slope) > DRIFT_SIGMAS * std and abs(slope) * np.ptp(known) > DRIFTS[column]):
        return ()
    first = float(np.mean(zero[known]) - slope * known.mean())
    change = Change(FaultKind.DRIFT, column, offset=-first, over_runs=-slope)
    seen = f": from {first:.2g} to {first + slope * (len(runs) - 1):.2g} rad/s beside the heading rate"
    return (fault_of(change, range(len(runs)), ids, seen, robot),)


def scale_faults(runs: Sequence[Rows], sessions: Sequence[str], robot: Robot) -> tuple[Fault, ...]:
    """Return the gyro where it reads a multiple of the heading rate that no scale of a sensor reaches.

    A heading is an angle, which closes after a turn, so that its rate has no scale of its own.
    """
    ratio, ids = np.log(_ratios(runs)), [run.run_id for run in runs]
    low, high = np.log1p(PARAMETER["gyro_scale_ratio"].plausible)
    beyond = np.maximum(ratio - high, low - ratio)
    has = faulty_runs(sessions, np.where(np.isfinite(ratio), np.where(beyond > 0, 1, -1), 0))
    shown = [i for i in has if np.isfinite(ratio[i])]
    if len(shown) < MIN_SHOWN:
        return ()
    middle = float(np.median(ratio[shown]))
    error = 1.48 * float(np.median(np.abs(ratio[shown] - middle))) / math.sqrt(len(shown))
    parts = [float(np.median(ratio[part])) for part in halves(shown)]
    same = abs(parts[1] - parts[0]) <= SAME_RATIO * abs(middle)
    if not (same and max(middle - high, low - middle) > OFFSET_SIGMAS * error):
        return ()
    change = Change(FaultKind.SCALE, Column.GYRO, math.exp(-middle))
    ends = " to ".join(f"{math.expm1(end):+.0%}" for end in (low, high))
    seen = f": {math.exp(middle):.3g} times the heading rate, where a sensor is within {ends}"
    return (fault_of(change, has, ids, seen, robot),)


def _ratios(runs: Sequence[Rows]) -> Array:
    """Return the gyro over the heading rate (runs,) by their gains over what the wheels predict; NaN where unknown."""
    follows = agreement_of(runs)
    gain, both = follows.gain[:, [G, H]], (follows.correlation[:, [G, H]] > FOLLOWS).all(axis=1)
    return np.where(both, gain[:, 0] / np.where(both, gain[:, 1], 1.0), np.nan)


def _common_ratio(runs: Sequence[Rows]) -> float:
    """Return the gyro over the heading rate of all runs, beside a zero; 1 where they do not turn."""
    gyro, heading = joined(runs).measured[:, [G, H]].T
    known = np.isfinite(gyro - heading)
    if known.sum() < MIN_ROWS or np.std(heading[known]) < LEAST[H]:
        return 1.0
    return float(np.polyfit(heading[known], gyro[known], 1)[0])


def _beside_witness(run: Rows, channel: int, ratio: float) -> tuple[float, float]:
    """Return the zero of a channel beside the one of the same motion, gyro over heading at a ratio, and its error."""
    gyro, heading = run.measured[:, [G, H]].T
    apart = (gyro - ratio * heading)[np.isfinite(gyro - heading)]
    if channel not in WITNESS or apart.size < MIN_BESIDE:
        return math.nan, math.nan
    std = float(np.std(apart)) / math.sqrt(max(apart.size * min(run.period_s, 1.0), 1.0))
    return float(apart.mean()) * (1.0 if channel == G else -1.0 / ratio), std


def _zero_beside(run: Rows, channel: int, ratio: float) -> tuple[float, float]:
    """Return the zero of a channel and its error, beside its witness where there is one, else beside the wheels."""
    beside = _beside_witness(run, channel, ratio)
    return beside if math.isfinite(beside[0]) else zero_of(run, channel)
