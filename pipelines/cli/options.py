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
from pipelines.report.results import Result
from pipelines.report.settings import Settings, option_name, option_of

PATH = click.Path(path_type=Path)
WIDTH = 110
"""Characters of a line of help at most."""

COMMON, REQUIRED = "Output", "Required"
"""Headings of the options that every command has, and of those that have to be given."""


class Option(click.Option):
    """An option that knows under which heading help lists it."""

    heading: str = COMMON


class OneFile(click.Command):
    """A command of the table, whose settings, run and report are in one module."""

    def __init__(self, command: Command) -> None:
        self.module, self.command = import_module(command.module), command
        model = self.module.Settings
        super().__init__(
            command.name,
            params=[*(one for name in model.model_fields for one in _parameters(model, name)), *_common()],
            callback=self._execute,
            context_settings={"help_option_names": ["-h", "--help"], "max_content_width": WIDTH},
        )

    def _execute(
        self, json_file: Path | None, report_file: Path | None, details: bool, **given: Any
    ) -> Result:
        from pipelines.report.json_file import write_json
        from pipelines.report.terminal import output_console, print_report, progress_bar
        from pipelines.report.writing import ENDINGS, check_file

        if json_file is not None:
            check_file(json_file, "--json")
        if report_file is not None:
            check_file(report_file, "--report", ENDINGS)
        settings = self.module.Settings(
            **{name: value for name, value in given.items() if value not in (None, ())}
        )
        with progress_bar() as progress:
            result: Result = self.module.run(settings, progress)
        report = result.report
        print_report(report, output_console(), details=details)
        if json_file is not None:
            write_json(json_file, result)
        if report_file is not None:
            report.save(report_file)
        return result

    def format_help(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write an example, what the command does, and its options by the class that declares them."""
        formatter.write(f"{self.module.EXAMPLE}\n\n")
        text = (self.module.__doc__ or self.command.text).strip()
        formatter.write_text(" ".join(text.split("\n\n")[0].split()))
        arguments = [each for each in self.params if isinstance(each, click.Argument)]
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.params:
            if isinstance(parameter, Option):
                record = parameter.get_help_record(context)
                if record is not None:
                    groups.setdefault(parameter.heading, []).append(record)
        if arguments:
            with formatter.section("Arguments"):
                formatter.write_dl(
                    [(each.make_metavar(context), getattr(each, "text", "")) for each in arguments]
                )
        kinds = self.module.Settings.__mro__  # what is the command's own comes first
        order = [REQUIRED, *(_headline(kind) for kind in kinds), COMMON]
        for heading in sorted(groups, key=order.index):
            with formatter.section(heading):
                formatter.write_dl(groups[heading])


def _parameters(model: type[Settings], name: str) -> list[click.Parameter]:
    """Return the parameter of a field; the model reads all values, so that they are texts here."""
    field, (option_given, several) = model.model_fields[name], option_of(model, name)
    if option_given == "":
        return []
    shown = option_name(model, name)
    if not shown.startswith("-"):
        argument = click.Argument([name], required=False, nargs=-1 if several else 1, metavar=shown)
        argument.text = field.description  # type: ignore[attr-defined]
        return [argument]
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    flag = field.annotation is bool
    names = f"{shown}/--no-{shown.removeprefix('--')}" if flag and default else shown
    option = Option(
        [names, name],
        help=_help(field, default),
        is_flag=flag,
        multiple=several,
        default=None,
        metavar=None if flag else _metavar(field.annotation),
        type=bool if flag else str,
    )
    option.heading = _heading(model, name)
    return [option]


def _help(field: FieldInfo, default: Any) -> str:
    text = field.description or ""
    if field.is_required():
        return text
    if default is None or isinstance(default, bool) or default in ("", ()):
        return text
    shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
    return f"{text} [default: {shown}]"


def _metavar(kind: Any) -> str:
    """Return what stands for the value in help: the choices, or the kind of value."""
    if typing.get_origin(kind) is Literal:
        return "|".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return _metavar(next(each for each in typing.get_args(kind) if each is not type(None)))
    return {int: "N", float: "X", Path: "PATH"}.get(kind, "TEXT")


def _heading(model: type[Settings], name: str) -> str:
    """Return under what help lists a field: the first line of the docstring of the class that declares it."""
    if model.model_fields[name].is_required():
        return REQUIRED
    return _headline([kind for kind in model.__mro__ if name in vars(kind).get("__annotations__", {})][-1])


def _headline(kind: type) -> str:
    return (kind.__doc__ or "Options").strip().splitlines()[0].rstrip(".")


def _common() -> list[click.Parameter]:
    return [
        Option(["--json", "json_file"], metavar="FILE", type=PATH, help="Write the result as JSON."),
        Option(
            ["--report", "report_file"],
            metavar="FILE",
            type=PATH,
            help="Write the report as a page (.html) or as Markdown (.md).",
        ),
        Option(["--details"], is_flag=True, help="Print the details, too."),
    ]
