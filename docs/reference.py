"""Write ``docs/commands.md``: every command with its options, and the fields of what ``--json`` writes.

    python docs/reference.py

All of it comes from the settings and results of the commands; a test holds the page to them.
"""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path
from types import ModuleType

from pipelines.cli.options import described_options
from pipelines.cli.table import COMMANDS
from pipelines.report.pages import markdown_table
from pipelines.report.results import Result
from pipelines.report.settings import Settings
from pipelines.report.tree import Column, Table

PAGE = Path(__file__).with_name("commands.md")


def commands_page() -> str:
    """Return the page."""
    blocks = [
        "# Commands and JSON",
        "Written by `python docs/reference.py` from the settings and results of the commands. Every command also takes "
        "`--json FILE`, `--report FILE` and `--details`. In JSON a number that is not known is `null`.",
    ]
    group = ""
    for command in COMMANDS:
        if command.group != group:
            group = command.group
            blocks.append(f"## {group}")
        module = import_module(command.module)
        text = " ".join((module.__doc__ or command.text).split("\n\n")[0].split())
        example = f"```\n{module.EXAMPLE}\n```"
        blocks += [f"### terrain {command.name}", text, example, _options(module.Settings)]
        blocks += [_fields(kind) for kind in _results(module)]
    return "\n\n".join(blocks) + "\n"


def _options(model: type[Settings]) -> str:
    rows = [row for options in described_options(model).values() for row in options]
    return markdown_table(Table(("option", Column("meaning", long=True)), rows))


def _results(module: ModuleType) -> list[type[Result]]:
    """Return the kinds of result that a module has, and those of the room's modules that it dispatches to."""
    modules = [module, *map(import_module, getattr(module, "RESULTS", ()))]
    own = [kind for each in modules for _, kind in inspect.getmembers(each, inspect.isclass)]
    return [kind for kind in dict.fromkeys(own) if issubclass(kind, Result) and not kind.__subclasses__()]


def _fields(kind: type[Result]) -> str:
    rows = [
        (name, about.get("unit", ""), about.get("description", ""))
        for name, about in kind.schema()["properties"].items()
    ]
    return f"JSON of `{kind.__name__}`:\n\n" + markdown_table(Table(("key", "unit", "meaning"), rows))


if __name__ == "__main__":
    PAGE.write_text(commands_page(), encoding="utf-8")
