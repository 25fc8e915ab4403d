"""Which runs of a data set are held out, so that what a model predicts of them shows its skill."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pipelines.crossval.splits import N_FOLDS
from terrain.records import RunLog

ENOUGH_RUNS = 6
"""A terrain with so many runs gives one of them away: five are left, one for each fold."""

FEWEST_RUNS = 3
"""Where no terrain has enough, the one with the most runs gives one away if two are left."""


class Division(NamedTuple):
    """Runs to evaluate and train on, and runs that the model never sees."""

    training: list[RunLog]
    held_out: list[RunLog]


def divide(runs: Sequence[RunLog]) -> Division:
    """Return the runs, the last one of each terrain that has enough runs held out.

    The choice depends on names and numbers alone.  Nothing is held out where too little would be left, and no
    run with several terrains is.

    Examples
    --------
    >>> def run(terrain, number):
    ...     return RunLog(f"{terrain}_{number}", "husky", {}, ((0.0, 9.0, terrain),))
    >>> runs = [run("ice", i) for i in range(6)] + [run("mud", i) for i in range(2)]
    >>> [each.run_id for each in divide(runs).held_out]
    ['ice_5']
    """
    by_terrain: dict[str, list[RunLog]] = {}
    for run in sorted(runs, key=lambda each: each.run_id):
        if len(run.terrains) == 1:
            by_terrain.setdefault(run.terrains[0], []).append(run)
    chosen = {of_one[-1].run_id for of_one in by_terrain.values() if len(of_one) >= ENOUGH_RUNS}
    if not chosen and by_terrain:
        most = max(by_terrain.values(), key=len)
        if len(most) >= FEWEST_RUNS and len(runs) > N_FOLDS:
            chosen = {most[-1].run_id}
    return Division(
        [run for run in runs if run.run_id not in chosen], [run for run in runs if run.run_id in chosen]
    )
