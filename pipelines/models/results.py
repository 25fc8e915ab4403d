"""What registering a model gives."""

from __future__ import annotations

from typing import NamedTuple


class Registered(NamedTuple):
    """A registered version of a model, and whether the alias ``champion`` moved to it."""

    model_uri: str
    version: str
    run_id: str
    alias_moved: bool
    alias_reason: str
