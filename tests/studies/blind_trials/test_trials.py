"""Each row of the trials hides in its logs what it states: seen in the logs themselves."""

import doctest
import math
from dataclasses import replace
from importlib import import_module
from itertools import count

import numpy as np
import pytest
from scipy.stats import norm

from studies.blind_trials.drives import LEAD_S, command_drives, poor_drives, rich_drives
from studies.blind_trials.hidden import (
    CREEP_RATIO,
    KNOWN,
    N_STALLED,
    SHORT_RUNS,
    TRACK,
    TRACK_ERROR,
    TRACK_RATIO,
    TRACK_SCATTER,
    WHEELS_LATE_S,
    Case,
    Row,
    as_command_log,
    cases_of,
    dynamic_runs,
    faults_of,
    hidden_runs,
    setting_of,
    value_is_right,
    with_fault,
)
from studies.blind_trials.limits import POWER, TEST_SIZE, Limits, confusable_class, limits_of
from studies.blind_trials.scoring import table_of
from studies.blind_trials.trial import GROSS, run_trial, simulation_of, stage_of
from terrain.discrepancy.diagnose import POWER_Z, diagnose
from terrain.discrepancy.selection import Z_EFFECT
from terrain.discrepancy.verdict import Verdict
from terrain.effects import BOUNDS, effect_named, library_of
from terrain.errors import DataError
from terrain.robots import load_robot

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")

NEW_ROWS = list(Row)[list(Row).index(Row.GROSS) :]

RATE_HZ = 50.0
"""Of the clock on which streams are compared."""


def stage(row, number, n_runs=4, seed=0):
    """Return a trial before the diagnosis; odd numbers are of the skid-steer robot where a row has both."""
    case = next(c for c in cases_of(row, number + 1, seed, n_runs) if c.number == number)
    drawn, noise = np.random.SeedSequence([seed, number]).spawn(2)
    return stage_of(case, load_robot(case.robot), np.random.default_rng(drawn), noise)


def stage_hiding(row, causes):
    """Return the first trial of the skid-steer robot that hides given causes."""
    return next(s for number in count(1, 2) if (s := stage(row, number)).hidden.causes == causes)


def on_clock(run, name, signal):
    """Return a signal of a stream on a clock of its run's own, and that clock."""
    stream = run.streams[name]
    first = max(s.time_s[0] for s in run.streams.values())
    last = min(s.time_s[-1] for s in run.streams.values())
    time_s = np.arange(first, last, 1.0 / RATE_HZ)
    return np.interp(time_s, stream.time_s, signal(stream))


def turn(wheels):
    """Return the yaw rate that a skid-steer robot's wheels ask for with the nominal track."""
    return (wheels.channel("speed_right_mps") - wheels.channel("speed_left_mps")) / HUSKY.track_m


def ahead(wheels):
    return (wheels.channel("speed_right_mps") + wheels.channel("speed_left_mps")) / 2


def gyro(imu):
    return imu.channel("gyro_z_radps")


def slope(x, y):
    return float(x @ y / (x @ x))


def lag_s(one, other):
    """Return how far one signal is behind another, by cross-correlation."""
    shifts = np.arange(-30, 31)
    same = [one[40 + k : len(one) - 40 + k] @ other[40 : len(other) - 40] for k in shifts]
    return shifts[int(np.argmax(same))] / RATE_HZ


def median_lag_s(runs, late, reference):
    return float(np.median([lag_s(on_clock(run, *late), on_clock(run, *reference)) for run in runs]))


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, marks=[pytest.mark.slow] * (row in ("dynamic", "short", "known")))
        for row in NEW_ROWS
    ],
)
def test_the_same_seed_gives_the_same_trial_and_nothing_of_the_truth_leaks(row):
    n_runs = 4

    def streams_of(seed):
        made = stage(row, 1, n_runs, seed)
        return made, [
            part.tobytes() for run in made.runs for s in run.streams.values() for part in (s.time_s, s.values)
        ]

    (made, one), (again, other), (_, third) = streams_of(0), streams_of(0), streams_of(1)
    assert one == other
    assert one != third
    assert made.hidden == again.hidden
    assert made.simulation is not None
    assert not any("truth" in run.streams or run.source for run in made.runs)
    assert len({run.run_id for run in made.runs}) == len(made.runs)


@pytest.mark.slow
def test_gross_effects_are_20_to_100_times_their_limit_unless_that_is_beyond_the_bounds():
    clipped = []
    for number in range(12):
        made = stage(Row.GROSS, number)
        assert GROSS[0] <= made.hidden.over_limit <= GROSS[1]
        effect = effect_named(made.hidden.causes[0])
        values = np.array([made.hidden.effects[p.name] for p in effect.parameters])
        bounds = np.array([BOUNDS[p.name] for p in effect.parameters])
        assert (values >= 0.9 * bounds[:, 0]).all()
        assert (values <= 0.9 * bounds[:, 1]).all()
        reached = np.linalg.norm(values) / made.limits.of(effect, values / np.linalg.norm(values))
        assert made.clipped == (reached < 0.999 * made.hidden.over_limit)
        clipped.append(made.clipped)
    assert len(set(clipped)) == 2


def test_short_runs_are_commands_of_6_s_in_the_drive_layout():
    made = stage(Row.SHORT, 0)
    assert len(made.runs) == SHORT_RUNS
    wheels = [run.streams["wheels"] for run in made.runs]
    for run in made.runs:
        assert set(run.streams) == {"wheels", "imu", "lidar"}
        assert not any(
            "current" in name or "roll" in name for s in run.streams.values() for name in s.channels
        )
        for stream in run.streams.values():
            assert stream.rate_hz == pytest.approx(20.0)
            assert stream.duration_s == pytest.approx(6.0, abs=0.2)
            assert stream.time_s[0] == 0.0
    held = np.array([[s.values[60:].std(axis=0).max(), s.values[60:].mean()] for s in wheels])
    assert np.median(held[:, 0]) < 0.02  # one command is held for the second half
    assert held[:, 1].std() > 0.3  # and differs from run to run
    assert np.median([abs(s.values[0]).max() for s in wheels]) > 0.2  # a run begins at the command before


@pytest.mark.parametrize("number", [1, 3])
def test_a_late_logger_is_late_by_what_is_stated(number):
    """Wheels that are stamped late see a turn after the gyro, an IMU that is stamped late before it."""
    made = stage(Row.LATE, number)
    assert (made.late_s < 0) == (made.variant == "wheels")
    assert 0.15 <= abs(made.late_s) <= 0.4
    found_s = median_lag_s(made.runs, ("imu", gyro), ("wheels", turn))
    assert found_s == pytest.approx(made.late_s, abs=0.05)
    assert made.hidden.causes[0] == "clock_offset"
    assert len(made.hidden.causes) == 2


@pytest.mark.parametrize("number", [1, 3, 5])
def test_one_sensor_is_late_and_the_others_are_not(number):
    made = stage(Row.SENSOR_LATE, number)
    (late_s,) = made.hidden.effects.values()
    assert 0.1 <= late_s <= 0.3
    gyro_s = median_lag_s(made.runs, ("imu", gyro), ("wheels", turn))
    seen = "lidar" if made.variant == "lidar" else "odometry"
    seen_s = median_lag_s(made.runs, (seen, lambda s: s.channel("speed_x_mps")), ("wheels", ahead))
    is_gyro = made.variant == "gyro"
    assert gyro_s == pytest.approx(late_s if is_gyro else 0.0, abs=0.03)
    camera_s = HUSKY.camera.latency_s
    assert seen_s == pytest.approx(camera_s if is_gyro else camera_s + late_s, abs=0.04)
    assert made.hidden.causes[0].endswith("_latency")


@pytest.mark.slow
def test_scatter_has_the_size_that_is_stated():
    """The track of a run is measured: the slope of its gyro over the turn of its wheels."""
    made = stage(Row.SCATTERED, 1, n_runs=40)
    ratio = float(made.variant.rstrip("%")) / 100
    assert 0.1 <= ratio <= 0.35
    slopes = [slope(on_clock(run, "wheels", turn), on_clock(run, "imu", gyro)) for run in made.runs]
    expected = math.sqrt(math.log(1 + ratio**2))
    assert np.std(np.log(slopes)) == pytest.approx(expected, rel=0.4)  # 3 standard deviations of 40 runs
    assert made.accepted == ("effective_track",)


def test_stalled_runs_do_not_move_and_their_wheels_turn():
    for number in (0, 1):
        made = stage(Row.STALLED, number, n_runs=8)
        assert 1 <= len(made.stalled) <= 2
        for run in made.runs:
            odometry = run.streams["odometry"]
            names = [n for n in odometry.channels if n in ("speed_x_mps", "position_x_m", "position_y_m")]
            moved = np.array([odometry.channel(n) for n in names])
            if len(names) == 2:  # poses: speeds by differences over 0.2 s
                moved = np.diff(moved[:, ::10], axis=1) * 5.0
            wheels = run.streams["wheels"]
            speeds = wheels.values[:, [n.startswith(("speed", "motor")) for n in wheels.channels]]
            per = 1.0 if number else AGRIMARO.wheel_radius_m / AGRIMARO.motors.reduction_ratio
            driven = float(np.sqrt((speeds**2).mean())) * per
            speed = float(np.sqrt((moved**2).sum(axis=0).mean()))
            assert driven > 0.2
            if run.run_id in made.stalled:
                assert speed < 2 * CREEP_RATIO[1] * driven + 0.02
            else:
                assert speed > 0.25 * driven


@pytest.mark.slow
def test_half_of_the_runs_have_the_effect_and_the_others_have_none():
    made = stage_hiding(Row.HALF, ("gyro_bias",))
    (bias,) = made.hidden.effects.values()
    assert len(made.present) == len(made.runs) // 2
    for run in made.runs:
        imu = run.streams["imu"]
        at_rest = float(gyro(imu)[imu.time_s < 1.0].mean())
        assert at_rest == pytest.approx(bias if run.run_id in made.present else 0.0, abs=0.008)
    assert abs(bias) > 0.008


def test_a_larger_wheel_carries_the_dynamic_robot_further():
    setting = setting_of(2)
    travelled = []
    for effects in ({}, {"wheel_radius_ratio": 0.03}):
        (run,) = dynamic_runs(AGRIMARO, setting, 7, 1, effects)
        seen, wheels = run.streams["odometry"], run.streams["wheels"]
        assert "truth" not in run.streams
        path = np.column_stack([seen.channel(f"position_{axis}_m") for axis in "xy"])[::40]
        rolled = np.trapezoid(np.abs(wheels.channel("speed_1_mps")), wheels.time_s)
        travelled.append(np.hypot(*np.diff(path, axis=0).T).sum() / rolled)
    assert travelled[1] / travelled[0] == pytest.approx(1.03, abs=0.01)


@pytest.mark.parametrize(
    "number", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, len(KNOWN)))]
)
def test_the_known_truth_is_in_the_logs(number):
    known, made = KNOWN[number], stage(Row.KNOWN, number)
    assert made.variant == known.name
    assert len(made.stalled) == (N_STALLED if known.stalled else 0)
    moving = [run for run in made.runs if run.run_id not in made.stalled]
    late_s = WHEELS_LATE_S if known.late else 0.0
    slopes = []
    for run in moving:
        wheels, imu = run.streams["wheels"], run.streams["imu"]
        asked = np.interp(imu.time_s, wheels.time_s - late_s, turn(wheels))
        if np.std(asked) + abs(asked.mean()) > 0.5:
            slopes.append(slope(asked, gyro(imu)))
    scatter = math.hypot(TRACK_SCATTER if known.scatters else 0.0, 0.008)
    assert np.median(slopes) == pytest.approx(1 / (1 + TRACK_ERROR), rel=0.06 if known.scatters else 0.03)
    assert np.std(np.log(slopes)) == pytest.approx(scatter, rel=0.35, abs=0.02)
    if known.stalled:
        for run in made.runs:
            ratio = slope(turn(run.streams["wheels"]), run.streams["lidar"].channel("yaw_rate_radps"))
            assert (abs(ratio) < 0.05) == (run.run_id in made.stalled) or np.std(
                turn(run.streams["wheels"])
            ) < 0.1


def test_what_is_free_costs_the_information_that_the_inverse_has_not():
    """Two routes: Schur's complement, and rows and columns of the inverse."""
    root = np.random.default_rng(0).standard_normal((4, 6))
    limits = Limits(("a", "b", "c", "d"), root @ root.T)
    left = limits.free("c")
    kept = [0, 1, 3]
    assert left.names == ("a", "b", "d")
    assert np.linalg.inv(left.information) == pytest.approx(
        np.linalg.inv(limits.information)[np.ix_(kept, kept)]
    )


# -- The sealed side of the blind trials: its limits agree with the diagnosis' own, and nothing leaks ------


@pytest.fixture(scope="module", params=[HUSKY, AGRIMARO], ids=["husky", "agrimaro"])
def world(request):
    drives = rich_drives(np.random.default_rng(1), 6, 40.0)
    return request.param, drives, limits_of(request.param, drives)


def test_the_cramer_rao_limit_and_the_diagnosis_agree_on_what_can_be_seen(world):
    """Two routes: true motion and the noise that is put in; logs and the noise that is found in them.

    The first takes noise at one pace, the second knows that it is less in slow turns.
    """
    robot, drives, limits = world
    runs = hidden_runs(robot, drives, np.random.SeedSequence(4), {})
    found = diagnose(runs, simulation_of(robot))
    per_std = norm.isf(TEST_SIZE / 2 / limits.library_size) + norm.ppf(POWER)
    ratios = {}
    modifying = {p.name for e in library_of(robot.drive) if e.modifies for p in e.parameters}
    assert all(
        math.isinf(limit.detection_limit) == (limit.name in modifying) for limit in found.detection_limits
    )
    for limit in found.detection_limits:
        if limit.name in modifying:
            continue
        std = 1 / math.sqrt(limits.information.diagonal()[limits.names.index(limit.name)])
        ratios[limit.name] = limit.detection_limit / (Z_EFFECT + POWER_Z) / std
        for effect in library_of(robot.drive):
            if effect.parameters[0].name == limit.name:
                assert limits.of(effect) == pytest.approx(per_std * std)
    assert np.mean([abs(ratio - 1) < 0.4 for ratio in ratios.values()]) > 0.85, ratios
    assert all(0.4 < ratio < 2.5 for ratio in ratios.values()), ratios


def test_limits_fall_with_more_runs_and_rise_where_little_is_driven(world):
    robot, drives, limits = world
    half = limits_of(robot, drives._replace(twists=drives.twists[:3], hills=drives.hills[:3]))
    poor = limits_of(robot, poor_drives(np.random.default_rng(1), 3, 40.0))
    for effect in library_of(robot.drive):
        assert limits.of(effect) < half.of(effect) or effect.modifies
    shown = "steering_delay" if robot is AGRIMARO else "turning_slip"
    assert poor.of(effect_named(shown)) > 3 * half.of(effect_named(shown))
    lever = effect_named("lever_arm")
    along = limits.of(lever, np.array([0.0, 1.0]))
    at = limits.names.index("lever_y_m")
    assert along / limits.of(lever) == pytest.approx(
        math.sqrt(limits.information[at - 1, at - 1] / limits.information[at, at])
    )


def test_an_effect_is_of_its_own_class_and_a_class_is_mutual(world):
    robot, _, limits = world
    library = library_of(robot.drive)
    classes = {effect.name: confusable_class(limits, effect, robot.drive) for effect in library}
    for name, members in classes.items():
        assert name in members
        assert all(name in classes[other] for other in members)
    assert "gyro_bias" not in classes["payload"]


def test_nothing_of_the_truth_leaks_into_the_runs(world):
    robot, drives, _ = world
    some = drives._replace(twists=drives.twists[:2], hills=drives.hills[:2])
    plain, hidden = (
        hidden_runs(robot, some, np.random.SeedSequence(9), effects)
        for effects in ({}, {"payload_ratio": 0.3})
    )
    for run, other in zip(plain, hidden, strict=True):
        assert set(run.streams) <= {"wheels", "imu", "odometry", "steering"}
        assert (run.run_id, run.labels, run.source) == (other.run_id, other.labels, other.source)
        assert run.source == ""
        assert "payload" not in repr(other)
        assert {name: s.channels for name, s in run.streams.items()} == {
            name: s.channels for name, s in other.streams.items()
        }
        # the same draws: an effect on masses leaves gyro noise alone, and shows in the currents
        currents = [f"current_{wheel}_a" for wheel in robot.wheels]
        one, two = (sum(r.streams["wheels"].channel(name) for name in currents) for r in (run, other))
        assert np.std(two - one) > 0.1


def test_a_clock_that_drifts_starts_with_the_log():
    """Of a log that begins two seconds into a drive, the first stamps of both loggers agree."""
    rate = 0.02
    drives = command_drives(np.random.default_rng(0), HUSKY, 1)
    (plain,), (drifting,) = (
        hidden_runs(HUSKY, drives, np.random.SeedSequence(1), values)
        for values in ({}, {"clock_rate_ratio": rate})
    )
    one, other = (run.streams["imu"].channel("gyro_z_radps") for run in (plain, drifting))
    shown, late = plain.streams["imu"].time_s, drifting.streams["imu"].time_s
    assert late[0] == pytest.approx(shown[0] - rate * LEAD_S, abs=0.02)
    # an event is stamped as late as the clock has drifted since the log began
    event = shown[np.abs(np.diff(one)).argmax()]
    there = late[np.abs(np.diff(other)).argmax()]
    assert there - event == pytest.approx(rate * event, abs=0.03)


# -- Which effects a trial may hide together ---------------------------------------------------------------


def test_two_effects_that_a_third_can_stand_for_are_known():
    """Equal latencies of IMU and camera are a clock offset; a payload is neither."""
    husky = load_robot("husky")
    limits = limits_of(husky, rich_drives(np.random.default_rng(1), 3))
    pair = effect_named("imu_latency"), effect_named("camera_latency")
    assert limits.spanned(pair, effect_named("clock_offset"))
    assert not limits.spanned(pair, effect_named("payload"))
    assert not limits.alike(pair[0], effect_named("clock_offset"))


@pytest.mark.parametrize("least", [0.0, 1e-320, 1e-12])
def test_an_effect_that_drives_hardly_show_is_like_none_that_they_show(least):
    names = "payload_ratio", "turn_drag_s2", "scrub_ratio"
    limits = Limits(names, np.diag([100.0, least, least]))
    payload, drag, scrub = (effect_named(name) for name in ("payload", "turn_drag", "scrub"))
    assert not limits.alike(payload, drag)
    assert limits.alike(drag, scrub)
    assert not limits.spanned((payload, drag), scrub)


def test_a_run_that_stands_shows_little_and_spoils_nothing():
    """One command of eighty may be next to none."""
    husky = load_robot("husky")
    drives = command_drives(np.random.default_rng(0), husky, 3)
    standing = tuple(np.zeros_like(twist) if i == 1 else twist for i, twist in enumerate(drives.twists))
    moved = limits_of(husky, drives._replace(twists=drives.twists[::2], hills=drives.hills[::2]))
    limits = limits_of(husky, drives._replace(twists=standing))
    assert np.isfinite(limits.information).all()
    at = limits.names.index("wheel_radius_ratio")
    assert limits.information[at, at] == pytest.approx(moved.information[at, at], rel=1e-3)


# -- A robot of known truth in short runs, and one of which nothing is wrong -------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(KNOWN)), ids=[known.name for known in KNOWN])
def test_a_track_that_is_two_and_a_half_times_as_wide_is_named_in_short_runs(number):
    known = KNOWN[number]
    trial = run_trial(Case(Row.KNOWN, number, "husky", SHORT_RUNS, 0))
    assert TRACK in trial.named
    assert trial.right
    assert value_is_right(trial.intervals)
    _, low, high = trial.intervals[TRACK_RATIO]
    if not known.scatters:  # the mean of runs that scatter is no constant to be met
        assert low < TRACK_ERROR < high
    assert set(trial.stalled) <= set(trial.excluded)
    assert len(trial.excluded) <= len(trial.stalled) + 1


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_short_runs_in_which_nothing_is_hidden_have_no_cause(seed):
    drives = command_drives(np.random.default_rng(seed), HUSKY, SHORT_RUNS)
    runs = hidden_runs(HUSKY, drives, np.random.SeedSequence(seed), {}, heading=True)
    found = diagnose(tuple(map(as_command_log, runs)), simulation_of(HUSKY))
    assert found.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    assert (found.causes, found.ambiguous_sets, found.varying, found.faults) == ((), (), (), ())
    assert len(found.excluded_runs) <= 3  # a command may leave a wheel as fast as the one before


# -- Faults written into logs: each is in the log, on the robots that show it, and is known by its sentence --


@pytest.fixture(scope="module", params=["husky", "agrimaro"])
def plain(request):
    robot = load_robot(request.param)
    drives = rich_drives(np.random.default_rng(1), 1, 20.0)
    return robot, hidden_runs(robot, drives, np.random.SeedSequence(2), {})


def test_a_fault_changes_its_channels_and_no_others(plain):
    robot, runs = plain
    (run,) = runs
    for fault in faults_of(robot.drive):
        (broken,) = with_fault(runs, fault, robot)
        changed = {
            (name, channel)
            for name, stream in run.streams.items()
            for channel in stream.channels
            if not np.array_equal(stream.channel(channel), broken.streams[name].channel(channel))
        }
        assert changed, fault.name
        assert {name for name, _ in changed} == {fault.stream}
        assert len(changed) < sum(len(s.channels) for s in run.streams.values()) / 2


def test_signs_and_units_are_those_that_the_name_states(plain):
    robot, runs = plain
    factors = {
        "gyro_sign": -1.0,
        "gyro_deg": 180 / math.pi,
        "wheels_kmh": 3.6,
        "camera_kmh": 3.6,
        "wheels_rpm": 9.549,
    }
    channels = {"imu": "gyro_z_radps", "odometry": "speed_x_mps", "wheels": robot.rate_channels[0]}
    for fault in faults_of(robot.drive):
        if fault.name in factors:
            (broken,) = with_fault(runs, fault, robot)
            before, after = (
                r.streams[fault.stream].channel(channels[fault.stream]) for r in (runs[0], broken)
            )
            assert after == pytest.approx(before * factors[fault.name], rel=1e-4)


# -- One blind trial: what it depends on, and what it counts when the diagnosis refuses the runs -----------


def test_cases_take_the_robots_in_turn_and_row_found_every_effect():
    cases = cases_of(Row.FOUND, 70, 7, 8)
    assert [case.robot for case in cases[:4]] == ["agrimaro", "husky"] * 2
    for robot, drive in (("agrimaro", "swerve"), ("husky", "skid_steer")):
        library = [effect for effect in library_of(drive) if not effect.modifies]
        own = [case for case in cases if case.robot == robot]
        assert {case.number // 2 % len(library) for case in own} == set(range(len(library)))


@pytest.mark.slow
def test_a_trial_depends_on_its_seed_and_number_alone():
    cases = cases_of(Row.STRONG, 4, 3, 3)
    one, other = run_trial(cases[1]), run_trial(cases[1])
    assert replace(one, seconds=0.0) == replace(other, seconds=0.0)
    assert run_trial(cases[3]).hidden != one.hidden


def test_refused_runs_count_as_a_false_alarm(monkeypatch):
    def refuse(*_):
        raise DataError("runs: only 2 of 8 are fit to be compared")

    monkeypatch.setattr("studies.blind_trials.trial.diagnose", refuse)
    found = run_trial(cases_of(Row.NONE, 1, 0, 3)[0])
    assert (found.verdict, found.named, found.right) == (Verdict.REFUSED, (), True)
    assert table_of([found])["none: false alarms"].hits == 1


@pytest.mark.parametrize("name", ["drives", "hidden", "limits", "scoring", "trial"])
def test_examples_in_docstrings_hold(name):
    assert doctest.testmod(import_module(f"studies.blind_trials.{name}")).failed == 0
