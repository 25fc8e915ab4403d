"""``terrain calibrate --what robot``: numbers of a description from run logs, written as a new one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.data.datasets import load_runs
from pipelines.report import Part, Report, Result, Shown, Text, described, frame, plural, sections
from pipelines.slip.shown import first_rows
from terrain.calibration.description import (
    IDENTIFIED,
    described_with,
    description_yaml,
    findings_of,
    hard_grounds,
)
from terrain.calibration.finding import Finding
from terrain.calibration.noise import measurement_variances
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog
from terrain.robots import Robot, SwerveRobot, read_description, robot_from

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.slip.modes import CalibrateSettings as Settings


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


@dataclass(frozen=True)
class CalibrationResult(Result):
    """A calibrated description."""

    robot: str = described("its name")
    out: str | None = described("file that was written")
    hard: tuple[str, ...] = described("terrain labels on which wheels were taken to slip next to nothing")
    run_ids: tuple[str, ...] = described("of the runs")
    findings: tuple[FindingRow, ...] = described("one a number")
    measurement_variances: Mapping[str, float] = described("of the calibrated robot by the filters' rows")

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a number, with its interval."""
        return frame(self.findings)


def calibrate_robot(settings: Settings, robot_name: str) -> CalibrationResult:
    """Calibrate a robot's description from its runs, and write it.

    Parameters
    ----------
    settings : of ``terrain calibrate``; nothing is written without ``out``
    robot_name : name of a robot or path of its YAML file, from which the calibration starts

    Raises
    ------
    LogError
        if a run cannot be read.
    ConfigError
        if the robot's description is not accepted, lacks a section or has effects, or ``out`` is there
        already or is no YAML file.
    DataError
        if a run is another robot's, the runs show nothing, or those of a skid-steer robot have no lidar.
    """
    file, description = read_description(robot_name)
    robot = robot_from(file, description)
    _check_robot(robot, file)
    out = None if settings.out is None else _new_file(settings.out)
    runs = load_runs(
        settings.data,
        layout=settings.layout,
        mapping=settings.mapping,
        repair=settings.repair,
        robot=robot_name if robot.skids else None,
    )
    _check_runs(runs, robot)
    grounds = hard_grounds() if settings.hard is None else settings.hard
    findings = findings_of(runs, description, robot, grounds)
    if not any(finding.determined for finding in findings):
        reasons = "; ".join(dict.fromkeys(finding.note for finding in findings))
        raise DataError(
            f"{settings.data}: nothing of robot {robot.name} can be calibrated from this: {reasons}"
        )
    name = file if out is None else out.name
    calibrated = described_with(description, findings)
    result = CalibrationResult(
        robot=robot.name,
        out=None if out is None else str(out),
        hard=grounds,
        run_ids=tuple(run.run_id for run in runs),
        findings=tuple(_row(finding, description) for finding in findings),
        measurement_variances=(
            measurement_variances(robot_from(name, calibrated)) if isinstance(robot, SwerveRobot) else {}
        ),
    )
    if out is not None:
        head = f"# Calibrated from {len(runs)} runs; what they could not tell is as it was in {file}.\n"
        atomic_write(out, head + description_yaml(calibrated))
    return result


def _sample(finding: FindingRow) -> str:
    runs = f", {plural(len(finding.runs), 'run')}" * (finding.counted != "runs")
    return f"{finding.n} {finding.counted}{runs}"


NUMBERS = (
    *(Shown("number", "parameter"), Shown("unit", "unit"), Shown("was", "described", ".4g")),
    *(Shown("is", "value", ".4g"), Shown("95 %", lambda row: (row.low, row.high), ".4g")),
    Shown("of", _sample),
)


def report(result: CalibrationResult) -> Report:
    """Return what was found, then what was not and why."""
    found = [row for row in result.findings if row.value is not None]
    moved = sum(
        row.described is not None and not (row.low or 0.0) <= row.described <= (row.high or 0.0)
        for row in found
    )
    first, all_numbers = first_rows(
        found, NUMBERS, f"{result.robot}, from {plural(len(result.run_ids), 'run')}"
    )
    parts: list[Part] = [first]
    if n_unknown := len(result.findings) - len(found):
        parts.append(
            Text(f"{n_unknown} numbers are not determined by these runs; the details say why.", "note")
        )
    return Report(
        f"Calibration of {result.robot}",
        f"{len(found)} numbers of {result.robot} are determined by {plural(len(result.run_ids), 'run')}; {moved} of "
        "them were described outside their 95 % interval.",
        parts=parts,
        details=sections(
            all_numbers, ("Not determined", _notes(result, False)), ("Assumed", _notes(result, True))
        ),
        next_step=f"terrain estimate --data DIR --filter FILTER --robot {result.out or 'FILE'} --out runs/",
    )


def _notes(result: CalibrationResult, of_found: bool) -> list[str]:
    """Return each note and the numbers to which it applies, of those that were found or of the others."""
    notes: dict[str, list[str]] = {}
    for finding in result.findings:
        if finding.note and (finding.value is not None) == of_found:
            notes.setdefault(finding.note, []).append(finding.parameter)
    return [f"{', '.join(names)}: {note}" for note, names in notes.items()]


def _check_robot(robot: Robot, file: str) -> None:
    """Refuse a robot that lacks a section, and one that is extended."""
    if not robot.skids:
        robot.require(*robot.sections)
    if robot.effects:  # what is calibrated would hold them a second time
        raise ConfigError(
            f"robot {robot.name}: {file} is extended by effects; calibrate the description without them, "
            "then explain again"
        )


def _check_runs(runs: Sequence[RunLog], robot: Robot) -> None:
    """Refuse runs of another robot, and, of a skid-steer robot, runs without speeds over ground."""
    if robot.skids and not any("lidar" in run.streams for run in runs):
        raise DataError(
            f"robot {robot.name}: drive {robot.drive!r} is not calibrated from logs without the stream "
            "'lidar', speeds over ground, which those of DRIVE have"
        )
    for run in runs:
        if run.robot != robot.name:
            raise DataError(
                f"run {run.run_id} is one of robot {run.robot!r}, and {robot.name!r} is calibrated"
            )


def _new_file(out: Path) -> Path:
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a robot's description is a .yaml file")
    if out.exists():
        raise ConfigError(f"{out}: is there already, and is left as it is; choose another --out")
    ensure_writable(out.absolute().parent)
    return out


def _row(finding: Finding, description: Any) -> FindingRow:
    section, _, name = finding.parameter.partition(".")
    entry = description.get(section, {}).get(name)
    value, low, high = (
        float(number) if math.isfinite(number) else None
        for number in (finding.value, finding.low, finding.high)
    )
    return FindingRow(
        finding.parameter,
        entry["unit"] if entry else name.rpartition("_")[2] if section == IDENTIFIED else "s",
        float(entry["value"]) if entry else None,
        value,
        low,
        high,
        finding.n,
        finding.counted,
        tuple(finding.runs),
        finding.note,
    )
