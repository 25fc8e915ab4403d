"""What ``terrain calibrate`` finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FindingRow:
    """One number of a robot's description.

    Parameters
    ----------
    parameter, unit : section and name, and the unit
    described : before; None where the description has no such number
    value, low, high : calibrated, with its 95 % interval; None where the runs do not tell it
    n, counted : size of the sample, and what is counted
    runs : ids of the runs it was found on
    note : what is assumed, or why there is no value
    """

    parameter: str
    unit: str
    described: float | None
    value: float | None
    low: float | None
    high: float | None
    n: int
    counted: str
    runs: tuple[str, ...]
    note: str


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A calibrated description.

    Parameters
    ----------
    robot : its name
    out : file that was written, or None
    hard : terrain labels on which wheels were taken to slip next to nothing
    run_ids : of the runs
    findings : one a number
    measurement_variances : of the calibrated robot by the filters' rows
    """

    robot: str
    out: str | None
    hard: tuple[str, ...]
    run_ids: tuple[str, ...]
    findings: tuple[FindingRow, ...]
    measurement_variances: Mapping[str, float]
