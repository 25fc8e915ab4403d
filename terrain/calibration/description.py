"""Numbers of a robot's description from its runs, and the description with them, as YAML."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import yaml

from terrain.calibration.finding import Finding
from terrain.calibration.lag import starts_and_stops, time_constants
from terrain.calibration.motion import RADIUS, motion_findings
from terrain.calibration.motors import motor_constant
from terrain.calibration.omni import identify_omni
from terrain.calibration.sensors import (
    LEVEL_ONLY,
    MIN_POSITION_S,
    NO_STANDING,
    accelerometer,
    gyro_bias,
    mounting,
    sensor_noise,
    standing,
    wheel_noise,
)
from terrain.calibration.wheels import (
    SLIP_RATIO,
    hard_stretches,
    reduction_ratio,
    steady_stretches,
    steering_zeros,
    why_none,
)
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, SwerveRobot, robot_from
from terrain.simulation.assumed import with_assumed
from terrain.terramechanics.soil import load_soil, soil_names

IDENTIFIED = "identified"  #: Section of a description that need not be there before.
NO_IMU = "no run has an IMU (stream 'imu'), by which rest is known, and whose biases, noise and mounting rest shows"
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
    """Return what the runs of a robot show, by whatever measured its motion, beside what its description has.

    What a stream would show that no run has is there without a value.  ``DataError`` if a run is another robot's;
    ``ConfigError`` if the description of a swerve robot lacks a section.
    """
    for run in runs:
        if run.robot != robot.name:
            raise DataError(
                f"run {run.run_id} is one of robot {run.robot!r}, and {robot.name!r} is calibrated"
            )
    if isinstance(robot, SwerveRobot):
        robot.require(*robot.sections)
    resting = [stretch for run in runs for stretch in standing(run, robot)]
    held = [stretch for run in runs for stretch in standing(run, robot, MIN_POSITION_S)]
    findings = [*gyro_bias(resting, robot), *accelerometer(held, robot), *sensor_noise(resting, robot)]
    value = {row.parameter: row.value for row in findings if row.determined}
    biases = [value.get(f"sensors.accel_bias_{axis}_mps2", 0.0) for axis in "xyz"]
    findings += [*mounting(runs, resting, robot, biases), *wheel_noise(runs, robot)]
    if not any("imu" in run.streams for run in runs):
        findings = [
            row._replace(note=NO_IMU) if row.note in (NO_STANDING, LEVEL_ONLY) else row for row in findings
        ]
    if isinstance(robot, OmniRobot):
        of_rollers = identify_omni(runs, robot)
        shown = {row.parameter for row in of_rollers if row.determined}
        findings += of_rollers
        if RADIUS not in shown:
            findings += [row for row in motion_findings(runs, robot, hard) if row.parameter not in shown]
    else:
        findings = [*motion_findings(runs, robot, hard), *motor_constant(runs, robot), *findings]
    if isinstance(robot, SwerveRobot):
        stretches, why = (
            [each for run in runs for each in hard_stretches(run, hard)],
            why_none(runs, robot, hard),
        )
        steady = [each for stretch in stretches for each in steady_stretches(stretch, robot)]
        driven = [*steering_zeros(steady, robot), reduction_ratio(steady, robot)]
        findings += driven if steady else [finding._replace(note=why) for finding in driven]
        # Starts are distinguished from turns by the steering angles, with the zeros that have just been found.
        better = robot_from(robot.name, described_with(description, findings))
        events = [each for stretch in stretches for each in starts_and_stops(stretch, better)]
        lags = time_constants(events)
        findings += lags if events else [finding._replace(note=why) for finding in lags]
    best = dict[str, Finding]()
    for finding in findings:  # of two about one number the one that has it
        if finding.parameter not in best or finding.determined:
            best[finding.parameter] = finding
    sees = robot.describes("camera")
    findings = [
        each for each in best.values() if sees or each.determined or not each.parameter.startswith("camera.")
    ]
    for i, finding in enumerate(findings):
        section, _, name = finding.parameter.partition(".")
        if entry := description.get(section, {}).get(name):
            findings[i] = finding._replace(unit=entry["unit"], described=float(entry["value"]))
        else:
            findings[i] = finding._replace(unit=name.rpartition("_")[2] if name else "s")
    return findings


def described_with(description: Any, findings: Sequence[Finding]) -> Any:
    """Return a description with the numbers that were found, rounded to a hundredth of their intervals."""
    found = copy.deepcopy(description)
    shown = {finding.parameter for finding in findings if finding.determined}
    if "sensors" not in found and any(name.startswith("sensors.") for name in shown):
        # a section is whole: what these runs do not show is what a simulation assumes
        robot = with_assumed(robot_from(found["name"], description))
        found["sensors"] = {
            key: {"value": value, "unit": key.rpartition("_")[2], "source": "assumed: as a simulation has it"}
            for key, value in asdict(robot.sensors).items()
        }
    both = {f"antenna.lever_{axis}_m" for axis in "xy"} <= shown
    for finding in findings:
        section, _, name = finding.parameter.partition(".")
        if (section == IDENTIFIED or (section == "antenna" and both)) and finding.determined:
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

    def flow(entry: Any) -> str:
        text = yaml.safe_dump(
            entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf
        )
        return str(text).removesuffix("...\n").strip()

    lines = []
    for key, entry in description.items():
        section = isinstance(entry, dict) and "value" not in entry
        lines += [f"{key}:"] if section else [f"{key}: {flow(entry)}"]
        if section:
            lines += [f"  {name}: {flow(number)}" for name, number in entry.items()]
    return "\n".join(lines) + "\n"
