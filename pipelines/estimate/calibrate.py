"""``terrain calibrate``: numbers of a robot's description from run logs, written as a new description."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from pipelines.data.datasets import load_runs
from pipelines.estimate.calibration_results import CalibrationResult, FindingRow
from terrain.calibration.finding import Finding
from terrain.calibration.lag import starts_and_stops, time_constants
from terrain.calibration.noise import measurement_variances, sensor_noise
from terrain.calibration.omni import identify_omni
from terrain.calibration.six_positions import MIN_POSITION_S, accelerometer
from terrain.calibration.skid_steer import identify
from terrain.calibration.standing import gyro_bias, standing
from terrain.calibration.steady import steady_stretches, why_none
from terrain.calibration.wheels import SLIP_RATIO, reduction_ratio, steering_zeros
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, SwerveRobot, read_description, robot_from
from terrain.terramechanics.soil import load_soil, soil_names

IDENTIFIED = "identified"
"""Section of a description that need not be there before."""

MAX_NAMED_RUNS = 4
"""A source names that many runs, and counts more."""


def calibrate(
    data: str | Path,
    robot_name: str,
    out: str | Path | None = None,
    *,
    hard: Sequence[str] | None = None,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
) -> CalibrationResult:
    """Calibrate a robot's description from its runs, and write it.

    Parameters
    ----------
    data, layout, mapping, repair : as in :func:`pipelines.data.datasets.load_runs`
    robot_name : name of a robot or path of its YAML file, from which the calibration starts
    out : new YAML file; nothing is written without
    hard : terrain labels of ground on which wheels slip next to nothing; :func:`hard_grounds` by default

    Returns
    -------
    CalibrationResult

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
    file, described = read_description(robot_name)
    robot = robot_from(file, described)
    _check_robot(robot, file)
    out = None if out is None else _new_file(Path(out))
    runs = load_runs(
        data, layout=layout, mapping=mapping, repair=repair, robot=robot_name if robot.skids else None
    )
    _check_runs(runs, robot)
    grounds = hard_grounds() if hard is None else tuple(hard)
    findings = _findings(runs, described, robot, grounds)
    if not any(finding.determined for finding in findings):
        reasons = "; ".join(dict.fromkeys(finding.note for finding in findings))
        raise DataError(f"{data}: nothing of robot {robot.name} can be calibrated from this: {reasons}")
    name = file if out is None else out.name
    calibrated = described_with(described, findings)
    result = CalibrationResult(
        robot=robot.name,
        out=None if out is None else str(out),
        hard=grounds,
        run_ids=tuple(run.run_id for run in runs),
        findings=tuple(_row(finding, described) for finding in findings),
        measurement_variances=(
            measurement_variances(robot_from(name, calibrated)) if isinstance(robot, SwerveRobot) else {}
        ),
    )
    if out is not None:
        head = f"# Calibrated from {len(runs)} runs; what they could not tell is as it was in {file}.\n"
        atomic_write(out, head + _yaml_text(calibrated))
    return result


def _findings(runs: Sequence[RunLog], described: Any, robot: Robot, hard: Sequence[str]) -> list[Finding]:
    """Return what the runs of a robot show, by its drive."""
    if robot.skids:
        return identify(runs, robot.wheel_radius_m, hard)
    if isinstance(robot, OmniRobot):
        return identify_omni(runs, robot)
    return find(runs, described, robot, hard)


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


def hard_grounds() -> tuple[str, ...]:
    """Return the soils on which a rolling wheel slips no more than the calibration of the ratio allows for.

    Examples
    --------
    >>> hard_grounds()
    ('asphalt', 'tiles')
    """
    soils = [load_soil(name) for name in soil_names()]
    return tuple(
        soil.name
        for soil in soils
        if soil.law == "magic"
        and soil.rolling_resistance_ratio
        <= SLIP_RATIO[1] * soil.stiffness_ratio * soil.shape_ratio * soil.peak_friction_ratio
    )


def find(runs: Sequence[RunLog], described: Any, robot: Robot, hard: Sequence[str]) -> list[Finding]:
    """Return a finding for each number that logs can determine, with the reason where these do not."""
    resting = [stretch for run in runs for stretch in standing(run, robot)]
    held = [stretch for run in runs for stretch in standing(run, robot, MIN_POSITION_S)]
    findings = [*gyro_bias(resting, robot), *accelerometer(held, robot), *sensor_noise(resting, robot)]
    steady = [stretch for run in runs for stretch in steady_stretches(run, robot, hard)]
    driven = [*steering_zeros(steady, robot), reduction_ratio(steady, robot)]
    findings += (
        driven if steady else [finding._replace(note=why_none(runs, robot, hard)) for finding in driven]
    )
    # Starts are distinguished from turns by the steering angles, with the zeros that have just been found.
    better = robot_from(robot.name, described_with(described, findings))
    events = [event for run in runs for event in starts_and_stops(run, better, hard)]
    lags = time_constants(events)
    return findings + (
        lags if events else [finding._replace(note=why_none(runs, robot, hard)) for finding in lags]
    )


def described_with(described: Any, findings: Sequence[Finding]) -> Any:
    """Return a description with the numbers that were found, rounded to a hundredth of their intervals."""
    found = copy.deepcopy(described)
    for finding in findings:
        section, _, name = finding.parameter.partition(".")
        if section == IDENTIFIED and finding.determined:
            unit = name.rpartition("_")[2]
            found.setdefault(section, {}).setdefault(name, {"unit": unit})
        if not finding.determined or name not in found.get(section, {}):
            continue
        half = (finding.high - finding.low) / 2
        digits = 2 - math.floor(math.log10(half)) if half > 0 else 12
        named = ": " + ", ".join(finding.runs) if len(finding.runs) <= MAX_NAMED_RUNS else ""
        found[section][name] = {
            "value": round(finding.value, digits),
            "unit": found[section][name]["unit"],
            "source": f"terrain calibrate, {len(finding.runs)} run{'s' * (len(finding.runs) > 1)}{named}",
            "interval": [round(finding.low, digits), round(finding.high, digits)],
        }
    return found


def _new_file(out: Path) -> Path:
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a robot's description is a .yaml file")
    if out.exists():
        raise ConfigError(f"{out}: is there already, and is left as it is; choose another --out")
    ensure_writable(out.absolute().parent)
    return out


def _row(finding: Finding, described: Any) -> FindingRow:
    section, _, name = finding.parameter.partition(".")
    entry = described.get(section, {}).get(name)
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


def _yaml_text(described: Any) -> str:
    """Return a description as YAML with one number a line."""
    lines = []
    for key, entry in described.items():
        section = isinstance(entry, dict) and "value" not in entry
        lines += [f"{key}:"] if section else [f"{key}: {_flow(entry)}"]
        if section:
            lines += [f"  {name}: {_flow(number)}" for name, number in entry.items()]
    return "\n".join(lines) + "\n"


def _flow(entry: Any) -> str:
    text = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)
    return str(text).removesuffix("...\n").strip()
