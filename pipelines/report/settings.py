"""Settings of a command: one frozen model is the only place of its defaults, bounds and help.

A field is made by :func:`setting`; :mod:`pipelines.cli.options` turns every field into an option of
the command line.  Unknown names are refused, and what is not accepted is one sentence, a ``ConfigError``.
Nothing heavy is imported here, nor by a module of settings: ``--help`` reads them.
"""

from __future__ import annotations

import os
import typing
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from terrain.errors import ConfigError


def setting(default: Any, text: str, option: str | None = None, repeated: bool = False, **bounds: Any) -> Any:
    """Return a field of a settings model.

    Parameters
    ----------
    default : its only default; ``...`` where it has to be given
    text : its help
    option : how it is given on the command line, as ``--window``; ``--name-of-the-field`` by default; without
        dashes an argument that is given by its place, as ``FOLDER``; empty for a field without one
    repeated : of a tuple: each value has an option of its own; otherwise they are one text, by commas
    bounds : of a number, as pydantic names them: ``ge``, ``gt``, ``le``, ``lt``
    """
    return Field(
        default, description=text, json_schema_extra={"option": option, "repeated": repeated}, **bounds
    )


class Settings(BaseModel):
    """Base of all settings: frozen, unknown names refused, errors in one sentence.

    Examples
    --------
    >>> class Shown(Settings):
    ...     seed: int = setting(0, "Of all that is drawn.", ge=0)
    ...     names: tuple[str, ...] = setting(("a",), "By commas.")
    >>> Shown(names="b, c").names
    ('b', 'c')
    >>> Shown(seed=-1)
    Traceback (most recent call last):
    terrain.errors.ConfigError: --seed is -1: input should be greater than or equal to 0
    """

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigError(_one_sentence(type(self), error)) from None

    @model_validator(mode="before")
    @classmethod
    def _separate(cls, values: dict[str, Any]) -> dict[str, Any]:
        separated = {
            name: tuple(part.strip() for part in value.split(",") if part.strip())
            for name, value in values.items()
            if isinstance(value, str) and name in cls.model_fields and is_separated(cls, name)
        }
        return values | separated

    def with_(self, **changed: Any) -> Self:
        """Return the same settings with some changed, checked anew."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | changed)


class JobsSettings(Settings):
    """Processes."""

    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs or os.cpu_count() or 1


def option_of(model: type[Settings], name: str) -> tuple[str | None, bool]:
    """Return the option that a field is given, or None, and whether it is repeated for several values."""
    extra: Any = model.model_fields[name].json_schema_extra or {"option": None, "repeated": False}
    return extra["option"], extra["repeated"]


def is_separated(model: type[Settings], name: str) -> bool:
    """Return whether several values of a field are given in one text, by commas."""
    kind = model.model_fields[name].annotation
    is_tuple = any(typing.get_origin(each) is tuple for each in (kind, *typing.get_args(kind)))
    return is_tuple and not option_of(model, name)[1]


def option_name(model: type[Settings], name: str) -> str:
    """Return the option of a field, as ``--window``."""
    return option_of(model, name)[0] or f"--{name.replace('_', '-')}"


def _one_sentence(model: type[Settings], error: ValidationError) -> str:
    """Return the first thing that is not accepted."""
    first = error.errors()[0]
    message = str(first["msg"]).removeprefix("Value error, ")
    if not first["loc"] or first["type"] == "value_error":
        return message
    name, given = str(first["loc"][0]), first["input"]
    if first["type"] == "extra_forbidden":
        return f"there is no setting {name!r}"
    option = option_name(model, name)
    if first["type"] == "missing":
        return f"{option} is missing"
    return f"{option} is {_shown(given)}: {message[:1].lower()}{message[1:]}"


def _shown(given: Any) -> str:
    """Return what was given: numbers, also those of the command line, as they are, and texts in quotes."""
    try:
        float(given)
    except (TypeError, ValueError):
        return repr(given)
    return str(given)
