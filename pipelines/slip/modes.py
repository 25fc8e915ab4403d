"""Refusal of options that are of another mode of a command."""

from __future__ import annotations

from collections.abc import Mapping

from pipelines.report.settings import Settings
from terrain.errors import ConfigError


def refuse_others(settings: Settings, groups: Mapping[str, type[Settings]], used: str, chosen: str) -> None:
    """Refuse options that a mode does not read.

    Parameters
    ----------
    settings : of the command, which has the fields of all groups
    groups : options, by what they are for
    used : key of the group of the chosen mode
    chosen : the mode, as a sentence names it

    Raises
    ------
    ConfigError
        if an option of another group is set.
    """
    for purpose, group in groups.items():
        for name, field in {} if purpose == used else group.model_fields.items():
            if getattr(settings, name) != field.get_default(call_default_factory=True):
                raise ConfigError(f"{field.alias} is for {purpose}, not for {chosen}")
