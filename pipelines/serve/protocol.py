"""Connections as the service needs them: a short queue to the robot, and an end for those that say nothing.

A command that waits in a buffer grows old.  What the system and the server buffer for a connection is kept
small, so that a robot that reads too slowly is noticed after a few steps, and gets new ones when it goes on.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

SEND_BUFFER = 8192
"""Bytes that the system may buffer towards a robot; it doubles them."""

REQUEST_S = 10.0
"""For a request to come whole, from the connection or from its first byte on."""

FLUSH_S = 3.0
"""For what is buffered when a connection ends; a receiver that does not read would keep it for ever."""


class HttpProtocol(H11Protocol):
    """HTTP, and the end of a connection on which a request does not come whole."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, with a time limit for the first request."""
        super().connection_made(transport)
        self._limit: asyncio.TimerHandle | None = self._end_in_time(transport)

    def data_received(self, data: bytes) -> None:
        """Take a part of a request; the rest has to come in time."""
        super().data_received(data)
        state = self.conn.their_state
        if state is h11.SEND_BODY or (state is h11.IDLE and self.conn.trailing_data[0]):
            self._limit = self._limit or self._end_in_time(self.transport)
        elif self._limit is not None:
            self._limit.cancel()
            self._limit = None

    def _end_in_time(self, transport: asyncio.Transport) -> asyncio.TimerHandle:
        def end() -> None:
            if transport.get_protocol() is self:  # and not that of a WebSocket
                transport.abort()

        return self.loop.call_later(REQUEST_S, end)


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
