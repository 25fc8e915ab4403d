"""A report as Markdown, as a model card has it; names from files may hold any sign and are escaped."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from pipelines.report.figure import Figure
from pipelines.report.numbers import plain_line
from pipelines.report.tree import Pairs, Part, Report, Section, Table, Text

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~&!])")
_ADDRESS = re.compile(r"(https?|ftp)(?=://)", re.IGNORECASE)


def escape_markdown(text: str) -> str:
    r"""Return a text that Markdown shows as it is, on one line.

    Examples
    --------
    >>> print(escape_markdown("DIRT_ROAD | <b>\n# one"))
    DIRT\_ROAD \| \<b\>\\n\# one
    """
    return _ADDRESS.sub(r"\1\\", _SPECIAL.sub(r"\\\1", plain_line(text)))


def markdown_text(report: Report) -> str:
    """Return a report as Markdown; details are folded, figures are left to pages.

    Examples
    --------
    >>> print(markdown_text(Report("Runs", "All are right.", parts=[Pairs([("runs", 3)])])))
    # Runs
    <BLANKLINE>
    **All are right.**
    <BLANKLINE>
    - runs: 3
    <BLANKLINE>
    """
    blocks = [f"# {escape_markdown(report.title)}", f"**{escape_markdown(report.answer)}**"]
    blocks += [escape_markdown(report.lead)] if report.lead else []
    blocks += _blocks(report.parts, 2)
    for section in report.details:
        inside = "\n\n".join(_blocks(section.parts, 3))
        blocks.append(
            f"<details><summary>{escape_markdown(section.title)}</summary>\n\n{inside}\n\n</details>"
        )
    blocks += [f"Next: `{report.next_step}`"] if report.next_step else []
    return "\n\n".join(blocks) + "\n"


def _blocks(parts: Sequence[Part], level: int) -> Iterator[str]:
    for part in parts:
        if isinstance(part, Text) and part.kind == "code":
            yield f"```\n{part.text}\n```"
        elif isinstance(part, Text):
            yield ("" if part.kind == "plain" else "> ") + escape_markdown(part.text)
        elif isinstance(part, Table):
            yield from [f"**{escape_markdown(part.title)}**"] if part.title else []
            yield markdown_table(part)
            yield from [escape_markdown(part.note)] if part.note else []
        elif isinstance(part, Pairs):
            yield from [f"**{escape_markdown(part.title)}**"] if part.title else []
            yield "\n".join(
                f"- {escape_markdown(name)}: {escape_markdown(value)}" for name, value in part.cells
            )
        elif isinstance(part, Figure):
            yield f"*{escape_markdown(part.title)}: {escape_markdown(part.caption or part.alt)}*"
        elif isinstance(part, Section):
            yield f"{'#' * level} {escape_markdown(part.title)}"
            yield from _blocks(part.parts, level + 1)


def markdown_table(table: Table) -> str:
    r"""Return the table alone.

    Examples
    --------
    >>> print(markdown_table(Table(("run", "windows"), [("a|b", 3)])))
    | run | windows |
    |---|---:|
    | a\|b | 3 |
    """
    columns = table.written
    lines = [[each.heading for each in columns], *zip(*(each.texts for each in columns), strict=True)]
    head, *body = (f"| {' | '.join(map(escape_markdown, line))} |" for line in lines)
    return "\n".join([head, f"|{'|'.join('---:' if each.right else '---' for each in columns)}|", *body])
