"""Settings of the live service."""

from __future__ import annotations

from pathlib import Path

from pipelines.report.settings import Settings, setting

PORT = 8765


class ServeSettings(Settings):
    """What is served, to whom, and how much is accepted."""

    model: str = setting(..., "models:/NAME@champion, models:/NAME/3, or a model folder.")
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(
        None, "Windows so far apart in s (0.25), filtered over time; as trained otherwise.", "--filter-stride"
    )
    robot: str | None = setting(
        None, "Robot by name, or its YAML file: its description is used for robots of its name."
    )
    host: str = setting("127.0.0.1", "Address to listen on; a token is required for others than loopback.")
    port: int = setting(PORT, "Port to listen on; 0 for a free one.", ge=0, le=65535)
    token_file: Path | None = setting(
        None, "File with the token that is required; TERRAIN_TOKEN holds it otherwise."
    )
    max_sessions: int = setting(64, "Robots at once.", ge=1, le=10_000)
    state: Path | None = setting(None, "Folder of what outlives a restart: biases and terrain of each robot.")
    record: Path | None = setting(None, "Folder of the run folders of sessions that ask to be recorded.")
    check: bool = setting(False, "Load and check all of it, take the port, and end.")
