"""Each row of the trials hides in its logs what it states: seen in the logs themselves."""

import doctest
import math
from functools import cache
from importlib import import_module

import numpy as np
import pytest
from scipy.stats import norm

from studies.blind_trials.drives import (
    CAR_MPS2,
    STEP_HZ,
    car_drives,
    command_drives,
    poor_drives,
    rich_drives,
)
from studies.blind_trials.limits import POWER, TEST_SIZE, Limits, limits_of
from studies.blind_trials.scoring import table_of
from studies.blind_trials.trial import (
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
    Draw,
    Hidden,
    Row,
    as_command_log,
    cases_of,
    faults_of,
    hidden_runs,
    run_trial,
    simulation_of,
    stage_of,
    value_is_right,
)
from terrain.discrepancy.diagnose import POWER_Z, diagnose
from terrain.discrepancy.evidence import Z_EFFECT
from terrain.discrepancy.verdict import Tier
from terrain.effects import effect_named, library_of
from terrain.errors import DataError
from terrain.robots import load_robot

HUSKY, AGRIMARO, CAR = map(load_robot, ("husky", "agrimaro", "adap2e"))
NEW_ROWS = list(Row)[list(Row).index(Row.GROSS) :]
RATE_HZ = 50.0  #: Of the clock on which streams are compared


def staged(row, number, n_runs=3, seed=0):
    """Return a trial before the diagnosis; odd numbers are of the skid-steer robot where a row has both."""
    case = cases_of(row, number + 1, seed, n_runs)[number]._replace(n_runs=n_runs)
    drawn, noise = np.random.SeedSequence([seed, number]).spawn(2)
    return stage_of(case, load_robot(case.robot), np.random.default_rng(drawn), noise)


stage = cache(staged)


def turn(wheels):
    """Return the yaw rate that a skid-steer robot's wheels ask for with the nominal track."""
    return (wheels.channel("speed_right_mps") - wheels.channel("speed_left_mps")) / HUSKY.track_m


def ahead(wheels):
    return (wheels.channel("speed_right_mps") + wheels.channel("speed_left_mps")) / 2


def gyro(imu):
    return imu.channel("gyro_z_radps")


def slope(x, y):
    return float(x @ y / (x @ x))


def on_clock(run, name, signal):
    """Return a signal of a stream on a clock of its run's own."""
    first, last = (end(s.time_s[i] for s in run.streams.values()) for end, i in ((max, 0), (min, -1)))
    time_s = np.arange(first, last, 1.0 / RATE_HZ)
    return np.interp(time_s, run.streams[name].time_s, signal(run.streams[name]))


def median_lag_s(runs, late, reference):
    """Return how far one signal is behind another in most runs, by cross-correlation."""
    lags, shifts = [], np.arange(-30, 31)
    for run in runs:
        one, other = on_clock(run, *late), on_clock(run, *reference)
        same = [one[40 + k : len(one) - 40 + k] @ other[40 : len(other) - 40] for k in shifts]
        lags.append(shifts[int(np.argmax(same))] / RATE_HZ)
    return float(np.median(lags))


@pytest.mark.parametrize(
    "row", [pytest.param(row, marks=[pytest.mark.slow] * (row == "dynamic")) for row in NEW_ROWS]
)
def test_the_same_seed_gives_the_same_trial_and_nothing_of_the_truth_leaks(row):
    made, again = stage(row, 1), staged(row, 1)
    one, two = (
        [part.tobytes() for run in s.runs for x in run.streams.values() for part in (x.time_s, x.values)]
        for s in (made, again)
    )
    assert one == two
    assert made.hidden == again.hidden
    assert not any("truth" in run.streams or run.source for run in made.runs)
    assert not any(name in repr(run) for run in made.runs for name in made.hidden.effects)
    assert len({run.run_id for run in made.runs}) == len(made.runs)


def test_short_runs_are_commands_of_6_s_in_the_drive_layout():
    assert {case.n_runs for case in cases_of(Row.SHORT, 2, 0, 4)} == {SHORT_RUNS}
    runs = stage(Row.SHORT, 0, n_runs=16).runs
    for run in runs:
        assert set(run.streams) == {"wheels", "imu", "lidar"}
        for stream in run.streams.values():
            assert not any("current" in name or "roll" in name for name in stream.channels)
            assert stream.rate_hz == pytest.approx(20.0)
            assert stream.duration_s == pytest.approx(6.0, abs=0.2)
            assert stream.time_s[0] == 0.0
    wheels = [run.streams["wheels"].values for run in runs]
    # one command is held for the second half, and differs from run to run
    assert np.median([x[60:].std(axis=0).max() for x in wheels]) < 0.02
    assert np.std([x[60:].mean() for x in wheels]) > 0.3
    assert np.median([abs(x[0]).max() for x in wheels]) > 0.2  # a run begins at the command before


def test_a_late_logger_or_sensor_is_late_by_what_is_stated_and_no_other_is():
    """Wheels that are stamped late see a turn after the gyro, an IMU that is stamped late before it."""
    late = [stage(Row.LATE, number) for number in range(1, 13, 2)]
    delays = ("latency", "delay", "lag", "backlash")  # beside an effect that is no delay itself
    for made in [made for made in late if not any(word in made.hidden.causes[-1] for word in delays)][:2]:
        late_s = made.asked["late_s"]
        assert (late_s < 0) == (made.asked["variant"] == "wheels")
        assert 0.15 <= abs(late_s) <= 0.4
        assert median_lag_s(made.runs, ("imu", gyro), ("wheels", turn)) == pytest.approx(late_s, abs=0.05)
        assert made.hidden.causes[0] == "clock_offset"
        assert len(made.hidden.causes) == 2
    for number in (1, 3, 5):
        made = stage(Row.SENSOR_LATE, number)
        (late_s,), sensor = made.hidden.effects.values(), made.asked["variant"]
        assert 0.1 <= late_s <= 0.3
        seen = "lidar" if sensor == "lidar" else "odometry"
        gyro_s = median_lag_s(made.runs, ("imu", gyro), ("wheels", turn))
        seen_s = median_lag_s(made.runs, (seen, lambda s: s.channel("speed_x_mps")), ("wheels", ahead))
        assert gyro_s == pytest.approx(late_s * (sensor == "gyro"), abs=0.03)
        assert seen_s == pytest.approx(HUSKY.camera.latency_s + late_s * (sensor != "gyro"), abs=0.04)
        assert made.hidden.causes[0].endswith("_latency")


@pytest.mark.parametrize("number", [0, 1])
def test_stalled_runs_do_not_move_and_their_wheels_turn(number):
    made = stage(Row.STALLED, number)
    assert len(made.asked["stalled"]) == 1
    for run in made.runs:
        odometry, wheels = run.streams["odometry"], run.streams["wheels"]
        names = [n for n in odometry.channels if n in ("speed_x_mps", "position_x_m", "position_y_m")]
        moved = np.array([odometry.channel(n) for n in names])
        if len(names) == 2:  # poses: speeds by differences over 0.2 s
            moved = np.diff(moved[:, ::10], axis=1) * 5.0
        speeds = wheels.values[:, [n.startswith(("speed", "motor")) for n in wheels.channels]]
        per = 1.0 if number else AGRIMARO.wheel_radius_m / AGRIMARO.motors.reduction_ratio
        driven = float(np.sqrt((speeds**2).mean())) * per
        speed = float(np.sqrt((moved**2).sum(axis=0).mean()))
        assert driven > 0.2
        is_stalled = run.run_id in made.asked["stalled"]
        assert speed < 2 * CREEP_RATIO[1] * driven + 0.02 if is_stalled else speed > 0.25 * driven


def test_half_of_the_runs_have_the_effect_and_the_others_have_none(monkeypatch):
    made = stage(Row.HALF, 1)
    present = made.asked["present"]
    assert len(present) == len(made.runs) // 2
    monkeypatch.setattr(Draw, "strong", lambda *_, **__: Hidden(()))
    for run, plain in zip(made.runs, staged(Row.HALF, 1).runs, strict=True):
        pairs = [(stream, plain.streams[name]) for name, stream in run.streams.items()]
        alike = [np.array_equal(a.values, b.values) and np.array_equal(a.time_s, b.time_s) for a, b in pairs]
        assert all(alike) == (run.run_id not in present)


@pytest.mark.parametrize(
    "number", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in range(1, len(KNOWN)))]
)
def test_the_known_truth_is_in_the_logs(number):
    name, beside = [*KNOWN.items()][number]
    made = stage(Row.KNOWN, number, n_runs=60 if number else 16)
    stalled, late_s, slopes = made.asked["stalled"], WHEELS_LATE_S * ("late" in beside), []
    assert (made.asked["variant"], len(stalled)) == (name, N_STALLED * ("stalled" in beside))
    for run in made.runs:
        wheels, imu, lidar = (run.streams[name] for name in ("wheels", "imu", "lidar"))
        asked = np.interp(imu.time_s, wheels.time_s - late_s, turn(wheels))
        if run.run_id not in stalled and np.std(asked) + abs(asked.mean()) > 0.5:
            slopes.append(slope(asked, gyro(imu)))
        if "stalled" in beside and np.std(turn(wheels)) >= 0.1:
            still = abs(slope(turn(wheels), lidar.channel("yaw_rate_radps"))) < 0.05
            assert still == (run.run_id in stalled)
    scatters = "scatter" in beside
    scatter = math.hypot(TRACK_SCATTER * scatters, 0.008)
    assert np.median(slopes) == pytest.approx(1 / (1 + TRACK_ERROR), rel=0.06 if scatters else 0.03)
    assert np.std(np.log(slopes)) == pytest.approx(scatter, rel=0.35, abs=0.02)


# -- The sealed side of the blind trials: its limits agree with the diagnosis' own, and nothing leaks ------


def test_what_is_free_costs_the_information_that_the_inverse_has_not():
    """Two routes: Schur's complement, and rows and columns of the inverse."""
    root = np.random.default_rng(0).standard_normal((4, 6))
    limits = Limits(("a", "b", "c", "d"), root @ root.T)
    left = limits.free("c")
    assert left.names == ("a", "b", "d")
    rest = np.linalg.inv(limits.information)[np.ix_([0, 1, 3], [0, 1, 3])]
    assert np.linalg.inv(left.information) == pytest.approx(rest)


@pytest.fixture(scope="module", params=[HUSKY, AGRIMARO], ids=["husky", "agrimaro"])
def world(request):
    drives = rich_drives(np.random.default_rng(1), 4, 30.0)
    return request.param, drives, limits_of(request.param, drives)


def test_the_cramer_rao_limit_and_the_diagnosis_agree_on_what_can_be_seen(world, monkeypatch):
    """Two routes: true motion and the noise that is put in; logs and the noise that is found in them.

    The first takes noise at one pace, the second knows that it is less in slow turns.
    """
    robot, drives, limits = world
    monkeypatch.setattr("terrain.discrepancy.diagnose.next_drive", lambda *_: None)  # it takes long
    runs = hidden_runs(robot, drives, np.random.SeedSequence(4), {})
    detected = {
        own.name: own.detection_limit for own in diagnose(runs, simulation_of(robot)).detection_limits
    }
    per_std = norm.isf(TEST_SIZE / 2 / limits.library_size) + norm.ppf(POWER)
    std = dict(zip(limits.names, 1 / np.sqrt(np.maximum(np.diag(limits.information), 1e-300)), strict=True))
    ratios = []
    for effect in library_of(robot.drive):
        if effect.modifies:
            assert all(math.isinf(detected[p.name]) for p in effect.parameters)
            continue
        assert limits.of(effect) == pytest.approx(per_std * std[effect.parameters[0].name])
        ratios += [detected[p.name] / (Z_EFFECT + POWER_Z) / std[p.name] for p in effect.parameters]
    assert np.mean(np.abs(np.array(ratios) - 1) < 0.4) > 0.85, ratios
    assert all(0.4 < ratio < 2.5 for ratio in ratios), ratios


def test_limits_fall_with_more_runs_and_rise_where_little_is_driven(world):
    robot, drives, limits = world
    half = limits_of(robot, drives._replace(twists=drives.twists[:2], hills=drives.hills[:2]))
    poor = limits_of(robot, poor_drives(np.random.default_rng(1), 2, 30.0))
    for effect in library_of(robot.drive):
        assert limits.of(effect) < half.of(effect) or effect.modifies
    shown = effect_named("steering_delay" if robot is AGRIMARO else "turning_slip")
    assert poor.of(shown) > 3 * half.of(shown)
    lever = effect_named("lever_arm")
    own = np.diag(limits.part(lever, lever))
    along = limits.of(lever, np.array([0.0, 1.0]))
    assert along / limits.of(lever) == pytest.approx(math.sqrt(own[0] / own[1]))


# -- Which effects a trial may hide together ---------------------------------------------------------------


@pytest.mark.parametrize("least", [0.0, 1e-320, 1e-12])
def test_an_effect_that_drives_hardly_show_is_like_none_that_they_show(least):
    payload, drag, scrub = effects = [effect_named(name) for name in ("payload", "turn_drag", "scrub")]
    limits = Limits(tuple(e.parameters[0].name for e in effects), np.diag([100.0, least, least]))
    assert not limits.alike(payload, drag)
    assert limits.alike(drag, scrub)
    assert not limits.spanned((payload, drag), scrub)


def test_a_run_that_stands_shows_little_and_spoils_nothing_and_equal_latencies_are_a_clock_offset():
    """One command of eighty may be next to none."""
    drives = command_drives(np.random.default_rng(0), HUSKY, 3)
    standing = tuple(np.zeros_like(twist) if i == 1 else twist for i, twist in enumerate(drives.twists))
    moved = limits_of(HUSKY, drives._replace(twists=drives.twists[::2], hills=drives.hills[::2]))
    limits, radius = limits_of(HUSKY, drives._replace(twists=standing)), effect_named("wheel_radius")
    assert np.isfinite(limits.information).all()
    assert limits.part(radius, radius) == pytest.approx(moved.part(radius, radius), rel=1e-3)
    pair = effect_named("imu_latency"), effect_named("camera_latency")
    assert limits.spanned(pair, effect_named("clock_offset"))
    assert not limits.spanned(pair, effect_named("payload"))
    assert not limits.alike(pair[0], effect_named("clock_offset"))


def test_drives_of_a_car_keep_to_what_it_can_and_part_stiffness_from_a_slide_on_side_slopes():
    drives = car_drives(np.random.default_rng(0), CAR, 3, 60.0)
    for twist in drives.twists:
        speed, turn = twist[:, 0], twist[:, 2]
        assert speed.min() < 0.0 < 1.5 < speed.max() <= 0.5 * CAR.speed_max_mps
        assert not twist[-1].any()
        assert np.abs(np.diff(speed)).max() * STEP_HZ <= CAR_MPS2 + 1e-9
        curvature = turn[speed != 0.0] / speed[speed != 0.0]
        assert np.abs(curvature).max() < np.tan(CAR.steering_max_rad) / CAR.wheelbase_m
    limits = limits_of(CAR, drives)
    stiffness, slide = effect_named("cornering_stiffness"), effect_named("side_hill_slip")
    assert not limits.alike(stiffness, slide)
    for over, explained in ((3.0, False), (0.01, True)):
        hidden = {"cornering_stiffness_ratio": over * limits.of(stiffness)}
        assert limits.in_place_of(stiffness, hidden, slide) == explained


# -- A robot of known truth in short runs, and one of which nothing is wrong -------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1, len(KNOWN) - 1], ids=["plain", "scatter", "all"])
def test_a_track_that_is_two_and_a_half_times_as_wide_is_named_in_short_runs(number):
    trial = run_trial(Case(Row.KNOWN, number, "husky", SHORT_RUNS, 0))
    assert TRACK in trial.named
    assert trial.right
    assert value_is_right(trial.intervals)
    _, low, high = trial.intervals[TRACK_RATIO]
    # the mean of runs that scatter is no constant to be met
    assert low < TRACK_ERROR < high or number > 0
    # that scatter is of the track, and of no effect that is like it in turns of one speed
    assert all(TRACK in (each.name, *each.rivals) for each in trial.varying)
    assert set(trial.stalled) <= set(trial.excluded)
    assert len(trial.excluded) <= len(trial.stalled) + 1


def test_short_runs_in_which_nothing_is_hidden_have_no_cause():
    drives = command_drives(np.random.default_rng(0), HUSKY, 16)
    runs = hidden_runs(HUSKY, drives, np.random.SeedSequence(0), {}, heading=True)
    answer = diagnose(tuple(map(as_command_log, runs)), simulation_of(HUSKY))
    assert answer.verdict in (None, Tier.NOT_SHOWN, Tier.CANDIDATE)
    assert (answer.causes, answer.ambiguous_sets, answer.varying, answer.faults) == ((), (), (), ())
    assert len(answer.excluded_runs) <= 1  # a command may leave a wheel as fast as the one before


# -- Faults written into logs: each is in the log, on the robots that show it --------------------------------

FACTORS = {
    "gyro_sign": -1.0,
    "gyro_deg": 180 / math.pi,
    "wheels_kmh": 3.6,
    "camera_kmh": 3.6,
    "wheels_rpm": 9.549,
}


@pytest.mark.parametrize("robot", [HUSKY, AGRIMARO], ids=["husky", "agrimaro"])
def test_a_fault_changes_its_channels_and_no_others_by_what_its_name_states(robot):
    (run,) = hidden_runs(robot, rich_drives(np.random.default_rng(1), 1, 20.0), np.random.SeedSequence(2), {})
    channels = {"imu": "gyro_z_radps", "odometry": "speed_x_mps", "wheels": robot.rate_channels[0]}
    every = [(name, channel) for name, stream in run.streams.items() for channel in stream.channels]
    for fault in faults_of(robot.drive):
        broken = fault.written(run, robot)
        values = {at: [r.streams[at[0]].channel(at[1]) for r in (run, broken)] for at in every}
        changed = [at for at, (before, after) in values.items() if not np.array_equal(before, after)]
        assert {name for name, _ in changed} == {fault.stream}
        assert len(changed) < len(every) / 2
        if fault.name in FACTORS:
            before, after = values[fault.stream, channels[fault.stream]]
            assert after == pytest.approx(before * FACTORS[fault.name], rel=1e-4)


# -- One blind trial: what it depends on, and what it counts when the diagnosis refuses the runs -----------


@pytest.mark.slow
def test_a_cause_that_squares_do_not_show_earns_its_name_where_noise_is_left():
    """A dead zone of 2 mm/s, 3 % of the square of a yaw rate, beside wheels that slip."""
    trial = run_trial(cases_of(Row.TWO, 12, 90420, 8)[11])
    assert (trial.right, set(trial.named)) == (True, {"wheel_dead_zone", "ground_slip"})


def test_refused_runs_count_as_a_false_alarm(monkeypatch):
    def refuse(*_):
        raise DataError("runs: only 2 of 8 are fit to be compared")

    monkeypatch.setattr("studies.blind_trials.trial.diagnose_runs", refuse)
    trial = run_trial(cases_of(Row.NONE, 1, 0, 3)[0])
    assert (trial.verdict, trial.named, trial.right) == (None, (), True)
    assert table_of([trial])["none: false alarms"].hits == 1


@pytest.mark.parametrize("name", ["drives", "limits", "scoring", "trial"])
def test_examples_in_docstrings_hold(name):
    assert doctest.testmod(import_module(f"studies.blind_trials.{name}")).failed == 0
