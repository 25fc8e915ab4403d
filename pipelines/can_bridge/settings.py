"""Settings of ``terrain can``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipelines.report.settings import Settings, setting


class CanSettings(Settings):
    """The bus, the robot, and what drives it."""

    interface: str = setting(..., "Kind of bus as python-can names it: socketcan, pcan, slcan, virtual...")
    channel: str = setting(..., "Channel of the bus, as can0.")
    bitrate: int | None = setting(None, "Bit rate in bit/s, of interfaces that set it; not socketcan.", gt=0)
    dbc: Path | None = setting(None, "DBC with the signals of docs/can.md; AgriMaRo's by default.")
    robot: str = setting("agrimaro", "Robot by name, or its YAML file.")
    controller: Literal["traction", "thesis"] = setting("traction", "traction, or thesis: PID on each wheel.")
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    model: str | None = setting(
        None, "Classifier of the terrain: models:/NAME@champion or a folder; unknown terrain without one."
    )
    rate_hz: float = setting(50.0, "Rate of the corrections in Hz.", option="--rate", ge=1.0, le=500.0)
    duration_s: float | None = setting(
        None, "Stops after so many s; by default when it is interrupted.", option="--duration", ge=0.0
    )
