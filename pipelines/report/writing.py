"""Reports as files, by the ending of their name, whole or not at all; and checks of files that are to be written."""

from __future__ import annotations

from pathlib import Path

from pipelines.report.tree import Report
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write, ensure_writable

ENDINGS = (".html", ".md")


def check_file(path: Path, option: str, endings: tuple[str, ...] = ()) -> None:
    """Refuse a file that cannot be written before the work is done, not after.

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


def save_report(report: Report, path: Path) -> Path:
    """Write a report as a page (``.html``) or as Markdown (``.md``) and return the path.

    Raises
    ------
    ConfigError
        if the path has another ending, or cannot be written.
    """
    check_file(path, "--report", ENDINGS)
    if path.suffix.lower() == ".md":
        from pipelines.report.markdown import markdown_text

        atomic_write(path, markdown_text(report))
    else:
        from pipelines.report.html import html_page

        atomic_write(path, html_page(report))
    return path
