"""Signs that are turned and columns that are exchanged, found by what makes all channels of a run agree.

Every reading of a run that is one fault away is tried: a change of its measured channels, or of its wheels,
which are then simulated again.  Under the right one all channels follow the wheels, each with a gain above
zero; the likelihood that a reading gains is summed over the runs that it mends.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.health.faults import (
    CHANNELS_OF,
    LOGGED,
    Change,
    Column,
    Fault,
    FaultKind,
    in_runs,
    session_of,
)
from terrain.discrepancy.health.response import AMPS, MOTION, A, H, Response, T, fits, gains_of
from terrain.effects import CHANNELS
from terrain.records import Array
from terrain.robots import Robot

TURNED, RIGHT = 0.3, 0.7
"""A channel does not follow the wheels below the first correlation about zero, and does over the second.  Of
measured runs, those that slip hardly fall below 0.8."""

RISE, CLEAR = 0.25, 0.95
"""A channel that half follows the wheels, as one wheel's do, is mended if its correlation rises by the first
and to over the second."""

LOSS = 0.1
"""Largest loss of correlation of any other channel under a reading that mends one."""

GAIN = 20.0
"""Twice the log-likelihood that a reading has to gain in a run: odds of e^10, over a score of readings and
hundreds of runs."""

TIE, TIE_RATIO = 10.0, 0.03
"""Readings whose gains differ by less, or by less than that ratio, cannot be distinguished."""

FOLLOWERS = (*MOTION, A, AMPS, T)
"""Channels whose gain is above zero, whatever the effects are."""

WORDS = dict(zip(CHANNELS, ("gyro", "speed", "lateral speed", "accelerometer", "sum of the currents",
                            "difference of the currents", "heading rate"), strict=True))  # fmt: skip


class Reading(NamedTuple):
    """What a change makes of runs.

    Parameters
    ----------
    change : tried
    correlation : (runs, channels) under it
    gain : (runs,) of twice the log-likelihood
    mends : (runs,) whether a channel follows the wheels that did not, and none is worse
    suits : (runs,) whether the gain is as clear and none is worse; a channel may have followed before
    """

    change: Change
    correlation: Array
    gain: Array
    mends: Array
    suits: Array


def candidate_changes(robot: Robot) -> tuple[Change, ...]:
    """Return the changes that are tried, those of fewest columns first."""
    sign, swapped, n_wheels = FaultKind.SIGN, FaultKind.SWAPPED, len(robot.rate_channels)
    single = (Column.GYRO, Column.HEADING, Column.SPEED, Column.ACCEL, Column.CURRENTS)
    changes = [Change(sign, column, -1.0) for column in single]
    changes.append(Change(swapped, Column.SPEED))
    if robot.skids:
        changes += [Change(swapped, column) for column in (Column.CURRENTS, Column.WHEELS, Column.SIDES)]
    else:
        pairs = combinations(range(n_wheels), 2)
        changes += [Change(swapped, Column.WHEELS, pair=pair) for pair in pairs]
    each = range(n_wheels) if n_wheels > 1 else ()
    changes += [Change(sign, Column.WHEELS, -1.0, wheel) for wheel in (-1, *each)]
    return tuple(changes)


def is_suspect(response: Response) -> bool:
    """Whether a channel of a run that is asked does not follow the wheels well."""
    correlation = fits(response)[0]
    return any(correlation[c] != 0.0 and correlation[c] < RIGHT for c in FOLLOWERS)


def reading_of(change: Change, before: Sequence[Response], after: Sequence[Response]) -> Reading:
    """Return what a change makes of runs."""
    was, now = ([fits(run) for run in runs] for runs in (before, after))
    old, new = (np.array([each[0] for each in fitted]) for fitted in (was, now))
    gain = np.array([b[1].sum() - a[1].sum() for a, b in zip(was, now, strict=True)])
    keys = list(FOLLOWERS)
    turned = (old < TURNED) & (new > RIGHT)
    asked = old != 0.0  # what a run does not show cannot be wrong in it
    mended = (asked & (turned | ((new - old > RISE) & (new > CLEAR))))[:, keys].any(axis=1)
    worse = ((new < old - LOSS) & (old > RIGHT))[:, keys].any(axis=1)
    suits = ~worse & (gain > GAIN)
    return Reading(change, new, gain, mended & suits, suits)


def best_reading(readings: Sequence[Reading]) -> tuple[Reading, list[Reading]] | None:
    """Return the reading that gains most over the runs that it mends, and those as good on the same runs."""
    best = max(readings, key=lambda reading: float(reading.gain[reading.mends].sum()), default=None)
    if best is None or not best.mends.any():
        return None
    most = float(best.gain[best.mends].sum())
    near = [
        reading
        for reading in readings
        if reading.mends[best.mends].all()
        and most - float(reading.gain[best.mends].sum()) < max(TIE, TIE_RATIO * most)
    ]
    return near[0], near[1:]


def runs_with(reading: Reading, ids: Sequence[str], responses: Sequence[Response]) -> list[int]:
    """Return the runs that have a fault: those that it suits, and of their sessions those that cannot say.

    A run that drives straight measures no sign of a gyro; it has that of the others.
    """
    has = set(np.flatnonzero(reading.suits).tolist())
    old = np.array([fits(run)[0] for run in responses])
    mended = np.flatnonzero(reading.mends)
    shift = np.median(np.abs(reading.correlation[mended] - old[mended]), axis=0)
    shows = [c for c in FOLLOWERS if shift[c] > RISE]
    for session in {session_of(ids[i]) for i in has}:
        members = [i for i in range(len(ids)) if session_of(ids[i]) == session]
        asked = [i for i in members if (np.abs(old[i, shows]) > RIGHT).any()]
        if all(i in has for i in asked):
            has |= set(members)
    return sorted(has)


def sign_fault(
    best: Reading,
    rivals: Sequence[Reading],
    has: Sequence[int],
    responses: Sequence[Response],
    robot: Robot,
) -> Fault:
    """Return the fault of a reading, in words.

    Readings that are as good are mirror images, left for right or ahead for back: the change of fewest
    columns is taken, and the diagnosis is that of either but for the side.
    """
    change, every = best.change, [run.run_id for run in responses]
    ids = tuple(every[i] for i in has)
    where = in_runs(ids, every)
    shown = [i for i in has if best.mends[i]]
    seen = _evidence(change, responses, shown, best)
    what, repair = _fault_words(change, robot)
    other = ""
    if rivals:
        words = " or ".join(_fault_words(rival.change, robot)[0] for rival in rivals)
        other = f" (these channels cannot distinguish it from another reading: {words})"
    sentence = f"{what} {where}: {seen}{other}; {repair}"
    return Fault(change.kind, change.column, ids, change.factor, sentence, repair, change)


def _evidence(change: Change, responses: Sequence[Response], shown: Sequence[int], best: Reading) -> str:
    """Return how a fault is seen: the gains of the channels that it turns."""
    runs = [responses[i] for i in shown]
    gains, old = (np.array(each) for each in zip(*(gains_of(run) for run in runs), strict=True))
    new = best.correlation[list(shown)]
    own = [c for c in FOLLOWERS if c in CHANNELS_OF[change.column] or change.of_wheels]
    asked = (old != 0.0) & np.isfinite(gains)
    turned = [c for c in own if asked[:, c].any() and np.median((new - old)[asked[:, c], c]) > RISE]
    words = []
    for c in turned:
        on = asked[:, c]
        text = f"the {WORDS[CHANNELS[c]]} follows the wheels with the factor {np.median(gains[on, c]):.2f}"
        both = on & np.isfinite(gains[:, H])
        if change.column is Column.GYRO and both.any():
            ratio = float(np.median(gains[both, c] / gains[both, H]))
            text += f", and the heading rate with {ratio:.2f}"
        words.append(text)
    return " and ".join(words)


def _fault_words(change: Change, robot: Robot) -> tuple[str, str]:
    """Return a fault and its repair in words."""
    if change.kind is FaultKind.SWAPPED:
        if change.column is Column.SPEED:
            names = "speed_x_mps and speed_y_mps"
            what = "the speeds forward and to the left are exchanged"
        elif not robot.skids:
            names = " and ".join(robot.rate_channels[i] for i in change.pair)
            what = "wheel speeds of {} and {} are exchanged".format(*(robot.wheels[i] for i in change.pair))
        else:
            what = f"{change.column.value} of left and right are exchanged"
            names = {
                Column.CURRENTS: "current_left_a and current_right_a",
                Column.WHEELS: "speed_left_mps and speed_right_mps",
                Column.SIDES: "left and right of the wheel speeds, and of the currents,",
            }[change.column]
        return what, f"exchange {names} (mapping file: exchange their columns)"
    if change.wheel >= 0:
        wheel = robot.wheels[change.wheel]
        what, logged = f"the sign of the {wheel} wheel's speed is turned", f"the speed of the wheel {wheel}"
    else:
        plural = change.column in (Column.WHEELS, Column.CURRENTS)
        what = f"the sign of the {change.column.value} is turned"
        logged = LOGGED[change.column]
        if not plural:
            what = f"the {change.column.value}'s sign is turned"
    return what, f"multiply {logged} by -1 (mapping file: scale: -1)"
