"""Reports as files, by the ending of their name, whole or not at all."""

from __future__ import annotations

from pathlib import Path

from pipelines.report.tree import Report
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write

ENDINGS = (".html", ".md")


def check_ending(path: Path, endings: tuple[str, ...] = ENDINGS, option: str = "--report") -> Path:
    """Return a path whose ending is one of those that can be written.

    Raises
    ------
    ConfigError
        if it is another one, or the path is a folder.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; {option} names a file")
    if path.suffix.lower() not in endings:
        raise ConfigError(
            f"{option} is {str(path)!r}; a name that ends in {' or '.join(endings)} is required"
        )
    return path


def save_report(report: Report, path: Path) -> Path:
    """Write a report as a page (``.html``) or as Markdown (``.md``) and return the path.

    Raises
    ------
    ConfigError
        if the path has another ending.
    """
    check_ending(path)
    if path.suffix.lower() == ".md":
        from pipelines.report.markdown import markdown_text

        atomic_write(path, markdown_text(report))
    else:
        from pipelines.report.html import html_page

        atomic_write(path, html_page(report))
    return path
