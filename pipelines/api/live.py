"""The live chain in Python: an observer of terrain and target slip, and the samples of a log as they would come."""

from __future__ import annotations

from pipelines.live.observer import Observer
from pipelines.live.samples import replay

__all__ = ["Observer", "replay"]
