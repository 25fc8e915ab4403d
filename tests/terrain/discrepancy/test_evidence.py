"""The quadratic form is generalised least squares with the scatter of each run written out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.stats import norm
from scipy.stats import t as student

from terrain.discrepancy import evidence
from terrain.discrepancy.evidence import (
    N_BLOCKS,
    PRIOR_RUNS,
    TRUST_DOF,
    Evidence,
    correlation,
    grams_of,
    held_out_gain,
    move_point,
    partial_information,
    pooled_variance,
    scatter_of,
    wald_test,
    z_of,
    z_of_t,
)
from terrain.discrepancy.runs import Simulation
from terrain.discrepancy.search import misfit_of
from terrain.effects import CHANNELS, INDEX, SPEED_X, effect_named
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
    change, cov = info.fit(NAMES)
    expected = np.linalg.solve(total_a[np.ix_(at, at)], total_g[at])
    std = np.sqrt(np.diag(cov))
    assert_allclose(change / std, expected / std, atol=1e-5)
    assert_allclose(cov, np.linalg.inv(total_a[np.ix_(at, at)]), rtol=1e-5, atol=1e-12)
    assert info.loss(NAMES) == pytest.approx(-total_g[at] @ expected)
    assert info.loss(()) == 0.0
    assert abs(change[1] - HIDDEN["camera_yaw_rad"]) < 4 * std[1]
    # and its thirds sum up to the whole
    for thirds, whole in zip(
        info.clusters(range(len(info.names)), by_run=False), (info.a, info.g), strict=True
    ):
        parts = thirds.reshape(len(whole), N_BLOCKS, *whole.shape[1:])
        assert_allclose(parts.sum(axis=1), whole, atol=1e-9 * np.abs(whole).max())
    # counted from elsewhere it is the same form
    there = info.counted_from(info.vector - move_point(0.0 * info.vector, NAMES, change))
    k = info.places(NAMES)
    moved = np.zeros(len(info.names))
    moved[k] = change
    assert_allclose(there.fit(NAMES)[0], 2.0 * change, rtol=1e-6)
    assert there.c.sum() == pytest.approx((info.c + 2.0 * info.g @ moved + moved @ info.a @ moved).sum())
    for left, white in zip(there.residuals(moved), info.white, strict=True):
        assert_allclose(left, white[-1], atol=1e-9)


def test_a_nuisance_is_a_parameter_too_and_its_scatter_widens_its_variance(info, problem):
    assert info.names[: len(NAMES)] == NAMES
    assert set(np.array(info.names)[info.nuisances]) == set(SCATTER)
    steady = problem._replace(simulation=Simulation(HUSKY))
    firm = steady.at(info.vector, NAMES, noise=info.noise)
    name = ["rolling_resistance_ratio"]  # which scatters
    wide, narrow = info.fit(name)[1][0, 0], firm.fit(name)[1][0, 0]
    # the mean over runs cannot be better known than its scatter lets
    assert wide > SCATTER["rolling_resistance_ratio"] ** 2 / len(info.rows) > narrow
    assert firm.nuisances.size == 0
    here = steady.near(firm, info.vector, NAMES)
    scale = np.sqrt(here.a[0].diagonal())
    assert_allclose(here.a[0] / np.outer(scale, scale), firm.a.sum(0) / np.outer(scale, scale), atol=1e-9)


def test_two_points_differ_in_misfit_as_their_likelihoods_do(problem, info):
    """By sums of squares a mass, which enlarges the noise of the wheels, would be ahead or behind by far more."""
    names = ["camera_yaw_rad", "payload_ratio"]
    before = misfit_of(info, info)
    for change in (info.fit(names)[0], np.array([0.0, 0.05])):
        point = problem.near(info, move_point(info.vector, names, change), names)
        a, g = info.total(names)
        expected, size = change @ a @ change - 2 * g @ change, change @ a @ change
        assert misfit_of(info, point) - before == pytest.approx(expected, abs=0.1 * size + 1.0)


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


# -- Evidence of an effect, on linear problems whose answer is known ------------------------------------------

PARAMETERS = ("payload_ratio", "gyro_bias_radps", "lever_x_m", "lever_y_m", "wheel_radius_ratio")
N_RUNS, N_ROWS = 8, 120
STD = 1 / (100.0 * np.sqrt(N_RUNS * N_ROWS))
"""Of an estimate."""

PAYLOAD, LEVER, RADIUS = map(effect_named, ("payload", "lever_arm", "wheel_radius"))


def linear(payload=0.0, seed=0, n_runs=N_RUNS, scatter=0.0, alike=0.0, model_std=0.0, lever=0.0):
    """Return a linear problem with white noise of size one, as evidence.

    Parameters
    ----------
    payload, lever : what is there, in standard deviations
    scatter : standard deviation from run to run of the first parameter
    alike : correlation of the sensitivities of the first and the last parameter
    model_std : the simulation's own error in units of the first parameter
    """
    rng = np.random.default_rng(seed)
    k, true = len(PARAMETERS), np.array([payload * STD, 0.0, lever * STD, 0.0, 0.0])
    grams = np.empty((n_runs, N_BLOCKS, k + 1, k + 1))
    for i in range(n_runs):
        j = rng.standard_normal((k, N_ROWS)) * 100.0
        j[-1] = alike * j[0] + np.sqrt(1 - alike**2) * j[-1]
        own = true + np.eye(k)[0] * scatter * rng.standard_normal()
        r = own @ j + rng.standard_normal(N_ROWS)
        grams[i] = grams_of(np.vstack([j, r])[:, :, None])
    point = np.zeros(len(INDEX))
    return Evidence(PARAMETERS, point, point, grams, {}, (), None, (), np.eye(k)[0] * model_std)


def test_evidence_is_the_fit_over_its_noise():
    z = np.array([wald_test(linear(10.0, seed), (), PAYLOAD).z for seed in range(60)])
    # a t statistic of ten or so, as a normal number, is less: its variance is uncertain
    assert np.median(z) == pytest.approx(z_of_t(10.0, TRUST_DOF + N_RUNS - 1), rel=0.1)
    test = wald_test(linear(10.0), (), PAYLOAD)
    assert test.significant
    assert abs(test.change[0] - 10 * STD) < 4 * STD
    assert_allclose(test.change, linear(10.0).fit(["payload_ratio"])[0])
    assert wald_test(linear(10.0, n_runs=3), (), PAYLOAD).significant  # thirds of runs are the clusters
    assert wald_test(linear(lever=12.0), (), LEVER).significant


@pytest.mark.parametrize(("effect", "selected"), [(PAYLOAD, ("gyro_bias_radps",)), (LEVER, ())])
def test_without_a_hidden_effect_evidence_has_its_nominal_rate(effect, selected):
    z = np.array([wald_test(linear(seed=seed), selected, effect).z for seed in range(200)])
    for limit in (1.0, 2.0, 3.0):
        expected = 2 * norm.sf(limit)
        assert (z > limit).mean() < expected + 3 * np.sqrt(expected / 200)
    assert (z > 1.0).mean() > 0.2


def test_differences_from_run_to_run_reduce_evidence():
    same, other = (wald_test(linear(40.0, scatter=scatter), (), PAYLOAD) for scatter in (0.0, 100 * STD))
    assert same.dispersion == pytest.approx(1.0, abs=0.6)
    assert other.inflation == other.dispersion > 10.0
    assert other.z < 0.3 * same.z


def test_out_of_bounds_or_without_information_nothing_is_significant():
    far = wald_test(linear(1.2 * PAYLOAD.parameters[0].high / STD), (), PAYLOAD)
    assert (far.inside, far.significant) == (False, False)
    blind = linear()
    blind.grams[:, :, 0] = blind.grams[:, :, :, 0] = 0.0
    test = wald_test(blind, (), PAYLOAD)
    assert (test.z, test.significant) == (0.0, False)


@pytest.mark.parametrize("n_runs", [3, N_RUNS])
def test_held_out_gain_is_that_of_fits_without_each_run(n_runs):
    info = linear(5.0, n_runs=n_runs)
    base, both = [1], [1, 0]

    def loss(i, at):
        rest = [k for k in range(n_runs) if k != i]
        a, g = info.a[rest].sum(axis=0)[np.ix_(at, at)], info.g[rest].sum(axis=0)[at]
        x = np.linalg.solve(a, g)
        return x @ info.a[i][np.ix_(at, at)] @ x - 2 * x @ info.g[i][at]

    expected = [loss(i, base) - loss(i, both) for i in range(n_runs)]
    assert_allclose(held_out_gain(info, base, both), expected, rtol=1e-5, atol=1e-6)
    plain = [-loss(i, both) for i in range(n_runs)]
    assert_allclose(held_out_gain(info, [], both), plain, rtol=1e-5, atol=1e-6)


def test_a_variance_is_pooled_from_noise_and_clusters():
    fraction, size = np.full(12, 1 / 12), 50.0
    fits = (
        (1 - fraction) * np.sqrt(size / 12) * np.sqrt(12 / 11)
    )  # clusters that scatter as the noise lets them
    variance, dof = pooled_variance(fits, fraction, size)
    assert variance == pytest.approx(1.0)
    assert dof == pytest.approx(TRUST_DOF + 11)
    none, _ = pooled_variance(np.zeros(12), fraction, size)
    assert none == pytest.approx(TRUST_DOF / (TRUST_DOF + 11))  # noise alone is believed so far
    large, dof = pooled_variance(1000 * fits, fraction, size)
    assert large == pytest.approx(1e6 * 11 / (TRUST_DOF + 11), rel=1e-3)
    assert dof == pytest.approx(11, rel=1e-3)
    one_tells = np.array([0.9, *np.full(11, 0.1 / 11)])
    _, dof = pooled_variance(1000 * (1 - one_tells) * np.sqrt(size / 12), one_tells, size)
    assert dof < 1.5


def test_z_scores_are_as_improbable_as_the_statistics_they_represent():
    for t, dof in ((2.0, 5.0), (8.0, 15.0)):
        assert 2 * norm.sf(z_of_t(t, dof)) == pytest.approx(2 * student.sf(t, dof))
    assert z_of(np.log(2 * norm.sf(3.0))) == pytest.approx(3.0)
    assert z_of(0.0) == 0.0
    assert z_of(-599.0) == pytest.approx(z_of(-601.0), rel=0.02)
    assert z_of(-1e4) > z_of(-601.0)
    # what is seen a hundred times over has a number too, and it grows with what is seen
    z = [wald_test(linear(lever=size), (), LEVER).z for size in (30.0, 100.0, 300.0)]
    assert np.isfinite(z).all()
    assert z == sorted(z)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_the_simulations_own_error_adds_to_the_variance_of_a_value(ratio):
    infos = [linear(500.0, model_std=std) for std in (0.0, ratio * STD)]
    std = float(np.sqrt(infos[0].fit(["payload_ratio"])[1][0, 0]))
    plain, doubtful = (wald_test(info, (), PAYLOAD) for info in infos)
    assert doubtful.change == pytest.approx(plain.change)
    assert doubtful.dispersion == pytest.approx(plain.dispersion + (ratio * STD / std) ** 2, rel=1e-6)
    assert doubtful.z < plain.z
    # what payload may be off by does not touch an effect beside it
    assert wald_test(infos[0], (), RADIUS).z == wald_test(infos[1], (), RADIUS).z
