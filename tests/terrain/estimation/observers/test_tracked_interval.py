"""The step over an interval: it never makes errors larger, and it is the continuous observer."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.estimation.observers.tracked_interval import (
    inverse_3,
    n_parts,
    normalised_gain,
    observe_interval,
)
from terrain.estimation.observers.tracked_stability import lyapunov, regressor

HALF_TRACK_M = 0.5


def mean_regressor(yaw, left, right, span):
    """M at the middle of an interval, times its length."""
    return span * regressor(yaw, left, right, HALF_TRACK_M)


def plain_interval(travel, span, gain, adaptation, error, eta, moved):
    """The implicit midpoint rule as a linear system in all five unknowns, part by part."""
    n = n_parts(travel, span, gain, adaptation)
    w, h, dz = travel / n, span / n, moved / n
    rates = np.block([[-h * np.diag(gain), -w], [adaptation @ w.T, np.zeros((2, 2))]])
    state = np.r_[error, eta]
    for _ in range(n):
        state = np.linalg.solve(np.eye(5) - rates / 2, (np.eye(5) + rates / 2) @ state + np.r_[dz, 0, 0])
    return state[:3], state[3:]


def random_case(rng):
    left, right = rng.uniform(-3, 3, 2)
    span = 10 ** rng.uniform(-2, 1)
    travel = mean_regressor(rng.uniform(-4, 4), left, right, span)
    return travel, span, 10 ** rng.uniform(-1, 1.5, 3), np.diag(10 ** rng.uniform(-2, 2, 2))


def test_the_lyapunov_function_never_grows():
    rng, falls = np.random.default_rng(0), []
    for _ in range(10_000):
        travel, span, gain, adaptation = random_case(rng)
        error, eta, true = rng.normal(size=3), rng.uniform(0, 2, 2), rng.uniform(0, 2, 2)
        after, eta_after, *_ = observe_interval(travel, span, gain, adaptation, error, eta, travel @ true)
        before_v, after_v = (
            lyapunov(error, eta - true, adaptation),
            lyapunov(after, eta_after - true, adaptation),
        )
        assert after_v <= before_v * (1 + 1e-12)
        if n_parts(travel, span, gain, adaptation) == 1:
            middle = (error + after) / 2
            falls.append((after_v - before_v, -span * middle @ (gain * middle), before_v))
    change, predicted, scale = np.array(falls).T
    assert len(falls) > 300
    np.testing.assert_array_less(abs(change - predicted), 1e-12 * scale + 1e-14)


def test_a_full_adaptation_gain_does_not_let_it_grow_either():
    rng = np.random.default_rng(1)
    for _ in range(2000):
        travel, span, gain, _ = random_case(rng)
        adaptation = normalised_gain(travel, span, gain, 1e-3)
        error, eta, true = rng.normal(size=3), rng.uniform(0, 2, 2), rng.uniform(0, 2, 2)
        after, eta_after, *_ = observe_interval(travel, span, gain, adaptation, error, eta, travel @ true)
        grown = lyapunov(after, eta_after - true, adaptation) / lyapunov(error, eta - true, adaptation)
        assert grown <= 1 + 1e-9


def test_the_kernel_is_the_plain_rule():
    rng = np.random.default_rng(2)
    for _ in range(300):
        travel, span, gain, adaptation = random_case(rng)
        error, eta, moved = rng.normal(size=3), rng.uniform(0, 2, 2), rng.normal(size=3)
        found = observe_interval(travel, span, gain, adaptation, error, eta, moved)
        plain = plain_interval(travel, span, gain, adaptation, error, eta, moved)
        np.testing.assert_allclose(np.r_[found[0], found[1]], np.concatenate(plain), rtol=1e-7, atol=1e-9)


def test_maps_of_the_errors_are_derivatives_of_the_step():
    rng = np.random.default_rng(3)
    for _ in range(50):
        travel, span, gain, adaptation = random_case(rng)
        true = rng.uniform(0, 2, 2)

        def errors(x, start, end, travel=travel, span=span, gain=gain, adaptation=adaptation, true=true):
            """Errors after an interval from those before it and the noise of its two fixes."""
            moved = travel @ true + end - start
            after = observe_interval(travel, span, gain, adaptation, x[:3] + start, true - x[3:], moved)
            return np.r_[after[0] - end, true - after[1]]

        x, start, end = rng.normal(size=5), rng.normal(size=3), rng.normal(size=3)
        *_, whole, from_start, from_end = observe_interval(
            travel, span, gain, adaptation, np.zeros(3), true, travel @ true
        )
        expected = whole @ x + from_start @ start + from_end @ end
        np.testing.assert_allclose(errors(x, start, end), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("gains", [(np.ones(3), np.eye(2)), (np.array([2.0, 2.0, 5.0]), np.diag([4.0, 1.0]))])
@pytest.mark.parametrize("span", [0.1, 1.0])
def test_it_is_the_continuous_observer(gains, span):
    left, right, true = 0.4, 0.6, np.array([1.1, 0.8])
    gain, adaptation = gains
    turn = regressor(0.0, left, right, HALF_TRACK_M)[2] @ true

    def rate(time, x):
        m = regressor(turn * time, left, right, HALF_TRACK_M)
        return np.r_[m @ (true - x[3:]) - gain * x[:3], adaptation @ m.T @ x[:3]]

    times = np.arange(0.0, 10.0 + span / 2, span)
    right_one = solve_ivp(rate, (0, times[-1]), [0, 0, 0, 1, 1], t_eval=times, rtol=1e-9, atol=1e-11).y[3:].T
    error, eta, found = np.zeros(3), np.ones(2), [np.ones(2)]
    for start in times[:-1]:
        nodes, weights = np.polynomial.legendre.leggauss(5)
        travel = sum(
            0.5
            * span
            * weight
            * regressor(turn * (start + 0.5 * span * (1 + node)), left, right, HALF_TRACK_M)
            for node, weight in zip(nodes, weights, strict=True)
        )
        error, eta, *_ = observe_interval(travel, span, gain, adaptation, error, eta, travel @ true)
        found.append(eta)
    np.testing.assert_allclose(found, right_one, atol=4e-4 if span == 0.1 else 4e-3)


def test_inverse():
    rng = np.random.default_rng(4)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        a = np.eye(3) + root @ root.T
        np.testing.assert_allclose(inverse_3(a) @ a, np.eye(3), atol=1e-11)


@pytest.mark.parametrize("speeds", [(0.3, 0.3), (1.0, 1.0), (0.4, 0.6), (-0.5, 0.5)])
def test_the_normalised_gain_damps_critically_at_every_speed(speeds):
    gain = np.array([2.0, 2.0, 3.0])
    m = regressor(0.0, *speeds, HALF_TRACK_M)
    adaptation = normalised_gain(0.1 * m, 0.1, gain, 0.0)
    rates = np.linalg.eigvals(np.block([[-np.diag(gain), -m], [adaptation @ m.T, np.zeros((2, 2))]]))
    np.testing.assert_allclose(np.sort(rates.real), [-2.0, -1.5, -1.5, -1.0, -1.0], atol=1e-6)
