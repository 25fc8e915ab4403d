"""Corrections are the controller's or zero: never stale, never not finite, whatever is received."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.data.can_codec import (
    QUATERNION,
    RECEIVED,
    Frame,
    channels_of,
    decode,
    encode,
    load_layout,
)
from pipelines.live.pilot import LivePilot
from pipelines.serve.can_bridge import (
    STALE_S,
    BridgeCore,
    BridgeState,
    LastSample,
    LowLevelKinematics,
    Theory,
    corrections,
)
from terrain.control.pilot_settings import PilotSettings
from terrain.control.slip_table import load_slip_table
from terrain.control.wheel_controllers import PERIOD_S
from terrain.records import Command, Reading, Sample, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

LAYOUT, ROBOT, TABLE = load_layout(), load_robot("agrimaro"), load_slip_table()
ACTIVE = BridgeState.ACTIVE
THEORY = Theory(np.full(3, 5.0), np.full(3, 0.2))


@pytest.fixture(scope="module")
def run():
    return simulate_run(ROBOT, "grass", "arc", 7, duration_s=14.0)


@pytest.fixture(scope="module")
def frames(run, run_frames):
    return [frame for frame in run_frames(LAYOUT, run) if frame.time_s <= 12.0]


def thesis_step(steer_rad):
    """The thesis' PID corrects at every step of a drive."""
    return LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="thesis"), steer_rad=steer_rad).step


class Slower:
    """A controller that commands each wheel 1 rad/s less than the kinematics: corrections are -1, or zero."""

    def __init__(self, steer_rad):
        self._kinematics = LowLevelKinematics(ROBOT)
        self._kinematics.start(steer_rad)
        self._before_s = math.nan

    def __call__(self, sample):
        dt_s = sample.time_s - self._before_s
        theory = self._kinematics.step(sample.twist, dt_s if 0 < dt_s < 0.5 else PERIOD_S)
        self._before_s = sample.time_s
        return Command(theory.wheel_radps - 1.0, theory.steer_rad, sample.twist, {"status_code": 0.0})


def ticks(core, frames, until_s, start_s=0.0, read_at=lambda frame: frame.time_s):
    """Give frames as their time comes; return time, corrections and state of each control step."""
    frames, place, rows = sorted(frames, key=read_at), 0, []
    for k in range(round((until_s - start_s) / PERIOD_S)):
        tick_s = start_s + (k + 1) * PERIOD_S + 1e-6
        while place < len(frames) and read_at(frames[place]) <= tick_s:
            core.receive(frames[place], read_at(frames[place]))
            place += 1
        sent = [decode(LAYOUT, frame) for frame in core.tick(tick_s)]
        core.sent(tick_s)
        added, status = np.array(sent[0].values), sent[1].values
        assert np.isfinite(added).all()
        assert sent[0].counter == sent[1].counter == k % 256
        state = BridgeState(int(status[4]))
        assert state == ACTIVE or not added.any(), "a correction without what it is built on"
        rows.append((tick_s, added, state))
    return rows


def of(stream):
    keys = {plan.message.frame_id for plan in LAYOUT.by_stream[stream]}
    return lambda frame: frame.arbitration_id in keys


def states(rows, start_s, end_s):
    return {state for tick_s, _, state in rows if start_s < tick_s < end_s}


def test_corrections_are_those_of_the_pilot_stepped_directly(frames):
    """On the same samples, rounded by hand, to half a resolution: the bridge adds nothing."""
    core = BridgeCore(LAYOUT, ROBOT, thesis_step)
    rows = ticks(core, frames, 12.0)
    streams = {name: rounded_samples(frames, name) for name in RECEIVED}
    steer_rad = streams["steering"][1][0]
    pilot, plain = (
        thesis_step(steer_rad),
        LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="plain"), steer_rad=steer_rad),
    )
    largest, before_s = 0.0, -1.0
    for tick_s, added, state in rows:
        assert state == ACTIVE
        readings = {}
        for name, (time_s, values) in streams.items():
            here = (time_s > before_s) & (time_s <= tick_s)
            if here.any():
                readings[name] = (time_s[here], values[here])
        twists = streams["twist"]
        twist = twists[1][np.searchsorted(twists[0], tick_s, side="right") - 1]
        readings.pop("twist", None)
        direct = pilot(Sample(tick_s, twist, readings)).wheel_radps
        expected = direct - plain.step(Sample(tick_s, twist, {})).wheel_radps
        np.testing.assert_allclose(added, expected, atol=0.00025 * (1 + 1e-6))
        largest, before_s = max(largest, np.abs(expected).max()), tick_s
    assert largest > 0.2
    assert core.receiver.dropped.total() == 0
    assert not core.clipped


def rounded_samples(frames, name):
    """Times and values of a stream, put together without the assembler."""
    samples = {}
    for frame in filter(of(name), frames):
        part = decode(LAYOUT, frame)
        row = samples.setdefault(frame.time_s, np.full(len(channels_of(name)), np.nan))
        row[list(part.columns)] = part.values
        if name == "odometry":
            row[QUATERNION[3]] = math.sqrt(max(0.0, 1.0 - sum(row[list(QUATERNION[:3])] ** 2)))
    return np.array(list(samples)), np.array(list(samples.values()))


MISSING = [
    ("twist", BridgeState.STALE_TWIST),
    ("wheels", BridgeState.STALE_WHEELS),
    ("steering", BridgeState.STEERING),
]


@pytest.mark.parametrize("how", ["lost", "hung", "not measured", "damaged"])
@pytest.mark.parametrize(("stream", "state"), MISSING)
def test_a_stream_that_ends_stops_corrections_in_time_and_one_that_returns_starts_them(
    frames, stream, state, how
):
    """Also one whose sender repeats its last frame, measures nothing, or sends what its CRC does not fit."""
    ids, last, n_ended = [plan.message.frame_id for plan in LAYOUT.by_stream[stream]], {}, Counter()

    def ended(frame):
        if not of(stream)(frame) or not 3.0 < frame.time_s < 4.0:
            last[frame.arbitration_id] = frame
            return [frame]
        if how == "hung":
            return [last[frame.arbitration_id]._replace(time_s=frame.time_s)]
        if how == "not measured":
            n_ended[frame.arbitration_id] += 1
            values = [math.nan] * len(channels_of(stream))
            sent = encode(LAYOUT, stream, values, 90 + n_ended[frame.arbitration_id], frame.time_s)
            return [sent[ids.index(frame.arbitration_id)]]
        if how == "damaged":  # the twist has a CRC
            flipped = bytes([frame.data[0] ^ 0x40, *frame.data[1:]])
            return [frame._replace(data=flipped if stream == "twist" else frame.data[:5])]
        return []

    core = BridgeCore(LAYOUT, ROBOT, Slower)
    rows = ticks(core, [sent for frame in frames for sent in ended(frame)], 6.0)
    assert states(rows, 1.0, 3.0) == {ACTIVE}
    assert states(rows, 3.0 + STALE_S[stream] + PERIOD_S, 4.0) == {state}
    assert states(rows, 4.0 + 2 * PERIOD_S, 6.0) == {ACTIVE}
    active = np.array([added for _, added, each in rows if each == ACTIVE])
    np.testing.assert_allclose(active, -1.0, atol=0.001)
    kind = {"hung": f"{stream}: repeated or late", "damaged": "wrong length"}.get(how)
    kind = "wrong checksum" if (stream, how) == ("twist", "damaged") else kind
    assert core.receiver.dropped.total() == 0 or core.receiver.dropped[kind] > 40


@pytest.mark.parametrize(("stream", "state"), MISSING)
def test_a_stream_that_never_came_is_named(frames, stream, state):
    never = {"twist": BridgeState.NO_TWIST, "wheels": BridgeState.NO_WHEELS}.get(stream, state)
    rows = ticks(BridgeCore(LAYOUT, ROBOT, Slower), [f for f in frames if not of(stream)(f)], 2.0)
    assert states(rows, 0.05, 2.0) == {never}


@pytest.mark.parametrize(
    ("now_s", "read_s", "fresh"),
    [(5.05, 9.05, True), (5.15, 9.05, False), (5.05, 9.15, False), (4.95, 9.0, True), (4.8, 9.0, False)],
)
def test_a_sample_is_fresh_on_both_clocks_and_not_of_the_future(now_s, read_s, fresh):
    last = LastSample(0.1, 3)
    assert not last.came
    assert not last.is_fresh(5.0, 9.0)
    assert last.take(Reading(np.array([5.0]), np.ones((1, 3))), 9.0, whole=True)
    assert last.is_fresh(now_s, read_s) == fresh


def test_frames_that_were_read_too_late_are_stale(frames):
    """A computer that does not come to read for 0.4 s: what it then reads was measured long ago."""

    def read_at(frame):
        return frame.time_s if frame.time_s < 3.0 else frame.time_s + min(0.4, 4 * (frame.time_s - 3.0))

    rows = ticks(BridgeCore(LAYOUT, ROBOT, Slower), frames, 3.45, read_at=read_at)
    assert states(rows, 3.3, 3.45) & {BridgeState.STALE_WHEELS, BridgeState.STALE_TWIST}
    assert ACTIVE not in states(rows, 3.35, 3.45)


@pytest.mark.parametrize("offset_s", [1.7e9, -50.0])
def test_the_clock_of_the_bus_may_be_any_and_one_that_is_set_is_followed(frames, offset_s):
    """An hour ahead and back, as a computer's is by the network: corrections are zero, then go on."""

    def stamped(frame):
        return frame._replace(time_s=frame.time_s + offset_s + 3600.0 * (3.0 < frame.time_s < 6.0))

    changed = [stamped(frame) for frame in frames]
    read = {id(new): frame.time_s for new, frame in zip(changed, frames, strict=True)}
    core = BridgeCore(LAYOUT, ROBOT, Slower)
    rows = ticks(core, changed, 10.0, read_at=lambda frame: read[id(frame)])
    for start_s, end_s in ((0.05, 3.0), (4.2, 6.0), (7.2, 10.0)):
        assert states(rows, start_s, end_s) == {ACTIVE}
    assert np.percentile(core.latencies_s, 95) < 0.021


def test_steering_elsewhere_than_computed_gets_no_correction(run, run_frames):
    """At 0.6 rad from the command the low-level kinematics commands other rates; half a turn is the same."""
    for turn_rad, state in ((0.0, ACTIVE), (0.6, BridgeState.STEERING), (math.pi, ACTIVE)):
        steering = run.streams["steering"]
        values = steering.values.copy()
        values[steering.time_s > 2.0, 1] += turn_rad
        streams = dict(run.streams) | {"steering": Stream(steering.time_s, values, steering.channels)}
        turned = [f for f in run_frames(LAYOUT, replace(run, streams=streams)) if f.time_s < 3.0]
        rows = ticks(BridgeCore(LAYOUT, ROBOT, Slower), turned, 3.0)
        assert states(rows, 2.1, 3.0) == {state}
        if state == ACTIVE:
            sign = np.array([-1.0, 1.0 if turn_rad else -1.0, -1.0])
            np.testing.assert_allclose(rows[-1][1], sign, atol=0.001)


def broken(kind):
    """A controller that fails after its 100th step."""

    def make(steer_rad):
        good, n = Slower(steer_rad), iter(range(10**6))

        def step(sample):
            command = good(sample)
            if next(n) < 100:
                return command
            if kind == "raises":
                raise ZeroDivisionError("a controller's fault")
            if kind == "none":
                return None
            if kind == "shape":
                return command._replace(wheel_radps=np.zeros(2))
            return command._replace(wheel_radps=np.array([0.0, kind, 0.0]))

        return step

    return make


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        (math.nan, BridgeState.NOT_FINITE),
        (math.inf, BridgeState.NOT_FINITE),
        ("raises", BridgeState.STEP_FAILED),
        ("none", BridgeState.STEP_FAILED),
        ("shape", BridgeState.STEP_FAILED),
    ],
)
def test_a_controller_that_fails_leaves_corrections_of_zero(frames, kind, state):
    core = BridgeCore(LAYOUT, ROBOT, broken(kind))
    rows = ticks(core, frames, 3.0)
    assert states(rows, 0.05, 2.0) == {ACTIVE}
    assert states(rows, 2.1, 3.0) == {state}
    assert bool(core.failed) == (state == BridgeState.STEP_FAILED)


ANY_FRAME = st.builds(
    Frame,
    st.one_of(st.floats(0.0, 3.0), st.floats()),
    st.sampled_from([*sorted(plan.message.frame_id for plan in LAYOUT.by_key.values()), 0x7FF]),
    st.binary(min_size=0, max_size=9),
    st.booleans(),
    st.integers(0, 20).map(lambda n: n == 0),
    st.integers(0, 20).map(lambda n: n == 0),
)


@settings(max_examples=40)
@given(st.lists(ANY_FRAME, max_size=60), st.integers(0, 200))
def test_no_frame_breaks_the_rule(frames, extra, every):
    """Random frames between those of a drive: finite corrections, and zero where the state says so."""
    core = BridgeCore(LAYOUT, ROBOT, Slower)
    mixed = [frame for frame in frames if frame.time_s < 0.6]
    read = {id(frame): frame.time_s for frame in mixed}
    for k, frame in enumerate(extra):
        read[id(frame)] = (k * 0.01 + every * 0.003) % 0.6
    rows = ticks(core, [*mixed, *extra], 0.6, read_at=lambda frame: read[id(frame)])
    assert len(rows) == 30
    assert core.n_in >= core.receiver.n_used


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2, 3])
@pytest.mark.parametrize("measured", [-1, 0, 1, 4])
def test_the_velocity_of_the_wheel_is_the_one_that_is_commanded(turns, measured):
    """Two routes: the correction of the other solution adds up to the same velocity of the wheel's centre."""
    commanded = Command(
        (-1.0) ** turns * np.array([4.0, 5.0, 6.5]), THEORY.steer_rad + turns * np.pi, None, {}
    )
    angle_rad = THEORY.steer_rad + measured * np.pi + 0.1
    added, state = corrections(commanded, THEORY, angle_rad)
    assert state == BridgeState.ACTIVE
    low_level = (-1.0) ** measured * THEORY.wheel_radps
    along = np.cos(commanded.steer_rad) * commanded.wheel_radps
    assert np.cos(angle_rad - 0.1) * (low_level + added) == pytest.approx(along)


@pytest.mark.parametrize("angle_rad", [0.8, -0.4, np.pi / 2, np.pi + 0.8, np.nan, np.inf])
def test_elsewhere_nothing_is_added(angle_rad):
    command = Command(np.full(3, 4.0), THEORY.steer_rad, None, {})
    with np.errstate(invalid="ignore"):
        added, state = corrections(command, THEORY, np.array([0.2, angle_rad, 0.2]))
    assert state == BridgeState.STEERING
    assert not added.any()


def test_kinematics_begins_where_the_steering_is():
    """A crab from steering that is there already: the theoretical rate at once, and nothing is steered."""
    heading_rad = 1.3
    twist = 0.5 * np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    kinematics = LowLevelKinematics(ROBOT)
    kinematics.start(np.full(3, heading_rad))
    theory = kinematics.step(twist, 0.02)
    assert theory.wheel_radps == pytest.approx(np.full(3, 0.5 / ROBOT.wheel_radius_m))
    assert theory.steer_rad == pytest.approx(np.full(3, heading_rad))
