"""What is doubtful or implausible about runs, as ``import`` and ``inspect`` report it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from pipelines.data.datasets import robot_of
from terrain.errors import ConfigError, LogError
from terrain.logs.checks import Check, Level
from terrain.logs.plausibility import judge
from terrain.logs.turn_checks import Scale
from terrain.records import RunLog
from terrain.robots import Robot

MAX_NAMED = 3
"""A sentence that concerns many runs is written for so many, and counted for the others."""


class Doubt(NamedTuple):
    """A check of a run that is doubtful or implausible."""

    run_id: str
    check: Check


def verdict(run: RunLog, robot: Robot | None = None) -> tuple[Check, ...]:
    """Return the checks of a run, with what is known of its robot.

    Parameters
    ----------
    run : as a reader returns it
    robot : that the user named; where the run names another, that of the package
    """
    try:
        known = robot_of(run, robot)
    except ConfigError:
        return judge(run)
    if not known.describes("motors"):
        return judge(run, Scale(known.track_m))
    return judge(run, Scale(known.track_m, known.motors.speed_max_radps * known.wheel_radius_m))


def doubts_of(verdicts: Mapping[str, Sequence[Check]]) -> tuple[Doubt, ...]:
    """Return what is doubtful or implausible in the checks of runs, by their id."""
    odd = (Level.DOUBTFUL, Level.IMPLAUSIBLE)
    return tuple(
        Doubt(run_id, check) for run_id, checks in verdicts.items() for check in checks if check.level in odd
    )


def refuse_implausible_runs(doubts: Sequence[Doubt]) -> None:
    """Raise :class:`LogError` with the first implausible check, and how many there are."""
    found = [doubt for doubt in doubts if doubt.check.level == Level.IMPLAUSIBLE]
    if not found:
        return
    runs = len({doubt.run_id for doubt in found})
    more = f" ({len(found)} such findings in {runs} run{'s' * (runs > 1)})" if len(found) > 1 else ""
    raise LogError(
        f"{found[0].run_id}: implausible {found[0].check.sentence}{more}; mend it where it is read, by a "
        "mapping, say, or import it as it is, and counted, with --repair"
    )


def counted(run: RunLog, checks: Sequence[Check]) -> RunLog:
    """Return a run that states among what was dropped or changed which checks it does not pass."""
    odd = Counter(f"implausible {check.check}" for check in checks if check.level == Level.IMPLAUSIBLE)
    return replace(run, dropped=Counter(run.dropped) + odd) if odd else run


def doubt_sentences(doubts: Sequence[Doubt]) -> Iterator[str]:
    """Yield a sentence a doubt; where one check concerns many runs, some of them and their number."""
    seen: Counter[tuple[str, str, Level]] = Counter()
    kinds = [(doubt.check.check, doubt.check.place, doubt.check.level) for doubt in doubts]
    for doubt, kind in zip(doubts, kinds, strict=True):
        seen[kind] += 1
        if seen[kind] <= MAX_NAMED:
            yield f"{doubt.run_id}: {doubt.check.level} {doubt.check.sentence}"
    for (check, place, level), n in Counter(kinds).items():
        if n > MAX_NAMED:
            yield f"{n - MAX_NAMED} more runs: {level} {check} ({place})"
