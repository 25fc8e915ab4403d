"""What ``terrain label`` finds and changes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from terrain.records import Label


class DoubtfulWindow(NamedTuple):
    """A window whose output does not count.

    Parameters
    ----------
    run_id, start_s, end_s : which one
    terrain, probability : output of the model; empty and NaN where it refused the window
    refused : why it did
    label : of the run, where one covers the whole window
    """

    run_id: str
    start_s: float
    end_s: float
    terrain: str
    probability: float
    refused: str
    label: str | None


class RunWindows(NamedTuple):
    """Windows of a run: how many there are, are doubtful, and of those lack a label; None: none recorded."""

    run_id: str
    n_windows: int | None
    n_doubtful: int
    n_without_label: int


@dataclass(frozen=True, slots=True)
class DoubtfulWindows:
    """Windows of low confidence of all runs of a folder, in the order of the runs and of time."""

    data: Path
    runs: tuple[RunWindows, ...]
    windows: tuple[DoubtfulWindow, ...]


@dataclass(frozen=True, slots=True)
class LabelledRun:
    """A run whose labels were changed; ``terrain`` is empty where they were removed."""

    run_id: str
    folder: Path
    start_s: float
    end_s: float
    terrain: str
    labels: tuple[Label, ...]
