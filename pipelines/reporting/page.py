"""The frame of a report: one self-contained HTML page, with no network, no script and no font of its own."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path

STYLE_FILE = Path(__file__).with_name("templates") / "report.css"


def page(kind: str, heading: str, title: str, lead: str, sections: Iterable[str]) -> str:
    """Return a page.

    Parameters
    ----------
    kind : what page it is, above the heading
    heading, title : plain text, on the page and in the browser's bar
    lead : HTML, a line below the heading
    sections : HTML; empty ones are left out
    """
    body = "\n".join(section for section in sections if section)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE_FILE.read_text(encoding="utf-8")}</style>
</head>
<body>
<main>
<header><p class="kind">{escape(kind)}</p>
<h1>{escape(heading)}</h1>
<p class="lead">{lead}</p></header>
{body}
</main>
</body>
</html>
"""
