"""Settings of ``terrain fit-soil``."""

from __future__ import annotations

from pathlib import Path

from pydantic import field_validator

from pipelines.data.settings import RunsSettings
from pipelines.report.settings import setting

LAW_NAMES = (
    "simulator",
    *("bekker", "wong_reece", "ishigami", "ishigami_ding", "ishigami_travel"),
    "inflow",
)
"""Laws that are compared; ``simulator`` is the one of ``terrain simulate``."""


class FitSoilSettings(RunsSettings):
    """Trials of a wheel testbed, and what is written."""

    out: Path = setting(..., "Folder of the page, its pictures and a soil file a wheel.")
    laws: tuple[str, ...] = setting(
        LAW_NAMES, "Laws to compare, by commas; the last one is reported in full.", separated=True
    )
    check: Path | None = setting(
        None, "Folder of further trials, which the last law predicts and no fit has."
    )
    draws: int = setting(60, "Bootstrap samples behind the intervals.", ge=2, le=10_000)
    seed: int = setting(0, "Of the bootstrap.", ge=0)

    @field_validator("laws")
    @classmethod
    def _check_laws(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in names if name not in LAW_NAMES]
        if unknown or not names:
            found = repr(unknown[0]) if unknown else "empty"
            raise ValueError(f"--laws is {found}; choose among {', '.join(LAW_NAMES)}")
        if names[-1] == "simulator":
            raise ValueError("--laws ends in 'simulator'; the last one is a law of stresses, as 'inflow' is")
        return tuple(dict.fromkeys(names))
