"""Base of statuses: enums whose numbers compiled steps and streams can hold."""

from __future__ import annotations

from enum import IntEnum


class StatusCode(IntEnum):
    """A status by its number; a stream of numbers holds it under a name that ends in ``_code``."""

    @property
    def label(self) -> str:
        """Name as screens and figures show it, in small letters."""
        return self.name.lower().replace("_", " ")
