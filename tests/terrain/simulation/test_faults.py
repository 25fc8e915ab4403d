"""Sensor faults: each does what it states to samples and stamps, and nothing else."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrain.errors import ConfigError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion, to_camera
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Command, Reading, Sample, Stream
from terrain.robots import load_robot
from terrain.simulation.faults import (
    EVERY,
    JITTER_S,
    NOISE_FACTOR,
    OTHER_WIDTH,
    SPIKE,
    FaultyBus,
    fault_catalogue,
    noise_std,
    select_faults,
)

ROBOT = load_robot("agrimaro")
CATALOGUE = fault_catalogue(ROBOT)
CHANNELS = {
    "wheels": WHEELS_CHANNELS,
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
}
STREAMS = tuple(CHANNELS)
RATE_HZ = {"wheels": 50, "steering": 50, "imu": 100, "odometry": 200}
STEP_S, START_S, END_S, LENGTH_S = 0.02, 1.0, 3.0, 4.0
COMMAND = Command(np.zeros(3), np.zeros(3), np.zeros(3), {})


@cache
def samples():
    """Steps with drawn readings that cannot be written to; the camera has rotations and a turned heading."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(round(LENGTH_S / STEP_S)):
        readings = {}
        for name, channels in CHANNELS.items():
            n = round(RATE_HZ[name] * STEP_S)
            time_s = (k + (np.arange(n) + 1 - n) / n) * STEP_S
            values = rng.standard_normal((n, len(channels)))
            if name == "odometry":
                angles = np.column_stack([0.7 + 0.1 * values[:, 0], 0.2 * values[:, 1:3]])
                q = Rotation.from_euler("ZYX", angles).as_quat()
                values[:, 3:7] = np.column_stack([to_camera(q[:, :3]), q[:, 3]])
            time_s.flags.writeable = values.flags.writeable = False
            readings[name] = Reading(time_s, values)
        made.append(Sample(k * STEP_S, np.zeros(3), readings, "grass"))
    return made


@cache
def arrived(name, seed=0):
    """What arrives of all steps with a fault."""
    given = []
    bus = FaultyBus(lambda sample: given.append(sample) or COMMAND, CATALOGUE[name], START_S, END_S, seed)
    assert all(bus(sample) is COMMAND for sample in samples())
    return given


def acts(sample):
    return START_S <= sample.time_s < END_S


def pairs(name):
    """The steps at which a fault acts, as the sensors gave them and as they arrive."""
    return [pair for pair in zip(samples(), arrived(name), strict=True) if acts(pair[0])]


def both(name, stream):
    """Values and stamps of a stream while the fault acts: as given, and as arrived."""
    readings = [[sample.readings[stream] for sample in each] for each in zip(*pairs(name), strict=True)]
    return tuple(tuple(map(np.concatenate, zip(*each, strict=True))) for each in readings)


def same(one, other):
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def named(kind):
    return [fault.name for fault in CATALOGUE.values() if fault.kind == kind]


def unchanged(found, given):
    """Whether what arrived of a stream are the arrays that were given."""
    if found is None or not isinstance(found.values, np.ndarray) or found.values.dtype != np.float64:
        return False
    return [np.shape(part) for part in found] == [np.shape(part) for part in given] and same(found, given)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_fault_touches_its_streams_while_it_acts_and_nothing_else(name):
    fault, touched, was_acting = CATALOGUE[name], set(), False
    assert (bool(fault.about), fault.name.startswith(fault.kind)) == (True, True)
    for given, found in zip(samples(), arrived(name), strict=True):
        assert (found.twist is given.twist, found.terrain) == (True, given.terrain)
        assert acts(given) or found.time_s == given.time_s
        for stream, reading in given.readings.items():
            if stream not in fault.streams:
                assert found.readings[stream] is reading
            elif acts(given):
                touched |= set() if unchanged(found.readings.get(stream), reading) else {stream}
            else:  # once it is over, all that was held back arrives first
                held = len(found.readings[stream].time_s) - len(reading.time_s)
                assert held == 0 or was_acting
                assert same([part[held:] for part in found.readings[stream]], reading)
        was_acting = acts(given)
    assert touched == set(fault.streams)


@pytest.mark.parametrize("name", ["noise_imu", "jitter_odometry", "late_100ms_wheels"])
def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(name):
    (stream,) = CATALOGUE[name].streams
    one, again, other = (
        [
            (k, s.readings[stream].values.tobytes())
            for k, s in enumerate(arrived(name, seed))
            if stream in s.readings
        ]
        for seed in (1, 1, 2)
    )
    assert one == again
    assert (one == other) == name.startswith("late")


def test_nothing_arrives_of_a_lost_stream():
    for name in named("loss"):
        for given, found in pairs(name):
            assert set(found.readings) == set(given.readings) - set(CATALOGUE[name].streams)


def changed(columns=slice(None), value=None, factor=1.0, amount=0.0, shift_s=0.0, rows=slice(None)):
    """What is made of stamps, values and the last values before; ``last`` puts these in place of a value."""

    def expected(time_s, values, last):
        time_s[rows] += shift_s
        values[rows, columns] = values[rows, columns] * factor + amount
        if value is not None:
            values[rows, columns] = last[columns] if value == "last" else value
        return time_s, values

    return expected


def of_each(kinds):
    return {(f"{kind}_{stream}", stream): expected for kind, expected in kinds.items() for stream in STREAMS}


TENTH = slice(EVERY - 1, None, EVERY)
EXPECTED = {
    ("freeze_camera_orientation", "odometry"): changed(slice(3, 7), "last"),
    **{(f"freeze_motor_{i}", "wheels"): changed([i - 1], "last") for i in (1, 2, 3)},
    **{
        (f"freeze_{name}", "imu"): changed(columns, "last")
        for name, columns in (("gyro", slice(0, 3)), ("accel", slice(3, 6)), ("pitch", [7]))
    },
    ("freeze_steering_1", "steering"): changed([0], "last"),
    **{
        (f"step_{name}", "imu"): changed(column, amount=amount)
        for name, column, amount in (("pitch", 7, 0.2), ("yaw", 8, 0.3), ("gyro", 2, 0.1), ("accel", 3, 2.0))
    },
    ("step_steering_1", "steering"): changed(0, amount=0.1),
    ("step_motor_1", "wheels"): changed(0, factor=1.2),
    **of_each({"freeze": changed(value="last"), "zeros": changed(value=0.0), "nan": changed(value=math.nan)}),
    **of_each({"inf": changed(value=math.inf), "minus_inf": changed(value=-math.inf)}),
    **of_each({"nan_some": changed(value=math.nan, rows=TENTH), "spikes": changed(value=SPIKE, rows=TENTH)}),
    **of_each({"behind": changed(shift_s=-0.03), "stampless": changed(shift_s=math.nan)}),
    **of_each({"clock_forward": changed(shift_s=3600.0), "clock_back": changed(shift_s=-3600.0)}),
    **of_each(
        {"future_1s": changed(shift_s=1.0, rows=TENTH), "future_1h": changed(shift_s=3600.0, rows=TENTH)}
    ),
    **of_each(
        {"duplicates": lambda time_s, values, last: (np.repeat(time_s, 2), np.repeat(values, 2, axis=0))}
    ),
}
"""What is made of stamps, values and the last values before, by fault and stream."""


@pytest.mark.parametrize(("name", "stream"), EXPECTED)
def test_a_fault_makes_of_stamps_and_values_what_it_states(name, stream):
    given, found = both(name, stream)
    last = [sample.readings[stream].values[-1] for sample in samples() if sample.time_s < START_S][-1]
    assert same(found, EXPECTED[name, stream](*(part.copy() for part in given), last))


def test_a_stream_that_freezes_before_its_first_sample_repeats_that_one():
    given = []
    bus = FaultyBus(given.append, CATALOGUE["freeze_wheels"], 0.0, math.inf, 0)
    for sample in samples()[:3]:
        bus(sample)
    first = samples()[0].readings["wheels"].values
    assert all(np.array_equal(sample.readings["wheels"].values, first) for sample in given)


def test_the_camera_steps_and_freezes_its_forward_speed_at_any_heading_and_turns_about_the_vertical():
    """As the robot's motion shows in it, by :mod:`terrain.kinematics.camera`."""
    camera = ROBOT.camera
    before = [sample for sample in samples() if sample.time_s < START_S][-1].readings["odometry"]
    last_mps = body_motion(Stream(*before, CAMERA_CHANNELS), camera).speed_mps[-1, 0]
    for name in ("step_camera_speed", "step_camera_speed_down", "freeze_camera_speed"):
        given, found = (
            body_motion(Stream(*each, CAMERA_CHANNELS), camera) for each in both(name, "odometry")
        )
        change = last_mps - given.speed_mps[:, 0] if "freeze" in name else -0.3 if "down" in name else 0.3
        assert found.speed_mps[:, 0] - given.speed_mps[:, 0] == pytest.approx(change)
        assert found.speed_mps[:, 1] == pytest.approx(given.speed_mps[:, 1])
        assert found.yaw_rad == pytest.approx(given.yaw_rad)
    given, found = (values for _, values in both("step_camera_yaw", "odometry"))
    q = (np.column_stack([-v[:, 5], -v[:, 3], v[:, 4], v[:, 6]]) for v in (given, found))
    angles, turned = (Rotation.from_quat(each).as_euler("ZYX") for each in q)
    assert turned - angles == pytest.approx(np.tile([0.3, 0.0, 0.0], (len(angles), 1)))
    np.testing.assert_array_equal(*(np.delete(values, range(3, 7), axis=1) for values in (given, found)))


@pytest.mark.parametrize("stream", STREAMS)
def test_noise_has_ten_times_the_described_standard_deviation(stream):
    (_, given), (_, found) = both(f"noise_{stream}", stream)
    added, std = found - given, NOISE_FACTOR * noise_std(ROBOT)[stream]
    assert len(std) == len(CHANNELS[stream])
    assert added.std(axis=0) == pytest.approx(std, rel=4 / math.sqrt(2 * len(added)))
    assert np.array_equal(added[:, std == 0], np.zeros((len(added), int((std == 0).sum()))))


@pytest.mark.parametrize("stream", STREAMS)
def test_shapes_and_types_are_wrong(stream):
    for given, found in pairs(f"text_{stream}"):
        with pytest.raises(ValueError, match="could not convert"):
            found.readings[stream].values.astype(float)
        assert np.array_equal(found.readings[stream].time_s, given.readings[stream].time_s)
    assert all(found.readings[stream] == (None, None) for _, found in pairs(f"none_{stream}"))
    for _, found in pairs(f"ragged_{stream}"):
        with pytest.raises(ValueError, match="inhomogeneous"):
            np.asarray(found.readings[stream].values)
    for given, found in pairs(f"width_{stream}"):
        n, width = given.readings[stream].values.shape
        assert found.readings[stream].values.shape == (n, OTHER_WIDTH[stream])
        assert OTHER_WIDTH[stream] != width


def delays(name):
    """Stamps of a stream and the delays with which they arrive, of all samples stamped while a fault acts."""
    (stream,) = CATALOGUE[name].streams
    came = [
        (s.time_s, time_s)
        for s in arrived(name)
        if stream in s.readings
        for time_s in s.readings[stream].time_s
    ]
    came_s, time_s = np.array(came).T
    every_s = np.concatenate([sample.readings[stream].time_s for sample in samples()])
    assert np.array_equal(np.sort(time_s), every_s)  # none is lost, and none arrives twice
    used = (came_s > START_S - STEP_S / 2) & (came_s < END_S - STEP_S / 2)
    return time_s[used], (came_s - time_s)[used]


@pytest.mark.parametrize("stream", STREAMS)
def test_late_samples_arrive_with_their_stamps_in_their_order_and_disordered_ones_in_turned_pairs(stream):
    for delay_s in (0.03, 0.1, 0.15):
        time_s, late_s = delays(f"late_{1000 * delay_s:g}ms_{stream}")
        assert (np.diff(time_s) > 0).all()
        assert late_s.min() >= delay_s - 1e-9
        assert late_s.max() < delay_s + STEP_S - 1e-9 + STEP_S / 1000
    time_s, late_s = delays(f"jitter_{stream}")
    assert (np.diff(time_s) > 0).all()
    assert late_s.min() >= -1e-9
    assert late_s.max() < JITTER_S + STEP_S
    assert len(np.unique(late_s.round(6))) >= 3
    time_s, _ = delays(f"disorder_{stream}")
    turned = time_s[: len(time_s) // 2 * 2].reshape(-1, 2)
    assert (turned[:, 0] > turned[:, 1]).all()
    assert (np.diff(turned[:, 0]) > 0).all()


def test_the_clock_of_the_whole_robot_steps():
    for name, shift_s in (("clock_forward_all", 3600.0), ("clock_back_all", -3600.0)):
        for given, found in pairs(name):
            assert found.time_s == given.time_s + shift_s
            for stream, reading in given.readings.items():
                assert same(found.readings[stream], (reading.time_s + shift_s, reading.values))


def test_times_that_are_none_are_refused():
    for start_s, end_s in ((2.0, 2.0), (math.nan, 3.0), (1.0, math.nan), (math.inf, math.inf)):
        with pytest.raises(ConfigError, match="start before end"):
            FaultyBus(lambda sample: COMMAND, CATALOGUE["loss_imu"], start_s, end_s, 0)


def test_faults_are_selected_by_name_or_kind_in_the_order_of_the_catalogue():
    selected = [fault.name for fault in select_faults(CATALOGUE, ["step_pitch", "loss"])]
    assert selected == [*named("loss"), "step_pitch"]
    assert select_faults(CATALOGUE, []) == list(CATALOGUE.values())
    with pytest.raises(ConfigError, match=r"fault 'loos' is unknown: use a kind \(loss, .*clock\)"):
        select_faults(CATALOGUE, ["loos"])
