"""``terrain serve --can BUS``: a pilot on a CAN bus, sensors in, corrections of the wheels' speeds out.

Corrections are the controller's only while the desired twist and the wheels' rates are fresh on both clocks, that
of the bus and that of this computer, and the steering is where it was computed
(:mod:`terrain.control.wheel_corrections`).  Nothing that is sent is older than the step that sends it.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.data.can_frames import Layout, Receiver, encode, library, load_layout
from pipelines.live.chain import Chain, CommandStatus
from pipelines.live.session import chain_of
from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import Column, Pairs, Report, Table, sections
from pipelines.serve.serve import Settings, loaded, stopping
from terrain.control.robot_control import PilotSettings, check_pilot, step_or_period
from terrain.control.slip_table import load_slip_table
from terrain.control.wheel_corrections import BridgeState, LowLevelKinematics, corrections, last_samples
from terrain.errors import ConfigError, one_line
from terrain.estimation.clocks import SessionClock
from terrain.records import Array, Sample
from terrain.robots import Robot, load_robot

if TYPE_CHECKING:
    from can import Message as Frame

REOPEN_S = 0.5  #: Between two attempts to open a bus that failed
RECEIVE_S = 0.05  #: For which the thread that reads waits at most, so that it ends soon when it has to

QUEUE = 20_000
"""Frames that wait for a control step: two seconds of a full bus; of more, the oldest are left out."""

MAX_READ = 2000  #: Frames that are taken between two control steps: a flooded bus delays none


KEPT = 100_000  #: Latencies that are kept: half an hour at 50 Hz

_NOT_DECIDED = {
    CommandStatus.NO_SAMPLES: BridgeState.STEERING,
    CommandStatus.NOT_FINITE: BridgeState.NOT_FINITE,
    CommandStatus.FAILED: BridgeState.STEP_FAILED,
}
"""States of commands that no controller has decided on."""


def open_bus(interface: str, channel: str, bitrate: int | None = None) -> Any:
    """Return an open bus of python-can.

    Raises
    ------
    ConfigError
        if there is no such interface, or it cannot be opened.
    """
    can = library("can")
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise ConfigError(f"the interface of --can is {interface!r}; python-can knows {known}")
    options = {} if bitrate is None else {"bitrate": bitrate}
    try:
        return can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except Exception as error:  # each interface has errors of its own, and of the library it loads
        raise ConfigError(f"the bus {interface} {channel!r} cannot be opened ({one_line(error)})") from error


class Link:
    """Frames from and to a bus, read by a notifier of python-can; a bus that fails is opened again.

    No later error of the bus comes through, all are counted.

    Parameters
    ----------
    make_bus : opens the bus; called at once, where its errors come through, and again after an error of it

    Attributes
    ----------
    errors : by message
    n_out : frames sent
    """

    def __init__(self, make_bus: Callable[[], Any]) -> None:
        self._make_bus = make_bus
        self._read: deque[tuple[Frame, float]] = deque(maxlen=QUEUE)
        self.errors: Counter[str] = Counter()
        self.n_out = 0
        self._failed, self._retry_s = threading.Event(), 0.0
        self._notifier: Any = None
        self._open()

    def _open(self) -> None:
        bus = self._make_bus()
        import can

        self._notifier = can.Notifier(bus, [self], timeout=RECEIVE_S)

    def __call__(self, frame: Frame) -> None:
        """Take a frame, in the thread of the notifier."""
        self._read.append((frame, time.monotonic()))

    def on_error(self, error: Exception) -> None:
        """Note that the bus failed, in the thread of the notifier; it is closed by the next :meth:`frames`."""
        if not self._failed.is_set():
            self.errors[f"receive: {one_line(error, 80)}"] += 1
            self._failed.set()
        time.sleep(RECEIVE_S)

    def frames(self) -> list[tuple[Frame, float]]:
        """Return frames that have come, each with the time at which it was read."""
        now_s = time.monotonic()
        if self._failed.is_set():
            self.close()
            self._failed.clear()
            self._retry_s = now_s + REOPEN_S
        if self._notifier is None and now_s >= self._retry_s:
            try:
                self._open()
            except Exception as error:  # each interface has errors of its own
                self.errors[f"open: {one_line(error, 80)}"] += 1
                self._retry_s = now_s + REOPEN_S
        return [self._read.popleft() for _ in range(min(len(self._read), MAX_READ))]

    def send(self, frames: Sequence[Frame]) -> bool:
        """Send frames; those that cannot be sent at once are not sent later. Say whether all were."""
        if self._notifier is None:
            return False
        for frame in frames:
            try:
                self._notifier.bus.send(frame, timeout=0)
            except Exception as error:
                self.errors[f"send: {one_line(error, 80)}"] += 1
                return False
            self.n_out += 1
        return True

    def close(self) -> None:
        """Shut the bus down."""
        notifier, self._notifier = self._notifier, None
        if notifier is not None:
            notifier.stop()
            with contextlib.suppress(Exception):  # a bus that failed may refuse
                notifier.bus.shutdown()


class Bridge:
    """Samples out of frames, a step of the live chain, corrections into frames, at each tick of its own clock.

    Parameters
    ----------
    layout : of the DBC
    robot : whose wheels
    chain : gives the commands; of a swerve robot begins where the steering is measured first

    Attributes
    ----------
    receiver : of the frames; it counts those that are used, and what was not used by kind, steps that failed too
    latencies_s, steps_s : ``wheels_to_correction`` and ``step`` of a :class:`BridgeResult`, each
    frames_in, samples, states, clipped, ticks_missed, duration_s : as it has them
    """

    def __init__(self, layout: Layout, robot: Robot, chain: Chain) -> None:
        self._layout, self._chain = layout, chain
        self.receiver = Receiver(layout, layout.received)
        self._robot, self._zeros_rad = robot, robot.steering_zeros_rad
        self._driven = np.isin(robot.wheels, robot.logged_wheels)
        self._kinematics: LowLevelKinematics | None = None
        self._clock, self._last = SessionClock(), last_samples(robot.drive == "swerve")
        self._before_s, self._counter, self._new_wheels = math.nan, 0, False
        self._stopped = threading.Event()
        self.frames_in = self.ticks_missed = 0
        self.duration_s = 0.0
        self.samples: Counter[str] = Counter()
        self.states: Counter[str] = Counter()
        self.clipped: Counter[str] = Counter()
        self.latencies_s: deque[float] = deque(maxlen=KEPT)
        self.steps_s: deque[float] = deque(maxlen=KEPT)

    def stop(self) -> None:
        """End :meth:`run` at once; a signal handler may call it."""
        self._stopped.set()

    def run(
        self,
        link: Link,
        rate_hz: float,
        duration_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], Any] | None = None,
    ) -> None:
        """Run until stopped, or for a time; then send corrections of zero and shut the bus down.

        Parameters
        ----------
        link : the bus
        rate_hz : of the control steps
        duration_s : None for no end
        clock : time of this computer in s
        wait : waits so many s, or until it is stopped
        """
        period_s, wait = 1.0 / rate_hz, wait or self._stopped.wait
        start_s = due_s = clock()
        end_s = math.inf if duration_s is None else start_s + duration_s
        try:
            while not self._stopped.is_set() and (now_s := clock()) < end_s:
                if now_s < due_s:
                    wait(min(due_s, end_s) - now_s)
                    continue
                for frame, read_s in link.frames():
                    self.receive(frame, read_s)
                began_s = clock()
                frames = self.tick(began_s)
                self.steps_s.append(clock() - began_s)
                if link.send(frames):
                    self.sent(clock())
                due_s += period_s
                late = max(int((clock() - due_s) / period_s), 0)
                self.ticks_missed += late
                due_s += late * period_s
        finally:
            self.duration_s = clock() - start_s
            none = np.zeros(len(self._driven))
            link.send(self._frames(none, np.zeros(3), {}, BridgeState.STOPPED, self._clock.at(clock())))
            link.close()

    def receive(self, frame: Frame, read_s: float) -> None:
        """Take a frame that was read at a time of this computer."""
        self.frames_in += 1
        if self.receiver.take(frame) is not None:
            self._clock.received(frame.timestamp, read_s)

    def tick(self, read_s: float) -> list[Frame]:
        """Return the frames of a control step at a time of this computer."""
        now_s = self._clock.at(read_s)
        readings = self.receiver.readings(now_s)
        self.samples.update({name: len(reading.time_s) for name, reading in readings.items()})
        new = {name: last.take(readings.get(name), read_s) for name, last in self._last.items()}
        self._new_wheels = new["wheels"]
        readings.pop("twist", None)
        sent = self._control(Sample(now_s, np.zeros(3), readings), read_s)
        self._before_s = now_s
        self.states[sent[-1].name] += 1
        return self._frames(*sent, now_s)

    def sent(self, read_s: float) -> None:
        """Note when the frames of the last step were sent."""
        if self._new_wheels:
            self.latencies_s.append(self._clock.at(read_s) - self._last["wheels"].stamp_s)

    def _control(
        self, sample: Sample, read_s: float
    ) -> tuple[Array, Array, Mapping[str, float], BridgeState]:
        """Return corrections, the twist to drive, the controller's status, and the state.

        Where corrections are not the controller's, the twist is the desired one while it is fresh, and 0 else.
        """
        states = {name: last.state(sample.time_s, read_s) for name, last in self._last.items()}
        state = next((each for each in states.values() if each != BridgeState.ACTIVE), BridgeState.ACTIVE)
        none, is_swerve = np.zeros(len(self._driven)), self._robot.drive == "swerve"
        measured_rad = self._last["steering"].values - self._zeros_rad if is_swerve else none
        desired = self._last["twist"].values if states["twist"] == BridgeState.ACTIVE else np.zeros(3)
        if np.isnan(measured_rad).any():  # it never came
            return none, desired, {}, state
        if self._kinematics is None:
            self._kinematics = LowLevelKinematics(self._robot, measured_rad)
        sample = sample._replace(twist=desired)
        wheel_radps = self._kinematics.step(desired, step_or_period(sample.time_s - self._before_s))
        done, steer_rad = self._chain.take(sample), self._kinematics.steer_rad
        assert done.command is not None  # of a chain that drives
        measured_rad = measured_rad if is_swerve else steer_rad
        added, found = corrections(done.command, wheel_radps, steer_rad, measured_rad)
        if done.failure:
            self.receiver.dropped[done.failure[:160]] += 1
        found = _NOT_DECIDED.get(done.status, found)
        if state == BridgeState.ACTIVE or found == BridgeState.STEP_FAILED:
            state = found
        if state != BridgeState.ACTIVE:
            return none, desired, done.command.status, state
        return added, done.command.twist, done.command.status, state

    def _frames(
        self, added: Array, twist: Array, status: Mapping[str, float], state: BridgeState, now_s: float
    ) -> list[Frame]:
        figures = {**status, "bridge_code": float(state)}
        known = {name: v for name, v in figures.items() if v >= 0.0 or not name.endswith("_code")}
        values = [
            known.get(name, math.nan) for name in self._layout.signals["status"]
        ]  # a code below zero is none
        counter, self._counter = self._counter, self._counter + 1
        sent = {"corrections": added[self._driven].tolist(), "command": twist.tolist(), "status": values}
        return [
            frame
            for stream, numbers in sent.items()
            for frame in encode(self._layout, stream, numbers, counter, now_s, self.clipped)
        ]


def latency_of(times_s: Sequence[float]) -> dict[str, float]:
    """Return median and 99th percentile of times; NaN where there are none.

    Examples
    --------
    >>> latency_of([0.001, 0.002, 0.003]), latency_of([])
    ({'median_ms': 2.0, 'p99_ms': 2.98}, {'median_ms': nan, 'p99_ms': nan})
    """
    quantiles_ms = np.percentile(1e3 * np.array(times_s or [math.nan]), [50.0, 99.0])
    return dict(zip(("median_ms", "p99_ms"), quantiles_ms.round(4).tolist(), strict=True))


class BridgeResult(Result):
    """What a bridge did, from its start to its stop."""

    interface: str = described("kind of bus, as python-can names it")
    channel: str = described("channel of the bus")
    dbc: str = described("file of the signals")
    robot: str = described("name of its description")
    duration_s: float = described("from the start to the stop", "s", form=".1f")
    frames_in: int = described("frames received")
    frames_used: int = described("frames of signals that are used")
    frames_out: int = described("frames sent")
    samples: Mapping[str, int] = described("samples by stream")
    dropped: Mapping[str, int] = described("what was not used, by kind")
    bus_errors: Mapping[str, int] = described("errors of the bus by message")
    clipped: Mapping[str, int] = described("values sent as the end of their range, by signal")
    states: Mapping[str, int] = described("control steps by state of the bridge")
    ticks_missed: int = described("control steps left out as one before took too long")
    wheels_to_correction: Mapping[str, float] = described(
        "median and 99th percentile from the first frame of the wheels' newest sample to its answer", "ms"
    )
    step: Mapping[str, float] = described("median and 99th percentile of the time of a control step", "ms")


def run(settings: Settings, progress: Progress = silent) -> BridgeResult:
    """Run a pilot on a bus until it is interrupted, or for the time of the settings."""
    interface, channel = bus_of(settings.can or "")
    robot, table = load_robot(settings.robot or "agrimaro"), load_slip_table(settings.table)
    layout, pilot = load_layout(settings.dbc, robot), PilotSettings(controller=settings.controller)
    check_pilot(robot, table, pilot)
    # of what the DBC has no signal of, nothing is measured
    measured = [name for name in layout.received[:-1] if robot.drive == "swerve" or layout.columns(name)]
    chain = chain_of(
        robot,
        {name: tuple(layout.signals[name]) for name in measured},
        loaded(settings, settings.model),
        table,
        pilot,
        ThreadPoolExecutor(1, "classifier"),
    )
    bridge, link = Bridge(layout, robot, chain), Link(lambda: open_bus(interface, channel, settings.bitrate))
    with stopping(bridge.stop):
        bridge.run(link, settings.rate_hz, settings.duration_s)
    return BridgeResult.of(
        bridge,
        interface=interface,
        channel=channel,
        dbc=layout.name,
        robot=robot.name,
        duration_s=round(bridge.duration_s, 3),
        frames_used=bridge.receiver.n_used,
        frames_out=link.n_out,
        samples=dict(sorted(bridge.samples.items())),
        dropped=dict(sorted(bridge.receiver.dropped.items())),
        bus_errors=dict(sorted(link.errors.items())),
        clipped=dict(sorted(bridge.clipped.items())),
        states=dict(sorted(bridge.states.items())),
        wheels_to_correction=latency_of(bridge.latencies_s),
        step=latency_of(bridge.steps_s),
    )


def bus_of(text: str) -> tuple[str, str]:
    """Return interface and channel of a bus; a channel alone is one of socketcan.

    Examples
    --------
    >>> bus_of("can0"), bus_of("udp_multicast:239.74.163.2"), bus_of("virtual:test")
    (('socketcan', 'can0'), ('udp_multicast', '239.74.163.2'), ('virtual', 'test'))
    """
    interface, colon, channel = text.partition(":")
    return (interface, channel) if colon else ("socketcan", text)


def report(result: BridgeResult) -> Report:
    """Return what a bridge did: frames, states and latencies, then what was not used, by kind."""
    answer = (
        f"Corrections were the controller's in {result.states.get('ACTIVE', 0)} of {sum(result.states.values())} "
        f"control steps, {format_value(result.duration_s, '.1f', 's')} on {result.interface} {result.channel}."
    )
    rows = [
        (kind.replace("_", " "), name, n)
        for kind in ("samples", "dropped", "bus_errors", "clipped", "states")
        for name, n in getattr(result, kind).items()
    ]
    pairs = result.pairs("frames_in", "frames_used", "frames_out", "ticks_missed")
    for name, found in (("wheels to correction", result.wheels_to_correction), ("control step", result.step)):
        span = format_value((found["median_ms"], found["p99_ms"]), ".2f", "ms")
        pairs.append((f"{name}, median to p99", span))
    columns = ("kind", Column("name", long=True), "number")
    return Report(
        "CAN bus",
        answer,
        parts=(Pairs(pairs), Table(columns, rows)) if rows else (Pairs(pairs),),
        details=sections(("Setup", [Pairs(result.pairs("robot", "dbc"))])),
        next_step="terrain serve --can BUS --json FILE",
    )
