"""A slip model as a YAML file: what was identified on one ground, for that robot.

Each parameter has its value and its standard deviation; correlations are left out unless they are given::

    robot: patako
    found: 12 runs with poses, 3400 samples
    parameters:
      turning_exponent: {value: 0.86, std: 0.004}
      ...
    residuals:
      slip_std_ratio: 0.01
      ...
    correlation: [[1.0, 0.1, ...], ...]
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from terrain.errors import ConfigError
from terrain.estimation.observers.slip_model import PARAMETERS, SlipModel, model_of
from terrain.files.atomic import atomic_write
from terrain.files.documents import check_keys, read_yaml
from terrain.files.names import shown
from terrain.records import Array

RESIDUALS = ("slip_std_ratio", "angle_std_rad", "run_slip_std_ratio", "run_angle_std_rad", "correlation_s")
"""Residuals of a model, and the time over which they are alike."""

DIGITS, ROUNDED = 6, 1e-4
"""Of the numbers written, and what their rounding makes of correlations."""


def write_slip_model(path: Path, model: SlipModel, robot: str) -> None:
    """Write the slip model of a robot; as :func:`check_slip_model_file`."""
    check_slip_model_file(path)
    std = np.sqrt(np.diag(model.covariance))
    scale = np.where(std > 0.0, std, 1.0)
    correlation = model.covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    pairs = zip(PARAMETERS, model.vector, std, strict=True)
    lines = [
        "# Slip of a tracked robot on one ground, for terrain estimate --filter slip-odometry --slip-model.",
        yaml.safe_dump({"robot": robot, "found": model.found}, sort_keys=False, width=math.inf).strip(),
        "parameters:",
        *(f"  {name}: {{value: {_text(value)}, std: {_text(error)}}}" for name, value, error in pairs),
        "residuals:",
        *(f"  {name}: {_text(getattr(model, name))}" for name in RESIDUALS),
        "correlation:",
        *(f"  - [{', '.join(_text(each) for each in row)}]" for row in correlation),
    ]
    atomic_write(path, "\n".join(lines) + "\n")


def check_slip_model_file(path: Path) -> None:
    """Refuse, by ``ConfigError``, the place of a new slip model that is no YAML file, or is there already."""
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{path}: a slip model is a .yaml file")
    if path.exists():
        raise ConfigError(f"{path}: is there already, and is left as it is; choose another name")


def read_slip_model(path: Path, robot: str) -> SlipModel:
    """Return the slip model of a file.

    Raises
    ------
    ConfigError
        if it cannot be read, lacks a parameter, has an unknown one or no number, or is of another robot.
    """
    described = read_yaml(path)
    check_keys(path.name, described, ["robot", "found", "parameters", "residuals"], optional=("correlation",))
    if described["robot"] != robot:
        raise ConfigError(
            f"{path.name}: is the slip model of robot {shown(described['robot'])}, not {robot!r}"
        )
    check_keys(f"{path.name}: parameters", described["parameters"], list(PARAMETERS))
    check_keys(f"{path.name}: residuals", described["residuals"], list(RESIDUALS))
    values, stds = np.empty(len(PARAMETERS)), np.empty(len(PARAMETERS))
    for k, name in enumerate(PARAMETERS):
        place, entry = f"{path.name}: parameters: {name}", described["parameters"][name]
        check_keys(place, entry, ["value", "std"])
        values[k] = _number(f"{place}: value", entry["value"])
        stds[k] = _number(f"{place}: std", entry["std"], least=0.0)
    residuals = {
        name: _number(f"{path.name}: residuals: {name}", described["residuals"][name], least=0.0)
        for name in RESIDUALS
    }
    correlation = _correlation(f"{path.name}: correlation", described.get("correlation"))
    covariance = correlation * np.outer(stds, stds)
    return model_of(values, covariance=covariance, found=str(described["found"]), **residuals)


def _number(place: str, value: Any, least: float = -math.inf) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not good or value < least:
        raise ConfigError(
            f"{place} is {shown(value)}, a finite number{' from zero up' if least == 0.0 else ''} is required"
        )
    return float(value)


def _correlation(place: str, rows: Any) -> Array:
    n = len(PARAMETERS)
    if rows is None:
        return np.eye(n)
    is_table = isinstance(rows, list) and all(isinstance(row, list) and len(row) == n for row in rows)
    if not is_table or len(rows) != n:
        raise ConfigError(f"{place}: {n} rows of {n} numbers are required")
    found = np.array([[_number(place, each) for each in row] for row in rows])
    one = np.abs(np.diag(found) - 1.0).max() <= ROUNDED and np.allclose(found, found.T, atol=ROUNDED)
    if not one or np.linalg.eigvalsh(found)[0] < -ROUNDED:
        raise ConfigError(f"{place}: these are no correlations: 1 on the diagonal, symmetric, none beyond 1")
    return found


def _text(value: float) -> str:
    """Return a number as YAML 1.1 reads it: with a point before an exponent."""
    text = repr(float(f"{value:.{DIGITS}g}"))
    mantissa, _, exponent = text.partition("e")
    return text if not exponent or "." in mantissa else f"{mantissa}.0e{exponent}"
