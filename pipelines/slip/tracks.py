"""What ``terrain estimate`` has in every mode: its results, and of filters and observers a pass and a report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar

from pipelines.report.figure import Band, Figure, Line, Mark
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Column, Part, Report, sections
from pipelines.slip.shown import first_rows, known_columns
from terrain.records import Array, RunLog

Pictures = Callable[[], Mapping[str, Figure]]  #: Makes the pictures of a run, by name
Keep = Callable[[RunLog, Pictures], None]  #: Gets each run with its estimates, and what makes its pictures

MAX_PICTURED = 3  #: Runs whose pictures a page has; ``--figures`` writes those of all
TRUTH_COLOUR = 6  #: Grey, for what was true, of every estimate

SLIP = "+.4f"


class TracksResult(Result, kw_only=True):
    """Estimates of runs."""

    rows: ClassVar[str] = "runs"

    out: Path | None = described("folder that the runs were written to", default=None)
    skipped: tuple[str, ...] = described("a sentence for each run that a repairing read left out", default=())
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def records(self) -> Iterable[Any]:
        """Return a row a run or a surface."""
        return tuple(getattr(self, self.rows))


def estimate_each(
    runs: Sequence[RunLog],
    name: str,
    estimate: Callable[[RunLog], tuple[Any, RunLog, Pictures]],
    progress: Progress,
    keep: Keep | None,
) -> dict[str, Any]:
    """Return of a result the name of its ``filter``, the figures of ``runs``, and ``pictures`` of the first ones.

    ``estimate`` gives the figures of a run, the run with its estimates, and what makes its pictures.
    """
    rows: list[Any] = []
    pictures: dict[str, Figure] = {}
    for done, run in enumerate(runs, start=1):
        summary, tracked, draw = estimate(run)
        rows.append(summary)
        if keep is not None:
            keep(tracked, draw)
        pictures |= draw() if done <= MAX_PICTURED else {}
        progress(f"estimate {name}", done, len(runs))
    return {"filter": name, "runs": tuple(rows), "pictures": pictures}


def tracks_report(
    result: Any,
    title: str,
    answer: str,
    rows: tuple[Sequence[Any], Sequence[Column], str],
    texts: tuple[str, Sequence[str]] = ("", ()),
    parts: Sequence[Part] = (),
) -> Report:
    """Return the report of a filter or an observer, which leads with the slip of the first run that has one.

    Parameters
    ----------
    result : with its ``filter``, ``out``, ``pictures`` and ``skipped``
    title, answer, parts : of the report, ``parts`` after its table
    rows : of its table, with its columns, of which those of a truth that no run has are left out, and its title
    texts : a section of the details; empty for none
    """
    records, columns, heading = rows
    first, all_rows = first_rows(records, known_columns(columns, records), heading)
    pictures = dict(result.pictures)
    lead = next((name for name in pictures if name.endswith("_slip")), next(iter(pictures), ""))
    writing = f"terrain estimate --data DIR --filter {result.filter} --out runs/"
    return Report(
        title,
        answer,
        pictures.pop(lead, None),
        [first, *parts],
        sections(all_rows, texts, ("Pictures", list(pictures.values())), ("Not read", result.skipped)),
        writing if result.out is None else f"terrain crossval --data {result.out}",
    )


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
        Band(f"± {n_std} std", time_s, mean - n_std * std, mean + n_std * std, 0),
        Line(label, time_s, mean, 0),
    ]
    return marks if true is None else [*marks, Line("truth", time_s, true, TRUTH_COLOUR, dashed=True)]
