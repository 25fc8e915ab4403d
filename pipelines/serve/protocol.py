"""Connections as the service needs them: a short queue to the robot, and an end for those that say nothing.

A command that waits in a buffer grows old.  What the system and the server buffer for a connection is kept
small, so that a robot that reads too slowly is noticed after a few steps, and gets new ones when it goes on.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

SEND_BUFFER = 8192
"""Bytes that the system may buffer towards a robot; it doubles them."""

REQUEST_S = 10.0
"""For the first request of a connection."""

FLUSH_S = 3.0
"""For what is buffered when a connection ends; a receiver that does not read would keep it for ever."""


class HttpProtocol(H11Protocol):
    """HTTP, and the end of a connection on which no request comes."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, with a time limit for the first request."""
        super().connection_made(transport)
        self.loop.call_later(REQUEST_S, self._end_silent, transport)

    def _end_silent(self, transport: asyncio.Transport) -> None:
        if self.cycle is None and transport.get_protocol() is self:
            transport.abort()


class SocketProtocol(WebSocketsSansIOProtocol):
    """WebSockets with a short queue."""

    def connection_made(self, transport: Any) -> None:
        """Begin with small buffers."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=0)
        found: socket.socket = transport.get_extra_info("socket")
        found.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """End the connection even where its receiver does not read."""
        super().on_task_complete(task)
        self.loop.call_later(FLUSH_S, self.transport.abort)
