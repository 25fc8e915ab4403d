import math

import numpy as np
import pytest
from studies.intervals import drawn_runs

from terrain.robots import load_robot
from terrain.slip_learning import curve
from terrain.slip_learning.curve import (
    BRAKING_CAP_SLIP,
    MIN_ABOVE_BALANCE_SLIP,
    PEAK_SLIP_RATIO,
    WORKING_TRACTION_RATIO,
    contradiction,
    energy_jpm,
    expanded_interval,
    fit_curve,
    insufficiency,
    learn_curve,
    net_peak,
    select_law,
    slip_at,
    targets_of,
    traction_ratio,
    tractive_efficiency,
    units,
    weighted_resistance,
)
from terrain.slip_learning.forces import RunBins, slip_range
from terrain.terramechanics.traction import janosi_force, magic_force

SAND = "janosi", (0.6, 0.16)
SNOW = "magic", (5.0, 2.0, 0.3, 1.0)


def resistances_of(n, value=0.1):
    return np.full((2, n), [[value], [0.01]])


def test_laws_are_those_of_the_simulated_terrain():
    slips = np.array([-0.3, -1e-5, 0.0, 1e-5, 0.02, 0.2, 0.9])
    np.testing.assert_allclose(
        traction_ratio(*SAND, slips), [janosi_force(s, 0.6, 1.0, 0.16) for s in slips], rtol=1e-9, atol=1e-15
    )
    np.testing.assert_allclose(
        traction_ratio(*SNOW, slips), [magic_force(s, 1.0, *SNOW[1]) for s in slips], rtol=1e-12
    )


@pytest.mark.parametrize(("law", "theta"), [SAND, SNOW])
def test_true_law_is_chosen_and_its_parameters_are_recovered(law, theta):
    runs = drawn_runs(law, theta, np.random.default_rng(3))
    assert select_law(runs)[0] == law
    found = fit_curve(law, runs)
    slips = np.linspace(0.05, 0.45, 20)
    np.testing.assert_allclose(
        traction_ratio(law, found, slips), traction_ratio(law, theta, slips), rtol=0.12
    )


def test_a_law_is_scored_on_runs_that_it_was_not_fitted_to():
    """One run of the few is of softer ground: fitted to it, a law would expect it."""
    rng = np.random.default_rng(3)
    runs = [*drawn_runs("janosi", (0.6, 0.6), rng)[:1], *drawn_runs(*SAND, rng)[:3]]
    score = select_law(runs)[2]["janosi"][0]
    odd, others = curve._Pooled(runs[:1]), fit_curve("janosi", runs[1:])
    expected = odd.log_likelihood(*odd.curve("janosi", others), odd.variance("janosi", others))
    assert score == pytest.approx(expected, abs=0.1)
    of_all = fit_curve("janosi", runs)
    fitted = odd.log_likelihood(*odd.curve("janosi", of_all), odd.variance("janosi", of_all))
    assert score < fitted - 0.5


def test_a_session_is_left_out_whole_and_drawn_whole():
    """Two runs of a session on softer ground: each excuses the other, unless both are left out."""
    rng = np.random.default_rng(3)
    odd, runs = drawn_runs("janosi", (0.6, 0.6), rng)[:2], drawn_runs(*SAND, rng)[:4]
    both = [each._replace(session=name) for name, each in zip("aabbcc", [*odd, *runs], strict=True)]
    assert units(both) == [[0, 1], [2, 3], [4, 5]]
    assert units([*odd, *runs]) == [[i] for i in range(6)]
    one, others = curve._Pooled(both[:1]), fit_curve("janosi", both[2:])
    expected = one.log_likelihood(*one.curve("janosi", others), one.variance("janosi", others))
    by_session, by_run = (select_law(each)[2]["janosi"][0] for each in (both, [*odd, *runs]))
    assert by_session == pytest.approx(expected, abs=0.1)
    assert by_session < by_run - 0.5
    learned = [
        learn_curve(each, *resistances_of(6), np.random.default_rng(0), n_bootstrap=60)
        for each in (both, [*odd, *runs])
    ]
    assert [(each.n_sessions, each.n_runs) for each in learned] == [(3, 6), (1, 6)]
    wide, narrow = (each.balance_std for each in learned)
    assert wide > 1.1 * narrow
    assert "within one session" in targets_of(learned[1])["steady"].source
    assert "within one session" not in targets_of(learned[0])["steady"].source


def test_slip_errors_do_not_bias_a_steep_law():
    """Slips that are off by more than the curve's rise must not make the curve steeper and higher."""
    rng = np.random.default_rng(5)
    runs = drawn_runs("magic", (10.0, 1.9, 0.8, 0.97), rng, offset_std=0.006)
    parameters = fit_curve("magic", runs)
    assert traction_ratio("magic", parameters, np.array([0.18]))[0] == pytest.approx(0.8, abs=0.12)


def test_peak_and_no_peak_are_distinguished_and_stay_in_range():
    hump = net_peak(lambda s: -((s - 0.3) ** 2), 0.0, 0.8)
    assert hump == (0.3, "peak")
    assert net_peak(lambda s: -((s - 0.79) ** 2) + 1, 0.0, 0.8).status == "no_peak"
    rising = net_peak(lambda s: traction_ratio(*SAND, s) - 0.1, 0.05, 0.7)
    net = traction_ratio(*SAND, np.array([rising.slip_ratio, 0.7])) - 0.1
    assert rising.status == "no_peak"
    assert net[0] / net[1] == pytest.approx(0.95, abs=1e-3)
    assert net_peak(lambda s: s - 2.0, 0.0, 0.5) == (0.5, "no_peak")  # no net traction
    for slip in (0.01, 0.1, 0.25):
        assert slip_at(*SNOW, traction_ratio(*SNOW, np.array([slip]))[0]) == pytest.approx(slip, abs=1e-4)
    assert math.isnan(slip_at(*SNOW, 0.31))
    assert slip_at(*SNOW, -0.1) == 0.0


def test_runs_that_do_not_suffice_for_a_curve_are_refused():
    rng = np.random.default_rng(0)
    assert "2 runs" in insufficiency(drawn_runs(*SAND, rng, n=2))
    assert "a range of" in insufficiency(drawn_runs(*SAND, rng, reach=0.08))
    runs = drawn_runs(*SAND, rng, n=4)
    assert insufficiency(runs) is None
    empty = RunBins("empty", *np.zeros((4, 0)))
    assert insufficiency([empty, empty, *runs[:2]]) is not None
    assert all(math.isnan(edge) for edge in slip_range([empty, empty]))
    with pytest.raises(ValueError, match="are needed"):
        learn_curve(runs[:2], *resistances_of(2), rng)


def test_a_curve_that_contradicts_itself_is_reported():
    for theta, rho, text in (
        (SAND[1], -0.1, "negative"),
        ((0.01, 0.16), 0.001, "does not rise"),
        (SAND[1], 0.9, "more thrust than the resistance"),
    ):
        rng = np.random.default_rng(1)
        runs = drawn_runs("janosi", theta, rng, noise=0.004)
        curve = learn_curve(runs, *resistances_of(len(runs), rho), rng, n_bootstrap=2)
        assert text in contradiction(curve)


def test_interval_of_few_runs_is_wider_than_its_percentiles():
    draws = np.random.default_rng(0).normal(0.3, 0.02, 4000)
    low, high = expanded_interval(draws, 5, 0.3, (0.0, 0.0))
    assert high - low > 1.25 * (np.quantile(draws, 0.95) - np.quantile(draws, 0.05))
    assert expanded_interval(np.full(50, 0.3), 5, 0.3, (0.01, 0.02)) == pytest.approx((0.29, 0.32))


def test_resistance_is_weighted_by_the_accuracy_of_each_run():
    mean, std = weighted_resistance(np.array([0.1, 0.3, np.nan]), np.array([0.01, 1.0, np.nan]))
    assert mean == pytest.approx(0.1, abs=1e-3)
    assert std >= 0.0099
    assert all(math.isnan(value) for value in weighted_resistance(*np.full((2, 3), np.nan)))


@pytest.mark.parametrize(("law", "theta", "rho"), [(*SAND, 0.2), (*SNOW, 0.04)])
def test_targets_rise_and_have_the_traction_they_are_chosen_for(law, theta, rho):
    rng = np.random.default_rng(4)
    runs = drawn_runs(law, theta, rng, noise=0.003, run_std=0.02)
    curve = learn_curve(runs, *resistances_of(len(runs), rho), rng, n_bootstrap=8)
    targets, robot = targets_of(curve), load_robot("agrimaro")
    steady, traction = targets["steady"].slip_ratio, targets["traction"].slip_ratio
    assert -BRAKING_CAP_SLIP <= targets["braking"].slip_ratio < 0 <= steady < traction or law == "magic"
    f = traction_ratio(curve.law, curve.parameters, np.array([steady, traction]))
    assert f[0] == pytest.approx(curve.resistance_ratio, abs=1e-3)
    assert traction >= steady + MIN_ABOVE_BALANCE_SLIP - 1e-9
    assert traction <= max(PEAK_SLIP_RATIO * curve.peak.slip_ratio, steady + MIN_ABOVE_BALANCE_SLIP) + 1e-9
    assert f[1] - curve.resistance_ratio >= WORKING_TRACTION_RATIO - 0.001
    assert 0 < tractive_efficiency(curve, traction) < 1
    assert tractive_efficiency(curve, steady) == pytest.approx(0.0, abs=1e-3)
    energies = [energy_jpm(curve, s, robot) for s in (-0.2, steady, traction, curve.peak.slip_ratio)]
    assert energies[0] < 0 < energies[1]
    assert energies == sorted(energies)
