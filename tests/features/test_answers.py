"""What the ground answers: a mirror turns it, a direction and a rate do not change it, and it is that of one window."""

import numpy as np

from features.answers import answers_of
from terrain.records import Windows
from terrain.signals import resampled

IMU = ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2", "gyro_x_radps", "gyro_y_radps", "gyro_z_radps")
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
SLIP = ("slip_left_ratio", "slip_right_ratio")


def windows_of(imu, wheels, slip=None, names=WHEELS, imu_hz=100.0):
    values = {"imu": imu, "wheels": wheels} | ({} if slip is None else {"slip": slip})
    channels = {"imu": IMU, "wheels": names, "slip": SLIP}
    n, rates = len(imu), {"imu": imu_hz, "wheels": 10.0, "slip": 10.0}
    channels, rates = ({name: of[name] for name in values} for of in (channels, rates))
    return Windows(values, channels, rates, 2.0, np.zeros(n), np.full(n, "a"), np.full(n, "ice"))


def drawn(n=12):
    rng = np.random.default_rng(3)
    wheels = np.concatenate([rng.normal(0.5, 0.3, (n, 2, 20)), rng.gamma(3.0, 1.0, (n, 2, 20))], axis=1)
    return rng.normal(0.0, 1.0, (n, 6, 200)), wheels, rng.uniform(-0.5, 0.5, (n, 2, 20))


def test_a_mirror_turns_what_turns_and_changes_nothing_else():
    imu, wheels, slip = drawn()
    one = answers_of(windows_of(imu, wheels, slip))
    other = answers_of(
        windows_of(imu * [[1], [-1], [1], [-1], [1], [-1]], wheels[:, [1, 0, 3, 2]], slip[:, ::-1])
    )
    odd = [name in ("turn", "current, sides") for name in one.quantities]
    assert sum(odd) == 2
    mirrored = [one.quantities.index(name) for name in ("slip, right", "slip, left")]
    order = [*range(len(odd) - 2), *mirrored]
    np.testing.assert_allclose(other.response, (one.response * np.where(odd, -1.0, 1.0))[:, order])
    turn = one.quantities.index("turn")
    np.testing.assert_allclose(other.driving[:, turn], one.driving[:, turn] * [1.0, -1.0, 1.0, -1.0, -1.0])
    shake = [i for i, name in enumerate(one.quantities) if name.startswith("shake")]
    assert len(shake) == 6
    np.testing.assert_allclose(other.driving[:, shake], one.driving[:, shake])


def test_a_window_answers_alike_alone_and_backwards_it_shakes_and_draws_alike():
    imu, wheels, slip = drawn()
    many = answers_of(windows_of(imu, wheels, slip))
    alone = answers_of(windows_of(imu[4:5], wheels[4:5], slip[4:5]))
    assert alone.response[0].tobytes() == many.response[4].tobytes()
    assert alone.driving[0].tobytes() == many.driving[4].tobytes()
    back = answers_of(windows_of(imu, wheels * [[-1], [-1], [1], [1]], slip))
    same = [i for i, name in enumerate(many.quantities) if name.startswith(("shake", "current", "slip"))]
    np.testing.assert_allclose(back.response[:, same], many.response[:, same])
    same = [i for i in same if many.quantities[i] != "current, sides"]
    np.testing.assert_allclose(back.driving[:, same], many.driving[:, same])


def test_bands_are_of_fixed_frequencies_at_any_rate():
    """What is below the cut-off of the lower rate is the same in both; what that rate cannot show is not there."""
    time_s = np.arange(200) / 100.0
    imu = np.random.default_rng(0).normal(0.0, 1.0, (1, 6, 1)) * np.sin(2 * np.pi * 6.0 * time_s + 0.4)
    wheels = drawn(1)[1]
    fast = answers_of(windows_of(imu, wheels))
    slow = answers_of(windows_of(resampled(imu, 100.0, 40, 20.0), wheels, imu_hz=20.0))
    assert {"shake, vertical, 1 to 10 Hz"} <= set(slow.quantities) < set(fast.quantities)
    for name in slow.quantities:
        if "10 Hz" in name and name.startswith("shake"):
            values = (each.response[0, each.quantities.index(name)] for each in (fast, slow))
            np.testing.assert_allclose(*values, atol=0.05)  # of decades


def test_slip_that_is_hardly_defined_is_unknown_and_robots_without_sides_have_answers():
    imu, wheels, slip = drawn(2)
    slip[0, 0, 3:], slip[1, 0, 8:] = np.nan, np.nan
    observed = answers_of(windows_of(imu, wheels, slip))
    left, right = (
        observed.response[:, observed.quantities.index(f"slip, {side}")] for side in ("left", "right")
    )
    assert np.isnan(left).tolist() == [True, False]
    np.testing.assert_allclose([left[1], *right], [slip[1, 0, :8].mean(), *slip[:, 1].mean(axis=1)])
    names = ("speed_1_mps", "speed_2_mps", "speed_3_mps", "current_1_a")
    omni = answers_of(windows_of(imu, wheels, names=names))
    assert {"turn", "current", "current, ripple"} < set(omni.quantities)
    assert "current, sides" not in omni.quantities
    bare = windows_of(imu, wheels)
    only = Windows({"imu": imu}, {"imu": IMU}, {"imu": 100.0}, 2.0, bare.start_s, bare.run_id, bare.terrain)
    assert answers_of(only) is None
