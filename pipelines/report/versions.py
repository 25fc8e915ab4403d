"""Versions of Python and of the packages that decide what numbers come out."""

from __future__ import annotations

from importlib import metadata
from platform import python_version

PACKAGES = (
    *("terrain-slip", "numpy", "scipy", "scikit-learn", "numba", "pandas", "pyarrow", "mlflow", "matplotlib"),
)


def versions() -> str:
    """Return the installed versions as a report states them; a package that is missing is left out."""
    found = [f"python {python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)
