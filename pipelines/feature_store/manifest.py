"""What all files of a store have in common, and the list of its runs: two JSON files.

``store.json`` is written before the first run, ``runs.json`` after the last:
a store without it is unfinished.  ``runs.json`` lists the stretches that two runs share as well.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from features.windows import Layout, SteadyMotion, WindowRule
from terrain import __version__
from terrain.errors import ConfigError, LogError
from terrain.files.documents import read_json
from terrain.files.names import shown
from terrain.logs.duplicates import SharedStretch

FORMAT_VERSION = 2
"""1: without the motion of each window and the stretches that runs share."""

STORE_FILE, RUNS_FILE, WINDOWS_FOLDER = "store.json", "runs.json", "windows"


@dataclass(frozen=True, slots=True, eq=False)
class Manifest:
    """How the features of a store were made.

    Parameters
    ----------
    rule : by which windows were cut
    signal_sets : whose channels the features use
    layout : channels and rates that all runs have
    features : name of each column, with its unit
    package_version : of the code that made them
    """

    rule: WindowRule
    signal_sets: tuple[str, ...]
    layout: Layout
    features: tuple[str, ...]
    package_version: str = __version__

    def as_json(self) -> dict[str, Any]:
        """Return what ``store.json`` holds."""
        return {
            "format_version": FORMAT_VERSION,
            "package_version": self.package_version,
            "rule": asdict(self.rule),
            "signal_sets": list(self.signal_sets),
            "channels": {name: list(channels) for name, channels in self.layout.channels.items()},
            "rate_hz": dict(self.layout.rate_hz),
            "features": list(self.features),
        }

    @property
    def identity(self) -> str:
        """SHA-256 of all of it: files of a store bear that of theirs."""
        return hashlib.sha256(json.dumps(self.as_json(), sort_keys=True).encode()).hexdigest()

    def check(self, rule: WindowRule, signal_sets: tuple[str, ...], place: Path) -> None:
        """Raise ``ConfigError`` where windows are asked for that the store does not hold."""
        for name, stored, asked in (
            ("--window", self.rule.length_s, rule.length_s),
            ("--stride", self.rule.step_s, rule.step_s),
            ("steady motion", self.rule.steady is not None, rule.steady is not None),
            ("--signals", ",".join(self.signal_sets), ",".join(signal_sets)),
        ):
            if stored != asked:
                raise ConfigError(f"{place}: holds features with {name} {stored}, {asked} is asked for")
        if self.rule != rule:
            raise ConfigError(f"{place}: its windows were cut by another rule of gaps or steady motion")


class StoredRun(NamedTuple):
    """A run of a store.

    Parameters
    ----------
    run_id, robot, filter : of the run
    digest : of its content, as :func:`pipelines.data.datasets.data_digest`
    n_windows : rows of its file
    dropped, repaired : windows left out, and what a repairing reader dropped, as counts
    """

    run_id: str
    robot: str
    filter: str
    digest: str
    n_windows: int
    dropped: Mapping[str, int]
    repaired: Mapping[str, int]


def read_manifest(folder: Path) -> Manifest:
    """Return what ``store.json`` holds.

    Raises
    ------
    LogError
        if it is missing or damaged.
    ConfigError
        if another version of the package made the store.
    """
    place = folder / STORE_FILE
    if not place.is_file():
        raise LogError(f"{folder}: is no store of features ({STORE_FILE} is missing)")
    document = read_json(place, str(place), LogError)
    try:
        made_as, made_by = document["format_version"], document["package_version"]
        if made_as != FORMAT_VERSION:
            raise ConfigError(
                f"{folder}: is a store of features of format {shown(made_as)}, format {FORMAT_VERSION} is "
                "read here: build it again with terrain features"
            )
        if made_by != __version__:
            raise ConfigError(
                f"{folder}: version {shown(made_by)} made this store of features, this is {__version__}: "
                "build it again with terrain features"
            )
        rule = dict(document["rule"])
        steady = None if rule["steady"] is None else SteadyMotion(**rule["steady"])
        return Manifest(
            WindowRule(**{**rule, "steady": steady}),
            tuple(document["signal_sets"]),
            Layout(
                {name: tuple(channels) for name, channels in document["channels"].items()},
                {name: float(rate) for name, rate in document["rate_hz"].items()},
            ),
            tuple(document["features"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise LogError(f"{place}: is damaged ({type(error).__name__}: {error})") from error


class StoredRuns(NamedTuple):
    """The runs of a finished store, sorted by their id, and the stretches that two of them share."""

    runs: tuple[StoredRun, ...]
    shared: tuple[SharedStretch, ...]


def read_runs(folder: Path) -> StoredRuns:
    """Return what ``runs.json`` holds.

    Raises
    ------
    LogError
        if the store is unfinished, or the list is damaged.
    """
    place = folder / RUNS_FILE
    if not place.is_file():
        raise LogError(
            f"{folder}: is an unfinished store of features: run terrain features again, it goes on"
        )
    document = read_json(place, str(place), LogError)
    try:
        return StoredRuns(
            tuple(StoredRun(**entry) for entry in document["runs"]),
            tuple(SharedStretch(**entry) for entry in document["shared"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise LogError(f"{place}: is damaged ({type(error).__name__}: {error})") from error
