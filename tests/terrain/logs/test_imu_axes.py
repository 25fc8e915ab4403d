import itertools

import numpy as np
import pytest

from terrain.logs.imu_axes import AS_LOGGED, ImuAxes, find_axes

PERIOD_S = 0.05


def driving(rng, duration_s=60.0, noise=0.3):
    """Sides, yaw rate and accelerometer of a robot that speeds up, slows down and turns."""
    t = np.arange(0.0, duration_s, PERIOD_S)
    speed, turn = 0.8 * np.sin(0.8 * t) + 0.5, 0.6 * np.sin(0.5 * t)
    accel = np.column_stack([np.gradient(speed, PERIOD_S), speed * turn, np.full(t.size, 9.8)])
    accel += rng.normal(0.0, noise, accel.shape)
    return speed - turn / 2, speed + turn / 2, turn + rng.normal(0.0, 0.02, t.size), accel


@pytest.mark.parametrize(
    "signs", [s for s in itertools.product((1.0, -1.0), repeat=3) if np.prod(s) == 1.0], ids=str
)
def test_every_level_mounting_is_found_and_undone(signs):
    left, right, gyro, accel = driving(np.random.default_rng(0))
    found = find_axes([(left, right, gyro * signs[2], accel * signs)], PERIOD_S)
    assert found == ImuAxes(signs, signs[2])
    np.testing.assert_allclose(accel * signs * found.accel, accel)


def test_an_axis_that_noise_hides_follows_from_the_other_two():
    """A mounting is a rotation: the product of the signs is 1."""
    signs, rng = (-1.0, 1.0, -1.0), np.random.default_rng(1)
    left, right, gyro, accel = driving(rng)
    for hidden in (0, 1):
        noisy = accel * signs
        noisy[:, hidden] = rng.normal(0.0, 3.0, len(accel))
        assert find_axes([(left, right, -gyro, noisy)], PERIOD_S).accel == signs


def test_a_robot_that_stands_or_drives_too_shortly_shows_no_axes():
    still = np.zeros(600)
    accel = np.random.default_rng(0).normal([0.0, 0.0, 9.8], 0.1, (600, 3))
    assert find_axes([(still, still, still, accel)], PERIOD_S) == AS_LOGGED
    short = driving(np.random.default_rng(0), 4.0)
    assert find_axes([short], PERIOD_S) == AS_LOGGED
    assert find_axes([], PERIOD_S, default=ImuAxes((-1.0, -1.0, 1.0), -1.0)).gyro_z == -1.0
