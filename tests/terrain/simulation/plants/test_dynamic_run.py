"""Runs of the dynamic plant: slip as in the field, a truth that agrees with itself, and a loop that is the log."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.logs.run_folders import read_run, write_run
from terrain.records import Command
from terrain.robots import load_robot
from terrain.simulation.plants import dynamic
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, Faults, Scenario, make_scenario
from terrain.simulation.sensors import Gnss
from terrain.terramechanics.soil import Scatter, load_soil, soil_names

ROBOT = load_robot("agrimaro")
SOILS = {name: load_soil(name) for name in soil_names()}
HILLY = Conditions(
    payload_kg=15.0,
    payload_m=(0.1, -0.1),
    grade_ratio=(0.05, -0.03),
    undulation_ratio=0.02,
    radius_factors=(1.01, 0.99, 1.0),
)


def with_part(section, **changes):
    return ROBOT.with_parts(**{section: dataclasses.replace(getattr(ROBOT, section), **changes)})


def run_of(scenario, terrain, seed=0, duration_s=None, **options):
    given = (
        scenario if isinstance(scenario, Scenario) else make_scenario(scenario, ROBOT, terrain, duration_s)
    )
    return simulate(ROBOT, given, SOILS, seed, **options)


def wheels_of(stream, pattern):
    return np.column_stack([stream.channel(pattern.format(i)) for i in (1, 2, 3)])


def test_the_truth_agrees_with_itself():
    """Slip and slip angle once more, from the speeds beside them."""
    run = run_of("complex", "grass", 3, conditions=HILLY)
    truth = run.streams["truth"]
    v = np.column_stack([truth.channel("speed_x_mps"), truth.channel("speed_y_mps")])
    turn = truth.channel("yaw_rate_radps")
    steer, radius = wheels_of(truth, "steer_{}_rad"), 0.2 * np.array(HILLY.radius_factors)
    centre = v[:, :, None] + turn[:, None, None] * np.array(
        [-ROBOT.wheel_positions_m[:, 1], ROBOT.wheel_positions_m[:, 0]]
    )
    along = np.cos(steer) * centre[:, 0] + np.sin(steer) * centre[:, 1]
    across = -np.sin(steer) * centre[:, 0] + np.cos(steer) * centre[:, 1]
    wheel_speed = radius * wheels_of(truth, "wheel_{}_radps")
    fastest = np.maximum(abs(wheel_speed), abs(along))
    slip = wheels_of(truth, "slip_{}_ratio")
    known = fastest >= 0.051
    np.testing.assert_allclose(slip[known], ((wheel_speed - along) / fastest)[known], atol=1e-9)
    assert np.isnan(slip[fastest < 0.049]).all()
    angle = wheels_of(truth, "slip_angle_{}_rad")
    moving = np.hypot(along, across) > 0.051
    np.testing.assert_allclose(angle[moving], np.arctan2(across, abs(along))[moving], atol=1e-9)
    mass_n = 105.0 * 9.80665
    assert wheels_of(truth, "normal_{}_n").sum(axis=1).mean() == pytest.approx(mass_n, rel=0.01)


def test_labels_cover_stretches_with_all_wheels_on_one_terrain():
    time_s = np.arange(601) / 50
    twist = np.column_stack([np.minimum(time_s, 1.0), np.zeros((601, 2))])
    patches = ((0.0, "tiles"), (3.0, "grass"), (6.0, "snow"))
    run = simulate(ROBOT, Scenario("mine", 50.0, time_s, twist, patches), SOILS, 1)
    truth = run.streams["truth"]
    ahead_m = ROBOT.wheel_positions_m[:, 0] * np.cos(truth.channel("yaw_rad"))[:, None]
    under = np.searchsorted([3.0, 6.0], truth.channel("position_x_m")[:, None] + ahead_m, side="right")
    assert run.terrains == ("tiles", "grass", "snow")
    for number, label in enumerate(run.labels):
        inside = (truth.time_s >= label.start_s) & (truth.time_s < label.end_s)
        # the robot drifts by centimetres: distance travelled is not quite x
        assert (inside != (under == number).all(axis=1)).sum() <= 3
    assert run.labels[0].start_s == 0.0
    # 1.015 m at 1 m/s
    assert all(after.start_s > before.end_s + 0.9 for before, after in pairwise(run.labels))
    # a ground that is crossed in a moment gets none
    drive = Scenario("mine", 50.0, time_s, twist, ((0.0, "tiles"), (3.0, "asphalt"), (4.3, "snow")))
    assert simulate(ROBOT, drive, SOILS, 1).terrains == ("tiles", "snow")


def test_terrain_varies_along_the_path_as_soil_and_conditions_state():
    rough = Scatter("friction_angle_rad", 0.0, 0.3), Scatter("rolling_resistance_ratio", 0.0, 0.5)
    soils = {
        "tiles": dataclasses.replace(SOILS["tiles"], scatter=()),
        "rough": dataclasses.replace(SOILS["grass"], scatter=rough),
    }
    time_s = np.arange(20_001) / 50
    drive = Scenario("mine", 50.0, time_s, np.zeros((len(time_s), 3)), ((0.0, "tiles"), (100.0, "rough")))
    varied = Conditions(roughness_factor=3.0, field_length_m=1.0)
    plant = dynamic.draw_profile(ROBOT, drive, soils, varied, np.random.default_rng(0))
    assert plant.field.shape[2] * 0.1 > 0.2 * 10.0 * time_s[-1]  # as far as it can come
    np.testing.assert_allclose(plant.patches["roughness_m3"], [12e-6, 3 * soils["rough"].roughness_m3])
    assert (plant.field[:, :, :1000] == 1.0).all()
    field = plant.field[:, :, 1000:]
    n_apart = field.shape[2] * 0.1 / (2 * 1.0)
    for factors, ratio in zip(field, (0.3, 0.5), strict=True):
        np.testing.assert_allclose(factors.mean(axis=1), 1.0, atol=4.5 * ratio / math.sqrt(n_apart))
        np.testing.assert_allclose(np.log(factors).std(axis=1), ratio, rtol=0.15)
        unit = (np.log(factors) - np.log(factors).mean(axis=1, keepdims=True)) / ratio
        np.testing.assert_allclose((unit[:, :-10] * unit[:, 10:]).mean(axis=1), math.exp(-1.0), atol=0.15)
    apart = np.corrcoef(np.log(field).reshape(6, -1)) - np.eye(6)
    assert np.abs(apart).max() < 4.5 / math.sqrt(n_apart)  # wheels and kinds each for themselves


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"robot": load_robot("husky"), "effects": {"payload_ratio": 0.1}},
            "robot husky: effects and learned terms of the drive 'skid_steer' act on a planar ground",
        ),
        ({"ground": {"tiles": SOILS["tiles"]}}, "scenario straight: terrain 'grass' has no soil"),
        ({"conditions": Conditions(payload_kg=300.0, payload_m=(0.6, 0.0))}, "tips it over: wheel 1 would"),
        (
            {"drive": Scenario("odd", 60.0, np.arange(9) / 60, np.zeros((9, 3)), ((0.0, "ice"),))},
            "divide 1000",
        ),
        ({"conditions": Conditions(payload_kg=1e5)}, "integrated in steps of 0.001 s: .*contacts are"),
        ({"robot": dataclasses.replace(ROBOT, mass_kg=0.1)}, "cannot be integrated .*tyres are"),
        ({"robot": with_part("body", yaw_inertia_kgm2=1e-9)}, "its motion cannot be integrated"),
        ({"robot": with_part("sensors", imu_rate_hz=1e9)}, "sensors: imu_rate_hz is 1e[+]09, at most 1000"),
        ({"robot": with_part("motors", speed_max_radps=1e6)}, "km of terrain are simulated at most"),
        ({"effects": {"gyro_scale_ratio": 0.5}}, "a number from -0.15 to 0.15"),
        *(({"command_delay_s": s}, "a time from 0 to 0.5 s is") for s in (-0.01, 0.51, math.nan, "soon")),
    ],
)
def test_invalid_simulations_are_refused_in_one_sentence(changed, message):
    drive = make_scenario("straight", ROBOT, "grass", 4.0)
    with pytest.raises(ConfigError, match=message) as error:
        simulate(**{"robot": ROBOT, "drive": drive, "ground": SOILS, "seed": 0} | changed)
    assert "\n" not in str(error.value)


STAND = Command(np.zeros(3), np.zeros(3), np.zeros(3), {})


class Listener:
    """A controller that keeps what it is given and asks another one what to do."""

    def __init__(self, controller):
        self.controller, self.samples = controller, []

    def __call__(self, sample):
        self.samples.append(sample)
        return self.controller(sample)

    def received(self, stream):
        given = [sample.readings[stream] for sample in self.samples if stream in sample.readings]
        return np.concatenate([r.time_s for r in given]), np.vstack([r.values for r in given])


def kinematic(sample):
    """Command the wheel speeds of the desired twist, with the steering straight ahead."""
    wheel = np.full(3, sample.twist[0] / 0.2) + sample.twist[2] * np.array([0.0, 0.0, 0.756 / 0.2])
    steer = np.array([-1.0, 1.0, 0.0]) * math.atan2(0.5075 * sample.twist[2], max(sample.twist[0], 0.1))
    return Command(wheel, steer, sample.twist, {})


@pytest.mark.parametrize(
    ("scenario", "terrain", "options"),
    [
        ("complex", "grass", {"conditions": HILLY, "gnss": Gnss(rate_hz=7.0), "duration_s": 28.0}),
        ("straight", "tiles", {"faults": Faults(camera_lost_s=((2.0, 3.51), (4.0, 4.001)))}),
        ("course", ["tiles", "snow", "grass"], {"duration_s": 20.0}),
    ],
)
def test_the_readings_of_a_controller_equal_the_log(scenario, terrain, options, tmp_path):
    listener = Listener(kinematic)
    run = run_of(scenario, terrain, 3, controller=listener, **options)
    drive = make_scenario(scenario, ROBOT, terrain, options.get("duration_s"))
    ticks_s = np.array([sample.time_s for sample in listener.samples])
    np.testing.assert_array_equal(ticks_s, drive.time_s)
    np.testing.assert_array_equal([sample.twist for sample in listener.samples], drive.twist)
    sensed = set(run.streams) - {"commands", "truth"}
    assert set().union(*(sample.readings for sample in listener.samples)) == sensed
    for name in sensed:
        stream = run.streams[name]
        time_s, values = listener.received(name)
        n = np.searchsorted(
            stream.time_s, ticks_s[-1], side="right"
        )  # after the last tick no controller runs
        assert time_s.tobytes() == stream.time_s[:n].tobytes()
        assert values.tobytes() == stream.values[:n].tobytes()
        for before_s, sample in zip([-1.0, *ticks_s[:-1]], listener.samples, strict=True):
            stamps = sample.readings[name].time_s if name in sample.readings else np.empty(0)
            assert ((stamps > before_s) & (stamps <= sample.time_s)).all()
    assert all(len(sample.readings["wheels"].time_s) == 1 for sample in listener.samples)
    for start_s, end_s in options.get("faults", Faults()).camera_lost_s:
        inside = [s for s in listener.samples if start_s + 0.02 <= s.time_s < end_s]
        assert not any("odometry" in sample.readings for sample in inside)
    truth = run.streams["truth"]
    for label in run.labels:
        for sample in listener.samples:
            if label.start_s <= sample.time_s < label.end_s:
                assert sample.terrain == label.terrain
    known = [sample.terrain for sample in listener.samples]
    assert (("" in known) and len(set(known)) > 2) == (scenario == "course")
    assert read_run(write_run(run, tmp_path)).streams["truth"].channels == truth.channels


@pytest.mark.parametrize("delay", [0, 33, 500])
def test_a_command_is_in_force_from_its_delay_to_that_of_the_next(delay, monkeypatch):
    given, advance, drive = [], dynamic.advance, make_scenario("straight", ROBOT, "clay", 4.0)
    wheel = 4 * np.random.default_rng(delay).random((len(drive.time_s), 3))
    rows = iter(wheel)

    def noted(plant, profile, state, wheel, *rest):
        given.append(wheel.copy())
        advance(plant, profile, state, wheel, *rest)

    def controller(sample):
        return STAND._replace(wheel_radps=next(rows))

    monkeypatch.setattr(dynamic, "advance", noted)
    run = run_of(drive, "clay", controller=controller, command_delay_s=delay / 1000)
    given = np.concatenate(given)[-20 * len(wheel) :]  # the robot was settled before
    np.testing.assert_array_equal(run.streams["commands"].values[:, 3:6], wheel)  # as decided, not as delayed
    tick = (np.arange(len(given)) - max(delay, 1)) // 20
    np.testing.assert_array_equal(given, np.where(tick[:, None] >= 0, wheel[tick], 0.0))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"wheel_radps": np.zeros(2)}, "wheel_radps of its command at 1.02 s is .*, 3 finite numbers"),
        ({"wheel_radps": np.array([0.0, math.nan, 0.0])}, "wheel_radps of its command at 1.02 s"),
        ({"steer_rad": [0.0, math.inf, 0.0]}, "steer_rad of its command at 1.02 s"),
        ({"steer_rad": "left"}, "steer_rad of its command at 1.02 s is 'left'"),
        ({"twist": np.zeros((3, 1))}, "twist of its command at 1.02 s"),
        ({"status": {}}, "at 1.02 s has nothing, that of the first has gain_ratio: the same names"),
        ({"status": {"gain_ratio": 1.0, "more_ratio": 1.0}}, "at 1.02 s has gain_ratio, more_ratio, that of"),
        ({"status": {"gain_ratio": "high"}}, "status of its command at 1.02 s: could not convert"),
        ({"status": None}, "status of its command at 1.02 s"),
    ],
)
def test_an_invalid_command_is_refused_with_its_time(changed, message):
    def controller(sample):
        command = STAND._replace(status={"gain_ratio": math.nan})
        return command._replace(**changed) if sample.time_s > 1.01 else command

    with pytest.raises(DataError, match=message) as error:
        run_of("straight", "grass", controller=controller, duration_s=4.0)
    assert "\n" not in str(error.value)


def test_a_controller_sees_nothing_of_a_motion_that_blows_up():
    listener = Listener(lambda sample: kinematic(sample)._replace(status={"gain_ratio": 1.0}))
    drive = make_scenario("arc", ROBOT, "grass", 5.0)
    with pytest.raises(ConfigError, match="its motion cannot be integrated"):
        simulate(with_part("motors", friction_nm=1e9), drive, SOILS, 0, controller=listener)
    for sample in listener.samples:
        assert all(np.isfinite(reading.values).all() for reading in sample.readings.values())


def test_a_status_whose_names_have_no_units_is_refused():
    with pytest.raises(DataError, match="status of its command at 0 s: channel 'mood' does not end in"):
        run_of("straight", "grass", controller=lambda _: STAND._replace(status={"mood": 1.0}), duration_s=4.0)
