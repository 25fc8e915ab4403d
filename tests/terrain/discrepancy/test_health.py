"""Signs, units and exchanged columns are named with their repair, and what effects do is none of them."""

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
from terrain.discrepancy.clocks import latencies_of
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
    faults_of,
    likeliest,
    options_of,
    reading_of,
    repaired,
)
from terrain.discrepancy.runs import Signals, low_pass_of, rows_of, signals_of
from terrain.effects import CHANNELS
from terrain.logs.drive import DriveRobot, find_runs
from terrain.logs.imu_axes import GYRO_TURNED
from terrain.records import Array, RunLog, Stream
from terrain.robots import load_robot

DEG, RPM, KMH = 57.29577951, 9.54929659, 3.6
SIGN, UNIT, SWAPPED = FaultKind.SIGN, FaultKind.UNIT, FaultKind.SWAPPED
TRACK = {"effective_track_ratio": 1.5}
"""A robot that turns 2.5 times less than its simulation."""

Edit = Callable[[RunLog], RunLog]


@cache
def sound(name: str = "husky", track: bool = False, seed: int = 3) -> tuple[RunLog, ...]:
    effects = TRACK if track else {}
    drives = rich_drives(np.random.default_rng(seed), 8, 40.0)
    return hidden_runs(load_robot(name), drives, np.random.SeedSequence(seed), effects)


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


GYRO, ACCEL = ("gyro_z",), ("accel_x",)
SPEED, WHEELS, CURRENTS = ("speed_x", "speed_y"), ("speed_", "motor_"), ("current_",)
WRITTEN = {
    "the gyro's sign": (edit("imu", GYRO, times(-1)), SIGN, Column.GYRO, -1),
    "gyro in deg/s": (edit("imu", GYRO, times(DEG)), UNIT, Column.GYRO, 1 / DEG),
    "gyro in rad/s, read as deg/s": (edit("imu", GYRO, times(1 / DEG)), UNIT, Column.GYRO, DEG),
    "gyro in rpm": (edit("imu", GYRO, times(RPM)), UNIT, Column.GYRO, 1 / RPM),
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


def with_heading(run: RunLog) -> RunLog:
    """Replace the camera by a lidar that measures a heading, too."""
    imu, wheels, seen = (run.streams[name] for name in ("imu", "wheels", "odometry"))
    yaw_rate = np.interp(seen.time_s, imu.time_s, imu.channel("gyro_z_radps"))
    values = np.column_stack([seen.values, yaw_rate])
    lidar = Stream(seen.time_s, values, (*seen.channels, "yaw_rate_radps"))
    return replace(run, streams={"imu": imu, "wheels": wheels, "lidar": lidar})


def test_a_heading_says_whether_the_gyro_or_the_wheels_are_turned():
    runs = [with_heading(run) for run in sound(track=True)]
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
    robot = load_robot(name)
    drives = rich_drives(np.random.default_rng(5), 8, 40.0)
    runs = hidden_runs(robot, drives, np.random.SeedSequence(5), effects)
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

    def following(gyro, likelihood):
        correlation = np.zeros((1, len(CHANNELS)))
        correlation[0, [G, X]] = gyro, 0.9
        return Agreement(correlation, np.array([[likelihood]]), correlation)

    after = following(0.98, 100.0)
    unasked, asked = (reading_of(change, following(gyro, 0.0), after) for gyro in (0.0, 0.1))
    assert (unasked.mends.tolist(), asked.mends.tolist()) == ([False], [True])


@pytest.mark.parametrize("folder", ["drive_husky", "borealtc", "vulpi"])
def test_measured_huskies_have_no_fault(measured, folder):
    assert faults(on_one_clock(load_runs(measured(folder)))) == ()


@pytest.mark.slow
def test_the_gyro_of_the_measured_marmotte_is_turned(measured):
    """The reader turns it and counts that; turned back, as it is logged, it is found as a fault."""
    robot = DriveRobot("husky", load_robot("husky").wheel_radius_m)  # a sign asks for no size
    runs = [read(repair=True) for read in find_runs(measured("drive_marmotte"), robot)]
    assert faults(on_one_clock(runs)) == ()
    assert all(run.dropped[GYRO_TURNED] == 1 for run in runs)
    logged = [WRITTEN["the gyro's sign"][0](run) for run in runs]
    (fault,) = faults(on_one_clock(logged))
    assert (fault.change.kind, fault.change.column, len(fault.run_ids)) == (SIGN, Column.GYRO, len(runs))
    assert "the heading rate with -0.9" in fault.sentence
    assert latencies_of(repaired(on_one_clock(logged), [fault]), simulation_of(load_robot("husky"))).channels
