import numpy as np
import pytest

from terrain.errors import DataError
from terrain.estimation.consistency import consistency_report, nees, sample_from_model
from terrain.estimation.filter import FilterModel, Noise, run_filter
from terrain.kernels import njit
from terrain.records import StateTrack

DT_S = 0.05


@njit
def turn(x, dt, params, x_next, f):
    x_next[:] = x
    x_next[0] += dt * x[1]
    f[0, 0], f[0, 1], f[1, 1], f[2, 2] = 1.0, dt, 1.0, 1.0


@njit
def read(x, params, z_hat, h):
    z_hat[0], z_hat[1] = x[0], x[1] + x[2]
    h[0, 0], h[1, 1], h[1, 2] = 1.0, 1.0, 1.0


TURNTABLE = FilterModel(
    name="turntable",
    states=("yaw_rad", "yaw_rate_radps", "gyro_bias_radps"),
    rows=("compass_rad", "gyro_z_radps"),
    sensors=(("compass", ("compass_rad",)), ("gyro", ("gyro_z_radps",))),
    propagate=turn,
    observe=read,
    params=np.zeros(1),
    initial_std=np.array([1.0, 1.0, 0.1]),
    angle_states=("yaw_rad",),
    angle_rows=("compass_rad",),
)
WALK, SAMPLE = np.array([1e-3, 0.3, 0.01]) ** 2, np.array([0.03, 0.02]) ** 2
NOISE = Noise(WALK, SAMPLE)


def turned(seed=0, n=4000, noise=NOISE):
    return sample_from_model(TURNTABLE, noise, n, DT_S, np.random.default_rng(seed))


def verdicts(entries):
    return {entry.name: entry.verdict for entry in entries}


@pytest.mark.parametrize("seed", range(4))
def test_a_filter_on_its_own_equations_is_consistent(seed):
    time_s, truth, z = turned(seed)
    report = consistency_report(run_filter(TURNTABLE, NOISE, time_s, z), truth)
    assert verdicts(report.sensors) == {"compass": "consistent", "gyro": "consistent"}
    assert set(verdicts(report.states)) == {"yaw", "yaw_rate", "gyro_bias", "all"}
    assert list(verdicts(report.states).values()).count("consistent") >= 3  # four bounds of 95 %
    for entry in report.sensors:
        assert entry.n_independent > 0.8 * entry.n  # innovations are white
    assert {e.name: e for e in report.states}["yaw"].n_independent < 0.8 * 4000  # errors are not


@pytest.mark.parametrize(("factor", "verdict"), [(1 / 3, "overconfident"), (3.0, "conservative")])
def test_noise_that_is_off_is_found_where_it_is(factor, verdict):
    time_s, truth, z = turned()
    off = Noise(WALK, SAMPLE * [1.0, factor])
    report = consistency_report(run_filter(TURNTABLE, off, time_s, z), truth)
    assert verdicts(report.sensors)["gyro"] == verdict
    wrong = Noise(WALK * factor, SAMPLE * factor, np.array([1.0, 1.0, 0.1]) ** 2)
    report = consistency_report(run_filter(TURNTABLE, wrong, time_s, z), truth)
    assert verdicts(report.sensors) == {"compass": verdict, "gyro": verdict}
    assert verdicts(report.states)["all"] == verdict


def test_a_filter_that_leaves_out_what_does_not_fit_is_not_called_consistent():
    time_s, _, z = turned()
    z[np.random.default_rng(0).random(len(z)) < 0.05, 1] += 5.0
    (compass, gyro) = consistency_report(run_filter(TURNTABLE, NOISE, time_s, z)).sensors
    assert gyro.gated_fraction == pytest.approx(0.05, abs=0.015)
    assert (compass.verdict, gyro.verdict) == ("consistent", "overconfident")


def test_a_sensor_without_measurements_has_an_unknown_verdict():
    time_s, truth, z = turned(n=200)
    z[:, 0] = np.nan
    truth[:, 2] = np.nan
    report = consistency_report(run_filter(TURNTABLE, NOISE, time_s, z), truth)
    assert report.sensors[0].verdict == "unknown"
    assert report.sensors[0].n == 0
    assert np.isnan(report.sensors[0].mean_per_dof)
    assert set(verdicts(report.states)) == {"yaw", "yaw_rate", "all"}


def test_nees_is_the_squared_error_over_its_covariance_with_angles_wrapped():
    mean = np.array([[3.1, 1.0], [-3.1, 1.0]])
    cov = np.array([[[0.04, 0.01], [0.01, 0.09]]] * 2)
    empty = np.zeros((2, 0))
    states = ("yaw_rad", "speed_mps")
    track = StateTrack(np.arange(2.0), mean, cov, states, empty, empty, empty, (), np.zeros(2), 0.0)
    truth = np.array([[-3.1, 1.2], [3.1, np.nan]])
    error = np.array([6.2 - 2 * np.pi, -0.2])
    np.testing.assert_allclose(nees(track, truth), [error @ np.linalg.solve(cov[0], error), np.nan])
    np.testing.assert_allclose(nees(track, truth[:, :1], ["yaw_rad"]), error[0] ** 2 / 0.04)
    with pytest.raises(DataError, match="the track has no state 'slip_1_ratio': it has yaw_rad, speed_mps"):
        nees(track, truth, ["yaw_rad", "slip_1_ratio"])
    with pytest.raises(DataError, match=r"truth has shape \(2, 2\), \(2, 1\) is needed"):
        nees(track, truth, ["yaw_rad"])


def test_drawn_samples_have_the_requested_moments():
    walk = np.array([[1e-4, 0.0, 0.0], [0.0, 0.04, -0.01], [0.0, -0.01, 0.01]])  # correlated
    noise = Noise(walk, SAMPLE, np.array([1e-2, 0.04, 0.09]))
    starts, steps, errors = [], [], []
    for seed in range(200):
        _, truth, z = turned(seed, 50, noise)
        starts.append(truth[0])
        steps.append(np.diff(truth[:, 1:], axis=0))
        errors.append(z[:, 1] - truth[:, 1] - truth[:, 2])
    np.testing.assert_allclose(np.var(starts, axis=0), [1e-2, 0.04, 0.09], rtol=0.35)
    np.testing.assert_allclose(np.cov(np.concatenate(steps).T), walk[1:, 1:] * DT_S, atol=2e-4)
    assert np.var(np.concatenate(errors)) == pytest.approx(SAMPLE[1], rel=0.06)
    np.testing.assert_array_equal(turned(7, 50)[2], turned(7, 50)[2])
    assert np.abs(turned(1)[1][:, 0]).max() <= np.pi
