"""Paths: geometry against exact ones, the search beside a path, and points that are no path."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.control.paths import (
    CURVATURE,
    HEADING,
    PathStatus,
    S,
    X,
    Y,
    locate,
    path_from_curvature,
    path_from_points,
    path_warnings,
)
from terrain.errors import DataError
from terrain.robots import load_robot

ARC = path_from_curvature(np.array([0.0, 10.0, 14.0, 30.0]), np.array([0.0, 0.0, 0.1, 0.1]))


@pytest.mark.parametrize("spacing", [4, 20])
def test_a_path_comes_back_from_its_points(spacing):
    again = path_from_points(ARC.rows[::spacing, [X, Y]])
    n = min(len(again.rows), len(ARC.rows)) - 20
    assert again.rows[:n, [X, Y]] == pytest.approx(ARC.rows[:n, [X, Y]], abs=0.01)
    inner = slice(40, n)
    assert again.rows[inner, CURVATURE] == pytest.approx(ARC.rows[inner, CURVATURE], abs=0.01)


def test_noise_of_driven_points_does_not_become_curvature():
    rng, points = np.random.default_rng(2), ARC.rows[::10, [X, Y]]
    noisy = path_from_points(points + rng.normal(0.0, 0.02, points.shape), std_m=0.02)
    n = min(len(noisy.rows), len(ARC.rows)) - 40
    assert noisy.rows[40:n, CURVATURE] == pytest.approx(ARC.rows[40:n, CURVATURE], abs=0.05)
    assert noisy.rows[:n, [X, Y]] == pytest.approx(ARC.rows[:n, [X, Y]], abs=0.06)


def test_place_is_the_one_on_exact_arcs():
    for s in (3.0, 12.0, 20.0, 27.3):
        row = ARC.rows[round(s / 0.05)]
        for lateral in (-1.0, 0.3, 2.0):
            x = row[X] - lateral * np.sin(row[HEADING])
            y = row[Y] + lateral * np.cos(row[HEADING])
            found = locate(ARC.rows, x, y, row[HEADING] + 0.1, np.nan)
            assert found[:4] == pytest.approx((row[S], lateral, 0.1, row[CURVATURE]), abs=0.01)
            assert found[4] == PathStatus.OK


def test_search_is_local_and_does_not_go_back():
    loop = path_from_curvature(np.array([0.0, 100.0]), np.array([0.1, 0.1]))  # passes each point 1.6 times
    s, found = np.nan, []
    for row in loop.rows[:1900:7]:
        s = locate(loop.rows, row[X] + 0.02, row[Y], row[HEADING], s)[0]
        found.append(s)
    assert found == pytest.approx(loop.rows[:1900:7, S], abs=0.06)
    assert locate(loop.rows, loop.rows[600, X], loop.rows[600, Y], 0.0, 35.0)[0] == 35.0


def test_statuses_of_places():
    rows = ARC.rows
    heading, end = rows[-1, HEADING], rows[-1, [X, Y]]
    beyond = end + 0.5 * np.array([np.cos(heading), np.sin(heading)])
    assert locate(rows, *beyond, heading, 29.0)[4] == PathStatus.END
    assert locate(rows, 3.0, 9.0, 0.0, 3.0)[4] == PathStatus.FAR
    centre = rows[-1, [X, Y]] + 10.0 * np.array([-np.sin(heading), np.cos(heading)])
    found = locate(path_from_curvature(np.array([0.0, 9.0]), np.array([0.3, 0.3])).rows, 0.0, 3.2, 0.0, 0.0)
    assert found[4] == PathStatus.SINGULAR
    assert np.isfinite(found[:4]).all()
    assert np.isfinite(locate(rows, *centre, 0.0, np.nan)[:4]).all()
    lost = locate(rows, np.nan, 0.0, 0.0, 12.0)
    assert lost[0] == 12.0
    assert lost[4] == PathStatus.NO_POSE


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.empty((0, 2)), "0 different points"),
        ([[0, 0]], "1 different points"),
        ([[0, 0], [1, 0]], "2 different points"),
        ([[0, 0], [0, 0], [1, 0], [1, 0]], "2 different points"),
        ([[0, 0], [1, np.nan], [2, 0], [3, 0]], "point 2"),
        ([[0, 0], [5, 0], [10, 0], [5, 0.01]], "turns back"),
        ([[0, 0], [1e6, 0], [2e6, 0], [3e6, 0]], "m long"),
        ([0, 1, 2, 3], "shape"),
    ],
)
def test_points_that_are_no_path_are_refused(points, message):
    with pytest.raises(DataError, match=message):
        path_from_points(np.array(points, float))


def test_three_points_make_a_path():
    assert path_from_points(np.array([[0.0, 0.0], [5.0, 1.0], [10.0, 0.0]])).length_m > 10.0


def test_repeated_points_are_merged_and_curvature_beyond_the_steering_is_named():
    angle = np.linspace(0.0, 2.0, 50)
    points = 2.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    path = path_from_points(np.repeat(points, 2, axis=0))
    assert path.n_merged == 50
    warnings = path_warnings(path, load_robot("adap2e"))
    assert "curvature is" in warnings[0]
    assert warnings[1].startswith("50 points")
    assert path_warnings(ARC, load_robot("adap2e")) == ()
