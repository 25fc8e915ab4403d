"""The commands: group, name, module and line of help; and where former commands went.

A module of a command has ``EXAMPLE`` (a command line), ``Settings``, ``run(settings, progress)`` with a
result, and ``report(result)`` beside each kind of result.
"""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """One row: the group under which help lists it, its name, the module that has it, and a line of help."""

    group: str
    name: str
    module: str
    text: str


COMMANDS: tuple[Command, ...] = ()

FORMER: dict[str, str] = {}
"""Former command: a sentence that names its successor."""
