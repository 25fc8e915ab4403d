"""The papers that can be reproduced, and which numbers of their simulation are assumed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pipelines.reproduce.results import AssumedNumber, Paper
from terrain.files.documents import read_yaml
from terrain.files.resources import data_folder

PAPERS: Mapping[str, Paper] = {
    "danzi": Paper(
        title="Danzi, AgriMaRo thesis",
        about=(
            "D. Danzi, Development of a terrain-aware omnidirectional robotic platform for enhanced mobility "
            "in agricultural fields, Politecnico di Torino, 2025-2026"
        ),
        module="pipelines.reproduce.danzi.experiments",
        descriptions=(
            ("robots", "agrimaro"),
            ("soils", "tiles"),
            ("soils", "grass"),
            ("soils", "firm_soil_gravel"),
        ),
    ),
    "tazzari": Paper(
        title="Tazzari et al., adaptive slip observer",
        about=(
            "R. Tazzari, I. A. Azzollini and L. Marconi, An adaptive observer approach to slip estimation "
            "for agricultural tracked vehicles, University of Bologna"
        ),
        module="pipelines.reproduce.tazzari.experiments",
        descriptions=(("robots", "orchard_ugv"), ("soils", "grass"), ("soils", "dry_sand")),
    ),
    "yamauchi": Paper(
        title="Yamauchi et al., slip-compensated odometry",
        about=(
            "G. Yamauchi, K. Nagatani, T. Hashimoto and K. Fujino, Slip-compensated odometry for tracked "
            "vehicle on loose and weak slope, ROBOMECH Journal, 2017"
        ),
        module="pipelines.reproduce.yamauchi.experiments",
        descriptions=(("robots", "patako"), ("soils", "extra/toyoura_sand"), ("soils", "firm_soil_gravel")),
    ),
    "deremetz": Paper(
        title="Deremetz et al., ICRA 2017",
        about=(
            "M. Deremetz, R. Lenain, B. Thuilot, V. Rousseau, Adaptive trajectory control of off-road mobile "
            "robots: A multi-model observer approach, ICRA 2017, 10.1109/ICRA.2017.7989509"
        ),
        module="pipelines.reproduce.deremetz.experiments",
        descriptions=(("robots", "adap2e"),),
    ),
}
"""Papers by the name that the command takes."""


def assumed_numbers(descriptions: Iterable[tuple[str, str]]) -> tuple[AssumedNumber, ...]:
    """Return every number of the descriptions that was assumed or fitted, by its own source.

    Examples
    --------
    >>> assumed_numbers([("soils", "asphalt")])[-1].file
    'soils/asphalt.yaml'
    """
    return tuple(
        AssumedNumber(f"{kind}/{name}.yaml", key, entry["value"], entry["unit"], str(entry["source"]))
        for kind, name in descriptions
        for key, entry in _entries(read_yaml(data_folder(kind) / f"{name}.yaml"))
        if "value" in entry
        and any(mark in str(entry.get("source", "")) for mark in ("assumed", "identified"))
    )


def _entries(described: Any, place: str = "") -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield, by their dotted names, the mappings of a description that hold no further ones with a value."""
    for key, value in described.items():
        if isinstance(value, dict) and "value" in value:
            yield f"{place}{key}", value
        elif isinstance(value, dict):
            yield from _entries(value, f"{place}{key}.")
