"""The quadratic form is generalised least squares with the scatter of each run written out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from terrain.discrepancy import evidence
from terrain.discrepancy.evidence import (
    N_BLOCKS,
    PRIOR_RUNS,
    correlation,
    fit_change,
    loss_of,
    move_point,
    partial_information,
    scatter_of,
)
from terrain.discrepancy.runs import Simulation
from terrain.discrepancy.search import misfit_of
from terrain.effects import CHANNELS, SPEED_X, vector_of
from terrain.robots import load_robot
from terrain.simulation.plants.planar import spread_numbers

HUSKY = load_robot("husky")
SCATTER = spread_numbers("scatter")
NAMES = ("payload_ratio", "camera_yaw_rad", "camera_latency_s", "lever_x_m", "rolling_resistance_ratio")
HIDDEN = {"camera_yaw_rad": 0.03}


@pytest.fixture(scope="module")
def problem(hide, pose):
    posed = pose(hide(HIDDEN, n=3, duration_s=25.0))
    signals = list(posed.signals)
    holes = signals[1].measured.copy()
    holes[500:600, CHANNELS.index(SPEED_X)] = np.nan
    signals[1] = replace(signals[1], measured=holes)
    return posed._replace(signals=tuple(signals))


@pytest.fixture(scope="module")
def info(problem):
    return problem.at(problem.simulation.vector, NAMES)


def dense(info, i):
    """Whitened sensitivities (k, m), residual (m,), inverse covariance (m, m) of a run, by plain sums."""
    run = info.rows[i]
    residual, size = run.residual, info.noise.size(run.pace_mps)
    rows_j, rows_r = [], []
    for c in np.flatnonzero(np.isfinite(info.noise.filters).all(axis=1)):
        taps = info.noise.filters[c]
        used = np.flatnonzero(taps)
        for k in range(used.max(), len(residual)):
            if all(np.isfinite(residual[k - lag, c]) for lag in used):
                weights = [taps[lag] / size[k - lag, c] for lag in used]
                rows_r.append(sum(w * residual[k - lag, c] for w, lag in zip(weights, used, strict=True)))
                both = zip(weights, used, strict=True)
                rows_j.append(sum(w * run.sensitivity[:, k - lag, c] for w, lag in both))
    j, r = np.array(rows_j).T, np.array(rows_r)
    scatter = j[info.nuisances]
    cov = np.eye(r.size) + scatter.T @ np.diag(info.nuisance_std**2) @ scatter
    return j, r, np.linalg.inv(cov)


def test_the_form_is_generalised_least_squares_with_scatter_written_out(info):
    total_a, total_g = 0.0, 0.0
    for i in range(len(info.rows)):
        j, r, weight = dense(info, i)
        a, g, c = j @ weight @ j.T, j @ weight @ r, r @ weight @ r
        scale = np.sqrt(np.outer(a.diagonal(), a.diagonal()))
        assert np.abs((info.a[i] - a) / np.maximum(scale, 1e-12)).max() < 1e-6
        assert_allclose(info.g[i], g, atol=1e-6 * np.sqrt(a.diagonal().max() * c))
        assert info.c[i] == pytest.approx(c)
        total_a, total_g = total_a + a, total_g + g
    at = info.places(NAMES)
    change, cov = fit_change(info, NAMES)
    expected = np.linalg.solve(total_a[np.ix_(at, at)], total_g[at])
    std = np.sqrt(np.diag(cov))
    assert_allclose(change / std, expected / std, atol=1e-5)
    assert_allclose(cov, np.linalg.inv(total_a[np.ix_(at, at)]), rtol=1e-5, atol=1e-12)
    assert loss_of(info, NAMES) == pytest.approx(-total_g[at] @ expected)
    assert loss_of(info, ()) == 0.0
    assert abs(change[1] - HIDDEN["camera_yaw_rad"]) < 4 * std[1]
    # and its thirds sum up to the whole
    assert info.blocks[0].shape[1] == N_BLOCKS
    assert_allclose(info.blocks[0].sum(axis=1), info.a, atol=1e-9 * np.abs(info.a).max())
    assert_allclose(info.blocks[1].sum(axis=1), info.g, atol=1e-9 * np.abs(info.g).max())


def test_a_nuisance_is_a_parameter_too_and_its_scatter_widens_its_variance(info, problem):
    assert info.names[: len(NAMES)] == NAMES
    assert set(np.array(info.names)[info.nuisances]) == set(SCATTER)
    steady = problem._replace(simulation=Simulation(HUSKY))
    firm = steady.at(info.vector, NAMES, info.statistics._replace(scatter={}))
    name = ["rolling_resistance_ratio"]  # which scatters
    wide, narrow = fit_change(info, name)[1][0, 0], fit_change(firm, name)[1][0, 0]
    # the mean over runs cannot be better known than its scatter lets
    assert wide > SCATTER["rolling_resistance_ratio"] ** 2 / len(info.rows) > narrow
    assert firm.nuisances.size == 0
    here = steady.near(firm, info.vector, NAMES)
    scale = np.sqrt(here.a.diagonal())
    assert_allclose(here.a / np.outer(scale, scale), firm.a.sum(0) / np.outer(scale, scale), atol=1e-9)


def test_two_points_differ_in_misfit_as_their_likelihoods_do(problem, info):
    """By sums of squares a mass, which enlarges the noise of the wheels, would be ahead or behind by far more."""
    names = ["camera_yaw_rad", "payload_ratio"]
    before = misfit_of(info, [white[-1] for white in info.white])
    for change in (fit_change(info, names)[0], np.array([0.0, 0.05])):
        point = problem.near(info, move_point(info.vector, names, change), names)
        a, g = info.total(names)
        expected, size = change @ a @ change - 2 * g @ change, change @ a @ change
        assert misfit_of(info, point.white_residual) - before == pytest.approx(expected, abs=0.1 * size + 1.0)


def test_correlation_is_the_largest_of_any_change_by_the_one_and_the_other():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((3, 200))
    alike = np.vstack([columns, columns[0] + columns[1]])
    a = alike @ alike.T
    assert correlation(a, [0, 1], [3]) == pytest.approx(1.0)
    cosine = a[0, 2] / np.sqrt(a[0, 0] * a[2, 2])
    assert correlation(a, [0], [2]) == pytest.approx(abs(cosine))
    assert correlation(np.diag([1.0, 0.0]), [0], [1]) == 1.0
    follow, free = partial_information(a, [0, 1], [2, 3])
    assert free[1, 1] == pytest.approx(0.0, abs=1e-9 * a[3, 3])
    assert_allclose(follow[:, 1], [1.0, 1.0])
    assert_allclose(np.linalg.inv(free[:1, :1]), np.linalg.inv(a[:3, :3])[2:, 2:])


def test_what_runs_vary_by_does_not_leak_between_their_thirds(hide, pose):
    """A camera's yaw and a gyro's bias of each run are not taken for a side slip that comes and goes."""
    hidden, off = {"turn_side_slip_s": 0.035}, []
    for seed in range(11, 15):
        info = pose(hide(hidden, duration_s=40.0, seed=seed)).at(vector_of(hidden), list(hidden))
        a, g = info.blocks[0][:, :, 0, 0].sum(axis=0), info.blocks[1][:, :, 0].sum(axis=0)
        off.append(g / np.sqrt(a))
    assert np.abs(off).max() < 4.0
    assert np.std(off) < 1.6


# -- Scatter from run to run: hidden and found, by two routes, and one rogue run is none -------------------

ASSUMED = np.array([0.02, 0.05])


def runs(std, n_runs, seed=0, rows=200, noise=0.3):
    """Return gram and score of runs whose two parameters, of correlated sensitivities, deviate at random."""
    rng = np.random.default_rng(seed)
    deviations = rng.standard_normal((n_runs, 2)) * std
    gram, score = np.empty((n_runs, 2, 2)), np.empty((n_runs, 2))
    for i, own in enumerate(deviations):
        j = rng.standard_normal((2, rows))
        j[1] += 0.5 * j[0]
        j /= noise
        gram[i], score[i] = j @ j.T, j @ (own @ j + rng.standard_normal(rows))
    return gram, score, deviations


def test_it_is_the_maximum_of_the_likelihood_of_normal_deviations(monkeypatch):
    """Values of each run scatter by both about a weighted mean, and a simplex finds the maximum."""
    gram, score, _ = runs(np.array([0.15, 0.3]), 60, seed=3)
    value = np.linalg.solve(gram, score[:, :, None])[:, :, 0]  # of each run by itself

    def loss(log_variance):
        variance = np.exp(log_variance)
        weight = np.linalg.inv(np.linalg.inv(gram) + np.diag(variance))
        mean = np.linalg.solve(weight.sum(axis=0), np.einsum("iqp,ip->q", weight, value))
        off = value - mean
        total = np.einsum("iq,iqp,ip->", off, weight, off) - np.linalg.slogdet(weight)[1].sum()
        return total + PRIOR_RUNS * (log_variance + ASSUMED**2 / variance).sum()

    best = minimize(loss, np.log(ASSUMED**2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8})
    expected = np.exp(best.x / 2)
    assert_allclose(scatter_of(gram, score, ASSUMED), expected, rtol=0.15)
    monkeypatch.setattr(evidence, "TAIL_DOF", 1e12)
    monkeypatch.setattr(evidence, "NORMAL_RATIO", 1.0)
    assert_allclose(scatter_of(gram, score, ASSUMED), expected, rtol=1e-3)
    # and it is never less than what was assumed
    for n_runs in (3, 80):
        gram, score, _ = runs(np.zeros(2), n_runs)
        assert (scatter_of(gram, score, ASSUMED) >= ASSUMED).all()
        assert_allclose(scatter_of(0.0 * gram, 0.0 * score, ASSUMED), ASSUMED)


def test_one_rogue_is_no_scatter_even_if_it_has_moved_the_common_fit():
    larger = []
    for seed in range(10):
        gram, score, deviations = runs(np.array([0.1, 0.1]), 20, seed)
        plain = scatter_of(gram, score, ASSUMED)
        score[7] += gram[7] @ (np.array([2.0, 0.0]) - deviations[7])  # as if of another robot
        larger.append(scatter_of(gram, score, ASSUMED)[0] / plain[0])
    assert np.median(larger) < 1.3
    assert max(larger) < 1.5
    # a fit to six runs, one of another robot, is off by a sixth of it in all of them
    gram, score, deviations = runs(ASSUMED, 6, noise=0.1)
    deviations[2] = [1.0, 0.0]
    score = np.einsum("iqp,ip->iq", gram, deviations - deviations.mean(axis=0))
    assert scatter_of(gram, score, ASSUMED)[0] < 2 * ASSUMED[0]
