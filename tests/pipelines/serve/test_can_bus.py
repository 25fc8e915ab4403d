"""The bridge on a bus: its ticks, its stop, a bus that fails, and the loop that a robot closes over it."""

import os
import signal
import threading
import time
import uuid
from collections import Counter

import can
import numpy as np
import pytest

from pipelines.data.can_codec import Frame, decode, encode, frame_of, load_layout
from pipelines.live.pilot import LivePilot
from pipelines.serve.can_bridge import BridgeCore, BridgeState
from pipelines.serve.can_bus import Bridge, Link, open_bus
from pipelines.serve.serve import Settings, run
from terrain.control.drive_metrics import drive_history, slip_peak
from terrain.control.pilot_settings import PilotSettings
from terrain.control.situations import SituationOptions, make_situation
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError
from terrain.records import Command
from terrain.robots import load_robot
from terrain.simulation.dynamic.simulate import simulate

LAYOUT, ROBOT, TABLE = load_layout(), load_robot("agrimaro"), load_slip_table()
RESOLUTION_RADPS = 0.0005


class Time:
    """A clock that a test moves."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s

    def wait(self, s):
        self.now_s += s


class ScriptedLink:
    """A link in a test's time: gives frames that are due, and sends none while its buffer is full."""

    def __init__(self, clock, frames=(), full_s=(np.inf, np.inf)):
        self._clock, self._due, self._full_s = clock, sorted(frames, key=lambda f: f.time_s), full_s
        self.sent, self.n_closed = [], 0

    def frames(self):
        n = sum(frame.time_s <= self._clock() for frame in self._due)
        taken, self._due = self._due[:n], self._due[n:]
        return [(frame, frame.time_s) for frame in taken]

    def send(self, frames):
        if self._full_s[0] <= self._clock() < self._full_s[1]:
            return False
        self.sent += [(self._clock(), frame) for frame in frames]
        return True

    def close(self):
        self.n_closed += 1


def drive(start_s, end_s):
    """Frames of a robot that drives straight on."""
    rows = {"wheels": [25.0] * 3 + [1.0] * 3, "steering": [0.0] * 3, "twist": [0.5, 0.0, 0.0]}
    return [
        frame
        for number, time_s in enumerate(np.arange(start_s, end_s, 0.02).tolist())
        for name, row in rows.items()
        for frame in encode(LAYOUT, name, row, number, time_s)
    ]


def message(frame, time_s=0.0):
    return can.Message(
        arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False, timestamp=time_s
    )


def slower(steer_rad):
    return lambda sample: Command(
        np.full(3, 2.5 if sample.twist.any() else 0.0) - 1.0, steer_rad, sample.twist, {}
    )


def last_state(frame):
    return BridgeState(int(decode(LAYOUT, frame).values[4]))


def until(holds, timeout_s=5.0):
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s, "it did not become true"
        time.sleep(0.005)


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 100.0])
def test_corrections_are_sent_at_the_rate_and_zero_in_the_end(rate_hz):
    clock = Time()
    link, core = ScriptedLink(clock, drive(100.0, 104.0)), BridgeCore(LAYOUT, ROBOT, slower)
    bridge = Bridge(core, link, rate_hz, clock, clock.wait)
    bridge.run(3.0)
    times = [time_s for time_s, sent in link.sent if sent.arbitration_id == 0x101]
    np.testing.assert_allclose(np.diff(times[:-1]), 1.0 / rate_hz, atol=1e-9)
    assert len(times) - 1 == pytest.approx(3.0 * rate_hz, abs=1)
    states = [last_state(sent) for _, sent in link.sent if sent.arbitration_id == 0x102]
    assert set(states[5:-1]) == {BridgeState.ACTIVE}
    assert states[-1] == BridgeState.STOPPED
    assert decode(LAYOUT, link.sent[-2][1]).values == (0.0, 0.0, 0.0)
    assert (link.n_closed, bridge.ticks_missed) == (1, 0)


def test_what_could_not_be_sent_is_not_sent_later():
    clock = Time()
    link = ScriptedLink(clock, drive(100.0, 104.0), full_s=(101.0, 102.0))
    Bridge(BridgeCore(LAYOUT, ROBOT, slower), link, 50.0, clock, clock.wait).run(3.0)
    counters = [sent.data[6] for _, sent in link.sent if sent.arbitration_id == 0x101]
    assert max(np.diff(counters)) == 51, "the receiver sees how many are missing"


def test_control_steps_that_are_late_are_left_out_and_counted():
    clock = Time()
    core = BridgeCore(LAYOUT, ROBOT, lambda steer: lambda sample: clock.wait(0.07) or slower(steer)(sample))
    bridge = Bridge(core, ScriptedLink(clock, drive(100.0, 103.0)), 50.0, clock, clock.wait)
    bridge.run(2.0)
    assert bridge.ticks_missed > 50
    assert sum(core.states.values()) + bridge.ticks_missed == pytest.approx(100, abs=3)


class FailingBus(can.BusABC):
    """A bus that gives messages as fast as they are read, until it fails."""

    def __init__(self, given):
        self._given, self.sent, self.n_shut = list(given), [], 0
        super().__init__(channel="failing")

    def _recv_internal(self, timeout):
        if not self._given:
            raise can.CanOperationError("Network is down")
        return self._given.pop(0), True

    def send(self, message, timeout=None):
        assert timeout == 0, "a command that waits is stale"
        raise can.CanOperationError("Transmit buffer full")

    def shutdown(self):
        self.n_shut += 1
        super().shutdown()


def test_a_bus_that_fails_is_opened_again_and_what_it_refuses_is_counted(monkeypatch):
    monkeypatch.setattr("pipelines.serve.can_bus.REOPEN_S", 0.1)
    odd = [
        can.Message(is_error_frame=True, arbitration_id=0x40),
        can.Message(is_error_frame=True, arbitration_id=0x4),
        can.Message(is_remote_frame=True, arbitration_id=0x120, is_extended_id=False),
        can.Message(arbitration_id=0x120, data=bytes(3), is_extended_id=False),
        can.Message(arbitration_id=0x101, data=bytes(8), is_extended_id=False),
    ]
    opened, gone = [], [True]

    def make_bus():
        if opened and gone[0]:
            raise OSError("No such device")
        opened.append(FailingBus(odd if not opened else []))
        return opened[-1]

    link, core = Link(make_bus), BridgeCore(LAYOUT, ROBOT, slower)
    assert not link.send([Frame(0.0, 0x101, bytes(8))])
    until(lambda: link.errors["receive: Network is down"])
    found = link.frames()
    assert not link.send([]), "a bus that is closed sends nothing"
    for frame, read_s in found:
        core.receive(frame, read_s)
    kinds = ("bus off", "error frame", "remote frame", "wrong length", "wrong checksum")
    assert core.receiver.dropped == dict.fromkeys(kinds, 1)
    until(lambda: link.frames() == [] and link.errors["open: No such device"])
    gone[0] = False
    until(lambda: link.frames() == [] and len(opened) == 2)
    link.close()
    assert [bus.n_shut for bus in opened] == [1, 1]
    assert link.errors["send: Transmit buffer full"] == 1
    assert link.n_out == 0


def test_on_a_real_virtual_bus_a_wheels_frame_is_answered_within_a_period_beside_a_flood():
    channel = f"real-{uuid.uuid4()}"
    core = BridgeCore(LAYOUT, ROBOT, slower)
    link = Link(lambda: open_bus("virtual", channel))
    with can.Bus(interface="virtual", channel=channel) as robot:
        thread = threading.Thread(target=Bridge(core, link, 50.0).run, args=(0.6,))
        thread.start()
        for number in range(25):
            for name, row in (
                ("wheels", [25.0] * 3 + [1.0] * 3),
                ("steering", [0.0] * 3),
                ("twist", [0.5, 0, 0]),
            ):
                for frame in encode(LAYOUT, name, row, number):
                    robot.send(message(frame))
            for _ in range(50):
                robot.send(can.Message(arbitration_id=0x7FF, data=bytes(8), is_extended_id=False))
            time.sleep(0.02)
        thread.join()
        received = list(iter(lambda: robot.recv(0), None))
    assert core.states["ACTIVE"] >= 15
    assert len(received) == link.n_out == 2 * (sum(core.states.values()) + 1)
    assert np.median(core.latencies_s) < 0.03
    assert core.receiver.dropped == {"unknown id": 25 * 50}


def test_a_signal_ends_it_in_order():
    """SIGTERM, as a service manager sends it: zero corrections, the bus shut down, the report."""
    channel = f"term-{uuid.uuid4()}"
    with can.Bus(interface="virtual", channel=channel) as robot:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
        result = run(Settings(can=f"virtual:{channel}", duration_s=20.0))
        received = list(iter(lambda: robot.recv(0), None))
    assert result.duration_s < 5.0
    assert result.frames_out == len(received)
    assert last_state(frame_of(received[-1])) == BridgeState.STOPPED
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    n_steps = sum(result.states.values())
    assert result.report.answer.startswith(
        f"Corrections were the controller's in 0 of {n_steps} control steps"
    )
    assert result.as_json()["states"] == {"NO_TWIST": n_steps}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"can": "nothing:no0"}, "python-can knows"),
        ({"can": "no0"}, "the bus socketcan 'no0' cannot be opened"),
        ({"can": "virtual:x", "robot": "husky"}, "robot husky: drive 'skid_steer' has no pilot"),
        ({"can": "virtual:x", "dbc": "none.dbc"}, "none.dbc"),
    ],
)
def test_what_cannot_be_driven_is_one_sentence(options, sentence):
    with pytest.raises(ConfigError, match=sentence) as raised:
        run(Settings(**options, duration_s=0.1))
    assert "\n" not in str(raised.value)


class RobotSide:
    """The Teensy: sends samples and the desired twist, adds corrections to its own kinematics."""

    def __init__(self, as_sent):
        self._as_sent = as_sent
        channel = f"loop-{uuid.uuid4()}"
        self.bus = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
        self.other = can.Bus(interface="virtual", channel=channel)
        self.core = BridgeCore(LAYOUT, ROBOT, pilot_step("traction"))
        self._kinematics = LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="plain"))
        self._counters = Counter()
        self.added, self.states = [], []

    def _send(self, name, row, time_s):
        for frame in encode(LAYOUT, name, self._as_sent(name, row), self._counters[name]):
            self.bus.send(message(frame, float(time_s)))
        self._counters[name] += 1

    def step(self, sample):
        for name, reading in sample.readings.items():
            for time_s, row in zip(reading.time_s, reading.values, strict=True):
                self._send(name, row, time_s)
        self._send("twist", sample.twist, sample.time_s)
        while (received := self.other.recv(0)) is not None:
            self.core.receive(frame_of(received), sample.time_s)
        for frame in self.core.tick(sample.time_s):
            self.other.send(message(frame))
        theory = self._kinematics.step(sample)
        added, status = (decode(LAYOUT, frame_of(self.bus.recv(0))).values for _ in range(2))
        self.added.append(added)
        self.states.append(int(status[4]))
        return Command(theory.wheel_radps + np.array(added), theory.steer_rad, theory.twist, {})


def pilot_step(controller):
    return lambda steer_rad: (
        LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller), steer_rad=steer_rad).step
    )


def driven(controller):
    """A start that is commanded as a step, on grass."""
    where = make_situation("straight", ROBOT, "grass", 3, SituationOptions(accel_mps2=np.inf, duration_s=8.0))
    given, options = (ROBOT, where.scenario, where.soils, where.seed), {"conditions": where.conditions}
    found = simulate(*given, **options, controller=controller, command_delay_s=0.04)
    return found, slip_peak(drive_history(found, ROBOT, where.conditions.radius_factors))


def test_the_loop_over_can_drives_as_the_one_without(as_sent):
    """Slip of a start is limited as without CAN, and the commands differ by little more than roundings."""
    direct, direct_peak = driven(pilot_step("traction")(np.zeros(3)))
    _, plain_peak = driven(pilot_step("plain")(np.zeros(3)))
    side = RobotSide(as_sent)
    with side.bus, side.other:
        over_can, peak = driven(side.step)
    assert peak == pytest.approx(direct_peak, abs=0.002)
    assert peak < 0.5 * plain_peak
    for wheel in (f"wheel_{i}_radps" for i in (1, 2, 3)):
        apart = over_can.streams["commands"].channel(wheel) - direct.streams["commands"].channel(wheel)
        assert np.abs(apart).max() < 10 * RESOLUTION_RADPS
        assert np.sqrt(np.mean(apart**2)) < 2 * RESOLUTION_RADPS
    assert np.abs(side.added).max() > 0.5
    assert set(side.states) == {0}
    assert not side.core.receiver.dropped
