"""Settings of ``terrain reproduce``."""

from __future__ import annotations

from pathlib import Path

from pipelines.config.settings import Settings, setting


class ReproduceSettings(Settings):
    """Where the page goes, and what is drawn."""

    out: Path = setting(Path("terrain-reproduce"), "Folder of the page.")
    seed: int = setting(0, "Of all runs.", ge=0)
