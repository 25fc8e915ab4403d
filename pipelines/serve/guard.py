"""Who may speak to the service, and how much: tokens, origins, bodies, budgets, and connections that stall."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import socket
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from fastapi import HTTPException
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipelines.serve.metrics import Metrics
from terrain.errors import ConfigError

SHORTEST_TOKEN = 16
"""Characters; a shorter one can be tried out."""

LONGEST_TOKEN = 512

WRONG_TOKEN_S = 1.0
"""Before a token that is missing or another is answered: a thousand tries take a quarter of an hour."""

LARGEST_BODY = 262_144
"""Bytes of a request's body: a table of target slips, or the name of a model."""

REQUEST_S = 10.0
"""For a request to come whole, and for a response to be read."""

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


def is_loopback(host: str) -> bool:
    """Say whether a host to listen on is reached from this machine only.

    Examples
    --------
    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0"), is_loopback("robot.local")
    (True, True, False, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_token(host: str, token: str) -> None:
    """Refuse to listen to other machines without a token, or with one that is too short or too long.

    Raises
    ------
    ConfigError
        where it is.
    """
    if token and not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN:
        raise ConfigError(
            f"the token has {len(token)} characters, {SHORTEST_TOKEN} to {LONGEST_TOKEN} are accepted "
            "(python -c 'import secrets; print(secrets.token_urlsafe())' makes one)"
        )
    if not token and not is_loopback(host):
        raise ConfigError(f"--host {host} is reached from other machines: a token is required (--token-file)")


def token_fits(required: str, given: str) -> bool:
    """Say whether a token is the required one, in a time that does not tell how much of it is right."""
    return not required or hmac.compare_digest(required.encode(), given.encode("utf-8", "replace"))


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


class Budget:
    """So much a second, and a second's worth at once; what is over is refused, or owed.

    Examples
    --------
    >>> budget = Budget(10.0)
    >>> budget.take(10, 0.0), budget.take(1, 0.0), budget.take(1, 0.5)
    (True, False, True)
    >>> budget.owe(14, 0.5), budget.take(1, 0.5), budget.owe(0, 1.0)
    (1.0, False, 0.5)
    """

    def __init__(self, per_s: float) -> None:
        self._per_s = self._left = per_s
        self._now_s: float | None = None

    def _refill(self, now_s: float) -> None:
        if self._now_s is not None:
            self._left = min(self._left + (now_s - self._now_s) * self._per_s, self._per_s)
        self._now_s = now_s

    def take(self, n: float, now_s: float) -> bool:
        """Say whether n more are within the budget; if so they are taken."""
        self._refill(now_s)
        if n > self._left:
            return False
        self._left -= n
        return True

    def owe(self, n: float, now_s: float) -> float:
        """Take n that have been spent already; return how many seconds it takes until nothing is owed."""
        self._refill(now_s)
        self._left -= n
        return max(-self._left / self._per_s, 0.0)


class Guard:
    """The application behind its limits: foreign pages, tokens of requests, sizes and times of bodies.

    Of a WebSocket only a token in its header is judged here; one that has none sends it as its first frame.

    Parameters
    ----------
    app : that is guarded
    token : that is required; empty for none
    open_paths : that need no token: they tell nothing of robots
    loopback : whether only this machine is listened to
    metrics : gets the number of wrong tokens
    connections : of the server
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        open_paths: frozenset[str],
        metrics: Metrics,
        connections: Connections,
        *,
        loopback: bool,
    ) -> None:
        self._app, self._token, self._open, self._loopback = app, token, open_paths, loopback
        self._metrics, self._connections = metrics, connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request or a WebSocket."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        address, headers, is_http = scope.get("client"), Headers(scope=scope), scope["type"] == "http"
        self._connections.came(address)
        refusal = None
        given = bearer(headers)
        if reason := foreign(headers, loopback=self._loopback):
            refusal = PlainTextResponse(f"{reason}\n", 403)
        elif ((is_http and scope["path"] not in self._open) or given) and not token_fits(self._token, given):
            await self.wrong_token()
            refusal = PlainTextResponse("a token is required (Authorization: Bearer)\n", 401)
        if is_http:
            receive, send = _in_time(receive), _secured(send)
        try:
            await (refusal or self._app)(scope, receive, send)
        finally:
            self._connections.ended(address, REQUEST_S if is_http else FLUSH_S)

    async def wrong_token(self) -> None:
        """Count a token that is missing or another, and let who gave it wait."""
        self._metrics.wrong_tokens.inc()
        await asyncio.sleep(WRONG_TOKEN_S)


def _in_time(receive: Receive) -> Receive:
    """Return what receives a body that comes in time."""
    latest_s, whole = asyncio.get_running_loop().time() + REQUEST_S, False

    async def in_time() -> Message:
        nonlocal whole
        if whole:  # what is waited for now is that the client leaves
            return await receive()
        try:
            async with asyncio.timeout_at(latest_s):
                message = await receive()
        except TimeoutError:
            raise HTTPException(408, f"the body did not come within {REQUEST_S:g} s") from None
        whole = not message.get("more_body", False)
        return message

    return in_time


def _secured(send: Send) -> Send:
    """Return what sends a response with the headers of all responses."""

    async def secured(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(SECURITY)
        await send(message)

    return secured


class Connections:
    """The server's connections by the address of the client, to end those that stall.

    uvicorn has no time limit for a first request, and waits for ever for a receiver that does not read; and
    what it buffers towards one would be old when it is read.
    """

    def __init__(self) -> None:
        self._transports: dict[Any, asyncio.Transport] = {}
        self._limits: dict[Any, asyncio.TimerHandle] = {}

    def began(self, transport: asyncio.Transport) -> None:
        """Take a connection: its request has to come in time, and little is buffered towards its client."""
        address = transport.get_extra_info("peername")
        transport.set_write_buffer_limits(high=0)
        line: socket.socket = transport.get_extra_info("socket")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._transports[address] = transport
        self._limits[address] = asyncio.get_running_loop().call_later(REQUEST_S, transport.abort)

    def came(self, address: Any) -> None:
        """Note that the head of a request has come whole."""
        if (limit := self._limits.pop(address, None)) is not None:
            limit.cancel()

    def ended(self, address: Any, flush_s: float = 0.0) -> None:
        """Let a connection end, with a time limit for what is buffered."""
        self.came(address)
        if (transport := self._transports.pop(address, None)) is not None:
            asyncio.get_running_loop().call_later(flush_s, transport.abort)


class Watched:
    """A protocol of the server, whose connections are watched until they become WebSockets.

    Parameters
    ----------
    protocol : that does the work
    connections : that are watched
    """

    def __init__(self, protocol: asyncio.Protocol, connections: Connections) -> None:
        self._protocol, self._connections = protocol, connections
        self._address: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._protocol, name)

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin."""
        self._address = transport.get_extra_info("peername")
        self._connections.began(transport)
        self._protocol.connection_made(transport)

    def connection_lost(self, error: Exception | None) -> None:
        """End."""
        self._connections.ended(self._address)
        self._protocol.connection_lost(error)
