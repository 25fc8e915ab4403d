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
