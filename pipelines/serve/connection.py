"""What speaks WebSocket to the service: robots, messages in and steps out; and pages that watch them.

Where a token is required, nothing is decoded before it has fitted: it comes in the header of the handshake, or
as the first frame by itself.  Before its hello a robot is given one answer at a time, and what it
sends is not decoded where it is larger than any hello.  What a session may send is a budget: of messages,
rows and bytes, and of the time that decoding them takes.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from time import monotonic, perf_counter
from typing import Any

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect, WebSocketState

from pipelines.live.chain import CommandStatus
from pipelines.live.session import StepOutput
from pipelines.serve.guard import LONGEST_TOKEN, Budget, bearer, token_fits
from pipelines.serve.hub import Hub, OpenSession
from pipelines.serve.messages import error_content, read_hello, served_content, step_content, welcome
from pipelines.serve.wire import WireError, decode, encode
from terrain.estimation.live.clocks import number

MAX_NOTES = 1000
"""Answers to messages that wait to be read; of more, the oldest are left out."""

TURN = 16
"""Messages of one robot in a row; then the others have their turn."""

LARGE = 32_768
"""Bytes of a message that is decoded in a thread; no hello is as large."""

PAUSE_S = 0.5
"""Before the next message of a robot is read whose hello was not accepted."""

WATCH_HZ, MAX_WATCHERS, WATCH_SLOW_S = 10.0, 16, 10.0
"""Of what pages are sent: how often, how many pages, and for how long one may not read."""

LONGEST_WATCH = 4096
"""Characters of what a page says."""

TRY_AGAIN_LATER, POLICY = 1013, 1008
"""Codes of closed WebSockets (RFC 6455)."""

NO_TOKEN = "a token is required, or it is another"

GONE = (WebSocketDisconnect, RuntimeError, OSError)
"""What is raised where the other end has left, in the middle of anything; ``TimeoutError`` is among them."""


class Line:
    """A WebSocket from its handshake to its end.

    Parameters
    ----------
    socket : not accepted yet
    hub : of the sessions
    token : that is required; empty for none
    wrong_token : counts a wrong token, and waits
    """

    def __init__(
        self, socket: WebSocket, hub: Hub, token: str, wrong_token: Callable[[], Awaitable[None]]
    ) -> None:
        self._socket, self._hub, self._token, self._wrong_token = socket, hub, token, wrong_token
        self._packed = False
        self._end: tuple[int, str] = (1000, "")

    async def serve(self) -> None:
        """Talk until the other end leaves or has to; nothing is raised."""
        try:
            await self._socket.accept()
            if await self._admitted():
                await self._talk()
        except GONE:
            pass
        finally:
            if self._socket.client_state is not WebSocketState.DISCONNECTED:
                with suppress(*GONE):
                    async with asyncio.timeout(1.0):
                        await self._socket.close(*self._end)

    async def _talk(self) -> None:
        raise NotImplementedError

    async def _admitted(self) -> bool:
        """Say whether the token is the required one: that of the header, or the first frame, undecoded."""
        if token_fits(self._token, bearer(self._socket.headers)):
            return True
        first: str | bytes = ""
        with suppress(TimeoutError):
            async with asyncio.timeout(self._hub.limits.hello_s):
                first = await self._received()
        if isinstance(first, str) and len(first) <= LONGEST_TOKEN and token_fits(self._token, first):
            return True
        await self._wrong_token()
        await self._write(self._error("token", NO_TOKEN, fatal=True))
        self._end = (POLICY, "token")
        return False

    async def _received(self) -> str | bytes:
        """Return the next message; its encoding is that of the answers from now on."""
        received = await self._socket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", 1006))
        message: str | bytes | None = received.get("text")
        if message is None:
            message = received.get("bytes") or b""
        self._packed = isinstance(message, bytes)
        return message

    async def _write(self, content: dict[str, Any]) -> None:
        message = encode(content, packed=self._packed)
        async with asyncio.timeout(self._hub.limits.too_slow_s):
            if isinstance(message, str):
                await self._socket.send_text(message)
            else:
                await self._socket.send_bytes(message)

    def _error(self, code: str, sentence: str, *, fatal: bool = False) -> dict[str, Any]:
        self._hub.metrics.errors.labels(code).inc()
        return error_content(code, sentence, fatal=fatal)


class Connection(Line):
    """One robot's connection: messages in, steps out, each at its own time."""

    def __init__(
        self, socket: WebSocket, hub: Hub, token: str, wrong_token: Callable[[], Awaitable[None]]
    ) -> None:
        super().__init__(socket, hub, token, wrong_token)
        limits = hub.limits
        self._messages, self._rows = Budget(limits.messages_per_s), Budget(limits.rows_per_s)
        self._bytes, self._decoding = Budget(limits.bytes_per_s), Budget(limits.decoding_s_per_s)
        self._notes: deque[dict[str, Any]] = deque(maxlen=MAX_NOTES)
        self._step: StepOutput | None = None
        self._changed = asyncio.Event()
        self._dropped: dict[str, int] = {}

    async def _talk(self) -> None:
        opened, rate_hz = await self._greet()
        if opened is None:
            return
        talking = [self._receive(opened, rate_hz), self._send()]
        if rate_hz > 0.0:
            talking.append(self._tick(opened, rate_hz))
        tasks = [asyncio.create_task(one) for one in talking]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            self._hub.close(opened)
            for result in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(result, Exception) and not isinstance(result, GONE):
                    self._hub.trouble["connection"] = f"{type(result).__name__}: {result}"

    def leave(self, code: str, sentence: str) -> None:
        """End the connection with an error, from outside."""
        self._end = (TRY_AGAIN_LATER, sentence[:120])
        self._note(code, sentence, fatal=True)

    async def _greet(self) -> tuple[OpenSession | None, float]:
        """Wait for a hello and answer it; None where none came in time or it was refused for good."""
        limits = self._hub.limits
        latest_s = asyncio.get_running_loop().time() + limits.hello_s
        while True:
            try:
                async with asyncio.timeout_at(latest_s):
                    message = await self._received()
                if len(message) > LARGE:
                    raise WireError(
                        "too-large", f"the first message has {len(message)} bytes, {LARGE} are accepted"
                    )
                hello = read_hello(decode(message))
                opened = await self._hub.open(hello, self.leave)
                break
            except WireError as error:
                final = error.code == "closing"
                await self._write(self._error(error.code, str(error), fatal=final))
                if final:
                    self._end = (POLICY, error.code)
                    return None, 0.0
                await asyncio.sleep(PAUSE_S)
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
        n_taken = 0
        while True:
            try:
                message = await self._received()
                now_s = opened.received_s = monotonic()
                self._hub.metrics.messages.inc()
                n_taken += 1
                if n_taken % TURN == 0:
                    await asyncio.sleep(0)
                if not await self._within(message, now_s):
                    continue
                content = await self._decoded(message)
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

    async def _within(self, message: str | bytes, now_s: float) -> bool:
        """Say whether a message is within the budgets; one that is not is dropped, undecoded.

        A robot that owes bytes or decoding is not read until it owes none: what it sends waits at its end.
        """
        limits = self._hub.limits
        owed_s = self._bytes.owe(len(message), now_s)
        if not self._messages.take(1, now_s):
            self._drop(f"{limits.messages_per_s:g} messages")
        elif owed_s:
            self._drop(f"{limits.bytes_per_s:g} bytes")
        elif owed_s := self._decoding.owe(0.0, now_s):
            self._drop(f"{limits.decoding_s_per_s:g} s of decoding")
        else:
            return True
        await asyncio.sleep(owed_s)
        return False

    async def _decoded(self, message: str | bytes) -> dict[str, Any]:
        most = self._hub.limits.message_bytes
        if len(message) > most:
            raise WireError("too-large", f"the message has {len(message)} bytes, {most} are accepted")
        begun_s = perf_counter()
        try:
            return decode(message) if len(message) <= LARGE else await asyncio.to_thread(decode, message)
        finally:
            self._decoding.owe(perf_counter() - begun_s, monotonic())

    def _take(self, opened: OpenSession, content: dict[str, Any], now_s: float) -> None:
        """Take the samples of a message; what is refused of it is named in one error, the rest is used."""
        chain, streams = opened.chain, content.get("streams")
        given = streams.values() if isinstance(streams, dict) else ()
        n_rows = sum(
            len(one[0]) for one in given if isinstance(one, list) and one and isinstance(one[0], list)
        )
        if not self._rows.take(n_rows, now_s):
            most = self._hub.limits.rows_per_s
            raise WireError("too-fast", f"more than {most:g} rows a second: this message is dropped")
        before = chain.inbox.refused.copy()
        self._hub.metrics.rows.inc(chain.put(streams, content.get("twist"), now_s))
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
        self._step = opened.last = output
        self._changed.set()

    async def _send(self) -> None:
        """Send what is there, first the notes, then the newest step; end with a fatal note."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            try:
                while self._notes:
                    note = self._notes.popleft()
                    await self._write(note)
                    if note["fatal"]:
                        return
                output, self._step = self._step, None
                if output is not None:
                    await self._write(step_content(output))
            except TimeoutError:
                self._end = (TRY_AGAIN_LATER, "the receiver did not read for too long")
                self._hub.metrics.errors.labels("too-slow").inc()
                return

    def _drop(self, most: str) -> None:
        """Count a message that comes too fast; those of a twentieth of a second are named in one error."""
        if not self._dropped:
            asyncio.get_running_loop().call_later(0.05, self._note_dropped)
        self._dropped[most] = self._dropped.get(most, 0) + 1

    def _note_dropped(self) -> None:
        dropped, self._dropped = self._dropped, {}
        for most, n in dropped.items():
            self._note("too-fast", f"more than {most} a second: dropped {n} of them")

    def _note(self, code: str, sentence: str, *, fatal: bool = False) -> None:
        self._notes.append(self._error(code, sentence, fatal=fatal))
        self._changed.set()


class Watcher(Line):
    """A page: it is sent the newest step of one robot, ten times a second.

    It says ``{"type": "watch", "session": ...}`` at any time; without a session it is sent the first one.
    """

    _session = ""

    async def _talk(self) -> None:
        if self._hub.watchers >= MAX_WATCHERS:
            self._end = (TRY_AGAIN_LATER, f"{MAX_WATCHERS} pages are open, no more are accepted")
            return
        self._hub.watchers += 1
        tasks = [asyncio.create_task(self._listen()), asyncio.create_task(self._show())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._hub.watchers -= 1
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _listen(self) -> None:
        while True:
            message = await self._received()
            with suppress(WireError):
                if len(message) <= LONGEST_WATCH:
                    self._session = str(decode(message).get("session", ""))
            await asyncio.sleep(0.1)

    async def _show(self) -> None:
        while True:
            async with asyncio.timeout(WATCH_SLOW_S):
                await self._socket.send_text(str(encode(shown(self._hub, self._session))))
            await asyncio.sleep(1.0 / WATCH_HZ)


def shown(hub: Hub, session: str) -> dict[str, Any]:
    """Return what a page shows of a session, of the first one where it is not there."""
    opened = hub.sessions.get(session) or next(iter(hub.sessions.values()), None)
    content: dict[str, Any] = {
        "type": "state",
        "sessions": list(hub.sessions),
        "served": served_content(hub.served),
        "trouble": list(hub.trouble.values()),
        "session": None,
    }
    if opened is not None:
        robot = hub.robot(opened.chain.request.robot)
        content["session"] = {
            "name": opened.name,
            "robot": opened.chain.request.robot,
            "control": opened.chain.request.control,
            "wheels": [] if robot is None else list(robot.wheels),
            "recording": opened.chain.recording,
            "dropped": opened.chain.dropped,
            "step": None if opened.last is None else step_content(opened.last),
        }
    return content
