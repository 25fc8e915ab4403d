"""One entry for all plants: seeds, channels, truth, noise as stated, loss, conditions, and a drive of one's own."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.angles import wrapped
from terrain.effects import EFFECTS, vector_of
from terrain.errors import ConfigError
from terrain.kernels import njit, record
from terrain.logs.schema import unit_of
from terrain.robots import load_robot
from terrain.simulation.plants import car, planar
from terrain.simulation.plants.planar import PLANAR_BODY, TRUTH, Ground, PlanarDrive, spread_numbers
from terrain.simulation.plants.tracks import TrackedSensors
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Conditions, Faults, make_scenario
from terrain.simulation.sensors import BODY
from terrain.terramechanics.soil import load_soil

AGRIMARO, HUSKY, ROBOTINO, CAR, PATAKO = map(
    load_robot, ("agrimaro", "husky", "robotino", "adap2e", "patako")
)
NOISE = {"noise": spread_numbers("noise"), "scatter": spread_numbers("scatter")}


def weave(sample):
    return car.CarCommand(0.1 * np.sin(sample.time_s), sample.speed_desired_mps)


def turning(speed_mps=0.5, turn_radps=0.3, seconds=8.0):
    twist = np.zeros((round(50 * seconds) + 1, 3))
    ramp = np.minimum(np.arange(len(twist)) / 50.0, 1.0)
    twist[:, 0], twist[:, 2] = speed_mps * ramp, turn_radps * ramp
    return twist


GRASS = {"grass": load_soil("grass")}
PLANTS = {
    "dynamic": (AGRIMARO, make_scenario("arc", AGRIMARO, "grass", 8.0), GRASS, {}),
    "skid": (HUSKY, turning(), Ground(), NOISE | {"heading": True}),
    "swerve": (AGRIMARO, turning(), Ground(), NOISE),
    "omni": (ROBOTINO, turning(0.15), Ground(), NOISE),
    "bicycle": (CAR, turning(), Ground(), NOISE | {"fixes": True}),
    "tracks": (PATAKO, np.tile([0.03, 0.08], (401, 1)), load_soil("dry_sand"), {}),
    "car": (CAR, car.CarDrive(2.0, duration_s=8.0), car.level_ground(0.7, 0.1), {"controller": weave}),
}


def run(plant, seed=3, **more):
    robot, drive, ground, options = PLANTS[plant]
    return simulate(robot, drive, ground, seed, **options | more)


def bytes_of(log):
    return {name: stream.values.tobytes() for name, stream in log.streams.items()}


@pytest.mark.parametrize("plant", PLANTS)
def test_the_same_seed_gives_the_same_bytes_and_another_one_other_sensors(plant):
    sequence = np.random.SeedSequence(3)
    one = bytes_of(run(plant))
    assert one == bytes_of(run(plant)) == bytes_of(run(plant, sequence)) == bytes_of(run(plant, sequence))
    other = bytes_of(run(plant, 4))
    still = {"commands", "truth"} | ({"steering"} if plant == "bicycle" else set())  # described without noise
    assert {name for name in one if one[name] == other[name]} <= still


@pytest.mark.parametrize("plant", PLANTS)
def test_every_channel_has_a_unit_every_logger_its_rate_from_0_on_and_the_truth_of_a_body_adds_up(plant):
    log = run(plant)
    for name, stream in log.streams.items():
        assert [unit_of(channel) for channel in stream.channels]
        assert stream.time_s[0] == 0.0
        np.testing.assert_allclose(np.diff(stream.time_s), 1.0 / stream.rate_hz, rtol=0, atol=2e-9)
        assert np.isfinite(stream.values[:, [not c.startswith("slip") for c in stream.channels]]).all(), name
    truth = log.streams["truth"]
    assert truth.channels[: len(BODY.names)] == BODY.names
    yaw, turn = np.unwrap(truth.channel("yaw_rad")), truth.channel("yaw_rate_radps")
    np.testing.assert_allclose(np.gradient(yaw, 0.01)[5:-5], turn[5:-5], atol=0.02)
    side = truth.channel("speed_y_mps") - CAR.com_ahead_m * turn * (plant == "car")
    velocity = (truth.channel("speed_x_mps") + 1j * side) * np.exp(1j * yaw)
    moved = np.cumsum(0.01 * velocity) - 0.01 * velocity
    place = truth.channel("position_x_m") + 1j * truth.channel("position_y_m")
    assert np.abs(moved - (place - place[0])).max() < 0.02
    assert np.abs(place[-1] - place[0]) > 0.2


@pytest.mark.parametrize("plant", [name for name in PLANTS if name != "car"])
def test_a_lost_camera_is_missing_and_all_else_the_same(plant):
    whole, lost = run(plant), run(plant, faults=Faults(camera_lost_s=((2.0, 4.0),)))
    name = "pose" if plant in ("omni", "tracks") else "odometry"
    t = whole.streams[name].time_s
    seen = (t < 2.0) | (t >= 4.0)
    np.testing.assert_array_equal(lost.streams[name].values, whole.streams[name].values[seen])
    found, expected = bytes_of(lost), bytes_of(whole)
    assert found | {name: None} == expected | {name: None}
    assert name not in run(plant, faults=Faults(camera_lost_s=((0.0, 99.0),))).streams


@pytest.mark.parametrize("plant", ["dynamic", "skid", "swerve", "bicycle", "tracks"])
def test_gravity_shows_on_a_slope_and_uphill_is_positive(plant):
    robot, _, ground, options = PLANTS[plant]
    still = {"dynamic": make_scenario("stand", robot, "grass", 6.0), "tracks": np.zeros((301, 2))}
    conditions = Conditions(grade_ratio=(0.1, -0.05))
    log = simulate(robot, still.get(plant, np.zeros((301, 3))), ground, 0, conditions=conditions, **options)
    truth, imu = log.streams["truth"], log.streams["imu"]
    pitch, roll = truth.channel("pitch_rad")[200:].mean(), truth.channel("roll_rad")[200:].mean()
    assert pitch == pytest.approx(-0.1, abs=0.01)
    assert roll == pytest.approx(-0.05, abs=0.01)
    force = imu.values[200:, 3:6].mean(axis=0) / 9.80665
    assert force == pytest.approx([-np.sin(pitch), np.sin(roll), np.cos(roll) * np.cos(pitch)], abs=0.03)


def test_noise_of_tracks_and_car_is_as_stated():
    for plant, gyro_radps, yaw_rad in (
        ("tracks", TrackedSensors().gyro_radps, 0.0087),
        ("car", car.GYRO_RADPS, car.COMPASS_RAD),
    ):
        streams = run(plant).streams
        truth, imu, fixes = streams["truth"], streams["imu"], streams["gnss"].channel("position_x_m")
        bias = truth.channel("gyro_bias_z_radps") if plant == "tracks" else 0.0
        gyro = imu.channel("gyro_z_radps") - bias - truth.channel("yaw_rate_radps")
        assert gyro.std() == pytest.approx(gyro_radps, rel=0.15)
        place, heading = (truth.channel(name)[::10][: len(fixes)] for name in ("position_x_m", "yaw_rad"))
        assert (fixes - place).std() == pytest.approx(0.02, rel=0.3)
        off_rad = wrapped(streams["compass"].values[:, 0] - heading)
        assert np.std(off_rad) == pytest.approx(yaw_rad, rel=0.3)


def test_an_effect_of_the_sensors_and_another_logger_leave_all_else_alone():
    plain = bytes_of(run("skid", heading=False))
    heavy = bytes_of(run("skid", heading=False, effects={"motor_constant_ratio": 0.1}))
    assert [name for name in plain if heavy[name] != plain[name]] == ["wheels"]
    with_lidar = bytes_of(run("skid"))
    assert {name: value for name, value in with_lidar.items() if name != "lidar"} == plain
    payload = replace(HUSKY, effects={"payload_ratio": 0.5})
    log = simulate(payload, turning(), Ground(), 3, conditions=Conditions(payload_kg=0.1 * HUSKY.mass_kg))
    same = simulate(HUSKY, turning(), Ground(), 3, effects={"payload_ratio": 0.6})
    np.testing.assert_allclose(log.streams["wheels"].values, same.streams["wheels"].values, atol=1e-9)


CAR_GIVEN = CAR, car.CarDrive(1.0), car.level_ground()


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (
            (HUSKY, np.zeros((9, 2)), load_soil("dry_sand")),
            {},
            "robot husky: drive 'skid_steer' has no tracks",
        ),
        ((HUSKY, *CAR_GIVEN[1:]), {"controller": weave}, "'skid_steer' is no car"),
        (
            (PATAKO, np.zeros((9, 2)), load_soil("dry_sand")),
            {"effects": {"payload_ratio": 0.1}},
            "no effects",
        ),
        (
            CAR_GIVEN,
            {"controller": weave, "conditions": Conditions(payload_kg=1.0)},
            "neither conditions nor",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(given, options, message):
    with pytest.raises(ConfigError, match=message):
        simulate(*given, 0, **options)


def test_names_that_do_not_go_together_are_refused():
    for given, message in (
        (("husky", "course", "straight"), "go together"),
        (("agrimaro", "grass", "course"), "go together"),
        (("agrimaro", "grass", "six_positions"), "give the terrain 'bench'"),
        (("agrimaro", "course", "slip"), "is driven on one terrain"),
    ):
        with pytest.raises(ConfigError, match=message):
            simulate_run(*given)


# -- A new drive: its record, its kernel and its entry; loggers, replay and effects of the sensors are there ----------

RAILS = record({"body": PLANAR_BODY, "gauge_m": float})


@njit
def _on_rails(params, vector, dt, inputs):
    """Wheels on rails: the body moves as fast as they roll, less what a grade takes, and never turns."""
    wheel_speed_mps, _, grade_rad, _, _ = inputs
    rails, p, n = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros(n, TRUTH)
    for k in range(n):
        slip = rails.body.soft_ratio[0] * np.sin(grade_rad[k])
        rolled = wheel_speed_mps[k].mean() * (1.0 + p.wheel_radius_ratio)
        out[k].speed_x_mps, out[k].slip_ratio = rolled * (1.0 - slip), slip
    return out


def test_a_new_drive_is_a_record_a_kernel_and_an_entry(monkeypatch):
    trolley = PlanarDrive(RAILS, lambda robot, ground: {"gauge_m": robot.track_m}, _on_rails)
    monkeypatch.setattr(planar, "DRIVES", {**planar.DRIVES, "skid_steer": trolley})
    uphill = Conditions(grade_ratio=(0.1, 0.0))
    log = simulate(HUSKY, turning(0.5, 0.0), Ground(slip_ratio=0.5), 0, conditions=uphill, **NOISE)
    truth = log.streams["truth"]
    slip = 0.5 * np.sin(np.arctan(0.1))
    assert truth.channel("slip_left_ratio")[-1] == pytest.approx(slip, abs=0.03)
    assert set(log.streams) == {"wheels", "imu", "odometry", "commands", "truth"}
    larger, plain = (
        planar.move(
            planar.make_planar(HUSKY, Ground()), vector_of(p), 0.02, np.full((9, 2), 0.5), *[np.zeros(9)] * 3
        )
        for p in ({"wheel_radius_ratio": 0.1}, {})
    )
    np.testing.assert_allclose(larger["speed_x_mps"], 1.1 * plain["speed_x_mps"])
