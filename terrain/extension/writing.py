"""Writing an extended robot: its description with a section ``effects``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from terrain.effects import SCHEMA, Parameter, checked_covariance, checked_effects, parameters_of
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.files.documents import parse_yaml, read_yaml
from terrain.records import Array
from terrain.robots import Region, Robot, description_file, robot_from

DIGITS = 7
"""Significant digits that a file has of each number."""


def extended_yaml(
    robot_name: str | Path,
    values: Mapping[str, float],
    covariance: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str,
    region: Region | None = None,
) -> str:
    """Return the description of a robot with a section ``effects``, as YAML.

    Everything else is kept, comments included; an earlier section ``effects`` is replaced.

    Parameters
    ----------
    robot_name : name of a robot or path of its YAML file
    values : by parameter
    covariance : (n, n) of the values in their order
    intervals : 95 % of each value, by parameter
    source : of the numbers, in words
    region : of driving, that they were validated in

    Raises
    ------
    ConfigError
        if the robot, a value, the covariance or an interval is not accepted.

    Examples
    --------
    >>> value, interval = {"gyro_scale_ratio": 0.02}, {"gyro_scale_ratio": (0.016, 0.024)}
    >>> text = extended_yaml("husky", value, np.array([[4e-6]]), interval, "me")
    >>> print("".join(text.partition("effects:")[1:]), end="")
    effects:
      schema: 1
      gyro_scale_ratio: {value: 0.02, unit: ratio, source: me, interval: [0.016, 0.024]}
      covariance:
        gyro_scale_ratio: {gyro_scale_ratio: 4.0e-06}
    """
    path = description_file(robot_name)
    described = read_yaml(path)
    robot = robot_from(path.name, described)
    values = checked_effects("effects", values, robot.drive)
    names = list(values)
    cov = checked_covariance("effects: covariance", np.asarray(covariance, dtype=float))
    if cov.shape != (len(names), len(names)):
        raise ConfigError(
            f"effects: covariance has the shape {cov.shape}, {(len(names), len(names))} is required"
        )
    lines = _section_lines(values, parameters_of(robot.drive), cov, intervals, source)
    lines += [] if region is None else _region_lines(region)
    text = _without_effects(path.read_text(encoding="utf-8-sig")) + "\n".join(lines) + "\n"
    try:
        content = parse_yaml(text)
    except ValueError:
        content = None
    others = {name: entry for name, entry in described.items() if name != "effects"}
    if not isinstance(content, dict) or {n: e for n, e in content.items() if n != "effects"} != others:
        raise ConfigError(f"{path}: cannot be extended as it is written: one section a line is required")
    robot_from(path.name, content)
    return text


def write_extended(
    out: str | Path,
    robot_name: str | Path,
    values: Mapping[str, float],
    covariance: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str,
    region: Region | None = None,
) -> Robot:
    """Write the description of :func:`extended_yaml` to a file, and return the robot.

    Raises
    ------
    ConfigError
        as :func:`extended_yaml` does, or if the file is no YAML by its name, or is there already.
    """
    out = Path(out)
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a robot's description is a .yaml file")
    if out.exists():
        raise ConfigError(f"{out}: is there already, and is left as it is; choose another name")
    text = extended_yaml(robot_name, values, covariance, intervals, source, region)
    atomic_write(out, text)
    return robot_from(out.name, parse_yaml(text))


def _section_lines(
    values: Mapping[str, float],
    known: Mapping[str, Parameter],
    cov: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str,
) -> list[str]:
    """Return the lines of the section ``effects``."""
    names = list(values)
    section: dict[str, Any] = {"schema": SCHEMA}
    for name in names:
        low, high = (float(edge) for edge in intervals.get(name, (math.nan, math.nan)))
        if not low <= values[name] <= high < math.inf:
            raise ConfigError(
                f"effects: {name} is {values[name]:g}, its interval {low:g} to {high:g} must hold it"
            )
        section[name] = {
            "value": _rounded(values[name]),
            "unit": known[name].unit,
            "source": source,
            "interval": [_rounded(low), _rounded(high)],
        }
    rows = {
        row: {column: _rounded(cov[i, j]) for j, column in enumerate(names)} for i, row in enumerate(names)
    }
    lines = ["effects:", *(f"  {name}: {_flow(entry)}" for name, entry in section.items())]
    lines += ["  covariance:" if rows else "  covariance: {}"]
    return lines + [f"    {name}: {_flow(row)}" for name, row in rows.items()]


def _region_lines(region: Region) -> list[str]:
    """Return the lines of the region; a range that was not measured has none."""
    ranges = {name: value for name, value in region._asdict().items() if value is not None}
    ranges["terrains"] = list(region.terrains)
    entries = {
        name: value if name == "terrains" else [_rounded(edge) for edge in value]
        for name, value in ranges.items()
    }
    return ["  region:", *(f"    {name}: {_flow(entry)}" for name, entry in entries.items())]


def _without_effects(text: str) -> str:
    """Return the text of a description without its section ``effects``."""
    kept, inside = [], False
    for line in text.splitlines():
        if inside and line.strip() and not line.startswith((" ", "#")):
            inside = False
        if line.startswith("effects:"):
            inside = True
        if not inside:
            kept.append(line)
    return "\n".join(kept).rstrip() + "\n"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _flow(entry: Any) -> str:
    text = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)
    return str(text).removesuffix("...\n").strip()
