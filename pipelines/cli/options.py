"""From the settings of a command to its options, and from its options to its result on the screen and in files."""

from __future__ import annotations

import types
import typing
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import click
from pydantic.fields import FieldInfo

from pipelines.cli.table import Command
from pipelines.report.results import Result, write_json
from pipelines.report.settings import ENDINGS, Settings, check_file, setting

REQUIRED = "Required"  #: Heading of what has to be given


class Output(Settings):
    """Output."""

    json_file: Path | None = setting(None, "Write the result as JSON.", "--json")
    report_file: Path | None = setting(None, option="--report")
    """Write the report as a page (.html) or as Markdown (.md)."""
    details: bool = setting(False, "Print the details, too.")


class OneFile(click.Command):
    """A command of the table, whose settings, run and report are in one module."""

    def __init__(self, command: Command) -> None:
        self.module, self.command = import_module(command.module), command
        fields = self.module.Settings.model_fields | Output.model_fields
        parameters = [_parameter(name, field) for name, field in fields.items() if field.alias]
        super().__init__(command.name, params=parameters, callback=self._execute)

    def _execute(self, **options: Any) -> Result:
        from pipelines.report.terminal import print_report, progress_bar

        # what is not given is None, or () of an option that may be repeated
        given = {name: value for name, value in options.items() if value not in (None, ())}
        output = Output(**{name: given.pop(name) for name in Output.model_fields if name in given})
        if output.json_file is not None:
            check_file(output.json_file, "--json")
        if output.report_file is not None:
            check_file(output.report_file, "--report", ENDINGS)
        settings = self.module.Settings(**given)
        with progress_bar() as progress:
            result: Result = self.module.run(settings, progress)
        report = result.report
        print_report(report, details=output.details)
        if output.json_file is not None:
            write_json(output.json_file, result)
        if output.report_file is not None:
            report.save(output.report_file)
        return result

    def format_help(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write an example, what the command does, and its options by the class that declares them."""
        formatter.write(f"{self.module.EXAMPLE}\n\n")
        text = (self.module.__doc__ or self.command.text).strip()
        formatter.write_text(" ".join(text.split("\n\n")[0].split()))
        for heading, rows in (described_options(self.module.Settings) | described_options(Output)).items():
            with formatter.section(heading):
                formatter.write_dl(rows)


def _parameter(name: str, field: FieldInfo) -> click.Parameter:
    """Return the parameter of a field; the model reads all values, so that they are texts here."""
    shown, extra = str(field.alias), typing.cast("dict[str, Any]", field.json_schema_extra)
    if not shown.startswith("-"):
        return click.Argument([name], required=False)
    if field.annotation is bool:
        names = f"{shown}/--no-{shown.removeprefix('--')}" if field.default else shown
        return click.Option([names, name], is_flag=True, default=None, type=bool)
    return click.Option([shown, name], multiple=extra["repeated"])


def described_options(model: type[Settings]) -> dict[str, list[tuple[str, str]]]:
    """Return how options are written and what they are, by the first line of the class that declares them.

    What has to be given comes first, then what is the command's own.
    """
    groups: dict[str, list[tuple[str, str]]] = {REQUIRED: []}
    heading_of: dict[str, str] = {}
    for kind in model.__mro__:  # the first class that has a field is the last one here
        heading = (kind.__doc__ or "Options").strip().splitlines()[0].rstrip(".")
        groups[heading] = []
        heading_of |= dict.fromkeys(vars(kind).get("__annotations__", ()), heading)
    for name, field in model.model_fields.items():
        if field.alias:
            heading = REQUIRED if field.is_required() else heading_of[name]
            groups[heading].append((_written(field, field.alias), _text(field)))
    return {heading: rows for heading, rows in groups.items() if rows}


def _written(field: FieldInfo, option: str) -> str:
    """Return an option with what stands for its value."""
    if not option.startswith("-"):
        return option
    if field.annotation is bool:
        return f"{option} / --no-{option.removeprefix('--')}" if field.default else option
    return f"{option} {_metavar(field.annotation)}"


def _metavar(kind: Any) -> str:
    """Return what stands for the value in help: the choices, or the kind of value."""
    if typing.get_origin(kind) is Literal:
        return "|".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return _metavar(next(each for each in typing.get_args(kind) if each is not type(None)))
    return {int: "N", float: "X", Path: "PATH"}.get(kind, "TEXT")


def _text(field: FieldInfo) -> str:
    """Return the help of a field with its default; none is shown of a flag."""
    text, default = " ".join((field.description or "").split()), field.default
    if field.is_required() or default is None or isinstance(default, bool) or default in ("", ()):
        return text
    shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
    return f"{text} [default: {shown}]"
