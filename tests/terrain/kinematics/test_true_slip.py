import numpy as np
import pytest

from terrain.kinematics.logged_wheels import true_slip, wheel_and_ground_speed
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")


@pytest.mark.parametrize("scenario", ["straight", "complex"])
def test_the_sign_is_that_of_traction_in_both_directions(scenario):
    truth = simulate_run(ROBOT, "grass", scenario, 0).streams["truth"]
    wheel_speed, ground = wheel_and_ground_speed(truth, ROBOT)
    slip = true_slip(truth, ROBOT.wheels)
    clear = np.isfinite(slip) & (np.abs(slip) > 0.05) & (np.abs(ground) > 0.1)
    assert clear.any()
    pulls = (wheel_speed - ground) * np.sign(ground) > 0.0
    np.testing.assert_array_equal(slip[clear] > 0.0, pulls[clear])


def test_a_slip_that_is_never_defined_is_unknown():
    rates = Stream(np.arange(2.0), np.zeros((2, 3)), [f"wheel_{i}_radps" for i in (1, 2, 3)])
    assert np.isnan(true_slip(rates, ROBOT.wheels)).all()
