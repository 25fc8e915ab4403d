"""How far runs deviate that were left out of the fit: by refits, from a hidden deviation, and covered as it says."""

import numpy as np
import pytest

from terrain.discrepancy.compared import ComparedRun, compare_runs
from terrain.discrepancy.left_out import deviation_of, left_out_residuals
from terrain.discrepancy.runs import LowPass
from terrain.discrepancy.search import names_of
from terrain.effects import CHANNELS, effect_named

LOW_PASS = LowPass(np.ones(1), 1, 6.25, 2.5, 0, np.inf)
T, V = CHANNELS.index("yaw_rate_radps"), CHANNELS.index("speed_x_mps")


def driven(seed, n=200, scale=1.0):
    """Return a run that stands a third of its time, with a gyro that deviates by 0.01, 0.05 m and 0.1 m."""
    rng = np.random.default_rng(seed)
    moves = np.arange(n) > n / 3
    speed, turn = moves * rng.uniform(0.0, 1.0, n), moves * rng.uniform(-1.0, 1.0, n)
    residual = np.full((n, len(CHANNELS)), np.nan)
    std = scale * np.sqrt(0.01**2 + (0.05 * speed) ** 2 + (0.1 * turn) ** 2)
    residual[:, T] = std * rng.standard_t(4, n) / np.sqrt(2.0)
    inputs = {"speed_mps": speed, "turn_mps": turn, "sideways_mps": 0.0 * speed}
    zero = np.zeros_like(residual)
    about = f"r{seed}", "", False, np.arange(n) / 6.25, np.abs(speed), residual, zero, zero
    return ComparedRun(*about, inputs)


def deviation(runs):
    return deviation_of(runs, [run.residual(True) for run in runs], [run.run_id for run in runs], LOW_PASS)


def test_the_hidden_deviation_comes_back():
    own = deviation([driven(seed) for seed in range(60)])
    assert set(own.channels) == {"yaw_rate_radps"}
    found = own.channels["yaw_rate_radps"]
    np.testing.assert_allclose(found[:3], [0.01, 0.05, 0.1], rtol=0.12)
    assert abs(found.times_95 - 2.776 / np.sqrt(2.0)) < 0.05  # Student's t of 4 degrees of freedom
    assert found.n_runs == 60


@pytest.mark.parametrize(("n", "level"), [(8, 0.0), (5, 0.3)])
def test_further_runs_are_covered_though_runs_differ(n, level):
    """A level of each run is most of what it deviates by, and a few runs are few levels."""
    covered = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        runs = [driven(100 * seed + i, scale=np.exp(0.3 * rng.standard_normal())) for i in range(n + 8)]
        for run in runs:
            run.measured[:, T] += level * rng.standard_normal()
        own = deviation(runs[:n]).channels["yaw_rate_radps"]
        for run in runs[n:]:
            half = own.half_95(run.speed_mps, run.inputs["turn_mps"])
            covered.append(np.mean(np.abs(run.residual(True)[:, T]) <= half))
    assert 0.93 < np.mean(covered) < 0.97


def test_of_two_runs_there_is_no_deviation():
    assert not deviation([driven(0), driven(1)]).channels


def test_residuals_are_those_of_fits_without_each_run(hide, pose):
    problem = pose(hide({"effective_track_ratio": 0.3}, n=4))
    cause = effect_named("effective_track")
    names = names_of([cause])
    simulation = problem.simulation.with_effects({"effective_track_ratio": 0.3})
    info = problem.at(simulation.vector)
    runs = compare_runs(problem.simulation, simulation, problem.signals, problem.low_pass)
    left = left_out_residuals(runs, problem.signals, info, names, {})
    every = info.fit(names)[0][0]
    for i, run in enumerate(runs):
        rest = problem._replace(signals=tuple(s for j, s in enumerate(problem.signals) if j != i))
        without = rest.at(simulation.vector, noise=info.noise, scatter=info.scatter).fit(names)[0][0]
        other = simulation.with_effects({"effective_track_ratio": without - every})
        (refit,) = compare_runs(problem.simulation, other, [problem.signals[i]], problem.low_pass)
        change, expected = left[i] - run.residual(True), refit.residual(True) - run.residual(True)
        apart = np.sqrt(np.mean((change - expected)[:, T] ** 2) / np.mean(expected[:, T] ** 2))
        assert apart < 0.2  # sensitivities are those of low-pass filtered wheels
