"""The tables of measured figures, from docs/measured/*.json: docs/measured.md, those of other pages, and README's.

Each file holds a table: a title, texts before and after, and one record a row with what was measured, by
which command, when, and at which commit.  A record with ``readme`` is a row of README too, under those words
(and with ``readme_command`` where its command refers to another row); the table there stands between
``<!-- measured -->`` and ``<!-- end of measured -->``.  A table with ``page`` stands in that page of docs, after
``<!-- measured: TITLE -->``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Report, Table
from terrain.errors import DataError
from terrain.files.atomic import atomic_write

EXAMPLE = "python tests/studies figures"
ROOT = Path(__file__).resolve().parents[2]
END = "<!-- end of measured -->"
KEYS = {"figure", "measured", "command", "date", "commit"}
HEAD = (
    "# Measured\n\nMade by `python tests/studies figures` from the records in docs/measured; do not edit. The date "
    "is that of the measurement. In brackets are 95 % intervals unless stated.\n"
)


class Settings(BaseSettings):
    """Where the records are, and the repository whose pages are written."""

    records: Path = setting(ROOT / "docs" / "measured", "Folder of the records.")
    root: Path = setting(ROOT, "Folder with docs/ and README.md.")


class Figures(Result):
    """What was written."""

    files: tuple[Path, ...] = described("pages that were written")
    tables: Mapping[str, int] = described("number of records by table")


def read_tables(folder: Path) -> list[dict[str, Any]]:
    """Return the tables in order of their files."""
    tables = []
    for file in sorted(folder.glob("*.json")):
        table = json.loads(file.read_text(encoding="utf-8"))
        for record in table["records"]:
            missing = KEYS - set(record) or set(table["columns"]) - set(record.get("measured", ()))
            if missing:
                raise DataError(
                    f"{file}: record {record.get('figure')!r} has no {', '.join(sorted(missing))}"
                )
        tables.append(table)
    return tables


def page_text(tables: Sequence[Mapping[str, Any]]) -> str:
    """Return docs/measured.md."""
    return HEAD + "".join(
        "\n" + "\n\n".join([f"## {table['title']}", *table["before"], _table(table), *table["after"]]) + "\n"
        for table in tables
        if "page" not in table
    )


def _table(table: Mapping[str, Any]) -> str:
    beside = [*(["command"] if table["shows_command"] else []), *([] if "page" in table else ["date"])]
    rows = [
        [record["figure"], *(record["measured"][name] for name in table["columns"])]
        + [record[name] for name in beside]
        for record in table["records"]
    ]
    return _markdown([table["heading"], *table["columns"], *beside], rows)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def readme_table(tables: Sequence[Mapping[str, Any]]) -> str:
    """Return the short table of README: the records that have words for it."""
    rows = []
    for table in tables:
        for record in table["records"]:
            if "readme" in record:
                values = [
                    value if len(table["columns"]) == 1 else f"{name} {value}"
                    for name, value in record["measured"].items()
                    if value
                ]
                rows.append(
                    [record["readme"], "; ".join(values), record.get("readme_command", record["command"])]
                )
    return _markdown(["figure", "measured", "command"], rows)


def with_table(page: str, table: str, title: str = "") -> str:
    """Return a page with a table between its marks."""
    mark = f"<!-- measured: {title} -->" if title else "<!-- measured -->"
    before, begin, rest = page.partition(mark)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise DataError(f"a page lacks {mark} with {END} after it")
    return f"{before}{begin}\n{table}\n{end}{after}"


def pages(settings: Settings, tables: Sequence[Mapping[str, Any]]) -> dict[Path, str]:
    """Return every page with tables of measured figures, as it has to be."""
    docs, readme = settings.root / "docs", settings.root / "README.md"
    texts = {
        docs / "measured.md": page_text(tables),
        readme: with_table(readme.read_text(encoding="utf-8"), readme_table(tables)),
    }
    for table in tables:
        if "page" in table:
            page = docs / table["page"]
            text = texts.get(page) or page.read_text(encoding="utf-8")
            texts[page] = with_table(text, _table(table), table["title"])
    return texts


def run(settings: Settings, progress: Progress = silent) -> Figures:
    """Write docs/measured.md, and the tables of the other pages and of README."""
    tables = read_tables(settings.records)
    texts = pages(settings, tables)
    for page, text in texts.items():
        atomic_write(page, text)
    return Figures(tuple(texts), {table["title"]: len(table["records"]) for table in tables})


def report(result: Figures) -> Report:
    """Return how many records each table has."""
    n = sum(result.tables.values())
    return Report(
        "Measured figures",
        f"{n} records make {len(result.tables)} tables in {', '.join(file.name for file in result.files)}.",
        parts=(Table(("table", "records"), tuple(result.tables.items())),),
    )
