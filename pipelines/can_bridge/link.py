"""A bus of python-can that is opened again when it fails."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from pipelines.data.can_codec import MISSING_PACKAGE, Frame
from terrain.errors import ConfigError

REOPEN_S = 0.5
"""Between two attempts to open a bus that failed."""


def open_bus(interface: str, channel: str, bitrate: int | None = None) -> Any:
    """Return an open bus of python-can.

    Raises
    ------
    ConfigError
        if there is no such interface, or it cannot be opened.
    """
    try:
        import can
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigError(f"--interface is {interface!r}; python-can knows {known}")
    options = {} if bitrate is None else {"bitrate": bitrate}
    try:
        return can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except Exception as error:  # each interface has errors of its own, and of the library it loads
        text = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"the bus {interface} {channel!r} cannot be opened ({text[:160]})") from error


class Link:
    """Frames from and to a bus; no error of the bus comes through, all are counted.

    Parameters
    ----------
    make_bus : opens the bus; called at once, and again after an error of it
    clock, wait : time of this computer in s, and how to wait

    Attributes
    ----------
    errors : by message
    n_out : frames sent

    Raises
    ------
    ConfigError
        if the bus cannot be opened at first.
    """

    def __init__(
        self,
        make_bus: Callable[[], Any],
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._make_bus, self._clock, self._wait = make_bus, clock, wait
        self.errors: Counter[str] = Counter()
        self.n_out = 0
        self._retry_s = 0.0
        self._bus: Any = make_bus()

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None where none came in time."""
        if self._bus is None and not self._reopened():
            self._wait(timeout_s)
            return None
        try:
            message = self._bus.recv(timeout=timeout_s)
        except Exception as error:  # each interface has errors of its own
            self._failed("receive", error)
            return None
        if message is None:
            return None
        return Frame(
            message.timestamp,
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_remote_frame,
            message.is_error_frame,
        )

    def send(self, frames: Sequence[Frame]) -> bool:
        """Send frames; those that cannot be sent at once are not sent later. Say whether all were."""
        if self._bus is None:
            return False
        import can

        for frame in frames:
            message = can.Message(
                arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=frame.is_extended
            )
            try:
                self._bus.send(message, timeout=0)
            except Exception as error:
                self._count("send", error)
                return False
            self.n_out += 1
        return True

    def close(self) -> None:
        """Shut the bus down."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(Exception):  # a bus that failed may refuse
                bus.shutdown()

    def _failed(self, what: str, error: Exception) -> None:
        self._count(what, error)
        self.close()
        self._retry_s = self._clock() + REOPEN_S

    def _reopened(self) -> bool:
        if self._clock() < self._retry_s:
            return False
        try:
            self._bus = self._make_bus()
        except Exception as error:
            self._failed("open", error)
        return self._bus is not None

    def _count(self, what: str, error: Exception) -> None:
        text = " ".join(str(error).split()) or type(error).__name__
        self.errors[f"{what}: {text[:80]}"] += 1
