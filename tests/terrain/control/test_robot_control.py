"""What a robot's control aims for on slick terrain and on a slope, and which of its sensors it names."""

import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.control.robot_control import (
    DECELERATION_RATIO,
    DEFAULT_SETTINGS,
    SLICK_RATIO,
    RobotControl,
    braking_by_slip,
    uphill_mps2,
)
from terrain.control.slip_table import load_slip_table
from terrain.estimation.health import SENSORS, Health
from terrain.estimation.live import LiveFilter
from terrain.records import Reading
from terrain.robots import load_robot
from terrain.slip_learning.curve import traction_ratio

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


class Curve:
    """The law of a table's curve, with its resistance."""

    resistance_ratio = 0.02

    def __init__(self, law, *parameters):
        self.thrust_ratio = lambda slip: traction_ratio(law, parameters, slip)


def test_slick_terrain_with_falling_thrust_is_braked_at_its_peak():
    """D sin(C atan(B s)) without curvature has its peak D where C atan(B s) is a right angle."""
    b, c, d = 25.0, 1.5, 0.3
    slip_ratio, mps2 = braking_by_slip(Curve("magic", b, c, d, 0.0))
    assert slip_ratio == pytest.approx(np.tan(np.pi / 2 / c) / b, abs=0.002)
    assert mps2 == pytest.approx(DECELERATION_RATIO * (d + 0.02) * GRAVITY_MPS2, rel=1e-3)


def test_where_locked_wheels_stop_as_soon_there_is_no_braking_by_slip():
    assert braking_by_slip(Curve("janosi", 0.3, 0.05)) is None  # rises up to the locked wheel
    for c, d in ((1.0, 0.3), (1.5, SLICK_RATIO + 0.01), (1.2, 0.3)):  # rises, grips, hardly falls
        assert braking_by_slip(Curve("magic", 25.0, c, d, 0.0)) is None
