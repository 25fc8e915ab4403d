"""Settings of ``terrain learn-slip``."""

from __future__ import annotations

from pathlib import Path

from pipelines.data.settings import RunsSettings
from pipelines.report.settings import setting


class LearnSlipSettings(RunsSettings):
    """Labelled runs of one robot, and what is written."""

    robot: str = setting(..., "Robot by name, or its YAML file; slip of others than swerve is measured.")
    out: Path = setting(..., "YAML file of the table of target slips.")
    figures: Path | None = setting(
        None, "Folder of a page and its pictures; MLflow gets those of swerve anyway."
    )
    seed: int = setting(0, "Of the bootstrap.", ge=0)
