import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2

from terrain.errors import ConfigError
from terrain.kinematics.wheels import velocity_matrix
from terrain.robots import load_robot
from terrain.signals import true_stretches
from terrain.simulation.scenario import (
    ACCEL_MPS2,
    CIRCLE_M,
    DURATION_S,
    PATCH_M,
    SCENARIOS,
    SLIP_MARGIN,
    YAW_ACCEL_RADPS2,
    Conditions,
    Faults,
    Patch,
    Scenario,
    draw_conditions,
    field_spread,
    make_scenario,
)

ROBOT, HUSKY = load_robot("agrimaro"), load_robot("husky")
DRAWN = ("survey", "course")
UNENDED = ("straight", "climb", "course")
TERRAINS = ("grass", "gravel", "sand", "tiles")


def make(name, **options):
    return make_scenario(name, ROBOT, TERRAINS if name == "course" else "grass", **options)


def resting(scenario):
    return (scenario.twist == 0).all(axis=1)


@pytest.mark.parametrize("speed_mps", [0.3, 2.0])
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_is_feasible_and_rests_where_stated(name, speed_mps):
    for seed in range(3 if name in DRAWN else 1):
        drive = make(name, speed_mps=speed_mps, seed=seed)
        np.testing.assert_allclose(drive.time_s, np.arange(len(drive.time_s)) / drive.rate_hz)
        rest = resting(drive)
        assert rest[drive.time_s <= 1.0].all()
        assert (rest[-1], rest.all()) == (name not in UNENDED, name == "stand")
        change = np.abs(np.diff(drive.twist, axis=0)) * drive.rate_hz
        if name == "brake":  # but for the one step
            assert change.max() == pytest.approx(speed_mps * drive.rate_hz)
            change[change[:, 0].argmax()] = 0.0
        assert np.hypot(change[:, 0], change[:, 1]).max() <= ACCEL_MPS2 * (1 + 1e-9)
        assert change[:, 2].max() <= YAW_ACCEL_RADPS2 * (1 + 1e-9)
        wheels = (drive.twist @ velocity_matrix(ROBOT.wheel_positions_m).T).reshape(len(drive.twist), -1, 2)
        limit_mps = ROBOT.wheel_radius_m * ROBOT.motors.speed_max_radps
        assert np.linalg.norm(wheels, axis=-1).max() <= limit_mps * (1 + 1e-9)


def test_a_robot_without_steering_drives_all_but_what_takes_it_sideways():
    limit_mps = HUSKY.wheel_radius_m * HUSKY.motors.speed_max_radps
    for name in set(SCENARIOS) - {"crab", "course"}:
        drive = make_scenario(name, HUSKY, "grass", speed_mps=1.0, seed=3)
        assert (drive.twist[:, 1] == 0).all()
        sides = drive.twist[:, :1] + 0.5 * HUSKY.track_m * drive.twist[:, 2:] * [-1.0, 1.0]
        assert np.abs(sides).max() <= limit_mps * (1 + 1e-9)
        assert resting(drive).all() == (name == "stand")
        if name in ("complex", "spot_turn"):  # to both sides, on the spot too
            on_the_spot = drive.twist[drive.twist[:, 0] == 0, 2]
            assert (on_the_spot.min(), on_the_spot.max()) == (-0.6, 0.6)


def test_a_scenario_lasts_exactly_as_long_as_it_should():
    for name in SCENARIOS:
        default_s = DURATION_S[name] or {"brake": 10, "circle": 22}.get(name)
        assert name == "course" or make(name).time_s[-1] == default_s
        for duration_s in (45.5, 83.0):
            drive = make(name, duration_s=duration_s, seed=4)
            assert (drive.time_s[-1], resting(drive)[-1]) == (duration_s, name not in UNENDED)


def test_complex_holds_every_kind_of_motion():
    drive = make("complex")
    x, y, yaw = drive.twist.T
    held = (np.abs(np.diff(drive.twist, axis=0, append=0)) == 0).all(axis=1)
    ahead, back = held & (x > 0), held & (x < 0)
    for kind in (
        ahead & (yaw == 0) & (y == 0),
        back & (yaw == 0),
        *(side & (yaw * sign > 0.29) for side in (ahead, back) for sign in (1, -1)),
        *(held & (x == 0) & (y * sign > 0) for sign in (1, -1)),
        *(ahead & (y * sign > 0) for sign in (1, -1)),
    ):
        assert kind.sum() >= 2 * drive.rate_hz
    assert x.max() == pytest.approx(1.0)
    bent = np.abs(np.diff(drive.twist, n=2, axis=0)).max() * drive.rate_hz**2
    assert bent < 10.0  # m/s^3; where a linear ramp of 1 m/s^2 begins it is 50


def test_a_circle_comes_round_to_where_it_began():
    for speed_mps in (0.3, 1.0):
        drive = make("circle", speed_mps=speed_mps)
        expected = min(speed_mps, 0.5) * np.array([1.0, 0.0, 1 / CIRCLE_M])
        assert drive.twist.max(axis=0) == pytest.approx(expected)
        assert 2 * math.pi < drive.twist[:, 2].sum() / drive.rate_hz < 2.2 * math.pi


@pytest.mark.parametrize("name", ["straight", "climb", "starts"])
def test_ramps_take_the_acceleration_that_is_asked_for_and_may_be_steps(name):
    plain = make(name)
    for accel_mps2 in (0.4, ACCEL_MPS2, 2.5):
        change = np.diff(make(name, accel_mps2=accel_mps2).twist[:, 0]) * plain.rate_hz
        assert change.max() == pytest.approx(accel_mps2)
    for accel_mps2 in (1e300, math.inf):
        step = make(name, accel_mps2=accel_mps2)
        assert set(step.twist[:, 0]) == {0.0, 1.0}
        assert step.twist.sum() > plain.twist.sum()
        assert name == "starts" or step.time_s[step.twist[:, 0] > 0][0] == 1.0


@pytest.mark.parametrize("name", DRAWN)
def test_same_seed_same_bytes_other_seed_other_drive(name):
    one, same, other = (make(name, seed=seed) for seed in (7, np.random.default_rng(7), 8))
    assert one.twist.tobytes() == same.twist.tobytes()
    assert one.patches == same.patches
    assert one.twist.tobytes() != other.twist.tobytes()
    longer = make(name, seed=7, duration_s=100.0)
    n = int(25 * one.rate_hz)
    np.testing.assert_array_equal(one.twist[:n], longer.twist[:n])  # a longer one goes on from there


def test_surveys_hold_stretches_of_steady_speed_and_now_and_then_something_else():
    held, counts = [], np.zeros(4, dtype=int)
    for seed in range(30):
        drive = make("survey", seed=seed)
        x, y, yaw = drive.twist.T
        assert (y == 0).all()
        assert np.abs(x).max() <= 1.2
        gentle = np.abs(x) > 0.01
        assert np.abs(yaw[gentle] / x[gentle]).max() <= 0.2 + 1e-9
        steady = (np.diff(drive.twist, axis=0) == 0).all(axis=1) & (x[1:] > 0)
        begin, end = true_stretches(steady).T
        held += list((end - begin)[:-1] / drive.rate_hz)  # the last one may be cut
        stops = np.flatnonzero(np.diff(resting(drive).astype(int)) > 0)
        counts += [len(stops) > 1, (x < 0).any(), ((x == 0) & (yaw != 0)).any(), ((x > 0) & (yaw != 0)).any()]
    assert len(held) > 90
    assert 3.9 < min(held) < max(held) < 6.0
    assert ((counts > 3) & (counts[:3].max() < 30)).all()


def test_a_course_is_driven_over_every_terrain_in_a_drawn_order_a_long_one_again_and_a_short_one_over_few():
    orders = set()
    for seed in range(12):
        drive = make("course", seed=seed)
        starts_m = np.array([patch.start_m for patch in drive.patches])
        names = tuple(patch.terrain for patch in drive.patches)
        assert sorted(names) == sorted(TERRAINS)
        orders.add(names)
        lengths_m = np.diff(starts_m, append=drive.distance_m[-1] / SLIP_MARGIN)
        assert starts_m[0] == 0
        assert PATCH_M[0] <= lengths_m.min() < lengths_m.max() <= PATCH_M[1] + 0.02
        crossing = np.searchsorted(drive.distance_m, starts_m[1:])
        assert (drive.twist[crossing, 0] > 0).all()  # terrain changes while it drives
        speeds = drive.twist[drive.time_s > 4.0, 0]
        assert 0.4 <= speeds.min() < speeds.max() - 0.1 < 1.1 + 1e-9
        assert np.abs(drive.twist[1:, 2]).max() <= 0.15 * 1.2
    assert len(orders) > 6
    long, short = (make("course", duration_s=duration_s, seed=3) for duration_s in (300.0, 15.0))
    names = [patch.terrain for patch in long.patches]
    assert all(a != b for a, b in pairwise(names))
    counts = [names.count(terrain) for terrain in TERRAINS]
    assert max(counts) - min(counts) <= 1
    last_m = long.patches[-1].start_m
    assert last_m < long.distance_m[-1] / SLIP_MARGIN <= last_m + PATCH_M[1]
    assert 1 <= len(short.patches) < 4
    assert short.patches == long.patches[: len(short.patches)]
    assert make_scenario("course", ROBOT, ["grass"], seed=1).patches == (Patch(0.0, "grass"),)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "zigzag"}, "scenario 'zigzag' is unknown: use one of stand, straight"),
        ({"terrains": []}, r"terrains are \[\]: one name or several are required"),
        ({"terrains": ["grass", 3]}, r"terrains are \['grass', 3\]"),
        ({"duration_s": 0}, "duration_s is 0, a time from"),
        *(({"duration_s": value}, f"duration_s is {value!r}") for value in (math.nan, math.inf, "long")),
        ({"duration_s": 1e12}, "duration_s is 1000000000000.0, a time from 0.02 to 3600 s is required"),
        ({"speed_mps": 2.1}, "speed_mps is 2.1: robot agrimaro drives above 0 and up to 2 m/s"),
        *(({"speed_mps": value}, f"speed_mps is {value!r}") for value in (0.0, math.nan)),
        ({"accel_mps2": 0.0}, "accel_mps2 is 0.0, a number above zero"),
        *(({"accel_mps2": value}, f"accel_mps2 is {value!r}") for value in (math.nan, "fast")),
        *(({"seed": value}, f"seed is {value}, a whole number from 0 up") for value in (-3, None)),
        ({"robot": HUSKY, "name": "crab"}, "scenario 'crab' is not for robot husky"),
        ({"robot": ROBOT.without("motors")}, "no section 'motors'"),
    ],
)
def test_infeasible_drives_are_refused_in_one_sentence(options, message):
    given = {"name": "survey", "robot": ROBOT, "terrains": "grass"} | options
    with pytest.raises(ConfigError, match=message) as error:
        make_scenario(**given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [name for name in SCENARIOS if name != "stand"])
def test_too_short_a_time_is_refused_and_the_message_says_what_is_long_enough(name):
    with pytest.raises(ConfigError, match=f"duration_s is 1.5, too short for '{name}'") as error:
        make(name, duration_s=1.5)
    enough_s = float(str(error.value).split("at least ")[1].split(" s")[0])
    assert make(name, duration_s=enough_s).time_s[-1] == pytest.approx(enough_s)
    with pytest.raises(ConfigError, match="too short"):
        make(name, duration_s=enough_s - 0.12)


def test_a_custom_scenario_is_validated():
    time_s = np.arange(3) / 50
    assert not Scenario("mine", 50.0, time_s, np.zeros((3, 3)), ((0.0, "ice"),)).twist.flags.writeable
    with pytest.raises(ValueError, match=r"twist has shape \(3, 2\)"):
        Scenario("mine", 50.0, time_s, np.zeros((3, 2)), ((0.0, "ice"),))
    with pytest.raises(ValueError, match="not evenly spaced from 0 at 50 Hz"):
        Scenario("mine", 50.0, time_s + 0.02, np.zeros((3, 3)), ((0.0, "ice"),))
    for patches in ((), ((1.0, "ice"),), ((0.0, "ice"), (0.0, "sand"))):
        with pytest.raises(ValueError, match="a rising row from 0 on is needed"):
            Scenario("mine", 50.0, time_s, np.zeros((3, 3)), patches)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        *(({"payload_kg": kg}, f"payload_kg is {kg}, a number from zero up") for kg in (math.nan, -1.0)),
        ({"payload_m": (0.0, math.inf)}, r"payload_m is \(0.0, inf\), a finite number"),
        ({"grade_ratio": (0.0, 1.2)}, r"grade_ratio is \(0.0, 1.2\), a gradient from -1 to 1"),
        ({"undulation_ratio": -2.0}, "undulation_ratio is -2.0"),
        ({"undulation_length_m": 0.0}, "undulation_length_m is 0.0, a number above zero"),
        ({"radius_factors": (1.0, 0.0, 1.0)}, r"radius_factors is \(1.0, 0.0, 1.0\), a number above zero"),
        ({"roughness_factor": -0.1}, "roughness_factor is -0.1, a number from zero up"),
        ({"leg_backlash_rad": -0.01}, "leg_backlash_rad is -0.01, an angle from 0 to 0.5 rad"),
        ({"field_length_m": math.nan}, "field_length_m is nan"),
    ],
)
def test_impossible_conditions_are_refused(changed, message):
    with pytest.raises(ConfigError, match=message):
        Conditions(**changed)


def test_an_interval_that_does_not_end_after_it_starts_is_refused():
    for interval in ((3.0, 2.0), (2.0, 2.0), (math.nan, 2.0), (0.0, math.nan)):
        with pytest.raises(ConfigError, match=r"camera_lost_s has .* start before end"):
            Faults(camera_lost_s=((0.0, 1.0), interval))


def test_conditions_scatter_around_the_nominal_ones_as_the_spread_says():
    spread, n = field_spread(), 800
    load = {"payload_kg": 5.0, "payload_m": (0.05, -0.02), "roughness_factor": 2.0}
    centres = {"grade_ratio": (0.05, 0.0), "undulation_ratio": 0.01, "radius_factors": (1.02, 1.0, 0.97)}
    rng = np.random.default_rng(1)
    drawn = [draw_conditions(rng, Conditions(**load, **centres)) for _ in range(n)]
    cut = 0.9594  # standard deviation of a normal clipped at two
    low, high = np.sqrt(chi2.ppf([1e-5, 1 - 1e-5], n - 1) / (n - 1))
    for name, centre in centres.items():
        std, values = (
            spread[f"{name.split('_')[0]}_std_ratio"],
            np.array([getattr(one, name) for one in drawn]),
        )
        np.testing.assert_allclose(values.mean(axis=0), centre, atol=4.5 * std / math.sqrt(n))
        assert (np.abs(values - centre) <= 2.0001 * std * np.maximum(1.0, centre)).all()
        ratio = values.std(axis=0) / std
        assert ((ratio > low * cut) & (ratio < high)).all(), name
    log, std = np.log([one.roughness_factor for one in drawn]), spread["roughness_log_std_ratio"]
    assert log.mean() == pytest.approx(math.log(2.0), abs=4.5 * std / math.sqrt(n))
    payload = np.array([one.payload_kg for one in drawn])
    assert 5.0 <= payload.min() < 6.0 < 34.0 < payload.max() <= 35.0
    place = np.array([one.payload_m for one in drawn]) - load["payload_m"]
    assert 0.14 < np.abs(place).max() <= 0.15
    assert len(set(drawn)) == n
