"""Settings of ``terrain replay``."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import field_validator

from pipelines.report.settings import Settings, setting

AS_FAST_AS_IT_GOES = "max"


class ReplaySettings(Settings):
    """How a log is replayed, and through what."""

    speed: str = setting(
        AS_FAST_AS_IT_GOES, "Times the log's own speed, as 1 or 4; 'max' is as fast as it goes."
    )
    model: str | None = setting(
        None, "models:/NAME@champion, models:/NAME/3, or a model folder; a robot without a pilot needs one."
    )
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(
        None, "Windows so far apart in s (0.25), filtered over time; as trained otherwise.", "--filter-stride"
    )
    rate_hz: float = setting(50.0, "Steps of the live chain a second.", option="--rate", ge=1.0, le=1000.0)

    @property
    def speed_ratio(self) -> float:
        """Times the log's own speed; infinite for ``max``."""
        return math.inf if self.speed == AS_FAST_AS_IT_GOES else float(self.speed)

    @field_validator("speed")
    @classmethod
    def _check_speed(cls, text: str) -> str:
        try:
            ratio = 1.0 if text == AS_FAST_AS_IT_GOES else float(text)
        except ValueError:
            ratio = 0.0
        if not 0.0 < ratio < math.inf:
            raise ValueError(f"--speed is {text!r}: a number above zero, or 'max', is required")
        return text
