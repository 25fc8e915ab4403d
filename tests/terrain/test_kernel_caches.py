"""A library that changed under numba's caches runs no old compiled code."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import terrain
from terrain.kernel_caches import STAMP_FILE, discard_stale

CALLER = """from numba import njit
from kern.callee import FACTOR, scaled


@njit(cache=True)
def answer(x):
    return scaled(x) + FACTOR
"""
CALLEE = """from numba import njit

FACTOR = {factor}


@njit(cache=True)
def scaled(x):
    return {scale} * x
"""
OTHER = "from numba import njit\n\n\n@njit(cache=True)\ndef other(x):\n    return -x\n"
CALL = "from kern.caller import answer; from kern.other import other; other(1.0); print(answer(1.0))"
GUARD = (
    "from pathlib import Path; from terrain.kernel_caches import discard_stale; discard_stale(Path('kern')); "
)


def write_callee(package, scale, factor=0.0):
    (package / "callee.py").write_text(CALLEE.format(scale=scale, factor=factor))


@pytest.fixture
def package(tmp_path):
    package = tmp_path / "kern"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "caller.py").write_text(CALLER)
    (package / "other.py").write_text(OTHER)
    write_callee(package, 2.0)
    return package


def answer(package, guarded=True):
    path = os.pathsep.join([str(package.parent), str(Path(terrain.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": path}
    code = (GUARD if guarded else "") + CALL
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=package.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)


@pytest.mark.slow
def test_a_change_of_what_a_kernel_takes_from_another_file_changes_its_answer(package):
    assert answer(package) == 2.0
    write_callee(package, 3.0)
    assert answer(package, guarded=False) == 2.0  # the fault that is guarded against
    assert answer(package) == 3.0
    write_callee(package, 3.0, factor=10.0)
    assert answer(package) == 13.0
    assert answer(package, guarded=False) == 13.0


def test_only_kernels_that_a_change_reaches_are_removed(package):
    discard_stale(package)
    cached = {
        name: package / "__pycache__" / f"{name}.f-5.py311.nbi" for name in ("caller", "callee", "other")
    }
    for file in cached.values():
        file.touch()
    assert discard_stale(package) == []
    assert all(file.exists() for file in cached.values())
    write_callee(package, 5.0)
    assert {path.stem for path in discard_stale(package)} == {"caller", "callee"}
    assert [name for name, file in cached.items() if file.exists()] == ["other"]
    assert discard_stale(package) == []
    (package / "__pycache__" / STAMP_FILE).write_bytes(b"\xff broken")
    assert {path.stem for path in discard_stale(package)} == {"caller", "callee", "other"}


def test_an_installation_that_cannot_be_written_is_left_as_it_is(package, monkeypatch):
    monkeypatch.setattr("terrain.kernel_caches.os.access", lambda *_: False)
    assert discard_stale(package) == []
    assert not (package / "__pycache__" / STAMP_FILE).exists()


def test_an_unchanged_package_costs_no_time_to_check():
    package = Path(terrain.__file__).parent
    discard_stale(package)
    times_s = []
    for _ in range(7):
        start_s = time.perf_counter()
        assert discard_stale(package) == []
        times_s.append(time.perf_counter() - start_s)
    assert min(times_s) < 0.005


def test_a_new_effect_reaches_the_kernels_that_have_the_places_of_parameters(tmp_path):
    copy = tmp_path / "terrain"
    shutil.copytree(Path(terrain.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    discard_stale(copy)
    file = copy / "effects.py"
    file.write_text(file.read_text() + "\nANOTHER = 1\n")
    stale = {path.relative_to(copy).as_posix() for path in discard_stale(copy)}
    assert "simulation/planar/model.py" in stale
    assert "terramechanics/traction.py" not in stale
    assert "kernel_caches.py" not in stale
