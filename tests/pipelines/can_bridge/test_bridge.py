"""The loop on a bus: its ticks, its stop, and what a bus does that fails."""

import os
import signal
import threading
import time
import uuid

import can
import numpy as np
import pytest

from pipelines.can_bridge.bridge import Bridge
from pipelines.can_bridge.bus_clock import WINDOW_S, BusClock
from pipelines.can_bridge.core import BridgeCore
from pipelines.can_bridge.corrections import BridgeState
from pipelines.can_bridge.link import REOPEN_S, Link, open_bus
from pipelines.can_bridge.run import run_can
from pipelines.can_bridge.settings import CanSettings
from pipelines.data.can_codec import Frame, decode, encode, load_layout
from terrain.errors import ConfigError
from terrain.records import Command
from terrain.robots import load_robot

LAYOUT, ROBOT = load_layout(), load_robot("agrimaro")


class Time:
    """A clock that a test moves."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s

    def wait(self, s):
        self.now_s += s


class ScriptedBus:
    """A bus in a test's time: gives messages when they are due, and fails between two times."""

    def __init__(self, clock, messages=(), fails_s=(np.inf, np.inf), full_s=(np.inf, np.inf)):
        self._clock, self._due, self._fails_s, self._full_s = clock, list(messages), fails_s, full_s
        self.sent, self.n_shut = [], 0

    def _check(self, ends_s, text):
        if ends_s[0] <= self._clock() < ends_s[1]:
            raise can.CanOperationError(text)

    def recv(self, timeout):
        self._check(self._fails_s, "Network is down")
        if self._due and self._due[0].timestamp <= self._clock() + timeout:
            message = self._due.pop(0)
            self._clock.now_s = max(self._clock.now_s, message.timestamp)
            return message
        self._clock.now_s += timeout
        return None

    def send(self, message, timeout):
        assert timeout == 0, "a command that waits is stale"
        self._check(self._fails_s, "Network is down")
        self._check(self._full_s, "Transmit buffer full")
        self.sent.append((self._clock(), message))

    def shutdown(self):
        self.n_shut += 1


def message(frame, time_s):
    return can.Message(
        arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False, timestamp=time_s
    )


def drive(start_s, end_s):
    """Messages of a robot that drives straight on."""
    rows = {
        "wheels": [25.0, 25.0, 25.0, 1.0, 1.0, 1.0],
        "steering": [0.0, 0.0, 0.0],
        "twist": [0.5, 0.0, 0.0],
    }
    times = np.arange(start_s, end_s, 0.02)
    return [
        message(frame, float(time_s))
        for number, time_s in enumerate(times)
        for name, row in rows.items()
        for frame in encode(LAYOUT, name, row, number)
    ]


def slower(steer_rad):
    return lambda sample: Command(
        np.full(3, 2.5 if sample.twist.any() else 0.0) - 1.0, steer_rad, sample.twist, {}
    )


def states_of(bus, start_s, end_s):
    found = set()
    for time_s, sent in bus.sent:
        part = decode(LAYOUT, Frame(0.0, sent.arbitration_id, bytes(sent.data)))
        if part.stream == "status" and start_s < time_s < end_s:
            found.add(BridgeState(int(part.values[4])))
    return found


def bridge_on(make_bus, clock, rate_hz=50.0):
    core = BridgeCore(LAYOUT, ROBOT, slower)
    link = Link(make_bus, clock, clock.wait)
    return core, link, Bridge(core, link, rate_hz, clock)


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 100.0])
def test_corrections_are_sent_at_the_rate_and_zero_in_the_end(rate_hz):
    clock = Time()
    bus = ScriptedBus(clock, drive(100.0, 104.0))
    _, link, bridge = bridge_on(lambda: bus, clock, rate_hz)
    bridge.run(3.0)
    times = [time_s for time_s, sent in bus.sent if sent.arbitration_id == 0x101]
    np.testing.assert_allclose(np.diff(times[:-1]), 1.0 / rate_hz, atol=1e-9)
    assert len(times) - 1 == pytest.approx(3.0 * rate_hz, abs=1)
    assert states_of(bus, 100.1, 102.999) == {BridgeState.ACTIVE}
    last = [sent for _, sent in bus.sent[-2:]]
    assert decode(LAYOUT, Frame(0.0, 0x101, bytes(last[0].data))).values == (0.0, 0.0, 0.0)
    assert decode(LAYOUT, Frame(0.0, 0x102, bytes(last[1].data))).values[4] == BridgeState.STOPPED
    assert bus.n_shut == 1
    assert link.n_out == len(bus.sent)
    assert bridge.ticks_missed == 0


def test_a_bus_that_fails_is_opened_again():
    """Gone for 1 s: nothing is sent meanwhile, each failure is counted, and corrections come back."""
    clock, opened = Time(), []

    def make_bus():
        if opened and 101.0 <= clock() < 102.0:
            raise OSError("No such device")
        opened.append(
            ScriptedBus(clock, [m for m in drive(100.0, 106.0) if m.timestamp >= clock()], (101, 102))
        )
        return opened[-1]

    core, link, bridge = bridge_on(make_bus, clock)
    bridge.run(4.0)
    assert len(opened) == 2
    assert [bus.n_shut for bus in opened] == [1, 1]
    assert link.errors["receive: Network is down"] == 1
    assert link.errors["open: No such device"] >= 1
    assert states_of(opened[1], 102.0 + REOPEN_S + 0.1, 103.9) == {BridgeState.ACTIVE}
    assert core.states["STALE_TWIST"] + core.states["STALE_WHEELS"] > 20


def test_a_full_buffer_is_counted_and_what_could_not_be_sent_is_not_sent_later():
    clock = Time()
    bus = ScriptedBus(clock, drive(100.0, 104.0), full_s=(101.0, 102.0))
    _, link, bridge = bridge_on(lambda: bus, clock)
    bridge.run(3.0)
    assert link.errors == {"send: Transmit buffer full": 50}
    assert not [time_s for time_s, _ in bus.sent if 101.0 <= time_s < 102.0]
    counters = [sent.data[6] for _, sent in bus.sent if sent.arbitration_id == 0x101]
    assert max(np.diff(counters)) == 51, "the receiver sees how many are missing"


def test_a_flooded_bus_delays_no_control_step():
    clock = Time()

    class Flooded(ScriptedBus):
        def recv(self, timeout):
            self._clock.now_s += 2e-5
            return can.Message(
                arbitration_id=0x7FF, data=bytes(8), is_extended_id=False, timestamp=self._clock()
            )

    bus = Flooded(clock)
    core, _, bridge = bridge_on(lambda: bus, clock)
    bridge.run(1.0)
    times = [time_s for time_s, sent in bus.sent if sent.arbitration_id == 0x101]
    assert max(np.diff(times)) < 0.09
    assert core.dropped["unknown id"] > 10_000


def test_control_steps_that_are_late_are_left_out_and_counted():
    clock = Time()
    core = BridgeCore(LAYOUT, ROBOT, lambda steer: lambda sample: clock.wait(0.07) or slower(steer)(sample))
    bus = ScriptedBus(clock, drive(100.0, 103.0))
    bridge = Bridge(core, Link(lambda: bus, clock, clock.wait), 50.0, clock)
    bridge.run(2.0)
    assert bridge.ticks_missed > 50
    assert sum(core.states.values()) + bridge.ticks_missed == pytest.approx(100, abs=3)


def test_error_and_remote_frames_are_counted():
    clock = Time()
    odd = [
        can.Message(timestamp=101.0, is_error_frame=True, arbitration_id=0x40),
        can.Message(timestamp=101.0, is_error_frame=True, arbitration_id=0x4),
        can.Message(timestamp=101.0, is_remote_frame=True, arbitration_id=0x120, is_extended_id=False),
        can.Message(timestamp=101.0, arbitration_id=0x120, data=bytes(3), is_extended_id=False),
        can.Message(timestamp=101.0, arbitration_id=0x101, data=bytes(8), is_extended_id=False),
    ]
    bus = ScriptedBus(clock, sorted([*drive(100.0, 103.0), *odd], key=lambda m: m.timestamp))
    core, _, bridge = bridge_on(lambda: bus, clock)
    bridge.run(2.0)
    kinds = ("bus off", "error frame", "remote frame", "wrong length", "wrong checksum")
    assert core.dropped == dict.fromkeys(kinds, 1)


def test_on_a_real_virtual_bus_a_wheels_frame_is_answered_within_a_period():
    channel = f"real-{uuid.uuid4()}"
    settings = CanSettings(interface="virtual", channel=channel, duration_s=0.5)
    core = BridgeCore(LAYOUT, ROBOT, slower)
    bridge = Bridge(core, Link(lambda: open_bus("virtual", channel)), settings.rate_hz)
    with can.Bus(interface="virtual", channel=channel) as robot:
        thread = threading.Thread(target=bridge.run, args=(settings.duration_s,))
        thread.start()
        for number in range(25):
            for name, row in (
                ("wheels", [25.0] * 3 + [1.0] * 3),
                ("steering", [0.0] * 3),
                ("twist", [0.5, 0, 0]),
            ):
                for frame in encode(LAYOUT, name, row, number):
                    robot.send(message(frame, 0.0))
            time.sleep(0.02)
        thread.join()
        received = list(iter(lambda: robot.recv(0), None))
    assert core.states["ACTIVE"] >= 15
    assert len(received) == 2 * (sum(core.states.values()) + 1)
    assert np.median(core.latencies_s) < 0.03
    assert not core.dropped


def test_a_signal_ends_it_in_order():
    """SIGTERM, as a service manager sends it: zero corrections, the bus shut down, the report."""
    channel = f"term-{uuid.uuid4()}"
    with can.Bus(interface="virtual", channel=channel) as robot:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
        report = run_can(CanSettings(interface="virtual", channel=channel, duration_s=20.0))
        received = list(iter(lambda: robot.recv(0), None))
    assert report.duration_s < 5.0
    assert report.frames_out == len(received)
    assert decode(LAYOUT, Frame(0.0, 0x102, bytes(received[-1].data))).values[4] == BridgeState.STOPPED
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_bus_that_cannot_be_opened_is_one_sentence():
    for interface, sentence in (("nothing", "python-can knows"), ("socketcan", "cannot be opened")):
        with pytest.raises(ConfigError, match=sentence) as raised:
            run_can(CanSettings(interface=interface, channel="no0", duration_s=0.1))
        assert "\n" not in str(raised.value)


def test_the_clock_follows_the_drift_of_the_bus():
    """50 ppm over an hour, frames read up to 5 ms late: at no time off by more than 3 ms."""
    clock, rng = BusClock(), np.random.default_rng(0)
    for read_s in np.arange(0.0, 3600.0, 0.05):
        stamp_s = 5000.0 + read_s * (1 - 50e-6)
        clock.received(stamp_s - rng.exponential(0.001), read_s)
        if read_s > WINDOW_S:
            assert abs(clock.time(read_s) - stamp_s) < 3e-3


def test_one_wrong_stamp_sets_no_clock():
    clock = BusClock()
    for k in range(100):
        clock.received(1e9 if k == 50 else 0.01 * k, 0.01 * k)
        assert clock.time(0.01 * k) == pytest.approx(0.01 * k, abs=1e-9)
