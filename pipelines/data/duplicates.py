"""Runs of a data set that hold the same measurements: what is reported, refused or merged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from terrain.errors import DataError
from terrain.logs.duplicates import SharedStretch, groups_of, shared_stretches
from terrain.logs.merge import merge_runs, refuse_other_labels
from terrain.records import RunLog

MAX_SHOWN = 3
"""Pairs that a refusal names."""


class DistinctRuns(NamedTuple):
    """Runs of which no two hold the same measurements, and the ids of those that were merged."""

    runs: list[RunLog]
    merged: tuple[tuple[str, ...], ...] = ()


def distinct_runs(runs: Sequence[RunLog], *, merge: bool) -> DistinctRuns:
    """Return runs of which no two hold the same measurements.

    Parameters
    ----------
    runs : of one data set
    merge : make one run of those that share a stretch, which then counts once; else they are refused

    Raises
    ------
    DataError
        if runs share a stretch and are not to be merged, or label it differently.
    """
    found = shared_stretches(runs)
    if not found:
        return DistinctRuns(list(runs))
    refuse_other_labels(runs, found)
    if not merge:
        raise DataError(
            f"{'; '.join(sentences(found))}: held out, they would be recognised and not classified; remove "
            "one of them, or use --merge-duplicates to treat them as one run"
        )
    return DistinctRuns(merge_runs(runs, found), groups_of(found))


def sentences(found: Sequence[SharedStretch]) -> list[str]:
    """Return what the shared stretches are, in words; beyond the first ones their number.

    Examples
    --------
    >>> sentences([SharedStretch("a", "b", 0.0, 9.0, 100.0, 109.0)])
    ['runs a and b hold the same measurements for 9.0 s (from 0.0 s of a and 100.0 s of b)']
    """
    shown = [
        f"runs {each.first} and {each.second} hold the same measurements for {each.duration_s:.1f} s "
        f"(from {each.first_start_s:.1f} s of {each.first} and {each.second_start_s:.1f} s of {each.second})"
        for each in found[:MAX_SHOWN]
    ]
    if len(found) > MAX_SHOWN:
        shown.append(f"and so do {len(found) - MAX_SHOWN} more pairs of runs")
    return shown
