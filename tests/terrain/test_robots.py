"""Robots: what each drive is, sections of descriptions, and descriptions that cannot be."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrain.errors import ConfigError
from terrain.files.names import data_folder
from terrain.robots import (
    BicycleRobot,
    MecanumRobot,
    Robot,
    SkidSteerRobot,
    SwerveRobot,
    TrackedRobot,
    TricycleRobot,
    as_drive,
    load_robot,
    robot_from,
)
from terrain.simulation.assumed import with_assumed

NAMES = ("agrimaro", "husky", "robotino", "adap2e", "orchard_ugv")
AGRIMARO, HUSKY, ROBOTINO, CAR, UGV = ROBOTS = [load_robot(name) for name in NAMES]


def test_every_drive_is_its_wheels_and_what_it_can_do_follows_from_them():
    for robot in ROBOTS:
        n = len(robot.wheels)
        assert robot.wheel_positions_m.shape == (n, 2)
        assert robot.wheel_directions_rad.shape == robot.steering_zeros_rad.shape == (n,)
        assert len(robot.rate_channels) == len(robot.wheel_rows) == len(robot.logged_wheels)
        assert robot.steered_wheels == robot.wheels[: len(robot.steer_rows)]
        assert (robot.steering_rate_max_radps > 0) == robot.steered
        if robot not in (CAR, UGV):  # whose sensors are part of their simulations
            robot.require(*robot.sections)
        speed_mps = np.array([0.2, -0.1, 0.4])[:n]
        logged = robot.logged_rates(speed_mps)
        if robot.by_motor:
            logged = robot.wheel_speeds_mps(logged / robot.motors.reduction_ratio)
        np.testing.assert_allclose(logged, speed_mps[-len(robot.logged_wheels) :], rtol=1e-12)
        copy = pickle.loads(pickle.dumps(robot))
        assert copy == robot
        assert copy.wheels == robot.wheels
    assert [robot.sideways for robot in ROBOTS] == [True, False, True, False, False]
    assert [robot.on_omni_wheels for robot in ROBOTS] == [False, False, True, False, False]
    assert (CAR.rate_channels, CAR.steer_channels) == (("speed_rear_mps",), ("angle_front_rad",))
    positions, directions = ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 0.125, rtol=1e-9)
    lever = positions[:, 0] * np.sin(directions) - positions[:, 1] * np.cos(directions)
    np.testing.assert_allclose(lever, 0.125, rtol=1e-9)  # all turn it to the left
    np.testing.assert_allclose(positions.sum(axis=0), 0.0, atol=1e-9)


def test_a_section_that_is_not_described_is_named_and_a_completed_robot_has_a_neutral_one():
    for section in ("body", "motors", "camera", "sensors", "steering"):
        bare = HUSKY.without(section)
        assert not bare.describes(section)
        for ask in (getattr, Robot.require):
            with pytest.raises(
                ConfigError, match=f"^robot husky: its description has no section '{section}', which is"
            ):
                ask(bare, section)
    with pytest.raises(AttributeError, match="no attribute 'wings'"):
        HUSKY.wings  # noqa: B018
    bare = AGRIMARO.without("sensors", "camera", "body")
    complete = bare.completed
    assert complete.motors == AGRIMARO.motors
    assert complete.describes("body", "motors", "steering", "camera", "sensors")
    assert (complete.body.com_x_m, complete.body.com_y_m) == tuple(AGRIMARO.wheel_positions_m.mean(axis=0))
    assert complete.sensors.accel_scale_x_ratio == 1.0
    assert complete.sensors.imu_latency_s == complete.camera.lever_x_m == bare.encoder_lag_s == 0.0
    assert np.isnan([complete.sensors.gyro_std_radps, complete.camera.speed_std_mps]).all()
    assert AGRIMARO.completed == AGRIMARO
    with pytest.raises(TypeError, match="section 'camera' is a Sensors"):
        AGRIMARO.with_parts(camera=AGRIMARO.sensors)
    assert as_drive(SwerveRobot, AGRIMARO, "") is AGRIMARO
    with pytest.raises(ConfigError, match=r"^agrimaro: 'swerve' does not skid$"):
        as_drive(SkidSteerRobot, AGRIMARO, "{name}: {drive!r} does not skid")


@pytest.mark.parametrize(
    ("robot", "change", "message"),
    [
        (ROBOTINO, {"track_m": 0.5}, "the footprint allows up to 0.185 m"),
        (ROBOTINO, {"track_m": -0.1}, "wheel_distance_m must be above zero"),
        (ROBOTINO, {"body": {"com_x_m": 0.2}}, "outside the triangle of the wheels: wheel 2 would carry"),
        (AGRIMARO, {"body": {"com_x_m": 0.6}}, "outside the triangle of the wheels: wheel 1 would carry"),
        (HUSKY, {"body": {"com_y_m": 0.3}}, "com_y_m is 0.3, -0.285 to 0.285 m is expected"),
        (AGRIMARO, {"track_m": 1.5}, "track_m is 1.5; the footprint allows"),
        (UGV, {"track_width_m": 2.0}, "the tracks would overlap"),
        (CAR, {"com_ahead_m": 2.0}, "between 0 and wheelbase_m"),
        (CAR, {"steering_max_rad": 2.0}, "below pi/2 is required"),
    ],
)
def test_impossible_dimensions_are_refused(robot, change, message):
    if "body" in change:
        robot, change = robot.with_parts(body=replace(robot.body, **change["body"])), {}
    with pytest.raises(ConfigError, match=message):
        replace(robot, **change).check_geometry("robot")


def test_a_centre_of_mass_beyond_the_wheelbase_is_named_and_not_what_follows_from_it():
    described = yaml.safe_load((data_folder("robots") / "adap2e.yaml").read_text())
    for presumed in ("front_cornering_npr", "rear_cornering_npr"):
        del described[presumed]
    described["com_ahead_m"] = {"value": 2.0, "unit": "m", "source": "written"}
    with pytest.raises(ConfigError, match=r"^own\.yaml: com_ahead_m is 2, between 0 and wheelbase_m"):
        robot_from("own.yaml", described)


BAD_SIZES = [
    (HUSKY, "wheel_radius_m", 22.0, "0.004 to 2.5 m is expected: in cm?"),
    (HUSKY, "wheel_radius_m", 6.5, "0.004 to 2.5 m is expected: in cm?"),  # inches
    (HUSKY, "wheel_radius_m", 0.00165, "is expected"),
    (HUSKY, "track_m", 570.8, "0.02 to 25 m is expected: in mm?"),
    (HUSKY, "track_m", 5.708, "beside track_m 5.71, wheelbase_m 0.512, wheel_radius_m 0.165"),
    (HUSKY, "wheelbase_m", 0.0512, "wheelbase_m is 0.0512, 0.0951 to 3.42 m is expected"),
    (HUSKY, "mass_kg", 50_000.0, "in g?"),
    (HUSKY, "mass_kg", 0.05, "in t?"),
    (HUSKY, "body.yaw_inertia_kgm2", 37_000.0, "of 50 kg and track_m 0.571"),
    (HUSKY, "body.com_height_m", 190.0, "in mm?"),
    (HUSKY, "body.contact_length_m", 100.0, "in mm?"),
    (HUSKY, "body.tyre_stiffness_npm", 40.0, "in N/mm?"),
    (HUSKY, "motors.efficiency_ratio", 70.0, "in %?"),
    (HUSKY, "motors.speed_max_radps", 6.1 * 60 / (2 * math.pi), "motors.supply_v is 24, 67.2 to"),  # rpm
    (HUSKY, "motors.reduction_ratio", 1 / 78.71, "motors.supply_v is 24"),
    (HUSKY, "motors.torque_max_nm", 60_000.0, "in mNm?"),
    (HUSKY, "motors.torque_time_constant_s", 5.0, "in ms?"),
    (HUSKY, "camera.lever_x_m", 350.0, "a robot of 0.571 m): in mm?"),
    (HUSKY, "camera.latency_s", 20.0, "in ms?"),
    (HUSKY, "sensors.gyro_bias_z_radps", 3.0, "in deg/s?"),
    (HUSKY, "identified.effective_track_m", 5.0, "track_m is 0.571 m"),
    (HUSKY, "identified.effective_track_grass_m", 5.0, "track_m is 0.571 m"),
    (HUSKY, "identified.rolling_radius_m", 0.33, "wheel_radius_m is 0.165 m"),
    (AGRIMARO, "steering.rate_max_radps", 120.0, "in deg/s?"),
    (AGRIMARO, "steering.zero_1_rad", 90.0, "in deg?"),
    (ROBOTINO, "wheel_radius_m", 4.0, "is expected"),
    (ROBOTINO, "first_wheel_rad", 60.0, "in deg?"),
    (UGV, "wheel_radius_m", 15.0, "sprocket_radius_m is 15"),
    (UGV, "wheelbase_m", 120.0, "contact_length_m is 120"),
    (CAR, "steering_max_rad", 20.0, "degrees?"),
    (CAR, "speed_max_mps", 300.0, "0.01 to 120 m/s is expected: in"),
    (CAR, "front_cornering_npr", 260.0, "in N/deg?"),
    (CAR, "yaw_inertia_kgm2", 2.0, "of 420 kg and track_m"),
]


@pytest.mark.parametrize(("robot", "name", "value", "message"), BAD_SIZES)
def test_a_size_that_cannot_belong_to_the_others_is_refused_with_its_likely_unit(robot, name, value, message):
    """One number in another unit, or by a factor of ten: the sentence names it, and what is expected."""
    section, _, key = name.rpartition(".")
    if section == "identified":
        robot = replace(robot, identified={key: value})
    elif section:
        robot = robot.with_parts(**{section: replace(robot.parts[section], **{key: value})})
    else:
        robot = replace(robot, **{key: value})
    with pytest.raises(ConfigError, match=r"^mine\.yaml: ") as error:
        robot.check_geometry("mine.yaml")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("factor", [0.2, 1.0, 8.0])
@pytest.mark.parametrize("robot", [HUSKY, AGRIMARO, ROBOTINO, UGV, CAR])
def test_sizes_belong_together_at_any_scale(robot, factor):
    """Geometrically similar robots of equal density: lengths by k, masses by k^3."""
    scaled = {name: getattr(robot, name) * factor for name in ("wheel_radius_m", "track_m", "wheelbase_m")}
    scaled |= {"mass_kg": robot.mass_kg * factor**3, "parts": {}}
    if robot is CAR:
        scaled |= {"com_ahead_m": robot.com_ahead_m * factor, "com_height_m": robot.com_height_m * factor}
        scaled |= {
            name: getattr(robot, name) * factor**3 for name in ("front_cornering_npr", "rear_cornering_npr")
        }
        scaled["yaw_inertia_kgm2"] = robot.yaw_inertia_kgm2 * factor**5
    if robot is UGV:
        scaled |= {"com_height_m": robot.com_height_m * factor, "track_width_m": robot.track_width_m * factor}
    replace(robot, **scaled).check_geometry("robot")


#: Robots of four numbers, and of what their drive needs beside.
BUILT = [
    SkidSteerRobot("quad", 0.3, 1.6, 2.2, 1200.0),
    SkidSteerRobot("mini", 0.05, 0.25, 0.2, 3.0),
    SkidSteerRobot("gantry", 0.2, 3.0, 1.5, 150.0),
    SkidSteerRobot("narrow", 0.1, 0.3, 1.2, 60.0),
    TrackedRobot("harvester", 0.4, 3.0, 4.5, 25_000.0, track_width_m=0.6, com_height_m=1.5),
    MecanumRobot("cart", 0.05, 0.3, 0.4, 20.0),
    BicycleRobot("tractor", 0.8, 1.8, 2.6, 5000.0, com_ahead_m=1.0, com_height_m=1.0, yaw_inertia_kgm2=6000.0,
                 front_cornering_npr=2e5, rear_cornering_npr=3e5),
    BicycleRobot("model car", 0.05, 0.25, 0.32, 3.5, com_ahead_m=0.16, com_height_m=0.05, yaw_inertia_kgm2=0.05,
                 front_cornering_npr=60.0, rear_cornering_npr=60.0),
    BicycleRobot("dump truck", 1.9, 7.0, 7.2, 300_000.0, com_ahead_m=3.0, com_height_m=3.0, yaw_inertia_kgm2=3e6,
                 front_cornering_npr=4e6, rear_cornering_npr=6e6),
    TricycleRobot("pallet jack", 0.04, 0.5, 1.2, 80.0, com_ahead_m=0.6, yaw_inertia_kgm2=10.0),
]  # fmt: skip


@pytest.mark.parametrize("robot", BUILT)
def test_sizes_of_vehicles_that_are_built_and_what_is_assumed_of_them_belong_together(robot):
    robot.check_geometry("robot")
    with_assumed(robot).check_geometry("robot")


def test_a_car_is_described_by_six_numbers_and_lists_what_is_missing_at_once(tmp_path):
    file = data_folder("robots") / "adap2e.yaml"
    keys = [
        "name",
        "drive",
        "wheel_radius_m",
        "track_m",
        "wheelbase_m",
        "mass_kg",
        "steering_max_rad",
        "speed_max_mps",
    ]
    full = yaml.safe_load(file.read_text())
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump({key: full[key] for key in keys}))
    car, described = load_robot(path), load_robot(file)
    for key in set(type(car).presumed):
        assert getattr(car, key) == pytest.approx(getattr(described, key), rel=0.5)
        assert key in car.assumed
    # half of the weight on each axle, a car turns as its geometry says
    assert car.understeer_s2pm == pytest.approx(0.0, abs=1e-12)
    written = yaml.safe_load(path.read_text())
    written["speed_max_mps"]["unit"] = "m/s"  # as units are usually written
    path.write_text(yaml.safe_dump(written))
    assert load_robot(path).speed_max_mps == car.speed_max_mps
    path.write_text(yaml.safe_dump({"name": "car", "drive": "bicycle", "mass_kg": full["mass_kg"]}))
    with pytest.raises(
        ConfigError, match=r"keys 'wheel_radius_m', 'track_m', .* 'speed_max_mps' are missing"
    ):
        load_robot(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(wheels=4), "key 'wheels' is unknown"),
        (lambda d: d.pop("track_m"), "key 'track_m' is missing"),
        (lambda d: d["track_m"].update(value=0.0), "track_m is 0.0, a number above zero"),
        (lambda d: d["track_m"].update(value=math.inf), "track_m is inf"),
        (lambda d: d["track_m"].update(value="wide"), "track_m is 'wide'"),
        (lambda d: d["track_m"].update(value=True), "track_m is True"),
        (lambda d: d["track_m"].update(unit="mm"), "track_m has the unit 'mm', 'm' is required"),
        (lambda d: d["track_m"].pop("source"), "track_m: key 'source' is missing"),
        (lambda d: d["track_m"].update(source=" "), "track_m has no source"),
        (lambda d: d.update(track_m=0.57), "track_m is 0.57, a mapping with value, unit, source"),
        (lambda d: d.update(drive="legs"), "drive 'legs' is unknown"),
    ],
)
def test_a_description_that_cannot_be_is_refused_in_one_sentence(tmp_path, change, message):
    described = yaml.safe_load((data_folder("robots") / "husky.yaml").read_text())
    change(described)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(described))
    with pytest.raises(ConfigError, match=r"mine\.yaml") as error:
        load_robot(path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_robot_is_named():
    for name in ("rover", "../robots/husky", "none.yaml"):
        with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
            load_robot(name)
