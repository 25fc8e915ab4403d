"""What importing and inspecting runs find."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.runs.breaks import OddStretch
from pipelines.runs.verdicts import Doubt
from terrain.logs.checks import Check
from terrain.logs.clock import ClockEstimate
from terrain.logs.duplicates import SharedStretch
from terrain.logs.quality import StreamQuality


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


@dataclass(frozen=True, slots=True)
class InspectedRun:
    """The quality of the streams of one run.

    ``clock`` is None where the run has no gyro or no speeds of a left and a right wheel, or its robot is
    unknown.  ``odd_stretches`` differ from the rest of the run.  ``plausibility`` has every check.
    """

    run_id: str
    terrains: tuple[str, ...]
    dropped: Mapping[str, int]
    streams: Mapping[str, StreamQuality]
    clock: ClockEstimate | None
    odd_stretches: tuple[OddStretch, ...] = ()
    plausibility: tuple[Check, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return all fields, the figures of channels by quantity."""
        return {
            "run_id": self.run_id,
            "terrains": self.terrains,
            "dropped": self.dropped,
            "streams": {name: _stream_json(quality) for name, quality in self.streams.items()},
            "clock": self.clock,
            "odd_stretches": self.odd_stretches,
            "plausibility": self.plausibility,
        }


def _stream_json(quality: StreamQuality) -> dict[str, Any]:
    channels = quality.channels.items()
    return {key: value for key, value in quality._asdict().items() if key != "channels"} | {
        "stuck": quality.stuck,
        "n_nonfinite": {name: channel.n_nonfinite for name, channel in channels},
        "longest_constant_s": {name: channel.longest_constant_s for name, channel in channels},
    }


@dataclass(frozen=True, slots=True)
class Inspection:
    """The quality of all runs.

    ``skipped`` has a sentence for each run that could not be read, ``duplicates`` the stretches that two
    runs share.
    """

    n_runs: int
    digest: str
    skipped: tuple[str, ...]
    runs: tuple[InspectedRun, ...]
    duplicates: tuple[SharedStretch, ...] = ()
