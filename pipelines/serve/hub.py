"""All that is served: model and table, the robots' sessions, and what outlives them."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from pipelines.live.classifying import ClassifierThread
from pipelines.live.model import LiveModel
from pipelines.live.recording import RecordingThread
from pipelines.live.session import Hello, RobotSession, Served
from pipelines.live.state import LiveState, load_state, save_state
from pipelines.serve.metrics import Metrics
from pipelines.serve.wire import WireError
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError, DataError, LogError, TerrainError
from terrain.robots import Robot, robot_named

REMEMBERED = 1000
"""States of robots that have left, which are kept in memory for their return."""

SILENT_S = 2.0
"""A connection that has sent nothing for so long gives up its session to one that asks for it."""


class Limits(NamedTuple):
    """How much is accepted.

    Parameters
    ----------
    sessions : open at once
    message_bytes : of one message
    messages_per_s, rows_per_s, bytes_per_s : of one session
    decoding_s_per_s : time that decoding the messages of one session takes
    hello_s : to say hello
    too_slow_s : for which a receiver may not read
    """

    sessions: int = 64
    message_bytes: int = 262_144
    messages_per_s: float = 2000.0
    rows_per_s: float = 20_000.0
    bytes_per_s: float = 2_000_000.0
    decoding_s_per_s: float = 0.1
    hello_s: float = 10.0
    too_slow_s: float = 5.0

    @property
    def per_s(self) -> dict[str, float]:
        """What one session may spend a second, by what it is called."""
        budgets = {"messages": self.messages_per_s, "rows": self.rows_per_s, "bytes": self.bytes_per_s}
        return budgets | {"s of decoding": self.decoding_s_per_s}


LIMITS = Limits()


class Hub:
    """Sessions of robots on one model and table.

    Parameters
    ----------
    served : at first
    given : a robot's description that the package does not have, or has otherwise
    limits : of sessions and messages
    states : folder of the states that outlive the service; None for memory only
    recordings : folder of the files of sessions that ask to be recorded; None for no recording

    Attributes
    ----------
    changing : held while a session begins, and while model or table are replaced
    trouble : what is not as it should be, by what it is of
    """

    def __init__(
        self,
        served: Served,
        given: Robot | None = None,
        limits: Limits = LIMITS,
        states: Path | None = None,
        recordings: Path | None = None,
    ) -> None:
        self.served, self.limits, self.metrics = served, limits, Metrics()
        self.metrics.served.set(served.number)
        self.sessions: dict[str, RobotSession] = {}
        self.changing = asyncio.Lock()
        self.closing = False
        self.trouble: dict[str, str] = {}
        self._given, self._folder = given, states
        self._thread = ClassifierThread()
        self._recording = None if recordings is None else (recordings, RecordingThread())
        self._left: OrderedDict[str, LiveState] = OrderedDict()

    def robot(self, name: str) -> Robot | None:
        """Return the description of a robot by its name, never by a path; None where it has none."""
        try:
            return robot_named(name, self._given)
        except ConfigError:
            return None

    async def open(self, hello: Hello, leave: Callable[[str, str], None]) -> RobotSession:
        """Begin a session.

        Parameters
        ----------
        hello : of the robot
        leave : called with a code and a sentence where the connection has to end

        Raises
        ------
        WireError
            if the session cannot be served, or there is one of that name already.
        """
        async with self.changing:
            if self.closing:
                raise WireError("closing", "the service ends")
            before = self.sessions.get(hello.session)
            if before is not None and monotonic() - before.received_s > SILENT_S:
                before.leave("name-taken", "another connection took the session, as this one was silent")
                self.close(before)
            elif before is not None:
                raise WireError("name-taken", f"a session {hello.session!r} is open already")
            if len(self.sessions) >= self.limits.sessions:
                raise WireError("too-many", f"{self.limits.sessions} sessions are open, no more are accepted")
            try:
                opened = await asyncio.to_thread(self._begin, hello, leave)
                if hello.record and self._recording is not None:
                    opened.record(*self._recording)
            except (ConfigError, DataError, LogError) as error:
                raise WireError("refused", str(error)) from None
            self.sessions[hello.session] = opened
        self.metrics.opened.inc()
        self.metrics.sessions.set(len(self.sessions))
        return opened

    def _begin(self, hello: Hello, leave: Callable[[str, str], None]) -> RobotSession:
        opened = RobotSession(hello, self.served, self.robot(hello.robot), self._thread, leave)
        state = self._left.get(hello.session)
        if state is None and self._folder is not None:
            try:
                state = load_state(self._folder / f"{hello.session}.json")
            except DataError as error:  # a damaged state is none
                self.trouble[f"state of {hello.session}"] = str(error)
        if state is not None:
            opened.restore(state)
        return opened

    def close(self, opened: RobotSession) -> None:
        """End a session; its state is kept for the robot's return."""
        name = opened.hello.session
        if self.sessions.get(name) is not opened:
            return
        del self.sessions[name]
        opened.end()
        self.metrics.sessions.set(len(self.sessions))
        self._left[name] = opened.state()
        self._left.move_to_end(name)
        while len(self._left) > REMEMBERED:
            self._left.popitem(last=False)

    def content(self, session: str) -> dict[str, Any]:
        """Return what a page shows of a session, of the first one where it is not there."""
        opened = self.sessions.get(session) or next(iter(self.sessions.values()), None)
        shown = None
        if opened is not None:
            robot = self.robot(opened.hello.robot)
            shown = opened.content() | {
                "wheels": () if robot is None else robot.wheels,
                "step": None if opened.last is None else opened.last.content(),
            }
        return {
            "sessions": list(self.sessions),
            "served": self.served.content(),
            "trouble": list(self.trouble.values()),
            "session": shown,
        }

    def swap(self, model: LiveModel | None, model_name: str, table: SlipTable) -> Served:
        """Serve another model and table: all sessions at once, or none; called with ``changing`` held.

        Raises
        ------
        ConfigError, DataError
            if they do not suit a session, which the sentence names; nothing has changed then.
        """
        served = Served(self.served.number + 1, model, model_name, table)
        for name, opened in self.sessions.items():
            try:
                opened.check(served)
            except (ConfigError, DataError) as error:
                raise DataError(f"session {name!r}: {error}") from None
        for opened in self.sessions.values():
            opened.swap(served)
        self.served = served
        self.metrics.served.set(served.number)
        return served

    def states(self) -> dict[str, LiveState]:
        """Return the states of all robots that are or were connected."""
        return {**self._left, **{name: opened.state() for name, opened in self.sessions.items()}}

    def save_states(self, states: dict[str, LiveState]) -> None:
        """Write states to the folder, if there is one; one that cannot be written is named in ``trouble``."""
        if self._folder is None:
            return
        failed = ""
        for name, state in states.items():
            try:
                save_state(self._folder / f"{name}.json", state)
            except TerrainError as error:
                failed = str(error)
        if failed:
            self.trouble["states"] = failed
        else:
            self.trouble.pop("states", None)

    def stop(self) -> None:
        """End the threads; recordings are written."""
        self._thread.stop()
        if self._recording is not None:
            self._recording[1].stop()
