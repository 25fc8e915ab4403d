"""All that is served: model and table, the robots' sessions, and what outlives them."""

from __future__ import annotations

import asyncio
import hmac
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

from pipelines.learn.model_file import drawn_window
from pipelines.live.classifying import Classifier, classify_window
from pipelines.live.model import TerrainModel
from pipelines.live.pilot import LivePilot
from pipelines.live.recording import RecordingThread
from pipelines.live.session import Hello, RobotSession, Served
from pipelines.serve.metrics import Metrics
from pipelines.serve.serve import Settings, loaded, required_token
from pipelines.serve.wire import WireError
from terrain.control.live_state import LiveState, load_state, to_text
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import TerrainSource
from terrain.discrepancy.watch import read_watched
from terrain.errors import ConfigError, DataError, LogError, TerrainError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Reading, Sample
from terrain.robots import Robot, load_robot, robot_named

WARM_STEPS = 30

WRONG_TOKEN_S = 1.0
"""Before a token that is missing or another is answered: a thousand tries take a quarter of an hour."""

REMEMBERED = 1000  #: States of robots that have left, which are kept in memory for their return
SILENT_S = 2.0  #: A connection that has sent nothing for so long gives up its session to one that asks for it


class Limits(NamedTuple):
    """How much is accepted."""

    sessions: int = 64  #: open at once
    message_bytes: int = 262_144  #: of one message
    #: messages_per_s, rows_per_s, bytes_per_s: of one session
    messages_per_s: float = 2000.0
    rows_per_s: float = 20_000.0
    bytes_per_s: float = 2_000_000.0
    decoding_s_per_s: float = 0.1  #: time that decoding the messages of one session takes
    hello_s: float = 10.0  #: to say hello
    too_slow_s: float = 5.0  #: for which a receiver may not read


class Hub:
    """Sessions of robots on one model and table, all of it loaded and checked, and its code run once.

    Parameters
    ----------
    settings : what is served, and to whom

    Attributes
    ----------
    served : model and table
    sessions : by their names
    limits : of sessions and messages
    changing : held while a session begins, and while model or table are replaced
    closing : whether the service ends
    trouble : what is not as it should be, by what it is of

    Raises
    ------
    TerrainError
        in one sentence, if anything does not fit: model, table, robot, token, folder.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.model is None and settings.watch is None and settings.robot is None:
            raise ConfigError(
                "--model is missing: models:/NAME@champion, models:/NAME/3, or a model folder (without one --robot is "
                "given commands, and --watch compares)"
            )
        self._watched = None if settings.watch is None else read_watched(settings.watch)
        self.settings, self._token = settings, required_token(settings)
        self._given = None if settings.robot is None else load_robot(settings.robot)
        table = load_slip_table(settings.table, None if self._given is None else self._given.name)
        for folder in (settings.state, settings.record):
            if folder is not None:
                ensure_writable(folder)
                folder.mkdir(parents=True, exist_ok=True)
        model = loaded(settings, settings.model)
        if model is not None:
            warm_up(model, self._given)
        self.served = Served(1, model, settings.model or "", table)
        self.limits, self.metrics = Limits(sessions=settings.max_sessions), Metrics()
        self.metrics.served.set(1)
        self.sessions: dict[str, RobotSession] = {}
        self.changing = asyncio.Lock()
        self.closing = False
        self.trouble: dict[str, str] = {}
        self._left: OrderedDict[str, LiveState] = OrderedDict()
        self._recorder = None if settings.record is None else RecordingThread()
        self._thread = ThreadPoolExecutor(1, "classifier")

    def admits(self, token: str) -> bool:
        """Say whether a token is the required one, in a time that does not tell how much of it is right."""
        required = self._token.encode()
        return not required or hmac.compare_digest(required, token.encode("utf-8", "replace"))

    async def wrong_token(self) -> None:
        """Count a token that is missing or another, and let who gave it wait."""
        self.metrics.wrong_tokens.inc()
        await asyncio.sleep(WRONG_TOKEN_S)

    def robot(self, name: str) -> Robot | None:
        """Return the description of a robot by its name, never by a path; None where it has none."""
        try:
            given = self._given
            if self._watched is not None and (given is None or given.name != name):
                given = self._watched.robot
            return robot_named(name, given)
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
                if hello.record and self._recorder is not None and self.settings.record is not None:
                    opened.record(self.settings.record, self._recorder)
            except (ConfigError, DataError, LogError) as error:
                raise WireError("refused", str(error)) from None
            self.sessions[hello.session] = opened
        self.metrics.opened.inc()
        self.metrics.sessions.set(len(self.sessions))
        return opened

    def _begin(self, hello: Hello, leave: Callable[[str, str], None]) -> RobotSession:
        about = hello, self.served, self.robot(hello.robot), self._thread, leave
        opened = RobotSession(*about, self._watched, self.settings.false_alarm_h)
        state = self._left.get(hello.session)
        if state is None and self.settings.state is not None:
            try:
                state = load_state(self.settings.state / f"{hello.session}.json")
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
        for trouble in (f"late samples of {name}", f"watch of {name}"):
            self.trouble.pop(trouble, None)
        self.metrics.forget(name)
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
            "trouble": [
                sentence
                for of, sentence in self.trouble.items()
                if opened is None or of != f"watch of {opened.hello.session}"  # the robot shows it
            ],
            "session": shown,
        }

    async def replace_model(self, name: str) -> Served:
        """Serve another model, as :meth:`swap` does."""
        model = await asyncio.to_thread(loaded, self.settings, name)
        async with self.changing:
            return self.swap(model, name, self.served.table)

    async def replace_table(self, text: str) -> Served:
        """Serve another table of target slips, given as its YAML, as :meth:`swap` does."""
        table = await asyncio.to_thread(load_slip_table, "the table", text=text)
        async with self.changing:
            return self.swap(self.served.model, self.served.model_name, table)

    def swap(self, model: TerrainModel | None, model_name: str, table: SlipTable) -> Served:
        """Serve another model and table: all sessions at once, or none; called with ``changing`` held.

        Raises
        ------
        ConfigError, DataError
            if they do not suit a session, which the sentence names; nothing has changed then.
        """
        served = Served(self.served.number + 1, model, model_name, table)
        for name, opened in self.sessions.items():
            try:
                opened.chain.check(model, table)
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
        if self.settings.state is None:
            return
        failed: dict[str, str] = {}
        for name, state in states.items():
            try:
                atomic_write(self.settings.state / f"{name}.json", to_text(state))
            except TerrainError as error:
                failed["states"] = str(error)
        self.trouble.pop("states", None)
        self.trouble.update(failed)

    def stop(self) -> None:
        """End the threads; recordings are written."""
        self._thread.shutdown(cancel_futures=True)
        if self._recorder is not None:
            self._recorder.stop()


def warm_up(model: TerrainModel, robot: Robot | None) -> None:
    """Run all code once, so that the first robot does not wait for it.

    Raises
    ------
    DataError
        if the model cannot classify the robot's windows: it needs channels that neither the robot's sensors nor
        its filter give, or was trained on other robots.
    """
    classify_window(model, drawn_window(model.info))
    if robot is None:
        return
    source, rng, channels = TerrainSource(), np.random.default_rng(0), sensor_channels(robot)
    if robot.drive == "swerve":
        source = Classifier(model, robot)
    elif model.info.robots and robot.name not in model.info.robots:
        trained = ", ".join(model.info.robots)
        raise DataError(f"the model was trained on runs of {trained}, not of {robot.name}")
    with suppress(ConfigError, DataError):  # a section is missing
        pilot = LivePilot(robot, source=source, channels=channels)
        for time_s in 0.02 * np.arange(WARM_STEPS):
            readings = {
                stream: Reading(np.array([time_s]), rng.normal(size=(1, len(names))))
                for stream, names in channels.items()
            }
            pilot.step(Sample(time_s, np.array([0.5, 0.0, 0.0]), readings))
