"""Results of ``terrain estimate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from terrain.estimation.summary import EstimateSummary
from terrain.estimation.tuned_noise import TunedNoise


@dataclass(frozen=True, slots=True)
class EstimateResult:
    """Estimates of runs.

    Parameters
    ----------
    filter, tuning : which filter, with which noise
    tuned : what the tuning ``likelihood`` did; None with another
    out : folder that the runs were written to, or None
    runs : figures of each run
    skipped : a sentence for each run that a repairing read left out
    clocks : a sentence where wheels and IMU of runs do not share a clock
    """

    filter: str
    tuning: str
    tuned: TunedNoise | None
    out: Path | None
    runs: tuple[EstimateSummary, ...]
    skipped: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()
