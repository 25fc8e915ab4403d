import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.estimation.consistency import consistency_report, sample_from_model
from terrain.estimation.filter import Noise, run_filter
from terrain.estimation.filters.swerve import make_filter
from terrain.estimation.filters.swerve_noise import default_noise
from terrain.estimation.filters.tuning import NoiseGroup, tune_noise
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
MODEL = make_filter("vio15", ROBOT)
GROUPS = (
    NoiseGroup("camera speed", rows=("camera_speed_x_mps", "camera_speed_y_mps")),
    NoiseGroup("wheels", rows=("wheel_1_radps", "wheel_2_radps", "wheel_3_radps")),
    NoiseGroup("gyro", rows=("gyro_z_radps",)),
    NoiseGroup("turning", states=("yaw_rate_radps",)),
    NoiseGroup("slipping", states=("slip_speed_1_mps", "slip_speed_2_mps", "slip_speed_3_mps")),
)
OFF_BY = (30.0, 1 / 4, 10.0, 1 / 10, 8.0)
"""What the noise to start with is wrong by."""


def true_noise():
    """Slow enough for the linearisation to hold over the run, fast enough to be seen.

    The camera's scatter has to stand out beside what the speed walks by within a tick, 0.003 m/s.
    """
    plain = default_noise("vio15", ROBOT)
    walk = plain.process_variance.diagonal().copy()
    for state, std in (
        ("accel", 0.05),
        ("yaw_rate", 0.2),
        ("steer", 0.1),
        ("slip_speed", 0.05),
        ("speed", 0.02),
    ):
        walk[[name.startswith(state) for name in MODEL.states]] = std**2
    start = np.minimum(plain.initial_variance.diagonal(), 0.1**2)
    sample = plain.measurement_variance.copy()
    sample[[name.startswith("camera_speed") for name in MODEL.rows]] = 0.0012**2
    return Noise(walk, sample, start)


def scaled(noise, factors):
    walk, sample = noise.process_variance.diagonal().copy(), noise.measurement_variance.copy()
    for group, factor in zip(GROUPS, factors, strict=True):
        walk[[name in group.states for name in MODEL.states]] *= factor
        sample[[name in group.rows for name in MODEL.rows]] *= factor
    return Noise(walk, sample, noise.initial_variance)


def tables(noise, n_runs=3, n=500):
    draws = (sample_from_model(MODEL, noise, n, 0.02, np.random.default_rng(seed)) for seed in range(n_runs))
    return [(time_s, z) for time_s, _, z in draws]


def test_variances_that_are_off_by_four_to_thirty_come_back():
    truth = true_noise()
    runs = tables(truth)
    tuned, report = tune_noise(MODEL, runs, scaled(truth, OFF_BY), GROUPS)
    for group, factor in zip(report.groups, OFF_BY, strict=True):
        assert group.status == "found"
        assert 1 / 1.5 < group.scale * factor < 1.5, group.name
    assert report.converged
    assert report.log_likelihood_after > report.log_likelihood_before + 100
    again = scaled(scaled(truth, OFF_BY), [group.scale for group in report.groups])
    np.testing.assert_allclose(tuned.measurement_variance, again.measurement_variance)
    np.testing.assert_allclose(tuned.process_variance, again.process_variance)
    track = run_filter(MODEL, tuned, *runs[0])
    assert [entry.verdict for entry in consistency_report(track).sensors].count("consistent") >= 10


def test_a_group_without_measurements_is_reported_as_not_excited():
    """Camera rows are missing throughout."""
    truth = true_noise()
    runs = tables(truth, n_runs=1, n=200)
    for _, z in runs:
        z[:, 10:12] = np.nan
    tuned, report = tune_noise(MODEL, runs, truth, GROUPS[:1])
    assert report.groups == (("camera speed", 1.0, "not excited"),)
    np.testing.assert_array_equal(tuned.measurement_variance, truth.measurement_variance)


def test_the_search_stops_at_its_evaluation_limit():
    truth = true_noise()
    _, report = tune_noise(MODEL, tables(truth, 1, 100), scaled(truth, OFF_BY), GROUPS, max_evaluations=12)
    assert not report.converged
    assert report.n_evaluations < 12 + 4 * len(GROUPS)


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([NoiseGroup("a", states=("slip_1_ratio",))], "group a: filter vio15 has no state 'slip_1_ratio'"),
        ([NoiseGroup("a", rows=("speed_x_mps",))], "group a: filter vio15 has no row 'speed_x_mps'"),
        ([NoiseGroup("a")], "group a names neither states nor rows"),
        ([GROUPS[0], GROUPS[0]], "row camera_speed_x_mps is in two groups"),
        ([], "there is no group to tune"),
    ],
)
def test_invalid_groups_are_refused(groups, message):
    with pytest.raises(ConfigError, match=message):
        tune_noise(MODEL, [(np.zeros(1), np.zeros((1, 14)))], true_noise(), groups)


def test_runs_and_noise_that_cannot_be_tuned_are_refused():
    with pytest.raises(DataError, match="there is no run to tune on"):
        tune_noise(MODEL, [], true_noise(), GROUPS)
    by_sample = Noise(np.ones(15), np.ones((3, 14)))
    with pytest.raises(DataError, match="changes from sample to sample: tune on one variance a row"):
        tune_noise(MODEL, [(np.arange(3.0), np.zeros((3, 14)))], by_sample, GROUPS)
