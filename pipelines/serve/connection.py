"""One robot's connection: messages in, steps out, each at its own time."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from contextlib import suppress
from time import monotonic, perf_counter
from typing import Any

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect, WebSocketState

from pipelines.live.chain import CommandStatus
from pipelines.live.session import StepOutput
from pipelines.serve.guard import Bucket, token_fits
from pipelines.serve.hub import Hub, OpenSession
from pipelines.serve.messages import error_content, read_hello, step_content, welcome
from pipelines.serve.wire import Encoding, WireError, decode, encode
from terrain.estimation.live.clocks import number

MAX_NOTES = 1000
"""Answers to messages that wait to be read; of more, the oldest are left out."""

LEAVING_S = 3.0
"""For a robot to be sent why its connection ends."""

TURN = 16
"""Messages of one robot in a row; then the others have their turn."""

TRY_AGAIN_LATER, POLICY = 1013, 1008
"""Codes of closed WebSockets (RFC 6455)."""


class Connection:
    """Talk with one robot until it leaves.

    Parameters
    ----------
    socket : accepted
    hub : of its session
    token : that is required; empty for none
    given_token : that came with the request
    """

    def __init__(self, socket: WebSocket, hub: Hub, token: str, given_token: str) -> None:
        self._socket, self._hub = socket, hub
        self._token, self._given_token = token, given_token
        self._encoding = Encoding.JSON
        self._notes: deque[dict[str, Any]] = deque(maxlen=MAX_NOTES)
        self._step: StepOutput | None = None
        self._changed = asyncio.Event()
        self._writing = False
        self._left = asyncio.Event()
        self._messages = Bucket(hub.limits.messages_per_s)
        self._rows = Bucket(hub.limits.rows_per_s)
        self._n_dropped = 0
        self._end: tuple[int, str] = (1000, "")

    async def serve(self) -> None:
        """Talk until the robot leaves or has to; nothing is raised."""
        opened = None
        tasks: list[asyncio.Task[None]] = []
        try:
            opened, rate_hz = await self._greet()
            if opened is None:
                return
            loop = asyncio.get_running_loop()
            tasks = [loop.create_task(self._receive(opened, rate_hz)), loop.create_task(self._send(opened))]
            tasks.append(loop.create_task(self._leaving()))
            if rate_hz > 0.0:
                tasks.append(loop.create_task(self._tick(opened, rate_hz)))
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        except (WebSocketDisconnect, RuntimeError, OSError):  # TimeoutError is an OSError
            pass  # the robot has left, in the middle of anything
        finally:
            for task in tasks:
                task.cancel()
            if opened is not None:
                self._hub.close(opened)
            for result in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(result, Exception) and not _is_leaving(result):
                    self._hub.trouble["connection"] = f"{type(result).__name__}: {result}"
            await self._close()

    def leave(self, code: str, sentence: str) -> None:
        """End the connection with an error, from outside."""
        self._end = (TRY_AGAIN_LATER, sentence[:120])
        self._note(code, sentence, fatal=True)
        self._left.set()

    async def _greet(self) -> tuple[OpenSession | None, float]:
        """Wait for a hello and answer it; None where none came in time or it was refused for good."""
        limits = self._hub.limits
        latest_s = asyncio.get_running_loop().time() + limits.hello_s
        while True:
            try:
                async with asyncio.timeout_at(latest_s):
                    hello = read_hello(await self._next())
                if not token_fits(self._token, hello.token or self._given_token):
                    raise WireError("token", "a token is required, or it is another")
                opened = await self._hub.open(hello, self.leave)
                break
            except WireError as error:
                final = error.code in ("token", "closing")
                async with asyncio.timeout(limits.too_slow_s):
                    await self._write(self._error(error.code, str(error), fatal=final))
                if final:
                    self._end = (POLICY, error.code)
                    return None, 0.0
            except TimeoutError:
                self._end = (POLICY, "no hello came in time")
                return None, 0.0
        accepted = {name: value for name, value in limits._asdict().items() if name != "sessions"}
        try:
            await self._write(welcome(hello, opened.chain, opened.restored, accepted))
        except BaseException:  # it has left meanwhile
            self._hub.close(opened)
            raise
        return opened, hello.rate_hz

    async def _receive(self, opened: OpenSession, rate_hz: float) -> None:
        metrics, n_taken = self._hub.metrics, 0
        while True:
            try:
                message = await self._receive_message()
                now_s = opened.received_s = monotonic()
                metrics.messages.inc()
                n_taken += 1
                if n_taken % TURN == 0:
                    await asyncio.sleep(0)
                if not self._messages.take(1, now_s):
                    self._drop()
                    continue
                content = self._decoded(message)
                if content.get("type") == "bye":
                    return
                if content.get("type") != "samples":
                    kind = str(content.get("type"))[:40]
                    raise WireError("unknown-type", f"there is no message of the type {kind!r}")
                self._take(opened, content, now_s)
                if rate_hz == 0.0 and content.get("step") is True:
                    time_s = number(content.get("time_s"))
                    self._run(opened, time_s if math.isfinite(time_s) else None)
            except WireError as error:
                self._note(error.code, str(error))

    def _take(self, opened: OpenSession, content: dict[str, Any], now_s: float) -> None:
        """Take the samples of a message; what is refused of it is named in one error, the rest is used."""
        chain = opened.chain
        n_rows = _n_rows(content.get("streams"))
        if not self._rows.take(n_rows, now_s):
            most = self._hub.limits.rows_per_s
            raise WireError("too-fast", f"more than {most:g} rows a second: this message is dropped")
        before = chain.inbox.refused.copy()
        self._hub.metrics.rows.inc(chain.put(content.get("streams"), content.get("twist"), now_s))
        refused = chain.inbox.refused - before
        if refused:
            self._note("malformed", f"samples: {'; '.join(sorted(refused))}")

    async def _tick(self, opened: OpenSession, rate_hz: float) -> None:
        """Step at the rate that was asked for; ticks that cannot be kept are left out and counted."""
        period_s = 1.0 / rate_hz
        due_s = monotonic()
        while True:
            due_s += period_s
            wait_s = due_s - monotonic()
            if wait_s < -period_s:
                n = int(-wait_s / period_s)
                self._hub.metrics.late_ticks.inc(n)
                due_s += n * period_s
            await asyncio.sleep(max(wait_s, 0.0))
            self._run(opened)

    def _run(self, opened: OpenSession, time_s: float | None = None) -> None:
        metrics, begun_s = self._hub.metrics, perf_counter()
        output = opened.chain.step(time_s=time_s)
        metrics.step_s.observe(perf_counter() - begun_s)
        metrics.steps.inc()
        if output.latency_s == output.latency_s:  # a number
            metrics.latency_s.observe(output.latency_s)
        if output.status is not CommandStatus.OK:
            metrics.stopped.labels(output.status.value).inc()
        if output.status is CommandStatus.FAILED:
            self._hub.trouble[f"session {opened.name}"] = opened.chain.failure
        for window in opened.chain.finished:
            metrics.window_s.observe(window.took_s)
            metrics.windows.labels(window.terrain or "refused").inc()
        if self._step is not None:
            metrics.unsent.inc()
        self._step = output
        opened.last = output
        self._changed.set()

    async def _send(self, opened: OpenSession) -> None:
        """Send what is there: first the notes, then the newest step."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            try:
                async with asyncio.timeout(self._hub.limits.too_slow_s):
                    self._writing = True
                    while self._notes:
                        await self._write(self._notes.popleft())
                    output, self._step = self._step, None
                    if output is not None:
                        await self._write(step_content(output))
                    self._writing = False
            except TimeoutError:
                self._end = (TRY_AGAIN_LATER, "the receiver did not read for too long")
                self._hub.metrics.errors.labels("too-slow").inc()
                return

    async def _leaving(self) -> None:
        await self._left.wait()
        async with asyncio.timeout(LEAVING_S):
            while self._notes or self._writing or self._changed.is_set():
                await asyncio.sleep(0.01)

    def _drop(self) -> None:
        """Count a message that comes too fast; those of a twentieth of a second are named in one error."""
        if not self._n_dropped:
            asyncio.get_running_loop().call_later(0.05, self._note_dropped)
        self._n_dropped += 1

    def _note_dropped(self) -> None:
        most, n, self._n_dropped = self._hub.limits.messages_per_s, self._n_dropped, 0
        self._note("too-fast", f"more than {most:g} messages a second: dropped {n} of them")

    async def _next(self) -> dict[str, Any]:
        """Return the content of the next message."""
        return self._decoded(await self._receive_message())

    async def _receive_message(self) -> str | bytes:
        """Return the next message; its encoding is that of the answers from now on."""
        received = await self._socket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", 1006))
        message: str | bytes | None = received.get("text")
        if message is None:
            message = received.get("bytes") or b""
        self._encoding = Encoding.JSON if isinstance(message, str) else Encoding.MSGPACK
        return message

    def _decoded(self, message: str | bytes) -> dict[str, Any]:
        if len(message) > self._hub.limits.message_bytes:
            raise WireError(
                "too-large",
                f"the message has {len(message)} bytes, {self._hub.limits.message_bytes} are accepted",
            )
        return decode(message)

    def _error(self, code: str, sentence: str, *, fatal: bool = False) -> dict[str, Any]:
        self._hub.metrics.errors.labels(code).inc()
        return error_content(code, sentence, fatal=fatal)

    def _note(self, code: str, sentence: str, *, fatal: bool = False) -> None:
        self._notes.append(self._error(code, sentence, fatal=fatal))
        self._changed.set()

    async def _write(self, content: dict[str, Any]) -> None:
        message = encode(content, self._encoding)
        if isinstance(message, str):
            await self._socket.send_text(message)
        else:
            await self._socket.send_bytes(message)

    async def _close(self) -> None:
        if self._socket.client_state is not WebSocketState.DISCONNECTED:
            with suppress(RuntimeError, OSError, WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._socket.close(*self._end)


def _n_rows(streams: Any) -> int:
    """Return how many rows a message has, as far as can be seen."""
    if not isinstance(streams, dict):
        return 0
    return sum(
        len(given[0])
        for given in streams.values()
        if isinstance(given, list) and given and isinstance(given[0], list)
    )


def _is_leaving(error: BaseException) -> bool:
    return isinstance(error, WebSocketDisconnect | RuntimeError | OSError | TimeoutError)
