"""Settings of ``terrain export``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipelines.report.settings import Settings, setting

Target = Literal["mcap", "ros2", "ros2-mcap"]
"""``mcap``: an MCAP file a run; ``ros2``: a bag of ROS 2 a run, stored in SQLite; ``ros2-mcap``: in MCAP."""


class ExportSettings(Settings):
    """What is written, and where to."""

    out: Path = setting(..., "Folder of the new files, one a run.")
    target: Target = setting(
        "mcap", "What is written: mcap, a file a run; ros2 or ros2-mcap, a bag a run.", option="--as"
    )
