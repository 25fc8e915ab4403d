"""The section ``effects`` of a robot's description: effects found by ``terrain explain``.

Each parameter of :mod:`terrain.effects.catalogue` is a number with unit, source and interval like any other;
the covariance has a row a parameter, and may be left out where it is unknown::

    effects:
      schema: 1
      wheel_radius_ratio: {value: 0.031, unit: ratio, source: "terrain explain", interval: [0.028, 0.034]}
      camera_yaw_rad: {value: -0.012, unit: rad, source: "terrain explain", interval: [-0.013, -0.011]}
      covariance:
        wheel_radius_ratio: {wheel_radius_ratio: 2.3e-06, camera_yaw_rad: 1.0e-08}
        camera_yaw_rad: {wheel_radius_ratio: 1.0e-08, camera_yaw_rad: 2.6e-07}

A parameter that is not there is 0, and its effect absent.  Former names of parameters are read as the present
ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from terrain.effects.catalogue import DEPRECATED, PARAMETER, parameters_of
from terrain.errors import ConfigError
from terrain.files.descriptions import check_keys, number
from terrain.records import Array, read_only

SCHEMA = 1
"""Version of the section that is read and written."""

NOT_EFFECTS = ("schema", "covariance", "region")
"""Keys of the section that name no parameter; the region is read by :mod:`terrain.robots.region`."""

ROUNDING = 1e-5
"""A covariance is written with seven digits: correlations may miss symmetry and sign by as much."""


def checked_effects(place: str, values: Mapping[str, float], drive: str) -> dict[str, float]:
    """Return the values of effects by parameter, checked.

    Parameters
    ----------
    place : what messages call it
    values : by parameter
    drive : of the robot

    Raises
    ------
    ConfigError
        for a parameter that is unknown or of an effect that does not apply to the robot, or a value that is
        no finite number within its bounds.
    """
    known = parameters_of(drive)
    for name, value in values.items():
        if name not in known:
            if name in PARAMETER:
                raise ConfigError(f"{place}: {name} does not apply to a robot with the drive {drive!r}")
            raise ConfigError(f"{place}: {name} is no parameter of an effect (known: {', '.join(known)})")
        low, high = known[name].low, known[name].high
        plain = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not (plain and math.isfinite(value) and low <= value <= high):
            raise ConfigError(f"{place}: {name} is {value!r}, a number from {low:g} to {high:g} is required")
    return {name: float(value) for name, value in values.items()}


def read_effects(place: str, described: Any, drive: str) -> tuple[dict[str, float], Array]:
    """Return the values of a section by parameter, and their covariance (n, n) in the same order.

    Parameters
    ----------
    place : file and section, as messages name them
    described : what the file holds
    drive : of the robot

    Returns
    -------
    values : as :func:`checked_effects` does
    covariance : NaN where the section has none

    Raises
    ------
    ConfigError
        if the schema is newer than this version, a parameter is not accepted, or the covariance is no
        covariance of the parameters that are given.

    Examples
    --------
    >>> entry = {"value": 0.1, "unit": "rad", "source": "by hand"}
    >>> read_effects("mine.yaml: effects", {"schema": 1, "camera_yaw_rad": entry}, "swerve")
    ({'camera_yaw_rad': 0.1}, array([[nan]]))
    """
    if not isinstance(described, dict) or "schema" not in described:
        raise ConfigError(f"{place} is {described!r}, a mapping with schema and parameters is required")
    schema = described["schema"]
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise ConfigError(f"{place}: schema is {schema!r}, {SCHEMA} is required")
    if schema > SCHEMA:
        raise ConfigError(
            f"{place}: schema {schema} is newer than this version of terrain, which reads {SCHEMA}"
        )
    entries = _renamed(place, {k: v for k, v in described.items() if k not in NOT_EFFECTS})
    known = parameters_of(drive)
    checked_effects(place, dict.fromkeys((name for name in entries if name not in known), 0.0), drive)
    values = {
        name: number(f"{place}: {name}", entry, known[name].unit, -math.inf)
        for name, entry in entries.items()
    }
    values = checked_effects(place, values, drive)
    if "covariance" not in described:
        return values, np.full((len(values), len(values)), np.nan)
    return values, _covariance(f"{place}: covariance", described["covariance"], list(values))


def _renamed(place: str, entries: dict[Any, Any]) -> dict[str, Any]:
    """Return entries by the present names of their parameters."""
    renamed: dict[str, Any] = {}
    for given, entry in entries.items():
        name = DEPRECATED.get(str(given), str(given))
        if name in renamed:
            raise ConfigError(f"{place}: {name} is given twice, once by its former name")
        renamed[name] = entry
    return renamed


def _covariance(place: str, described: Any, names: list[str]) -> Array:
    if isinstance(described, dict):
        described = _renamed(place, described)
    check_keys(place, described, names)
    for name in names:
        if isinstance(described[name], dict):
            described[name] = _renamed(f"{place}: {name}", described[name])
        check_keys(f"{place}: {name}", described[name], names)
    rows = [[described[row][column] for column in names] for row in names]
    for row, entries in zip(names, rows, strict=True):
        for column, entry in zip(names, entries, strict=True):
            if isinstance(entry, bool) or not isinstance(entry, int | float) or not math.isfinite(entry):
                raise ConfigError(f"{place}: {row}, {column} is {entry!r}, a finite number is required")
    return checked_covariance(place, np.array(rows, dtype=float).reshape(len(names), len(names)))


def checked_covariance(place: str, covariance: Array) -> Array:
    """Return a covariance (n, n), read-only and symmetric to the last bit.

    Raises
    ------
    ConfigError
        if it is no square of finite numbers, is not symmetric, or gives some combination a negative variance.

    Examples
    --------
    >>> checked_covariance("covariance", np.array([[1.0, 2.0], [2.0, 1.0]]))
    Traceback (most recent call last):
    terrain.errors.ConfigError: covariance is not positive semi-definite: its correlations have eigenvalue -1
    """
    if (
        covariance.ndim != 2
        or covariance.shape[0] != covariance.shape[1]
        or not np.isfinite(covariance).all()
    ):
        raise ConfigError(f"{place} has the shape {covariance.shape}; a square of finite numbers is required")
    variance = covariance.diagonal()
    if (variance < 0).any():
        raise ConfigError(f"{place} is not positive semi-definite: it has the variance {variance.min():g}")
    std = np.sqrt(variance)
    scale = np.where(std > 0, std, 1.0)
    correlation = covariance / scale[:, None] / scale
    skew = float(np.abs(correlation - correlation.T).max(initial=0.0))
    if skew > ROUNDING:
        raise ConfigError(f"{place} is not symmetric: two of its correlations differ by {skew:.3g}")
    least = float(np.linalg.eigvalsh((correlation + correlation.T) / 2).min(initial=0.0))
    if least < -ROUNDING:
        raise ConfigError(
            f"{place} is not positive semi-definite: its correlations have eigenvalue {least:.3g}"
        )
    return read_only((covariance + covariance.T) / 2)
