"""Files, functions and rooms stay small enough to be read; what is longer is named here with its reason."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_ROOM_LINES = 400, 80, 2000

LONG_FILES: dict[str, str] = {}
"""Files of more than 400 lines, at most six."""

LONG_FUNCTIONS: dict[str, str] = {
    "terrain/estimation/ekf/kernel.py:run": "one loop: cut into functions a step takes 80 % longer",
    "terrain/simulation/dynamic/step.py:advance": "one loop: cut into functions it takes twice as long",
    "terrain/simulation/planar/swerve.py:move_swerve": "one pass that shares a dozen local numbers",
}
"""Functions of more than 80 lines, at most five."""


def sources(*packages: str) -> list[Path]:
    return [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


def n_lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def test_files_are_short():
    lengths = {
        str(path.relative_to(ROOT)): n_lines(path) for path in sources("terrain", "features", "pipelines")
    }
    long = {name for name, length in lengths.items() if length > MAX_FILE_LINES}
    assert long == set(LONG_FILES), {name: lengths[name] for name in long ^ set(LONG_FILES)}
    assert len(LONG_FILES) <= 6
    assert all(LONG_FILES.values())


def test_functions_are_short():
    long = {}
    for path in sources("terrain", "features", "pipelines"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno + 1 > MAX_FUNCTION_LINES:
                long[f"{path.relative_to(ROOT)}:{node.name}"] = node.end_lineno - node.lineno + 1
    assert set(long) == set(LONG_FUNCTIONS), long
    assert len(LONG_FUNCTIONS) <= 5
    assert all(LONG_FUNCTIONS.values())


def test_rooms_of_pipelines_are_small():
    """The folder of a paper in the room ``reproduce`` is counted by itself."""
    rooms = {
        str(room.relative_to(ROOT)): sum(n_lines(path) for path in room.glob("*.py"))
        for room in (ROOT / "pipelines").rglob("*")
        if room.is_dir() and room.name != "__pycache__"
    }
    assert {name: length for name, length in rooms.items() if length > MAX_ROOM_LINES} == {}
