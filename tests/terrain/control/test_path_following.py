"""A path to twists: on the path it is followed, beside it the robot is led back, and it stops where it has to."""

import math

import numpy as np
import pytest

from terrain.control.car_following import SteeringSettings, law_17
from terrain.control.path_following import SETTINGS, PathFollower, curvature_to_path
from terrain.control.paths import PathStatus, path_from_curvature

DT_S = 0.02


def driven(follower, pose=(0.0, 0.0, 0.0), until_s=60.0, lost=lambda time_s: False, lag_s=0.2):
    """Rows (n, 6) of time, pose, and twist of a robot that drives each twist behind a lag of its yaw rate."""
    pose, rows, time_s, turn = np.array(pose), [], 0.0, 0.0
    while time_s < until_s and not follower.finished:
        seen = np.full(3, math.nan) if lost(time_s) else pose
        speed, _, desired = follower.step(time_s, seen)
        turn += (desired - turn) * DT_S / lag_s
        rows.append([time_s, *pose, speed, desired])
        middle = pose[2] + 0.5 * DT_S * turn
        pose = pose + DT_S * np.array([speed * math.cos(middle), speed * math.sin(middle), turn])
        time_s += DT_S
    return np.array(rows)


def straight(length_m=20.0, curvature=0.0):
    return path_from_curvature(np.array([0.0, length_m]), np.full(2, curvature))


@pytest.mark.parametrize("curvature", [0.0, 0.3, -0.3])
def test_on_the_path_the_path_is_driven(curvature):
    assert curvature_to_path(0.5, 1.4, 0.0, 0.0, 0.0, curvature) == curvature
    follower = PathFollower(straight(12.0, curvature), 0.8)
    rows = driven(follower)
    assert follower.finished
    assert max(abs(place.lateral_m) for place in follower.places) < (0.06 if curvature else 1e-9)
    assert rows[:, 4].max() == pytest.approx(0.8)


def test_the_law_is_that_of_a_car_without_sideslip():
    settings = SteeringSettings(position_pm2=0.5, angle_pm=1.4)
    of_car = law_17(settings, 1.2, 0.3, -0.2, 0.1, 0.0, 0.0)
    assert math.atan(1.2 * curvature_to_path(0.5, 1.4, 0.3, 0.3, -0.2, 0.1)) == pytest.approx(of_car)


@pytest.mark.parametrize("start", [(0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.6), (0.0, 0.0, -1.2)])
@pytest.mark.parametrize("speed_mps", [0.3, 1.0, 2.0])
def test_a_robot_beside_the_path_comes_back_to_its_offset_without_a_swing(start, speed_mps):
    follower = PathFollower(straight(40.0), speed_mps, offset_m=0.2)
    driven(follower, start, until_s=200.0)
    off = np.array([place.lateral_m for place in follower.places]) - 0.2
    late = len(off) // 2
    assert np.abs(off[late:]).max() < 0.03
    if start[2] == 0.0:
        assert (off * np.sign(off[0])).min() > -0.05 * abs(off[0])


def test_it_stops_where_it_has_to_and_for_as_long():
    follower = PathFollower(straight(6.0), 0.8, stops_m=(3.0,))
    rows = driven(follower)[1:-1]
    stands = rows[:, 4] == 0.0
    assert stands.sum() * DT_S == pytest.approx(SETTINGS.stand_s, abs=0.1)
    assert rows[stands, 1] == pytest.approx(3.0, abs=0.1)
    assert rows[-1, 1] == pytest.approx(6.0, abs=0.1)
    assert np.abs(np.diff(rows[rows[:, 4] > 0.2, 4])).max() < 0.05


def test_without_a_pose_it_goes_on_for_a_while_and_stands_then():
    follower = PathFollower(straight(30.0), 0.8)
    rows = driven(follower, lost=lambda time_s: time_s > 5.0, until_s=12.0)
    assert (rows[(rows[:, 0] > 5.0) & (rows[:, 0] < 7.9), 4] > 0.5).all()
    assert not rows[rows[:, 0] > 8.1, 4].any()
    away = PathFollower(straight(30.0), 0.8)
    away.step(0.0, np.zeros(3))
    assert not away.step(0.02, np.array([0.0, 50.0, 0.0])).any()
    assert away.places[-1].status is PathStatus.FAR


def test_a_tight_bend_is_driven_as_fast_as_the_yaw_rate_allows():
    rows = driven(PathFollower(straight(6.0, 2.0), 2.0))
    assert np.abs(rows[:, 5]).max() <= SETTINGS.yaw_rate_radps + 1e-9
    assert rows[len(rows) // 2, 4] < 0.65
