"""Settings of a command: one frozen model is the only place of its defaults, bounds and help.

A field is made by :func:`setting`; :mod:`pipelines.cli.options` turns every field into an option of
the command line.  Unknown names are refused, and what is not accepted is one sentence, a ``ConfigError``.
Nothing heavy is imported here, nor by a module of settings: ``--help`` reads them.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from terrain.errors import ConfigError


class OptionText(NamedTuple):
    """How a field is written on the command line.

    Parameters
    ----------
    option : its option, as ``--window``; ``--name-of-the-field`` by default; without dashes an argument that
        is given by its place, as ``FOLDER``; empty for a field without one
    separated : whether several values are given in one text, by commas
    """

    option: str | None = None
    separated: bool = False


def setting(
    default: Any,
    text: str,
    option: str | None = None,
    separated: bool = False,
    **bounds: Any,
) -> Any:
    """Return a field of a settings model.

    Parameters
    ----------
    default : its only default; ``...`` where it has to be given
    text : its help
    option, separated : as :class:`OptionText`
    bounds : of a number, as pydantic names them: ``ge``, ``gt``, ``le``, ``lt``
    """
    return Field(default, description=text, json_schema_extra={"option": [option, separated]}, **bounds)


class Settings(BaseModel):
    """Base of all settings: frozen, unknown names refused, errors in one sentence.

    Examples
    --------
    >>> class Shown(Settings):
    ...     seed: int = setting(0, "Of all that is drawn.", ge=0)
    ...     names: tuple[str, ...] = setting(("a",), "By commas.", separated=True)
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
        values = dict(values)
        for name in cls.model_fields:
            if option_text(cls, name).separated and isinstance(values.get(name), str):
                values[name] = tuple(part.strip() for part in values[name].split(",") if part.strip())
        return values

    def with_(self, **changed: Any) -> Self:
        """Return the same settings with some changed, checked anew."""
        return type(self)(**{name: getattr(self, name) for name in type(self).model_fields} | changed)


def option_text(model: type[Settings], name: str) -> OptionText:
    """Return how a field of a model is written on the command line."""
    extra = model.model_fields[name].json_schema_extra
    if not isinstance(extra, dict):
        return OptionText()
    option, separated = extra["option"]  # type: ignore[misc, str-unpack]
    return OptionText(option, bool(separated))  # type: ignore[arg-type]


def option_name(model: type[Settings], name: str) -> str:
    """Return the option of a field, as ``--window``."""
    return option_text(model, name).option or f"--{name.replace('_', '-')}"


def _one_sentence(model: type[Settings], error: ValidationError) -> str:
    """Return the first thing that is not accepted."""
    first = error.errors()[0]
    message = str(first["msg"])
    message = message.removeprefix("Value error, ")
    if not first["loc"] or first["type"] == "value_error":
        return message
    name = str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return f"there is no setting {name!r}"
    option = option_name(model, name)
    if first["type"] == "missing":
        return f"{option} is missing"
    given = first["input"]
    shown = given if isinstance(given, str) and _is_number(given) else repr(given)
    return f"{option} is {shown}: {message[:1].lower()}{message[1:]}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
