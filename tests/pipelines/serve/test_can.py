"""Corrections are the controller's or zero: never stale, never not finite, whatever is received or fails."""

import copy
import itertools
import math
import os
import signal
import threading
import time
import uuid
from collections import Counter

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.data.can_frames import SIGNALS, decode, encode, load_layout
from pipelines.live.chain import CommandStatus
from pipelines.live.pilot import LivePilot
from pipelines.serve import can_bus
from pipelines.serve.can_bus import Bridge, Link, open_bus
from pipelines.serve.serve import Settings, run
from terrain.control.robot_control import PERIOD_S, PilotSettings
from terrain.control.slip_table import load_slip_table
from terrain.control.wheel_corrections import BridgeState
from terrain.errors import ConfigError
from terrain.files.names import data_folder
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

from .strangers import until

LAYOUT, ROBOT, TABLE = load_layout(), load_robot("agrimaro"), load_slip_table()
ACTIVE, RESOLUTION_RADPS = BridgeState.ACTIVE, 0.0005


@pytest.fixture(scope="module")
def arc():
    return simulate_run(ROBOT, "grass", "arc", 7, duration_s=8.0)


@pytest.fixture(scope="module")
def frames(run_frames, arc):
    return run_frames(LAYOUT, arc)


def pilot(controller):
    return LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller))


def changed(frame, **fields):
    """Return a copy of a frame with other fields."""
    other = copy.copy(frame)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


class Slower:
    """A chain that commands each wheel 1 rad/s less than the kinematics: corrections are -1, or zero.

    Parameters
    ----------
    changed : is given each step and its number, and returns another
    """

    def __init__(self, changed=lambda step, n: step):
        self._plain, self._changed, self._n = pilot("plain"), changed, 0

    def take(self, sample):
        step, self._n = self._plain.take(sample), self._n + 1
        command = step.command._replace(wheel_radps=step.command.wheel_radps - 1.0)
        return self._changed(step._replace(command=command), self._n)


def bridged(chain=None):
    return Bridge(LAYOUT, ROBOT, chain or Slower())


def ticks(bridge, frames, until_s, read_at=lambda frame: frame.timestamp):
    """Give frames as their time comes; return time, corrections and state of each control step."""
    frames, place, rows = sorted(frames, key=read_at), 0, []
    for k in range(round(until_s / PERIOD_S)):
        tick_s = (k + 1) * PERIOD_S + 1e-6
        while place < len(frames) and read_at(frames[place]) <= tick_s:
            bridge.receive(frames[place], read_at(frames[place]))
            place += 1
        sent = [decode(LAYOUT, frame) for frame in bridge.tick(tick_s)]
        bridge.sent(tick_s)
        added, state = np.array([*sent[0].values.values()]), BridgeState(int(sent[1].values[4]))
        assert np.isfinite(added).all()
        assert sent[0].counter == sent[1].counter == k % 256
        assert state == ACTIVE or not added.any(), "a correction without what it is built on"
        rows.append((tick_s, added, state))
    return rows


def states(rows, start_s, end_s):
    return {state for tick_s, _, state in rows if start_s < tick_s < end_s}


STALE = {
    "twist": (0.2, BridgeState.STALE_TWIST, BridgeState.NO_TWIST),
    "wheels": (0.1, BridgeState.STALE_WHEELS, BridgeState.NO_WHEELS),
    "steering": (0.2, BridgeState.STEERING, BridgeState.STEERING),
}
"""By stream, its longest age, and the states without it: where it was there, and where it never was."""


@pytest.mark.parametrize(
    ("stream", "how", "kind"),
    [
        ("twist", "lost", ""),
        ("twist", "damaged", "wrong checksum"),
        ("wheels", "not measured", ""),
        ("wheels", "damaged", "wrong length"),
        ("steering", "hung", "steering: repeated or late"),
        ("steering", "not measured", ""),
    ],
)
def test_a_stream_that_ends_stops_corrections_in_time_and_one_that_returns_starts_them(
    frames, stream, how, kind
):
    """Also one whose sender repeats its last frame, measures nothing, or sends what its CRC does not fit."""
    ids, last, n_ended = [plan.message.frame_id for plan in LAYOUT.by_stream[stream]], {}, Counter()

    def ended(frame):
        if frame.arbitration_id not in ids or not 2.0 < frame.timestamp < 3.0:
            last[frame.arbitration_id] = frame
            return [frame]
        if how == "hung":
            return [changed(last[frame.arbitration_id], timestamp=frame.timestamp)]
        if how == "not measured":
            n_ended[frame.arbitration_id] += 1
            values = [math.nan] * len(SIGNALS[stream])
            sent = encode(LAYOUT, stream, values, 90 + n_ended[frame.arbitration_id], frame.timestamp)
            return [sent[ids.index(frame.arbitration_id)]]
        if how == "damaged":  # the twist has a CRC
            flipped = bytes([frame.data[0] ^ 0x40, *frame.data[1:]])
            return [changed(frame, data=flipped if stream == "twist" else frame.data[:5])]
        return []

    bridge, (stale_s, stale, never) = bridged(), STALE[stream]
    rows = ticks(bridge, [sent for frame in frames for sent in ended(frame)], 4.0)
    assert states(rows, 1.0, 2.0) == {ACTIVE}
    assert states(rows, 2.0 + stale_s + PERIOD_S, 3.0) == {stale}
    assert states(rows, 3.0 + 2 * PERIOD_S, 4.0) == {ACTIVE}
    active = np.array([added for _, added, each in rows if each == ACTIVE])
    np.testing.assert_allclose(active, -1.0, atol=0.001)
    dropped = bridge.receiver.dropped
    assert dropped[kind] > 40 if kind else not dropped
    without = [frame for frame in frames if frame.arbitration_id not in ids]
    assert states(ticks(bridged(), without, 0.3), 0.05, 0.3) == {never}


@pytest.mark.parametrize("offset_s", [1.7e9, -50.0])
def test_the_clock_of_the_bus_may_be_any_and_one_that_is_set_is_followed(frames, offset_s):
    """An hour ahead and back, as a computer's is by the network: corrections are zero, then go on."""

    def stamped(frame):
        jump_s = 3600.0 * (2.0 < frame.timestamp < 4.5)
        return changed(frame, timestamp=frame.timestamp + offset_s + jump_s)

    sent = [stamped(frame) for frame in frames]
    read = {id(new): frame.timestamp for new, frame in zip(sent, frames, strict=True)}
    bridge = bridged()
    rows = ticks(bridge, sent, 7.0, read_at=lambda frame: read[id(frame)])
    for start_s, end_s in ((0.05, 2.0), (3.2, 4.5), (5.7, 7.0)):
        assert states(rows, start_s, end_s) == {ACTIVE}
    assert np.percentile(bridge.latencies_s, 95) < 0.021


@pytest.mark.parametrize(
    ("radps", "status", "state"),
    [
        (math.nan, CommandStatus.OK, BridgeState.NOT_FINITE),
        (math.inf, CommandStatus.OK, BridgeState.NOT_FINITE),
        (0.0, CommandStatus.NOT_FINITE, BridgeState.NOT_FINITE),
        (0.0, CommandStatus.FAILED, BridgeState.STEP_FAILED),
    ],
)
def test_a_chain_that_fails_leaves_corrections_of_zero(frames, radps, status, state):
    """From its 50th step on."""
    why = "a step failed" if status is CommandStatus.FAILED else ""

    def changed(step, n):
        failed = step.command._replace(wheel_radps=np.array([0.0, radps, 0.0]))
        return step if n < 50 else step._replace(command=failed, status=status, failure=why)

    bridge = bridged(Slower(changed))
    rows = ticks(bridge, frames, 1.5)
    assert (states(rows, 0.05, 0.9), states(rows, 1.1, 1.5)) == ({ACTIVE}, {state})
    assert bool(bridge.receiver.dropped) == bool(why)


SELDOM = st.integers(0, 20).map(lambda n: n == 0)
ANY_FRAME = st.builds(
    can.Message,
    timestamp=st.one_of(st.floats(0.0, 3.0), st.floats()),
    arbitration_id=st.sampled_from(
        [*sorted(plan.message.frame_id for plan in LAYOUT.by_key.values()), 0x7FF]
    ),
    data=st.binary(min_size=0, max_size=9),
    is_extended_id=st.booleans(),
    is_remote_frame=SELDOM,
    is_error_frame=SELDOM,
)


@settings(max_examples=25)
@given(st.lists(ANY_FRAME, max_size=60), st.integers(0, 200))
def test_no_frame_breaks_the_rule(frames, extra, every):
    """Random frames between those of a drive: finite corrections, and zero where the state says so."""
    mixed = [frame for frame in frames if frame.timestamp < 0.6]
    read = {id(frame): frame.timestamp for frame in mixed}
    for k, frame in enumerate(extra):
        read[id(frame)] = (k * 0.01 + every * 0.003) % 0.6
    bridge = bridged()
    assert len(ticks(bridge, [*mixed, *extra], 0.6, read_at=lambda frame: read[id(frame)])) == 30
    assert bridge.frames_in >= bridge.receiver.n_used


class Time:
    """A clock that a test moves."""

    now_s = 100.0

    def __call__(self):
        return self.now_s

    def wait(self, s):
        self.now_s += s


class ScriptedLink:
    """A link in a test's time: gives frames that are due, and sends none while its buffer is full."""

    def __init__(self, clock, full_s=(np.inf, np.inf)):
        self._clock, self._full_s, self.sent, self.n_closed = clock, full_s, [], 0
        rows = {"wheels": [25.0] * 3 + [1.0] * 3, "steering": [0.0] * 3, "twist": [0.5, 0.0, 0.0]}
        self._due = [
            frame
            for number, time_s in enumerate(np.arange(100.0, 104.0, 0.02).tolist())
            for name, row in rows.items()
            for frame in encode(LAYOUT, name, row, number, time_s)
        ]

    def frames(self):
        n = sum(frame.timestamp <= self._clock() for frame in self._due)
        taken, self._due = self._due[:n], self._due[n:]
        return [(frame, frame.timestamp) for frame in taken]

    def send(self, frames):
        if self._full_s[0] <= self._clock() < self._full_s[1]:
            return False
        self.sent += [(self._clock(), frame) for frame in frames]
        return True

    def close(self):
        self.n_closed += 1


def last_state(frame):
    return BridgeState(int(decode(LAYOUT, frame).values[4]))


def test_corrections_are_sent_at_the_rate_never_later_and_zero_in_the_end():
    """What could not be sent is not sent later; steps that come late are left out and counted."""
    clock, bridge = Time(), bridged()
    link = ScriptedLink(clock, full_s=(101.0, 102.0))
    bridge.run(link, 50.0, 3.0, clock, clock.wait)
    sent = [(time_s, frame.data[6]) for time_s, frame in link.sent if frame.arbitration_id == 0x101]
    steps_s, counters = np.diff(sent[:-1], axis=0).T
    assert sorted(counters)[-2:] == [1, 51], "the receiver sees how many are missing"
    np.testing.assert_allclose(steps_s, counters / 50.0, atol=1e-9)
    assert len(sent) == pytest.approx(101, abs=1)
    states = [last_state(frame) for _, frame in link.sent if frame.arbitration_id == 0x102]
    assert (set(states[5:-1]), states[-1]) == ({ACTIVE}, BridgeState.STOPPED)
    assert decode(LAYOUT, link.sent[-2][1]).values == {0: 0.0, 1: 0.0, 2: 0.0}
    assert (link.n_closed, bridge.ticks_missed) == (1, 0)
    clock = Time()
    slow = bridged(Slower(lambda step, n: clock.wait(0.07) or step))
    slow.run(ScriptedLink(clock), 50.0, 2.0, clock, clock.wait)
    assert slow.ticks_missed > 50
    assert slow.states.total() + slow.ticks_missed == pytest.approx(100, abs=3)


class FailingBus(can.BusABC):
    """A bus that gives messages as fast as they are read, until it fails."""

    def __init__(self, given):
        self._given, self.n_shut = list(given), 0
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

    with pytest.raises(ConfigError, match=r"--can is 'nothing'; python-can knows .*socketcan"):
        open_bus("nothing", "can0")
    with pytest.raises(ConfigError, match="the bus socketcan 'no0' cannot be opened"):
        Link(lambda: open_bus("socketcan", "no0"))
    link, bridge = Link(make_bus), bridged()
    assert not link.send([can.Message(arbitration_id=0x101, data=bytes(8), is_extended_id=False)])
    until(lambda: link.errors["receive: Network is down"])
    found = link.frames()
    assert not link.send([]), "a bus that is closed sends nothing"
    for frame, read_s in found:
        bridge.receive(frame, read_s)
    kinds = ("bus off", "error frame", "remote frame", "wrong length", "wrong checksum")
    assert bridge.receiver.dropped == dict.fromkeys(kinds, 1)
    until(lambda: link.frames() == [] and link.errors["open: No such device"])
    gone[0] = False
    until(lambda: link.frames() == [] and len(opened) == 2)
    link.close()
    assert [bus.n_shut for bus in opened] == [1, 1]
    assert link.errors["send: Transmit buffer full"] == 1
    assert link.n_out == 0


def test_on_a_real_virtual_bus_a_wheels_frame_is_answered_within_a_period_beside_a_flood_until_a_signal(
    monkeypatch,
):
    """By the command, which SIGTERM ends as a service manager does: zero corrections, the bus shut down, a report."""
    channel, bridges = f"real-{uuid.uuid4()}", []

    def noted(*given):
        bridges.append(bridged())
        return bridges[-1]

    def drive():
        until(lambda: bridges and bridges[0].steps_s)
        rows = {"wheels": [25.0] * 3 + [1.0] * 3, "steering": [0.0] * 3, "twist": [0.5, 0, 0]}
        for number in range(25):
            for name, row in rows.items():
                for frame in encode(LAYOUT, name, row, number):
                    robot.send(frame)
            for _ in range(50):
                robot.send(can.Message(arbitration_id=0x7FF, data=bytes(8), is_extended_id=False))
            time.sleep(0.02)
        until(lambda: bridges[0].receiver.dropped == {"unknown id": 25 * 50})
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(can_bus, "Bridge", noted)
    with can.Bus(interface="virtual", channel=channel) as robot:
        thread = threading.Thread(target=drive)
        thread.start()
        result = run(Settings(can=f"virtual:{channel}", duration_s=60.0))
        thread.join()
        received = list(iter(lambda: robot.recv(0), None))
    n_steps = sum(result.states.values())
    assert result.states["ACTIVE"] >= 15
    assert len(received) == result.frames_out == 2 * (n_steps + 1)
    assert result.wheels_to_correction["median_ms"] < 30.0
    assert result.duration_s < 30.0
    assert last_state(received[-1]) == BridgeState.STOPPED
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert f"the controller's in {result.states['ACTIVE']} of {n_steps} control steps" in result.report.answer
    assert result.as_json()["states"] == result.states


def test_with_a_pilot_corrections_are_what_it_commands_beyond_plain_kinematics(frames, arc):
    """As the robot adds them to its own kinematics, it drives as it would without CAN."""
    direct, plain = pilot("traction"), pilot("plain")
    expected = [
        direct.take(sample).command.wheel_radps - plain.take(sample).command.wheel_radps
        for sample in itertools.islice(replay(arc), 301)
    ]
    _, added, states = zip(*ticks(bridged(pilot("traction")), frames, 6.0), strict=True)
    np.testing.assert_allclose(added, expected[1:301], atol=RESOLUTION_RADPS)
    assert np.abs(added).max() > 1.0
    assert set(states) == {ACTIVE}


HUSKY = load_robot("husky")
SKIDDING = load_layout(None, HUSKY)


def husky_bridge(controller="traction"):
    return Bridge(SKIDDING, HUSKY, LivePilot(HUSKY, TABLE, settings=PilotSettings(controller=controller)))


def husky_frames(twist=(0.5, 0.0, 0.3), until_s=2.0, rates=(0.4, 0.6)):
    """Frames of a desired twist, and of wheels, gyro and camera of a robot that drives so."""
    found = []
    for k in range(round(until_s / PERIOD_S)):
        time_s = k * PERIOD_S
        sent = {"twist": twist, "wheels": (*rates, math.nan, math.nan)}
        sent |= {"imu": (0.0, 0.0, 0.3, *[math.nan] * 6), "odometry": (0.5, 0.0)}
        for stream, values in sent.items():
            found += encode(SKIDDING, stream, values, k, time_s)
    return found


def sent_at_last(bridge, frames, until_s):
    """What the bridge sent in its last step, by stream."""
    last = []
    for k in range(round(until_s / PERIOD_S)):
        tick_s = (k + 1) * PERIOD_S + 1e-6
        for frame in frames:
            if tick_s - PERIOD_S < frame.timestamp <= tick_s:
                bridge.receive(frame, frame.timestamp)
        last = bridge.tick(tick_s)
    parts = [decode(SKIDDING, frame) for frame in last]
    return {part.stream: list(part.values.values()) for part in parts}


def test_a_skid_steer_robot_is_sent_corrections_of_its_sides_and_the_twist_to_drive():
    plain = sent_at_last(husky_bridge("plain"), husky_frames(), 2.0)
    assert plain["corrections"] == [0.0, 0.0]
    assert plain["command"] == pytest.approx([0.5, 0.0, 0.3])
    assert BridgeState(int(plain["status"][4])) == ACTIVE
    driven = sent_at_last(
        husky_bridge(), husky_frames(rates=(0.3, 0.7)), 2.0
    )  # turns less than its wheels say
    left, right = driven["corrections"]
    assert left < 0.0 < right
    assert driven["command"][2] > 0.31


def test_without_what_it_is_built_on_the_twist_of_a_skid_steer_robot_is_the_desired_one_or_none():
    frames = [frame for frame in husky_frames() if frame.arbitration_id != 0x120]  # no wheels
    sent = sent_at_last(husky_bridge(), frames, 2.0)
    assert (sent["corrections"], BridgeState(int(sent["status"][4]))) == ([0.0, 0.0], BridgeState.NO_WHEELS)
    assert sent["command"] == pytest.approx([0.5, 0.0, 0.3])
    sent = sent_at_last(husky_bridge(), husky_frames(until_s=1.0), 2.0)  # all end
    assert (sent["corrections"], sent["command"]) == ([0.0, 0.0], [0.0, 0.0, 0.0])


def test_a_drive_without_a_packaged_dbc_needs_its_own():
    with pytest.raises(ConfigError, match="no DBC of drive 'omni' is packaged, give one with --dbc"):
        load_layout(None, load_robot("robotino"))
    with pytest.raises(ConfigError, match="lacks the signal 'MotorRate1' and 2 more"):
        load_layout(data_folder("can") / "skid_steer.dbc", load_robot("robotino"))
