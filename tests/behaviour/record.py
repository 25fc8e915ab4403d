"""Runs the cases and keeps what came out.

To keep the results of one state of the code, all or of some cases, from the folder ``tests``::

    python -m behaviour.record
    python -m behaviour.record --out other --only slip,drive

(The name ``tests`` is taken: a package that the benchmarks need installs one of that name.)

The commands are called in this process: to start one anew takes longer than most of them.  A result holds, for
each step, exit code and JSON; of each stream of each run folder, a few statistics of each channel; of each HTML page,
its outline; of each YAML and JSON file, all of it; of MLflow, parameters and metrics; of a picture, that it is there.
"""

from __future__ import annotations

import argparse
import gzip
import html
import json
import math
import os
import re
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, chdir, closing, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from pipelines.cli import main as cli

from .commands import CASES, Case

EXPECTED = Path(__file__).with_name("expected")

LONG = 40  #: So many numbers in a list are kept as statistics
BIG_BYTES = 100_000  #: A bigger result is kept compressed
PARTS = ("section", "h2", "h3", "table", "svg", "img", "figure")  #: Elements of a page that are counted

ALIASES_QUERY = "select name, alias, version from registered_model_aliases order by name"


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Return the result of a case that is run in an empty folder."""
    given = case.make()
    for name, content in given.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    with working_in(folder):
        result: dict[str, Any] = {
            "steps": {f"{i:02d}": _run_step(words, i, folder) for i, words in enumerate(case.steps)}
        }
        if case.helps:
            result["help"] = {name or "terrain": _helped(name) for name in case.helps}
    tracking = folder / "mlruns" / "mlflow.db"
    if tracking.exists():
        result["tracking"] = tracked(tracking)
    result["files"] = _tree(folder, {folder / name for name in given})
    return plain(result)


def outline(page: str) -> dict[str, Any]:
    """Return how many there are of the parts of an HTML page, and its headings."""
    counts = {part: len(re.findall(rf"<{part}\b", page)) for part in PARTS if part != "h2"}
    headings = re.findall(r"<h2\b[^>]*>(.*?)</h2>", page, flags=re.DOTALL)
    return {**counts, "h2": [html.unescape(re.sub(r"<[^>]*>", "", heading)).strip() for heading in headings]}


def statistics(values: Any) -> dict[str, Any]:
    """Return what is kept of many numbers, or of many texts."""
    if any(isinstance(value, str) for value in values):
        texts = [str(value) for value in values]
        return {"n": len(texts), "distinct": len(set(texts)), "first": texts[0], "last": texts[-1]}
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    ends = (array[0], array[-1]) if array.size else (math.nan, math.nan)
    return {
        "n": array.size,
        "nan": array.size - known.size,
        "sum": _rounded(math.fsum(known)),
        "sum_sq": _rounded(math.fsum(known * known)),
        "first": _rounded(ends[0]),
        "last": _rounded(ends[1]),
    }


def plain(value: Any) -> Any:
    """Return what JSON can hold, with long lists of numbers as statistics."""
    if isinstance(value, dict):
        return {str(key): plain(child) for key, child in value.items()}
    if isinstance(value, list | tuple):
        numbers = all(isinstance(child, int | float) and not isinstance(child, bool) for child in value)
        return statistics(value) if numbers and len(value) > LONG else [plain(child) for child in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def tracked(database: Path) -> dict[str, Any]:
    """Return what MLflow has of each run, in the order in which they began, and where aliases point."""
    with closing(sqlite3.connect(database)) as store:
        runs = store.execute("select run_uuid, name, status from runs order by start_time").fetchall()

        def table(name: str, run: str) -> dict[str, Any]:
            found = store.execute(f"select key, value from {name} where run_uuid = ?", (run,))
            return {key: _number(value) for key, value in found if not key.startswith("mlflow.")}

        return {
            "runs": [
                {
                    "name": name,
                    "status": status,
                    "params": table("params", run),
                    "metrics": table("metrics", run),
                    "tags": table("tags", run),
                    "artifacts": sorted(
                        path.relative_to(artifacts).as_posix()
                        for artifacts in database.parent.glob(f"*/{run}/artifacts")
                        for path in artifacts.rglob("*")
                        if path.is_file()
                    ),
                }
                for run, name, status in runs
            ],
            "aliases": [list(row) for row in store.execute(ALIASES_QUERY)],
        }


def load_result(name: str, folder: Path = EXPECTED) -> dict[str, Any]:
    """Return a result that was kept."""
    path = folder / f"{name}.json"
    text = path.read_bytes() if path.exists() else gzip.decompress((folder / f"{name}.json.gz").read_bytes())
    return json.loads(text)


def keep_result(name: str, result: dict[str, Any], folder: Path) -> Path:
    """Write a result: compact, by sorted keys, compressed if it is big."""
    folder.mkdir(parents=True, exist_ok=True)
    content = (json.dumps(result, sort_keys=True, separators=(",", ":")) + "\n").encode()
    path, other = folder / f"{name}.json", folder / f"{name}.json.gz"
    if len(content) > BIG_BYTES:
        path, other, content = other, path, gzip.compress(content, mtime=0)
    other.unlink(missing_ok=True)
    path.write_bytes(content)
    return path


@contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Work in a folder without a tracking server and without measured data."""
    left_out = ("MLFLOW_TRACKING_URI", "TERRAIN_DATA", "COLUMNS")
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    with chdir(folder), patch.dict(os.environ, {**kept, "MPLBACKEND": "Agg"}, clear=True):
        yield


class Done(NamedTuple):
    """What a command line gave."""

    code: int
    out: str
    err: str


def _run(words: list[str]) -> Done:
    out, err, code = StringIO(), StringIO(), 0
    with ExitStack() as around:
        for context in (
            redirect_stdout(out),
            redirect_stderr(err),
            patch.object(sys, "argv", ["terrain", *words]),
        ):
            around.enter_context(context)
        try:
            cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def _run_step(words: str, i: int, folder: Path) -> dict[str, Any]:
    file, line = folder / f"step_{i:02d}.json", words.removeprefix("! ")
    code, options = (2, []) if line != words else (0, ["--json", file.name])
    done = _run([*line.split(), *options])
    result: dict[str, Any] = {"line": line, "code": done.code}
    if done.code != code:
        result["stderr"] = done.err[-2000:]
    elif code:
        result["refusal"] = {
            "lines": len(done.err.splitlines()),
            "begins_with_error": done.err.startswith("error: "),
            "silent_on_stdout": not done.out,
        }
    if file.exists():
        result["json"] = json.loads(file.read_text(encoding="utf-8"))
        file.unlink()
    return result


def _helped(name: str) -> dict[str, Any]:
    done = _run([*name.split(), "--help"])
    options = sorted(set(re.findall(r"^  (--[a-z-]+)", done.out, flags=re.MULTILINE)))
    commands = re.findall(r"^  ([a-z][a-z-]*)  +\S", "" if name else done.out, flags=re.MULTILINE)
    return {"code": done.code, "options": options, "commands": sorted(commands)}


def _tree(folder: Path, given: set[Path]) -> dict[str, Any]:
    found = {}
    for path in sorted(folder.iterdir()):
        if path in given or path.name in (
            "mlruns",
            "cache",
        ):  # names of cached files hold the state of the code
            continue
        content = _tree(path, given) if path.is_dir() else _content(path)
        if content != {}:
            found[path.name] = content
    return found


def _content(path: Path) -> Any:
    if path.suffix == ".parquet":
        return _channels(path)
    if path.suffix == ".json":
        return json.loads(path.read_text(encoding="utf-8"))
    if path.suffix in (".yaml", ".yml"):
        import yaml

        return yaml.safe_load(path.read_text(encoding="utf-8"))
    if path.suffix == ".html":
        return {"page": outline(path.read_text(encoding="utf-8"))}
    return "file" if path.stat().st_size else "empty"


def _channels(path: Path) -> dict[str, Any]:
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    columns = {name: table.column(name).combine_chunks() for name in table.column_names}
    return {
        name: statistics(
            (column.flatten() if hasattr(column, "flatten") else column).to_numpy(zero_copy_only=False)
        )
        for name, column in columns.items()
    }


def _rounded(number: float) -> float:
    return float(f"{number:.12g}")


def _number(text: Any) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def main() -> None:
    """Run cases and keep their results."""
    by_name = {case.name: case for case in CASES}
    parser = argparse.ArgumentParser(description="Run the cases and keep what came out.")
    parser.add_argument("--out", type=Path, default=EXPECTED, help="folder of the results")
    parser.add_argument("--only", default=",".join(by_name), help="cases, by commas; all by default")
    given = parser.parse_args()
    for name in given.only.split(","):
        start_s = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            result = run_case(by_name[name], Path(folder).resolve())
        path = keep_result(name, result, given.out)
        failed = [step["line"] for step in result["steps"].values() if "stderr" in step]
        print(f"{name}: {time.monotonic() - start_s:.1f} s, {path.stat().st_size} bytes", *failed, flush=True)


if __name__ == "__main__":
    main()
