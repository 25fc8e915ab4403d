"""Terrain classification and slip learning for off-road robots: run logs in, terrain, slip and wheel commands out.

The names below are imported when they are first asked for; ``import terrain`` itself loads nothing heavy.

>>> import terrain
>>> terrain.load_robot("husky").name
'husky'
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from terrain.kernel_caches import discard_stale

__version__ = "0.1.0"

FACE = {
    "load_runs": "pipelines.api.runs",
    "Runs": "pipelines.api.runs",
    "load_robot": "terrain.robots",
    "simulate": "pipelines.api.runs",
    "estimate": "pipelines.api.runs",
    "learn_slip": "pipelines.api.runs",
    "cut_windows": "pipelines.api.learn",
    "TerrainClassifier": "pipelines.learn.classifier",
    "cross_validate": "pipelines.api.learn",
    "explain": "pipelines.api.runs",
    "Observer": "pipelines.live.observer",
    "replay": "terrain.logs.replay",
}
"""The names that ``import terrain`` offers, and the modules that have them."""

__all__ = ["__version__", *FACE]


def __getattr__(name: str) -> Any:
    """Import a name of the face."""
    if name not in FACE:
        raise AttributeError(f"module 'terrain' has no attribute {name!r}; it has {', '.join(FACE)}")
    refuse_hidden_packages()
    return getattr(import_module(FACE[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *FACE})


def refuse_hidden_packages() -> None:
    """Refuse to go on where a folder of the user's has the name of a package of this one and comes before it.

    Raises
    ------
    ImportError
        that names the folder.
    """
    here = Path(__file__).resolve().parents[1]
    for name in ("features", "pipelines"):
        found = find_spec(name)
        place = None if found is None or found.origin is None else Path(found.origin).resolve()
        if place is None or place.parents[1] != here:
            where = "it is missing" if place is None else f"{place.parent} comes before it"
            raise ImportError(
                f"the package {name!r} of terrain cannot be imported: {where}; rename that folder or run elsewhere"
            )


discard_stale(Path(__file__).parent)
