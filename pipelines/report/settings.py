"""Settings of a command: one frozen model is the only place of its defaults, bounds and help.

A field is made by :func:`setting`; :mod:`pipelines.cli.options` turns every field into an option of
the command line.  Unknown names are refused, and what is not accepted is one sentence, a ``ConfigError``.
Nothing heavy is imported here, nor by a module of settings: ``--help`` reads them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from terrain.errors import ConfigError
from terrain.files.atomic import ensure_writable

ENDINGS = (".html", ".md")  #: Of reports


def separated(given: Any) -> Any:
    """Return the values of one text, which commas separate; what is no text as it is."""
    if not isinstance(given, str):
        return given
    return [part.strip() for part in given.split(",") if part.strip()]


ByCommas = BeforeValidator(separated)  #: Of a tuple: it may be given as one text

Names = Annotated[tuple[str, ...], ByCommas]  #: Texts, by commas


def setting(
    default: Any, text: str | None = None, option: str | None = None, repeated: bool = False, **bounds: Any
) -> Any:
    """Return a field of a settings model.

    Parameters
    ----------
    default : its only default; ``...`` where it has to be given
    text : its help; one that is long stands below the field instead, as its docstring
    option : how it is given on the command line, as ``--window``; ``--name-of-the-field`` by default; without
        dashes an argument that is given by its place, as ``FOLDER``; empty for a field without one
    repeated : of a tuple: each value has an option of its own
    bounds : of a number, as pydantic names them: ``ge``, ``gt``, ``le``, ``lt``
    """
    return Field(default, description=text, alias=option, json_schema_extra={"repeated": repeated}, **bounds)


class Settings(BaseModel):
    """Base of all settings: frozen, unknown names refused, errors in one sentence.

    Examples
    --------
    >>> class Shown(Settings):
    ...     seed: int = setting(0, "Of all that is drawn.", ge=0)
    ...     names: Names = setting(("a",), "By commas.")
    >>> Shown(names="b, c").names, Shown.model_fields["names"].alias
    (('b', 'c'), '--names')
    >>> Shown(seed=-1)
    Traceback (most recent call last):
    terrain.errors.ConfigError: --seed is -1: input should be greater than or equal to 0
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        arbitrary_types_allowed=True,
        populate_by_name=True,
        use_attribute_docstrings=True,
        alias_generator=lambda name: f"--{name.replace('_', '-')}",
    )

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigError(_one_sentence(type(self), error)) from None

    def with_(self, **changed: Any) -> Self:
        """Return the same settings with some changed, checked anew."""
        return type(self)(**dict(self) | changed)

    def refuse(self, names: Iterable[str], why: str) -> None:
        """Refuse settings that are given, as those of another mode of a command: ``ConfigError`` with the reason."""
        for name in names:
            field = type(self).model_fields[name]
            if getattr(self, name) != field.default:
                raise ConfigError(f"{field.alias} {why}")

    def refuse_others(self, mode: str, modes: Mapping[str, type[Settings]], why: str) -> None:
        """Refuse options of other modes than the one asked for; in the reason ``{of}`` is theirs, ``{mode}`` that."""
        for name, group in modes.items():
            if name != mode:
                self.refuse(group.model_fields, why.format(of=name, mode=mode))


class JobsSettings(Settings):
    """Processes."""

    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs or os.cpu_count() or 1


def check_file(path: Path, option: str, endings: tuple[str, ...] = ()) -> None:
    """Refuse a file that cannot be written, before the work is done.

    Raises
    ------
    ConfigError
        if it is a folder, has none of the endings, or nothing can be written there.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; {option} names a file")
    if endings and path.suffix.lower() not in endings:
        raise ConfigError(
            f"{option} is {str(path)!r}; a name that ends in {' or '.join(endings)} is required"
        )
    ensure_writable(path.parent)


def _one_sentence(model: type[Settings], error: ValidationError) -> str:
    """Return the first thing that is not accepted."""
    first = error.errors()[0]
    message = str(first["msg"]).removeprefix("Value error, ")
    if not first["loc"] or first["type"] == "value_error":
        return message
    name, given = str(first["loc"][0]), first["input"]
    if first["type"] == "extra_forbidden":
        return f"there is no setting {name!r}"
    if first["type"] == "missing":
        return f"{name} is missing"
    shown = repr(given)
    with suppress(TypeError, ValueError):  # numbers, also those of the command line, are without quotes
        float(given)
        shown = str(given)
    return f"{model.model_fields[name].alias} is {shown}: {message[:1].lower()}{message[1:]}"
