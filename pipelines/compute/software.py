"""What results depend on beside the data: the code of this package and the libraries below it."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

LIBRARIES = ("numpy", "scipy", "scikit-learn", "numba", "pyarrow")
PACKAGES = ("terrain", "features", "pipelines")


def software() -> dict[str, str]:
    """Return the versions that the bytes of a result depend on, by name, and a digest of this package's code.

    Examples
    --------
    >>> list(software())[:3]
    ['terrain-slip', 'its code', 'python']
    """
    return {
        "terrain-slip": import_module("terrain").__version__,
        "its code": code_digest(),
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }


@cache
def code_digest() -> str:
    """Return the start of a SHA-256 over all source files of this package."""
    digest = hashlib.sha256()
    for name in PACKAGES:
        folder = Path(str(import_module(name).__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{name}/{path.relative_to(folder).as_posix()}".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def difference(here: dict[str, str], there: dict[str, str]) -> str | None:
    """Return in words what differs first between two of them, None where nothing does.

    Examples
    --------
    >>> difference({"numpy": "2.3"}, {"numpy": "2.1"})
    'numpy 2.1 where 2.3 is needed'
    """
    for name, needed in here.items():
        if there.get(name) != needed:
            return f"{name} {there.get(name, 'missing')} where {needed} is needed"
    return None
