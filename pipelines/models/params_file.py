"""The result of a search as a JSON file, for ``--params`` of other commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.files.documents import MAX_JSON_BYTES, parse_json
from terrain.files.names import shown
from terrain.files.regular import read_regular

BEST_FILE = "best.json"
VERSION = 1


class SvmParams(NamedTuple):
    """Hyper-parameters of the SVM, as :class:`terrain.classify.svm.Candidate`."""

    C: float
    gamma: float
    percentile: float


LIMITS = {"C": (0.0, 1e6), "gamma": (0.0, 1e3), "percentile": (0.0, 100.0)}
"""Each is above the first and at most the second."""


def write_params(file: Path, params: SvmParams, beside: dict[str, Any]) -> None:
    """Write hyper-parameters, and what is known of them."""
    content = {"version": VERSION, "params": params._asdict(), **beside}
    atomic_write(file, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_params(file: Path) -> SvmParams:
    """Return the hyper-parameters of a file.

    Raises
    ------
    ConfigError
        if it is no such file, of another version, or has an unknown or impossible hyper-parameter.
    """
    try:
        content = parse_json(read_regular(file, str(file), ConfigError, MAX_JSON_BYTES))
        version, params = content["version"], dict(content["params"])
    except (LogError, TypeError, KeyError, ValueError, AttributeError) as error:
        raise ConfigError(f"{file}: is no result of terrain sweep") from error
    if version != VERSION:
        raise ConfigError(f"{file}: has version {shown(version)}; version {VERSION} is read here")
    unknown = sorted(set(params) - set(SvmParams._fields))
    if unknown:
        names = ", ".join(SvmParams._fields)
        raise ConfigError(f"{file}: {shown(unknown[0])} is no hyper-parameter ({names})")
    for name, (low, high) in LIMITS.items():
        value = params.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low < value <= high:
            raise ConfigError(
                f"{file}: {name} is {shown(value)}, a number above {low:g} to {high:g} is needed"
            )
    return SvmParams(**{name: float(params[name]) for name in SvmParams._fields})
