"""Excitation, Lyapunov function and the bound of Remark 1, against matrices and simulated disturbances."""

import numpy as np
import pytest
from scipy.linalg import expm

from terrain.errors import ConfigError
from terrain.estimation.observers.track_efficiency import measured_efficiency, traction_slip_of
from terrain.estimation.observers.tracked_stability import (
    disturbance_bound,
    error_matrix,
    excitation,
    regressor,
)
from terrain.slip import slip_ratio

HALF_TRACK_M = 0.5


def test_excitation_is_the_papers_matrix():
    rng = np.random.default_rng(0)
    for left, right, d in rng.uniform([-2, -2, 0.1], [2, 2, 2], (50, 3)):
        near, far = (1 + 1 / d**2) / 4, (1 - 1 / d**2) / 4
        matrix = [[near * left**2, far * left * right], [far * left * right, near * right**2]]
        assert excitation(left, right, d) == pytest.approx(np.linalg.eigvalsh(matrix)[0], abs=1e-12)


def test_the_printed_regressor_is_never_exciting():
    """(11) as printed: the second row is the first times -v_L / v_R."""
    theta, left, right = 0.4, 0.4, 0.6
    row = np.array([np.cos(theta) / 2, np.sin(theta) / 2, 0.5 / HALF_TRACK_M])
    assert np.linalg.matrix_rank(np.array([-row * right, row * left])) == 1
    assert excitation(left, right, HALF_TRACK_M) > 0.05


@pytest.mark.parametrize("speeds", [(0.6, 0.6), (0.4, 0.6), (-0.5, 0.5), (0.1, 0.6)])
@pytest.mark.parametrize("gain", [(1.0, 1.0, 1.0), (2.0, 2.0, 4.0)])
def test_disturbances_stay_within_the_bound(speeds, gain):
    """Constant, rotating, random and worst-case disturbances of size 1, from an error at the start."""
    m = regressor(0.0, *speeds, HALF_TRACK_M)
    a = error_matrix(m, np.array(gain), np.eye(2), float(m[2] @ [0.9, 0.8]))
    bound = disturbance_bound(a)
    step_s, n, rng = 0.05, 1200, np.random.default_rng(0)
    exact = expm(step_s * np.block([[a, np.eye(5)], [np.zeros((5, 10))]]))
    ahead, driven = exact[:5, :5], exact[:5, 5:]
    final = np.linalg.svd(np.linalg.solve(a, np.eye(5)))[0][:, 0]
    backwards = [final @ expm(a * step_s * (n - k)) for k in range(n)]
    turning = [np.roll([np.cos(k * step_s), np.sin(k * step_s), 0, 0, 0], 1) for k in range(n)]
    for forces in (np.tile(final, (n, 1)), turning, rng.normal(size=(n, 5)), backwards):
        unit = forces / np.linalg.norm(forces, axis=1, keepdims=True)
        x = start = rng.normal(size=5)
        for k, force in enumerate(unit):
            x = ahead @ x + driven @ force
            decayed = (
                bound.overshoot_ratio * np.exp(-bound.rate_ps * step_s * (k + 1)) * np.linalg.norm(start)
            )
            assert np.linalg.norm(x) <= decayed + bound.disturbance_s


def test_a_bound_needs_excitation_and_equal_gains():
    with pytest.raises(ConfigError, match="does not converge"):
        disturbance_bound(error_matrix(regressor(0, 0.6, 0.0, HALF_TRACK_M), np.ones(3), np.eye(2), 0.1))
    with pytest.raises(ConfigError, match="equal ones are required"):
        error_matrix(np.zeros((3, 2)), np.array([1.0, 2.0, 1.0]), np.eye(2), 0.0)


def test_efficiency_and_slip_are_two_words_for_one_thing():
    rng = np.random.default_rng(1)
    left, right = rng.uniform(0.1, 1, (2, 100))
    forward, turn = rng.uniform(0.1, 1, 100), rng.uniform(-0.1, 0.1, 100)
    found = measured_efficiency(forward, turn, left, right, HALF_TRACK_M)
    ground = np.stack([forward - HALF_TRACK_M * turn, forward + HALF_TRACK_M * turn], axis=-1)
    kept = ground > 0
    expected = slip_ratio(np.stack([left, right], axis=-1), ground)
    np.testing.assert_allclose(traction_slip_of(found)[kept], expected[kept], atol=1e-12)
    assert np.isnan(measured_efficiency(0.5, 0.0, 0.04, 0.5, HALF_TRACK_M)[0])
