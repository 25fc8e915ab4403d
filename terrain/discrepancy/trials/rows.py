"""Kinds of blind trials.  Imports nothing heavy: the command line reads it."""

from __future__ import annotations

from enum import StrEnum


class Row(StrEnum):
    """What is hidden in the runs of a trial.

    ``NONE``: nothing.  ``STRONG``: one effect of 3 times its detection limit.  ``LADDER``: one effect of 0.1
    to 10 times its limit.  ``FOUND``: each effect in turn, around its limit.  ``TWO``: two effects.
    ``OUTSIDE``: something that is not in the library.  ``POOR``: one effect, with drives that excite little.
    """

    NONE = "none"
    STRONG = "strong"
    LADDER = "ladder"
    FOUND = "found"
    TWO = "two"
    OUTSIDE = "outside"
    POOR = "poor"
