"""What a run has alone makes it unfit; what all have does not."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.trial import simulation_of

from pipelines.data.datasets import load_runs
from terrain.discrepancy.clocks import latencies_of, shifts_of
from terrain.discrepancy.health import (
    agreement_of,
    clocks_of,
    odd_runs,
    on_own_clocks,
    stalled_runs,
    unfit_runs,
)
from terrain.discrepancy.runs import low_pass_of, rows_of, signals_of
from terrain.errors import DataError
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, make_scenario

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
SAND = Ground(1.2, 0.35, 0.15, 0.3)
ODD = 2
"""Which of the runs has the fault."""


def drive(robot=HUSKY, seed=0, name="survey", ground=None, **options):
    twist = make_scenario(name, robot, "grass", 40.0, 0.6, seed=seed).twist
    about = {
        "conditions": Conditions(grade_ratio=(0.04, 0.02), undulation_ratio=0.03),
        "run_id": f"run_{seed}",
        "terrain": "grass",
    }
    return simulate(
        robot,
        twist,
        ground or Ground(),
        seed,
        scatter=spread_numbers("scatter"),
        noise=spread_numbers("noise"),
        **about,
        **options,
    )


def edited(run, change, **channels):
    """Return a run whose channels (names by stream) are ``change(time, values)``."""
    streams = dict(run.streams)
    for stream, names in channels.items():
        values, there = streams[stream].values.copy(), streams[stream].channels
        for at in (there.index(name) for name in names if name in there):
            values[:, at] = change(streams[stream].time_s, values[:, at])
        streams[stream] = replace(streams[stream], values=values)
    return replace(run, streams=streams)


def late(run, by_s):
    moved = {
        name: replace(run.streams[name], time_s=run.streams[name].time_s + by_s)
        for name in ("imu", "odometry")
    }
    return replace(run, streams={**run.streams, **moved})


@pytest.fixture(scope="module")
def evidence(pose):
    """Return a function that gives signals and evidence of runs."""

    def looked_at(runs):
        problem = pose(runs)
        return problem.signals, problem.at(problem.simulation.vector)

    return looked_at


@pytest.fixture(scope="module")
def excluded(evidence):
    return lambda runs: unfit_runs(*evidence(runs))


@pytest.fixture(scope="module")
def sound():
    return [drive(seed=seed, name="complex" if seed == ODD else "survey") for seed in range(6)]


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        pytest.param(HUSKY, {}, marks=pytest.mark.slow),
        (AGRIMARO, {}),
        (HUSKY, {"effective_track_ratio": 1.0, "rolling_resistance_ratio": 0.2}),
        pytest.param(HUSKY, {"clock_rate_ratio": 0.015, "camera_latency_s": 0.3}, marks=pytest.mark.slow),
        pytest.param(HUSKY, {"yaw_delay_s": 0.4, "gyro_scale_ratio": -0.15}, marks=pytest.mark.slow),
        (AGRIMARO, {"encoder_lag_s": 0.3, "force_slip_ratio": 2.0}),
        (AGRIMARO, {"clock_offset_s": 0.5, "steering_offset_1_rad": 0.2}),
    ],
)
def test_an_effect_common_to_all_runs_makes_none_unfit(excluded, robot, effects):
    names = ["survey", "complex", "survey", "starts", "spot_turn"]
    for first in (10, 20):
        runs = [drive(robot, first + i, name, effects=effects) for i, name in enumerate(names)]
        assert excluded(runs) == ()


def test_a_clock_offset_of_one_run_is_found_to_a_hundredth_of_a_second(sound, evidence):
    offset_s = [0.84 if i == ODD else 0.02 for i in range(6)]
    signals, info = evidence([late(run, by_s) for run, by_s in zip(sound, offset_s, strict=True)])
    shift = shifts_of(info)
    unfit, clocks = unfit_runs(signals, info), clocks_of(info, shift)
    assert unfit == (
        (f"run_{ODD}", "its IMU and camera are 0.84 s behind its wheels, 0.02 s behind in the other runs"),
    )
    assert [clock.run_id for clock in clocks] == [run.run_id for run in sound]
    assert_allclose([clock.offset_s for clock in clocks], offset_s, atol=0.01)
    assert all(0 < clock.std_s < 0.01 for clock in clocks)
    assert unfit_runs(signals, info, shift) == unfit  # clocks that are known are taken


def test_clocks_out_of_the_search_exclude_a_run_and_are_refused_for_most_runs(sound, excluded):
    ((run_id, reason),) = excluded([late(run, 5.0) if i == ODD else run for i, run in enumerate(sound)])
    assert run_id == f"run_{ODD}"
    assert "not -1 to 2 s behind" in reason
    with pytest.raises(DataError, match="unsynchronised clocks beyond the search in 6 of 6"):
        excluded([late(run, 5.0) for run in sound])


MOTION = {"imu": ["gyro_z_radps"], "odometry": ["speed_x_mps", "speed_y_mps"]}
LEFT = {"wheels": ["speed_left_mps"]}


def of_sides(left_mps, right_mps):
    """Return a run of which the speeds of left and right are given over time, without its start from rest."""
    rate_radps = (right_mps - left_mps) / HUSKY.track_m
    twist = np.column_stack([(left_mps + right_mps) / 2, np.zeros_like(left_mps), rate_radps])
    run = simulate(
        HUSKY, twist, Ground(), ODD, scatter=spread_numbers("scatter"), run_id=f"run_{ODD}", terrain="grass"
    )
    wheels = run.streams["wheels"]
    driven = wheels.time_s > 2.0
    later = Stream(wheels.time_s[driven], wheels.values[driven], wheels.channels)
    return replace(run, streams={**run.streams, "wheels": later})


@pytest.mark.parametrize("left_mps", [0.0, 0.3])
def test_a_wheel_at_a_steady_speed_is_not_dead_but_one_that_only_reads_so_is(sound, excluded, left_mps):
    time_s = np.arange(40 * 50 + 1) / 50
    steady, right = np.full_like(time_s, left_mps), left_mps + 0.25 * np.sin(0.7 * time_s)
    others = [run for i, run in enumerate(sound) if i != ODD]
    assert excluded([*others, of_sides(steady, right)]) == ()
    both = of_sides(left_mps + 0.25 * np.sin(0.8 * time_s), right)
    unfit = excluded([*others, edited(both, lambda t, v: left_mps, **LEFT)])
    assert unfit == ((f"run_{ODD}", "its wheel 1 never turns faster or slower, the others do"),)


def gyro(change):
    return lambda run: edited(run, change, imu=["gyro_z_radps"])


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (
            # a body stays for four seconds of driving
            lambda run: edited(
                run, lambda t, v: np.where((t > 14) & (t < 18), 0.002 * np.sin(37 * t), v), **MOTION
            ),
            "it is stalled",
        ),
        (gyro(lambda t, w: np.where(t < 15, w, w[t < 15][-1])), "yaw_rate_radps is frozen"),
        (gyro(lambda t, w: np.clip(w, *np.quantile(w, [0.1, 0.9]))), "yaw_rate_radps is clipped"),
        (gyro(lambda t, w: np.where(t < 6, w, np.nan)), "yaw_rate_radps is known in 1"),
        (gyro(lambda t, w: -w), "it is unlike the other runs"),
        (lambda run: edited(run, lambda t, v: 0.0, **LEFT), "its wheel 1 never turns faster or slower"),
        (lambda run: drive(seed=ODD, name="complex", ground=SAND), "it is unlike the other runs"),
    ],
)
def test_a_fault_of_one_run_excludes_that_run_only(sound, excluded, fault, reason):
    ((run_id, text),) = excluded([fault(run) if i == ODD else run for i, run in enumerate(sound)])
    assert run_id == f"run_{ODD}"
    assert reason in text


def test_a_single_run_of_three_runs_one_and_a_single_terrain_are_not_compared(sound, excluded):
    sand = drive(seed=ODD, ground=SAND)
    labelled = replace(sand, labels=(sand.labels[0]._replace(terrain="sand"),))
    for runs in (sound[:1], [*sound[:2], sand], [*sound[:2], *sound[3:], labelled]):
        assert excluded(runs) == ()


# -- Runs are compared with what the others make of their wheels, whatever the simulation makes of them ----

TRACK = 1.5
"""The robot turns 2.5 times less than its simulation."""

WAIT_S = 1.6
"""By how much longer a stall is without a clock."""


def runs_of(n, scatter, other=None):
    """Return short runs of one command each, whose effective track scatters; that of some is set."""
    rng, runs = np.random.default_rng(0), []
    for i in range(n):
        twist = np.tile([rng.uniform(-0.6, 0.6), 0.0, rng.choice([-1, 1]) * rng.uniform(0.4, 1.2)], (350, 1))
        twist[:75] *= np.linspace(0.0, 1.0, 75)[:, None]
        track = (1.0 + TRACK) * np.exp(scatter * rng.standard_normal()) - 1.0
        about = {"effects": {"effective_track_ratio": (other or {}).get(i, track)}, "run_id": f"run_{i:02d}"}
        runs.append(simulate(HUSKY, twist, Ground(), i, noise=spread_numbers("noise"), **about))
    return runs


def stalled(run, from_s):
    rest = np.random.default_rng(0)
    return edited(run, lambda t, v: np.where(t >= from_s, rest.normal(0.0, 0.003, len(v)), v), **MOTION)


def responses(runs):
    simulation = simulation_of(HUSKY)
    signals = [signals_of(run, HUSKY) for run in runs]
    planar, low_pass = simulation.planar_on(""), low_pass_of(signals)
    rows = [rows_of(run, planar, simulation.vector, (), low_pass) for run in signals]
    return on_own_clocks(rows, latencies_of(signals, simulation))


def stalls(compared):
    return stalled_runs(compared, agreement_of(compared), [False] * len(compared), WAIT_S)


def odd(compared):
    return odd_runs(compared, agreement_of(compared), range(len(compared)))


@pytest.mark.parametrize(("n", "scatter"), [(6, 0.35), (40, 0.1)])
def test_runs_that_scatter_have_no_outlier_and_none_stalls(n, scatter):
    compared = responses(runs_of(n, scatter))
    assert odd(compared) == {}
    assert stalls(compared) == {}


def test_four_stalled_runs_of_forty_are_named_also_those_that_stall_later():
    which = {3: 0.0, 9: 0.0, 20: 3.0, 31: 0.0}
    runs = [stalled(run, which[i]) if i in which else run for i, run in enumerate(runs_of(40, 0.15))]
    reasons = stalls(responses(runs))
    assert set(reasons) == set(which)
    assert "it is stalled for" in reasons[3]
    assert "its body turns at 0.0" in reasons[3]


@pytest.mark.parametrize(
    ("others", "named"),
    [
        ({7: -0.3}, True),
        (dict.fromkeys(range(0, 40, 5), 0.1), True),
        (dict.fromkeys(range(0, 40, 2), 0.1), False),  # two groups are no outliers
    ],
)
def test_runs_of_another_robot_are_named_beside_those_of_their_terrain(others, named):
    compared = responses(runs_of(40, 0.08, others))
    reasons = odd(compared)
    assert set(reasons) == (set(others) if named else set())
    assert all("its yaw rate is" in reason for reason in reasons.values())
    labelled = [run._replace(terrain="ice") if i in others else run for i, run in enumerate(compared)]
    assert odd(labelled) == {}


def test_the_snow_runs_that_are_stuck_are_named_by_a_gap_of_their_response(measured):
    compared = responses([run for run in load_runs(measured("borealtc")) if run.terrains == ("SNOW",)])
    stuck = {compared[i].run_id for i in stalls(compared)}
    assert stuck == {f"SNOW_{k:02d}" for k in (2, 3, 4, 5, 12, 14, 15, 19, 22)}


def test_stalled_runs_of_the_measured_husky(measured):
    compared = responses(load_runs(measured("drive_husky")))
    stuck = {compared[i].run_id for i in stalls(compared)}
    assert {"step_052", "step_103"} <= stuck
    assert len(stuck) < 0.05 * len(compared)
