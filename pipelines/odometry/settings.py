"""Settings of ``terrain odometry``."""

from __future__ import annotations

from pathlib import Path

from pipelines.report.settings import Settings, setting


class OdometrySettings(Settings):
    """Which robot, how runs are dealt, how long legs are, and what is written."""

    robot: str = setting(..., "Tracked robot by name, or its YAML file.")
    out: Path | None = setting(None, "New YAML file with the slip model that is fitted to all runs.")
    lengths: tuple[float, ...] = setting(
        (2.0, 6.0), "Seconds after which poses are compared, by commas; windows of DRIVE have their own.",
        separated=True,
    )  # fmt: skip
    folds: int = setting(5, "Folds of whole runs.", ge=2)
    seed: int = setting(0, "Seed of the folds and of the bootstrap over runs.", ge=0)
