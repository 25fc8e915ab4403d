"""Health of sensors by what comes of their streams: what each fault makes of it, and nothing without one."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrain.estimation.health import Health, HealthMonitor, sensors_of
from terrain.estimation.stream_evidence import BELIEVED_S, StreamEvidence, TurnComparison
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Reading
from terrain.robots import load_robot

ROBOT = load_robot("husky")
CHANNELS = sensor_channels(ROBOT)
SENSORS = sensors_of(ROBOT, CHANNELS)
DT_S, SPEED_MPS, FAULT_S = 0.02, 0.8, 4.0
EVERY = {"wheels": 1, "imu": 1, "odometry": 2, "gnss": 5}  # steps from sample to sample
STD = {"speed_x_mps": 0.02, "velocity_x_mps": 0.03, "position_x_m": 0.02, "pitch_rad": 0.01}


def judged(change=lambda name, time_s, row: row, length_s=6.0, age_s=lambda time_s: 0.0, seed=0, **given):
    """The health of each sensor at each step of a steady drive, whose samples ``change`` makes others of, or none.

    ``given`` is of the estimate in place of what it is.
    """
    rng, found = np.random.default_rng(seed), []
    source, monitor = StreamEvidence(ROBOT, CHANNELS, SENSORS), HealthMonitor(SENSORS)
    for k in range(round(length_s / DT_S)):
        time_s, readings = k * DT_S, {}
        for name, channels in CHANNELS.items():
            mean = {
                "speed": SPEED_MPS,
                "velocity_x": SPEED_MPS,
                "position_x": SPEED_MPS * time_s,
                "std": 0.02,
            }
            row = np.array([next((v for n, v in mean.items() if c.startswith(n)), 0.0) for c in channels])
            row = row + [
                0.0 if c == "std_position_m" else STD.get(c, 0.01) * rng.standard_normal() for c in channels
            ]
            row = change(name, time_s, row) if k % EVERY[name] == 0 else None
            if row is not None:
                readings[name] = Reading(np.array([time_s]), row[None])
        motion = {"time_s": time_s, "reference_age_s": age_s(time_s), "speed_x_mps": SPEED_MPS}
        motion |= {"wheel_speed_mps": np.full(2, 0.9), "accel_x_mps2": 0.1 * rng.standard_normal()} | given
        found.append(monitor.judge(source.at(time_s, DT_S, readings, SimpleNamespace(**motion))))
    return dict(zip(monitor.names, np.array(found).T, strict=True))


def added(stream, channel, amount, until_s=np.inf):
    """A change by which a channel has another value from the fault on."""
    place = CHANNELS[stream].index(channel)

    def change(name, time_s, row):
        if name == stream and FAULT_S <= time_s < until_s:
            row[place] += amount
        return row

    return change


def frozen(stream):
    held = {}

    def change(name, time_s, row):
        if name != stream:
            return row
        held[name] = row if time_s < FAULT_S else held[name]
        return held[name].copy()

    return change


SENSORS_OF = {
    "wheels": ("wheel_left", "wheel_right"),
    "imu": ("gyro", "accel", "tilt"),
    "odometry": ("camera_speed",),
    "gnss": ("gnss_position", "gnss_speed"),
}


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_named_without_a_fault(seed):
    assert all((health == Health.FRESH).all() for health in judged(seed=seed).values())


@pytest.mark.parametrize("stream", SENSORS_OF)
@pytest.mark.parametrize("kind", ["lost", "nan", "frozen"])
def test_a_dead_stream_is_named_within_three_tenths_of_a_second(stream, kind):
    gone = {"lost": None, "nan": np.full(len(CHANNELS[stream]), np.nan)}
    change = frozen(stream)
    if kind != "frozen":

        def change(name, time_s, row):
            return gone[kind] if name == stream and time_s >= FAULT_S else row

    found = judged(change)
    named = Health.FROZEN if kind == "frozen" else Health.LOST
    for name, health in found.items():
        late = health[round((FAULT_S + 0.3) / DT_S) :]
        assert (late == (named if name in SENSORS_OF[stream] else Health.FRESH)).all(), name


@pytest.mark.parametrize(
    ("stream", "channel", "amount", "sensor"),
    [
        ("odometry", "speed_x_mps", 0.3, "camera_speed"),
        ("gnss", "velocity_x_mps", -0.3, "gnss_speed"),
        ("gnss", "position_x_m", 1.0, "gnss_position"),
        ("imu", "pitch_rad", 0.2, "tilt"),
    ],
)
def test_a_value_that_jumped_is_named_until_it_jumps_back_or_is_believed(stream, channel, amount, sensor):
    back = judged(added(stream, channel, amount, FAULT_S + 1.0))[sensor]
    acts = slice(round((FAULT_S + 0.3) / DT_S), round((FAULT_S + 1.0) / DT_S))
    assert (back[acts] >= Health.DISAGREES).all()
    assert back[-1] == Health.FRESH
    stays = judged(added(stream, channel, amount), length_s=FAULT_S + BELIEVED_S + 1.0)[sensor]
    assert (stays[round((FAULT_S + 0.3) / DT_S) : -60] >= Health.DISAGREES).all()
    assert stays[-1] == Health.FRESH


def test_an_outlier_a_float_solution_and_what_never_came_are_no_faults():
    def change(name, time_s, row):
        if name == "odometry":
            return None
        if name == "gnss" and time_s >= 2.0:  # half a metre, and stated
            row[:2] += 0.5 * np.sin(37.0 * time_s)
            row[CHANNELS["gnss"].index("std_position_m")] = 0.5
        if name == "imu" and abs(time_s - 1.0) < 1e-9:
            row[:] = 1e6
        return row

    for name, health in judged(change).items():
        assert (health[: round(0.9 / DT_S)] == Health.FRESH).all(), name
        assert health[-1] == Health.FRESH, name
        assert (health != Health.FRESH).sum() <= 2, name


@pytest.mark.parametrize(
    "given",
    [
        {"wheel_speed_mps": np.full(2, np.nan)},
        {"accel_x_mps2": np.nan},
        {"wheel_speed_mps": np.full(2, np.nan), "accel_x_mps2": np.nan},
    ],
    ids=["no wheels", "no accelerometer", "neither"],
)
@pytest.mark.parametrize(("stream", "channel"), [("odometry", "speed_x_mps"), ("gnss", "velocity_x_mps")])
def test_a_speed_that_jumps_is_named_whatever_there_is_to_compare_it_with(stream, channel, given):
    sensor = "camera_speed" if stream == "odometry" else "gnss_speed"
    found = judged(added(stream, channel, 1.0), **given)[sensor]
    assert (found[: round(FAULT_S / DT_S)] == Health.FRESH).all()
    assert (found[round((FAULT_S + 0.3) / DT_S) :] == Health.STEPPED).all()


def test_a_robot_that_stands_has_the_speed_that_jumps_less_than_one_that_drives_and_none_is_right_again():
    rest = {"speed_x_mps": 0.0, "wheel_speed_mps": np.zeros(2)}
    for amount, last in ((0.3, Health.STEPPED), (-SPEED_MPS, Health.FRESH)):
        found = judged(added("odometry", "speed_x_mps", amount), **rest)["camera_speed"]
        assert (found[: round(FAULT_S / DT_S)] == Health.FRESH).all()
        assert found[-1] == last


def test_a_speed_that_jumped_on_a_robot_that_stands_has_as_it_drives_off():
    source, monitor = StreamEvidence(ROBOT, CHANNELS, SENSORS), HealthMonitor(SENSORS)
    for k in range(100):
        speed = max(k - 60, 0) * 0.01
        row = np.array([speed + 0.3 * (k >= 50) + 0.001 * (k % 3), 0.0])
        motion = {"time_s": k * DT_S, "reference_age_s": 0.0, "speed_x_mps": speed, "accel_x_mps2": 0.0}
        motion |= {"wheel_speed_mps": np.full(2, speed)}
        given = {"odometry": Reading(np.array([k * DT_S]), row[None])}
        monitor.judge(source.at(k * DT_S, DT_S, given, SimpleNamespace(**motion)))
        assert (monitor.by_name["camera_speed"] == "stepped") == (k > 50), k


def coarse(alone):
    """Rates of wheels that turn evenly and are rounded, from the fault on; or of the left one only."""

    def change(name, time_s, row):
        if name == "wheels" and time_s >= FAULT_S:
            row[: 1 if alone else 2] = 0.8
        return row

    return change


def test_rates_that_are_rounded_repeat_themselves_on_wheels_that_turn_evenly_and_a_wheel_alone_is_frozen():
    found = judged(coarse(alone=False))
    assert all((found[wheel] == Health.FRESH).all() for wheel in SENSORS_OF["wheels"])
    found = judged(coarse(alone=True))
    assert (found["wheel_left"][round((FAULT_S + 0.3) / DT_S) :] == Health.FROZEN).all()
    assert (found["wheel_right"] == Health.FRESH).all()


def test_rounded_rates_of_a_few_hertz_that_change_together_are_no_fault(monkeypatch):
    monkeypatch.setitem(EVERY, "wheels", 8)

    def change(name, time_s, row):
        if name == "wheels":
            row[:2] = 0.8 if time_s % 4.0 < 2.0 else 0.82
        return row

    found = judged(change, length_s=12.0)
    assert all((found[wheel][round(1.0 / DT_S) :] == Health.FRESH).all() for wheel in SENSORS_OF["wheels"])


@pytest.mark.parametrize("moving", [True, False])
def test_wheels_that_measure_nothing_but_zeros_are_frozen_on_a_robot_that_moves(moving):
    def zeros(name, time_s, row):
        return 0.0 * row if name == "wheels" and time_s >= FAULT_S else row

    found = judged(zeros, speed_x_mps=SPEED_MPS if moving else 0.0, wheel_speed_mps=np.zeros(2))
    late = found["wheel_left"][round((FAULT_S + 0.2) / DT_S) :]
    assert (late == (Health.FROZEN if moving else Health.FRESH)).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_gyro_that_turns_otherwise_than_the_wheels_is_named_within_a_quarter_of_a_second(seed):
    found = judged(added("imu", "gyro_z_radps", 0.1, FAULT_S + 1.0), seed=seed)
    for name in ("gyro", *SENSORS_OF["wheels"]):
        acts = found[name][round((FAULT_S + 0.25) / DT_S) : round((FAULT_S + 1.0) / DT_S)]
        assert (acts == Health.DISAGREES).all(), name
        assert (found[name][round((FAULT_S + 1.25) / DT_S) :] == Health.FRESH).all(), name


@pytest.mark.parametrize(("value", "every"), [(np.inf, 1), (1e6, 10), (np.nan, 10)])
def test_a_gyro_that_measures_no_rate_or_spikes_does_not_turn_otherwise_than_the_wheels(value, every):
    def change(name, time_s, row):
        if name == "imu" and FAULT_S <= time_s < FAULT_S + 1.0 and round(time_s / DT_S) % every == 0:
            row[CHANNELS["imu"].index("gyro_z_radps")] = value
        return row

    found = judged(change)
    for name in SENSORS_OF["wheels"]:
        assert (found[name] == Health.FRESH).all(), name
    assert (found["gyro"][round((FAULT_S + 1.1) / DT_S) :] == Health.FRESH).all()


def test_rough_ground_that_turns_the_robot_to_and_fro_is_no_fault_once_it_is_known():
    """A yaw rate of 0.05 rad/s, correlated over a tenth of a second, as a Husky has on sandy loam."""
    turns, rng, rate, named = TurnComparison(), np.random.default_rng(0), 0.0, []
    for _ in range(3000):
        rate += -0.2 * rate + 0.03 * rng.standard_normal()
        turns = turns.after(rate, 0.01 * rng.standard_normal(), DT_S)
        named.append(turns.apart_s > 0.0)
    assert np.mean(named[500:]) < 0.01


@pytest.mark.parametrize("part", [0.8, 0.35])
def test_a_robot_that_turns_later_than_its_wheels_and_by_less_is_no_fault(part):
    turns, rng = TurnComparison(), np.random.default_rng(0)
    turn = 0.0
    for k in range(600):
        wheels = 0.8 * (200 <= k < 400)
        turn += (part * wheels - turn) * DT_S / 0.3
        turns = turns.after(turn + 0.01 * rng.standard_normal(), wheels + 0.02 * rng.standard_normal(), DT_S)
        assert turns.apart_s == 0.0, k


def test_references_that_the_filter_does_not_believe_are_gated():
    found = judged(age_s=lambda time_s: max(time_s - 2.0, 0.0))
    assert all((found[name][-20:] == Health.GATED).all() for name in ("camera_speed", "gnss_speed"))
    assert (found["gyro"] == Health.FRESH).all()


def test_what_is_frozen_or_has_jumped_is_kept_from_the_filter_and_nothing_else():
    monitor = HealthMonitor(SENSORS)
    for sensor, health in (
        ("tilt", Health.STEPPED),
        ("gnss_speed", Health.FROZEN),
        ("accel", Health.DISAGREES),
    ):
        monitor.health[monitor.names.index(sensor)] = health
    given = {name: Reading(np.zeros(1), np.ones((1, len(channels)))) for name, channels in CHANNELS.items()}
    readings = dict(given, odometry=Reading(np.zeros(1), np.ones((1, 5))))  # of another robot: left as it is
    StreamEvidence(ROBOT, CHANNELS, SENSORS).mask(readings, monitor.health)
    masked = {
        name: [CHANNELS[name][i] for i in np.flatnonzero(np.isnan(reading.values[0]))]
        for name, reading in readings.items()
    }
    speeds = ["velocity_x_mps", "velocity_y_mps"]
    assert masked == {"wheels": [], "imu": ["pitch_rad"], "odometry": [], "gnss": speeds}
    assert all(np.isfinite(reading.values).all() for reading in given.values())
