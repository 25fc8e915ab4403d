"""Names of the controllers that are compared."""

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


def base_name(name: str) -> str:
    """Return the name of a controller without path tracking.

    Examples
    --------
    >>> base_name("true_terrain+track")
    'true_terrain'
    """
    return name.partition(TRACK)[0]
