"""Settings of ``terrain serve``, by what they belong to."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, Self

from pydantic import field_validator, model_validator

from pipelines.data.settings import ReadSettings
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import option_name, setting

AS_FAST_AS_IT_GOES = "max"


class ServedSettings(BaseSettings):
    """What is served."""

    model: str | None = setting(
        None,
        "models:/NAME@champion, models:/NAME/3, or a model folder; without one terrain is unknown (--can, --replay).",
    )
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(
        None, "Windows so far apart in s (0.25), filtered over time; as trained otherwise.", "--filter-stride"
    )
    robot: str | None = setting(
        None, "Robot by name, or its YAML file: its description is used for robots of its name."
    )
    rate_hz: float = setting(
        50.0, "Steps a second of the live chain on a bus or over a log.", "--rate", ge=1.0, le=1000.0
    )


class ServiceSettings(BaseSettings):
    """The WebSocket service: where it listens, to whom, and how much is accepted."""

    host: str = setting("127.0.0.1", "Address to listen on; a token is required for others than loopback.")
    port: int = setting(8765, "Port to listen on; 0 for a free one.", ge=0, le=65535)
    token_file: Path | None = setting(
        None, "File with the token that is required; TERRAIN_TOKEN holds it otherwise."
    )
    max_sessions: int = setting(64, "Robots at once.", ge=1, le=10_000)
    state: Path | None = setting(None, "Folder of what outlives a restart: biases and terrain of each robot.")
    record: Path | None = setting(None, "Folder of the recordings of sessions that ask for it.")
    check: bool = setting(False, "Load and check all of it, take the port, and end.")


class CanSettings(BaseSettings):
    """A CAN bus in place of the WebSocket service."""

    can: str | None = setting(
        None, "Bus as INTERFACE:CHANNEL of python-can, as socketcan:can0; can0 alone is of socketcan."
    )
    bitrate: int | None = setting(None, "Bit rate in bit/s, of interfaces that set it; not socketcan.", gt=0)
    dbc: Path | None = setting(None, "DBC with the signals of docs/can.md; AgriMaRo's by default.")
    controller: Literal["traction", "thesis"] = setting("traction", "traction, or thesis: PID on each wheel.")
    duration_s: float | None = setting(
        None, "Stops after so many s; by default when it is interrupted.", option="--duration", ge=0.0
    )


class ReplaySettings(ReadSettings):
    """A log in place of robots."""

    replay: Path | None = setting(
        None, "Log, in any layout that convert reads, that is sent through the live chain."
    )
    speed: str = setting(
        AS_FAST_AS_IT_GOES, "Times the log's own speed, as 1 or 4; 'max' is as fast as it goes."
    )

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


class Settings(ReplaySettings, CanSettings, ServiceSettings, ServedSettings):
    """Settings of ``terrain serve``."""

    @model_validator(mode="after")
    def _check_mode(self) -> Self:
        """Refuse options of another mode than the one that is asked for."""
        modes: dict[str, type[BaseSettings]] = {"--can": CanSettings, "--replay": ReplaySettings}
        asked = [option for option in modes if getattr(self, option.removeprefix("--")) is not None]
        if len(asked) > 1:
            raise ValueError(f"{' and '.join(asked)} are two modes: one of them is accepted")
        mode = asked[0] if asked else "the WebSocket service"
        for name, group in (modes | {"the WebSocket service": ServiceSettings}).items():
            for field, about in group.model_fields.items():
                if name != mode and getattr(self, field) != about.get_default():
                    raise ValueError(
                        f"{option_name(type(self), field)} is an option of {name}, not of {mode}"
                    )
        return self
