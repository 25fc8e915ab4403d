"""Inspect runs: rates, gaps, clocks, units and signs; or a model: what it was trained on, its figures and limits."""

from __future__ import annotations

from pathlib import Path

from pipelines.data import inspect as runs
from pipelines.learn.settings import TrustSettings
from pipelines.report.results import Progress, Result, silent
from pipelines.report.settings import setting

EXAMPLE = runs.EXAMPLE


class Settings(runs.Settings, TrustSettings):
    """What is inspected."""

    data: Path = setting(..., option="DATA")
    """Folder of runs, an MCAP file, or a model: its folder or models:/NAME."""


def run(settings: Settings, progress: Progress = silent) -> Result:
    """Return the quality of runs, or the card of a model."""
    uri = str(settings.data)
    if uri.startswith(("models:/", "runs:/")) or (settings.data / "terrain_model.json").is_file():
        from pipelines.learn.card import model_result
        from pipelines.learn.model_file import model_folder
        from pipelines.learn.trust import remember

        remember(settings.trust)

        with model_folder(uri) as folder:
            return model_result(folder, uri)
    return runs.run(settings, progress)
