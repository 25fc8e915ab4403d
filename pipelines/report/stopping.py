"""Ctrl-C and SIGTERM as a call, for commands that end with a summary.

An interrupt that is raised while a kernel is compiled is lost there; a call is not.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Call a function at an interrupt or a request to end, in place of ending at once."""
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)}
    for name in before:
        signal.signal(name, lambda *_: stop())
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
