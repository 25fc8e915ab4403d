"""Versions of Python, of packages and of this one's code: what decides which numbers come out."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from platform import python_version

COMPUTING = ("terrain-slip", "numpy", "scipy", "scikit-learn", "numba", "pyarrow")
"""Packages that the bytes of a result depend on."""

CODE = ("terrain", "features", "pipelines")


def installed(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of Python and of packages by name; a package that is missing is left out."""
    found = {"python": python_version()}
    for package in packages:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def versions() -> str:
    """Return the installed versions as a report states them."""
    stated = installed((*COMPUTING, "pandas", "mlflow", "matplotlib"))
    return ", ".join(f"{name} {number}" for name, number in stated.items())


def software() -> dict[str, str]:
    """Return the versions that the bytes of a result depend on, by name, and a digest of this package's code."""
    return {**installed(COMPUTING), "its code": code_digest()}


@cache
def code_digest() -> str:
    """Return the start of a SHA-256 over all source files of this package."""
    digest = hashlib.sha256()
    for name in CODE:
        folder = Path(str(import_module(name).__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{name}/{path.relative_to(folder).as_posix()}".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str | None:
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
