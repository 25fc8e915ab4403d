"""The controllers that are compared: names, pilots, where they have the terrain from, and a sentence on each."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

TRACK = "+track"
"""Suffix of a controller with path tracking; all but ``plain`` and ``ramp`` can have it."""


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

    @property
    def adapts(self) -> bool:
        """Whether its target follows the terrain."""
        return self.source in (Source.CLASSIFIER, Source.TRUTH)


_THESIS, _TRACTION = "The thesis' PID of slip on each wheel, with the target", "Traction control"

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
    "classified": Kind(
        "traction",
        Source.CLASSIFIER,
        f"{_TRACTION} with the target of the terrain that a classifier recognises while driving.",
    ),
    "true_terrain": Kind(
        "traction",
        Source.TRUTH,
        f"{_TRACTION} with the target of the true terrain: the limit for a classifier without error.",
    ),
    "thesis:classified": Kind(
        "thesis",
        Source.CLASSIFIER,
        f"{_THESIS}s of the terrain that a classifier recognises while driving: the chain of the thesis.",
    ),
    "thesis:true_terrain": Kind("thesis", Source.TRUTH, f"{_THESIS}s of the true terrain."),
}
"""By name; beside them there are ``known:NAME`` and ``target:SLIP``."""

CONTROLLERS = tuple(name for name in KINDS if ":" not in name)
"""Those of a comparison by default."""


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
