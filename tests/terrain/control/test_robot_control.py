"""What a robot's control aims for on a slope, and which of its sensors it names."""

import math

import numpy as np
import pytest

from terrain.control.pilot_settings import DEFAULT_SETTINGS
from terrain.control.robot_control import RobotControl, uphill_mps2
from terrain.control.slip_table import load_slip_table
from terrain.estimation.health import SENSORS, Health
from terrain.estimation.live import LiveFilter
from terrain.records import Reading
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")


@pytest.fixture(scope="module")
def standing():
    """The estimate of a robot that stands, and the states of its filter."""
    estimator = LiveFilter(ROBOT)
    estimator.step({"wheels": Reading(np.array([0.0]), np.zeros((1, 6)))})
    return estimator.latest, estimator.states


@pytest.mark.parametrize("speed_mps", [0.5, -0.5])
@pytest.mark.parametrize(("axis", "tilt_rad"), [("speed_x_mps", (0.0, -0.1)), ("speed_y_mps", (0.1, 0.0))])
def test_gravity_decelerates_uphill_in_any_direction(standing, axis, tilt_rad, speed_mps):
    seen = standing[0]._replace(**{"speed_x_mps": 0.0, "speed_y_mps": 0.0, axis: speed_mps})
    found = uphill_mps2(seen, *tilt_rad)
    assert found == pytest.approx(math.copysign(9.81 * math.sin(0.1), speed_mps), rel=0.01)
    assert uphill_mps2(standing[0]._replace(speed_x_mps=0.0, speed_y_mps=0.0), *tilt_rad) == 0.0


@pytest.mark.parametrize(
    ("statuses", "named", "health"),
    [
        ({}, None, Health.FRESH),
        ({"gyro": Health.LATE}, None, Health.LATE),
        ({"wheel_1": Health.LOST, "camera_speed": Health.FROZEN}, "camera_speed", Health.FROZEN),
        ({"wheel_1": Health.STEPPED, "camera_speed": Health.LOST}, "wheel_1", Health.STEPPED),
        ({"wheel_1": Health.GATED, "camera_speed": Health.LOST}, "camera_speed", Health.LOST),
    ],
)
def test_the_sensor_is_named_that_takes_others_with_it(standing, statuses, named, health):
    seen, states = standing
    control = RobotControl(ROBOT, load_slip_table(), DEFAULT_SETTINGS, states)
    judged = np.array([statuses.get(name, Health.FRESH) for name in SENSORS], dtype=np.int8)
    place, status = control._judge(seen._replace(health=judged))
    assert (SENSORS[place] if place >= 0 else None, status) == (named, health)
