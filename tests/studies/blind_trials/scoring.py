"""How often blind trials came out right: rates with exact intervals, and how small an effect is found."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from studies.blind_trials.trial import (
    DRIVE_ROWS,
    FAULTS,
    KNOWN,
    OUTSIDE,
    ROBOTS,
    Row,
    Trial,
    Varying,
    value_is_right,
)
from terrain.bootstrap import proportion_interval
from terrain.discrepancy.verdict import Tier
from terrain.effects import library_of
from terrain.records import Array

FOUND_TRIALS = 5
"""Least number of trials of an effect, from which the amplitude at which it is found is fitted."""


class Score(NamedTuple):
    """A rate with its 95 % interval by Clopper and Pearson (Biometrika 1934), beside the bar that it has to meet."""

    hits: int
    of: int
    rate: float  #: NaN where nothing was counted
    low: float
    high: float
    bar: str  #: in words; empty for a rate without a bar
    met: bool


def score(outcomes: Iterable[bool], least: float = 0.0, most: float = 1.0, n_least: int = 0) -> Score:
    """Return the rate of outcomes that are true, which should be within bounds, of so many at the least.

    Examples
    --------
    >>> found = score([False] * 300, most=0.02)
    >>> [round(x, 4) for x in found[2:5]], found.bar, found.met
    ([0.0, 0.0, 0.0122], 'at most 2 %', True)
    """
    counted = [bool(outcome) for outcome in outcomes]
    n, k = len(counted), sum(counted)
    words = [f"at least {100 * least:.0f} %"] * (least > 0.0) + [f"at most {100 * most:.0f} %"] * (most < 1.0)
    bar = " and ".join(words) + f", of at least {n_least}" * (n_least > 0)
    rate = k / n if n else math.nan
    return Score(k, n, rate, *proportion_interval(k, n), bar, least <= rate <= most and n >= n_least)


def table_of(trials: Sequence[Trial]) -> dict[str, Score]:
    """Return the scores of all rows that were tried, by name."""
    rows = {row: [t for t in trials if t.row == row] for row in Row}
    gain = score((t.gain_low > 0 for t in trials if t.named), least=1.0)
    every = {**dict(_plain_scores(rows)), "held-out gain above zero with its interval": gain}
    return {name: one for name, one in {**every, **dict(_measured_scores(rows))}.items() if one.of}


def _plain_scores(rows: Mapping[Row, Sequence[Trial]]) -> Iterator[tuple[str, Score]]:
    yield "none: false alarms", score(map(states_something, rows[Row.NONE]), most=0.02)
    yield "strong: named", score((_all_found(t) for t in rows[Row.STRONG]), least=0.95)
    for row in (Row.STRONG, Row.LADDER):
        yield f"{row.value}: wrongly named", score((t.wrong for t in rows[row]), most=0.01)
    over_limit = [t for row in (Row.LADDER, Row.FOUND, Row.STRONG) for t in rows[row] if t.over_limit >= 1.0]
    inside = (is_covered(t) for t in over_limit if t.causes[0] in t.named)
    yield "value inside its 95 % interval", score(inside, least=0.9, most=0.99, n_least=100)
    yield "two: both, and only both", score((t.right for t in rows[Row.TWO]), least=0.85)
    for row in DRIVE_ROWS:
        hidden = [t for t in rows[row] if t.causes]
        yield f"{row.value}: named", score(map(_all_found, hidden), least=0.95)
        yield f"{row.value}: named alone", score(t.causes[0] in t.named for t in hidden)
        yield f"{row.value}: wrongly named", score((t.wrong for t in hidden), most=0.01)
        quiet = [t for t in rows[row] if not t.causes]
        yield f"{row.value}: false alarms", score(map(states_something, quiet), most=0.02)
        inside = (is_covered(t) for t in hidden if t.causes[0] in t.named)
        yield f"{row.value}: value inside its 95 % interval", score(inside)
        for effect in dict.fromkeys(t.causes[0] for t in hidden):
            own = score(t.found(effect) for t in hidden if t.causes[0] == effect)
            yield f"{row.value}, {effect}: named", own
    outside = rows[Row.OUTSIDE]
    yield "outside: confidently misnamed", score((bool(t.named) for t in outside), most=0.02)
    yield "outside: called unexplained", score((bool(t.unexplained) for t in outside), least=0.6)
    for kind in OUTSIDE:
        some = [t for t in outside if t.outside == kind]
        yield f"outside, {kind}: misnamed", score(bool(t.named) for t in some)
        least = 0.6 if kind == "stick_slip" else 0.0
        yield f"outside, {kind}: unexplained", score((bool(t.unexplained) for t in some), least)
    poor = rows[Row.POOR]
    wrong = (bool(set(t.named) - set(t.causes)) for t in poor)
    yield "poor: a wrong single name", score(wrong, most=0.02)
    undecided = (bool(t.sets) or t.verdict in (Tier.CANDIDATE, Tier.NOT_SHOWN) for t in poor)
    yield "poor: a set, a candidate or not shown", score(undecided)


def _measured_scores(rows: Mapping[Row, Sequence[Trial]]) -> Iterator[tuple[str, Score]]:
    """Yield the scores of the rows that resemble measured runs."""
    named_rows = Row.GROSS, Row.SHORT, Row.LATE, Row.SCATTERED, Row.STALLED, Row.HALF, Row.SENSOR_LATE
    for row in (*named_rows, Row.DYNAMIC, Row.FAULT):
        name, least = ("stated in words", 0.95) if row is Row.FAULT else ("right or its twin set", 0.85)
        yield f"{row.value}: {name}", score(map(is_right, rows[row]), least)
        wrong = (bool(wrong_names(t)) for t in rows[row])
        yield f"{row.value}: a wrong single name", score(wrong, most=0.02)
    for kind in dict.fromkeys(t.fault for t in rows[Row.FAULT]):
        yield f"fault, {kind}: stated", score(is_right(t) for t in rows[Row.FAULT] if t.fault == kind)
    gross, scattered = rows[Row.GROSS], rows[Row.SCATTERED]
    yield "gross: beyond the bounds, and clipped", score(t.clipped for t in gross)
    for row, some, value in ((Row.GROSS, gross, "value"), (Row.SCATTERED, scattered, "mean value")):
        inside = (is_covered(t) for t in some if t.causes[0] in t.named)
        yield f"{row.value}: {value} inside its 95 % interval", score(inside)
    for place, name in ((0, "delay"), (1, "effect beside it")):
        yield f"late: {name} found", score(t.found(t.causes[place]) for t in rows[Row.LATE])
    stalled = rows[Row.STALLED]
    yield "stalled: all stalled runs excluded", score(set(t.stalled) <= set(t.excluded) for t in stalled)
    others = score(bool(set(t.excluded) - set(t.stalled)) for t in stalled)
    yield "stalled: another run excluded", others
    right = []  # the runs with the effect are a group of their own
    for trial in (t for t in rows[Row.HALF] if varies(t, t.causes[0])):
        of_cause = [each for each in trial.varying if {each.name, *each.rivals} & {*trial.causes}]
        right.append(any(each.groups and parts(each, {*trial.present}) for each in of_cause))
    yield "half: groups of runs are right", score(right)
    late = rows[Row.SENSOR_LATE]
    for sensor in dict.fromkeys(t.variant for t in late):
        yield f"sensor_late, {sensor}: right", score(is_right(t) for t in late if t.variant == sensor)
    quiet = [t for t in rows[Row.DYNAMIC] if not t.causes]
    hidden = [t for t in rows[Row.DYNAMIC] if t.causes]
    yield "dynamic, nothing hidden: something stated", score(map(states_something, quiet), most=0.05)
    named = score((t.found(t.causes[0]) for t in hidden), least=0.8)
    yield "dynamic, wheel radius: named or in its set", named
    inside = (is_covered(t) for t in hidden if t.found(t.causes[0]))
    yield "dynamic, wheel radius: true value inside", score(inside, least=0.9)
    for known in KNOWN:
        some = [t for t in rows[Row.KNOWN] if t.variant == known]
        named = score((t.found(t.causes[0]) and value_is_right(t.intervals) for t in some), least=0.9)
        yield f"known, {known}: named, value within 5 %", named
        wrong = score((bool(wrong_names(t)) for t in some), most=0.01)
        yield f"known, {known}: a wrong single name", wrong


def parts(varying: Varying, present: Set[str]) -> bool:
    """Return whether no group holds runs with an effect beside others without."""
    return all({*ids} <= present or not {*ids} & present for _, ids in varying.groups)


def _all_found(trial: Trial) -> bool:
    return all(trial.found(cause) for cause in trial.causes)


def is_right(trial: Trial) -> bool:
    """Return whether an answer is what its row asks for, and names nothing else.

    Row ``fault`` asks for a sentence about the log, row ``half`` for the effect as one that varies, row
    ``stalled`` for the effect and the runs that are stalled, and row ``dynamic`` without an effect for
    silence.
    """
    if trial.row is Row.FAULT:
        return FAULTS[trial.fault].stated_in(trial.statements)
    if trial.row is Row.HALF:
        return varies(trial, trial.causes[0]) and not wrong_names(trial)
    if not trial.causes:
        return not states_something(trial)
    right = trial.right and not wrong_names(trial)
    return right and (trial.row is not Row.STALLED or set(trial.stalled) <= set(trial.excluded))


def wrong_names(trial: Trial) -> set[str]:
    """Return what is named alone, or as varying, and is not hidden."""
    varying = {each.name for each in trial.varying if not {*each.rivals} & {*trial.causes}}
    return {*trial.named, *varying} - {*trial.causes, *trial.accepted}


def varies(trial: Trial, cause: str) -> bool:
    """Return whether an effect differs from run to run, alone or with none but its confusable class."""
    twins = {cause, *trial.classes.get(cause, ())}
    return any(
        each.name == cause or (cause in each.rivals and {each.name, *each.rivals} <= twins)
        for each in trial.varying
    )


def states_something(trial: Trial) -> bool:
    """Return whether an answer states that something is wrong; a candidate alone is no statement."""
    states = trial.named, trial.sets, trial.unexplained, trial.varying, trial.statements, trial.refusal
    return any(map(bool, states))


def is_covered(trial: Trial) -> bool:
    """Return whether every hidden value lies within the interval that was given for it."""
    return all(
        name in trial.intervals and trial.intervals[name][1] <= value <= trial.intervals[name][2]
        for name, value in trial.hidden.items()
    )


def found_from(trials: Sequence[Trial]) -> dict[str, dict[str, float]]:
    """Return, by robot and effect, the amplitude over the limit from which nine in ten are found.

    A logistic curve in the logarithm of the amplitude is fitted to the trials of row ``found``.
    """
    from scipy.optimize import minimize

    out: dict[str, dict[str, float]] = {}
    for robot in ROBOTS:
        own = [t for t in trials if t.row == Row.FOUND and t.robot == robot]
        for effect in library_of("swerve" if robot == "agrimaro" else "skid_steer"):
            some = [t for t in own if t.causes == (effect.name,)]
            if len(some) >= FOUND_TRIALS:
                over = np.log([t.over_limit for t in some])
                hit = np.array([t.found(effect.name) for t in some])

                def loss(theta: Array, over: Array = over, hit: Array = hit) -> float:
                    """Return that of a logistic curve; a weak prior keeps it finite."""
                    steep = math.exp(min(theta[1], 5.0))
                    p = 1 / (1 + np.exp(-np.clip(steep * (over - theta[0]), -500, 500)))
                    p = np.clip(p, 1e-9, 1 - 1e-9)
                    prior = 0.5 * (theta[1] - math.log(6.0)) ** 2 + 0.5 * (theta[0] / 2.0) ** 2
                    return float(-(np.log(p[hit]).sum() + np.log(1 - p[~hit]).sum()) + prior)

                theta = minimize(loss, np.array([0.3, math.log(6.0)]), method="Nelder-Mead").x
                # where it reaches 0.9
                at = float(math.exp(theta[0] + math.log(9.0) / math.exp(theta[1])))
                out.setdefault(robot, {})[effect.name] = at
    return out
