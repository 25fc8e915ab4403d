"""Draw the rooms and who imports whom, from the contracts in ``pyproject.toml`` and the imports themselves.

    python docs/import_graph.py

writes the graphs into ``docs/architecture.md``, between its markers.  A room imports rooms below it only;
an arrow that follows from others is left out.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("terrain", "features", "pipelines")


def layers_of(package: str) -> list[list[str]]:
    """Return the rooms of a package, layer by layer from the top, as its contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (contract,) = (each for each in contracts if each.get("containers") == [package])
    return [[room.strip() for room in layer.split("|")] for layer in contract["layers"]]


def arrows_between(package: str, rooms: list[str], graph: grimp.ImportGraph) -> set[tuple[str, str]]:
    """Return the pairs of rooms of which the first imports the second, less those that follow from others."""

    def files(room: str) -> set[str]:
        return {f"{package}.{room}", *graph.find_descendants(f"{package}.{room}")}

    owner = {file: room for room in rooms for file in files(room)}
    direct = {
        room: {
            owner[target]
            for file in files(room)
            for target in graph.find_modules_directly_imported_by(file)
            if target in owner
        }
        - {room}
        for room in rooms
    }

    def reach(room: str) -> set[str]:
        return set().union(*({below} | reach(below) for below in direct[room]), set())

    return {
        (room, below)
        for room in rooms
        for below in direct[room]
        if not any(below in reach(other) for other in direct[room] - {below})
    }


def mermaid(package: str, graph: grimp.ImportGraph) -> str:
    """Return the graph of a package's rooms in the language of Mermaid, which GitHub draws."""
    layers = layers_of(package)
    lines = ["```mermaid", "flowchart TD"]
    for number, layer in enumerate(layers):
        lines += [f"    subgraph {package}_{number}[ ]", "        direction LR"]
        lines += [f"        {package}_{room}[{room}]" for room in layer]
        lines.append("    end")
    rooms = [room for layer in layers for room in layer]
    arrows = sorted(arrows_between(package, rooms, graph), key=lambda pair: (rooms.index(pair[0]), pair[1]))
    lines += [f"    {package}_{above} --> {package}_{below}" for above, below in arrows]
    return "\n".join([*lines, "```"])


def with_graphs(text: str) -> str:
    """Return the text of the page with the graphs between their markers."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    for package in ("pipelines", "terrain"):
        start, end = f"<!-- {package} -->", f"<!-- end of {package} -->"
        body = f"{start}\n{mermaid(package, graph)}\n{end}"
        text = re.sub(
            rf"{re.escape(start)}.*?{re.escape(end)}", lambda _, body=body: body, text, flags=re.DOTALL
        )
    return text


if __name__ == "__main__":
    PAGE.write_text(with_graphs(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
