"""The controllers that are compared: names, pilots, where they have the terrain from, and a sentence on each.

Settings of a command read the names, so that nothing heavy is imported here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from terrain.errors import ConfigError

if TYPE_CHECKING:
    from terrain.control.robot_control import PilotSettings
    from terrain.control.slip_table import SlipTable

TRACK = "+track"  #: Suffix of a controller with path tracking; all but ``plain`` and ``ramp`` can have it.


class Source(Enum):
    """Where a controller has the current terrain from."""

    NONE = "none"
    CLASSIFIER = "classifier"
    TRUTH = "truth"
    KNOWN = "known"


class Kind(NamedTuple):
    """What a controller is: the pilot's own controller, where the terrain comes from, and a sentence."""

    pilot: str
    source: Source
    text: str


_THESIS, _TRACTION = "The thesis' PID of slip on each wheel, with the target", "Traction control"
_CLASSIFIED = "of the terrain that a classifier recognises while driving"

#: By name; beside them there are ``known:NAME`` and ``target:SLIP``.
KINDS = {
    "plain": Kind("plain", Source.NONE, "The wheel speeds of the kinematics; slip is not used."),
    "ramp": Kind("ramp", Source.NONE, "As plain, with a speed that rises by no more than {ramp}."),
    "thesis": Kind("thesis", Source.NONE, f"{_THESIS} of the table's fallback."),
    "fallback": Kind(
        "traction",
        Source.NONE,
        f"{_TRACTION}: one speed for all wheels, limited while it rises; the target is that of the table's "
        "fallback.",
    ),
    "classified": Kind("traction", Source.CLASSIFIER, f"{_TRACTION} with the target {_CLASSIFIED}."),
    "true_terrain": Kind(
        "traction",
        Source.TRUTH,
        f"{_TRACTION} with the target of the true terrain: the limit for a classifier without error.",
    ),
    "thesis:classified": Kind(
        "thesis", Source.CLASSIFIER, f"{_THESIS}s {_CLASSIFIED}: the chain of the thesis."
    ),
    "thesis:true_terrain": Kind("thesis", Source.TRUTH, f"{_THESIS}s of the true terrain."),
}
CONTROLLERS = tuple(name for name in KINDS if ":" not in name)  #: Those of a comparison by default.


def kind_of(name: str) -> Kind | None:
    """Return what a controller is, with or without path tracking; None if there is none of that name.

    Examples
    --------
    >>> kind_of("true_terrain+track").source.value, kind_of("known:clay").pilot, kind_of("best")
    ('truth', 'traction', None)
    """
    bare = name.partition(TRACK)[0]
    kind, _, given = bare.partition(":")
    if kind == "known" and given:
        return Kind("traction", Source.KNOWN, f"{_TRACTION} with the target of {given} on every terrain.")
    if kind == "target":
        return Kind("traction", Source.NONE, f"{_TRACTION} with a target slip of {given}.")
    return KINDS.get(bare)


def uses_classifier(name: str) -> bool:
    """Return whether a controller has the terrain from a classifier."""
    kind = kind_of(name)
    return kind is not None and kind.source is Source.CLASSIFIER


def adapts(name: str) -> bool:
    """Return whether the target of a controller follows the terrain."""
    kind = kind_of(name)
    return kind is not None and kind.source in (Source.CLASSIFIER, Source.TRUTH)


def pairs_to_compare(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs to compare: all with plain, traction control with ramp and fallback, PID with PID.

    Examples
    --------
    >>> pairs_to_compare(["plain", "fallback", "true_terrain"])[1:]
    [('true_terrain', 'plain'), ('true_terrain', 'fallback')]
    """
    pilots = {name: kind.pilot for name in names if (kind := kind_of(name)) is not None}
    traction = [name for name in names if pilots.get(name) == "traction"]
    thesis = [name for name in names if pilots.get(name) == "thesis"]
    compared = (
        ([name for name in names if name != "plain"], "plain"),
        (traction, "ramp"),
        ([name for name in traction if name in KINDS and adapts(name)], "fallback"),
        ([name for name in thesis if name in KINDS and adapts(name)], "thesis"),
    )
    pairs = [(name, other) for those, other in compared if other in names for name in those]
    return pairs or [(name, names[0]) for name in names[1:]]


@dataclass(frozen=True, slots=True)
class Controller:
    """What the name of a controller stands for."""

    name: str  #: as given
    pilot: PilotSettings  #: its settings
    table: SlipTable  #: its targets
    source: Source = Source.NONE  #: of the current terrain
    known_terrain: str = ""  #: given to the pilot on every terrain, where the source is ``KNOWN``


def make_controller(
    name: str, table: SlipTable, delay_s: float, ramp_mps2: float | None = None
) -> Controller:
    """Return a controller: of :data:`KINDS`, ``known:NAME`` or ``target:SLIP``, with or without path tracking.

    The delay is from a sample to the wheel, the ramp the largest rise of speed of ``ramp``.  ``ConfigError`` is
    raised if there is none of that name, or its terrain or target is none.
    """
    from terrain.control.robot_control import PilotSettings
    from terrain.records import SlipTarget, TargetStatus

    kind, (bare, track, rest) = kind_of(name), name.partition(TRACK)
    if kind is None or rest:
        raise ConfigError(
            f"controller {name!r} is unknown: use {', '.join(KINDS)}, known:NAME, target:SLIP; {TRACK}"
        )
    pilot = PilotSettings(controller=kind.pilot, delay_s=delay_s, track=bool(track))
    if ramp_mps2 is not None:
        pilot = replace(pilot, ramp_mps2=ramp_mps2)
    given = bare.partition(":")[2]
    if kind.source is Source.KNOWN and given not in table.targets:
        raise ConfigError(f"controller {name!r}: the table {table.name} has no entry {given!r}")
    if bare.startswith("target:"):
        try:
            ratio = float(given)
        except ValueError:
            ratio = math.nan
        if not 0.0 <= ratio < 1.0:
            raise ConfigError(f"controller {name!r}: a slip from 0 to below 1 is required")
        target = SlipTarget(table.fallback, "traction", ratio, math.nan, 0, TargetStatus.UNESTIMATED, "given")
        only = {table.fallback: {**table.targets[table.fallback], "traction": target}}
        table = replace(table, targets=only, curves={}, reasons={})
    return Controller(name, pilot, table, kind.source, given if kind.source is Source.KNOWN else "")
