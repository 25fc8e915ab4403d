"""The server: its port, its event loop, and its end, which it announces to the robots."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import socket
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, suppress
from typing import Any

import uvicorn

from pipelines.serve.app import make_app
from pipelines.serve.guard import Watched
from pipelines.serve.hub import Hub
from pipelines.serve.serve import Settings
from terrain.errors import ConfigError, TerrainError

SAVE_EVERY_S = 5.0
LARGEST_MESSAGE = 1_048_576  #: Bytes of a message that is not even read: the connection is closed (code 1009)

PING_S = 10.0

LEAVING_S = 3.5  #: That robots have to read that the service ends
CLOSING_S = 0.5  #: For their answers: ended at once, what was sent last would be lost


class Service:
    """A service that is loaded, checked and warm, and has its port; then from its first robot to its end.

    Parameters
    ----------
    settings : what is served, and where

    Attributes
    ----------
    hub : of the sessions
    url : of its HTTP side
    """

    def __init__(self, settings: Settings) -> None:
        with ExitStack() as cleanup:
            self.hub = Hub(settings)
            cleanup.callback(self.hub.stop)
            self._socket = cleanup.enter_context(_listen(settings.host, settings.port))
            self._cleanup = cleanup.pop_all()
        host, port = self._socket.getsockname()[:2]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending: asyncio.Task[None] | None = None
        self._announce: Callable[[str], None] = lambda url: None
        self._server = uvicorn.Server(
            uvicorn.Config(
                make_app(self.hub, self._lifespan),
                log_level="critical",
                access_log=False,
                loop="asyncio",
                lifespan="on",
                http=Watched,  # type: ignore[arg-type]  # it passes on what it does not do itself
                ws="websockets-sansio",
                ws_max_size=LARGEST_MESSAGE,
                ws_ping_interval=PING_S,
                ws_ping_timeout=PING_S,
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=5,
                server_header=False,
            )
        )

    def close(self) -> None:
        """Give the port back, and end the threads."""
        self._cleanup.close()

    def run(self, announce: Callable[[str], None]) -> None:
        """Serve until it has to end: at SIGTERM or Ctrl-C in order, at the second one at once.

        Parameters
        ----------
        announce : called with the address once robots can come
        """
        self._announce = announce
        gc.collect()
        gc.freeze()  # what is loaded now stays: no collection has to look at it
        with self._cleanup:
            self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """End in order, from another thread."""
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._end_at_signal)

    @asynccontextmanager
    async def _lifespan(self, app: Any) -> AsyncIterator[None]:
        """Save states while the service runs, and once more when all robots have left."""
        hub, loop = self.hub, asyncio.get_running_loop()
        self._loop = loop
        # few threads for what takes long: each has memory of its own that is not given back
        loop.set_default_executor(ThreadPoolExecutor(max_workers=2))
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):  # in place of uvicorn's, which tells no robot
                loop.add_signal_handler(number, self._end_at_signal)

        async def save() -> None:
            while True:
                await asyncio.sleep(SAVE_EVERY_S)
                await asyncio.to_thread(hub.save_states, hub.states())

        saving = asyncio.create_task(save())
        self._announce(self.url)
        yield
        saving.cancel()
        await asyncio.gather(saving, return_exceptions=True)
        hub.save_states(hub.states())

    def _end_at_signal(self) -> None:
        if self.hub.closing:
            self._server.should_exit = self._server.force_exit = True
        elif self._loop is not None:
            self.hub.closing = True
            self._ending = self._loop.create_task(self._end())

    async def _end(self) -> None:
        """Tell the robots, and end when they have read it."""
        leaving = list(self.hub.sessions.values())
        for opened in leaving:
            opened.leave("closing", "the service ends")
        with suppress(TimeoutError):
            async with asyncio.timeout(LEAVING_S):
                while self.hub.sessions:
                    await asyncio.sleep(0.01)
        await asyncio.sleep(CLOSING_S if leaving else 0.0)
        self._server.should_exit = True


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens; ``TerrainError`` where the address is taken or none of this machine."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no name of a machine"
        raise ConfigError(f"--host {host[:100]!r}: is no address ({reason})") from None
    try:
        return socket.create_server((host, port), family=family, backlog=1024)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise TerrainError(f"port {port} of {host} cannot be listened on ({reason})") from None
