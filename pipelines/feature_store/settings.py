"""Settings of the command that makes a store of features."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.crossval.settings import WINDOW_S
from pipelines.report.settings import Settings, setting
from terrain.logs.schema import SIGNAL_SETS

if TYPE_CHECKING:
    from features.windows import WindowRule


class FeaturesSettings(Settings):
    """How windows are cut, which features they get, and where these are written."""

    out: Path = setting(..., "Folder of the store of features; one that was interrupted goes on.")
    window_s: float = setting(WINDOW_S, "Window length in s.", "--window")
    stride_s: float | None = setting(None, "From window to window in s; one length by default.", "--stride")
    steady: bool = setting(True, "Keep windows of steady motion only.")
    signal_sets: tuple[str, ...] = setting(
        SIGNAL_SETS, "Signal sets to use, by commas.", option="--signals", separated=True
    )
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        from features.windows import WindowRule

        return WindowRule(self.window_s, self.stride_s, WindowRule().steady if self.steady else None)

    @property
    def jobs(self) -> int:
        """Processes at once on this machine."""
        return self.n_jobs if self.n_jobs > 0 else os.cpu_count() or 1
