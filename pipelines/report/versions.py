"""Versions of Python and of the packages that decide what numbers come out."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from importlib import metadata
from platform import python_version

COMPUTING = ("terrain-slip", "numpy", "scipy", "scikit-learn", "numba", "pyarrow")
"""Packages that the bytes of a result depend on."""


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
