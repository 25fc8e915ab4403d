import numpy as np
import pytest
from sklearn.base import clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from terrain.classify.ground_response import (
    SPEED_LENGTH,
    fit_process,
    left_out,
    regimes,
    unit_means,
    units_of,
)
from terrain.classify.response import GroupedResponse, ResponseColumns, log_density
from terrain.errors import DataError

WHEELS = np.radians([150.0, 270.0, 390.0])
COLUMNS = ResponseColumns(3, 3)


def driven(rng, terrain, directions, runs_each=2, windows=4, scatter=0.02):
    """Return wheel speeds and currents of runs on a ground that answers by direction, and the run of each."""
    grounds = {"linoleum": (0.3, 0.2), "carpet": (0.3, 0.5), "mat": (0.9, 0.1)}
    friction, drag = grounds[terrain]
    rows, groups = [], []
    for number, direction in enumerate(np.repeat(directions, runs_each)):
        off = rng.normal(0.0, scatter, 3)
        for _ in range(windows):
            speed = 0.1 * np.cos(WHEELS - direction)
            current = friction * np.tanh(np.abs(speed) / 0.05) + drag * np.abs(speed) / 0.1 + off
            rows.append(np.concatenate([speed, current + rng.normal(0.0, scatter, 3)]))
            groups.append(f"{terrain}_{number}")
    return np.array(rows), np.array(groups)


def data_of(rng, terrains, directions, **keywords):
    parts = [driven(rng, terrain, directions, **keywords) for terrain in terrains]
    X = np.concatenate([rows for rows, _ in parts])
    y = np.repeat(terrains, [len(rows) for rows, _ in parts])
    return X, y, np.concatenate([groups for _, groups in parts])


def test_the_regime_of_each_wheel_is_the_same_motion_seen_from_it():
    speed = np.array([[0.1, -0.2, 0.3]])
    found = regimes(speed, 1.0)[0]
    np.testing.assert_allclose(found[0, [1, 2, 0]], found[1, :3])
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1.0)
    np.testing.assert_allclose(regimes(2 * speed, 2.0), found[None])
    assert np.isnan(regimes(np.zeros((1, 3)), 1.0)[0, :, :3]).all()


def test_what_is_left_out_is_what_a_fit_without_it_says():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (30, 2))
    covariance = np.exp(-((points[:, None] - points) ** 2).sum(-1)) + 0.1 * np.eye(30)
    response, block = rng.normal(size=30), np.repeat(np.arange(10), 3)
    found = left_out(covariance, response, block)
    for number in range(10):
        own, rest = np.flatnonzero(block == number), np.flatnonzero(block != number)
        cross = covariance[np.ix_(own, rest)]
        expected = cross @ np.linalg.solve(covariance[np.ix_(rest, rest)], response[rest])
        np.testing.assert_allclose(found[own], response[own] - expected, rtol=1e-8)


def test_a_process_predicts_as_the_library_does():
    rng = np.random.default_rng(1)
    X, groups = driven(rng, "carpet", np.linspace(-3, 3, 15), runs_each=1)
    regime = regimes(X[:, :3], 0.2)
    unit = units_of(regime[:, 0], groups)
    mean_regime, mean_current = unit_means(regime, unit), unit_means(X[:, 3:], unit)
    points = np.concatenate([mean_regime[:, i] for i in range(3)])
    wheel = np.repeat(np.arange(3), len(mean_regime))
    values = mean_current.T.ravel()
    process, _ = fit_process(points, wheel, values, np.tile(np.arange(len(mean_regime)), 3))
    scales = [process.length] * 3 + [SPEED_LENGTH]
    kernel = ConstantKernel(process.common) * RBF([*scales, 1e6, 1e6, 1e6]) + ConstantKernel(
        process.own
    ) * RBF([*scales, 1.0, 1.0, 1.0])
    apart = 10.0 * np.eye(3)
    scaled = (values - values.mean()) / values.std()
    noise = _noise_of(kernel, np.column_stack([points, apart[wheel]]), scaled, process, values.std())
    library = GaussianProcessRegressor(kernel + WhiteKernel(noise), optimizer=None, alpha=1e-8)
    library.fit(np.column_stack([points, apart[wheel]]), scaled)
    new = regimes(driven(rng, "carpet", np.linspace(-2, 2, 7), windows=1)[0][:, :3], 0.2)
    for i in range(3):
        expected = library.predict(np.column_stack([new[:, i], np.tile(apart[i], (len(new), 1))]))
        np.testing.assert_allclose(
            process.predict(new[:, i], i), values.mean() + values.std() * expected, atol=1e-5
        )


def _noise_of(kernel, points, scaled, process, spread):
    """Return the scatter that the weights of a process were solved with: (K + c 1) w = y."""
    weight = process.weight / spread
    return float(np.median((scaled - kernel(points) @ weight) / weight)) - 1e-8


def test_ground_is_found_by_what_wheels_answer_on_runs_that_were_left_out():
    rng = np.random.default_rng(2)
    X, y, groups = data_of(rng, ["linoleum", "carpet", "mat"], np.linspace(-3, 3, 25), runs_each=1)
    fitted = GroupedResponse(COLUMNS).fit(X, y, groups=groups)
    new, truth, _ = data_of(rng, ["linoleum", "carpet", "mat"], np.linspace(-2.8, 2.8, 9))
    assert np.mean(fitted.predict(new) == truth) > 0.97
    inner = fitted.classes_[fitted.inner_probability_.argmax(axis=1)]
    assert np.mean(inner == y) > 0.95


def test_a_direction_that_only_one_terrain_was_driven_in_does_not_name_it():
    """Two grounds that answer alike, driven in different directions: a label cannot be known."""
    rng = np.random.default_rng(3)
    X, groups = driven(rng, "carpet", np.linspace(-3, 3, 24))
    run = np.unique(groups, return_inverse=True)[1]
    y = np.where(run % 4 < 2, "north", "south")
    fitted = GroupedResponse(COLUMNS).fit(X, y, groups=groups)
    new, _ = driven(rng, "carpet", np.linspace(-2.9, 2.9, 15))
    assert np.median(fitted.predict_proba(new).max(axis=1)) < 0.75


def test_a_missing_response_leaves_the_others_and_a_standing_robot_says_nothing():
    rng = np.random.default_rng(4)
    X, y, groups = data_of(rng, ["linoleum", "carpet"], np.linspace(-3, 3, 13))
    fitted = clone(GroupedResponse(COLUMNS)).fit(X, y, groups=groups)
    new, truth, _ = data_of(rng, ["linoleum", "carpet"], np.linspace(-2.8, 2.8, 9))
    new[:, 4] = np.nan
    assert np.mean(fitted.predict(new) == truth) > 0.9
    new[:, 3:] = np.nan
    np.testing.assert_allclose(fitted.predict_proba(new), 0.5)
    new[:, :3] = 0.0
    np.testing.assert_allclose(fitted.predict_proba(new), 0.5)


def test_data_that_cannot_answer_are_refused():
    rng = np.random.default_rng(5)
    X, y, groups = data_of(rng, ["linoleum", "carpet"], np.linspace(-3, 3, 5))
    with pytest.raises(DataError, match="at least two classes"):
        GroupedResponse(COLUMNS).fit(X, np.full(len(y), "carpet"), groups=groups)
    with pytest.raises(DataError, match="do not describe rows of 6"):
        GroupedResponse(ResponseColumns(3, 6)).fit(X, y, groups=groups)
    X[y == "carpet", 4] = np.nan
    with pytest.raises(DataError, match="no window of class 'carpet'"):
        GroupedResponse(COLUMNS).fit(X, y, groups=groups)


def test_the_density_of_known_responses_is_that_of_their_part_of_the_covariance():
    covariance = np.array([[2.0, 0.6], [0.6, 1.0]])
    apart = np.array([[1.0, np.nan], [np.nan, 1.0]])
    found = log_density(apart, covariance)
    alone = [log_density(np.array([[1.0]]), covariance[i : i + 1, i : i + 1])[0] for i in range(2)]
    np.testing.assert_allclose(found, alone)
