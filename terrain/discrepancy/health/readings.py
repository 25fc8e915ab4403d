"""Signs that are turned and columns that are exchanged, found by what makes all channels of a run agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.health.agreement import FOLLOWERS, LEAST, MOTION, Agreement, H, joined
from terrain.discrepancy.health.fault import (
    KINDS,
    Change,
    Changes,
    Column,
    Fault,
    FaultKind,
    FaultStatus,
    change_in_words,
    fault_of,
)
from terrain.discrepancy.health.sessions import faulty_runs, halves
from terrain.discrepancy.runs import Rows
from terrain.records import Array
from terrain.robots import Robot
from terrain.signals import agreement

# Every reading of a run that is one fault away is tried: a change of its measured channels, or of its wheels,
# which are then simulated again.  Under the right one all channels follow the wheels, each with a gain above
# zero; the likelihood that a reading gains is summed over the runs that it mends.

#: A channel does not follow the wheels below the first correlation about zero, and does over the second.  Of measured
#: runs, those that slip hardly fall below 0.8.
TURNED, RIGHT = 0.3, 0.7
#: A channel that half follows the wheels, as one wheel's do, is mended if its correlation rises by the first and to
#: over the second.
RISE, CLEAR = 0.25, 0.95

LOSS = 0.1  #: Largest loss of correlation of any other channel under a reading that mends one.
#: Twice the log-likelihood that a reading has to gain in a run: odds of e^10, over a score of readings and hundreds
#: of runs.
GAIN = 20.0
#: Readings whose gains differ by less, or by less than that ratio, cannot be distinguished.
TIE, TIE_RATIO = 10.0, 0.03
#: Ratio to the runs that a reading mends, of those of its sessions that another does and it does not.
MAX_OTHER_RATIO = 0.25
MIN_MENDED_RATIO = 0.8  #: Ratio of the runs that a reading has to mend, to be as good as another.

WORDS = (
    *("gyro", "speed", "lateral speed", "accelerometer"),
    *("sum of the currents", "difference of the currents", "heading rate"),
)


class Reading(NamedTuple):
    """What a change makes of runs."""

    change: Change  #: tried
    correlation: Array  #: (runs, channels) under it
    gain: Array  #: (runs,) of twice the log-likelihood
    mends: Array  #: (runs,) whether a channel follows the wheels that did not, and none is worse
    #: (runs,) whether the gain is as clear and none is worse; a channel may have followed before
    suits: Array


def candidate_changes(robot: Robot) -> Changes:
    """Return the signs and exchanges that are tried, those of fewest columns first."""
    sign, swapped, n_wheels = FaultKind.SIGN, FaultKind.SWAPPED, len(robot.rate_channels)
    single = (Column.GYRO, Column.HEADING, Column.SPEED, Column.ACCEL, Column.CURRENTS)
    changes = [*(Change(sign, column, -1.0) for column in single), Change(swapped, Column.SPEED)]
    if robot.skids:
        changes += [Change(swapped, column) for column in (Column.CURRENTS, Column.WHEELS, Column.SIDES)]
    else:
        changes += [Change(swapped, Column.WHEELS, pair=pair) for pair in combinations(range(n_wheels), 2)]
    for column, z in ((Column.GYRO, 2), (Column.ACCEL, 3)):
        others = [axis for axis in range(3 * (z // 3), 3 * (z // 3) + 3) if axis != z]
        changes += [
            Change(FaultKind.AXES, column, turn, axis=axis) for axis in others for turn in (1.0, -1.0)
        ]
    each = range(n_wheels) if n_wheels > 1 else ()
    return (*changes, *(Change(sign, Column.WHEELS, -1.0, wheel) for wheel in (-1, *each)))


def reading_of(change: Change, before: Agreement, after: Agreement) -> Reading:
    """Return what a change makes of runs."""
    old, new = before.correlation[:, FOLLOWERS], after.correlation[:, FOLLOWERS]
    gain = after.likelihood.sum(axis=1) - before.likelihood.sum(axis=1)
    turned = (old < TURNED) & (new > RIGHT)
    asked = old != 0.0  # what a run does not show cannot be wrong in it
    mended = (asked & (turned | ((new - old > RISE) & (new > CLEAR)))).any(axis=1)
    worse = ((new < old - LOSS) & (old > RIGHT)).any(axis=1)
    suits = ~worse & (gain > GAIN)
    # under the right reading nothing is predicted to move that rests, and what is turned may be another fault
    motion = after.correlation[:, MOTION]
    dead = ((motion != 0.0) & (np.abs(motion) < TURNED)).any(axis=1)
    return Reading(change, after.correlation, gain, mended & suits & ~dead, suits)


def turned_fault(
    before: Agreement,
    tried: Callable[[Change, Sequence[int]], Reading],
    runs: Sequence[Rows],
    sessions: Sequence[str],
    robot: Robot,
) -> Fault | None:
    """Return the sign or exchange that mends most, or None if there is none.

    It is the reading that gains most over the runs that it mends, of those that whole sessions or successive runs have,
    and that two halves of these runs find each by itself.  Readings that are as good on the same runs are mirror
    images, left for right or ahead for back: no channel tells which it is, and the diagnosis is that of either but for
    the side.  Where a sign shows in the level of one steady motion only, an offset is as good.
    """
    ids, fit = [run.run_id for run in runs], before.correlation[:, FOLLOWERS]
    suspects = np.flatnonzero(((fit != 0.0) & (fit < RIGHT)).any(axis=1)).tolist()
    readings = [tried(change, suspects) for change in candidate_changes(robot)] if suspects else []
    readings = [reading for reading in readings if reading.mends.any()]
    for first in sorted(readings, key=lambda reading: -float(reading.gain[reading.mends].sum())):
        change, *rivals = _equal_readings(readings, np.flatnonzero(first.mends).tolist()) or [first.change]
        best = tried(change, range(len(ids)))
        votes = np.where(best.suits, 1, np.where(best.gain < -GAIN, -1, 0))
        has = faulty_runs(sessions, votes)
        shown = [i for i in has if best.mends[i]]
        if not shown:
            continue
        parts, equal = halves(shown), {change, *rivals}
        # of runs in which it gains nothing another reading gains in many: then neither is that of the session
        own = {sessions[i] for i in has}
        left = [i for i in range(len(ids)) if sessions[i] in own and not best.gain[i] > GAIN]
        others = [each.change for each in readings if left and each.change not in equal]
        if any(tried(each, left).suits[left].sum() > MAX_OTHER_RATIO * len(shown) for each in others):
            continue
        rest = halves([i for i in has if i not in shown])
        if parts[1] and not all(
            equal & {*_equal_readings(readings, part)}
            or _is_best(best, readings, tried, part, [*part, *more])
            for part, more in zip(parts, rest, strict=True)
        ):
            continue
        offset = _offset_for_sign(change, [runs[i] for i in shown])
        if (
            offset is not None and not offset.offset
        ):  # the channel follows about its mean, with the sign that it has
            continue
        seen = _evidence(before, best, shown)
        if offset is not None:
            seen += (
                f" (steady as the motion is, another reading is as good: {change_in_words(offset, robot)[0]})"
            )
            left_out = f"{KINDS[change.column].logged} is left out"
            fault = fault_of(change, has, ids, seen, robot)
            sentence = f"{fault.sentence.removesuffix(fault.repair)}so that {left_out}"
            nothing = change._replace(factor=math.nan)
            fault = Fault(
                nothing, fault.run_ids, sentence, left_out, FaultStatus.UNDECIDED, (offset, *rivals)
            )
            return fault if parts[1] else fault._replace(status=FaultStatus.NOT_CONFIRMED)
        if rivals:
            alike = " or ".join(change_in_words(rival, robot)[0] for rival in rivals)
            seen += f" (these channels cannot distinguish it from another reading: {alike})"
        fault = fault_of(change, has, ids, seen, robot)
        if not parts[1]:
            return fault._replace(status=FaultStatus.NOT_CONFIRMED)
        return fault._replace(status=FaultStatus.UNDECIDED, rivals=tuple(rivals)) if rivals else fault
    return None


def _is_best(
    best: Reading,
    readings: Sequence[Reading],
    tried: Callable[[Change, Sequence[int]], Reading],
    part: Sequence[int],
    whole: Sequence[int],
) -> bool:
    """Return whether the readings that gain more in the part of runs that one mends gain less than it in the whole."""
    nets = [float(tried(each, whole).gain[list(whole)].sum()) for each in _equal_readings(readings, part)]
    return max(nets, default=math.inf) < float(best.gain[list(whole)].sum()) - TIE


def _offset_for_sign(change: Change, runs: Sequence[Rows]) -> Change | None:
    """Return the offset that is as good as a turned sign in runs that move alike; None where they tell the two apart.

    It is 0 where the channel, about its mean over all of them, follows the wheels with the sign that it has.
    """
    if (
        change.kind is not FaultKind.SIGN
        or change.of_wheels
        or KINDS[change.column].channels[0] not in MOTION
    ):
        return None
    c = KINDS[change.column].channels[0]
    together = joined(runs)
    measured, predicted = together.measured[:, c], together.predicted[:, c]
    known = np.isfinite(measured) & np.isfinite(predicted)
    m, p = measured[known] - measured[known].mean(), predicted[known] - predicted[known].mean()
    follows = float(agreement(m[:, None], p[:, None])[0][0]) if np.std(p) > LEAST[c] else 0.0
    if follows < -TURNED:
        return None
    offset = float((predicted - measured)[known].mean()) if follows < TURNED else 0.0
    return Change(FaultKind.OFFSET, change.column, offset=offset)


def _equal_readings(readings: Sequence[Reading], places: Sequence[int]) -> list[Change]:
    """Return the readings that gain most in some runs, of those that mend all of them, and those that are as good."""
    whole = [reading for reading in readings if reading.mends[places].mean() > MIN_MENDED_RATIO]
    gains = [float(reading.gain[places].sum()) for reading in whole]
    most = max(gains, default=0.0)
    return [
        each.change
        for each, gain in zip(whole, gains, strict=True)
        if most - gain < max(TIE, TIE_RATIO * most)
    ]


def _evidence(before: Agreement, best: Reading, shown: Sequence[int]) -> str:
    """Return how a reading is seen, in words: the gains of the channels that it turns, in the runs that it mends."""
    old, change, words = before.correlation[shown], best.change, []
    gains, rise = before.gain[shown], best.correlation[shown] - old
    asked = (old != 0.0) & np.isfinite(gains)
    for c in FOLLOWERS:
        on = asked[:, c]
        own = c in KINDS[change.column].channels or change.of_wheels
        if own and on.any() and np.median(rise[on, c]) > RISE:
            text = f"the {WORDS[c]} follows the wheels with the factor {np.median(gains[on, c]):.2f}"
            both = on & np.isfinite(gains[:, H])
            if change.column is Column.GYRO and both.any():
                text += f", and the heading rate with {float(np.median(gains[both, c] / gains[both, H])):.2f}"
            words.append(text)
    return f": {' and '.join(words)}"
