"""Settings of ``terrain find-changes``."""

from __future__ import annotations

from pathlib import Path

from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import setting


class FindChangesSettings(AlignedRunsSettings):
    """Runs to watch, and runs on one ground each that say what is no change."""

    calibrate: Path = setting(..., "Folder of runs on one ground each, of the same robot.")
    false_alarms: float = setting(
        0.02, "Share of the runs on one ground that may give an alarm.", gt=0.0, lt=0.5
    )
