"""The turn of robots that turn by their wheels' speeds: kept while sides slip differently, and bounded."""

import math

import numpy as np
import pytest

from terrain.control.turning import SETTINGS, TurnState, first_state, turn_step, turning_of
from terrain.robots import load_robot

HUSKY = load_robot("husky")
TURNING, ARM_M, DT_S = turning_of(HUSKY), 0.2854, 0.02


def steps(twist, yaw_rate, n=1, state=None, wheels=None, part=1.0, turning=TURNING, speed=math.nan):
    """The twist for the kinematics after n steps with one measured yaw rate, and the state."""
    state = TurnState(reference_radps=twist[2]) if state is None else state
    wheels = np.full(len(turning.rolling), math.nan) if wheels is None else np.array(wheels)
    for _ in range(n):
        now = np.array(twist), part, yaw_rate, wheels, speed, DT_S
        given, state = turn_step(SETTINGS, turning, state, *now)
    return given, state


def test_a_robot_that_turns_as_desired_is_not_corrected():
    given, state = steps((0.5, 0.0, 0.4), 0.4, 50)
    assert given == pytest.approx([0.5, 0.0, 0.4])
    assert state.integral_radps == pytest.approx(0.0)


@pytest.mark.parametrize("twist", [(0.5, 0.0, 0.0), (0.5, 0.0, 0.4), (-0.5, 0.0, 0.4), (0.0, 0.0, 0.6)])
@pytest.mark.parametrize("yaw_rate", [-3.0, 3.0, 0.1])
def test_a_correction_is_bounded_never_reverses_a_wheel_and_does_not_wind_up(twist, yaw_rate):
    desired = TURNING.rolling @ np.array(twist)
    state = None
    for _ in range(500):
        given, state = steps(twist, yaw_rate, state=state)
        wheels = TURNING.rolling @ given
        assert (wheels * desired >= -1e-12).all()
        assert np.abs(wheels - desired).max() <= SETTINGS.limit_ratio * np.abs(desired).max() + 1e-9
    error = twist[2] - yaw_rate
    back, n = state, 0
    while (steps(twist, twist[2] + error, state=back)[0][2] - twist[2]) * error > 0.0:
        back, n = steps(twist, twist[2] + error, state=back)[1], n + 1
    # once the error changes its sign, what was integrated is gone as soon as it had been within the bound
    most = SETTINGS.limit_ratio * np.abs(desired).max() / ARM_M
    assert n * DT_S * SETTINGS.k_i_ps * abs(error) <= 1.05 * most + 0.1


def test_at_rest_nothing_is_left_of_a_correction():
    _, wound = steps((0.5, 0.0, 0.4), 0.1, 100)
    given, state = steps((0.0, 0.0, 0.0), 0.2, state=wound)
    assert not given.any()
    assert state.integral_radps == 0.0


def test_without_a_yaw_rate_or_a_time_the_twist_is_that_of_the_effective_track():
    state = TurnState(1.5, 0.1, 0.4)
    for yaw_rate, dt_s in ((math.nan, DT_S), (0.1, math.nan), (0.1, 3.0)):
        unknown = np.full(2, math.nan)
        now = np.array([0.5, 0.0, 0.4]), 1.0, yaw_rate, unknown, math.nan, dt_s
        given, after = turn_step(SETTINGS, TURNING, state, *now)
        assert given == pytest.approx([0.5, 0.0, 0.6])
        assert after.track_ratio == 1.5
        assert after.integral_radps == pytest.approx(0.1)


def test_no_wheel_is_asked_for_more_than_its_motor_gives_and_the_turning_centre_stays():
    given, _ = steps((5.0, 0.0, 2.0), math.nan)
    assert np.abs(TURNING.rolling @ given).max() == pytest.approx(TURNING.limit_mps)
    assert given[2] / given[0] == pytest.approx(0.4)


@pytest.mark.parametrize("ratio", [1.3, 1.9, 2.6])
def test_the_effective_track_comes_back_and_a_described_one_is_used_at_once(ratio):
    """A robot that turns by the speeds of its sides over its effective track, behind a lag."""
    state, yaw_rate, wheels = first_state(HUSKY), 0.0, np.zeros(2)
    for _ in range(600):
        now = np.array([0.4, 0.0, 0.5]), 1.0, yaw_rate, wheels, 0.4, DT_S
        given, state = turn_step(SETTINGS, TURNING, state, *now)
        wheels = wheels + (TURNING.rolling @ given - wheels) * DT_S / 0.1
        yaw_rate += ((wheels[1] - wheels[0]) / (2.0 * ARM_M * ratio) - yaw_rate) * DT_S / 0.1
    assert state.track_ratio == pytest.approx(ratio, rel=0.05)
    assert yaw_rate == pytest.approx(0.5, rel=0.01)
    assert first_state(load_robot("marmotte")).track_ratio == pytest.approx(0.602 / 0.52, rel=1e-6)


def test_the_turn_of_omni_wheels_has_no_effective_track():
    turning = turning_of(load_robot("robotino"))
    _, state = steps((0.2, 0.1, 0.4), 0.2, 100, wheels=(0.1, 0.1, 0.1), turning=turning)
    assert state.track_ratio == 1.0
    assert state.integral_radps > 0.0


def test_where_the_robot_is_slow_beside_its_wheels_its_turn_takes_no_more():
    state = TurnState(2.5, 0.05, 0.4)
    slips, grips = (
        steps((0.5, 0.0, 0.4), 0.1, 50, state=state, wheels=(0.2, 0.8), speed=speed)[1]
        for speed in (0.2, 0.4)
    )
    assert slips.track_ratio < 1.6
    assert grips.track_ratio > 2.5
    on_the_spot = steps((0.0, 0.0, 0.6), 0.1, 50, state=state, wheels=(-0.5, 0.5), speed=0.0)[1]
    assert on_the_spot.track_ratio > 2.5


def test_wheels_that_stay_behind_their_commands_wind_nothing_up():
    twist, turning = (0.5, 0.0, 0.3), turning_of(load_robot("robotino"))
    rolling = turning.rolling @ twist
    _, state = steps(twist, 0.3, 100, wheels=rolling, turning=turning)
    _, state = steps(twist, 0.2, 200, state=state, wheels=0.6 * rolling, turning=turning)
    assert abs(state.integral_radps) < 0.01
