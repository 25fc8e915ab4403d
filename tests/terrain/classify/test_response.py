"""Terrain by what wheels answer: hidden responses are found, and what driving alone says does not count."""

import numpy as np
import pytest
from sklearn.base import clone

from terrain.classify.response import GroupedResponse, ResponseColumns, fit_ground, fit_process, left_out
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


def test_a_process_expects_what_wheels_answer_between_its_points():
    rng = np.random.default_rng(1)
    angle, wheel = rng.uniform(-3, 3, 120), np.arange(120) % 2

    def regime(angle):
        return np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])

    def answer(angle, wheel):
        return 1.0 + 0.5 * np.cos(angle) + 0.1 * wheel

    noisy = answer(angle, wheel) + rng.normal(0, 0.01, 120)
    process, left = fit_process(regime(angle), wheel, noisy, np.arange(120))
    new = np.linspace(-2.9, 2.9, 20)
    for i in range(2):
        np.testing.assert_allclose(process.predict(regime(new), i), answer(new, i), atol=0.02)
    assert 0.008 < left.std() < 0.016


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
    with pytest.raises(DataError, match="do not describe rows of 6"):
        GroupedResponse(ResponseColumns(3, 6)).fit(X, y, groups=groups)
    X[y == "carpet", 4] = np.nan
    with pytest.raises(DataError, match="no window of class 'carpet'"):
        GroupedResponse(COLUMNS).fit(X, y, groups=groups)


def test_a_ground_of_a_single_window_has_a_covariance_that_can_be_used():
    """Differences of a single unit have rank 1."""
    regime = np.array([[[0.6, 0.8, 0.5], [0.8, 0.6, 0.5]]])
    ground, _ = fit_ground(regime, np.array([[-4.1, 30.5, 0.03]]), np.array(["a"]), n_body=1)
    assert np.isfinite(np.linalg.cholesky(ground.covariance)).all()
