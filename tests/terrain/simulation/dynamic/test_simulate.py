import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.logs.read import read_run
from terrain.logs.write import write_run
from terrain.robots import load_robot
from terrain.simulation.conditions import Conditions, Faults
from terrain.simulation.dynamic.simulate import COMMAND_CHANNELS, simulate
from terrain.simulation.scenario import Scenario, make_scenario
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
    drive = (
        scenario if isinstance(scenario, Scenario) else make_scenario(scenario, ROBOT, terrain, duration_s)
    )
    return simulate(ROBOT, drive, SOILS, seed, **options)


@lru_cache
def straight(terrain, seed):
    """Return the run of thesis 7.2.3: from rest at 1 m/s2 to 1 m/s."""
    return run_of("straight", terrain, seed, 15.0)


def wheels_of(stream, pattern):
    return np.column_stack([stream.channel(pattern.format(i)) for i in (1, 2, 3)])


def same(one, other):
    return all(
        one.streams[name].channels == other.streams[name].channels
        and np.array_equal(one.streams[name].time_s, other.streams[name].time_s)
        and np.array_equal(one.streams[name].values, other.streams[name].values, equal_nan=True)
        for name in one.streams
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("terrain", "low", "high"),
    [("tiles", -0.01, 0.01), ("grass", 0.116, 0.135), ("firm_soil_gravel", 0.122, 0.146)],
)
def test_steady_slip_is_the_one_measured_in_the_field(terrain, low, high, seed):
    truth = straight(terrain, seed).streams["truth"]
    steady = truth.time_s > 5.0
    assert low < wheels_of(truth, "slip_{}_ratio")[steady].mean() < high


@pytest.mark.parametrize("seed", range(3))
def test_a_start_slips_most_on_gravel_then_on_grass_then_on_tiles(seed):
    peaks = []
    for terrain in ("tiles", "grass", "firm_soil_gravel"):
        truth = straight(terrain, seed).streams["truth"]
        start = (truth.channel("speed_x_mps") > 0.2) & (truth.time_s < 3.0)
        slip = wheels_of(truth, "slip_{}_ratio")[start].mean(axis=1)
        peaks.append(slip.max())
        assert peaks[-1] > 2 * np.mean(wheels_of(truth, "slip_{}_ratio")[truth.time_s > 5.0])
    assert peaks[0] < 0.05 < 0.25 < peaks[1] < peaks[2] - 0.03 < 0.6


def test_vibration_orders_the_terrains_by_their_roughness_and_grows_with_the_speed():
    def shaking(run):
        imu = run.streams["imu"]
        return imu.channel("accel_z_mps2")[imu.time_s > 5.0].std()

    by_roughness = sorted(SOILS, key=lambda name: SOILS[name].roughness_m3)
    shaken = [shaking(straight(name, 1)) for name in by_roughness]
    classes = {SOILS[name].roughness_m3: value for name, value in zip(by_roughness, shaken, strict=True)}
    assert (np.diff(list(classes.values())) > 0.25 * np.array(list(classes.values()))[:-1]).all()
    speeds = [
        shaking(run_of(make_scenario("straight", ROBOT, "grass", 12.0, speed_mps=speed), "grass"))
        for speed in (0.4, 0.8, 1.6)
    ]
    assert (np.diff(speeds) > 0.2 * np.array(speeds[:-1])).all()


def test_the_truth_agrees_with_itself():
    """Slip, slip angle and acceleration once more, from the positions and speeds beside them."""
    run = run_of("complex", "grass", 3, conditions=HILLY)
    truth = run.streams["truth"]
    t = truth.time_s
    v = np.column_stack([truth.channel("speed_x_mps"), truth.channel("speed_y_mps")])
    turn, yaw = truth.channel("yaw_rate_radps"), truth.channel("yaw_rad")
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
    # central differences over 20 ms: within what the acceleration changes in that time
    accel = np.gradient(v, t, axis=0) + turn[:, None] * np.column_stack([-v[:, 1], v[:, 0]])
    true_accel = np.column_stack([truth.channel("accel_x_mps2"), truth.channel("accel_y_mps2")])
    assert np.sqrt(((accel - true_accel) ** 2).mean()) < 0.05 * true_accel.std()
    c, s = np.cos(yaw), np.sin(yaw)
    world = np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]])
    moved = np.cumsum(0.5 * (world[1:] + world[:-1]) * np.diff(t)[:, None], axis=0)
    place = np.column_stack([truth.channel("position_x_m"), truth.channel("position_y_m")])
    np.testing.assert_allclose(moved, place[1:] - place[0], atol=5e-3)
    assert np.ptp(place, axis=0).min() > 1.0
    mass_n = 105.0 * 9.80665
    assert wheels_of(truth, "normal_{}_n").sum(axis=1).mean() == pytest.approx(mass_n, rel=0.01)


def test_sensor_streams_agree_with_the_truth():
    run = run_of("complex", "tiles", 1)
    truth, wheels, steering, imu = (run.streams[name] for name in ("truth", "wheels", "steering", "imu"))
    for i in (1, 2, 3):
        lagged = np.interp(wheels.time_s - 0.05, truth.time_s, truth.channel(f"wheel_{i}_radps"))
        error = wheels.channel(f"motor_{i}_radps") / 10.0 - lagged
        assert abs(error[50:].mean()) < 0.01
        assert (
            np.abs(error[50:]).max() < 0.6
        )  # a Hall step is 0.14 rad/s behind the low-pass, and the lag is no delay
        turned = np.interp(steering.time_s, truth.time_s, truth.channel(f"steer_{i}_rad"))
        assert np.abs(steering.channel(f"angle_{i}_rad") - turned).max() < 0.01
    bias = imu.channel("gyro_z_radps") - np.interp(
        imu.time_s - 0.008, truth.time_s, truth.channel("yaw_rate_radps")
    )
    assert np.median(bias) == pytest.approx(np.median(truth.channel("gyro_bias_z_radps")), abs=5e-4)
    commands = run.streams["commands"]
    assert commands.channels == COMMAND_CHANNELS
    np.testing.assert_array_equal(commands.values[:, :3], make_scenario("complex", ROBOT, "tiles").twist)


@pytest.mark.parametrize("added", ["camera", "gnss"])
def test_an_added_fault_or_sensor_changes_no_other_stream(added):
    options = {
        "camera": {"faults": Faults(camera_lost_s=((1.0, 3.0),), by_chance=False)},
        "gnss": {"gnss": Gnss(), "faults": Faults(gnss_lost_s=((2.0, 3.0),))},
    }[added]
    plain, changed = (run_of("straight", "grass", 5, 6.0, **given) for given in ({}, options))
    assert ("gnss" in changed.streams) == (added == "gnss")
    assert (len(plain.streams["odometry"]) > len(changed.streams["odometry"])) == (added == "camera")
    for name in ("wheels", "steering", "imu", "commands", "truth"):
        np.testing.assert_array_equal(plain.streams[name].values, changed.streams[name].values)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    def written(folder, seed):
        run = run_of("arc", "clay", seed, 8.0, conditions=HILLY, gnss=Gnss())
        path = write_run(run, tmp_path / folder)
        return {file.name: file.read_bytes() for file in path.iterdir()}

    one, again, other = written("one", 0), written("again", 0), written("other", 1)
    assert one == again
    assert {name for name in one if one[name] == other[name]} == {"run.json", "commands.parquet"}


def test_labels_cover_stretches_with_all_wheels_on_one_terrain():
    time_s = np.arange(601) / 50
    twist = np.column_stack([np.minimum(time_s, 1.0), np.zeros((601, 2))])
    patches = ((0.0, "tiles"), (3.0, "grass"), (6.0, "snow"))
    run = simulate(ROBOT, Scenario("mine", 50.0, time_s, twist, patches), SOILS, 1)
    truth = run.streams["truth"]
    x = (
        truth.channel("position_x_m")[:, None]
        + ROBOT.wheel_positions_m[:, 0] * np.cos(truth.channel("yaw_rad"))[:, None]
    )
    under = np.searchsorted([3.0, 6.0], x, side="right")
    assert run.terrains == ("tiles", "grass", "snow")
    for number, label in enumerate(run.labels):
        inside = (truth.time_s >= label.start_s) & (truth.time_s < label.end_s)
        alone = (under == number).all(axis=1)
        # the robot drifts by centimetres: distance travelled is not quite x
        assert (inside != alone).sum() <= 3
    ends = [label.end_s for label in run.labels]
    starts = [label.start_s for label in run.labels]
    assert starts[0] == 0.0
    assert all(
        start > end + 0.9 for start, end in zip(starts[1:], ends[:-1], strict=True)
    )  # 1.015 m at 1 m/s


def test_a_ground_that_is_crossed_in_a_moment_gets_no_label():
    time_s = np.arange(501) / 50
    twist = np.column_stack([np.minimum(time_s, 1.0), np.zeros((501, 2))])
    drive = Scenario("mine", 50.0, time_s, twist, ((0.0, "tiles"), (3.0, "asphalt"), (4.3, "snow")))
    assert simulate(ROBOT, drive, SOILS, 1).terrains == ("tiles", "snow")


def test_terrain_varies_along_the_path_as_soil_and_conditions_state(monkeypatch):
    plants = []

    def noted(plant, profile, state, wheel, steer, substeps, noise, rows):
        plants.append(profile)
        rows[:] = np.zeros(1, rows.dtype)

    monkeypatch.setattr("terrain.simulation.dynamic.simulate.advance", noted)
    rough = Scatter("friction_angle_rad", 0.0, 0.3), Scatter("rolling_resistance_ratio", 0.0, 0.5)
    soils = {
        "tiles": dataclasses.replace(SOILS["tiles"], scatter=()),
        "rough": dataclasses.replace(SOILS["grass"], scatter=rough),
    }
    time_s = np.arange(20_001) / 50
    drive = Scenario("mine", 50.0, time_s, np.zeros((len(time_s), 3)), ((0.0, "tiles"), (100.0, "rough")))
    simulate(ROBOT, drive, soils, 0, conditions=Conditions(roughness_factor=3.0, field_length_m=1.0))
    (plant,) = plants
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


def test_a_course_is_labelled_ground_by_ground():
    course = make_scenario("course", ROBOT, ["tiles", "dry_sand", "grass"], 40.0, seed=2)
    run = run_of(course, None, 0)
    assert len(run.labels) >= 3
    assert len(run.terrains) >= 2
    for label, after in zip(run.labels, run.labels[1:], strict=False):
        assert label.start_s + 0.5 <= label.end_s < after.start_s
        assert label.terrain != after.terrain
    assert run.terrains[0] == course.patches[0].terrain
    slip, t = wheels_of(run.streams["truth"], "slip_{}_ratio").mean(axis=1), run.streams["truth"].time_s
    by_ground = {
        label.terrain: np.nanmedian(slip[(t > label.start_s + 1.0) & (t < label.end_s)])
        for label in run.labels
    }
    assert all(by_ground["tiles"] < value - 0.05 for name, value in by_ground.items() if name != "tiles")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"robot": load_robot("husky")}, "robot husky: drive 'skid_steer' is not simulated"),
        ({"robot": ROBOT.without("camera")}, "robot agrimaro: .* no section 'camera'"),
        ({"soils": {"tiles": SOILS["tiles"]}}, "scenario straight: terrain 'grass' has no soil"),
        (
            {"conditions": Conditions(payload_kg=300.0, payload_m=(0.6, 0.0))},
            "tips it over: wheel 1 would carry nothing",
        ),
        (
            {"scenario": Scenario("odd", 60.0, np.arange(9) / 60, np.zeros((9, 3)), ((0.0, "grass"),))},
            "scenario odd: rate_hz is 60, it must divide 1000",
        ),
        ({"conditions": Conditions(payload_kg=1e6)}, "its motion cannot be integrated"),
        ({"robot": dataclasses.replace(ROBOT, mass_kg=1e9)}, "its motion cannot be integrated"),
        ({"robot": with_part("body", yaw_inertia_kgm2=1e-9)}, "its motion cannot be integrated"),
        ({"robot": with_part("body", tyre_stiffness_npm=1e12)}, "its motion cannot be integrated"),
        ({"robot": with_part("sensors", imu_rate_hz=1e9)}, "sensors: imu_rate_hz is 1e[+]09, at most 1000"),
        ({"robot": with_part("motors", speed_max_radps=1e6)}, "km of terrain are simulated at most"),
    ],
)
def test_invalid_simulations_are_refused_in_one_sentence(changed, message):
    given = {
        "robot": ROBOT,
        "scenario": make_scenario("straight", ROBOT, "grass", 4.0),
        "soils": SOILS,
        "seed": 0,
    }
    with pytest.raises(ConfigError, match=message) as error:
        simulate(**given | changed)
    assert "\n" not in str(error.value)


def test_a_run_reads_back_as_it_was_written(tmp_path):
    for scenario, options in (
        ("complex", {"gnss": Gnss(), "faults": Faults(camera_lost_s=((5.0, 8.0),))}),
        ("stand", {}),
        ("straight", {"faults": Faults(camera_lost_s=((0.0, math.inf),)), "run_id": "blind"}),
    ):
        run = run_of(scenario, "tilled_loam", 2, conditions=HILLY, **({"run_id": scenario} | options))
        back = read_run(write_run(run, tmp_path))
        assert same(run, back)
        assert set(run.streams) == set(back.streams)
        assert (run.run_id, run.robot, run.labels, run.source) == (
            back.run_id,
            back.robot,
            back.labels,
            back.source,
        )
        assert ("odometry" in run.streams) == (run.run_id != "blind")


def test_a_seed_sequence_can_be_given_twice():
    sequence = np.random.SeedSequence([3, 4])
    one, again = (run_of("straight", "snow", sequence, 4.0) for _ in range(2))
    assert same(one, again)
    assert sequence.n_children_spawned == 0
    first, second = (run_of("straight", "snow", child, 4.0) for child in sequence.spawn(2))
    assert not np.array_equal(first.streams["imu"].values, second.streams["imu"].values)
    assert not same(one, first)
    assert same(run_of("straight", "snow", 7, 4.0), run_of("straight", "snow", np.int64(7), 4.0))
