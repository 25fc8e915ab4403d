"""Excitation and the bound of Remark 1 of Tazzari et al., against matrices and simulated disturbances."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "papers"))

from tracked_stability import disturbance_bound, error_matrix, measured_efficiency, regressor

from terrain.errors import ConfigError

HALF_TRACK_M = 0.5


@pytest.mark.parametrize(
    ("speeds", "gain"),
    [((0.6, 0.6), (2.0, 2.0, 4.0)), ((-0.5, 0.5), (1.0, 1.0, 1.0)), ((0.1, 0.6), (2.0, 2.0, 4.0))],
)
def test_disturbances_stay_within_the_bound(speeds, gain):
    """Constant, rotating, random and worst-case disturbances of size 1, from an error at the start."""
    m = regressor(0.0, *speeds, HALF_TRACK_M)
    a = error_matrix(m, np.array(gain), np.eye(2), float(m[2] @ [0.9, 0.8]))
    bound = disturbance_bound(a)
    step_s, n, rng = 0.1, 400, np.random.default_rng(0)
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


def test_efficiency_is_unknown_of_a_track_that_stands():
    eta = measured_efficiency(0.46, 0.04, [0.4, 0.04], 0.6, HALF_TRACK_M)
    np.testing.assert_allclose(eta, [[1.1, 0.8], [np.nan, 0.8]])
