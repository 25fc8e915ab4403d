"""Target slip by terrain and drive state, from a YAML table in which every number has its source.

Two forms are read.  That of ``data/target_slip/default.yaml`` is written by hand; a number with runs behind
it (``n_runs``, ``n_sessions`` and ``slip_std``) is ``estimated``, one without ``unestimated``.  ``terrain learn-slip``
writes the other, ``schema: 2``: for one robot, each number with its status, and the curve that the numbers are from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from pydantic.dataclasses import dataclass as checked_dataclass

from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.files.documents import accepted, check_keys, read_yaml
from terrain.files.names import data_folder, shown
from terrain.records import Array, SlipTarget, TargetStatus
from terrain.slip_learning.curve import LAW_BOUNDS, LAW_PARAMETERS, PeakStatus, traction_ratio

DRIVE_STATES = ("traction", "braking", "steady")

#: Slip is positive in traction and negative in braking; steady motion needs traction against resistance.
SIGN = {"traction": 1, "braking": -1, "steady": 1}
SCHEMA = 2  #: Newest form that is read, and the one that is written.

_HEADER = """\
# Target slip on each terrain, positive in traction (s = (w r - v) / max(|w r|, |v|)).
# Written by terrain learn-slip.  estimated: learned from n_runs runs of n_sessions sessions; unestimated: the runs
# do not suffice, the number is assumed; invalid: what was learned contradicts itself, the fallback is used instead.
"""

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Ratio = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1.0, le=1.0)]
Words = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
_CLOSED = ConfigDict(extra="forbid")


@checked_dataclass(frozen=True, slots=True, config=_CLOSED)
class CurveEntry:
    """What a table holds of a learned curve; numbers as in the file, None where not known."""

    law: str  #: by :data:`terrain.slip_learning.curve.LAW_PARAMETERS`
    parameters: Mapping[str, Finite]
    #: of net traction (:mod:`terrain.slip_learning.curve`); the interval contains it with 90 %
    peak_slip_ratio: Ratio
    peak_interval_ratio: tuple[Ratio, Ratio]
    peak_status: PeakStatus
    slip_range_ratio: tuple[Ratio, Ratio]  #: slips that were observed
    resistance_ratio: Finite  #: over load
    resistance_std: Finite
    balance_slip_ratio: Ratio  #: where thrust equals resistance
    peak_based_slip_ratio: Ratio  #: of which the target of traction is the lesser
    working_slip_ratio: Ratio | None = field(default=None, kw_only=True)
    traction_efficiency_ratio: Finite  #: tractive efficiency there
    traction_energy_jpm: Finite  #: a metre, at each target, without payload
    braking_energy_jpm: Finite
    steady_energy_jpm: Finite
    n_runs: Annotated[int, Field(strict=True, ge=1)]  #: the curve is fitted to
    #: of these runs; those that name none are of one
    n_sessions: Annotated[int, Field(strict=True, ge=0)] = 0

    def thrust_ratio(self, slip_ratio: Array) -> Array:
        """Return the thrust over load (n,) at each slip (n,)."""
        return traction_ratio(
            self.law, [self.parameters[name] for name in LAW_PARAMETERS[self.law]], slip_ratio
        )


@dataclass(frozen=True, slots=True, eq=False)
class SlipTable:
    """Target slips by terrain and drive state."""

    name: str  #: name of the table
    fallback: str  #: the entry used for a terrain without a valid one
    targets: Mapping[str, Mapping[str, SlipTarget]]  #: by terrain, then by drive state
    robot: str = ""  #: that the slips are for; empty where the table is for any robot
    curves: Mapping[str, CurveEntry] = field(default_factory=dict)  #: by terrain, where one was learned
    #: by terrain, why its numbers are not learned or not used
    reasons: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("targets", "curves", "reasons"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def lookup(self, terrain: str) -> Mapping[str, SlipTarget]:
        """Return the targets for a terrain, or those of the fallback; each names the entry that it is from.

        The fallback is also used for an entry with an ``invalid`` number.

        Examples
        --------
        >>> table = load_slip_table()
        >>> table.lookup("ICE")["traction"].terrain, table.lookup("mud")["traction"].terrain
        ('ICE', 'unknown')
        """
        entry = self.targets.get(terrain)
        return self.targets[self.fallback] if entry is None or _is_invalid(entry) else entry

    def target_rows(self, terrain: str) -> dict[str, dict[str, Any]]:
        """Return the targets of an entry by drive state, as JSON has them."""
        keys = ("slip_ratio", "slip_std", "n_sessions", "status", "source")
        return {
            state: {key: getattr(target, key) for key in keys}
            for state, target in self.targets[terrain].items()
        }


def _is_invalid(entry: Mapping[str, SlipTarget]) -> bool:
    return any(target.status is TargetStatus.INVALID for target in entry.values())


class _Number(BaseModel):
    model_config = _CLOSED

    slip_ratio: Ratio
    source: Words
    slip_std: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)] | None = None
    n_runs: Annotated[int, Field(strict=True, ge=0)] = 0
    n_sessions: Annotated[int, Field(strict=True, ge=0)] = 0
    status: TargetStatus | None = None


class _Entry(BaseModel):
    model_config = _CLOSED

    traction: _Number
    braking: _Number
    steady: _Number
    curve: CurveEntry | None = None
    reason: Annotated[str, Field(strict=True)] = ""


def load_slip_table(
    path: str | Path | None = None, robot: str | None = None, text: str | None = None
) -> SlipTable:
    """Read a table for a robot, any by default; the packaged ``default`` one without a path.

    With a text, the path is but its name in messages.

    Raises
    ------
    ConfigError
        if the file cannot be read or is of a newer schema, a key is unknown, missing or given twice, the
        table is another robot's, has no fallback or an invalid one, lacks a drive state or a source, or holds
        a slip that is not finite, not within [-1, 1], of the wrong sign, or targets that do not rise from
        braking over steady to traction.
    """
    file = data_folder("target_slip") / "default.yaml" if path is None else Path(path)
    content = read_yaml(file, text)
    schema = content.get("schema", 1) if isinstance(content, dict) else 1
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise ConfigError(f"{file}: schema is {shown(schema)}, 1 or {SCHEMA} is required")
    if schema > SCHEMA:
        raise ConfigError(f"{file}: schema {schema} is newer than {SCHEMA}, the newest that is read here")
    of_robot = ["schema", "robot"] if schema == SCHEMA else []
    check_keys(str(file), content, [*of_robot, "name", "fallback", "terrains"], ("schema",))
    terrains, fallback, owner = content["terrains"], content["fallback"], content.get("robot", "")
    if not isinstance(terrains, dict) or not isinstance(fallback, str) or fallback not in terrains:
        raise ConfigError(f"{file}: the fallback {shown(fallback)} is no entry of terrains")
    if of_robot and not (isinstance(owner, str) and owner):
        raise ConfigError(f"{file}: robot is {shown(owner)}, the name of one is required")
    if robot is not None and owner not in ("", robot):
        raise ConfigError(f"{file}: the table is for robot {owner!r}, not for {robot!r}")
    entries = {
        str(key): accepted(_Entry, entry, f"{file}: {key}", ConfigError) for key, entry in terrains.items()
    }
    targets = {terrain: _targets(f"{file}: {terrain}", terrain, entry) for terrain, entry in entries.items()}
    if _is_invalid(targets[fallback]):
        raise ConfigError(
            f"{file}: the fallback {fallback!r} is invalid: it could not be used for any terrain"
        )
    curves = {terrain: entry.curve for terrain, entry in entries.items() if entry.curve is not None}
    for terrain, curve in curves.items():
        where = f"{file}: {terrain}, curve"
        if curve.law not in LAW_PARAMETERS:
            laws = ", ".join(LAW_PARAMETERS)
            raise ConfigError(f"{where}: law is {curve.law!r}; it must be one of {laws}")
        check_keys(f"{where}: parameters", dict(curve.parameters), list(LAW_PARAMETERS[curve.law]))
        for name, least, most in zip(LAW_PARAMETERS[curve.law], *LAW_BOUNDS[curve.law], strict=True):
            if not least <= (value := curve.parameters[name]) <= most:
                raise ConfigError(f"{where}: {name} is {value:g}; {least:g} to {most:g} are accepted")
        for name in ("peak_interval_ratio", "slip_range_ratio"):
            low, high = getattr(curve, name)
            if low > high:
                raise ConfigError(f"{where}: {name} is {low:g} to {high:g}; two rising numbers are required")
    reasons = {terrain: entry.reason for terrain, entry in entries.items() if entry.reason}
    return SlipTable(str(content["name"]), fallback, targets, owner, curves, reasons)


def _targets(place: str, terrain: str, entry: _Entry) -> dict[str, SlipTarget]:
    targets = {}
    for state in DRIVE_STATES:
        number: _Number = getattr(entry, state)
        where, slip, n_runs = f"{place}, {state}", number.slip_ratio, number.n_runs
        if slip * SIGN[state] < 0:
            sign = "negative" if SIGN[state] > 0 else "positive"
            raise ConfigError(f"{where}: slip_ratio is {slip:g}; {state} slip cannot be {sign}")
        if (number.slip_std is None) != (n_runs == 0):
            raise ConfigError(f"{where}: slip_std and n_runs go together")
        status = number.status or (TargetStatus.ESTIMATED if n_runs else TargetStatus.UNESTIMATED)
        if status is TargetStatus.ESTIMATED and n_runs == 0:
            raise ConfigError(f"{where}: status is 'estimated', and no runs are behind it")
        if number.n_sessions > n_runs:
            raise ConfigError(
                f"{where}: n_sessions is {number.n_sessions}, of {n_runs} runs; a session has one or more"
            )
        std = math.nan if number.slip_std is None else number.slip_std
        rest = status, number.source, number.n_sessions
        targets[state] = SlipTarget(terrain, state, slip, std, n_runs, *rest)
    steady, traction = targets["steady"].slip_ratio, targets["traction"].slip_ratio
    if steady > traction:
        raise ConfigError(
            f"{place}: steady slip {steady:g} is over that of traction, {traction:g}; targets must rise"
        )
    return targets


def write_slip_table(table: SlipTable, path: str | Path) -> None:
    """Write a table of a robot as a file of schema 2, whole or not at all; reading it gives the same table."""
    if not table.robot:
        raise ConfigError(f"table {table.name!r} is no robot's: a learned table names the one it is for")
    content = table_content(table)
    body = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200, allow_unicode=True)
    atomic_write(path, _HEADER + body)


def table_content(table: SlipTable) -> dict[str, Any]:
    """Return what the file of a table holds."""
    terrains: dict[str, Any] = {}
    for terrain, by_state in table.targets.items():
        entry = terrains[terrain] = {state: _number(by_state[state]) for state in DRIVE_STATES}
        if terrain in table.reasons:
            entry["reason"] = table.reasons[terrain]
        if (curve := table.curves.get(terrain)) is not None:
            known = {item.name: _plain(getattr(curve, item.name)) for item in fields(CurveEntry)}
            entry["curve"] = {name: value for name, value in known.items() if value is not None}
    head = {"schema": SCHEMA, "name": table.name, "robot": table.robot, "fallback": table.fallback}
    return {**head, "terrains": terrains}


def _number(target: SlipTarget) -> Any:
    learned = {"slip_std": float(target.slip_std), "n_runs": int(target.n_runs)} if target.n_runs else {}
    learned |= {"n_sessions": int(target.n_sessions)} if target.n_sessions else {}
    status = TargetStatus(target.status).value
    return {"slip_ratio": float(target.slip_ratio), **learned, "status": status, "source": target.source}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: float(number) for key, number in value.items()}
    if isinstance(value, StrEnum):
        return value.value
    return [float(number) for number in value] if isinstance(value, tuple) else value
