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

__version__ = "0.1.0"

#: The names that ``import terrain`` offers, and what they are.
FACE = {
    "load_runs": "pipelines.data.datasets.load_runs",
    "Runs": "pipelines.data.runs.Runs",
    "load_robot": "terrain.robots.load_robot",
    "simulate": "terrain.simulation.run.simulate_run",
    "estimate": "pipelines.slip.estimate.estimate_runs",
    "estimate_run": "terrain.estimation.estimate.estimate_run",
    "learn_slip": "pipelines.slip.learn_slip.learn_slip_table",
    "cut_windows": "features.windows.windows_of",
    "TerrainClassifier": "pipelines.learn.classifier.TerrainClassifier",
    "cross_validate": "pipelines.learn.crossval.cross_validate",
    "explain": "pipelines.explain.explain.explain",
    "Observer": "pipelines.live.observer.Observer",
    "replay": "terrain.logs.replay.replay",
}
__all__ = ["__version__", *FACE]


def __getattr__(name: str) -> Any:
    """Import a name of the face."""
    if name not in FACE:
        raise AttributeError(f"module 'terrain' has no attribute {name!r}; it has {', '.join(FACE)}")
    refuse_hidden_packages()
    module, _, found = FACE[name].rpartition(".")
    return getattr(import_module(module), found)


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
