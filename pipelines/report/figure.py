"""A figure as it is described: panels with marks, and not how these are drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

Span = tuple[float, float, str]  #: Start, end and name of an interval


class Mark(NamedTuple):
    """What is drawn in a panel, in a colour of the palette by its number, or the next one."""

    kind: Literal["line", "points", "band", "bars", "strip"]
    label: str
    x: Any
    y: Any = None
    low: Any = None
    high: Any = None
    colour: int | None = None
    dashed: bool = False


def Line(label: str, x: Any, y: Any, colour: int | None = None, dashed: bool = False) -> Mark:
    """Return a line through points ``x, y`` (n,); NaN is a gap."""
    return Mark("line", label, x, y, colour=colour, dashed=dashed)


def Band(label: str, x: Any, low: Any, high: Any, colour: int | None = None) -> Mark:
    """Return the area between ``low`` and ``high`` (n,) over ``x`` (n,)."""
    return Mark("band", label, x, low=low, high=high, colour=colour)


Points = partial(Mark, "points")
"""Points ``label, x, y``, with bars from ``low`` to ``high`` (n,) where these are given."""

Bars = partial(Mark, "bars")
"""A horizontal bar for each category, ``label, categories, values``, with an interval ``low, high`` where one is
given; several are grouped."""

Strip = partial(Mark, "strip", "")
"""Coloured intervals along x, each a :data:`Span`; one name has one colour."""


def spans(time_s: Any, codes: Any, names: Mapping[int, str]) -> list[Span]:
    """Return the intervals in which a code (n,) has a name, from its first sample to that of the next code.

    Examples
    --------
    >>> spans(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0, 1, 1, 0]), {1: "braking"})
    [(1.0, 3.0, 'braking')]
    """
    codes = np.nan_to_num(codes, nan=-99.0)  # no status
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    ends = [*time_s[first[1:]].tolist(), float(time_s[-1])]
    intervals = []
    for i, end in zip(first, ends, strict=True):
        if int(codes[i]) in names:
            intervals.append((float(time_s[i]), end, names[int(codes[i])]))
    return intervals


@dataclass(frozen=True)
class Panel:
    """Axes with marks; ``equal`` where both axes have one scale, as of a path."""

    marks: Sequence[Mark]
    y_label: str = ""
    title: str = ""
    x_label: str = ""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    equal: bool = False
    log_x: bool = False


@dataclass(frozen=True)
class Figure:
    """Panels below one another."""

    title: str  #: above
    panels: Sequence[Panel]  #: from the top
    caption: str = ""  #: below: what is to be seen
    x_label: str = ""  #: of the last panel
