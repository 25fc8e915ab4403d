"""What ``terrain estimate`` has in every mode: its results, and what gets the runs with their estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar

from pipelines.report.figure import Figure
from pipelines.report.results import Result, described
from terrain.records import RunLog

Pictures = Callable[[], Mapping[str, Figure]]  #: Makes the pictures of a run, by name
Keep = Callable[[RunLog, Pictures], None]  #: Gets each run with its estimates, and what makes its pictures


class TracksResult(Result, kw_only=True):
    """Estimates of runs."""

    rows: ClassVar[str] = "runs"

    out: Path | None = described("folder that the runs were written to", default=None)
    skipped: tuple[str, ...] = described("a sentence for each run that a repairing read left out", default=())
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def records(self) -> Iterable[Any]:
        """Return a row a run or a surface."""
        return tuple(getattr(self, self.rows))
