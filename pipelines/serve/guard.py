"""Who may speak to the service: foreign pages and strangers may not, and connections that stall are ended."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipelines.serve.hub import Hub
from pipelines.serve.serve import is_loopback

REQUEST_S = 10.0  #: For a request to come whole, and for a response to be read

FLUSH_S = 3.0
"""For what is buffered when a WebSocket ends; a receiver that does not read would keep it for ever."""

SEND_BUFFER = 8192
"""Bytes that the system may buffer towards a robot; it doubles them.  A command that waits there grows old."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")

SECURITY = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Connection": "close",  # one request a connection: that it comes whole is timed from its beginning
}


def bearer(headers: Mapping[str, str]) -> str:
    """Return the token of an ``Authorization: Bearer`` header; empty without one."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else ""


def foreign(headers: Mapping[str, str], *, loopback: bool) -> str:
    """Return why a request must come from another site's page; empty where it need not.

    A browser lets any page reach this machine.  It tells the page's origin, which has to be the host that
    was asked; and where only this machine is listened to, that host has to be this machine by its own name.

    Examples
    --------
    >>> foreign({"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:8765"}, loopback=True)
    ''
    >>> foreign({"host": "127.0.0.1:8765", "origin": "http://evil.example"}, loopback=True)
    "the request is of a page of 'evil.example'"
    """
    host = headers.get("host", "")
    origin = headers.get("origin")
    name = _name(f"//{host}")
    if loopback and host and name not in LOCAL_NAMES:
        return f"the host {name!r} is not this machine"
    if origin is not None and urlsplit(origin).netloc != host:
        return f"the request is of a page of {_name(origin)!r}"
    return ""


def _name(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


class Guard:
    """The application behind its limits: foreign pages, tokens of requests, sizes and times of bodies.

    Of a WebSocket only a token in its header is judged here; one that has none sends it as its first frame.

    Parameters
    ----------
    app : that is guarded
    hub : knows the token
    open_paths : that need no token: they tell nothing of robots
    """

    def __init__(self, app: ASGIApp, hub: Hub, open_paths: frozenset[str]) -> None:
        self._app, self._hub, self._open = app, hub, open_paths
        self._loopback = is_loopback(hub.settings.host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request or a WebSocket."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers, is_http = Headers(scope=scope), scope["type"] == "http"
        connection: Watched = scope["state"]["connection"]
        app, given = self._app, bearer(headers)
        if reason := foreign(headers, loopback=self._loopback):
            app = PlainTextResponse(f"{reason}\n", 403)
        elif ((is_http and scope["path"] not in self._open) or given) and not self._hub.admits(given):
            await self._hub.wrong_token()
            app = PlainTextResponse("a token is required (Authorization: Bearer)\n", 401)

        async def received() -> Message:
            message = await receive()
            if not message.get("more_body", False):
                connection.abort_in(None)
            return message

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                connection.abort_in(REQUEST_S)
                MutableHeaders(scope=message).update(SECURITY)
            await send(message)

        if is_http:
            await app(scope, received, sent)
            return
        connection.abort_in(None)
        try:
            await app(scope, receive, send)
        finally:
            connection.abort_in(FLUSH_S)


class Watched:
    """A connection of the server, which is ended where it stalls.

    uvicorn has no time limit for a first request, and waits for ever for a receiver that does not read; and
    what it buffers towards one would be old when it is read.

    Parameters
    ----------
    app_state : of the server; requests and the WebSocket of the connection find it there
    named : of uvicorn's protocol, which does the work
    """

    def __init__(self, app_state: dict[str, Any], **named: Any) -> None:
        self._protocol = H11Protocol(app_state={**app_state, "connection": self}, **named)
        self._ending: asyncio.TimerHandle | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._protocol, name)

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin: a request has to come in time, and little is buffered towards the client."""
        self._transport = transport
        transport.set_write_buffer_limits(high=0)
        line: socket.socket = transport.get_extra_info("socket")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.abort_in(REQUEST_S)
        self._protocol.connection_made(transport)

    def abort_in(self, seconds: float | None) -> None:
        """End the connection after a time, in place of the time that was set before; None for never."""
        if self._ending is not None:
            self._ending.cancel()
        self._ending = None
        if seconds is not None:
            self._ending = asyncio.get_running_loop().call_later(seconds, self._transport.abort)
