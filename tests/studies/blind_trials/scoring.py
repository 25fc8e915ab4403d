"""How often blind trials came out right: rates with exact intervals, and how small an effect is found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import beta

from studies.blind_trials.hidden import DRIVE_ROWS, KNOWN, OUTSIDE, ROBOTS, Row, fault_named, value_is_right
from studies.blind_trials.trial import Trial
from terrain.discrepancy.verdict import Verdict
from terrain.effects import library_of
from terrain.records import Array

FOUND_TRIALS = 5
"""Least number of trials of an effect, from which the amplitude at which it is found is fitted."""


class Score(NamedTuple):
    """A rate beside the bar that it has to meet.

    Parameters
    ----------
    hits, of, rate, low, high : as :class:`Rate`
    bar : in words; empty for a rate without a bar
    met : whether the rate meets it
    """

    hits: int
    of: int
    rate: float
    low: float
    high: float
    bar: str
    met: bool


def table_of(trials: Sequence[Trial]) -> dict[str, Score]:
    """Return the scores of all rows that were tried, by name."""
    rows = {row: [t for t in trials if t.row == row] for row in Row}
    scores = (*_scores(trials, rows), *measured_scores(rows))
    return {name: Score(*rate, bar, met) for name, rate, bar, met in scores if rate.of}


def _scores(trials: Sequence[Trial], rows: dict[Row, list[Trial]]) -> Iterator[tuple[str, Rate, str, bool]]:
    """Yield name, rate, bar, and whether it is met."""
    alarms = rate_of(states_something(t) for t in rows[Row.NONE])
    yield "none: false alarms", alarms, "at most 2 %", alarms.rate <= 0.02
    named = rate_of(all(t.found(c) for c in t.causes) for t in rows[Row.STRONG])
    yield "strong: named", named, "at least 95 %", named.rate >= 0.95
    for row in (Row.STRONG, Row.LADDER):
        wrong = rate_of(t.wrong for t in rows[row])
        yield f"{row.value}: wrongly named", wrong, "at most 1 %", wrong.rate <= 0.01
    covered = rate_of(
        is_covered(t)
        for t in [*rows[Row.LADDER], *rows[Row.FOUND], *rows[Row.STRONG]]
        if t.over_limit >= 1.0 and t.causes[0] in t.named
    )
    enough = covered.of >= 100 and 0.9 <= covered.rate <= 0.99
    yield "value inside its 95 % interval", covered, "90 to 99 %, of at least 100", enough
    both = rate_of(t.right for t in rows[Row.TWO])
    yield "two: both, and only both", both, "at least 85 %", both.rate >= 0.85
    for row in DRIVE_ROWS:
        yield from _drive_scores(row.value, rows[row])
    yield from _outside_scores(rows[Row.OUTSIDE])
    wrong = rate_of(bool(set(t.named) - set(t.causes)) for t in rows[Row.POOR])
    yield "poor: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02
    undecided = rate_of(t.verdict in (Verdict.AMBIGUOUS, Verdict.NOT_EXCITED) for t in rows[Row.POOR])
    yield "poor: ambiguous or not excited", undecided, "", True
    gain = rate_of(t.gain_low > 0 for t in trials if t.named)
    yield "held-out gain above zero with its interval", gain, "all", gain.rate == 1.0


def _drive_scores(row: str, trials: Sequence[Trial]) -> Iterator[tuple[str, Rate, str, bool]]:
    hidden = [t for t in trials if t.causes]
    named = rate_of(all(t.found(c) for c in t.causes) for t in hidden)
    yield f"{row}: named", named, "at least 95 %", named.rate >= 0.95
    yield f"{row}: named alone", rate_of(t.causes[0] in t.named for t in hidden), "", True
    wrong = rate_of(t.wrong for t in hidden)
    yield f"{row}: wrongly named", wrong, "at most 1 %", wrong.rate <= 0.01
    alarms = rate_of(states_something(t) for t in trials if not t.causes)
    yield f"{row}: false alarms", alarms, "at most 2 %", alarms.rate <= 0.02
    covered = rate_of(is_covered(t) for t in hidden if t.causes[0] in t.named)
    yield f"{row}: value inside its 95 % interval", covered, "", True
    for effect in dict.fromkeys(t.causes[0] for t in hidden):
        own = rate_of(t.found(effect) for t in hidden if t.causes[0] == effect)
        yield f"{row}, {effect}: named", own, "", True


def _outside_scores(trials: Sequence[Trial]) -> Iterator[tuple[str, Rate, str, bool]]:
    wrong = rate_of(bool(t.named) for t in trials)
    yield "outside: confidently misnamed", wrong, "at most 2 %", wrong.rate <= 0.02
    left = rate_of(bool(t.unexplained) for t in trials)
    yield "outside: called unexplained", left, "at least 60 %", left.rate >= 0.6
    for kind in OUTSIDE:
        some = [t for t in trials if t.outside == kind]
        yield f"outside, {kind}: misnamed", rate_of(bool(t.named) for t in some), "", True
        left = rate_of(bool(t.unexplained) for t in some)
        bar = "at least 60 %" if kind == "stick_slip" else ""
        yield f"outside, {kind}: unexplained", left, bar, not bar or left.rate >= 0.6


def found_from(trials: Sequence[Trial]) -> dict[str, dict[str, float]]:
    """Return, by robot and effect, the amplitude over the limit from which nine in ten are found.

    A logistic curve in the logarithm of the amplitude is fitted to the trials of row ``found``.
    """
    out: dict[str, dict[str, float]] = {}
    for robot in ROBOTS:
        for effect in library_of("swerve" if robot == "agrimaro" else "skid_steer"):
            some = [
                t for t in trials if t.row == Row.FOUND and t.robot == robot and t.causes == (effect.name,)
            ]
            if len(some) >= FOUND_TRIALS:
                over = np.log([t.over_limit for t in some])
                hit = np.array([t.found(effect.name) for t in some])
                out.setdefault(robot, {})[effect.name] = _ninety_percent_point(over, hit)
    return out


def _ninety_percent_point(x: Array, hit: Array) -> float:
    """Return the amplitude at which a logistic curve reaches 0.9; a weak prior keeps it finite."""
    from scipy.optimize import minimize

    def loss(theta: Array) -> float:
        steep = math.exp(min(theta[1], 5.0))
        p = np.clip(1 / (1 + np.exp(-np.clip(steep * (x - theta[0]), -500, 500))), 1e-9, 1 - 1e-9)
        prior = 0.5 * (theta[1] - math.log(6.0)) ** 2 + 0.5 * (theta[0] / 2.0) ** 2
        return float(-(np.log(p[hit]).sum() + np.log(1 - p[~hit]).sum()) + prior)

    theta = minimize(loss, np.array([0.3, math.log(6.0)]), method="Nelder-Mead").x
    return float(math.exp(theta[0] + math.log(9.0) / math.exp(theta[1])))


# -- Rates with exact intervals ----------------------------------------------------------------------------


class Rate(NamedTuple):
    """A rate, and its 95 % interval by Clopper and Pearson (Biometrika 1934).

    Parameters
    ----------
    hits, of : counts
    rate : NaN where nothing was counted
    low, high : ends of the interval
    """

    hits: int
    of: int
    rate: float
    low: float
    high: float


def rate_of(outcomes: Iterable[bool]) -> Rate:
    """Return the rate of outcomes that are true.

    Examples
    --------
    >>> [round(x, 4) for x in rate_of([False] * 300)[2:]]
    [0.0, 0.0, 0.0122]
    """
    counted = [bool(outcome) for outcome in outcomes]
    n, k = len(counted), sum(counted)
    if n == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low = float(beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return Rate(k, n, k / n, low, high)


# -- Scores of the rows that resemble measured runs --------------------------------------------------------

NAMED_ROWS = (
    *(Row.GROSS, Row.SHORT, Row.LATE, Row.SCATTERED, Row.STALLED, Row.HALF, Row.SENSOR_LATE, Row.DYNAMIC),
)
"""Rows with a bar on right names."""

Scored = tuple[str, Rate, str, bool]
"""Name, rate, bar in words, and whether it is met."""


def measured_scores(rows: Mapping[Row, Sequence[Trial]]) -> Iterator[Scored]:
    """Yield name, rate, bar, and whether it is met."""
    for row in NAMED_ROWS:
        right = rate_of(is_right(t) for t in rows[row])
        yield f"{row.value}: right or its twin set", right, "at least 85 %", right.rate >= 0.85
        wrong = rate_of(bool(wrong_names(t)) for t in rows[row])
        yield f"{row.value}: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02
        yield from _DETAILS.get(row, _nothing)(rows[row])
    stated = rate_of(is_right(t) for t in rows[Row.FAULT])
    yield "fault: stated in words", stated, "at least 95 %", stated.rate >= 0.95
    wrong = rate_of(bool(wrong_names(t)) for t in rows[Row.FAULT])
    yield "fault: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02
    for kind in dict.fromkeys(t.fault for t in rows[Row.FAULT]):
        yield (
            f"fault, {kind}: stated",
            rate_of(is_right(t) for t in rows[Row.FAULT] if t.fault == kind),
            "",
            True,
        )
    yield from _known_scores(rows[Row.KNOWN])


def is_right(trial: Trial) -> bool:
    """Return whether an answer is what its row asks for, and names nothing else.

    Row ``fault`` asks for a sentence about the log, row ``half`` for the effect as one that varies, row
    ``stalled`` for the effect and the runs that are stalled, and row ``dynamic`` without an effect for
    silence.
    """
    if trial.row is Row.FAULT:
        return fault_named(trial.fault).stated_in(trial.statements)
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
    """Return whether an answer states that something is wrong."""
    quiet = trial.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    return not quiet or bool(trial.statements or trial.varying)


def is_covered(trial: Trial) -> bool:
    """Return whether every hidden value lies within the interval that was given for it."""
    return all(
        name in trial.intervals and trial.intervals[name][1] <= value <= trial.intervals[name][2]
        for name, value in trial.hidden.items()
    )


def groups_are_right(trial: Trial) -> bool:
    """Return whether the runs with the effect are a group of their own."""
    return any(
        {each.name, *each.rivals} & set(trial.causes) and set(ids) == set(trial.present)
        for each in trial.varying
        for _, ids in each.groups
    )


def _nothing(_: Sequence[Trial]) -> Iterator[Scored]:
    yield from ()


def _gross(trials: Sequence[Trial]) -> Iterator[Scored]:
    yield "gross: beyond the bounds, and clipped", rate_of(t.clipped for t in trials), "", True
    found = [t for t in trials if t.causes[0] in t.named]
    yield "gross: value inside its 95 % interval", rate_of(is_covered(t) for t in found), "", True


def _late(trials: Sequence[Trial]) -> Iterator[Scored]:
    for place, name in ((0, "delay"), (1, "effect beside it")):
        yield f"late: {name} found", rate_of(t.found(t.causes[place]) for t in trials), "", True


def _scattered(trials: Sequence[Trial]) -> Iterator[Scored]:
    found = [t for t in trials if t.causes[0] in t.named]
    yield "scattered: mean value inside its 95 % interval", rate_of(is_covered(t) for t in found), "", True


def _stalled(trials: Sequence[Trial]) -> Iterator[Scored]:
    all_out = rate_of(set(t.stalled) <= set(t.excluded) for t in trials)
    yield "stalled: all stalled runs excluded", all_out, "", True
    others = rate_of(bool(set(t.excluded) - set(t.stalled)) for t in trials)
    yield "stalled: another run excluded", others, "", True


def _half(trials: Sequence[Trial]) -> Iterator[Scored]:
    groups = rate_of(groups_are_right(t) for t in trials if varies(t, t.causes[0]))
    yield "half: groups of runs are right", groups, "", True


def _sensor_late(trials: Sequence[Trial]) -> Iterator[Scored]:
    for sensor in dict.fromkeys(t.variant for t in trials):
        found = rate_of(is_right(t) for t in trials if t.variant == sensor)
        yield f"sensor_late, {sensor}: right", found, "", True


def _dynamic(trials: Sequence[Trial]) -> Iterator[Scored]:
    silent = rate_of(states_something(t) for t in trials if not t.causes)
    yield "dynamic, nothing hidden: something stated", silent, "at most 3 of 60", silent.rate <= 3 / 60
    hidden = [t for t in trials if t.causes]
    named = rate_of(t.found(t.causes[0]) for t in hidden)
    yield "dynamic, wheel radius: named or in its set", named, "at least 80 %", named.rate >= 0.8
    covered = rate_of(is_covered(t) for t in hidden if t.found(t.causes[0]))
    yield "dynamic, wheel radius: true value inside", covered, "at least 90 %", covered.rate >= 0.9


_DETAILS: dict[Row, Callable[[Sequence[Trial]], Iterator[Scored]]] = {
    Row.GROSS: _gross,
    Row.LATE: _late,
    Row.SCATTERED: _scattered,
    Row.STALLED: _stalled,
    Row.HALF: _half,
    Row.SENSOR_LATE: _sensor_late,
    Row.DYNAMIC: _dynamic,
}


def _known_scores(trials: Sequence[Trial]) -> Iterator[Scored]:
    for known in KNOWN:
        some = [t for t in trials if t.variant == known.name]
        named = rate_of(t.found(t.causes[0]) and value_is_right(t.intervals) for t in some)
        bar = "at least 90 %"
        yield f"known, {known.name}: named, value within 5 %", named, bar, named.rate >= 0.9
        wrong = rate_of(bool(wrong_names(t)) for t in some)
        yield f"known, {known.name}: a wrong single name", wrong, "at most 1 %", wrong.rate <= 0.01
