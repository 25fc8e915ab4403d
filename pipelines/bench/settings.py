"""Settings of the benchmarks."""

from __future__ import annotations

from pathlib import Path

from pydantic import field_validator

from pipelines.report.settings import Settings, setting


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


class LabelsSettings(Settings):
    """On which runs label strategies are compared."""

    data: Path = setting(..., "Folder of labelled runs.")
    repeats: int = setting(5, "Fold assignments.", ge=1)
    seed: int = setting(0, "Deals runs into folds, and draws the first labels.", ge=0)
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)


class FleetSettings(Settings):
    """How many runs are generated, and how many processes compute their features."""

    runs: int = setting(10_000, "Runs of the largest size; 10 % and 30 % of them are measured too.", ge=10)
    workers: tuple[int, ...] = setting((1, 2), "Processes at once, by commas.", separated=True)
    seed: int = setting(0, "Of the fleet.", ge=0)
    scratch: Path | None = setting(
        None, "Existing folder for the generated runs, 70 kB each; that of temporary files by default."
    )

    @field_validator("workers")
    @classmethod
    def _check_workers(cls, workers: tuple[int, ...]) -> tuple[int, ...]:
        if not workers or min(workers) < 1 or len(set(workers)) < len(workers):
            raise ValueError(f"--workers is {','.join(map(str, workers))!r}: different numbers from 1 on")
        return workers

    @field_validator("scratch")
    @classmethod
    def _check_scratch(cls, scratch: Path | None) -> Path | None:
        if scratch is not None and not scratch.is_dir():
            raise ValueError(f"--scratch is {scratch}: is no folder")
        return scratch
