"""Pages that are made from the code are those of today: the graph of imports, and the commands."""

from __future__ import annotations

import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_shows_the_imports_of_today():
    spec = importlib.util.spec_from_file_location("import_graph", ROOT / "docs" / "import_graph.py")
    drawing = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawing)
    page = drawing.PAGE.read_text(encoding="utf-8")
    assert drawing.with_graphs(page) == page, "run: python docs/import_graph.py"
    assert page.count("-->") > 40


def test_the_page_of_commands_is_made_from_them():
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    page = reference.PAGE.read_text(encoding="utf-8")
    assert reference.commands_page() == page, "run: python docs/reference.py"
    assert page.count("### terrain ") == 14
