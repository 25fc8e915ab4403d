"""A robot's WebSocket: messages in and steps out.

Where a token is required, nothing is decoded before it has fitted: it comes in the header of the handshake, or
as the first frame by itself.  Before its hello a robot is given one answer at a time, and what it
sends is not decoded where it is larger than any hello.  What a session may send is a budget: of messages,
rows and bytes, and of the time that decoding them takes.
"""

from __future__ import annotations

import asyncio
import math
import sys
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic, perf_counter, thread_time
from typing import Any

from fastapi import WebSocket
from pydantic import ValidationError
from starlette.websockets import WebSocketDisconnect, WebSocketState

from pipelines.live.chain import CommandStatus, Step
from pipelines.live.session import Hello, RobotSession
from pipelines.serve.guard import bearer
from pipelines.serve.hub import Hub
from pipelines.serve.serve import LONGEST_TOKEN
from pipelines.serve.wire import WireError, decode, encode
from terrain.discrepancy.watch import Watch
from terrain.estimation.clocks import number
from terrain.files.documents import first_fault

MAX_NOTES = 1000  #: Answers to messages that wait to be read; of more, the oldest are left out
TURN = 16  #: Messages of one robot in a row; then the others have their turn
LARGE = 32_768  #: Bytes of a message that is decoded in a thread; no hello is as large
PAUSE_S = 0.5  #: Before the next message of a robot is read whose hello was not accepted
TRY_AGAIN_LATER, POLICY = 1013, 1008  #: Codes of closed WebSockets (RFC 6455)

NO_TOKEN = "a token is required, or it is another"

BUDGETS = {
    "messages": "messages_per_s",
    "rows": "rows_per_s",
    "bytes": "bytes_per_s",
    "s of decoding": "decoding_s_per_s",
}
"""What one session may spend a second, by what it is called; each is one of the hub's limits."""

GONE = (WebSocketDisconnect, RuntimeError, OSError)
"""What is raised where the other end has left, in the middle of anything; ``TimeoutError`` is among them."""


class Budgets:
    """So much a second of each thing, and a second's worth at once; what is spent beyond that is owed.

    Examples
    --------
    >>> budgets = Budgets({"rows": 10.0, "bytes": 1000.0})
    >>> budgets.spend(10.0, rows=15, bytes=100)
    >>> budgets.owed(10.0), budgets.owed(10.5)
    ((0.5, '10 rows'), (0.0, '10 rows'))
    """

    def __init__(self, per_s: Mapping[str, float]) -> None:
        self._per_s = per_s
        self._paid_s = dict.fromkeys(per_s, -math.inf)  # when nothing is owed any more

    def spend(self, now_s: float, **spent: float) -> None:
        """Note what has been spent by a time."""
        for name, n in spent.items():
            self._paid_s[name] = max(self._paid_s[name], now_s - 1.0) + n / self._per_s[name]

    def owed(self, now_s: float) -> tuple[float, str]:
        """Return the time in s until nothing is owed, and of what most is, as ``10 rows``."""
        name = max(self._paid_s, key=self._paid_s.__getitem__)
        return max(self._paid_s[name] - now_s, 0.0), f"{self._per_s[name]:g} {name}"


class Connection:
    """One robot's connection, from its handshake to its end: messages in, steps out, each at its own time.

    Parameters
    ----------
    socket : not accepted yet
    hub : of the sessions
    """

    _session: RobotSession

    def __init__(self, socket: WebSocket, hub: Hub) -> None:
        self._socket, self._hub = socket, hub
        self._packed = False
        self._end: tuple[int, str] = (1000, "")
        limits = hub.limits._asdict()
        self._limits = {name: limits[name] for name in limits if name != "sessions"}
        self._budgets = Budgets({words: limits[name] for words, name in BUDGETS.items()})
        self._notes: deque[dict[str, Any]] = deque(maxlen=MAX_NOTES)
        self._step: Step | None = None
        self._changed = asyncio.Event()
        self._dropped: Counter[str] = Counter()

    async def serve(self) -> None:
        """Talk until the other end leaves or has to; nothing is raised."""
        try:
            await self._socket.accept()
            if await self._admitted() and await self._greeted():
                await self._talk()
        except GONE:
            pass
        finally:
            if self._socket.client_state is not WebSocketState.DISCONNECTED:
                with suppress(*GONE):
                    async with asyncio.timeout(1.0):
                        await self._socket.close(*self._end)

    async def _admitted(self) -> bool:
        """Say whether the token is the required one: that of the header, or the first frame, undecoded."""
        if self._hub.admits(bearer(self._socket.headers)):
            return True
        first: str | bytes = ""
        with suppress(TimeoutError):
            async with asyncio.timeout(self._hub.limits.hello_s):
                first = await self._received()
        if isinstance(first, str) and len(first) <= LONGEST_TOKEN and self._hub.admits(first):
            return True
        await self._hub.wrong_token()
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
            await self._socket.send({"type": "websocket.send", "bytes" if self._packed else "text": message})

    def _error(self, code: str, sentence: str, *, fatal: bool = False) -> dict[str, Any]:
        """Count an error and return its message; after a fatal one the connection is closed."""
        self._hub.metrics.errors.labels(code).inc()
        return {"type": "error", "code": code, "message": sentence, "fatal": fatal}

    def leave(self, code: str, sentence: str) -> None:
        """End the connection with an error, from outside."""
        self._end = (TRY_AGAIN_LATER, sentence[:120])
        self._note(code, sentence, fatal=True)

    async def _greeted(self) -> bool:
        """Wait for a hello and begin its session; say whether one came in time and was not refused for good."""
        latest_s = asyncio.get_running_loop().time() + self._hub.limits.hello_s
        while True:
            try:
                async with asyncio.timeout_at(latest_s):
                    message = await self._received()
                if len(message) > LARGE:
                    raise WireError(
                        "too-large", f"the first message has {len(message)} bytes, {LARGE} are accepted"
                    )
                self._session = await self._hub.open(_hello_of(decode(message)), self.leave)
                return True
            except WireError as error:
                final = error.code == "closing"
                await self._write(self._error(error.code, str(error), fatal=final))
                if final:
                    self._end = (POLICY, error.code)
                    return False
                await asyncio.sleep(PAUSE_S)
            except TimeoutError:
                self._end = (POLICY, "no hello came in time")
                return False

    async def _talk(self) -> None:
        """Receive, step and send at once; each of them ends all by what it raises."""
        try:
            await self._write(self._session.welcome() | {"limits": self._limits})
            async with asyncio.TaskGroup() as talking:
                talking.create_task(self._receive())
                talking.create_task(self._send())
                if self._session.hello.rate_hz > 0.0:
                    talking.create_task(self._tick(1.0 / self._session.hello.rate_hz))
        except* GONE:
            pass
        except* Exception as errors:
            error = errors.exceptions[0]
            self._hub.trouble["connection"] = f"{type(error).__name__}: {error}"
        finally:
            self._hub.close(self._session)

    async def _receive(self) -> None:
        """Take messages until one is a goodbye; a robot that owes is not read until it owes nothing."""
        n_taken = 0
        while True:
            try:
                message = await self._received()
                now_s = self._session.received_s = monotonic()
                self._hub.metrics.messages.inc()
                n_taken += 1
                if n_taken % TURN == 0:
                    await asyncio.sleep(0)
                owed_s, most = self._budgets.owed(now_s)
                if owed_s > 0.0:
                    if not self._dropped:  # those of a twentieth of a second are named in one error
                        asyncio.get_running_loop().call_later(0.05, self._note_dropped)
                    self._dropped[most] += 1
                    await asyncio.sleep(owed_s)
                    continue
                content = await self._decode(message)
                kind = str(content.get("type"))
                if kind == "bye":
                    raise WebSocketDisconnect
                if kind != "samples":
                    raise WireError("unknown-type", f"there is no message of the type {kind[:40]!r}")
                self._take(content, now_s)
                if self._session.hello.rate_hz == 0.0 and content.get("step") is True:
                    time_s = number(content.get("time_s"))
                    self._run(time_s if math.isfinite(time_s) else None)
            except WireError as error:
                self._note(error.code, str(error))

    async def _decode(self, message: str | bytes) -> dict[str, Any]:
        most = self._hub.limits.message_bytes
        self._budgets.spend(monotonic(), messages=1, bytes=len(message))
        if len(message) > most:
            raise WireError("too-large", f"the message has {len(message)} bytes, {most} are accepted")

        def timed() -> dict[str, Any]:
            begun_s = thread_time()  # of decoding alone: what else the machine does is not the robot's fault
            try:
                return decode(message)
            finally:
                self._budgets.spend(monotonic(), **{"s of decoding": thread_time() - begun_s})

        return timed() if len(message) <= LARGE else await asyncio.to_thread(timed)

    def _take(self, content: dict[str, Any], now_s: float) -> None:
        """Take the samples of a message; what is refused of it is named in one error, the rest is used."""
        inbox = self._session.inbox
        before = inbox.refused.copy()
        n_rows = self._session.put(content.get("streams"), content.get("twist"), now_s)
        self._budgets.spend(now_s, rows=n_rows)
        self._hub.metrics.rows.inc(n_rows)
        if refused := inbox.refused - before:
            self._note("malformed", f"samples: {'; '.join(sorted(refused))}")

    async def _tick(self, period_s: float) -> None:
        """Step at the rate that was asked for; ticks that cannot be kept are left out and counted."""
        due_s = monotonic()
        while True:
            due_s += period_s
            wait_s = due_s - monotonic()
            if wait_s < -period_s:
                n = int(-wait_s / period_s)
                self._hub.metrics.late_ticks.inc(n)
                due_s += n * period_s
            await asyncio.sleep(max(wait_s, 0.0))
            self._run()

    def _run(self, time_s: float | None = None) -> None:
        metrics, begun_s = self._hub.metrics, perf_counter()
        output = self._session.step(time_s=time_s)
        metrics.step_s.observe(perf_counter() - begun_s)
        metrics.steps.inc()
        if not math.isnan(output.latency_s):
            metrics.latency_s.observe(output.latency_s)
        if output.status is not CommandStatus.OK:
            metrics.stopped.labels(output.status.value).inc()
        if output.status is CommandStatus.FAILED:
            self._hub.trouble[f"session {self._session.hello.session}"] = output.failure
        # named in the hub's trouble, and in the log once
        name, late = self._session.hello.session, self._session.late
        if late and f"late samples of {name}" not in self._hub.trouble:
            print(f"{name}: {late}", file=sys.stderr, flush=True)
        self._hub.trouble.pop(f"late samples of {name}", None)
        if late:
            self._hub.trouble[f"late samples of {name}"] = late
        key, doubts = f"samples of {name}", "; ".join(self._session.gate.sentences)
        if doubts and doubts != self._hub.trouble.get(key):
            print(f"{name}: {doubts}", file=sys.stderr, flush=True)
        self._hub.trouble.pop(key, None)
        if doubts:
            self._hub.trouble[key] = doubts
        if (watch := self._session.watch) is not None:
            self._report(name, watch)
        for window in output.windows:
            metrics.window_s.observe(window.took_s)
            metrics.windows.labels(window.terrain or "refused").inc()
        if self._step is not None:
            metrics.unsent.inc()
        self._step = output
        self._changed.set()

    def _report(self, name: str, watch: Watch) -> None:
        """Name in the log what a watched robot departs in from now on, or no more, and in trouble what is not over."""
        for sentence in watch.news:
            print(f"{name}: {sentence}", file=sys.stderr, flush=True)
        for alarm in watch.raised:
            self._hub.metrics.alarms.labels(alarm.channel).inc()
        self._hub.metrics.departing.labels(name).set(len(watch.current))
        self._hub.trouble.pop(f"watch of {name}", None)
        if watch.current:
            self._hub.trouble[f"watch of {name}"] = (
                f"{name} {'; '.join([alarm.text for alarm in watch.current])}"
            )

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
                        raise WebSocketDisconnect
                output, self._step = self._step, None
                if output is not None:
                    await self._write(output.content())
            except TimeoutError:
                self._end = (TRY_AGAIN_LATER, "the receiver did not read for too long")
                self._hub.metrics.errors.labels("too-slow").inc()
                raise

    def _note_dropped(self) -> None:
        for most, n in self._dropped.items():
            self._note("too-fast", f"more than {most} a second: dropped {n} of them")
        self._dropped.clear()

    def _note(self, code: str, sentence: str, *, fatal: bool = False) -> None:
        self._notes.append(self._error(code, sentence, fatal=fatal))
        self._changed.set()


def _hello_of(content: dict[str, Any]) -> Hello:
    """Return a hello; the first thing that is not accepted is named in a ``WireError``."""
    if content.get("type") != "hello":
        kind = str(content.get("type"))[:40]
        raise WireError("hello-first", f"the first message is of the type {kind!r}, a hello is required")
    try:
        return Hello.model_validate(content)
    except ValidationError as error:
        raise WireError("malformed", f"hello: {first_fault(error)}"[:300]) from None
