"""Process noise comes back from what a filter's own equations draw, and what runs do not show has that status."""

from dataclasses import replace

import numpy as np
import pytest
from model_draws import sample_from_model

from terrain.estimation.consistency import consistency_report
from terrain.estimation.filter import run_filter
from terrain.estimation.models.swerve import make_filter
from terrain.estimation.tuning import GROUPS, TuningStatus, tune_noise
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
MODEL = make_filter("vio15", ROBOT)
STD = {"accel": 0.05, "yaw_rate": 0.2, "steer": 0.1, "slip_speed": 0.05, "speed": 0.02}
"""Of the walks: slow enough for the linearisation to hold over the run, fast enough to be seen."""

OFF_BY = {"yaw_rate": 1 / 10, "slip": 8.0, "steer": 10.0}
"""What the process noise to start with is wrong by."""


def group(name, names):
    return [each.startswith(name) for each in names]


def true_model():
    walk = MODEL.process_variance.diagonal().copy()
    for state, std in STD.items():
        walk[group(state, MODEL.states)] = std**2
    # the camera's scatter stands out beside the walk within a tick
    sample = MODEL.measurement_variance.copy()
    sample[group("camera_speed", MODEL.rows)] = 0.0012**2
    initial = np.minimum(MODEL.initial_variance.diagonal(), 0.1**2)
    return replace(MODEL, process_variance=walk, measurement_variance=sample, initial_variance=initial)


def drawn(n_runs, n):
    draws = (sample_from_model(true_model(), n, 0.02, np.random.default_rng(seed)) for seed in range(n_runs))
    return [(time_s, z) for time_s, _, z in draws]


def test_variances_that_are_off_by_eight_to_ten_come_back():
    truth, samples = true_model(), drawn(n_runs=2, n=600)
    walk = truth.process_variance.diagonal().copy()
    for name, factor in OFF_BY.items():
        walk[group(name, MODEL.states)] *= factor
    tuned, report = tune_noise(replace(truth, process_variance=walk), samples)
    for name, factor in OFF_BY.items():
        assert report.status[name] is TuningStatus.FOUND
        assert 1 / 1.5 < report.scales[name] * factor < 1.5, name
        states = group(name, MODEL.states)
        scaled = walk[states] * report.scales[name]
        np.testing.assert_allclose(tuned.process_variance.diagonal()[states], scaled)
    assert report.log_likelihood_after > report.log_likelihood_before + 100
    track = run_filter(tuned, *samples[0])
    assert [entry.verdict for entry in consistency_report(track)["sensors"]].count("consistent") >= 10


def test_a_group_without_measurements_is_reported_as_not_excited():
    ((time_s, z),) = drawn(n_runs=1, n=200)
    z[:, [row.startswith(("steer", "wheel")) for row in MODEL.rows]] = np.nan
    _, report = tune_noise(true_model(), [(time_s, z)])
    assert report.status["steer"] is TuningStatus.NOT_EXCITED
    assert report.scales["steer"] == pytest.approx(1.0)
    assert set(report.scales) == {each for each in GROUPS if any(group(each, MODEL.states))}
