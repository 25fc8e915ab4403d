"""Settings of ``terrain measure-slip``."""

from __future__ import annotations

from pathlib import Path

from pydantic import field_validator

from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import setting


class MeasureSlipSettings(AlignedRunsSettings):
    """Runs with wheel speeds and an outside measurement of motion, and what is found of them."""

    out: Path | None = setting(None, "Folder of new run folders with the stream slip.")
    figures: Path | None = setting(None, "Folder of a page and its pictures.")
    window_s: float = setting(2.0, "Window length in s.", "--window", gt=0.0)
    stride_s: float = setting(1.0, "From window to window in s.", "--stride", gt=0.0)
    delay: str = setting(
        "auto", "Delay of the outside measurement in s; 'auto' finds it, a session at a time."
    )
    predict: bool = setting(False, "Predict slip from currents and wheel speeds, on held-out runs.")
    hold_out: tuple[str, ...] = setting(
        (),
        "Sessions that predictions never train on, by commas; runs without a label never are.",
        separated=True,
    )
    rollers: bool = setting(False, "Of omni robots: rollers' friction by surface, load of the wheels.")
    seed: int = setting(0, "Deals and draws runs.", ge=0)

    @field_validator("delay")
    @classmethod
    def _check_delay(cls, text: str) -> str:
        try:
            within = text == "auto" or abs(float(text)) <= 5.0
        except ValueError:
            within = False
        if not within:
            raise ValueError(f"--delay is {text!r}; 'auto' or seconds from -5 to 5 are required")
        return text

    @property
    def delay_s(self) -> float | None:
        """The delay that is given; None where it is to be found."""
        return None if self.delay == "auto" else float(self.delay)
