"""Serve terrain, target slips and commands to robots, live.

Robots connect to a WebSocket service and send samples as they come; with ``--can`` the live chain runs on a CAN
bus instead, with ``--replay`` over a log.
"""

from __future__ import annotations

import ipaddress
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import model_validator

from pipelines.data.settings import ReadSettings
from pipelines.learn.settings import TrustSettings
from pipelines.report.numbers import enumerated, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Pairs, Report, sections
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.live.model import TerrainModel

EXAMPLE = "terrain serve --model models:/field@champion --robot agrimaro --state states/"

RESULTS = ("pipelines.serve.can_bus", "pipelines.serve.replay")
"""Modes beside the service, each with a result and a report of its own."""

SHORTEST_TOKEN = 16  #: Characters; a shorter one can be tried out

LONGEST_TOKEN = 512


class ServedSettings(TrustSettings):
    """What is served."""

    model: str | None = setting(None)
    """models:/NAME@champion, models:/NAME/3, or a folder; without one terrain is unknown (--robot, --watch)."""
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(None, option="--filter-stride")
    """Windows so far apart in s (0.25), filtered over time; as trained otherwise."""
    adapt: Literal["", "start", "spread", "none"] = setting("")
    """start: the first 20 s of each session adapt the model to it; spread: probabilities hold any session; none: as
    trained; by default start where training shows that it helps."""
    adapt_terrain: str = setting("", "The terrain that each start is on, where it is known.")
    robot: str | None = setting(None)
    """Robot by name, or its YAML file: its description is used for robots of its name."""
    watch: Path | None = setting(None)
    """extended.yaml of terrain explain: alarms where that robot departs from it (service and --replay)."""
    false_alarm_h: float = setting(100.0, option="--false-alarm", gt=0.0, le=1e6)
    """Hours of driving in which one false alarm of --watch is expected."""
    rate_hz: float = setting(50.0, option="--rate", ge=1.0, le=1000.0)
    """Steps a second of the live chain on a bus or over a log."""


def loaded(settings: ServedSettings, name: str | None) -> TerrainModel | None:
    """Return a model by its name, filtered over time where the settings have it so; None without a name."""
    if name is None:
        return None
    from pipelines.live.model import with_start
    from pipelines.live.windows import filtered

    model = filtered(settings.read_model(name), settings.filter_stride_s)
    return with_start(model, settings.adapt, settings.adapt_terrain)


class ServiceSettings(BaseSettings):
    """The WebSocket service: where it listens, to whom, and how much is accepted."""

    host: str = setting("127.0.0.1", "Address to listen on; a token is required for others than loopback.")
    port: int = setting(8765, "Port to listen on; 0 for a free one.", ge=0, le=65535)
    token_file: Path | None = setting(None)
    """File with the token that is required; TERRAIN_TOKEN holds it otherwise."""
    max_sessions: int = setting(64, "Robots at once.", ge=1, le=10_000)
    state: Path | None = setting(None, "Folder of what outlives a restart: biases and terrain of each robot.")
    record: Path | None = setting(None, "Folder of the recordings of sessions that ask for it.")
    check: bool = setting(False, "Load and check all of it, take the port, and end.")


class CanSettings(BaseSettings):
    """A CAN bus in place of the WebSocket service."""

    can: str | None = setting(None)
    """Bus as INTERFACE:CHANNEL of python-can, as socketcan:can0; can0 alone is of socketcan."""
    bitrate: int | None = setting(None, "Bit rate in bit/s, of interfaces that set it; not socketcan.", gt=0)
    dbc: Path | None = setting(None, "DBC with the signals of docs/can.md; AgriMaRo's by default.")
    controller: Literal["traction", "thesis"] = setting("traction", "traction, or thesis: PID on each wheel.")
    duration_s: float | None = setting(None, option="--duration", ge=0.0)
    """Stops after so many s; by default when it is interrupted."""


class ReplaySettings(ReadSettings):
    """A log in place of robots."""

    replay: Path | None = setting(None)
    """Log, in any layout that convert reads, that is sent through the live chain."""
    speed: float | None = setting(None, gt=0.0, allow_inf_nan=False)
    """Times the log's own speed, as 1 or 4; by default as fast as it goes."""


class Settings(ReplaySettings, CanSettings, ServiceSettings, ServedSettings):
    """Settings of ``terrain serve``."""

    @model_validator(mode="after")
    def _check_mode(self) -> Self:
        """Refuse options of another mode than the one that is asked for."""
        modes: dict[str, type[BaseSettings]] = {"--can": CanSettings, "--replay": ReplaySettings}
        asked = [option for option in modes if getattr(self, option.removeprefix("--")) is not None]
        if len(asked) > 1:
            raise ValueError(f"{' and '.join(asked)} are two modes: one of them is accepted")
        mode = asked[0] if asked else "the WebSocket service"
        modes["the WebSocket service"] = ServiceSettings
        self.refuse_others(mode, modes, "is an option of {of}, not of {mode}")
        if self.watch is not None and self.can is not None:
            raise ConfigError("--watch is an option of the WebSocket service and of --replay, not of --can")
        if self.adapt_terrain and self.adapt != "start":
            raise ConfigError("--adapt-terrain is the terrain of each start: --adapt start is required")
        return self


@contextmanager
def stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Call a function at Ctrl-C or SIGTERM in place of ending at once, for modes that end with a summary.

    An interrupt that is raised while a kernel is compiled is lost there; a call is not.
    """
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)}
    for name in before:
        signal.signal(name, lambda *_: stop())
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)


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


def required_token(settings: ServiceSettings) -> str:
    """Return the token that a file or ``TERRAIN_TOKEN`` holds; empty for none.

    Raises
    ------
    ConfigError
        if it cannot be read, is too short or too long, or is missing where other machines are listened to.
    """
    file = settings.token_file
    try:
        held = os.environ.get("TERRAIN_TOKEN", "") if file is None else file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise ConfigError(f"{file}: cannot be read ({reason})") from None
    token = held.strip()
    if file is not None and not token:
        raise ConfigError(f"{file}: holds no token")
    if token and not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN:
        raise ConfigError(
            f"the token has {len(token)} characters, {SHORTEST_TOKEN} to {LONGEST_TOKEN} are accepted "
            "(python -c 'import secrets; print(secrets.token_urlsafe())' makes one)"
        )
    if not token and not is_loopback(settings.host):
        raise ConfigError(
            f"--host {settings.host} is reached from other machines: a token is required (--token-file)"
        )
    return token


NO_MODEL = SimpleNamespace(classes=(), channels={}, rate_hz={}, filter="", robots=())


class ServiceResult(Result):
    """What a service serves, and what it did until its end."""

    model: str = described("as it was named")
    classes: tuple[str, ...] = described("terrains that the model knows")
    channels: Mapping[str, tuple[str, ...]] = described("channels that the model needs, by stream")
    rate_hz: Mapping[str, float] = described("rate of each stream in its windows", "Hz")
    filter: str = described("filter whose estimates it uses; empty for none")
    robots: tuple[str, ...] = described("robots whose runs it was trained on")
    table: str = described("table of target slips")
    robot: str | None = described("robot that model and table were checked against")
    watch: str | None = described("extended robot that robots of its name are compared with", default=None)
    served: Mapping[str, int] | None = described(
        "sessions, messages, rows, steps, errors and wrong tokens until its end; null with --check",
        default=None,
    )

    @property
    def served_with(self) -> str:
        """What robots are served with: a model, an extended robot, or commands alone."""
        return self.model or self.watch or f"commands of {self.robot}"


def run(settings: Settings, progress: Progress = silent) -> Result:
    """Serve until it is ended; with ``--check`` only find out whether it could."""
    on_bus, over_log = RESULTS
    if settings.can is not None or settings.replay is not None:
        mode: Any = import_module(on_bus if settings.can is not None else over_log)
        result: Result = mode.run(settings, progress)
        return result
    service = import_module("pipelines.serve.service").Service(settings)
    served = service.hub.served
    info = NO_MODEL if served.model is None else served.model.info
    about = {"model": served.model_name, "table": served.table.name}
    result = ServiceResult.of(
        info, settings, **about, watch=None if settings.watch is None else str(settings.watch)
    )
    if settings.check:
        service.close()
        return result
    service.run(lambda url: print(f"serving {result.served_with} at {url}", flush=True))
    return replace(result, served=service.hub.metrics.totals())


def report(result: ServiceResult) -> Report:
    """Return what a service serves, and what it did until its end."""
    about = ("classes", "table", "robots", "robot", "filter") if result.model else ("watch", "table", "robot")
    parts = [Pairs(result.pairs(*about))]
    needs = [
        (f"{stream}, {result.rate_hz[stream]:g} Hz", enumerated(names))
        for stream, names in result.channels.items()
    ]
    options = f"--watch {result.watch}" if result.watch else f"--robot {result.robot}"
    answer = f"Robots can be compared with {result.watch}."
    if result.model:
        options, answer = (
            f"--model {result.model}",
            f"{result.model} can be served: {enumerated(result.classes)}.",
        )
    elif not result.watch:
        answer = f"{result.robot} can be given commands; without a model its terrain is unknown."
    next_step = f"terrain serve {options}"
    if (done := result.served) is not None:
        answer = f"{plural(done['sessions'], 'session')} of robots served with {result.served_with}."
        next_step = "terrain convert RECORDINGS --out RUNS"
        parts.insert(0, Pairs([(name.replace("_", " "), n) for name, n in done.items()]))
    details = sections(("Channels that the model needs", [Pairs(needs)] if needs else []))
    return Report("Service", answer, parts=parts, details=details, next_step=next_step)
