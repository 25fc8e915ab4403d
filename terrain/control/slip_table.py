"""Target slip by terrain and drive state, from a YAML table in which every number has its source.

Two forms are read.  That of ``data/target_slip/default.yaml`` is written by hand; a number with runs behind
it (``n_runs`` and ``slip_std``) is ``estimated``, one without ``unestimated``.  ``terrain learn-slip`` writes
the other, ``schema: 2``: for one robot, each number with its status, and the curve that the numbers are from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import yaml

from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.files.documents import check_keys, read_yaml
from terrain.files.names import data_folder
from terrain.records import Array, SlipTarget, TargetStatus
from terrain.slip_learning.curve import LAW_BOUNDS, LAW_PARAMETERS, PeakStatus, traction_ratio

DRIVE_STATES = ("traction", "braking", "steady")

SIGN = {"traction": 1, "braking": -1, "steady": 1}
"""Slip is positive in traction and negative in braking; steady motion needs traction against resistance."""

SCHEMA = 2
"""Newest form that is read, and the one that is written."""

_Status = TypeVar("_Status", bound=StrEnum)

_NUMBER_KEYS = {"slip_ratio", "source", "slip_std", "n_runs"}
_HEADER = """\
# Target slip on each terrain, positive in traction (s = (w r - v) / max(|w r|, |v|)).
# Written by terrain learn-slip.  estimated: learned from n_runs runs; unestimated: the runs do not suffice,
# the number is assumed; invalid: what was learned contradicts itself, the fallback is used instead.
"""


@dataclass(frozen=True, slots=True)
class CurveEntry:
    """What a table holds of a learned curve; numbers as in the file, None where not known.

    Parameters
    ----------
    law, parameters : by :data:`terrain.slip_learning.curve.LAW_PARAMETERS`
    peak_slip_ratio, peak_interval_ratio, peak_status : of net traction (:mod:`terrain.slip_learning.curve`);
        the interval contains it with 90 %
    slip_range_ratio : slips that were observed
    resistance_ratio, resistance_std : over load
    balance_slip_ratio : where thrust equals resistance
    peak_based_slip_ratio, working_slip_ratio : of which the target of traction is the lesser
    traction_efficiency_ratio : tractive efficiency there
    traction_energy_jpm, braking_energy_jpm, steady_energy_jpm : a metre, at each target, without payload
    n_runs : the curve is fitted to
    """

    law: str
    parameters: Mapping[str, float]
    peak_slip_ratio: float
    peak_interval_ratio: tuple[float, float]
    peak_status: PeakStatus
    slip_range_ratio: tuple[float, float]
    resistance_ratio: float
    resistance_std: float
    balance_slip_ratio: float
    peak_based_slip_ratio: float
    working_slip_ratio: float | None
    traction_efficiency_ratio: float
    traction_energy_jpm: float
    braking_energy_jpm: float
    steady_energy_jpm: float
    n_runs: int

    def thrust_ratio(self, slip_ratio: Array) -> Array:
        """Return the thrust over load (n,) at each slip (n,)."""
        return traction_ratio(
            self.law, [self.parameters[name] for name in LAW_PARAMETERS[self.law]], slip_ratio
        )


@dataclass(frozen=True, slots=True, eq=False)
class SlipTable:
    """Target slips by terrain and drive state.

    Parameters
    ----------
    name : name of the table
    fallback : the entry used for a terrain without a valid one
    targets : by terrain, then by drive state
    robot : that the slips are for; empty where the table is for any robot
    curves : by terrain, where one was learned
    reasons : by terrain, why its numbers are not learned or not used
    """

    name: str
    fallback: str
    targets: Mapping[str, Mapping[str, SlipTarget]]
    robot: str = ""
    curves: Mapping[str, CurveEntry] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    _valid: Mapping[str, Mapping[str, SlipTarget]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("targets", "curves", "reasons"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        valid = {terrain: entry for terrain, entry in self.targets.items() if _is_valid(entry)}
        object.__setattr__(self, "_valid", valid)

    def lookup(self, terrain: str) -> Mapping[str, SlipTarget]:
        """Return the targets for a terrain, or those of the fallback; each names the entry that it is from.

        The fallback is also used for an entry with an ``invalid`` number.

        Examples
        --------
        >>> table = load_slip_table()
        >>> table.lookup("ICE")["traction"].terrain, table.lookup("mud")["traction"].terrain
        ('ICE', 'unknown')
        """
        entry = self._valid.get(terrain)
        return self.targets[self.fallback] if entry is None else entry

    def target_rows(self, terrain: str) -> dict[str, dict[str, Any]]:
        """Return the targets of an entry by drive state, as JSON has them."""
        keys = ("slip_ratio", "slip_std", "status", "source")
        return {
            state: {key: getattr(target, key) for key in keys}
            for state, target in self.targets[terrain].items()
        }


def _is_valid(entry: Mapping[str, SlipTarget]) -> bool:
    return not any(target.status is TargetStatus.INVALID for target in entry.values())


def load_slip_table(
    path: str | Path | None = None, robot: str | None = None, text: str | None = None
) -> SlipTable:
    """Read a table; the packaged ``default`` one without a path.

    Parameters
    ----------
    path : YAML file
    robot : name of the robot that is to be driven; any by default
    text : content, of which the path is but the name in messages

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
    schema = _schema(file, content)
    of_robot = _check_frame(file, content, schema)
    if robot is not None and of_robot and of_robot != robot:
        raise ConfigError(f"{file}: the table is for robot {of_robot!r}, not for {robot!r}")
    fallback = content["fallback"]
    targets, curves, reasons = {}, {}, {}
    for key, entry in content["terrains"].items():
        terrain = str(key)
        targets[terrain] = _targets(file, terrain, entry, schema)
        if "curve" in entry:
            curves[terrain] = _curve(f"{file}: {terrain}, curve", entry["curve"])
        if "reason" in entry:
            if not isinstance(entry["reason"], str):
                raise ConfigError(f"{file}: {terrain}: reason is {entry['reason']!r}, a text is required")
            reasons[terrain] = entry["reason"]
    if any(target.status is TargetStatus.INVALID for target in targets[fallback].values()):
        raise ConfigError(
            f"{file}: the fallback {fallback!r} is invalid: it could not be used for any terrain"
        )
    return SlipTable(str(content["name"]), fallback, targets, of_robot, curves, reasons)


def _schema(file: Path, content: Any) -> int:
    schema = content.get("schema", 1) if isinstance(content, dict) else 1
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise ConfigError(f"{file}: schema is {schema!r}, 1 or {SCHEMA} is required")
    if schema > SCHEMA:
        raise ConfigError(f"{file}: schema {schema} is newer than {SCHEMA}, the newest that is read here")
    return schema


def _check_frame(file: Path, content: Any, schema: int) -> str:
    """Check all of a file but its terrains; return the robot that it is for, or an empty name."""
    keys = ["name", "fallback", "terrains"]
    if schema == 1 and not (isinstance(content, dict) and set(content) - {"schema"} == set(keys)):
        raise ConfigError(f"{file}: a slip table holds just the keys name, fallback and terrains")
    if schema > 1:
        check_keys(str(file), content, ["schema", "name", "robot", "fallback", "terrains"])
    terrains, fallback = content["terrains"], content["fallback"]
    if not isinstance(terrains, dict) or not isinstance(fallback, str) or fallback not in terrains:
        raise ConfigError(f"{file}: the fallback {fallback!r} is no entry of terrains")
    robot = content.get("robot", "")
    if schema > 1 and not (isinstance(robot, str) and robot):
        raise ConfigError(f"{file}: robot is {robot!r}, the name of one is required")
    return str(robot)


def _targets(file: Path, terrain: str, entry: Any, schema: int) -> dict[str, SlipTarget]:
    """Return the targets of a terrain by drive state."""
    extra = {"curve", "reason"} if schema > 1 else set()
    if not isinstance(entry, dict) or not set(DRIVE_STATES) <= set(entry) <= set(DRIVE_STATES) | extra:
        raise ConfigError(f"{file}: {terrain} needs just the drive states {', '.join(DRIVE_STATES)}")
    targets = {state: _target(file, terrain, state, entry[state], schema) for state in DRIVE_STATES}
    steady, traction = targets["steady"].slip_ratio, targets["traction"].slip_ratio
    if steady > traction:
        raise ConfigError(
            f"{file}: {terrain}: steady slip {steady:g} is over that of traction, {traction:g}; "
            "targets must rise"
        )
    return targets


def write_slip_table(table: SlipTable, path: str | Path) -> None:
    """Write a table as a file of schema 2, whole or not at all; reading it gives the same table.

    Raises
    ------
    ConfigError
        if it is no robot's.
    TerrainError
        if the place cannot be written.
    """
    if not table.robot:
        raise ConfigError(f"table {table.name!r} is no robot's: a learned table names the one it is for")
    body = yaml.safe_dump(
        table_content(table), sort_keys=False, default_flow_style=None, width=200, allow_unicode=True
    )
    atomic_write(path, _HEADER + body)


def table_content(table: SlipTable) -> dict[str, Any]:
    """Return what the file of a table holds."""
    terrains: dict[str, Any] = {}
    for terrain, by_state in table.targets.items():
        entry: dict[str, Any] = {state: _number(by_state[state]) for state in DRIVE_STATES}
        if terrain in table.reasons:
            entry["reason"] = table.reasons[terrain]
        if (curve := table.curves.get(terrain)) is not None:
            entry["curve"] = {
                item.name: _plain(getattr(curve, item.name))
                for item in fields(CurveEntry)
                if getattr(curve, item.name) is not None
            }
        terrains[terrain] = entry
    return {
        "schema": SCHEMA,
        "name": table.name,
        "robot": table.robot,
        "fallback": table.fallback,
        "terrains": terrains,
    }


def _number(target: SlipTarget) -> dict[str, Any]:
    known = {} if math.isnan(target.slip_std) else {"slip_std": float(target.slip_std)}
    runs = {"n_runs": int(target.n_runs)} if target.n_runs else {}
    return {
        "slip_ratio": float(target.slip_ratio),
        **known,
        **runs,
        "status": TargetStatus(target.status).value,
        "source": target.source,
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: float(number) for key, number in value.items()}
    if isinstance(value, StrEnum):
        return value.value
    return [float(number) for number in value] if isinstance(value, tuple) else value


def _target(file: Path, terrain: str, state: str, number: Any, schema: int) -> SlipTarget:
    where = f"{file}: {terrain}, {state}"
    accepted = _NUMBER_KEYS | ({"status"} if schema > 1 else set())
    needed = accepted - {"slip_std", "n_runs"}
    if not isinstance(number, dict) or not needed <= set(number) <= accepted:
        words = "slip_ratio and source" if schema == 1 else "slip_ratio, status and source"
        raise ConfigError(f"{where}: needs {words}, and accepts slip_std and n_runs besides")
    slip, std, n_runs = number["slip_ratio"], number.get("slip_std"), number.get("n_runs", 0)
    if not _is_number(slip) or abs(slip) > 1:
        raise ConfigError(f"{where}: slip_ratio is {slip!r}; it must be a number within [-1, 1]")
    if slip * SIGN[state] < 0:
        sign = "negative" if SIGN[state] > 0 else "positive"
        raise ConfigError(f"{where}: slip_ratio is {slip:g}; {state} slip cannot be {sign}")
    if not isinstance(number["source"], str) or not number["source"].strip():
        raise ConfigError(f"{where}: source must be a text, or 'assumed'")
    if std is not None and not (_is_number(std) and std >= 0):
        raise ConfigError(f"{where}: slip_std is {std!r}; it must be a number of at least 0")
    if isinstance(n_runs, bool) or not isinstance(n_runs, int) or n_runs < 0:
        raise ConfigError(f"{where}: n_runs is {n_runs!r}; it must be a whole number of at least 0")
    status = _one_of(
        TargetStatus, where, "status", number.get("status", "estimated" if n_runs else "unestimated")
    )
    if (schema == 1 or status is TargetStatus.ESTIMATED) and (std is None) != (n_runs == 0):
        raise ConfigError(f"{where}: slip_std and n_runs go together")
    if status is TargetStatus.ESTIMATED and n_runs == 0:
        raise ConfigError(f"{where}: status is 'estimated', and no runs are behind it")
    slip_std = math.nan if std is None else float(std)
    return SlipTarget(terrain, state, float(slip), slip_std, n_runs, status, number["source"])


def _curve(where: str, content: Any) -> CurveEntry:
    names = [item.name for item in fields(CurveEntry)]
    check_keys(where, content, [n for n in names if n != "working_slip_ratio"], ("working_slip_ratio",))
    law, n_runs = content["law"], content["n_runs"]
    if not isinstance(law, str) or law not in LAW_PARAMETERS:
        raise ConfigError(f"{where}: law is {law!r}; it must be one of {', '.join(LAW_PARAMETERS)}")
    status = _one_of(PeakStatus, where, "peak_status", content["peak_status"])
    if isinstance(n_runs, bool) or not isinstance(n_runs, int) or n_runs < 1:
        raise ConfigError(f"{where}: n_runs is {n_runs!r}; it must be a whole number of at least 1")
    values: dict[str, Any] = {"working_slip_ratio": None, "law": law, "peak_status": status, "n_runs": n_runs}
    values["parameters"] = _parameters(where, law, content["parameters"])
    for name in names:
        if name in content and name not in ("law", "peak_status", "n_runs", "parameters"):
            read = _interval if name in ("peak_interval_ratio", "slip_range_ratio") else _ratio
            values[name] = read(where, name, content[name])
    return CurveEntry(**values)


def _parameters(where: str, law: str, content: Any) -> dict[str, float]:
    check_keys(f"{where}: parameters", content, list(LAW_PARAMETERS[law]))
    values = {name: _finite(f"{where}: {name}", value) for name, value in content.items()}
    for name, least, most in zip(LAW_PARAMETERS[law], *LAW_BOUNDS[law], strict=True):
        if not least <= values[name] <= most:
            raise ConfigError(f"{where}: {name} is {values[name]:g}; {least:g} to {most:g} are accepted")
    return values


def _interval(where: str, name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ConfigError(f"{where}: {name} is {value!r}; two numbers are required")
    low, high = (_finite(f"{where}: {name}", edge) for edge in value)
    if not -1 <= low <= high <= 1:
        raise ConfigError(f"{where}: {name} is {value!r}; two rising numbers within [-1, 1] are required")
    return low, high


def _ratio(where: str, name: str, value: Any) -> float:
    """Return a number, of a slip one within [-1, 1]."""
    number = _finite(f"{where}: {name}", value)
    if "slip_ratio" in name and abs(number) > 1:
        raise ConfigError(f"{where}: {name} is {value!r}; it must be within [-1, 1]")
    return number


def _one_of(kind: type[_Status], where: str, name: str, value: Any) -> _Status:
    if value not in list(kind):
        raise ConfigError(f"{where}: {name} is {value!r}; it must be one of {', '.join(kind)}")
    return kind(value)


def _finite(where: str, value: Any) -> float:
    if not _is_number(value):
        raise ConfigError(f"{where} is {value!r}; it must be a finite number")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
