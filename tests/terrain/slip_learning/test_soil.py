"""Laws fitted to trials: hidden numbers come back, held-out trials are not seen, measured ones agree."""

from __future__ import annotations

import numpy as np
import pytest
from studies.intervals import SPEEDS_MMPS, wheel_trials

from pipelines.data.datasets import load_runs
from terrain.errors import DataError
from terrain.slip_learning.soil import (
    GIVEN,
    LAWS,
    WHEELS,
    calibration_rows,
    cohesion_profile,
    fit_law,
    fit_plain_soil,
    held_out_predictions,
    law_predictor,
    misfit,
    modulus_spread,
    parameters_of,
    plain_prediction,
    plain_soil,
    predict,
    regime_misfits,
    setting_means,
    side_coupling,
    trials_of,
    without_coupling,
)
from terrain.terramechanics.travel_sinkage import TRAVEL

WHEEL = WHEELS["testbed_smooth"]
LAW = LAWS["inflow"]
HIDDEN = {"tan_friction": 0.65, "shear_modulus_m": 0.016, "side_pressure_ratio": 19.0}
SHALLOW = {"rolling_m": 0.017, "slip_ratio": 0.6}


def simulated(seed):
    depth = np.array([SHALLOW.get(name, value) for name, (value, _) in TRAVEL.items()])
    return wheel_trials(LAW, depth, HIDDEN, seed)


def test_hidden_numbers_come_back_within_their_intervals():
    trials = simulated(0)
    fit = fit_law(LAW, trials, WHEEL)
    found = parameters_of(fit, trials, 8, 0)
    for name, value in (HIDDEN | SHALLOW).items():
        low, high = found[name].interval
        half = max((high - low) / 2.0, 1e-3 * value)
        assert found[name].identified, name
        assert abs(found[name].value - value) < 1.5 * half, (name, found[name])
    assert misfit(trials, predict(fit, trials)).pull_ratio < 0.05


def test_what_the_trials_do_not_hold_is_marked_so():
    skid_only = simulated(1)
    skid_only = skid_only.chosen(skid_only.slip_ratio <= 0.01)
    found = parameters_of(fit_law(LAW, skid_only, WHEEL), skid_only, 4, 0)
    assert not found["peak_slip_ratio"].identified
    assert found["peak_slip_ratio"].informed_ratio == pytest.approx(1.0, abs=0.02)
    assert found["tan_friction"].identified


def test_held_out_trials_are_in_no_fit_and_all_are_predicted():
    """And cohesion takes the place of friction."""
    trials, law = simulated(3), LAWS["wong_reece"]
    trials, seen = trials.chosen(np.isin(trials.angle_setting, [0.0, 45.0, 60.0])), []
    angles = [row.friction_angle_rad for row in cohesion_profile(law, trials, WHEEL, (0.0, 500.0, 1000.0))]
    assert angles[0] > angles[1] > angles[2]

    def predictor(training, tested):
        seen.append((set(training.slip_setting.tolist()), set(tested.slip_setting.tolist())))
        return {"load": predict(fit_law(law, training, WHEEL), tested)}

    found = held_out_predictions(trials, predictor, "slip")["load"]
    assert np.isfinite(found.pull_n).all()
    assert regime_misfits(trials, found)["rolling, 45 to 75 deg"].pull_ratio < 0.3
    assert len(seen) == len(SPEEDS_MMPS)
    assert all(not training & tested for training, tested in seen)


def test_the_simulators_law_gets_its_own_soil_back():
    trials = simulated(5)
    straight = trials.chosen((trials.angle_setting < 31) & (trials.slip_ratio > -0.6))
    truth = plain_soil(np.array([0.5, 0.012, 8e5, 0.3]))
    made = plain_prediction(truth, straight, WHEEL)
    own = straight._replace(pull_n=made.pull_n, side_n=made.side_n, sinkage_m=made.sinkage_m)
    found = fit_plain_soil(own, WHEEL).values
    assert list(found.values()) == pytest.approx([0.5, 0.012, 8e5, 0.3], rel=1e-3)


def test_too_few_settings_and_runs_of_another_kind_are_refused(make_run):
    with pytest.raises(DataError, match="trials have 9 settings of slip and angle, a fit needs 20 or more"):
        setting_means(simulated(0).chosen(simulated(0).angle_setting == 15.0))
    with pytest.raises(DataError, match="run SNOW_01: has no stream 'testbed'"):
        trials_of([make_run()], WHEEL)


def test_the_coupling_of_a_testbed_is_found_by_symmetry_and_taken_off():
    trials = simulated(6)
    clean = trials.chosen(~calibration_rows(trials))
    three = trials.chosen(np.flatnonzero(calibration_rows(trials)).repeat(3))
    bent = trials.chosen(np.r_[np.arange(trials.n), np.flatnonzero(calibration_rows(trials)).repeat(2)])
    bent = bent._replace(pull_n=bent.pull_n - 0.13 * bent.side_n)
    found = side_coupling(bent)
    assert found.n_trials == three.n
    assert found.ratio == pytest.approx(-0.13, abs=3 * 0.03 * 22.0 / three.side_n[0])
    back = without_coupling(bent, found)
    np.testing.assert_allclose(back.pull_n, clean.pull_n, atol=0.04 * 60.0)
    none = side_coupling(clean)
    assert (none.n_trials, np.isnan(none.ratio)) == (0, True)
    assert without_coupling(clean, none) is clean


@pytest.mark.parametrize("robot", ["testbed_smooth", pytest.param("testbed_grouser", marks=pytest.mark.slow)])
def test_measured_trials_are_predicted_at_slips_that_were_held_out(measured, robot):
    """Of the smooth wheel at one slip of nine."""
    runs = [run for run in load_runs(measured("wheel_testbed")) if run.robot == robot]
    trials = trials_of(runs, WHEELS[robot])
    trials = without_coupling(trials, side_coupling(trials))
    if robot == "testbed_smooth":
        tested = trials.slip_setting == np.unique(trials.slip_setting)[5]
        fit = fit_law(LAW, setting_means(trials.chosen(~tested)), WHEELS[robot])
        trials = trials.chosen(tested)
        found = {given: predict(fit, trials, given) for given in GIVEN}
    else:
        found = held_out_predictions(trials, law_predictor(LAW, WHEELS[robot]), "slip")
        spread = modulus_spread(fit_law(LAW, setting_means(trials), WHEELS[robot]), trials)
        assert spread.smallest_pa < spread.rolling_pa
    load, sinkage = (misfit(trials, found[given]) for given in GIVEN)
    assert max(load.pull_ratio, load.side_ratio, sinkage.pull_ratio, sinkage.side_ratio) < 0.4
    assert load.sinkage_m < 0.008
