"""From the settings of a command to its options, and from its options to its result on the screen and in files."""

from __future__ import annotations

import shlex
import types
import typing
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import click

from pipelines.cli.table import COMMANDS, Command
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
        parameters: list[click.Parameter] = []
        for name, field in (self.module.Settings.model_fields | Output.model_fields).items():
            shown = field.alias  # the model reads all values, so that they are texts here
            if not shown:
                continue
            if not shown.startswith("-"):
                parameters.append(click.Argument([name], required=False))
            elif field.annotation is bool:
                names = f"{shown}/--no-{shown.removeprefix('--')}" if field.default else shown
                parameters.append(click.Option([names, name], is_flag=True, default=None, type=bool))
            else:
                parameters.append(click.Option([shown, name], multiple=field.json_schema_extra["repeated"]))
        super().__init__(command.name, params=parameters, callback=self._execute)

    def _execute(self, **options: Any) -> Result:
        from pipelines.report.terminal import print_report, progress_bar

        given: dict[str, Any] = {}
        of_output: dict[str, Any] = {}
        for name, value in options.items():
            if value not in (None, ()):  # what is not given is None, or () of an option that may be repeated
                (of_output if name in Output.model_fields else given)[name] = value
        output = Output(**of_output)
        if output.json_file is not None:
            check_file(output.json_file, "--json")
        if output.report_file is not None:
            check_file(output.report_file, "--report", ENDINGS)
        settings = self.module.Settings(**given)
        with progress_bar() as progress:
            result: Result = self.module.run(settings, progress)
        report = result.report
        report = replace(report, next_step=next_command(report.next_step, given))
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


def next_command(step: str, given: Mapping[str, Any]) -> str:
    """Return a command line that a report names as the next, with what this command was given and the next one takes.

    ``DIR`` in it stands for the data of this command, which come with their mapping and format.  The robot is that of
    this command, unless the line names another one's file.

    Examples
    --------
    >>> next_command("terrain estimate --data DIR --out runs/", {"data": "raw/", "robot": "mine.yaml"})
    'terrain estimate --data raw/ --out runs/ --robot mine.yaml'
    >>> next_command("terrain estimate --data DIR --out runs/", {"data": "my logs/"})
    "terrain estimate --data 'my logs/' --out runs/"
    >>> next_command("terrain train --data it's/", {})
    "terrain train --data it's/"
    """
    words = step.split()
    module = next((each.module for each in COMMANDS if words[:2] == ["terrain", each.name]), None)
    if module is None:
        return step
    fields = {field.alias for field in import_module(module).Settings.model_fields.values()}
    if "DIR" in words and given.get("data"):
        words[words.index("DIR")] = shlex.quote(str(given["data"]))
        for name, option in (("layout", "--format"), ("mapping", "--mapping")):
            if given.get(name) and option in fields:
                words += [option, shlex.quote(str(given[name]))]
    if given.get("robot") and "--robot" in fields:
        from terrain.robots import load_robot, robot_argument

        file = shlex.quote(str(given["robot"]))
        if "--robot" not in words:
            words += ["--robot", file]
        elif words[words.index("--robot") + 1] in (
            "ROBOT",
            robot_argument(load_robot(str(given["robot"])).name),
        ):
            words[words.index("--robot") + 1] = file
    return " ".join(words)


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
        if not field.alias:
            continue
        option, default = field.alias, field.default
        if field.annotation is bool:
            option += f" / --no-{option.removeprefix('--')}" if default else ""
        elif option.startswith("-"):
            option += f" {_metavar(field.annotation)}"
        text = " ".join((field.description or "").split())
        if not (field.is_required() or default is None or isinstance(default, bool) or default in ("", ())):
            shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
            text += f" [default: {shown}]"
        groups[REQUIRED if field.is_required() else heading_of[name]].append((option, text))
    return {heading: rows for heading, rows in groups.items() if rows}


def _metavar(kind: Any) -> str:
    """Return what stands for the value in help: the choices, or the kind of value."""
    if typing.get_origin(kind) is Literal:
        return "|".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return _metavar(next(each for each in typing.get_args(kind) if each is not type(None)))
    return {int: "N", float: "X", Path: "PATH"}.get(kind, "TEXT")
