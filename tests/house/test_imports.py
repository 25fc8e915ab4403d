"""Imports follow the arrows: contracts between rooms, and no circle between files."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("terrain", "features", "pipelines")


def test_imports_follow_the_contracts():
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()", "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    kept = re.search(r"Contracts: (\d+) kept, 0 broken", done.stdout)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert kept, done.stdout
    assert int(kept[1]) == len(contracts)


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of files that import each other, directly or through others."""
    names = sorted(edges)
    place = {name: i for i, name in enumerate(names)}
    pairs = np.array([(place[a], place[b]) for a in names for b in edges[a]]).reshape(-1, 2)
    graph = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(names),) * 2)
    _, group = connected_components(graph, directed=True, connection="strong")
    members = [[names[i] for i in np.flatnonzero(group == k)] for k in range(group.max() + 1)]
    return [each for each in members if len(each) > 1]


def test_no_two_files_import_each_other_in_a_circle():
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    edges = {name: set(graph.find_modules_directly_imported_by(name)) for name in graph.modules}
    assert len(edges) > 150
    assert circles(edges) == []


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_no_file_lies_directly_in_pipelines():
    files = [path.name for path in (ROOT / "pipelines").iterdir() if path.is_file()]
    assert sorted(files) == ["__init__.py", "py.typed"]


def loaded_with(module: str, loaded: set[str]) -> None:
    """Add the modules of the project that importing one loads, by the imports that no function holds."""
    path = ROOT / (module.replace(".", "/") + ".py")
    path = path if path.is_file() else path.with_suffix("") / "__init__.py"
    if module in loaded or not path.is_file() or module.partition(".")[0] not in PACKAGES:
        return
    loaded.add(module)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                loaded_with(str(name), loaded)


def test_training_compiles_no_live_estimator():
    """Its kernels take a minute where none is compiled; quickstart has another process compile them meanwhile."""
    loaded: set[str] = set()
    for name in ("card", "predict", "train", "training_data"):
        loaded_with(f"pipelines.learn.{name}", loaded)
    assert "terrain.records" in loaded
    assert not [name for name in loaded if "estimation.live" in name]
