"""What a run has alone makes it unfit; what all have does not."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.trial import simulation_of

from pipelines.data.datasets import load_runs
from terrain.discrepancy.clocks import latencies_of, shifts_of
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.faults import Response, responses_of
from terrain.discrepancy.residuals import low_pass_of, rows_of
from terrain.discrepancy.search import Problem
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.unfit import clocks_of, common_gains, odd_runs, stalled_runs, unfit_runs
from terrain.discrepancy.verdict import Excluded
from terrain.effects import CHANNELS, GYRO, SPEED_X
from terrain.errors import DataError
from terrain.records import Array, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import Hills, simulate_planar
from terrain.simulation.scenario import make_scenario

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
ODD = 2
"""Which of the runs has the fault."""


def drive(robot=HUSKY, seed=0, name="survey", duration_s=40.0, **options) -> RunLog:
    twist = make_scenario(name, robot, "grass", duration_s, 0.6, seed=seed).twist
    return simulate_planar(
        robot,
        twist,
        seed,
        scatter=load_scatter(),
        noise=load_noise(),
        hills=Hills((0.04, 0.02), 0.03),
        run_id=f"run_{seed}",
        terrain="grass",
        **options,
    )


def looked_at(runs: Sequence[RunLog]) -> tuple[tuple[Signals, ...], Evidence]:
    robot = HUSKY if runs[0].robot == "husky" else AGRIMARO
    scatter = load_scatter()._asdict()
    if robot is AGRIMARO:
        del scatter["effective_track_ratio"]
    simulation = Simulation(robot, scatter=scatter)
    signals = tuple(signals_of(run, robot) for run in runs)
    problem = Problem(signals, simulation, low_pass_of(signals), simulation.library)
    return signals, problem.at(simulation.vector)


def excluded(runs: Sequence[RunLog]) -> tuple[Excluded, ...]:
    return unfit_runs(*looked_at(runs))


def edited(run: RunLog, stream: str, edit: Callable[[Array, Array, list[str]], None]) -> RunLog:
    was = run.streams[stream]
    values = was.values.copy()
    edit(values, was.time_s, list(was.channels))
    return replace(run, streams={**run.streams, stream: replace(was, values=values)})


def late(run: RunLog, by_s: float) -> RunLog:
    moved = {
        name: replace(run.streams[name], time_s=run.streams[name].time_s + by_s)
        for name in ("imu", "odometry")
    }
    return replace(run, streams={**run.streams, **moved})


@pytest.fixture(scope="module")
def sound() -> list[RunLog]:
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
def test_an_effect_common_to_all_runs_makes_none_unfit(robot, effects):
    names = ["survey", "complex", "survey", "starts", "spot_turn"]
    for first in (10, 20):
        runs = [drive(robot, first + i, name, effects=effects) for i, name in enumerate(names)]
        assert excluded(runs) == ()


def test_a_clock_offset_of_one_run_is_found_to_a_hundredth_of_a_second(sound):
    runs = [late(run, 0.84 if i == ODD else 0.02) for i, run in enumerate(sound)]
    signals, info = looked_at(runs)
    assert unfit_runs(signals, info) == (
        (f"run_{ODD}", "its IMU and camera are 0.84 s behind its wheels, 0.02 s behind in the other runs"),
    )
    clocks = clocks_of(info)
    assert [clock.run_id for clock in clocks] == [run.run_id for run in runs]
    assert_allclose(
        [clock.offset_s for clock in clocks], [0.84 if i == ODD else 0.02 for i in range(6)], atol=0.01
    )
    assert all(0 < clock.std_s < 0.01 for clock in clocks)


def test_a_clock_requires_excitation_and_a_common_offset_is_no_fault(sound):
    runs = [late(run, 0.3) for run in [*sound[:3], drive(seed=7, name="stand")]]
    signals, info = looked_at(runs)
    assert unfit_runs(signals, info) == ()
    offset_s = [clock.offset_s for clock in clocks_of(info)]
    assert_allclose(offset_s[:3], 0.3, atol=0.01)
    assert np.isnan(offset_s[3])
    assert np.isnan(clocks_of(info)[3].std_s)


def test_clocks_out_of_the_search_exclude_a_run_and_are_refused_for_most_runs(sound):
    one = excluded([late(run, 5.0) if i == ODD else run for i, run in enumerate(sound)])
    assert [run.run_id for run in one] == [f"run_{ODD}"]
    assert "not -1 to 2 s behind" in one[0].reason
    with pytest.raises(DataError, match="unsynchronised clocks beyond the search in 6 of 6"):
        excluded([late(run, 5.0) for run in sound])


def stuck(run: RunLog) -> RunLog:
    """Let a body stay for four seconds of driving."""

    def stay(values: Array, time_s: Array, channels: list[str]) -> None:
        still = (time_s > 14) & (time_s < 18)
        for name in {"gyro_z_radps", "speed_x_mps", "speed_y_mps"} & set(channels):
            values[still, channels.index(name)] = 0.002 * np.sin(37 * time_s[still])

    return edited(edited(run, "imu", stay), "odometry", stay)


def gyro(change: Callable[[Array, Array], Array]) -> Callable[[RunLog], RunLog]:
    def edit(values: Array, time_s: Array, channels: list[str]) -> None:
        at = channels.index("gyro_z_radps")
        values[:, at] = change(time_s, values[:, at])

    return lambda run: edited(run, "imu", edit)


def dead_wheel(run: RunLog) -> RunLog:
    def edit(values: Array, time_s: Array, channels: list[str]) -> None:
        values[:, channels.index("speed_left_mps")] = 0.0

    return edited(run, "wheels", edit)


def of_sides(left_mps: Array, right_mps: Array) -> RunLog:
    """Return a run of which the speeds of left and right are given over time, without its start from rest."""
    rate_radps = (right_mps - left_mps) / HUSKY.track_m
    twist = np.column_stack([(left_mps + right_mps) / 2, np.zeros_like(left_mps), rate_radps])
    run = simulate_planar(HUSKY, twist, ODD, scatter=load_scatter(), run_id=f"run_{ODD}", terrain="grass")
    wheels = run.streams["wheels"]
    late = wheels.time_s > 2.0
    later = Stream(wheels.time_s[late], wheels.values[late], wheels.channels)
    return replace(run, streams={**run.streams, "wheels": later})


@pytest.mark.parametrize("left_mps", [0.0, 0.3])
def test_a_wheel_at_a_steady_speed_is_not_dead_but_one_that_only_reads_so_is(sound, left_mps):
    def reads_so(values: Array, time_s: Array, channels: list[str]) -> None:
        values[:, channels.index("speed_left_mps")] = left_mps

    time_s = np.arange(40 * 50 + 1) / 50
    steady, right = np.full_like(time_s, left_mps), left_mps + 0.25 * np.sin(0.7 * time_s)
    run = of_sides(steady, right)
    assert np.std(run.streams["wheels"].channel("speed_left_mps")) < 0.002
    others = [each for i, each in enumerate(sound) if i != ODD]
    assert excluded([*others, run]) == ()
    both = of_sides(left_mps + 0.25 * np.sin(0.8 * time_s), right)
    ((name, reason),) = excluded([*others, edited(both, "wheels", reads_so)])
    assert (name, reason) == (f"run_{ODD}", "its wheel 1 never turns faster or slower, the others do")


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (stuck, "it is stalled"),
        (gyro(lambda t, w: np.where(t < 15, w, w[t < 15][-1])), "yaw_rate_radps is frozen"),
        (gyro(lambda t, w: np.clip(w, *np.quantile(w, [0.1, 0.9]))), "yaw_rate_radps is clipped"),
        (gyro(lambda t, w: np.where(t < 6, w, np.nan)), "yaw_rate_radps is known in 1"),
        (gyro(lambda t, w: -w), "it is unlike the other runs"),
        (dead_wheel, "its wheel 1 never turns faster or slower"),
        (
            lambda run: drive(seed=ODD, name="complex", ground=Ground(1.2, 0.35, 0.15, 0.3)),
            "it is unlike the other runs",
        ),
    ],
)
def test_a_fault_of_one_run_excludes_that_run_only(sound, fault, reason):
    found = excluded([fault(run) if i == ODD else run for i, run in enumerate(sound)])
    assert [run.run_id for run in found] == [f"run_{ODD}"]
    assert reason in found[0].reason


def test_a_single_run_is_not_compared_and_known_clocks_are_reused(sound):
    signals, info = looked_at(sound[:1])
    assert unfit_runs(signals, info) == ()
    signals, info = looked_at([late(run, 0.84 if i == ODD else 0.02) for i, run in enumerate(sound)])
    shift = shifts_of(info)
    assert unfit_runs(signals, info, shift) == unfit_runs(signals, info)
    assert clocks_of(info, shift) == clocks_of(info)


def test_of_three_runs_none_is_an_outlier_and_a_single_terrain_is_not_compared(sound):
    sand = drive(seed=ODD, ground=Ground(1.2, 0.35, 0.15, 0.3))
    assert excluded([sound[0], sound[1], sand]) == ()
    labelled = replace(sand, labels=(sand.labels[0]._replace(terrain="sand"),))
    assert excluded([*sound[:2], *sound[3:], labelled]) == ()


# -- Runs are compared with what the others make of their wheels, whatever the simulation makes of them ----

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
