"""What ``terrain estimate`` has in every mode: results, a pass over runs, and lines of estimates over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from pipelines.report import Band, Figure, Line, Mark, Progress, Result, Strip, described, frame
from terrain.records import Array, RunLog

if TYPE_CHECKING:
    import pandas as pd

Found = TypeVar("Found")

Keep = Callable[[RunLog, Callable[[], Mapping[str, Figure]]], None]
"""Gets each run with its estimates, and what makes its pictures by name."""

MAX_PICTURED = 3
"""Runs whose pictures a page has; ``--figures`` writes those of all."""

MAX_POINTS = 2000
"""More points a line than this are more than a picture can show."""

TRUTH_COLOUR = 6
"""Grey, for what was true, of every estimate."""

SLIP = "+.4f"


@dataclass(frozen=True, kw_only=True)
class TracksResult(Result):
    """Estimates of runs."""

    rows: ClassVar[str] = "runs"

    out: Path | None = described("folder that the runs were written to", default=None)
    skipped: tuple[str, ...] = described("a sentence for each run that a repairing read left out", default=())
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a run or a surface."""
        return frame(getattr(self, self.rows))


def estimate_each(
    runs: Sequence[RunLog],
    name: str,
    estimate: Callable[[RunLog], Found],
    summarize: Callable[[Found], Any],
    with_tracks: Callable[[Found], RunLog],
    figures_of: Callable[[Found], dict[str, Figure]],
    progress: Progress,
    keep: Keep | None,
) -> dict[str, Any]:
    """Return of a result the name of its ``filter``, the figures of ``runs``, and ``pictures`` of the first ones."""
    rows: list[Any] = []
    pictures: dict[str, Figure] = {}
    for done, run in enumerate(runs, start=1):
        found = estimate(run)
        rows.append(summarize(found))
        if keep is not None:
            keep(with_tracks(found), partial(figures_of, found))
        pictures |= figures_of(found) if done <= MAX_PICTURED else {}
        progress(f"estimate {name}", done, len(runs))
    return {"filter": name, "runs": tuple(rows), "pictures": pictures}


def next_step(filter_name: str, out: Path | None) -> str:
    """Return what follows an estimate: learning on runs that were written, or writing them."""
    writing = f"terrain estimate --data DIR --filter {filter_name} --out runs/"
    return writing if out is None else f"terrain crossval --data {out}"


def line(label: str, time_s: Array, values: Any, colour: int | None = None, *, dashed: bool = False) -> Line:
    """Return a line of thinned points.

    Parameters
    ----------
    label, colour, dashed : as :class:`pipelines.report.Line`
    time_s, values : (n,)
    """
    every = max(1, len(time_s) // MAX_POINTS)
    return Line(label, time_s[::every], np.asarray(values)[::every], colour=colour, dashed=dashed)


def band(label: str, time_s: Array, mean: Array, half: Array, colour: int | None = None) -> Band:
    """Return the thinned band ``mean - half`` to ``mean + half``, all (n,)."""
    every = max(1, len(time_s) // MAX_POINTS)
    return Band(label, time_s[::every], (mean - half)[::every], (mean + half)[::every], colour=colour)


def estimated(
    label: str, time_s: Array, mean: Array, std: Array, n_std: int, true: Array | None = None
) -> list[Mark]:
    """Return an estimate over time, the band of its standard deviations, and what was true where that is known.

    Parameters
    ----------
    label : of the estimate
    time_s, mean, std, true : (n,)
    n_std : standard deviations that the band reaches
    """
    marks: list[Mark] = [
        band(f"± {n_std} std", time_s, mean, n_std * std, 0),
        line(label, time_s, mean, 0),
    ]
    return marks if true is None else [*marks, line("truth", time_s, true, TRUTH_COLOUR, dashed=True)]


def spans(time_s: Array, marked: Array, name: str) -> list[Strip]:
    """Return a strip of the intervals in which instants are marked; none where no instant is.

    Parameters
    ----------
    time_s : (n,)
    marked : (n,) of booleans
    name : of what the intervals show

    Examples
    --------
    >>> spans(np.arange(5.0), np.array([False, True, True, False, True]), "stuck")
    [Strip(spans=((1.0, 3.0, 'stuck'), (4.0, 4.0, 'stuck')))]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    last = len(time_s) - 1
    found = tuple(
        (float(time_s[begin]), float(time_s[min(end, last)]), name) for begin, end in edges.reshape(-1, 2)
    )
    return [Strip(found)] if found else []
