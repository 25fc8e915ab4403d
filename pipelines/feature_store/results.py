"""What making a store of features gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from terrain.logs.duplicates import SharedStretch


@dataclass(frozen=True, slots=True)
class StoreReport:
    """A store of features, and what was done to make it.

    Parameters
    ----------
    out : its folder
    n_runs, n_windows, n_features : that it holds
    n_computed : runs that were computed now; the others were there
    dropped : windows left out, as counts by reason
    repaired : what a repairing reader dropped, as counts by kind
    skipped : a sentence for each run that could not be read
    duplicates : stretches that two of the runs share; crossval and train refuse them
    """

    out: Path
    n_runs: int
    n_computed: int
    n_windows: int
    n_features: int
    dropped: Mapping[str, int]
    repaired: Mapping[str, int]
    skipped: tuple[str, ...]
    duplicates: tuple[SharedStretch, ...]
