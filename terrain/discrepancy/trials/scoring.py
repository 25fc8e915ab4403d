"""How often blind trials came out right: rates with exact intervals, and how small an effect is found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.trials.hidden_effects import OUTSIDE, ROBOTS
from terrain.discrepancy.trials.measured_scores import is_covered, measured_scores, states_something
from terrain.discrepancy.trials.rate import Rate, rate_of
from terrain.discrepancy.trials.rows import DRIVE_ROWS, Row
from terrain.discrepancy.trials.trial import Trial
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
