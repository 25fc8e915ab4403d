"""Settings of ``terrain reproduce``."""

from __future__ import annotations

from pathlib import Path

from pipelines.report.settings import Settings, setting


class ReproduceSettings(Settings):
    """Folder of the page, and the seed of all runs."""

    out: Path = setting(Path("terrain-reproduce"), "Folder of the page.")
    seed: int = setting(0, "Seed of all runs.", ge=0)
