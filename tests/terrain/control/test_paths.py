"""Paths against exact geometry, the search beside a path, points that are none, and the law that steers along one."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.control.car_following import SteeringSettings, SteerState, SteerStatus, law_17, steer
from terrain.control.paths import PathStatus, Place, path_from_curvature, path_from_points, read_path
from terrain.errors import DataError, TerrainError
from terrain.robots import load_robot

ARC = path_from_curvature(np.array([0.0, 10.0, 14.0, 30.0]), np.array([0.0, 0.0, 0.1, 0.1]))


def points_of(path):
    return np.column_stack([path.x_m, path.y_m])


@pytest.mark.parametrize(
    ("spacing", "std_m", "off_m", "off_pm"), [(4, 0.0, 0.01, 0.01), (10, 0.02, 0.06, 0.05)]
)
def test_a_path_comes_back_from_its_points_and_their_noise_does_not_become_curvature(
    spacing, std_m, off_m, off_pm
):
    points = points_of(ARC)[::spacing]
    again = path_from_points(points + std_m * np.random.default_rng(2).standard_normal(points.shape), std_m)
    n = min(len(again.x_m), len(ARC.x_m)) - 40
    assert points_of(again)[:n] == pytest.approx(points_of(ARC)[:n], abs=off_m)
    assert again.curvature_pm[40:n] == pytest.approx(ARC.curvature_pm[40:n], abs=off_pm)


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
    beyond, centre = (
        end + 0.5 * np.array([np.cos(heading), np.sin(heading)]),
        [-np.sin(heading), np.cos(heading)],
    )
    tight = path_from_curvature(np.array([0.0, 9.0]), np.array([0.3, 0.3]))
    for path, place, status in (
        (ARC, (*beyond, heading, 29.0), PathStatus.END),
        (ARC, (3.0, 9.0, 0.0, 3.0), PathStatus.FAR),
        (tight, (0.0, 3.2, 0.0, 0.0), PathStatus.SINGULAR),
    ):
        found = path.locate(*place)
        assert found.status == status
        assert np.isfinite(found[:4]).all()
    assert np.isfinite(ARC.locate(*(end + 10.0 * np.array(centre)), 0.0)[:4]).all()
    lost = ARC.locate(np.nan, 0.0, 0.0, 12.0)
    assert (lost.distance_m, lost.status) == (12.0, PathStatus.NO_POSE)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.empty((0, 2)), "0 different points"),
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


def test_three_points_make_a_path_and_repeated_ones_are_merged():
    assert path_from_points(np.array([[0.0, 0.0], [5.0, 1.0], [10.0, 0.0]])).length_m > 10.0
    assert path_from_points(np.repeat(bend(50), 2, axis=0)).n_merged == 50


def bend(n=80, radius=12.0):
    angle = np.linspace(0.0, 2.0, n)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def test_roll_of_a_file_is_that_of_the_path(tmp_path):
    file, points = tmp_path / "rolled.csv", bend()
    rows = np.column_stack([points, np.linspace(0.0, 0.2, len(points))])
    np.savetxt(file, rows, delimiter=",", header="position_x_m,position_y_m,roll_rad", comments="")
    assert read_path(file).roll_rad[[0, -1]] == pytest.approx([0.0, 0.2], abs=0.005)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "columns x_m and y_m"),
        ("x_m,y_m\n0,0\n1,two\n", "row 3 has 'two'"),
        ("x_m,y_m\n0,0\n1\n", "row 3 has 'nothing'"),
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
        with pytest.raises(TerrainError, match=r"is a folder|is no CSV file|cannot be opened"):
            read_path(place)


ROBOT = load_robot("adap2e")
SETTINGS = SteeringSettings()
STRAIGHT = path_from_curvature(np.array([0.0, 50.0]), np.zeros(2))
NO_SLIP = np.zeros(2)


def at(*place):
    return Place(*place, PathStatus.OK)


def steered(place, speed_mps=3.0, dt_s=0.02, state=SteerState(), slips=NO_SLIP):  # noqa: B008
    return steer(ROBOT, SETTINGS, state, STRAIGHT, at(*place), slips, speed_mps, dt_s)


def plain_17(lateral, angle, curvature, front, rear, k_p=0.16, k_d=0.8, base=1.2):
    gamma, alpha = angle + rear, 1 - curvature * lateral
    eta = np.tan(gamma)
    a = -k_p * lateral - k_d * alpha * eta + curvature * alpha * np.tan(gamma) ** 2
    inner = curvature * np.cos(gamma) / alpha + a * np.cos(gamma) ** 3 / alpha**2
    return np.arctan(np.tan(rear) + base / np.cos(rear) * inner) - front


def test_law_is_17():
    rng = np.random.default_rng(0)
    for values in rng.uniform(-0.3, 0.3, (50, 5)):
        assert law_17(SETTINGS, 1.2, *values) == pytest.approx(plain_17(*values))


@pytest.mark.parametrize(("front", "rear"), [(-0.06, -0.04), (0.02, 0.05)])
@pytest.mark.parametrize("curvature", [0.0, 0.08])
def test_deviation_converges_by_its_equation_whatever_the_slip(front, rear, curvature):
    """(2) with known slip under (17): y'' + K_d y' + K_p y = 0 over the distance along the path."""
    lateral, angle, ds, found = 0.5, -rear, 0.005, []
    for _ in range(4000):
        steer_rad = law_17(SETTINGS, 1.2, lateral, angle, curvature, front, rear)
        per_s = (1 - curvature * lateral) / np.cos(
            angle + rear
        )  # distance driven per distance along the path
        bend = np.cos(rear) * (np.tan(steer_rad + front) - np.tan(rear)) / 1.2
        lateral, angle = lateral + ds * np.sin(angle + rear) * per_s, angle + ds * (bend * per_s - curvature)
        found.append(lateral)
    s = np.arange(1, len(found) + 1) * ds
    assert np.array(found) == pytest.approx(0.5 * (1 + 0.4 * s) * np.exp(-0.4 * s), abs=0.01)


def test_predicted_curvature_takes_the_lag_of_the_actuator_out():
    speed = 5.0
    path = path_from_curvature(np.array([0.0, 20.0, 24.0, 60.0]), np.array([0.0, 0.0, 0.1, 0.1]))
    errors = {}
    for horizon in (0.0, 1.0):
        settings = SteeringSettings(delay_s=0.0, horizon_time_constants=horizon)
        state, actual, late = SteerState(), 0.0, []
        for s in np.arange(0.0, 40.0, speed * 0.02):
            curvature = float(np.interp(s, path.distance_m, path.curvature_pm))
            place = at(float(s), 0.0, 0.0, curvature)
            command, state, _ = steer(ROBOT, settings, state, path, place, NO_SLIP, speed, 0.02)
            actual += (1 - np.exp(-0.02 / ROBOT.steering_time_constant_s)) * (command - actual)
            late.append(actual - np.arctan(1.2 * curvature))
        errors[horizon] = np.abs(late).max()
        assert abs(late[-1]) < 1e-6
    assert errors[1.0] < 0.7 * errors[0.0]


def test_slower_gains_above_the_bandwidth_limits_and_statuses():
    at_speed = {v: steered((5.0, 0.2, 0.0, 0.0), v)[0] for v in (1.0, 3.0, 6.0)}
    assert at_speed[1.0] == pytest.approx(at_speed[3.0])
    assert abs(at_speed[6.0]) < 0.5 * abs(at_speed[3.0])
    command, _, status = steered((5.0, 5.0, 0.0, 0.0), 1.0)
    assert command == -ROBOT.steering_max_rad
    assert status == SteerStatus.CLAMPED


def test_bad_inputs_have_a_status_and_a_finite_angle():
    before = SteerState(0.1, 0.12)
    for speed, dt_s in ((np.nan, 0.02), (3.0, np.nan), (3.0, -1.0), (3.0, 5.0), (np.inf, 0.02)):
        found = steered((5.0, 0.1, 0.0, 0.0), speed, dt_s, before)
        assert found == (0.12, before, SteerStatus.BAD_INPUT)
    command, _, status = steered((5.0, np.nan, np.nan, 0.0), state=before, slips=np.full(2, np.nan))
    assert status == SteerStatus.HELD
    assert abs(command) <= ROBOT.steering_max_rad
    for lateral, angle, curvature in ((11.0, 0.0, 0.1), (0.0, 2.0, 0.0), (-3.0, 3.1, -0.5)):
        command, after, status = steered((5.0, lateral, angle, curvature))
        assert np.isfinite([command, *after]).all()
        assert status in (SteerStatus.SINGULAR, SteerStatus.CLAMPED)
