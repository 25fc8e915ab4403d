"""What an extended description is worth to the filters, against the truth of simulated runs."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.estimation.summary import summarize
from terrain.robots import load_robot
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.scenario import make_scenario
from terrain.simulation.sensors import Gnss
from terrain.terramechanics.soil import load_soil

ROBOT = load_robot("agrimaro")
ASKED = {"wheel_radius_ratio": 0.04, "camera_yaw_rad": 0.05, "gyro_scale_ratio": 0.08}
# effects, and how much worse speed and slip are for them: the errors without them are 0.0028 m/s and 0.012
CASES = {
    "radius, camera and gyro": (ASKED, 8.0, 2.5),
    "clocks": ({"clock_offset_s": 0.1, "clock_rate_ratio": 0.001}, 8.0, 1.3),
    "latency": ({"camera_latency_s": 0.08}, 6.0, 1.1),
    "lever": ({"lever_x_m": 0.2, "lever_y_m": -0.15}, 8.0, 2.5),
    "one side": ({"one_sided_radius_ratio": 0.06}, None, 2.0),
    "biases": ({"gyro_bias_radps": 0.03, "accel_bias_mps2": 0.5}, None, None),
    "steering": (
        {"steering_offset_1_rad": 0.05, "steering_backlash_rad": 0.03, "steering_delay_s": 0.08},
        *(None, None),
    ),
    "many": (
        ASKED | {"clock_offset_s": 0.1, "encoder_lag_s": 0.05, "gyro_bias_radps": 0.02, "lever_x_m": 0.1},
        *(8.0, 2.5),
    ),
}


@lru_cache
def driven(effects=(), gnss=None, scenario="complex", length_s=60.0):
    drive = make_scenario(scenario, ROBOT, "grass", length_s)
    return simulate(ROBOT, drive, {"grass": load_soil("grass")}, 1, effects=dict(effects), gnss=gnss)


def errors(found):
    """Root mean square errors of speed (m/s) and of steady slip, against the truth of wheels and ground."""
    truth, track = found.run.streams["truth"], found.track
    true = np.column_stack(
        [np.interp(track.time_s, truth.time_s, truth.channel(f"slip_{i}_ratio")) for i in (1, 2, 3)]
    )
    error = (found.slip.slip_ratio - true)[found.figures.steady]
    return summarize(found).speed_rmse_mps, float(np.sqrt(np.nanmean(error**2)))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.slow
def test_the_filter_of_an_extended_robot_is_as_good_as_without_effects(name):
    effects, speed_gain, slip_gain = CASES[name]
    run, extended = driven(tuple(effects.items())), replace(ROBOT, effects=effects)
    clean = errors(estimate_run(driven(), ROBOT, "vio15"))
    before = errors(estimate_run(run, ROBOT, "vio15"))
    found = estimate_run(run, extended, "vio15")
    after = errors(found)
    assert after[0] < 1.5 * clean[0]
    assert after[1] < 1.2 * clean[1]
    if speed_gain:
        assert before[0] > speed_gain * after[0]
    if slip_gain:
        assert before[1] > slip_gain * after[1]
    assert summarize(found).nees < 2.0
    assert found.run is run


def test_biases_are_found_by_the_filter_and_by_their_correction():
    effects = {"gyro_bias_radps": 0.03, "accel_bias_mps2": 0.5}
    run = driven(tuple(effects.items()), Gnss())
    before = errors(estimate_run(run, ROBOT, "vio15"))[0]
    after = errors(estimate_run(run, replace(ROBOT, effects=effects), "vio15"))[0]
    assert after < 0.005
    assert before < 0.005  # biases are states, and found


def test_the_written_run_holds_the_measurements_and_the_true_wheel_speeds():
    run = driven(tuple(ASKED.items()))
    written = enriched(estimate_run(run, replace(ROBOT, effects=ASKED), "vio15"))
    assert written.streams["imu"] is run.streams["imu"]
    wheels = written.streams["wheels"]
    wheel_speed = wheels.channel("motor_1_radps") / ROBOT.motors.reduction_ratio * ROBOT.wheel_radius_m * 1.04
    np.testing.assert_allclose(wheels.channel("speed_1_mps"), wheel_speed)
