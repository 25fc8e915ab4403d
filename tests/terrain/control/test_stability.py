import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.control.pid import Gains, pid_step
from terrain.control.stability import DELAY_S, SLOPES, check_stable, loop_matrices
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.plants.dynamic import DEFLECTION_DAMPING_S

ROBOT = load_robot("agrimaro")
DT_S = 0.02
RADIUS_M = ROBOT.wheel_radius_m
LOAD_N = ROBOT.mass_kg / 3 * GRAVITY_MPS2
MOST_RADPS = 1e300


def spectral_radius(matrix):
    return np.abs(np.linalg.eigvals(matrix)).max()


def critical_gain(delay_s, *where):
    """The proportional gain from which on the loop is unstable, by halving."""
    low, high = 1e-3, 1e3
    while high / low > 1.0001:
        middle = math.sqrt(low * high)
        gains = Gains(middle, 0.0, 1.0)
        stable = spectral_radius(loop_matrices(ROBOT, gains, delay_s, [where])[0]) < 1
        low, high = (middle, high) if stable else (low, middle)
    return low


def small_changes(gains, n_delayed, speed_mps, slip_ratio, slope_ratio, n_samples):
    """Slip (n,) as seen at each sample after a change of the rate: the same loop by ``pid_step`` and Heun."""
    body, motors, sensors = ROBOT.body, ROBOT.motors, ROBOT.sensors

    def slip_of(w, v):
        if slip_ratio > 0:
            return (RADIUS_M * (1 - slip_ratio) * w - v) / speed_mps
        return (RADIUS_M * w - (1 + slip_ratio) * v) / speed_mps

    def change(x, u):
        w, v, taken, torque, integral, estimate, seen = x
        slip = slip_of(w, v)
        rate = speed_mps / body.relaxation_length_m * (slip - taken)
        thrust_n = slope_ratio * LOAD_N * (taken + DEFLECTION_DAMPING_S * rate)
        desired = motors.speed_gain_nmspr * (u - estimate) + integral
        return np.array(
            [
                (torque - RADIUS_M * thrust_n) / body.wheel_inertia_kgm2,
                thrust_n / (ROBOT.mass_kg / 3),
                rate,
                (desired - torque) / motors.torque_time_constant_s,
                motors.speed_integral_nmpr * (u - estimate),
                (w - estimate) / motors.speed_estimate_time_constant_s,
                (slip - seen) / sensors.encoder_time_constant_s,
            ]
        )

    x, pid, queue, found = np.array([0.01, 0, 0, 0, 0, 0, 0.0]), 0.0, [0.0] * n_delayed, []
    steps = 40
    for _ in range(n_samples):
        error = -x[6] * speed_mps / RADIUS_M
        output, pid, _ = pid_step(gains, pid, float(error), DT_S)
        queue.append(output)
        u = queue.pop(0)
        for _ in range(steps):
            first = change(x, u)
            x = x + DT_S / steps * 0.5 * (first + change(x + DT_S / steps * first, u))
        found.append(x[6])
    return np.array(found)


@pytest.mark.parametrize(
    ("numbers", "n_delayed", "where"),
    [((3.5, 1.0), 3, (1.0, 0.13, 0.6)), ((6.0, 0.0), 0, (0.05, -0.2, 0.3)), ((4.0, 4.0), 1, (0.1, 0.2, 3.0))],
)
def test_a_small_change_grows_or_decays_by_the_largest_eigenvalue(numbers, n_delayed, where):
    gains = Gains(*numbers, MOST_RADPS)
    matrix = loop_matrices(ROBOT, gains, n_delayed * DT_S, [where])[0]
    slip = np.abs(small_changes(gains, n_delayed, *where, 500))
    early, late = slip[150:250].max(), slip[400:500].max()  # a hundred samples hold a whole swing
    assert (late / early) ** (1 / 250) == pytest.approx(spectral_radius(matrix), rel=2e-3)


def test_the_margin_is_the_same_at_any_speed():
    """The figure in the module's docstring; that of the printed form is this times V / r."""
    speeds = (0.05, 2.0)
    least = [min(critical_gain(DELAY_S, speed, -0.2, slope) for slope in SLOPES) for speed in speeds]
    assert least == pytest.approx([1.53] * 2, rel=0.02)
    assert np.multiply(least, speeds) / RADIUS_M == pytest.approx([0.38, 15.3], rel=0.02)
    margin = check_stable(ROBOT, Gains(0.19, 0.0, 5.0))
    assert margin == pytest.approx(min(least) / 0.19, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gains": Gains(2.0, 0.0, 5.0)}, r"unstable from 0\.05 to 2 m/s; it is stable up to 0\.76 times"),
        ({"delay_s": math.nan}, "^delay_s is nan, 0 to 1 s is required"),
        ({"delay_s": -0.1}, "^delay_s is -0.1"),
        ({"robot": load_robot("husky").without("body")}, "^robot husky: its description has no section"),
    ],
)
def test_an_unstable_loop_or_bad_input_is_refused_in_one_sentence(arguments, message):
    with pytest.raises(ConfigError, match=message) as refused:
        check_stable(**{"robot": ROBOT, "gains": Gains(1.0, 0.0, 5.0)} | arguments)
    assert "\n" not in str(refused.value)
