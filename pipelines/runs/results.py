"""What importing and inspecting runs find."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipelines.data.plausibility import Doubt
from terrain.logs.duplicates import SharedStretch


@dataclass(frozen=True, slots=True)
class Imported:
    """Runs that were written.

    Parameters
    ----------
    out : folder that they were written to
    run_ids : of all runs, sorted
    labels : runs by terrain
    dropped : what a repairing reader dropped, as counts by kind
    skipped : a sentence for each run that could not be read
    digest : of all runs
    duplicates : stretches that two of the runs share
    doubts : checks that are doubtful or implausible
    """

    out: Path
    n_runs: int
    run_ids: tuple[str, ...]
    labels: Mapping[str, int]
    dropped: Mapping[str, int]
    skipped: tuple[str, ...]
    digest: str
    duplicates: tuple[SharedStretch, ...] = ()
    doubts: tuple[Doubt, ...] = ()
