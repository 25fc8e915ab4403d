"""Windows, classifiers and their evaluation in Python."""

from __future__ import annotations

from collections.abc import Iterable

from features.windows import SteadyMotion, WindowRule
from features.windows import cut_windows as cut
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.crossval import cross_validate
from terrain.errors import DataError
from terrain.records import RunLog, Windows

__all__ = ["TerrainClassifier", "cross_validate", "cut_windows"]


def cut_windows(
    runs: Iterable[RunLog], length_s: float = 2.0, stride_s: float | None = None, *, steady: bool = True
) -> Windows:
    """Cut runs into windows of equal length; runs that are shorter are left out.

    Parameters
    ----------
    runs : whose channels and rates fit each other
    length_s, stride_s : of a window, and from start to start; one length by default
    steady : keep windows of steady motion only

    Raises
    ------
    DataError
        if no window is left, or runs do not fit each other.

    Examples
    --------
    >>> import terrain
    >>> terrain.cut_windows([terrain.simulate("husky", "grass", "straight", duration_s=8.0)])
    3 windows of 2 s from 1 runs: grass
    """
    rule = WindowRule(length_s, stride_s, SteadyMotion() if steady else None)
    found = cut(list(runs), rule, skip_short=True)
    if not len(found.windows):
        dropped = ", ".join(f"{n} {why}" for why, n in found.dropped.items())
        raise DataError(
            f"no window of {length_s:g} s is left; dropped: {dropped or 'none, there are no runs'}"
        )
    return found.windows
