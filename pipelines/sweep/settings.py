"""Settings of ``terrain sweep``."""

from __future__ import annotations

from pathlib import Path

from pipelines.crossval.settings import CrossvalSettings, RecipeSettings
from pipelines.report.settings import setting


class SweepSettings(RecipeSettings):
    """How long is searched, and where to."""

    out: Path = setting(..., "Folder of the trials and the result; a search that lies there goes on.")
    trials: int = setting(40, "Candidates that are tried.", ge=4, le=10_000)

    @property
    def evaluation(self) -> CrossvalSettings:
        """How windows are cut and runs dealt."""
        return CrossvalSettings(**self.shared(), extras=False)
