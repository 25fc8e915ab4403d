"""Faults on purpose: whether the tests notice them.

``mutants.yaml`` holds one fault an entry: its name, what it is, the file, the text that is there and the text in
its place, and the tests that have to fail with it; ``mutants_terrain.yaml`` holds those of the mechanisms of
``terrain``.  Each is put into a copy of the working tree, and the tests are run there.  Kernels that call what
was changed are compiled anew, and the others are shared (:mod:`terrain.kernels`).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import yaml

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.tree import Column, Report, Table
from terrain.errors import ConfigError

EXAMPLE = "python tests/studies mutants --only nan-as-zero"
REPOSITORY = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_suffix(".yaml")
TERRAIN_FILE = FILE.with_name("mutants_terrain.yaml")
NOT_COPIED = (".git", ".venv", ".*_cache", ".hypothesis", "mlruns")
TIMEOUT_S = 600


class Mutant(NamedTuple):
    """A fault, and what has to notice it."""

    name: str  #: of the fault
    what: str  #: the fault in a sentence, by which it is put in again where its text has moved
    file: str  #: that it is in, from the repository
    #: old, new: the text that occurs once in the file, and what replaces it
    old: str
    new: str
    tests: tuple[str, ...]  #: files or nodes of tests
    #: numerical (a sign, a factor, an index) or logical (a missing check, a status); empty where not stated
    kind: str = ""


class Settings(BaseSettings):
    """Which mutants are put into which tree."""

    only: Names = setting((), "These mutants alone, by commas.")
    file: Path = setting(FILE, "List of mutants.")
    tree: Path = setting(REPOSITORY, "Working tree that is copied.")


class Outcome(NamedTuple):
    """A mutant, whether a test failed with it; and which and why, or the last line of the tests."""

    name: str
    what: str
    kind: str
    caught: bool
    tests: str


class Mutants(Result):
    """Which mutants the tests notice."""

    mutants: tuple[Outcome, ...] = described("outcome of each")

    @property
    def refused(self) -> str:
        """What is not accepted: the mutants that survived."""
        return ", ".join(f"{each.name} survived" for each in self.mutants if not each.caught)


def read_mutants(path: Path = FILE) -> list[Mutant]:
    """Return the mutants of a file."""
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [Mutant(name, **{**entry, "tests": tuple(entry["tests"])}) for name, entry in found.items()]


def mutated(text: str, mutant: Mutant) -> str:
    """Return the text of a file with a mutant; ``ValueError`` where it has no place, or more than one."""
    n = text.count(mutant.old)
    if n != 1:
        raise ValueError(f"{mutant.name}: {mutant.file} holds its text {n} times, once is needed")
    return text.replace(mutant.old, mutant.new)


def is_caught(mutant: Mutant, tree: Path) -> tuple[bool, str]:
    """Return whether a test fails with a mutant in a tree; and which and why, or the last line of the tests."""
    file = tree / mutant.file
    text, times = file.read_text(encoding="utf-8"), file.stat()
    file.write_text(mutated(text, mutant), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--no-header", "-rfE"]
    command += ["-m", "slow or not slow", "--tb=no", "--doctest-modules", *mutant.tests]
    settings = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1") | {"COLUMNS": "240"}
    try:
        done = subprocess.run(
            command,
            cwd=tree,
            env=os.environ | settings | {"PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
    finally:
        file.write_text(text, encoding="utf-8")
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    lines = (done.stdout.strip() or done.stderr.strip()).splitlines()
    if done.returncode not in (0, 1):
        raise ValueError(f"{mutant.name}: the tests did not run: {lines[-1] if lines else done.returncode}")
    failed = (line for line in lines if line.startswith(("FAILED ", "ERROR ")))
    return done.returncode == 1, next(failed, lines[-1] if lines else "")


def run(settings: Settings, progress: Progress = silent) -> Mutants:
    """Put in each mutant and run its tests."""
    mutants = read_mutants(settings.file)
    unknown = sorted(set(settings.only) - {each.name for each in mutants})
    if unknown:
        raise ConfigError(f"--only: there is no mutant {unknown[0]!r}")
    chosen = [each for each in mutants if not settings.only or each.name in settings.only]
    found: list[Outcome] = []
    for mutant in chosen:
        progress("mutants", len(found), len(chosen))
        with tempfile.TemporaryDirectory() as place:  # a tree each: kernels compiled with one are of no other
            tree = Path(place) / "tree"
            shutil.copytree(settings.tree, tree, ignore=shutil.ignore_patterns(*NOT_COPIED))
            try:
                caught, tests = is_caught(mutant, tree)
            except (ValueError, OSError, subprocess.TimeoutExpired) as error:
                caught, tests = False, str(error)
        found.append(Outcome(mutant.name, mutant.what, mutant.kind, caught, tests))
    progress("mutants", len(found), len(chosen))
    return Mutants(tuple(found))


def report(result: Mutants) -> Report:
    """Return which mutants were caught, the others first."""
    n = sum(each.caught for each in result.mutants)
    rows = [
        (each.name, "caught" if each.caught else "survived", each.what, each.tests) for each in result.mutants
    ]
    rows.sort(key=lambda row: row[1] == "caught")
    return Report(
        "Mutants",
        f"{n} of {len(rows)} mutants are caught.",
        parts=(Table(("mutant", "", Column("fault", long=True), Column("tests", long=True)), tuple(rows)),),
    )
