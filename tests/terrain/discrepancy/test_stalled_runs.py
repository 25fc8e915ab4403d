"""Runs are compared with what the others make of their wheels, whatever the simulation makes of them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.trial import simulation_of

from pipelines.data.datasets import load_runs
from terrain.discrepancy.clocks import latencies_of
from terrain.discrepancy.faults import Response, responses_of
from terrain.discrepancy.residuals import low_pass_of, rows_of
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.unfit import common_gains, odd_runs, stalled_runs
from terrain.effects import CHANNELS, GYRO, SPEED_X
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.planar.noise import load_noise
from terrain.simulation.planar.run import simulate_planar

HUSKY = load_robot("husky")
TRACK = 1.5
"""The robot turns 2.5 times less than its simulation."""

WAIT_S = 1.6
"""By how much longer a stall is without a clock."""


def runs_of(n: int, scatter: float, seed: int = 0, other: Mapping[int, float] | None = None) -> list[RunLog]:
    """Return short runs of one command each, whose effective track scatters; that of some is set."""
    rng = np.random.default_rng(seed)
    runs = []
    for i in range(n):
        twist = np.tile([rng.uniform(-0.6, 0.6), 0.0, rng.choice([-1, 1]) * rng.uniform(0.4, 1.2)], (350, 1))
        twist[:75] *= np.linspace(0.0, 1.0, 75)[:, None]
        track = (1.0 + TRACK) * np.exp(scatter * rng.standard_normal()) - 1.0
        track = (other or {}).get(i, track)
        run = simulate_planar(
            HUSKY,
            twist,
            i,
            effects={"effective_track_ratio": track},
            noise=load_noise(),
            run_id=f"run_{i:02d}",
        )
        runs.append(run)
    return runs


def stalled(run: RunLog, from_s: float = 0.0) -> RunLog:
    streams = dict(run.streams)
    for name, channels in (("imu", ("gyro_z_radps",)), ("odometry", ("speed_x_mps", "speed_y_mps"))):
        stream = streams[name]
        values = stream.values.copy()
        at = [stream.channels.index(channel) for channel in channels]
        rest = np.random.default_rng(0).normal(0.0, 0.003, (len(values), len(at)))
        late = stream.time_s >= from_s
        values[np.ix_(late, at)] = rest[late]
        streams[name] = replace(stream, values=values)
    return replace(run, streams=streams)


def responses(runs: list[RunLog]) -> tuple[Response, ...]:
    simulation = simulation_of(HUSKY)
    signals = [signals_of(run, simulation.robot) for run in runs]
    low_pass = low_pass_of(signals)
    planar = simulation.planar_on("")
    rows = [rows_of(run, planar, simulation.vector, (), low_pass) for run in signals]
    return responses_of(rows, latencies_of(signals, simulation))


@pytest.mark.parametrize("scatter", [0.1, 0.35])
@pytest.mark.parametrize("n", [6, 40])
def test_runs_that_scatter_have_no_outlier_and_none_stalls(n, scatter):
    found = responses(runs_of(n, scatter))
    assert odd_runs(found, range(n)) == {}
    assert stalled_runs(found, [False] * n, WAIT_S) == {}


def test_the_common_response_is_that_of_the_runs_and_not_of_the_simulation():
    gain = dict(zip(CHANNELS, common_gains(responses(runs_of(20, 0.1))), strict=True))
    assert gain[GYRO] == pytest.approx(1 / (1 + TRACK), rel=0.1)
    assert gain[SPEED_X] == pytest.approx(1.0, rel=0.05)
    assert np.isnan(common_gains(responses(runs_of(2, 0.1)))).all()


def test_four_stalled_runs_of_forty_are_named_also_those_that_stall_later():
    which = {3: 0.0, 9: 0.0, 20: 3.0, 31: 0.0}
    runs = [stalled(run, which[i]) if i in which else run for i, run in enumerate(runs_of(40, 0.15))]
    found = stalled_runs(responses(runs), [False] * 40, WAIT_S)
    assert set(found) == set(which)
    assert "it is stalled for" in found[3]
    assert "its body turns at 0.0" in found[3]


@pytest.mark.parametrize("odd", [{7: -0.3}, dict.fromkeys(range(0, 40, 5), 0.1)])
def test_runs_of_another_robot_are_named(odd):
    found = odd_runs(responses(runs_of(40, 0.08, other=odd)), range(40))
    assert set(found) == set(odd)
    assert "its yaw rate is" in found[min(odd)]


def test_two_groups_of_runs_are_no_outliers():
    half = dict.fromkeys(range(0, 40, 2), 0.1)
    assert odd_runs(responses(runs_of(40, 0.08, other=half)), range(40)) == {}


def test_runs_are_compared_with_those_of_their_terrain():
    odd = dict.fromkeys(range(5), -0.3)
    found = responses(runs_of(30, 0.08, other=odd))
    labelled = [run._replace(terrain="ice") if i in odd else run for i, run in enumerate(found)]
    assert set(odd_runs(found, range(30))) == set(odd)
    assert odd_runs(labelled, range(30)) == {}


def test_the_snow_runs_that_are_stuck_are_named_by_a_gap_of_their_response(measured):
    runs = [run for run in load_runs(measured("borealtc")) if run.terrains == ("SNOW",)]
    found = responses(runs)
    stuck = {found[i].run_id for i in stalled_runs(found, [False] * len(found), WAIT_S)}
    assert stuck == {f"SNOW_{k:02d}" for k in (2, 3, 4, 5, 12, 14, 15, 19, 22)}


def test_stalled_runs_of_the_measured_husky(measured):
    found = responses(load_runs(measured("drive_husky")))
    stuck = {found[i].run_id for i in stalled_runs(found, [False] * len(found), WAIT_S)}
    assert {"step_052", "step_103"} <= stuck
    assert len(stuck) < 0.05 * len(found)
