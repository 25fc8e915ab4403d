"""Names of the controllers that are compared, and those of earlier releases."""

from __future__ import annotations

TRACK = "+track"
"""Suffix of a controller with path tracking."""

CONTROLLERS = ("plain", "ramp", "thesis", "fallback", "classified", "true_terrain")
"""Commands of the kinematics; with a bounded rise of speed; the thesis' PID of slip on each wheel; the
traction controller with the target of the table's fallback, of the classified terrain, and of the true one.
Also :data:`THESIS_ADAPTING`; ``known:NAME`` and ``target:SLIP``, the traction controller with the target of
that terrain, and with that target; and all but the first two with :data:`TRACK`."""

BASELINES = ("plain", "ramp", "thesis")
THESIS_ADAPTING = ("thesis:classified", "thesis:true_terrain")
"""The thesis' PID with the targets of the classified terrain, which is the chain of the thesis, and of the
true one; ``thesis`` alone has those of the table's fallback."""

USING_CLASSIFIER = ("classified", "thesis:classified")
ADAPTING = ("classified", "true_terrain", *THESIS_ADAPTING)
"""Controllers whose target follows the terrain."""

_EARLIER = {"fixed": "fallback", "learned": "classified", "oracle": "true_terrain", "told": "known"}


def current_name(name: str) -> str:
    """Return the name of a controller, given that or the one of earlier releases.

    Examples
    --------
    >>> current_name("oracle+track"), current_name("told:clay"), current_name("plain")
    ('true_terrain+track', 'known:clay', 'plain')
    """
    return _renamed(name, _EARLIER)


def earlier_name(name: str) -> str:
    """Return the name that a controller had in earlier releases.

    Examples
    --------
    >>> earlier_name("true_terrain+track"), earlier_name("known:clay"), earlier_name("plain")
    ('oracle+track', 'told:clay', 'plain')
    """
    return _renamed(name, {new: old for old, new in _EARLIER.items()})


def base_name(name: str) -> str:
    """Return the name of a controller without path tracking."""
    return name.partition(TRACK)[0]


def _renamed(name: str, names: dict[str, str]) -> str:
    kind = base_name(name).partition(":")[0]
    return names.get(kind, kind) + name.removeprefix(kind)
