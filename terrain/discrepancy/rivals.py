"""Effects that fit as well as a cause in its place, by nonlinear fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import Evidence, correlation, loss_of, partial_information
from terrain.discrepancy.fitting import Problem, Refit, fit_again, names_of
from terrain.discrepancy.selection import wald_test
from terrain.effects import Effect
from terrain.records import Array

RIVAL_LOSS = 8.0
"""Two causes whose best fits differ by less in minus twice the log-likelihood are not distinguished: the
wrong one of two is that much ahead with a chance of 0.3 % at most, whatever the size of the effect."""

TWIN, TWIN_LOSS = 0.99, 30.0
"""The same of two whose sensitivities correlate more, a collinearity index of 8: what distinguishes them is a
small part of what they explain, and may as well be an error of the simulation."""

RIVAL_LINEAR, RIVAL_RATIO = 80.0, 0.5
"""Loss, and ratio of the gain of the cause, above which a rival is not refitted nonlinearly."""

RIVAL_RISE = 0.02
"""Ratio by which a rival may leave a larger square than a cause: a mass that is too small predicts less of
the wheels' noise, which is up to so much of what a slow drive leaves."""

SHARED = 0.5
"""Least correlation of what a cause and its rival change: one that shares less with it explains something
else, and is no rival, however little worse it fits."""


class Rival(NamedTuple):
    """An effect that fits as well as a cause in its place.

    Parameters
    ----------
    effect : that
    behind : by how much it fits worse, as minus twice a log-likelihood, over the inflation of the cause
    change, std : (p,) of its parameters, by a fit of its own; a value may be at its bound
    """

    effect: Effect
    behind: float
    change: Array
    std: Array


def rivals_of(
    problem: Problem, info: Evidence, start: Evidence, causes: Sequence[Effect]
) -> dict[str, tuple[Rival, ...]]:
    """Return by cause all effects that, refitted in its place, fit as well as it does, the best first.

    It is compared by the noise that the causes leave and by that of the simulation as it is given: a cause
    that absorbs noise is ahead by only one of them.  Where runs disagree on a cause by more than the noise
    allows, losses count that much less, as a quasi-likelihood has them.  Where much is wrong, neither is a
    likelihood: a rival that leaves a larger square than the noise of the wheels can make is none.
    """
    base, judges = start.vector, (info, start)
    runs_alone = replace(info, model_std=np.zeros_like(info.model_std))  # in what all runs have they agree
    own: list[Refit] = []  # losses of the causes by both judges, where anything comes near
    rivals = {}
    for cause in causes:
        others = [other for other in causes if other is not cause]
        inflation = wald_test(runs_alone, names_of(others), cause).inflation
        found = []
        for effect in _near(problem, info, cause, others, inflation):
            own = own or [fit_again(problem, judge, base, names_of(causes)) for judge in judges]
            swapped = names_of([*others, effect])
            here, there = (fit_again(problem, judge, base, swapped) for judge in judges)
            behind = min(here.loss - own[0].loss, there.loss - own[1].loss) / inflation
            worse = here.square > (1.0 + RIVAL_RISE) * own[0].square + RIVAL_LOSS * inflation
            if not worse and behind < _allowed(info, others, cause, effect):
                at = [swapped.index(p.name) for p in effect.parameters]
                found.append(Rival(effect, behind, here.change[at], here.std[at]))
        rivals[cause.name] = tuple(sorted(found, key=lambda rival: rival.behind))
    return rivals


def _near(
    problem: Problem, info: Evidence, cause: Effect, others: Sequence[Effect], inflation: float
) -> list[Effect]:
    """Return the effects that come near a cause beside the others, by linear fits."""
    causes = [*others, cause]
    now = loss_of(info, names_of(causes))
    gain = loss_of(info, names_of(others)) - now
    most = min(RIVAL_LINEAR * inflation, RIVAL_LOSS * inflation + RIVAL_RATIO * gain)
    return [
        effect
        for effect in problem.library
        if effect not in causes
        and loss_of(info, names_of([*others, effect])) - now < most
        and _alike(info, others, cause, effect) > SHARED
        and wald_test(info, names_of(others), effect).inside
    ]


def _allowed(info: Evidence, others: Sequence[Effect], cause: Effect, rival: Effect) -> float:
    """Return by how much a rival may fit worse than a cause and still be a rival."""
    return TWIN_LOSS if _alike(info, others, cause, rival) > TWIN else RIVAL_LOSS


def _alike(info: Evidence, others: Sequence[Effect], cause: Effect, rival: Effect) -> float:
    """Return the correlation of what a cause and another effect change beside the others."""
    base, own, its = (info.places(names_of(effects)) for effects in (others, [cause], [rival]))
    free = partial_information(info.a.sum(axis=0), base, [*own, *its])[1]
    return correlation(free, range(len(own)), range(len(own), len(own) + len(its)))
