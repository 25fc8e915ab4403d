"""Progress of long work, reported by a callable."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the task, how many of its steps are done, and how many there are."""


def silent(task: str, done: int, total: int) -> None:
    """Report nothing."""
