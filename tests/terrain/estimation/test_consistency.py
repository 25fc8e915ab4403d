"""A right filter is consistent, its innovations are white, and noise that is off is found where it is."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from model_draws import CARRIAGE, sample_from_model

from terrain.errors import DataError
from terrain.estimation.consistency import (
    consistency_report,
    innovations,
    nees,
    true_states,
)
from terrain.estimation.filter import FilterSettings, run_filter
from terrain.estimation.models.swerve import make_filter
from terrain.records import RunLog, StateTrack, Stream
from terrain.robots import load_robot
from terrain.signals import low_passed
from terrain.simulation.run import simulate_run


@cache
def drawn():
    return sample_from_model(CARRIAGE, 4000, 0.05, np.random.default_rng(0))


def ridden():
    """Return stamps, truth and measurements of the carriage's own equations, for the caller to change."""
    return tuple(each.copy() for each in drawn())


def verdicts(entries):
    return {entry.name: entry.verdict for entry in entries}


def test_a_filter_on_its_own_equations_is_consistent():
    time_s, truth, z = ridden()
    report = consistency_report(run_filter(CARRIAGE, time_s, z), truth)
    assert verdicts(report["sensors"]) == {"place": "consistent", "rate": "consistent"}
    assert set(verdicts(report["states"])) == {"position", "speed", "all"}
    assert list(verdicts(report["states"]).values()).count("consistent") >= 2  # three bounds of 95 %
    for entry in report["sensors"]:
        assert entry.n_independent > 0.8 * entry.n  # innovations are white
    assert {e.name: e for e in report["states"]}["position"].n_independent < 0.8 * 4000  # errors are not


@pytest.mark.parametrize(("factor", "verdict"), [(1 / 3, "overconfident"), (3.0, "conservative")])
def test_noise_that_is_off_is_found_where_it_is(factor, verdict):
    time_s, truth, z = ridden()
    off = replace(CARRIAGE, measurement_variance=CARRIAGE.measurement_variance * [1.0, factor])
    report = consistency_report(run_filter(off, time_s, z), truth)
    assert verdicts(report["sensors"])["rate"] == verdict
    wrong = replace(
        CARRIAGE,
        process_variance=CARRIAGE.process_variance * factor,
        measurement_variance=CARRIAGE.measurement_variance * factor,
    )
    report = consistency_report(run_filter(wrong, time_s, z), truth)
    assert verdicts(report["sensors"]) == {"place": verdict, "rate": verdict}
    assert verdicts(report["states"])["all"] == verdict


def test_a_filter_that_leaves_out_what_does_not_fit_is_not_called_consistent():
    time_s, truth, z = ridden()
    z[np.random.default_rng(0).random(len(z)) < 0.05, 1] += 5.0
    (place, rate) = consistency_report(run_filter(CARRIAGE, time_s, z))["sensors"]
    assert rate.gated_fraction == pytest.approx(0.05, abs=0.015)
    assert (place.verdict, rate.verdict) == ("consistent", "overconfident")
    z[:, 0] = np.nan  # and of a sensor without measurements the verdict is unknown
    truth[:, 1] = np.nan
    report = consistency_report(run_filter(CARRIAGE, time_s, z), truth)
    assert report["sensors"][0].verdict == "unknown"
    assert report["sensors"][0].n == 0
    assert np.isnan(report["sensors"][0].mean_per_dof)
    assert set(verdicts(report["states"])) == {"position"}


def test_nees_is_the_squared_error_over_its_covariance_with_angles_wrapped():
    mean = np.array([[3.1, 1.0], [-3.1, 1.0]])
    cov = np.array([[[0.04, 0.01], [0.01, 0.09]]] * 2)
    empty = np.zeros((2, 0))
    states = ("yaw_rad", "speed_mps")
    track = StateTrack(np.arange(2.0), mean, cov, states, empty, empty, empty, (), np.zeros(2), 0.0)
    truth = np.array([[-3.1, 1.2], [3.1, np.nan]])
    error = np.array([6.2 - 2 * np.pi, -0.2])
    np.testing.assert_allclose(nees(track, truth), [error @ np.linalg.solve(cov[0], error), np.nan])
    np.testing.assert_allclose(nees(track, truth, ["yaw_rad"]), error[0] ** 2 / 0.04)
    with pytest.raises(DataError, match="the track has no state 'slip_1_ratio': it has yaw_rad, speed_mps"):
        nees(track, truth, ["yaw_rad", "slip_1_ratio"])
    with pytest.raises(DataError, match=r"truth has shape \(2, 1\), \(2, 2\) is needed"):
        nees(track, truth[:, :1], ["yaw_rad"])


ROBOT = load_robot("agrimaro")


def test_innovations_scaled_have_unit_variance_and_no_memory_and_are_none_after_a_gap():
    model = make_filter("vio15", ROBOT)
    time_s, _, z = sample_from_model(model, 1500, 0.02, np.random.default_rng(0))
    z[200:250, model.rows.index("camera_speed_x_mps")] = np.nan
    track = run_filter(model, time_s, z, FilterSettings(gate_probability=1.0))
    found = innovations(model, track, z)
    assert np.isnan([value[0] for value, _ in found.values()]).all()
    for value, std in found.values():
        scaled = (value / std)[50:]
        scaled = scaled[np.isfinite(scaled)]
        assert abs(scaled.var() - 1.0) < 5 * np.sqrt(2 / scaled.size)
        assert abs(np.mean(scaled[1:] * scaled[:-1])) < 5 / np.sqrt(scaled.size)
    # the first sensor of a step, conditioned on before the others, has the square that the filter kept
    (row,) = model.sensors[0][1]
    value, std = found[row]
    np.testing.assert_allclose((value / std)[1:] ** 2, track.nis[1:, 0], rtol=1e-6, atol=1e-9)

    time_s, z = np.where(np.arange(400) < 200, time_s[:400], time_s[:400] + 6.0), z[:400]
    track = run_filter(model, time_s, z)
    found = innovations(model, track, z[np.searchsorted(time_s, track.time_s)])
    after = int(np.flatnonzero(np.diff(track.time_s) > 1.0)[0]) + 1
    for row in ("gyro_z_radps", "wheel_1_radps"):
        value, std = found[row]
        assert np.isnan([value[after], std[after]]).all()
        assert np.isfinite(value[after + 1 :]).all()


STATES = ("yaw_rad", "speed_x_mps", "steer_2_rad", "gyro_bias_radps", "slip_speed_3_mps", "effective_track_m")


def empty_track(states, time_s):
    (n, d), none = (len(time_s), len(states)), np.zeros((len(time_s), 1))
    cov = np.tile(np.eye(d), (n, 1, 1))
    return StateTrack(time_s, np.zeros((n, d)), cov, states, none, none, none, ("s",), np.zeros(n), 0.0)


def test_truth_passes_the_low_pass_of_the_filter_inputs_and_is_none_without_one():
    run, time_s = simulate_run(ROBOT, "grass", "arc", 0, duration_s=10.0), np.arange(0.5, 9.0, 0.02)
    truth = run.streams["truth"]
    found = true_states(run, empty_track(STATES, time_s), ROBOT, 0.05)
    speed = low_passed(truth.time_s, truth.channel("speed_x_mps"), 0.05, 1.0)
    np.testing.assert_allclose(found[:, 1], np.interp(time_s, truth.time_s, speed), atol=1e-9)
    plain = true_states(run, empty_track(STATES, time_s), ROBOT, 0.0)
    rising = (time_s > 1.3) & (time_s < 1.7)
    lag_s = (plain - found)[rising, 1].mean() / np.gradient(plain[rising, 1], time_s[rising]).mean()
    assert lag_s == pytest.approx(0.05, abs=0.01)
    assert found[0, 0] == pytest.approx(0.0, abs=0.02)
    assert np.isnan(found[:, 5]).all()  # there is no true effective track
    streams = {name: stream for name, stream in run.streams.items() if name != "truth"}
    track = empty_track(("speed_x_mps",), np.arange(0.0, 1.0, 0.1))
    assert true_states(RunLog("a", "agrimaro", streams), track, ROBOT, 0.05) is None
    nothing = Stream(
        run.streams["truth"].time_s, np.full((len(run.streams["truth"]), 1), np.nan), ("speed_x_mps",)
    )
    assert np.isnan(true_states(RunLog("a", "agrimaro", {"truth": nothing}), track, ROBOT, 0.05)).all()
    with pytest.raises(DataError, match="slip_speed_4_mps"):
        true_states(run, empty_track(("slip_speed_4_mps",), np.arange(0.0, 1.0, 0.1)), ROBOT, 0.05)
