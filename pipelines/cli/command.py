"""From a settings model to the options of a command; the file of a command only calls what does the work."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo

from pipelines.report.json_file import checked_json
from pipelines.report.settings import Settings, option_name, option_text


def command(app: typer.Typer, name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command; parameters that are :class:`Settings` become their fields' options.

    Parameters
    ----------
    app : that gets the command
    name : of the command
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        hints = typing.get_type_hints(function, include_extras=True)
        models: dict[str, type[Settings]] = {}
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(function).parameters.values():
            kind = hints[parameter.name]
            if isinstance(kind, type) and issubclass(kind, Settings):
                models[parameter.name] = kind
                parameters += _options(kind)
            else:
                keyword = inspect.Parameter.KEYWORD_ONLY
                parameters.append(parameter.replace(annotation=kind, kind=keyword))

        @functools.wraps(function)
        def run(**given: Any) -> None:
            function(**{key: _filled(kind, given) for key, kind in models.items()}, **given)

        # options that must be given come first in help
        ordered = sorted(parameters, key=lambda each: each.default is not inspect.Parameter.empty)
        run.__signature__ = inspect.Signature(ordered)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in ordered}
        app.command(name)(run)
        return function

    return register


def _options(model: type[Settings]) -> list[inspect.Parameter]:
    options: list[inspect.Parameter] = []
    for name, field in model.model_fields.items():
        written = option_text(model, name)
        if written.option == "":
            continue
        kind, default = _shown_type(field, written.separated), _default(field, written.separated)
        shown = option_name(model, name)
        switch = field.annotation is bool and default
        names = f"{shown}/--no-{shown.removeprefix('--')}" if switch else shown
        option = (
            typer.Option(names, help=field.description)
            if shown.startswith("-")
            else typer.Argument(metavar=shown, help=field.description)
        )
        options.append(_parameter(name, default, Annotated[kind, option]))
        for number, alias in enumerate(written.aliases):
            hidden = typer.Option(alias, hidden=True)
            options.append(_parameter(f"{name}_alias_{number}", None, Annotated[kind | None, hidden]))
    return options


def _parameter(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _default(field: FieldInfo, separated: bool) -> Any:
    if field.is_required():
        return inspect.Parameter.empty
    default = field.get_default(call_default_factory=True)
    return ",".join(str(part) for part in default) if separated and default is not None else default


def _shown_type(field: FieldInfo, separated: bool) -> Any:
    """Return the type that the command line reads; everything else is a text, and the model reads that."""
    kind = field.annotation
    if separated:
        return str | None if field.get_default() is None else str
    return list[str] if kind == tuple[str, ...] else kind


def _filled(model: type[Settings], given: dict[str, Any]) -> Settings:
    """Take a model's fields out of what was given, and return the model."""
    values = {}
    for name in model.model_fields:
        if option_text(model, name).option == "":
            continue
        values[name] = given.pop(name)
        for number, _ in enumerate(option_text(model, name).aliases):
            earlier = given.pop(f"{name}_alias_{number}")
            values[name] = values[name] if earlier is None else earlier
    return model(**values)


Json = Annotated[
    Path | None,
    typer.Option("--json", help="Write the result to this file as JSON.", callback=checked_json),
]
