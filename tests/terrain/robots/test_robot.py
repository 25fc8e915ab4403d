import pickle
from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.robots import OmniRobot, SkidSteerRobot, SwerveRobot, as_drive, load_robot

AGRIMARO, HUSKY, ROBOTINO = (load_robot(name) for name in ("agrimaro", "husky", "robotino"))


def test_the_drive_of_a_description_is_the_type_of_the_robot():
    assert isinstance(AGRIMARO, SwerveRobot)
    assert isinstance(HUSKY, SkidSteerRobot)
    assert not hasattr(HUSKY, "steering")


@pytest.mark.parametrize("robot", [AGRIMARO, HUSKY, ROBOTINO], ids=lambda robot: robot.name)
def test_every_drive_type_provides_the_robot_interface(robot):
    n = len(robot.wheels)
    assert robot.wheel_positions_m.shape == (n, 2)
    assert len(robot.rate_channels) == len(robot.wheel_rows) == len(robot.steering_zeros_rad) == n
    assert robot.wheel_directions_rad.shape == (n,)
    assert len(robot.steer_rows) == (n if robot.steered else 0)
    assert (robot.steering_rate_max_radps > 0) == robot.steered
    assert robot.describes(*robot.sections)
    robot.require(*robot.sections)


@pytest.mark.parametrize("section", ["body", "motors", "camera", "sensors"])
def test_a_section_that_is_not_described_is_named_when_it_is_asked_for(section):
    bare = HUSKY.without(section)
    assert not bare.describes(section)
    message = f"robot husky: its description has no section '{section}', which is needed here"
    for ask in (lambda: getattr(bare, section), lambda: bare.require(section)):
        with pytest.raises(ConfigError) as error:
            ask()
        assert str(error.value) == message


def test_a_completed_robot_keeps_its_parts_and_adds_neutral_ones():
    bare = AGRIMARO.without("sensors", "camera", "body")
    complete = bare.completed
    assert complete.motors == AGRIMARO.motors
    assert complete.describes("body", "motors", "steering", "camera", "sensors")
    assert (complete.body.com_x_m, complete.body.com_y_m) == tuple(AGRIMARO.wheel_positions_m.mean(axis=0))
    assert complete.sensors.accel_scale_x_ratio == 1.0
    assert complete.sensors.imu_latency_s == complete.camera.lever_x_m == bare.encoder_lag_s == 0.0
    assert np.isnan([complete.sensors.gyro_std_radps, complete.camera.speed_std_mps]).all()
    assert AGRIMARO.completed == AGRIMARO


def test_a_part_of_the_wrong_kind_is_refused():
    with pytest.raises(TypeError, match="section 'camera' is a Sensors"):
        AGRIMARO.with_parts(camera=AGRIMARO.sensors)


def test_a_robot_is_pickled_with_its_parts_and_effects():
    robot = replace(AGRIMARO.without("camera"), effects={"payload_ratio": 0.1}, effects_cov=np.eye(1))
    back = pickle.loads(pickle.dumps(robot))
    assert back == robot
    assert back.effects_cov == robot.effects_cov
    assert back.steering == robot.steering


def test_robots_of_another_drive_are_refused_with_the_sentence_given():
    assert as_drive(SwerveRobot, AGRIMARO, "") is AGRIMARO
    assert as_drive(SkidSteerRobot, HUSKY, "") is HUSKY
    assert as_drive(OmniRobot, ROBOTINO, "") is ROBOTINO
    with pytest.raises(ConfigError, match=r"^agrimaro: 'swerve' does not skid$"):
        as_drive(SkidSteerRobot, AGRIMARO, "{name}: {drive!r} does not skid")


def test_log_rates_and_rows_are_two_views_of_wheel_speeds():
    speed_mps = np.array([0.2, -0.1, 0.4])
    motors = AGRIMARO.logged_rates(speed_mps)
    back = AGRIMARO.wheel_speeds_mps(motors / AGRIMARO.motors.reduction_ratio)
    np.testing.assert_allclose(back, speed_mps, rtol=1e-12)
    motors = ROBOTINO.logged_rates(speed_mps)
    back = ROBOTINO.wheel_speeds_mps(motors / ROBOTINO.motors.reduction_ratio)
    np.testing.assert_allclose(back, speed_mps, rtol=1e-12)
    np.testing.assert_array_equal(HUSKY.wheel_speeds_mps(HUSKY.logged_rates(speed_mps[:2])), speed_mps[:2])


def test_wheels_of_an_omni_robot_turn_it_to_the_left_from_a_third_of_a_turn_apart():
    positions, directions = ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 0.125, rtol=1e-9)
    lever = positions[:, 0] * np.sin(directions) - positions[:, 1] * np.cos(directions)
    np.testing.assert_allclose(lever, 0.125, rtol=1e-9)
    np.testing.assert_allclose(positions.sum(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"track_m": 0.5}, "the footprint allows up to 0.185 m"),
        ({"track_m": -0.1}, "wheel_distance_m must be above zero"),
        ({"body": {"com_x_m": 0.2}}, "outside the triangle of the wheels: wheel 2 would carry nothing"),
    ],
)
def test_an_omni_robot_with_impossible_dimensions_is_refused(change, message):
    robot = ROBOTINO
    if "body" in change:
        robot = robot.with_parts(body=replace(robot.body, **change.pop("body")))
    with pytest.raises(ConfigError, match=message):
        replace(robot, **change).check_geometry("robot robotino")
