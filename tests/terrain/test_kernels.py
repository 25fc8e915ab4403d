"""A compiled function is found again by its content, and only by it."""

import os
import subprocess
import sys
from collections import namedtuple
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest

import terrain
from terrain.kernels import content_digest, inner, njit, record

CALLER = """from terrain.kernels import njit
from kern.callee import FACTOR, scaled


@njit
def answer(x):
    return scaled(x) + FACTOR
"""
CALLEE = """from terrain.kernels import njit

FACTOR = {factor}


@njit
def scaled(x):
    "{words}"
    return {scale} * x
"""
CALL = "from kern.caller import answer; print(answer(1.0), sum(answer.stats.cache_hits.values()))"


@pytest.fixture
def package(tmp_path):
    package = tmp_path / "kern"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "caller.py").write_text(CALLER)
    return package


def answer(package, cache, scale=2.0, factor=0.0, words=""):
    (package / "callee.py").write_text(CALLEE.format(scale=scale, factor=factor, words=words))
    path = os.pathsep.join([str(package.parent), str(Path(terrain.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-B", "-c", CALL]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    value, hits = done.stdout.split()
    return float(value), int(hits)


@pytest.mark.slow
def test_a_change_of_what_a_kernel_takes_from_another_file_changes_its_answer(package, tmp_path):
    """A cache that cannot be made costs compilation and nothing else."""
    cache = tmp_path / "cache"
    assert answer(package, cache) == (2.0, 0)
    assert answer(package, cache) == (2.0, 1)
    assert answer(package, cache, scale=3.0) == (3.0, 0)
    assert answer(package, cache, factor=10.0) == (12.0, 0)
    copy = tmp_path / "elsewhere"  # the same content, elsewhere: a docstring is none
    copy.mkdir()
    package.rename(copy / "kern")
    assert answer(copy / "kern", cache, words="of another docstring") == (2.0, 1)
    (tmp_path / "file").write_text("a file, where a folder should be")
    assert answer(copy / "kern", tmp_path / "file") == (2.0, 0)


class Colour(IntEnum):
    RED = 1


def settings(gain):
    """Return a class of settings with a default, under one name."""
    return namedtuple("Settings", "gain", defaults=[gain], module=__name__)


GLOBALS = {
    "number": 1.0,
    "array": np.zeros(3),
    "kind": record({"x": float}),
    "colour": Colour,
    "words": ("a", 1),
    "named": settings(1.0),
}
CHANGED = {
    "number": -1.0,
    "array": np.ones(3),
    "kind": record({"x": int}),
    "colour": IntEnum("Colour", {"RED": 2}, module=__name__),
    "words": ("a", 2),
    "named": settings(2.0),
}


def reading(names):
    scope = dict(GLOBALS, **names)
    exec("def read():\n    return number, array, kind, colour, words, named", scope)
    function = scope["read"]
    function.__module__ = __name__
    return function


@pytest.mark.parametrize("name", GLOBALS)
def test_each_global_that_a_function_reads_is_content(name):
    assert content_digest(reading({})) == content_digest(reading({name: GLOBALS[name]}))
    assert content_digest(reading({})) != content_digest(reading({name: CHANGED[name]}))
    assert content_digest(reading({})) != content_digest(reading({}), {"nogil": True})
    with pytest.raises(TypeError, match=r"reads .* a object, by which a compiled function cannot be cached"):
        content_digest(reading({name: object()}))


def test_what_a_called_function_reads_is_content():
    def caller(inner):
        def outer():
            return inner()

        return outer

    first, second = (njit(caller(njit(reading({"number": value})))) for value in (1.0, 2.0))
    assert content_digest(first.py_func) != content_digest(second.py_func)


@inner
def halved(x):
    return 0.5 * x


@njit
def quartered(x):
    return halved(halved(x))


def test_a_kernel_for_kernels_refuses_to_be_called_from_python():
    for _ in range(2):
        with pytest.raises(TypeError, match="halved is called by compiled functions only"):
            halved(1.0)
        assert quartered(1.0) == 0.25
    assert halved.py_func(1.0) == 0.5
