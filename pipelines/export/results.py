"""What an export has written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Exported:
    """Runs that were written.

    Parameters
    ----------
    out : folder that they were written to
    files : name in it of each run's file or bag, by run
    topics : number of messages of each topic, of all runs
    dropped : what a repairing reader dropped, as counts by kind
    skipped : a sentence for each run that could not be read
    digest : of all runs; what is imported from the files has the same
    """

    out: Path
    n_runs: int
    files: Mapping[str, str]
    topics: Mapping[str, int]
    dropped: Mapping[str, int]
    skipped: tuple[str, ...]
    digest: str
