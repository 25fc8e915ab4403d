"""Paths: geometry against exact ones, the search beside a path, and points that are no path."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.control.paths import PathStatus, path_from_curvature, path_from_points, path_warnings, read_path
from terrain.errors import DataError, TerrainError
from terrain.robots import load_robot

ARC = path_from_curvature(np.array([0.0, 10.0, 14.0, 30.0]), np.array([0.0, 0.0, 0.1, 0.1]))


def points_of(path):
    return np.column_stack([path.x_m, path.y_m])


@pytest.mark.parametrize("spacing", [4, 20])
def test_a_path_comes_back_from_its_points(spacing):
    again = path_from_points(points_of(ARC)[::spacing])
    n = min(len(again.x_m), len(ARC.x_m)) - 20
    assert points_of(again)[:n] == pytest.approx(points_of(ARC)[:n], abs=0.01)
    assert again.curvature_pm[40:n] == pytest.approx(ARC.curvature_pm[40:n], abs=0.01)


def test_noise_of_driven_points_does_not_become_curvature():
    rng, points = np.random.default_rng(2), points_of(ARC)[::10]
    noisy = path_from_points(points + rng.normal(0.0, 0.02, points.shape), std_m=0.02)
    n = min(len(noisy.x_m), len(ARC.x_m)) - 40
    assert noisy.curvature_pm[40:n] == pytest.approx(ARC.curvature_pm[40:n], abs=0.05)
    assert points_of(noisy)[:n] == pytest.approx(points_of(ARC)[:n], abs=0.06)


def test_place_is_the_one_on_exact_arcs():
    for s in (3.0, 12.0, 20.0, 27.3):
        i = round(s / 0.05)
        heading = ARC.heading_rad[i]
        for lateral in (-1.0, 0.3, 2.0):
            x, y = ARC.x_m[i] - lateral * np.sin(heading), ARC.y_m[i] + lateral * np.cos(heading)
            found = ARC.locate(x, y, heading + 0.1)
            assert found[:4] == pytest.approx((s, lateral, 0.1, ARC.curvature_pm[i]), abs=0.01)
            assert found.status == PathStatus.OK


def test_search_is_local_and_does_not_go_back():
    loop = path_from_curvature(np.array([0.0, 100.0]), np.array([0.1, 0.1]))  # passes each point 1.6 times
    s, found = np.nan, []
    for i in range(0, 1900, 7):
        s = loop.locate(loop.x_m[i] + 0.02, loop.y_m[i], loop.heading_rad[i], s).distance_m
        found.append(s)
    assert found == pytest.approx(loop.distance_m[:1900:7], abs=0.06)
    assert loop.locate(loop.x_m[600], loop.y_m[600], 0.0, 35.0).distance_m == 35.0


def test_statuses_of_places():
    heading, end = ARC.heading_rad[-1], points_of(ARC)[-1]
    beyond = end + 0.5 * np.array([np.cos(heading), np.sin(heading)])
    assert ARC.locate(*beyond, heading, 29.0).status == PathStatus.END
    assert ARC.locate(3.0, 9.0, 0.0, 3.0).status == PathStatus.FAR
    centre = end + 10.0 * np.array([-np.sin(heading), np.cos(heading)])
    found = path_from_curvature(np.array([0.0, 9.0]), np.array([0.3, 0.3])).locate(0.0, 3.2, 0.0, 0.0)
    assert found.status == PathStatus.SINGULAR
    assert np.isfinite(found[:4]).all()
    assert np.isfinite(ARC.locate(*centre, 0.0)[:4]).all()
    lost = ARC.locate(np.nan, 0.0, 0.0, 12.0)
    assert (lost.distance_m, lost.status) == (12.0, PathStatus.NO_POSE)


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


def bend(n=80, radius=12.0):
    angle = np.linspace(0.0, 2.0, n)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def test_roll_of_a_file_is_that_of_the_path(tmp_path):
    file = tmp_path / "rolled.csv"
    points = bend()
    rows = np.column_stack([points, np.linspace(0.0, 0.2, len(points))])
    np.savetxt(file, rows, delimiter=",", header="position_x_m,position_y_m,roll_rad", comments="")
    path = read_path(file)
    assert path.roll_rad[[0, -1]] == pytest.approx([0.0, 0.2], abs=0.005)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "columns x_m and y_m"),
        ("x_m,y_m\n0,0\n1,two\n", "row 3 has 'two'"),
        ("x_m,y_m\n0,0\n1\n", "row 3 has 'nothing'"),
        ("x_m,y_m\n0,0\n1,nan\n2,0\n3,0\n", "point 2"),
        ("x_m,y_m\n0,0\n1,0\n", "2 different points"),
        ("5\n6\n", "two columns"),
        ("x_m,y_m,roll_rad\n0,0,0\n1,0,3\n2,0,0\n3,0,0\n", "roll_rad is beyond"),
    ],
)
def test_a_file_that_is_no_path_is_one_sentence(tmp_path, text, message):
    file = tmp_path / "path.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(TerrainError, match=message) as refused:
        read_path(file)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_bytes_and_folders_are_no_path(tmp_path):
    (tmp_path / "noise.csv").write_bytes(b"\xff\xfe\x00\x9f")
    for place in (tmp_path, tmp_path / "noise.csv", tmp_path / "none.csv"):
        with pytest.raises(TerrainError, match="cannot be read"):
            read_path(place)
