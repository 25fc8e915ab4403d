"""``terrain calibrate --what robot``: numbers of a description from run logs, written as a new one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from pipelines.data.datasets import load
from pipelines.report.numbers import plural
from pipelines.report.results import Progress, Result, described
from pipelines.report.settings import check_file
from pipelines.report.tree import Column, Report, Text, sections
from pipelines.slip.calibrate import Settings
from pipelines.slip.shown import first_rows
from terrain.calibration.description import described_with, description_yaml, findings_of, hard_grounds
from terrain.calibration.finding import Finding
from terrain.calibration.sensors import measurement_variances
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write
from terrain.files.documents import read_yaml
from terrain.robots import SwerveRobot, description_file, robot_from


class CalibrationResult(Result):
    """A calibrated description."""

    robot: str = described("its name")
    out: str | None = described("file that was written")
    hard: tuple[str, ...] = described("terrain labels on which wheels were taken to slip next to nothing")
    run_ids: tuple[str, ...] = described("of the runs")
    findings: tuple[Finding, ...] = described("one a number")
    measurement_variances: Mapping[str, float] = described("of the calibrated robot by the filters' rows")

    def records(self) -> Iterable[Any]:
        """Return a row a number, with its interval."""
        return self.findings


def calibrate(settings: Settings, progress: Progress) -> CalibrationResult:
    """Calibrate a robot's description from its runs, and write it; without ``out`` nothing is written.

    Raises
    ------
    LogError
        if a run cannot be read.
    ConfigError
        if the robot's description is not accepted, lacks a section or has effects or learned terms, or ``out`` is there
        already or is no YAML file.
    DataError
        if a run is another robot's, or the runs show nothing.
    """
    assert settings.robot is not None
    path = description_file(settings.robot)
    file, description = path.name, read_yaml(path)
    robot = robot_from(file, description)
    if robot.effects or robot.learned:  # what is calibrated would hold them a second time
        what = "effects" if robot.effects else "learned terms"
        raise ConfigError(
            f"robot {robot.name}: {file} is extended by {what}; calibrate the description without them, "
            "then explain again"
        )
    if (out := settings.out) is not None:
        check_file(out, "--out", (".yaml", ".yml"))
        if out.exists():
            raise ConfigError(f"{out}: is there already, and is left as it is; choose another --out")
    runs, _, doubts = load(settings)
    grounds = hard_grounds() if settings.hard is None else settings.hard
    findings = findings_of(runs, description, robot, grounds)
    if not any(finding.determined for finding in findings):
        reasons = "; ".join(dict.fromkeys(finding.note for finding in findings))
        raise DataError(
            f"{settings.data}: nothing of robot {robot.name} can be calibrated from this: {reasons}"
        )
    progress("calibrate", 1, 1)
    calibrated = described_with(description, findings)
    variances: Mapping[str, float] = {}
    if isinstance(robot, SwerveRobot):
        variances = measurement_variances(robot_from(out.name if out else file, calibrated))
    if out is not None:
        head = f"# Calibrated from {len(runs)} runs; what they could not tell is as it was in {file}.\n"
        atomic_write(out, head + description_yaml(calibrated))
    return CalibrationResult(
        robot=robot.name,
        out=None if out is None else str(out),
        hard=grounds,
        run_ids=tuple(run.run_id for run in runs),
        findings=tuple(findings),
        measurement_variances=variances,
    ).with_doubts(doubts)


def _sample(finding: Finding) -> str:
    runs = f", {plural(len(finding.runs), 'run')}" * (finding.counted != "runs")
    return f"{finding.n} {finding.counted}{runs}"


NUMBERS = (
    Column("number", of="parameter"),
    Column("unit", of="unit"),
    Column("was", ".4g", of="described"),
    Column("is", ".4g", of="value"),
    Column("95 %", ".4g", of=lambda row: (row.low, row.high)),
    Column("of", of=_sample),
)


def report(result: CalibrationResult) -> Report:
    """Return what was found, then what was not and why."""
    found = [row for row in result.findings if row.determined]
    moved = sum(row.described is not None and not row.low <= row.described <= row.high for row in found)
    n_runs = plural(len(result.run_ids), "run")
    first, all_numbers = first_rows(found, NUMBERS, f"{result.robot}, from {n_runs}")
    notes: dict[bool, dict[str, list[str]]] = {False: defaultdict(list), True: defaultdict(list)}
    for row in result.findings:
        if row.note:
            notes[row.determined][row.note].append(row.parameter)
    unknown, assumed = ([f"{', '.join(each[note])}: {note}" for note in each] for each in notes.values())
    n_unknown = len(result.findings) - len(found)
    text = f"{n_unknown} numbers are not determined by these runs; the details say why."
    return Report(
        f"Calibration of {result.robot}",
        f"{len(found)} numbers of {result.robot} are determined by {n_runs}; {moved} of "
        "them were described outside their 95 % interval.",
        parts=[first, Text(text, "note")] if n_unknown else [first],
        details=sections(all_numbers, ("Not determined", unknown), ("Assumed", assumed)),
        next_step=f"terrain estimate --data DIR --robot {result.out or 'FILE'} --out runs/",
    )
