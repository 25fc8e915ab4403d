"""Target slip by terrain and drive state, from a YAML table in which every number has its source.

See ``data/target_slip/default.yaml`` for the form.  A number with runs behind it (``n_runs`` and
``slip_std``) is ``estimated``; one without is ``unestimated``, whoever wrote it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from terrain.errors import ConfigError
from terrain.records import SlipTarget
from terrain.resources import data_folder

DRIVE_STATES = ("traction", "braking", "steady")

SIGN = {"traction": 1, "braking": -1, "steady": 1}
"""Slip is positive in traction and negative in braking; steady motion needs traction against resistance."""

_NUMBER_KEYS = {"slip_ratio", "source", "slip_std", "n_runs"}


@dataclass(frozen=True, slots=True, eq=False)
class SlipTable:
    """Target slips by terrain and drive state.

    Parameters
    ----------
    name : name of the table
    fallback : the entry that stands in for a terrain without one
    targets : by terrain, then by drive state
    """

    name: str
    fallback: str
    targets: Mapping[str, Mapping[str, SlipTarget]]

    def lookup(self, terrain: str) -> Mapping[str, SlipTarget]:
        """Return the targets for a terrain, or those of the fallback; each says whose entry it is.

        Examples
        --------
        >>> table = load_slip_table()
        >>> table.lookup("ICE")["traction"].terrain, table.lookup("mud")["traction"].terrain
        ('ICE', 'unknown')
        """
        return self.targets.get(terrain, self.targets[self.fallback])


def load_slip_table(path: str | Path | None = None) -> SlipTable:
    """Read a table; the packaged ``default`` one without a path.

    Raises
    ------
    ConfigError
        if the file cannot be read, holds an unknown key, lacks a drive state or a source, or holds a slip
        that is not finite, not within [-1, 1] or of the wrong sign.
    """
    file = data_folder("target_slip") / "default.yaml" if path is None else Path(path)
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{file}: is no YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict) or set(content) != {"name", "fallback", "terrains"}:
        raise ConfigError(f"{file}: a slip table holds just the keys name, fallback and terrains")
    terrains, fallback = content["terrains"], content["fallback"]
    if not isinstance(terrains, dict) or not isinstance(fallback, str) or fallback not in terrains:
        raise ConfigError(f"{file}: the fallback {fallback!r} is no entry of terrains")
    targets = {str(terrain): _entry(file, str(terrain), entry) for terrain, entry in terrains.items()}
    return SlipTable(str(content["name"]), str(fallback), targets)


def _entry(file: Path, terrain: str, entry: Any) -> dict[str, SlipTarget]:
    if not isinstance(entry, dict) or set(entry) != set(DRIVE_STATES):
        raise ConfigError(f"{file}: {terrain} needs just the drive states {', '.join(DRIVE_STATES)}")
    return {state: _target(file, terrain, state, entry[state]) for state in DRIVE_STATES}


def _target(file: Path, terrain: str, state: str, number: Any) -> SlipTarget:
    where = f"{file}: {terrain}, {state}"
    if not isinstance(number, dict) or not {"slip_ratio", "source"} <= set(number) <= _NUMBER_KEYS:
        raise ConfigError(f"{where}: needs slip_ratio and source, and accepts slip_std and n_runs besides")
    slip, std, n_runs = number["slip_ratio"], number.get("slip_std"), number.get("n_runs", 0)
    if isinstance(slip, bool) or not isinstance(slip, int | float) or not np.isfinite(slip) or abs(slip) > 1:
        raise ConfigError(f"{where}: slip_ratio is {slip!r}; it must be a number within [-1, 1]")
    if slip * SIGN[state] < 0:
        sign = "negative" if SIGN[state] > 0 else "positive"
        raise ConfigError(f"{where}: slip_ratio is {slip:g}; {state} slip cannot be {sign}")
    if not isinstance(number["source"], str) or not number["source"].strip():
        raise ConfigError(f"{where}: source must be a text, or 'assumed'")
    is_number = isinstance(std, int | float) and not isinstance(std, bool)
    if std is not None and not (is_number and np.isfinite(std) and std >= 0):
        raise ConfigError(f"{where}: slip_std is {std!r}; it must be a number of at least 0")
    if isinstance(n_runs, bool) or not isinstance(n_runs, int) or n_runs < 0:
        raise ConfigError(f"{where}: n_runs is {n_runs!r}; it must be a whole number of at least 0")
    if (std is None) != (n_runs == 0):
        raise ConfigError(f"{where}: slip_std and n_runs go together")
    status = "estimated" if n_runs else "unestimated"
    slip_std = float("nan") if std is None else float(std)
    return SlipTarget(terrain, state, float(slip), slip_std, n_runs, status, number["source"])
