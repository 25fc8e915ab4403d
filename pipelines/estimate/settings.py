"""Settings of ``terrain estimate`` and ``terrain calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipelines.report.settings import Settings, setting

Filter = Literal[
    "encoder12",
    "slip14",
    "vio12",
    "vio15",
    "skid",
    "tracked",
    "slip-odometry",
    "slip-learning",
    "encoder-odometry",
    "gyrodometry",
    "endo",
    "sideslip-kinematic",
    "sideslip-dynamic",
    "sideslip-multi",
]
"""Filters, the numbers being those of their states, and observers of slip of tracked and car-like robots."""

Tuning = Literal["physical", "thesis", "likelihood"]
"""Sources of a filter's noise."""


class EstimateSettings(Settings):
    """Which filter, with what noise, and what is written."""

    filter: Filter = setting(..., "Which filter.")
    out: Path | None = setting(None, "Folder of new run folders with state and slip, and of pictures.")
    robot: str | None = setting(None, "Robot or its YAML file, in place of the one that a run names.")
    tuning: Tuning | None = setting(None, "Noise; the thesis' own for vio12, else physical.")
    tune_on: tuple[str, ...] | None = setting(
        None, "Runs, by commas, for the tuning 'likelihood'; the first three.", separated=True
    )
    slip_model: Path | None = setting(
        None, "Slip model of a tracked robot on its ground, for slip-odometry and endo (terrain odometry)."
    )
    figures: bool = setting(True, "Draw pictures into OUT/figures.")
    align: bool = setting(False, "Bring the wheel stream onto the IMU's clock where both see the turns.")


class CalibrateSettings(Settings):
    """From which description a calibration starts, and what is written."""

    robot: str = setting(..., "Robot by name, or its YAML file, to start from.")
    out: Path | None = setting(None, "New YAML file with the estimated parameters.")
    hard: tuple[str, ...] | None = setting(
        None,
        "Labels of hard ground, by commas; those that slip next to nothing by default.",
        separated=True,
    )
