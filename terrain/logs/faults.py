"""What is wrong with a log of messages: refused at once, or counted where it is repaired."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from terrain.errors import LogError

EARLY_END = "files that end early"
DAMAGED_BLOCK = "damaged blocks of messages"
DAMAGED_MESSAGE = "damaged messages"


class Topic(NamedTuple):
    """A topic: its type, how its messages are encoded, and the definition that the file holds of it.

    ``definition`` is text; of Protobuf it is its bytes, a character each.
    """

    name: str
    kind: str
    encoding: str
    schema_encoding: str
    definition: str


class Faults:
    """Faults of one log.

    Parameters
    ----------
    repairs : counts by kind; None refuses

    Attributes
    ----------
    first : what a strict read would refuse first; empty without a fault
    """

    def __init__(self, repairs: Counter[str] | None) -> None:
        self.repairs, self.first = repairs, ""

    def found(self, place: str, kind: str, text: str, n: int = 1) -> None:
        """Raise :class:`LogError`, or count."""
        self.first = self.first or f"{place}: {text}; read it with --repair to leave that out"
        if self.repairs is None:
            raise LogError(self.first)
        self.repairs[kind] += n
