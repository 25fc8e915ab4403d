"""Numbers of a robot's description from its runs, and the description with them, as YAML."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import yaml

from terrain.calibration.finding import Finding
from terrain.calibration.lag import starts_and_stops, time_constants
from terrain.calibration.omni import identify_omni
from terrain.calibration.sensors import MIN_POSITION_S, accelerometer, gyro_bias, sensor_noise, standing
from terrain.calibration.skid_steer import identify
from terrain.calibration.wheels import SLIP_RATIO, reduction_ratio, steady_stretches, steering_zeros, why_none
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, robot_from
from terrain.terramechanics.soil import load_soil, soil_names

IDENTIFIED = "identified"  #: Section of a description that need not be there before.
MAX_NAMED_RUNS = 4  #: A source names that many runs, and counts more.


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


def findings_of(runs: Sequence[RunLog], description: Any, robot: Robot, hard: Sequence[str]) -> list[Finding]:
    """Return what the runs of a robot show, by its drive, beside what its description has.

    ``DataError`` if a run is another robot's, or those of a skid-steer robot have no lidar.
    """
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
    if robot.skids:
        findings = identify(runs, robot.wheel_radius_m, hard)
    elif isinstance(robot, OmniRobot):
        findings = identify_omni(runs, robot)
    else:
        findings = find(runs, description, robot, hard)
    return [_beside(finding, description) for finding in findings]


def _beside(finding: Finding, description: Any) -> Finding:
    """Return a finding with its unit, and the number that a description has of it."""
    section, _, name = finding.parameter.partition(".")
    entry = description.get(section, {}).get(name)
    if entry:
        return finding._replace(unit=entry["unit"], described=float(entry["value"]))
    return finding._replace(unit=name.rpartition("_")[2] if section == IDENTIFIED else "s")


def find(runs: Sequence[RunLog], description: Any, robot: Robot, hard: Sequence[str]) -> list[Finding]:
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
    better = robot_from(robot.name, described_with(description, findings))
    events = [event for run in runs for event in starts_and_stops(run, better, hard)]
    lags = time_constants(events)
    return findings + (
        lags if events else [finding._replace(note=why_none(runs, robot, hard)) for finding in lags]
    )


def described_with(description: Any, findings: Sequence[Finding]) -> Any:
    """Return a description with the numbers that were found, rounded to a hundredth of their intervals."""
    found = copy.deepcopy(description)
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


def description_yaml(description: Any) -> str:
    """Return a description as YAML with one number a line."""
    lines = []
    for key, entry in description.items():
        section = isinstance(entry, dict) and "value" not in entry
        lines += [f"{key}:"] if section else [f"{key}: {_flow(entry)}"]
        if section:
            lines += [f"  {name}: {_flow(number)}" for name, number in entry.items()]
    return "\n".join(lines) + "\n"


def _flow(entry: Any) -> str:
    text = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)
    return str(text).removesuffix("...\n").strip()
