"""Settings of the benchmarks of the live chain."""

from __future__ import annotations

from pathlib import Path

from pipelines.config.settings import Settings, setting


class BenchSettings(Settings):
    """What is measured, and for how long."""

    model: str | None = setting(
        None, "Model of AgriMaRo, as of train; by default one trained on four short simulated runs."
    )
    robots: int = setting(25, "Robots at once.", ge=1, le=200)
    seconds: float = setting(20.0, "Length of each measurement.", gt=1.0, le=600.0)
    seed: int = setting(0, "Of the simulated drive.", ge=0)


class SoakSettings(Settings):
    """How long the service is loaded, and with what."""

    model: str | None = setting(
        None, "Model of AgriMaRo, as of train; by default one trained on four short simulated runs."
    )
    robots: int = setting(8, "Robots at once.", ge=1, le=100)
    minutes: float = setting(30.0, "Length of the soak.", gt=0.0, le=6000.0)
    seed: int = setting(0, "Of the faults and the drives.", ge=0)
    out: Path | None = setting(None, "Folder of the service's states; a temporary one by default.")
