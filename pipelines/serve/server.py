"""``terrain serve``: all that is checked before a robot may come, then the server until it has to end."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import uvicorn

from pipelines.live.classifying import AtOnce, classify_window
from pipelines.live.over_time import filtered
from pipelines.live.pilot import LivePilot
from pipelines.live.session import Served
from pipelines.live.terrain_source import Classifier
from pipelines.models.model_files import TerrainModel
from pipelines.models.resolve import load_model
from pipelines.serve.app import make_app
from pipelines.serve.guard import check_token, is_loopback
from pipelines.serve.hub import Hub, Limits
from pipelines.serve.protocol import HttpProtocol, SocketProtocol
from pipelines.serve.results import ServiceCheck
from pipelines.serve.settings import ServeSettings
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError, TerrainError
from terrain.estimation.live.estimator import CHANNELS
from terrain.files.atomic import ensure_writable
from terrain.records import Reading, Sample, Windows
from terrain.robots import Robot, load_robot

SAVE_EVERY_S = 5.0
LARGEST_MESSAGE = 4_194_304
"""Bytes of a message that is not even read: the connection is closed (code 1009)."""

PING_S = 10.0
WARM_STEPS = 30

LEAVING_STEPS = 350
"""Hundredths of a second that robots have to read that the service ends."""

CLOSING_STEPS = 60
"""Twentieths of a second for their answers."""


class Prepared(NamedTuple):
    """A service that is ready to listen."""

    hub: Hub
    listening: socket.socket
    token: str
    url: str
    load: Callable[[str], TerrainModel]


def prepare(settings: ServeSettings) -> Prepared:
    """Load, check and warm up what is served, and take the port.

    Raises
    ------
    TerrainError
        in one sentence, if anything does not fit: model, table, robot, token, folder, port.
    """
    token = _token(settings)
    check_token(settings.host, token)
    robot = None if settings.robot is None else load_robot(settings.robot)
    table = load_slip_table(settings.table, None if robot is None else robot.name)
    for folder in (settings.state, settings.record):
        if folder is not None:
            ensure_writable(folder)
            folder.mkdir(parents=True, exist_ok=True)
    listening = _listen(settings.host, settings.port)
    load = partial(_load, filter_stride_s=settings.filter_stride_s)
    try:
        model = load(settings.model)
        served = Served(1, model, settings.model, table)
        if robot is not None:
            check_fit(model, robot)
        limits = Limits(sessions=settings.max_sessions)
        hub = Hub(served, robot, limits, settings.state, settings.record)
        try:
            warm_up(model, robot)
        except BaseException:
            hub.stop()
            raise
    except BaseException:
        listening.close()
        raise
    host, port = listening.getsockname()[:2]
    return Prepared(hub, listening, token, f"http://{f'[{host}]' if ':' in host else host}:{port}", load)


def _load(name: str, filter_stride_s: float | None) -> TerrainModel:
    return filtered(load_model(name), filter_stride_s)


def checked(prepared: Prepared, robot: str | None) -> ServiceCheck:
    """Return what a prepared service would serve, and give its port back."""
    prepared.listening.close()
    prepared.hub.stop()
    served = prepared.hub.served
    assert served.model is not None  # prepare() loads one
    info = served.model.info
    return ServiceCheck(
        served.model_name,
        info.classes,
        info.channels,
        info.rate_hz,
        info.filter,
        info.robots,
        served.table.name,
        robot,
    )


class Service:
    """A prepared service, from its first robot to its end.

    Parameters
    ----------
    prepared : by :func:`prepare`
    """

    def __init__(self, prepared: Prepared) -> None:
        self._prepared, hub = prepared, prepared.hub
        loopback = is_loopback(prepared.listening.getsockname()[0])
        config = uvicorn.Config(
            make_app(hub, prepared.token, prepared.load, loopback=loopback),
            log_level="critical",
            access_log=False,
            lifespan="off",
            http=HttpProtocol,
            ws=SocketProtocol,
            ws_max_size=LARGEST_MESSAGE,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=5,
            server_header=False,
        )
        self._server = _Server(config, hub)

    def run(self, announce: Callable[[str], None]) -> None:
        """Serve until SIGTERM or Ctrl-C: the robots get a message then, and their states are saved.

        Parameters
        ----------
        announce : called with the address once robots can come
        """
        gc.collect()
        gc.freeze()  # what is loaded now stays: no collection has to look at it
        try:
            asyncio.run(self._run(announce))
        finally:
            self._prepared.hub.stop()
            self._prepared.listening.close()

    def stop(self) -> None:
        """End in order, from another thread."""
        self._server.handle_exit(signal.SIGTERM, None)

    async def _run(self, announce: Callable[[str], None]) -> None:
        hub, server = self._prepared.hub, self._server
        server.loop = asyncio.get_running_loop()
        # few threads for what takes long: each has memory of its own that is not given back
        server.loop.set_default_executor(ThreadPoolExecutor(max_workers=2))

        async def save() -> None:
            while True:
                await asyncio.sleep(SAVE_EVERY_S)
                await asyncio.to_thread(hub.save_states, hub.states())

        async def tell() -> None:
            while not server.started:
                await asyncio.sleep(0.005)
            announce(self._prepared.url)

        tasks = [asyncio.create_task(save()), asyncio.create_task(tell())]
        try:
            await server.serve(sockets=[self._prepared.listening])
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            hub.save_states(hub.states())


class _Server(uvicorn.Server):
    """A server that tells the robots before it ends."""

    loop: asyncio.AbstractEventLoop

    def __init__(self, config: uvicorn.Config, hub: Hub) -> None:
        super().__init__(config)
        self._hub = hub
        self._ending: asyncio.Task[None] | None = None

    def handle_exit(self, sig: int, frame: Any) -> None:
        """End in order at the first signal, at once at the second."""
        if self._hub.closing:
            super().handle_exit(sig, frame)
            return
        self._hub.closing = True

        def begin() -> None:
            self._ending = self.loop.create_task(self._end())

        self.loop.call_soon_threadsafe(begin)

    async def _end(self) -> None:
        for opened in list(self._hub.sessions.values()):
            opened.leave("closing", "the service ends")
        for _ in range(LEAVING_STEPS):
            if not self._hub.sessions:
                break
            await asyncio.sleep(0.01)
        for _ in range(CLOSING_STEPS):  # ended at once, what was sent last would be lost
            await asyncio.sleep(0.05)
            if not any(getattr(one, "close_sent", False) for one in self.server_state.connections):
                break
        self.should_exit = True


def check_fit(model: TerrainModel, robot: Robot) -> None:
    """Refuse a model that cannot classify a robot's windows.

    Raises
    ------
    DataError
        if it needs channels that neither the robot's sensors nor its filter give.
    """
    if robot.drive == "swerve":
        Classifier(model, robot)
    elif model.info.robots and robot.name not in model.info.robots:
        raise DataError(
            f"the model was trained on runs of {', '.join(model.info.robots)}, not of {robot.name}"
        )


def warm_up(model: TerrainModel, robot: Robot | None) -> None:
    """Run all code once, so that the first robot does not wait for it."""
    rng = np.random.default_rng(0)
    layout, rule = model.layout, model.rule
    values = {
        stream: rng.normal(size=(1, len(names), layout.n_samples(stream, rule.length_s)))
        for stream, names in layout.channels.items()
    }
    nothing = np.array([""], dtype=object)
    window = Windows(values, layout.channels, layout.rate_hz, rule.length_s, np.zeros(1), nothing, nothing)
    classify_window(model, window)
    if robot is None or robot.drive != "swerve":
        return
    try:
        pilot = LivePilot(robot, source=Classifier(model, robot, AtOnce()))
    except (ConfigError, DataError):
        return
    for k in range(WARM_STEPS):
        time_s = np.array([0.02 * k])
        readings = {
            stream: Reading(time_s, rng.normal(size=(1, len(names)))) for stream, names in CHANNELS.items()
        }
        pilot.step(Sample(0.02 * k, np.array([0.5, 0.0, 0.0]), readings))


def _token(settings: ServeSettings) -> str:
    if settings.token_file is None:
        return os.environ.get("TERRAIN_TOKEN", "").strip()
    try:
        token = Path(settings.token_file).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise ConfigError(f"{settings.token_file}: cannot be read ({reason})") from None
    if not token:
        raise ConfigError(f"{settings.token_file}: holds no token")
    return token


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens; ``TerrainError`` where the address is taken or none of this machine."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listening = socket.socket(family, socket.SOCK_STREAM)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no name of a machine"
        raise ConfigError(f"--host {host[:100]!r}: is no address ({reason})") from None
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(1024)
    except OSError as error:
        listening.close()
        raise TerrainError(f"port {port} of {host} cannot be listened on ({error.strerror})") from None
    return listening
