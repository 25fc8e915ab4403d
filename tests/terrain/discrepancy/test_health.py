"""Signs, units and exchanged columns are named with their repair, and what effects do is none of them.

What a run has alone makes it unfit; what all have does not.  Lags come back within their own standard deviation, also
where runs are short, scatter, and hold values.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.trial import hidden_runs, simulation_of, with_late_streams

from terrain.discrepancy.clocks import latencies_of, shifts_of
from terrain.discrepancy.health.agreement import (
    AMPS,
    A,
    Agreement,
    G,
    X,
    Y,
    agreement_of,
    on_own_clocks,
    zero_of,
)
from terrain.discrepancy.health.fault import Change, Column, FaultKind, FaultStatus, repaired
from terrain.discrepancy.health.faults import faults_of
from terrain.discrepancy.health.readings import Reading, reading_of, turned_fault
from terrain.discrepancy.health.response import odd_runs, stalled_runs
from terrain.discrepancy.health.sessions import faulty_runs
from terrain.discrepancy.health.unfit import clocks_of, unfit_runs
from terrain.discrepancy.health.units import KEYS, likeliest, options_of
from terrain.discrepancy.runs import Simulation, low_pass_of, rows_of, signals_of
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.signals import low_pass
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, make_scenario

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
DEG, RPM, KMH = 57.29577951, 9.54929659, 3.6
SIGN, UNIT, SWAPPED, OFFSET = FaultKind.SIGN, FaultKind.UNIT, FaultKind.SWAPPED, FaultKind.OFFSET
WIDE = {"effective_track_ratio": 1.5}
"""Of a robot that turns 2.5 times less than its simulation."""


def rich_runs(robot=HUSKY, n=6, duration_s=30.0, effects=None, seed=3):
    drives = rich_drives(np.random.default_rng(seed), n, duration_s)
    return list(hidden_runs(robot, drives, np.random.SeedSequence(seed), effects or {}))


@cache
def sound(name="husky", wide=False, seed=3):
    """Return runs without a fault; the first of the Husky at seed 3 drives straight."""
    duration_s = 40.0 if name == "agrimaro" else 30.0  # all its wheels have to turn apart
    return rich_runs(load_robot(name), 6, duration_s, WIDE if wide else None, seed)


def on_one_clock(runs):
    return [signals_of(run, load_robot(run.robot)) for run in runs]


def rows_and_low_pass(signals, simulation):
    low_pass, planar = low_pass_of(signals), simulation.planar_on("")
    return [rows_of(run, planar, simulation.vector, (), low_pass) for run in signals], low_pass


def faults(signals, name="husky", lags=None):
    simulation = simulation_of(load_robot(name))
    rows, low_pass = rows_and_low_pass(signals, simulation)
    return faults_of(signals, rows, simulation, low_pass, lags or latencies_of(signals, simulation))


def edit(change, **starts):
    """Return what changes a run's columns, by stream and beginnings of their names: ``change(time (n, 1), values)``."""

    def edited(run):
        streams = dict(run.streams)
        for name, start in starts.items():
            was = streams[name]
            at = [i for i, channel in enumerate(was.channels) if channel.startswith(start)]
            values = was.values.copy()
            values[:, at] = change(was.time_s[:, None], values[:, at])
            streams[name] = replace(was, values=values)
        return replace(run, streams=streams)

    return edited


def times(factor):
    return lambda _, values: values * factor


def exchanged(_, values):
    return values[:, ::-1]


# -- Faults of columns, in all runs or in some -----------------------------------------------------------------

GYRO_Z, ACCEL = {"imu": "gyro_z"}, {"imu": "accel_x"}
SPEED, WHEELS, CURRENTS = {"odometry": "speed_"}, {"wheels": ("speed_", "motor_")}, {"wheels": "current_"}
WRITTEN = {
    "the gyro's sign": (edit(times(-1), **GYRO_Z), SIGN, Column.GYRO, -1),
    "gyro in deg/s": (edit(times(DEG), **GYRO_Z), UNIT, Column.GYRO, 1 / DEG),
    "gyro in rad/s, read as deg/s": (edit(times(1 / DEG), **GYRO_Z), UNIT, Column.GYRO, DEG),
    "gyro in rpm": (edit(times(RPM), **GYRO_Z), UNIT, Column.GYRO, 1 / RPM),
    "speed in km/h": (edit(times(KMH), **SPEED), UNIT, Column.SPEED, 1 / KMH),
    "the speed's sign": (edit(times(-1), **SPEED), SIGN, Column.SPEED, -1),
    "x and y of the speed": (edit(exchanged, **SPEED), SWAPPED, Column.SPEED, 1),
    "accelerometer in g": (edit(times(1 / 9.80665), **ACCEL), UNIT, Column.ACCEL, 9.80665),
    "the accelerometer's sign": (edit(times(-1), **ACCEL), SIGN, Column.ACCEL, -1),
    "wheels in km/h": (edit(times(KMH), **WHEELS), UNIT, Column.WHEELS, 1 / KMH),
    "wheels in rpm": (edit(times(RPM), **WHEELS), UNIT, Column.WHEELS, 1 / RPM),
    "the wheels' sign": (edit(times(-1), **WHEELS), SIGN, Column.WHEELS, -1),
    "the left wheels' sign": (edit(times(-1), wheels="speed_left"), SIGN, Column.WHEELS, -1),
    "left and right wheels": (edit(exchanged, **WHEELS), SWAPPED, Column.WHEELS, 1),
    "left and right currents": (edit(exchanged, **CURRENTS), SWAPPED, Column.CURRENTS, 1),
    "the currents' sign": (edit(times(-1), **CURRENTS), SIGN, Column.CURRENTS, -1),
    "currents in mA": (edit(times(1e3), **CURRENTS), UNIT, Column.CURRENTS, 1e-3),
    "wheels 2 and 3": (edit(exchanged, wheels=("motor_2", "motor_3")), SWAPPED, Column.WHEELS, 1),
}
OF_SWERVE = ("wheels 2 and 3", "gyro in deg/s", "accelerometer in g")
CASES = [(name, "husky", i % 2 == 1) for i, name in enumerate(WRITTEN) if name != OF_SWERVE[0]]


@pytest.mark.parametrize(
    ("written", "robot", "wide"), CASES + [(name, "agrimaro", False) for name in OF_SWERVE]
)
def test_a_fault_of_all_runs_is_named_and_its_repair_gives_the_log_back(written, robot, wide):
    write, kind, column, factor = WRITTEN[written]
    was = sound(robot, wide)
    signals = on_one_clock([write(run) for run in was])
    (fault,) = faults(signals, robot)
    assert (fault.change.kind, fault.change.column) == (kind, column)
    assert fault.run_ids == tuple(run.run_id for run in was)
    assert fault.change.factor == pytest.approx(factor, rel=1e-4)
    assert "in all 6 runs" in fault.sentence
    assert fault.sentence.endswith(fault.repair)
    assert "mapping file" in fault.repair
    for run, truth in zip(repaired(signals, [fault]), on_one_clock(was), strict=True):
        assert_allclose(run.measured, truth.measured, rtol=1e-4, atol=1e-9)
        assert_allclose(run.wheel_speed_mps, truth.wheel_speed_mps, rtol=1e-4, atol=1e-9)


SUCCESSIVE, SCATTERED = (1, 2, 3), (0, 2, 5)


@pytest.mark.parametrize(
    ("written", "robot"),
    [
        ("the gyro's sign", "husky"),
        ("left and right wheels", "husky"),
        ("gyro in deg/s", "husky"),
        ("wheels in km/h", "husky"),
        ("wheels 2 and 3", "agrimaro"),
    ],
)
def test_a_fault_of_successive_runs_is_named_by_the_runs_and_none_of_one_or_of_scattered_runs(written, robot):
    """A logger is set up anew between two runs of a session; where runs are scattered, the body did otherwise."""
    write, kind, column, _ = WRITTEN[written]

    def found(which):
        runs = [write(run) if i in which else run for i, run in enumerate(sound(robot))]
        return faults(on_one_clock(runs), robot)

    (fault,) = found(SUCCESSIVE)
    ids = tuple(run.run_id for i, run in enumerate(sound(robot)) if i in SUCCESSIVE)
    assert (fault.change.kind, fault.change.column, fault.run_ids) == (kind, column, ids)
    assert f"in 3 of 6 runs ({', '.join(ids)})" in fault.sentence
    if robot == "agrimaro":
        assert fault.sentence.startswith("wheel speeds of 2 and 3 are exchanged in")
        assert "exchange motor_2_radps and motor_3_radps" in fault.repair
    assert found((2,)) == found(SCATTERED) == ()


def test_a_session_has_the_fault_of_its_runs_also_where_one_of_them_drives_straight():
    write, *_ = WRITTEN["the gyro's sign"]
    runs = [replace(write(run), run_id=f"gravel_{i}") for i, run in enumerate(sound()[:4])]
    runs += [replace(run, run_id=f"sand_{i}") for i, run in enumerate(sound()[4:])]
    (fault,) = faults(on_one_clock(runs))
    assert "in all 4 runs of gravel" in fault.sentence


def test_the_unit_of_wheels_is_not_judged_by_the_currents():
    """In rpm these wheels predict accelerations that are none, and currents that no motor has."""
    gains = {G: -2.25, X: -2.15, A: -2.56, AMPS: -2.28}
    logs = np.array([gains.get(c, np.nan) for c in KEYS])
    (change,), rivals = likeliest(logs, options_of(logs[None], AGRIMARO), AGRIMARO)
    assert (change.column, change.factor) == (Column.WHEELS, pytest.approx(1 / RPM))
    assert rivals == []


def test_a_unit_of_the_wheels_says_nothing_of_currents():
    """They are not in proportion to the speeds of the wheels, and all else is."""
    changes, adds = options_of(np.zeros((1, len(KEYS))), AGRIMARO)
    wheels = [k for k, reading in enumerate(changes) if any(change.of_wheels for change in reading)]
    others = [place for place, channel in enumerate(KEYS) if channel != AMPS]
    assert wheels
    assert np.isnan(np.delete(adds[wheels], others, axis=1)).all()
    factors = [np.log(change.factor) for k in wheels for change in changes[k]]
    assert_allclose(adds[wheels][:, others], -np.tile(factors, (len(others), 1)).T)


def test_a_heading_says_whether_the_gyro_or_the_wheels_are_turned():
    runs = [with_lidar(run, 0.0) for run in sound(wide=True)]
    (gyro,) = faults(on_one_clock([WRITTEN["the gyro's sign"][0](run) for run in runs]))
    assert gyro.change.column is Column.GYRO
    assert "the heading rate with -1.00" in gyro.sentence
    (wheels,) = faults(on_one_clock([WRITTEN["left and right wheels"][0](run) for run in runs]))
    assert (wheels.change.kind, wheels.change.column) == (SWAPPED, Column.WHEELS)
    (both,) = faults(on_one_clock([edit(times(DEG), lidar="yaw")(run) for run in runs]))
    assert (both.change.kind, both.change.column) == (UNIT, Column.HEADING)
    # with a gyro alone both readings are named
    signals = []
    for run in on_one_clock([WRITTEN["the gyro's sign"][0](run) for run in sound()]):
        measured = np.where(np.arange(len(CHANNELS)) == G, run.measured, np.nan)
        signals.append(replace(run, grade_rad=0 * run.grade_rad, measured=measured))
    (fault,) = faults(signals)
    assert fault.change.column is Column.GYRO
    assert "cannot distinguish" in fault.sentence
    assert "left and right are exchanged" in fault.sentence


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (HUSKY, {"effective_track_ratio": 3.5}),
        (HUSKY, {"turning_slip_ratio": 0.8, "wheel_radius_ratio": -0.25}),
        (HUSKY, {"lever_x_m": -0.9, "one_sided_radius_ratio": 0.2, "motor_constant_ratio": 0.9}),
        (HUSKY, {"force_slip_ratio": 2.7, "rolling_resistance_ratio": 0.4}),
        (AGRIMARO, {"gyro_scale_ratio": 0.27, "wheel_radius_ratio": -0.27}),
        (AGRIMARO, {"camera_yaw_rad": 0.27, "steering_offset_1_rad": 0.27, "payload_ratio": 1.4}),
        (AGRIMARO, {"encoder_lag_s": 0.45, "clock_offset_s": 0.45}),
    ],
)
def test_what_effects_do_is_no_fault(robot, effects):
    assert faults(on_one_clock(rich_runs(robot, effects=effects, seed=5)), robot.name) == ()


def test_faults_of_two_columns_are_both_named_and_an_offset_that_no_bias_has_is_subtracted():
    runs = sound(wide=True)
    for name in ("gyro in deg/s", "the gyro's sign", "left and right currents"):
        runs = [WRITTEN[name][0](run) for run in runs]
    signals = on_one_clock([edit(lambda _, v: v - 9.8, **ACCEL)(run) for run in runs])
    found = faults(signals)
    kinds = {(SIGN, Column.GYRO), (UNIT, Column.GYRO), (SWAPPED, Column.CURRENTS), (OFFSET, Column.ACCEL)}
    assert {(fault.change.kind, fault.change.column) for fault in found} == kinds
    for run, true in zip(repaired(signals, found), on_one_clock(sound(wide=True)), strict=True):
        off = [0.1 if c == A else 1e-9 for c in range(len(CHANNELS))]
        for c, most in enumerate(off):
            assert_allclose(run.measured[:, c], true.measured[:, c], rtol=1e-4, atol=most)
    (fault,) = faults(on_one_clock([edit(lambda _, v: v + 0.9, **GYRO_Z)(run) for run in sound(wide=True)]))
    assert (fault.change.kind, fault.change.column) == (OFFSET, Column.GYRO)
    assert fault.change.offset == pytest.approx(-0.9, abs=0.1)
    assert "in all 6 runs" in fault.sentence


def test_one_run_alone_and_a_run_without_rows_are_no_special_case():
    (fault,) = faults(on_one_clock([WRITTEN["gyro in deg/s"][0](sound()[1])]))
    assert fault.change.column is Column.GYRO
    (run,), simulation = on_one_clock(sound()[1:2]), simulation_of(HUSKY)
    (rows,), low_pass = rows_and_low_pass([run], simulation)
    none = {name: getattr(rows, name)[:0] for name in ("time_s", "measured", "predicted", "inputs")}
    lags = latencies_of([run], simulation)
    assert faults_of([run], [rows._replace(**none)], simulation, low_pass, lags) == ()
    assert fault.status is FaultStatus.NOT_CONFIRMED  # of one run none is left to confirm it
    assert repaired([run], [fault]) == (run,)
    nan = fault.change._replace(factor=float("nan"))  # the channel is left out
    unclear = fault._replace(change=nan, status=FaultStatus.UNDECIDED)
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


# -- Runs that are unfit ------------------------------------------------------------------------------------

SAND = Ground(1.8, 0.35, 0.2, 0.3)
ODD, OTHERS = 2, ("imu", "odometry")
"""Which of the runs has the fault, and the streams of the logger that is not the wheels'."""


def drive(robot=HUSKY, seed=0, name="survey", ground=None, **options):
    twist = make_scenario(name, robot, "grass", 40.0, 0.6, seed=seed).twist
    options |= {"scatter": spread_numbers("scatter"), "noise": spread_numbers("noise")}
    hills = Conditions(grade_ratio=(0.04, 0.02), undulation_ratio=0.03)
    about = {"run_id": f"run_{seed}", "terrain": "grass", "conditions": hills}
    return simulate(robot, twist, ground or Ground(), seed, **about, **options)


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
        (HUSKY, {"effective_track_ratio": 1.0, "clock_rate_ratio": 0.015, "camera_latency_s": 0.3}),
        (AGRIMARO, {"encoder_lag_s": 0.3, "force_slip_ratio": 2.0}),
        (AGRIMARO, {"clock_offset_s": 0.5, "steering_offset_1_rad": 0.2}),
    ],
)
def test_an_effect_common_to_all_runs_makes_none_unfit(excluded, robot, effects):
    names = ["survey", "complex", "survey", "starts", "spot_turn"]
    assert excluded([drive(robot, 10 + i, name, effects=effects) for i, name in enumerate(names)]) == ()


def test_a_clock_offset_of_one_run_is_found_to_a_hundredth_of_a_second(six_runs, evidence):
    offset_s = [0.84 if i == ODD else 0.02 for i in range(6)]
    runs = [with_late_streams([run], OTHERS, by_s)[0] for run, by_s in zip(six_runs, offset_s, strict=True)]
    signals, info = evidence(runs)
    shift = shifts_of(info)
    unfit, clocks = unfit_runs(signals, info), clocks_of(info, shift)
    assert unfit == (
        (f"run_{ODD}", "its IMU and camera are 0.84 s behind its wheels, 0.02 s behind in the other runs"),
    )
    assert [clock.run_id for clock in clocks] == [run.run_id for run in six_runs]
    assert_allclose([clock.offset_s for clock in clocks], offset_s, atol=0.01)
    assert all(0 < clock.std_s < 0.01 for clock in clocks)
    assert unfit_runs(signals, info, shift) == unfit  # clocks that are known are taken
    # a clock out of the search excludes a run, and is refused for most runs
    far = with_late_streams(six_runs, OTHERS, 5.0)
    ((run_id, reason),) = unfit_runs(*evidence([*six_runs[:ODD], far[ODD], *six_runs[ODD + 1 :]]))
    assert run_id == f"run_{ODD}"
    assert "not -1 to 2 s behind" in reason
    with pytest.raises(DataError, match="unsynchronised clocks beyond the search in 3 of 3"):
        unfit_runs(*evidence(far[:3]))


MOTION = {"imu": "gyro_z", "odometry": "speed_"}


def test_a_wheel_at_a_steady_speed_is_not_dead_but_one_that_only_reads_so_is(six_runs, excluded):
    time_s, left_mps = np.arange(40 * 50 + 1) / 50, 0.3

    def of_sides(left, right):
        """Return a run of such wheel speeds over time, without its start from rest."""
        twist = np.column_stack([(left + right) / 2, 0.0 * left, (right - left) / HUSKY.track_m])
        about = {"scatter": spread_numbers("scatter"), "run_id": f"run_{ODD}", "terrain": "grass"}
        run = simulate(HUSKY, twist, Ground(), ODD, **about)
        wheels = run.streams["wheels"]
        driven = wheels.time_s > 2.0
        later = Stream(wheels.time_s[driven], wheels.values[driven], wheels.channels)
        return replace(run, streams={**run.streams, "wheels": later})

    right = left_mps + 0.25 * np.sin(0.7 * time_s)
    others = [run for i, run in enumerate(six_runs) if i != ODD]
    assert excluded([*others, of_sides(np.full_like(time_s, left_mps), right)]) == ()
    both = of_sides(left_mps + 0.25 * np.sin(0.8 * time_s), right)
    unfit = excluded([*others, edit(lambda t, v: left_mps, wheels="speed_left")(both)])
    assert unfit == ((f"run_{ODD}", "its wheel 1 never turns faster or slower, the others do"),)


def of_gyro(change):
    return edit(change, imu="gyro_z")


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        # a body stays for four seconds of driving
        (
            edit(lambda t, v: np.where((t > 14) & (t < 18), 0.002 * np.sin(37 * t), v), **MOTION),
            "it is stalled",
        ),
        (of_gyro(lambda t, w: np.where(t < 15, w, w[t < 15][-1])), "yaw_rate_radps is frozen"),
        (of_gyro(lambda t, w: np.clip(w, *np.quantile(w, [0.1, 0.9]))), "yaw_rate_radps is clipped"),
        (of_gyro(lambda t, w: np.where(t < 6, w, np.nan)), "yaw_rate_radps is known in 1"),
        (of_gyro(times(-1)), "it is unlike the other runs"),
        (edit(times(0.0), wheels="speed_left"), "its wheel 1 never turns faster or slower"),
        (lambda run: drive(seed=ODD, name="complex", ground=SAND), "it is unlike the other runs"),
    ],
)
def test_a_fault_of_one_run_excludes_that_run_only(six_runs, excluded, fault, reason):
    ((run_id, text),) = excluded([fault(run) if i == ODD else run for i, run in enumerate(six_runs)])
    assert run_id == f"run_{ODD}"
    assert reason in text


def test_a_run_of_three_runs_or_less_and_a_single_terrain_are_not_compared(six_runs, excluded):
    sand = drive(seed=ODD, ground=SAND)
    labelled = replace(sand, labels=(sand.labels[0]._replace(terrain="sand"),))
    for runs in (six_runs[:1], [*six_runs[:2], sand], [*six_runs[:2], *six_runs[3:], labelled]):
        assert excluded(runs) == ()


# -- Runs are compared with what the others make of their wheels, whatever the simulation makes of them ----

WAIT_S = 1.6
"""By how much longer a stall is without a clock."""


def runs_of(n, scatter, other=None):
    """Return short runs of one command each, whose effective track scatters; that of some is set."""
    rng, runs = np.random.default_rng(0), []
    for i in range(n):
        twist = np.tile([rng.uniform(-0.6, 0.6), 0.0, rng.choice([-1, 1]) * rng.uniform(0.4, 1.2)], (350, 1))
        twist[:75] *= np.linspace(0.0, 1.0, 75)[:, None]
        track = (1.0 + WIDE["effective_track_ratio"]) * np.exp(scatter * rng.standard_normal()) - 1.0
        about = {"effects": {"effective_track_ratio": (other or {}).get(i, track)}, "run_id": f"run_{i:02d}"}
        runs.append(simulate(HUSKY, twist, Ground(), i, noise=spread_numbers("noise"), **about))
    return runs


def responses(runs):
    simulation = simulation_of(HUSKY)
    signals = [signals_of(run, HUSKY) for run in runs]
    return on_own_clocks(rows_and_low_pass(signals, simulation)[0], latencies_of(signals, simulation))


def stalls(runs):
    signals, compared = [signals_of(run, HUSKY) for run in runs], responses(runs)
    return stalled_runs(signals, compared, agreement_of(compared), [False] * len(compared), WAIT_S)


def odd(compared):
    return odd_runs(compared, agreement_of(compared), range(len(compared)))


def test_stalled_runs_are_named_also_those_that_stall_later_and_runs_that_scatter_are_none():
    runs = runs_of(40, 0.15)
    for few in (runs_of(6, 0.35), runs):
        assert odd(responses(few)) == stalls(few) == {}
    which, rest = {3: 0.0, 9: 0.0, 20: 3.0, 31: 0.0}, np.random.default_rng(0)
    for i, from_s in which.items():
        still = edit(lambda t, v, at=from_s: np.where(t >= at, rest.normal(0.0, 0.003, v.shape), v), **MOTION)
        runs[i] = still(runs[i])
    reasons = stalls(runs)
    assert set(reasons) == set(which)
    assert "it is stalled for" in reasons[3]
    assert "its body turns at 0.0" in reasons[3]


def still_from(run, start_s, end_s, seed=0):
    """Return a run whose body is at rest meanwhile."""
    rest = np.random.default_rng(seed)

    def change(t, v):
        return np.where((t >= start_s) & (t < end_s), rest.normal(0.0, 0.003, v.shape), v)

    return edit(change, **MOTION)(run)


def test_a_stall_between_two_parts_of_a_motion_is_shorter_than_one_that_a_clock_makes():
    runs = runs_of(12, 0.1)
    runs[3] = still_from(runs[3], 2.4, 5.0)
    (runs[7],) = with_late_streams([runs[7]], ["imu", "odometry"], 1.8)
    assert set(stalls(runs)) == {3}


def test_a_stall_that_is_seen_through_holes_is_seen_for_a_second():
    def seen(t, v):
        return np.where(((t > 1.4) & (t < 2.2)) | (t > 5.3) & (t < 6.1), v, np.nan)

    runs = runs_of(12, 0.1)
    for i, (start_s, end_s) in {3: (1.2, 6.5), 5: (2.6, 5.2)}.items():
        runs[i] = edit(seen, **MOTION)(still_from(runs[i], start_s, end_s))
    assert set(stalls(runs)) == {3}


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


# -- Lags of sensors, common to all runs --------------------------------------------------------------------


def with_lidar(run, late_s):
    """Replace the camera by a lidar at 10 Hz that is late, and has holes at the edges of its windows."""
    imu, seen = run.streams["imu"], run.streams["odometry"]
    time_s = np.arange(seen.time_s[0], seen.time_s[-1], 0.1)
    logged = (seen, "speed_x_mps"), (imu, "gyro_z_radps")
    values = np.column_stack([np.interp(time_s, each.time_s, each.channel(name)) for each, name in logged])
    values[(time_s % 2.0 < 0.3) | (time_s % 2.0 > 1.7)] = np.nan
    lidar = Stream(time_s + late_s, values, ("speed_x_mps", "yaw_rate_radps"))
    return replace(run, streams={"imu": imu, "wheels": run.streams["wheels"], "lidar": lidar})


def latencies(runs, robot=HUSKY):
    return latencies_of([signals_of(run, robot) for run in runs], Simulation(robot))


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (AGRIMARO, {"encoder_lag_s": 0.4}),
        (AGRIMARO, {"steering_delay_s": 0.4}),
        (HUSKY, {"yaw_delay_s": 0.4, "force_slip_ratio": 2.0}),
    ],
)
def test_other_delays_start_no_search(robot, effects):
    assert latencies(rich_runs(robot, effects=effects, seed=1), robot).starting_values == {}


def test_what_is_late_is_found_in_both_signs_and_a_sensor_is_distinguished_from_the_clock():
    runs, lidar = sound(seed=1), [with_lidar(run, 0.0) for run in sound(seed=1)]
    for given, streams, late_s, expected in (
        (runs, [], 0.0, {}),
        (runs, ["wheels"], 0.27, {"clock_offset_s": -0.27}),
        (runs, ["imu", "odometry"], 0.3, {"clock_offset_s": 0.3}),
        (runs, ["odometry"], 0.3, {"camera_latency_s": 0.3}),
        (lidar, ["imu"], 0.3, {"imu_latency_s": 0.3}),
    ):
        found = latencies(with_late_streams(given, streams, late_s))
        assert found.starting_values == pytest.approx(expected, abs=0.025), streams
        assert list(found.channels)[:2] == [GYRO, SPEED_X]
    alone = latencies(with_late_streams(runs, ["imu"], 0.3))  # or it turns late
    assert "imu_latency_s" not in alone.starting_values
    few = latencies(runs[:2])
    assert (few.channels, few.starting_values) == ({}, {})


def test_short_runs_of_a_wrong_simulation_measure_clocks_together():
    runs = rich_runs(n=40, duration_s=8.0, effects=WIDE)
    rng = np.random.default_rng(0)
    for i, run in enumerate(runs):  # scatter of 20 %, and a gyro whose sign is turned
        (seen,) = with_late_streams([with_lidar(run, 0.16)], ["wheels"], 0.27)
        runs[i] = of_gyro(times(-(1 + 0.2 * rng.standard_normal())))(seen)
    found = latencies(runs)
    truth_s = {GYRO: -0.27, SPEED_X: -0.11, HEADING: -0.11}
    for name, lag in found.channels.items():
        assert abs(lag.delay_s - truth_s[name]) < 4 * lag.std_s + 0.02
    assert found.starting_values == {
        "clock_offset_s": pytest.approx(-0.27, abs=0.03),
        "camera_latency_s": pytest.approx(0.16, abs=0.04),
    }


# -- Each rule with its innocent twin --------------------------------------------------------------------------


def on_ice(run, rng):
    """Return a run whose body follows its wheels late and little, and slides by itself."""
    time_s = np.arange(0.0, 60.0, 0.02)
    slides = low_pass(rng.normal(size=(time_s.size, 3)), 0.02, 4.0) * [8.0, 4.0, 6.0]
    streams = dict(run.streams)
    for name, channel, k in (
        ("imu", "gyro_z_radps", 2),
        ("odometry", "speed_x_mps", 0),
        ("odometry", "speed_y_mps", 1),
    ):
        was = streams[name]
        values, at = was.values.copy(), was.channels.index(channel)
        own = low_pass(values[:, at : at + 1], 1.0 / was.rate_hz, rng.choice([0.5, 2.5, 5.0]))[:, 0]
        values[:, at] = rng.choice([0.15, 0.4]) * own + np.interp(
            was.time_s - was.time_s[0], time_s, slides[:, k]
        )
        streams[name] = replace(was, values=values)
    return replace(run, streams=streams)


def test_a_body_that_slides_on_ice_is_no_fault_of_the_logs():
    rng = np.random.default_rng(0)
    runs = [on_ice(run, rng) for run in runs_of(40, 0.1)]
    assert faults(on_one_clock(runs)) == ()


def test_runs_of_a_fault_are_sessions_or_successive_ones():
    a, b = ["a"] * 6, ["b"] * 6
    assert faulty_runs(a + b, np.array([1, 0, 1, 1, 1, 1] + [-1] * 6)) == [0, 1, 2, 3, 4, 5]
    assert faulty_runs(a, np.array([-1, -1, 1, 1, 1, -1])) == [2, 3, 4]
    assert faulty_runs(a, np.array([-1, -1, 1, 1, -1, -1])) == []  # two are no change of a logger
    assert faulty_runs(a + b, np.array([1] * 6 + [0] * 6)) == list(range(12))  # nothing says that b has not


def with_axes(run, order):
    """Return a run whose IMU has all axes, those of the gyro in some order."""
    imu, rng = run.streams["imu"], np.random.default_rng(0)
    names = ("gyro_x_radps", "gyro_y_radps", "accel_y_mps2", "accel_z_mps2")
    others = [name for name in names if name not in imu.channels]
    values = np.column_stack([imu.values, rng.normal(0.0, 0.02, (len(imu.values), len(others)))])
    channels, axes = [*imu.channels, *others], [f"gyro_{axis}_radps" for axis in "xyz"]
    at = [channels.index(name) for name in axes]
    values[:, at] = values[:, [at["xyz".index(axis)] for axis in order]]
    return replace(run, streams={**run.streams, "imu": Stream(imu.time_s, values, tuple(channels))})


def test_a_gyro_whose_axes_are_exchanged_is_read_from_the_axis_that_follows_the_wheels():
    signals = on_one_clock([with_axes(run, "zyx") for run in sound()])
    (fault,) = faults(signals)
    assert (fault.change.kind, fault.change.column) == (FaultKind.AXES, Column.GYRO)
    assert "gyro_z_radps is in gyro_x_radps" in fault.sentence
    true = on_one_clock([with_axes(run, "xyz") for run in sound()])
    for run, right in zip(repaired(signals, [fault]), true, strict=True):
        assert_allclose(run.measured, right.measured)
    assert faults(true) == ()


def test_samples_that_are_held_or_clipped_are_left_out_and_named():
    def held_from(t, w):
        return np.where((t > 8) & (t < 14), w[np.argmax(t > 8)], w)

    for change, kind in (
        (held_from, FaultKind.DROPOUT),
        (lambda t, w: np.where((t > 9) & (t < 10.5), 0.0, w), FaultKind.DROPOUT),
        (lambda t, w: np.clip(w, *np.quantile(w, [0.1, 0.9])), FaultKind.SATURATION),
    ):
        runs = [of_gyro(change)(run) if i in (2, 3) else run for i, run in enumerate(sound())]
        signals = on_one_clock(runs)
        (fault,) = faults(signals)
        assert (fault.change.kind, fault.change.column) == (kind, Column.GYRO)
        fixed = repaired(signals, [fault])
        assert set(fault.run_ids) <= {runs[2].run_id, runs[3].run_id}
        lost = [np.isnan(run.measured[:, G]).mean() for run in fixed if run.run_id in fault.run_ids]
        assert all(0.02 < ratio < 0.5 for ratio in lost)


def test_an_offset_is_not_beyond_what_was_measured_and_not_where_the_heading_has_it_too():
    runs = [with_lidar(run, 0.0) for run in sound(wide=True)]
    gyro = edit(lambda _, v: v + 0.9, **GYRO_Z)
    (fault,) = faults(on_one_clock([gyro(run) for run in runs]))
    assert (fault.change.kind, fault.change.column) == (OFFSET, Column.GYRO)
    both = edit(lambda _, v: v + 0.9, **GYRO_Z, lidar="yaw")  # it turns, and its wheels do not say so
    assert not [f for f in faults(on_one_clock([both(run) for run in runs])) if f.change.kind is OFFSET]
    (rows,), _ = rows_and_low_pass(on_one_clock(sound()[1:2]), simulation_of(HUSKY))
    far = rows._replace(predicted=rows.predicted + 5.0)  # never near rest
    assert np.isnan(zero_of(far, G)).all()
    assert np.isfinite(zero_of(rows, G)).all()


def test_an_offset_that_each_half_of_the_runs_has_otherwise_is_no_fault_of_the_logger():
    gyros = [
        of_gyro(lambda _, w, by=by: w + by)(run)
        for by, run in zip([0.9, 1.9] * 3, sound(wide=True), strict=True)
    ]
    assert not [fault for fault in faults(on_one_clock(gyros)) if fault.change.kind is OFFSET]


def test_a_zero_that_drifts_in_all_runs_is_named_and_one_that_wanders_is_not():
    drifts = [of_gyro(lambda t, w: w + 0.006 * t)(run) for run in sound()]
    (fault,) = faults(on_one_clock(drifts))
    assert (fault.change.kind, fault.change.column) == (FaultKind.DRIFT, Column.GYRO)
    assert fault.change.drift == pytest.approx(-0.006, rel=0.1)
    signs = [
        of_gyro(lambda t, w, s=s: w + 0.006 * s * t)(r) for s, r in zip([1, -1] * 3, sound(), strict=True)
    ]
    assert not [f for f in faults(on_one_clock(signs)) if f.change.kind is FaultKind.DRIFT]


def test_wheels_faster_than_their_motors_are_in_another_unit_also_without_a_speed_over_ground():
    """A gyro that reads a seventh of the prediction may be that of a robot that skids."""
    logs = np.array([{G: np.log(0.6 / 3.6)}.get(c, np.nan) for c in KEYS])
    options = options_of(logs[None], HUSKY)
    assert likeliest(logs, options, HUSKY, 0.9) == ((), [])
    changes, rivals = likeliest(logs, options, HUSKY, 3.2)
    assert {change.column for each in (changes, *rivals) for change in each} == {Column.WHEELS}


# -- Zeros and scales beside a witness -----------------------------------------------------------------------


def steady_turns(rates_radps, n=12, duration_s=8.0):
    """Return runs with a lidar, each of one steady turn, whose body turns less than its wheels say."""
    noise, runs = spread_numbers("noise"), []
    for i in range(n):
        twist = np.tile([0.4, 0.0, rates_radps[i % len(rates_radps)]], (round(duration_s * 50) + 1, 1))
        about = {"effects": WIDE, "run_id": f"turn_{i:02d}", "noise": noise}
        run = simulate(HUSKY, twist, Ground(), i, **about)
        streams = {  # without the start from rest
            name: Stream(was.time_s[was.time_s > 2.0], was.values[was.time_s > 2.0], was.channels)
            for name, was in run.streams.items()
        }
        runs.append(with_lidar(replace(run, streams=streams), 0.0))
    return runs


SIDES, ONE_SIDE = (0.8, -0.6, 0.5, -0.9), (0.7,)


def without_heading(run):
    """Return a run whose lidar logs no yaw rate."""
    seen = run.streams["lidar"]
    return replace(
        run, streams={**run.streams, "lidar": Stream(seen.time_s, seen.values[:, :1], seen.channels[:1])}
    )


def test_an_offset_of_steady_turns_is_found_beside_the_heading_and_is_no_turned_sign():
    runs = steady_turns(SIDES)
    (fault,) = faults(on_one_clock([of_gyro(lambda _, w: w + 0.9)(run) for run in runs]))
    assert (fault.change.kind, fault.change.column) == (OFFSET, Column.GYRO)
    assert fault.change.offset == pytest.approx(-0.9, abs=0.05)
    assert len(fault.run_ids) == len(runs)  # also those whose zero the wheels do not show
    assert faults(on_one_clock(runs)) == ()


def test_an_offset_that_few_runs_show_is_that_of_a_body_that_slides():
    """Of the others, none could show it: their wheels never come near rest."""
    runs = [without_heading(run) for run in steady_turns(SIDES)]
    slides = edit(lambda _, v: v + 0.9, odometry="speed_x")
    odd = [slides(run) if i == 2 else run for i, run in enumerate(sound())]
    far = [replace(run, run_id=f"far_{i}") for i, run in enumerate(odd[2:3])]
    assert faults(on_one_clock([*runs, *far])) == ()


def test_a_run_whose_zero_is_not_known_does_not_contradict_an_offset():
    """Its gyro and its heading differ by as much as the offset, as where a lidar's windows begin."""
    rng, runs = np.random.default_rng(0), steady_turns(SIDES)
    for i, run in enumerate(runs):
        runs[i] = of_gyro(lambda _, w: w + 0.9)(run)
        if i % 3 == 0:
            runs[i] = edit(lambda t, w: w + 0.8 * np.sign(np.sin(2.0 * t + rng.uniform(0, 6))), lidar="yaw")(
                runs[i]
            )
    found = [fault for fault in faults(on_one_clock(runs)) if fault.change.kind is OFFSET]
    assert [len(fault.run_ids) for fault in found] == [len(runs)]


def test_a_gyro_of_another_scale_has_no_offset_by_its_turns():
    runs = [of_gyro(lambda _, w: 2.0 * w)(run) for run in steady_turns((2.5, 2.5, 1.2, 1.2))]
    assert OFFSET not in {fault.change.kind for fault in faults(on_one_clock(runs))}


def test_what_is_left_of_a_gyro_at_the_end_of_its_range_has_no_scale(monkeypatch):
    def asked(*_):
        raise AssertionError

    monkeypatch.setattr("terrain.discrepancy.health.faults.scale_faults", asked)
    runs = [with_lidar(run, 0.16) for run in runs_of(12, 0.1)]
    found = faults(on_one_clock([of_gyro(lambda _, w: np.clip(w, -0.3, 0.3))(run) for run in runs]))
    assert {fault.change.kind for fault in found} == {FaultKind.SATURATION}


def test_a_turned_sign_of_one_steady_turn_may_be_an_offset_and_of_two_is_a_sign():
    one, two = (
        on_one_clock([of_gyro(times(-1))(run) for run in steady_turns(rates)]) for rates in (ONE_SIDE, SIDES)
    )
    (fault,) = faults(one)
    assert (fault.change.column, fault.status) == (Column.GYRO, FaultStatus.UNDECIDED)
    assert [rival.kind for rival in fault.rivals] == [OFFSET]
    assert "steady as the motion is" in fault.sentence
    for run in repaired(one, [fault]):
        assert np.isnan(run.measured[:, G]).all()
    (fault,) = faults(two)
    assert (fault.change.kind, fault.change.column, fault.status) == (
        SIGN,
        Column.GYRO,
        FaultStatus.CONFIRMED,
    )


def test_a_channel_follows_about_its_zero_where_that_is_beyond_any_sensors():
    (run,), _ = rows_and_low_pass(on_one_clock(sound()[1:2]), simulation_of(HUSKY))
    moved = run.measured.copy()
    moved[:, G] += 0.9
    was, now = (agreement_of([each]) for each in (run, run._replace(measured=moved)))
    assert now.correlation[0, G] == pytest.approx(was.correlation[0, G], abs=0.05)
    assert now.gain[0, G] == pytest.approx(was.gain[0, G], rel=0.1)


@pytest.mark.parametrize(("factor", "is_fault"), [(1.15, True), (0.87, True), (1.04, False), (1.0, False)])
def test_a_scale_of_the_gyro_beside_the_heading_is_named_beyond_that_of_any_sensor(factor, is_fault):
    runs = [with_lidar(run, 0.16) for run in runs_of(12, 0.1)]
    signals = on_one_clock([of_gyro(times(factor))(run) for run in runs])
    found = faults(signals)
    assert [(fault.change.kind, fault.change.column) for fault in found] == (
        [(FaultKind.SCALE, Column.GYRO)] if is_fault else []
    )
    for fault in found:
        assert fault.change.factor == pytest.approx(1.0 / factor, rel=0.03)
        assert fault.sentence.startswith("the gyro reads 1")
        assert "too much" in fault.sentence if factor > 1.0 else "too little" in fault.sentence


def test_a_zero_that_drifts_over_the_runs_is_named_and_taken_off_in_their_order():
    runs = [with_lidar(run, 0.0) for run in runs_of(24, 0.1)]
    drifts = [of_gyro(lambda _, w, k=k: w + 0.01 * k)(run) for k, run in enumerate(runs)]
    signals = [replace(run, place=float(k)) for k, run in enumerate(on_one_clock(drifts))]
    (fault,) = faults(signals)
    assert (fault.change.kind, fault.change.column) == (FaultKind.DRIFT, Column.GYRO)
    assert fault.change.over_runs == pytest.approx(-0.01, rel=0.1)
    assert "from run to run in all 24 runs" in fault.sentence
    for run, true in zip(repaired(signals, [fault]), on_one_clock(runs), strict=True):
        assert_allclose(run.measured[:, G], true.measured[:, G], atol=0.03)
    shuffled = [
        of_gyro(lambda _, w, k=k: w + 0.01 * k)(run) for k, run in zip([5, 17, 11] * 8, runs, strict=True)
    ]
    assert faults(on_one_clock(shuffled)) == ()
    last = [of_gyro(lambda _, w: w + 2.0)(run) if k == 23 else run for k, run in enumerate(runs)]
    assert FaultKind.DRIFT not in {fault.change.kind for fault in faults(on_one_clock(last))}


def test_a_reading_that_gains_more_in_a_half_of_the_runs_that_one_mends_may_lose_in_the_rest():
    """Where both wheels turn alike, all wheels turned look like one that is; where they differ, they do not."""
    one, every = Change(SIGN, Column.WHEELS, -1.0, 0), Change(SIGN, Column.WHEELS, -1.0)
    correlation = np.zeros((8, len(CHANNELS)))
    correlation[:4, G], correlation[4:, G] = 0.1, 0.99
    before = Agreement(correlation, 0.0 * correlation, correlation)
    gains = {one: [100.0] * 4 + [0.0] * 4, every: [80.0, 110.0, 80.0, 110.0] + [-500.0] * 4}
    mends = np.arange(8) < 4

    def tried(change, _):
        gain = np.array(gains.get(change, [0.0] * 8))
        return Reading(change, correlation, gain, mends & (gain > 0), gain > 0)

    rows, _ = rows_and_low_pass(on_one_clock(sound()[1:2]), simulation_of(HUSKY))
    runs = [rows[0]._replace(run_id=f"run_{i}") for i in range(8)]
    fault = turned_fault(before, tried, runs, ["a"] * 8, HUSKY)
    assert fault is not None
    assert fault.change == one


def test_where_a_robot_drives_sideways_the_vector_of_its_speed_follows_the_wheels():
    """Either speed alone may be too small to ask for, and has the same sign in many directions."""
    (run,), _ = rows_and_low_pass(on_one_clock(sound("agrimaro")[:1]), simulation_of(AGRIMARO))
    predicted = np.zeros_like(run.predicted)
    predicted[:, [X, Y]] = 0.05, 0.03
    for turn_rad in (0.0, 1.0, np.pi):
        measured = np.full_like(predicted, np.nan)
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        measured[:, [X, Y]] = 0.8 * predicted[:, [X, Y]] @ np.array([[cos, sin], [-sin, cos]])
        follows = agreement_of([run._replace(measured=measured, predicted=predicted)], sideways=True)
        assert follows.correlation[0, X] == pytest.approx(cos)
        assert follows.gain[0, X] == pytest.approx(0.8 * cos)
    assert agreement_of([run._replace(measured=measured, predicted=predicted)]).correlation[0, X] == 0.0


def test_a_channel_that_holds_its_largest_value_is_not_at_the_end_of_a_range_where_others_end_elsewhere():
    def held_at_most(t, w):
        at = int(np.argmax(np.where((t > 5) & (t < 20), w, -np.inf)))
        return np.where((t >= t[at]) & (t < t[at] + 5), w[at], np.minimum(w, w[at]))

    runs = [of_gyro(held_at_most)(run) if i in (1, 2, 3) else run for i, run in enumerate(sound())]
    found = faults(on_one_clock(runs))
    assert {fault.change.kind for fault in found} == {FaultKind.DROPOUT}


# -- Measured logs: no fault, wheels and lidar of one robot that are late, runs of another that are stuck -----


@pytest.mark.parametrize("folder", [pytest.param("drive_husky", marks=pytest.mark.slow), "borealtc", "vulpi"])
def test_measured_huskies_have_no_fault_and_what_is_late_or_stuck_is_found(measured_runs, folder):
    runs = measured_runs(folder)
    lags = latencies(runs)
    assert faults(on_one_clock(runs), lags=lags) == ()
    if folder == "drive_husky":
        found = dict(lags.starting_values)
        assert found.pop("clock_offset_s") == pytest.approx(-0.265, abs=0.03)
        assert found == {"camera_latency_s": pytest.approx(0.16, abs=0.05)}
    if folder == "borealtc":
        snow = [run for run in runs if run.terrains == ("SNOW",)]
        stuck = {snow[i].run_id for i in stalls(snow)}
        assert stuck == {f"SNOW_{k:02d}" for k in (2, 3, 4, 5, 12, 14, 15, 19, 22)}
