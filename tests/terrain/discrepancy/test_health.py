"""Signs, units and exchanged columns are named with their repair, and what effects do is none of them.

What a run has alone makes it unfit; what all have does not.  Lags come back within their own standard deviation, also
where runs are short, scatter, and hold values.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from pipelines.data.datasets import load_runs
from terrain.discrepancy.clocks import latencies_of, shifts_of
from terrain.discrepancy.health import (
    AMPS,
    KEYS,
    A,
    Agreement,
    Change,
    Column,
    Fault,
    FaultKind,
    G,
    X,
    agreement_of,
    clocks_of,
    faults_of,
    likeliest,
    odd_runs,
    on_own_clocks,
    options_of,
    reading_of,
    repaired,
    stalled_runs,
    unfit_runs,
)
from terrain.discrepancy.runs import Signals, Simulation, low_pass_of, rows_of, signals_of
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Array, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, make_scenario

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
LATER = ("imu", "odometry")
DEG, RPM, KMH = 57.29577951, 9.54929659, 3.6
SIGN, UNIT, SWAPPED = FaultKind.SIGN, FaultKind.UNIT, FaultKind.SWAPPED
TRACK = {"effective_track_ratio": 1.5}
"""A robot that turns 2.5 times less than its simulation."""

Edit = Callable[[RunLog], RunLog]


def rich_runs(robot=HUSKY, n=8, duration_s=40.0, effects=None, seed=1) -> list[RunLog]:
    drives = rich_drives(np.random.default_rng(seed), n, duration_s)
    return list(hidden_runs(robot, drives, np.random.SeedSequence(seed), effects or {}))


@cache
def sound(name: str = "husky", track: bool = False, seed: int = 3) -> tuple[RunLog, ...]:
    return tuple(rich_runs(load_robot(name), effects=TRACK if track else None, seed=seed))


def moved(run: RunLog, names: Sequence[str], late_s: float) -> RunLog:
    shifted = {name: replace(run.streams[name], time_s=run.streams[name].time_s + late_s) for name in names}
    return replace(run, streams={**run.streams, **shifted})


def on_one_clock(runs: Sequence[RunLog]) -> list[Signals]:
    return [signals_of(run, load_robot(run.robot)) for run in runs]


def faults(signals: Sequence[Signals], name: str = "husky") -> tuple[Fault, ...]:
    simulation, low_pass = simulation_of(load_robot(name)), low_pass_of(signals)
    planar = simulation.planar_on("")
    rows = [rows_of(run, planar, simulation.vector, (), low_pass) for run in signals]
    return faults_of(signals, rows, simulation, low_pass)


def edit(stream: str, start: str | Sequence[str], change: Callable[[Array], Array]) -> Edit:
    """Return what changes the columns of a stream whose names begin so."""

    def edited(run: RunLog) -> RunLog:
        was = run.streams[stream]
        at = [i for i, name in enumerate(was.channels) if name.startswith(tuple(start))]
        values = was.values.copy()
        values[:, at] = change(values[:, at])
        return replace(run, streams={**run.streams, stream: replace(was, values=values)})

    return edited


def times(factor: float) -> Callable[[Array], Array]:
    return lambda values: values * factor


def exchanged(values: Array) -> Array:
    return values[:, ::-1]


YAW_RATE, ACCEL = ("gyro_z",), ("accel_x",)
SPEED, WHEELS, CURRENTS = ("speed_x", "speed_y"), ("speed_", "motor_"), ("current_",)
WRITTEN = {
    "the gyro's sign": (edit("imu", YAW_RATE, times(-1)), SIGN, Column.GYRO, -1),
    "gyro in deg/s": (edit("imu", YAW_RATE, times(DEG)), UNIT, Column.GYRO, 1 / DEG),
    "gyro in rad/s, read as deg/s": (edit("imu", YAW_RATE, times(1 / DEG)), UNIT, Column.GYRO, DEG),
    "gyro in rpm": (edit("imu", YAW_RATE, times(RPM)), UNIT, Column.GYRO, 1 / RPM),
    "speed in km/h": (edit("odometry", SPEED, times(KMH)), UNIT, Column.SPEED, 1 / KMH),
    "the speed's sign": (edit("odometry", SPEED, times(-1)), SIGN, Column.SPEED, -1),
    "x and y of the speed": (edit("odometry", SPEED, exchanged), SWAPPED, Column.SPEED, 1),
    "accelerometer in g": (edit("imu", ACCEL, times(1 / 9.80665)), UNIT, Column.ACCEL, 9.80665),
    "the accelerometer's sign": (edit("imu", ACCEL, times(-1)), SIGN, Column.ACCEL, -1),
    "wheels in km/h": (edit("wheels", WHEELS, times(KMH)), UNIT, Column.WHEELS, 1 / KMH),
    "wheels in rpm": (edit("wheels", WHEELS, times(RPM)), UNIT, Column.WHEELS, 1 / RPM),
    "the wheels' sign": (edit("wheels", WHEELS, times(-1)), SIGN, Column.WHEELS, -1),
    "the left wheels' sign": (edit("wheels", ("speed_left",), times(-1)), SIGN, Column.WHEELS, -1),
    "left and right wheels": (edit("wheels", WHEELS, exchanged), SWAPPED, Column.WHEELS, 1),
    "left and right currents": (edit("wheels", CURRENTS, exchanged), SWAPPED, Column.CURRENTS, 1),
    "the currents' sign": (edit("wheels", CURRENTS, times(-1)), SIGN, Column.CURRENTS, -1),
    "currents in mA": (edit("wheels", CURRENTS, times(1e3)), UNIT, Column.CURRENTS, 1e-3),
}


CASES = [(name, "husky", i % 2 == 1) for i, name in enumerate(WRITTEN)]
CASES += [("gyro in deg/s", "agrimaro", False), ("accelerometer in g", "agrimaro", False)]


@pytest.mark.parametrize(("written", "robot", "track"), CASES)
def test_a_fault_of_all_runs_is_named_and_its_repair_gives_the_log_back(written, robot, track):
    write, kind, column, factor = WRITTEN[written]
    was = sound(robot, track)
    signals = on_one_clock([write(run) for run in was])
    (fault,) = faults(signals, robot)
    assert (fault.change.kind, fault.change.column) == (kind, column)
    assert fault.run_ids == tuple(run.run_id for run in was)
    assert fault.change.factor == pytest.approx(factor, rel=1e-4)
    assert "in all 8 runs" in fault.sentence
    assert fault.sentence.endswith(fault.repair)
    assert "mapping file" in fault.repair
    for run, truth in zip(repaired(signals, [fault]), on_one_clock(was), strict=True):
        assert_allclose(run.measured, truth.measured, rtol=1e-4, atol=1e-9)
        assert_allclose(run.wheel_speed_mps, truth.wheel_speed_mps, rtol=1e-4, atol=1e-9)


ONE, HALF = (2,), (0, 1, 4, 5)  # run_04 drives straight: it could not show the unit of a gyro


@pytest.mark.parametrize(
    ("written", "which"),
    [
        *(("the gyro's sign", ONE), ("left and right wheels", ONE), ("gyro in deg/s", ONE)),
        *(("wheels in km/h", ONE), ("gyro in deg/s", HALF), ("wheels in km/h", HALF)),
    ],
)
def test_a_fault_of_one_run_or_of_half_of_them_is_named_by_the_runs(written, which):
    write, kind, column, _ = WRITTEN[written]
    runs = [write(run) if i in which else run for i, run in enumerate(sound())]
    (fault,) = faults(on_one_clock(runs))
    assert (fault.change.kind, fault.change.column) == (kind, column)
    assert fault.run_ids == tuple(sound()[i].run_id for i in which)
    assert f"in {len(which)} of 8 runs ({', '.join(fault.run_ids)})" in fault.sentence


@pytest.mark.parametrize("of_one", [False, True])
def test_two_wheels_of_a_swerve_robot_are_exchanged(of_one):
    was = sound("agrimaro")
    write = edit("wheels", ("motor_2", "motor_3"), exchanged)
    runs = [write(run) if i == 2 or not of_one else run for i, run in enumerate(was)]
    (fault,) = faults(on_one_clock(runs), "agrimaro")
    assert (fault.change.kind, fault.change.column) == (SWAPPED, Column.WHEELS)
    assert fault.run_ids == tuple(run.run_id for i, run in enumerate(was) if i == 2 or not of_one)
    assert fault.sentence.startswith("wheel speeds of 2 and 3 are exchanged in")
    assert "exchange motor_2_radps and motor_3_radps" in fault.repair
    for run, truth in zip(repaired(on_one_clock(runs), [fault]), on_one_clock(was), strict=True):
        assert_allclose(run.wheel_speed_mps, truth.wheel_speed_mps, atol=1e-9)


def test_the_unit_of_wheels_is_not_judged_by_the_currents():
    """In rpm these wheels predict accelerations that are none, and currents that no motor has."""
    gains, robot = {G: -2.25, X: -2.15, A: -2.56, AMPS: -2.28}, load_robot("agrimaro")
    logs = np.array([gains.get(c, np.nan) for c in KEYS])
    (change,), rivals = likeliest(logs, options_of(logs[None], robot), robot)
    assert (change.column, change.factor) == (Column.WHEELS, pytest.approx(1 / RPM))
    assert rivals == []


def test_one_run_of_many_is_no_other_unit():
    """A pose that is lost for one command of thirty reads three times too fast; its unit is the same."""
    write, *_ = WRITTEN["speed in km/h"]
    many = [replace(run, run_id=f"{run.run_id}_{seed}") for seed in (3, 4, 5) for run in sound(seed=seed)]
    for n_written, n_faults in ((1, 0), (3, 1)):
        runs = [write(run) if i < n_written else run for i, run in enumerate(many)]
        assert len(faults(on_one_clock(runs))) == n_faults


def test_a_session_is_named_also_where_a_run_of_it_drives_straight():
    write = WRITTEN["the gyro's sign"][0]
    runs = [
        replace(write(run), run_id=f"gravel_{i}") if i < 5 else replace(run, run_id=f"sand_{i}")
        for i, run in enumerate(sound())
    ]
    (fault,) = faults(on_one_clock(runs))
    assert "in all 5 runs of gravel" in fault.sentence


def test_a_heading_says_whether_the_gyro_or_the_wheels_are_turned():
    runs = [with_lidar(run, 0.0) for run in sound(track=True)]
    (gyro,) = faults(on_one_clock([WRITTEN["the gyro's sign"][0](run) for run in runs]))
    assert gyro.change.column is Column.GYRO
    assert "the heading rate with -1.00" in gyro.sentence
    (wheels,) = faults(on_one_clock([WRITTEN["left and right wheels"][0](run) for run in runs]))
    assert (wheels.change.kind, wheels.change.column) == (SWAPPED, Column.WHEELS)
    (both,) = faults(on_one_clock([edit("lidar", ("yaw",), times(DEG))(run) for run in runs]))
    assert (both.change.kind, both.change.column) == (UNIT, Column.HEADING)


def test_with_a_gyro_alone_both_readings_are_named():
    signals = []
    for run in on_one_clock([WRITTEN["the gyro's sign"][0](run) for run in sound()]):
        measured = np.where(np.arange(len(CHANNELS)) == G, run.measured, np.nan)
        signals.append(replace(run, grade_rad=0 * run.grade_rad, measured=measured))
    (fault,) = faults(signals)
    assert fault.change.column is Column.GYRO
    assert "cannot distinguish" in fault.sentence
    assert "left and right are exchanged" in fault.sentence


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("husky", {"effective_track_ratio": 3.5}),
        ("husky", {"effective_track_ratio": -0.45, "gyro_scale_ratio": 0.25}),
        ("husky", {"turning_slip_ratio": 0.8, "wheel_radius_ratio": -0.25}),
        ("husky", {"lever_x_m": -0.9, "one_sided_radius_ratio": 0.2, "motor_constant_ratio": 0.9}),
        ("husky", {"force_slip_ratio": 2.7, "rolling_resistance_ratio": 0.4}),
        ("agrimaro", {"gyro_scale_ratio": 0.27, "wheel_radius_ratio": -0.27}),
        ("agrimaro", {"camera_yaw_rad": 0.27, "steering_offset_1_rad": 0.27, "payload_ratio": 1.4}),
        ("agrimaro", {"encoder_lag_s": 0.45, "clock_offset_s": 0.45}),
    ],
)
def test_what_effects_do_is_no_fault(name, effects):
    runs = rich_runs(load_robot(name), effects=effects, seed=5)
    assert faults(on_one_clock(runs), name) == ()


def test_faults_of_two_columns_are_both_named():
    runs = sound(track=True)
    for name in ("gyro in deg/s", "the gyro's sign", "left and right currents"):
        runs = [WRITTEN[name][0](run) for run in runs]
    signals = on_one_clock(runs)
    found = faults(signals)
    kinds = {(SIGN, Column.GYRO), (UNIT, Column.GYRO), (SWAPPED, Column.CURRENTS)}
    assert {(fault.change.kind, fault.change.column) for fault in found} == kinds
    for run, true in zip(repaired(signals, found), on_one_clock(sound(track=True)), strict=True):
        assert_allclose(run.measured, true.measured, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    ("stream", "start", "offset", "column"),
    [("imu", "gyro_z", 0.9, Column.GYRO), ("imu", "accel_x", -9.8, Column.ACCEL)],
)
def test_an_offset_that_no_bias_has_is_named_and_subtracted(stream, start, offset, column):
    was = sound(track=True)
    (fault,) = faults(on_one_clock([edit(stream, (start,), lambda v: v + offset)(run) for run in was]))
    assert (fault.change.kind, fault.change.column) == (FaultKind.OFFSET, column)
    assert fault.change.offset == pytest.approx(-offset, abs=0.1)
    assert "in all 8 runs" in fault.sentence


def test_one_run_alone_and_a_run_without_rows_are_no_special_case():
    (fault,) = faults(on_one_clock([WRITTEN["gyro in deg/s"][0](sound()[0])]))
    assert fault.change.column is Column.GYRO
    (run,) = on_one_clock(sound()[:1])
    simulation, low_pass = simulation_of(load_robot("husky")), low_pass_of([run])
    rows = rows_of(run, simulation.planar_on(""), simulation.vector, (), low_pass)
    none = {name: getattr(rows, name)[:0] for name in ("time_s", "measured", "predicted", "inputs")}
    assert faults_of([run], [rows._replace(**none)], simulation, low_pass) == ()
    unclear = fault._replace(change=fault.change._replace(factor=float("nan")))  # the channel is left out
    (left,) = repaired([run], [unclear])
    assert np.isnan(left.measured[:, G]).all()
    assert_allclose(left.measured[:, 1:], run.measured[:, 1:])


def test_a_reading_mends_no_channel_that_a_run_does_not_show():
    """Straight ahead a gyro says nothing; with a wheel turned the simulation turns, and its noise may fit."""
    change = Change(SIGN, Column.WHEELS, -1.0, 2)

    def following(gyro, likelihood, speed=0.9):
        correlation = np.zeros((1, len(CHANNELS)))
        correlation[0, [G, X]] = gyro, speed
        return Agreement(correlation, np.array([[likelihood]]), correlation)

    after = following(0.98, 100.0)
    unasked, asked = (reading_of(change, following(gyro, 0.0), after) for gyro in (0.0, 0.1))
    assert (unasked.mends.tolist(), asked.mends.tolist()) == ([False], [True])
    # nor does it suit a run whose speed fits worse by it
    worse = reading_of(change, following(0.1, 0.0), following(0.98, 100.0, speed=0.7))
    assert (asked.suits.tolist(), worse.suits.tolist(), worse.mends.tolist()) == ([True], [False], [False])


@pytest.mark.parametrize("folder", ["drive_husky", "borealtc", "vulpi"])
def test_measured_huskies_have_no_fault(measured, folder):
    assert faults(on_one_clock(load_runs(measured(folder)))) == ()


# -- Runs that are unfit ------------------------------------------------------------------------------------

SAND = Ground(1.2, 0.35, 0.15, 0.3)
ODD = 2
"""Which of the runs has the fault."""


def drive(robot=HUSKY, seed=0, name="survey", ground=None, **options):
    twist = make_scenario(name, robot, "grass", 40.0, 0.6, seed=seed).twist
    about = {"run_id": f"run_{seed}", "terrain": "grass"}
    about["conditions"] = Conditions(grade_ratio=(0.04, 0.02), undulation_ratio=0.03)
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
def six_runs():
    return [drive(seed=seed, name="complex" if seed == ODD else "survey") for seed in range(6)]


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (AGRIMARO, {}),
        (HUSKY, {"effective_track_ratio": 1.0, "rolling_resistance_ratio": 0.2}),
        (HUSKY, {"clock_rate_ratio": 0.015, "camera_latency_s": 0.3}),
        (AGRIMARO, {"encoder_lag_s": 0.3, "force_slip_ratio": 2.0}),
        (AGRIMARO, {"clock_offset_s": 0.5, "steering_offset_1_rad": 0.2}),
    ],
)
def test_an_effect_common_to_all_runs_makes_none_unfit(excluded, robot, effects):
    names = ["survey", "complex", "survey", "starts", "spot_turn"]
    assert excluded([drive(robot, 10 + i, name, effects=effects) for i, name in enumerate(names)]) == ()


def test_a_clock_offset_of_one_run_is_found_to_a_hundredth_of_a_second(six_runs, evidence):
    offset_s = [0.84 if i == ODD else 0.02 for i in range(6)]
    signals, info = evidence([moved(run, LATER, by_s) for run, by_s in zip(six_runs, offset_s, strict=True)])
    shift = shifts_of(info)
    unfit, clocks = unfit_runs(signals, info), clocks_of(info, shift)
    assert unfit == (
        (f"run_{ODD}", "its IMU and camera are 0.84 s behind its wheels, 0.02 s behind in the other runs"),
    )
    assert [clock.run_id for clock in clocks] == [run.run_id for run in six_runs]
    assert_allclose([clock.offset_s for clock in clocks], offset_s, atol=0.01)
    assert all(0 < clock.std_s < 0.01 for clock in clocks)
    assert unfit_runs(signals, info, shift) == unfit  # clocks that are known are taken


def test_clocks_out_of_the_search_exclude_a_run_and_are_refused_for_most_runs(six_runs, excluded):
    ((run_id, reason),) = excluded(
        [moved(run, LATER, 5.0) if i == ODD else run for i, run in enumerate(six_runs)]
    )
    assert run_id == f"run_{ODD}"
    assert "not -1 to 2 s behind" in reason
    with pytest.raises(DataError, match="unsynchronised clocks beyond the search in 6 of 6"):
        excluded([moved(run, LATER, 5.0) for run in six_runs])


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
def test_a_wheel_at_a_steady_speed_is_not_dead_but_one_that_only_reads_so_is(six_runs, excluded, left_mps):
    time_s = np.arange(40 * 50 + 1) / 50
    steady, right = np.full_like(time_s, left_mps), left_mps + 0.25 * np.sin(0.7 * time_s)
    others = [run for i, run in enumerate(six_runs) if i != ODD]
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
def test_a_fault_of_one_run_excludes_that_run_only(six_runs, excluded, fault, reason):
    ((run_id, text),) = excluded([fault(run) if i == ODD else run for i, run in enumerate(six_runs)])
    assert run_id == f"run_{ODD}"
    assert reason in text


def test_a_single_run_of_three_runs_one_and_a_single_terrain_are_not_compared(six_runs, excluded):
    sand = drive(seed=ODD, ground=SAND)
    labelled = replace(sand, labels=(sand.labels[0]._replace(terrain="sand"),))
    for runs in (six_runs[:1], [*six_runs[:2], sand], [*six_runs[:2], *six_runs[3:], labelled]):
        assert excluded(runs) == ()


# -- Runs are compared with what the others make of their wheels, whatever the simulation makes of them ----

TURNS_LESS = 1.5
"""The robot turns 2.5 times less than its simulation."""

WAIT_S = 1.6
"""By how much longer a stall is without a clock."""


def runs_of(n, scatter, other=None):
    """Return short runs of one command each, whose effective track scatters; that of some is set."""
    rng, runs = np.random.default_rng(0), []
    for i in range(n):
        twist = np.tile([rng.uniform(-0.6, 0.6), 0.0, rng.choice([-1, 1]) * rng.uniform(0.4, 1.2)], (350, 1))
        twist[:75] *= np.linspace(0.0, 1.0, 75)[:, None]
        track = (1.0 + TURNS_LESS) * np.exp(scatter * rng.standard_normal()) - 1.0
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


# -- Lags of sensors, common to all runs --------------------------------------------------------------------


def with_lidar(run: RunLog, late_s: float) -> RunLog:
    """Replace the camera by a lidar at 10 Hz that is late, and has holes at the edges of its windows."""
    imu, seen = run.streams["imu"], run.streams["odometry"]
    time_s = np.arange(seen.time_s[0], seen.time_s[-1], 0.1)
    logged = (seen, "speed_x_mps"), (imu, "gyro_z_radps")
    values = np.column_stack([np.interp(time_s, each.time_s, each.channel(name)) for each, name in logged])
    values[(time_s % 2.0 < 0.3) | (time_s % 2.0 > 1.7)] = np.nan
    lidar = Stream(time_s + late_s, values, ("speed_x_mps", "yaw_rate_radps"))
    return replace(run, streams={"imu": imu, "wheels": run.streams["wheels"], "lidar": lidar})


def latencies(runs: Sequence[RunLog], robot=HUSKY):
    return latencies_of([signals_of(run, robot) for run in runs], Simulation(robot))


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (HUSKY, {}),
        (AGRIMARO, {"encoder_lag_s": 0.4}),
        (HUSKY, {"yaw_delay_s": 0.4}),
        (AGRIMARO, {"steering_delay_s": 0.4}),
        (HUSKY, {"effective_track_ratio": 1.5, "force_slip_ratio": 2.0}),
    ],
)
def test_nothing_late_and_other_delays_start_no_search(robot, effects):
    assert latencies(rich_runs(robot, effects=effects), robot).starting_values == {}


@pytest.mark.parametrize(("streams", "late_s"), [(("wheels",), 0.27), (("imu", "odometry"), 0.3)])
def test_a_clock_is_found_in_both_signs(streams, late_s):
    found = latencies([moved(run, streams, late_s) for run in rich_runs()])
    expected_s = -late_s if streams == ("wheels",) else late_s
    assert found.starting_values == {"clock_offset_s": pytest.approx(expected_s, abs=0.01)}
    assert list(found.channels) == [GYRO, SPEED_X]


def test_a_sensor_that_is_late_by_itself_is_distinguished_from_the_clock():
    camera = latencies([moved(run, ["odometry"], 0.3) for run in rich_runs()]).starting_values
    assert camera == {"camera_latency_s": pytest.approx(0.3, abs=0.02)}
    imu = latencies([moved(with_lidar(run, 0.0), ["imu"], 0.3) for run in rich_runs()])
    assert imu.starting_values == {"imu_latency_s": pytest.approx(0.3, abs=0.02)}
    alone = latencies([moved(run, ["imu"], 0.3) for run in rich_runs()])  # or it turns late
    assert "imu_latency_s" not in alone.starting_values


def test_short_runs_of_a_wrong_simulation_measure_clocks_together():
    runs = rich_runs(n=40, duration_s=8.0, effects={"effective_track_ratio": 1.5}, seed=3)
    runs = [moved(with_lidar(run, 0.16), ["wheels"], 0.27) for run in runs]
    rng = np.random.default_rng(0)
    for i, run in enumerate(runs):  # scatter of 20 %, and a gyro whose sign is turned
        imu = run.streams["imu"]
        values = imu.values.copy()
        values[:, imu.channels.index("gyro_z_radps")] *= -(1 + 0.2 * rng.standard_normal())
        runs[i] = replace(run, streams={**run.streams, "imu": replace(imu, values=values)})
    found = latencies(runs)
    truth_s = {GYRO: -0.27, SPEED_X: -0.11, HEADING: -0.11}
    for name, lag in found.channels.items():
        assert abs(lag.delay_s - truth_s[name]) < 4 * lag.std_s + 0.02
    assert found.starting_values == {
        "clock_offset_s": pytest.approx(-0.27, abs=0.03),
        "camera_latency_s": pytest.approx(0.16, abs=0.04),
    }


def test_too_few_runs_measure_nothing():
    found = latencies(rich_runs(n=2))
    assert (found.channels, found.starting_values) == ({}, {})


def test_wheels_and_lidar_of_the_measured_husky_are_late(measured):
    runs = load_runs(measured("drive_husky"))
    found = latencies(runs)
    values = found.starting_values
    assert values["clock_offset_s"] == pytest.approx(-0.265, abs=0.03)
    assert values["camera_latency_s"] == pytest.approx(0.16, abs=0.05)
    assert set(values) == {"clock_offset_s", "camera_latency_s"}
