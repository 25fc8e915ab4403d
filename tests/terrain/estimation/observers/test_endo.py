"""Endo's law: the regular form against (27) itself, its limits, its derivative."""

import numpy as np
import pytest

from terrain.estimation.observers.endo import endo_slip_speeds, slip_imbalance

D = 0.1965
EXPONENTS = [0.0, 0.3, 0.847, 1.0, 1.3, 2.0]


@pytest.mark.parametrize("n", EXPONENTS)
def test_slip_speeds_are_the_solution_of_27_and_7(n):
    rng = np.random.default_rng(0)
    for _ in range(200):
        left, right = rng.uniform(0.01, 0.3, 2) * rng.choice([-1, 1], 2)
        w = rng.normal()
        u_l, u_r = endo_slip_speeds(left, right, w, D, n)
        alpha_l, alpha_r = u_l / left, u_r / right
        assert right - u_r - left + u_l == pytest.approx(2 * D * w)
        assert alpha_l == pytest.approx(-np.sign(right * left) * abs(right / left) ** n * alpha_r)


def plain_slip_speeds(left, right, w, n):
    """The form of the erratum, with powers."""
    lost = right - left - 2 * D * w
    a, b = (abs(right), abs(left)) if n <= 1 else (abs(left), abs(right))
    a, b = np.power([a, b], abs(1 - n))  # 0^0 is 1
    return -lost * b / (a + b), lost * a / (a + b)


@pytest.mark.parametrize("n", EXPONENTS)
@pytest.mark.parametrize(("left", "right"), [(0.0, 0.1), (0.1, 0.0), (0.1, 0.1), (-0.1, 0.1), (-0.02, 0.12)])
def test_it_is_regular_and_continuous_where_a_track_stops_or_the_robot_spins(n, left, right):
    at = endo_slip_speeds(left, right, 0.4, D, n)
    assert at == pytest.approx(plain_slip_speeds(left, right, 0.4, n), abs=1e-12)
    tiny = 1e-9 if abs(1 - n) > 0.5 else 1e-300 ** (1 / 3)  # |v|^(1 - n) falls slowly near n = 1
    for beside in (tiny, -tiny):
        moved = endo_slip_speeds(left + beside, right + beside, 0.4, D, n)
        expected = plain_slip_speeds(left + beside, right + beside, 0.4, n)
        assert moved == pytest.approx(expected, abs=1e-12)
        assert abs(moved[0] - at[0]) < 0.3 * (tiny / 0.1) ** abs(1 - n) + 1e-8


def test_spin_in_place_shares_the_slip_evenly_for_every_n():
    for n in EXPONENTS:
        u_l, u_r = endo_slip_speeds(-0.1, 0.1, 0.3, D, n)
        assert u_r == -u_l == pytest.approx(0.1 - D * 0.3)


def test_a_pushed_robot_has_no_slip_of_endo():
    assert endo_slip_speeds(0.0, 0.0, 0.5, D, 0.85) == (0.0, 0.0)


@pytest.mark.parametrize("n", [0.3, 0.847, 1.0, 1.3])
def test_the_derivative_by_n_is_numerical(n):
    for left, right in [(0.02, 0.1), (-0.02, 0.1), (0.1, -0.07)]:
        step = 1e-6
        by = slip_imbalance(left, right, n + step)[0] - slip_imbalance(left, right, n - step)[0]
        assert slip_imbalance(left, right, n)[1] == pytest.approx(by / (2 * step), rel=1e-6)
