"""What is stated of single runs: why one is excluded, and how late its sensors are."""

from __future__ import annotations

from typing import NamedTuple


class Excluded(NamedTuple):
    """A run that is excluded as unfit, and why."""

    run_id: str
    reason: str


class Clock(NamedTuple):
    """Delay of the IMU's and the camera's logger behind the wheels' in a run, and its standard deviation."""

    run_id: str
    offset_s: float
    std_s: float
