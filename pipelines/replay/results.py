"""What a replay finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple


class ObservedWindow(NamedTuple):
    """A window as the live chain saw it.

    Parameters
    ----------
    start_s, end_s : on the clock of the run
    terrain, probability : output of the model; empty and NaN where it refused the window
    refused : why it did
    believed : terrain that was believed from then on; empty while it was unknown
    target_ratio : target slip in traction of the believed terrain
    label : of the run, where one covers the whole window
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    refused: str
    believed: str
    target_ratio: float
    label: str | None


class ReplayMoment(NamedTuple):
    """Where a replay is: time since the start of the run, its length, and what is believed there."""

    run_id: str
    time_s: float
    duration_s: float
    believed: str
    target_ratio: float


@dataclass(frozen=True, slots=True)
class ReplayedRun:
    """One run.

    Parameters
    ----------
    chain : ``pilot``, or ``observer`` of a robot without one
    duration_s, elapsed_s, times_real_time : length of what was replayed, how long that took, and their ratio
    terrains : fraction of the windows with an output, by terrain
    believed : fraction of the steps by terrain that was believed; empty for unknown
    accuracy : of the windows whose label is one of the model's classes; None without any
    n_judged : number of those
    dropped : what the chain did not use, as counts by kind
    interrupted : the replay was stopped before its end
    """

    run_id: str
    robot: str
    chain: str
    duration_s: float
    elapsed_s: float
    times_real_time: float
    n_steps: int
    n_windows: int
    n_refused: int
    terrains: Mapping[str, float]
    believed: Mapping[str, float]
    accuracy: float | None
    n_judged: int
    dropped: Mapping[str, int]
    interrupted: bool
    windows: tuple[ObservedWindow, ...]


@dataclass(frozen=True, slots=True)
class Replay:
    """All runs, and the same figures over all of them; ``skipped`` has a sentence for each unread run."""

    model: str | None
    table_name: str
    runs: tuple[ReplayedRun, ...]
    n_windows: int
    accuracy: float | None
    n_judged: int
    duration_s: float
    elapsed_s: float
    times_real_time: float
    interrupted: bool
    skipped: tuple[str, ...]
