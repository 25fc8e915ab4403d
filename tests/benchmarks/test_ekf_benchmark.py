"""How long a filter step takes, beside filterpy: ``pytest tests/benchmarks --benchmark-enable``.

Calls of one group filter the same log with the same model, so that their times can be divided; all of it runs
on one core, and is timed in seconds of that core.
"""

import time

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from threadpoolctl import threadpool_limits

from terrain.estimation.filter import Filter, FilterSettings, process_noise, run_filter
from terrain.estimation.models.swerve import make_filter
from terrain.robots import load_robot

N_STEPS = 2000
DT_S = 0.02
MOST_US = 6.0
LEAST_RATIO = 5.0


def log_of(name):
    """A filter, and a robot that drives at 1 m/s with a sensor's noise on every row."""
    robot = load_robot("agrimaro")
    model = make_filter(name, robot)
    rng = np.random.default_rng(0)
    z = rng.standard_normal((N_STEPS, len(model.rows))) * np.sqrt(model.measurement_variance)
    for i, row in enumerate(model.rows):
        z[:, i] += {"wheel": 1 / robot.wheel_radius_m, "camera_speed_x": 1.0}.get(row.rsplit("_", 2)[0], 0.0)
    return model, np.arange(N_STEPS) * DT_S, z


def with_filterpy(model, z):
    """Return the last mean of filterpy's filter; it calls the same compiled model."""
    d, m = len(model.states), len(model.rows)
    params = model.params.copy()
    x_next, f, z_hat, h = np.zeros(d), np.zeros((d, d)), np.zeros(m), np.zeros((m, d))
    ekf = ExtendedKalmanFilter(d, m)
    ekf.x, ekf.P = model.initial_mean.copy(), model.initial_variance.copy()
    ekf.Q, ekf.R = process_noise(model, DT_S), np.diag(model.measurement_variance)
    ekf.predict_x = lambda u=0: ekf.x.__setitem__(slice(None), x_next)

    def jacobian(x):
        h[:] = 0.0
        model.observe(x, params, z_hat, h)
        return h

    def expected(x):
        return z_hat

    for k, row in enumerate(z):
        if k:
            f[:] = 0.0
            model.propagate(ekf.x, DT_S, params, x_next, f)
            ekf.F = f
            ekf.predict()
        ekf.update(row, jacobian, expected)
    return ekf.x


@pytest.fixture(scope="module", autouse=True)
def one_core():
    with threadpool_limits(1):  # idle threads of a linear algebra library would count against filterpy
        yield


@pytest.fixture(scope="module")
def vio12():
    return log_of("vio12")


BELIEVED = FilterSettings(gate_probability=1.0)


def per_step(benchmark, n):
    if not benchmark.stats:  # absent where benchmarks are off
        return None
    benchmark.extra_info["us_per_step"] = 1e6 * benchmark.stats.stats.min / n
    return benchmark.extra_info["us_per_step"]


MEASURED = {}


@pytest.mark.benchmark(group=f"{N_STEPS} steps of 12 states by 14 measurements", timer=time.process_time)
def test_the_filter_at_once(benchmark, vio12):
    model, time_s, z = vio12
    track = benchmark(run_filter, model, time_s, z)
    assert len(track.time_s) == N_STEPS
    MEASURED["run_filter"] = per_step(benchmark, N_STEPS)
    if MEASURED["run_filter"]:
        assert MEASURED["run_filter"] <= MOST_US


@pytest.mark.benchmark(group=f"{N_STEPS} steps of 12 states by 14 measurements", timer=time.process_time)
def test_the_filter_sample_by_sample(benchmark, vio12):
    model, time_s, z = vio12

    def walk():
        session = Filter(model)
        for k in range(N_STEPS):
            session.step(time_s[k], z[k])
        return session

    session = benchmark(walk)
    per_step(benchmark, N_STEPS)
    np.testing.assert_array_equal(session.mean, run_filter(model, time_s, z).mean[-1])


@pytest.mark.benchmark(group=f"{N_STEPS} steps of 12 states by 14 measurements", timer=time.process_time)
def test_filterpy(benchmark, vio12):
    model, time_s, z = vio12
    mean = benchmark(with_filterpy, model, z)
    mean_of_filter = run_filter(model, time_s, z, BELIEVED).mean[-1]
    np.testing.assert_allclose(mean_of_filter, mean, rtol=1e-6, atol=1e-9)
    filterpy_us = per_step(benchmark, N_STEPS)
    if filterpy_us and MEASURED.get("run_filter"):
        assert filterpy_us >= LEAST_RATIO * MEASURED["run_filter"]


@pytest.mark.benchmark(group=f"{N_STEPS} steps of 18 states by 17 measurements", timer=time.process_time)
def test_vio15_at_once(benchmark):
    model, time_s, z = log_of("vio15")
    benchmark(run_filter, model, time_s, z)
    per_step(benchmark, N_STEPS)
