"""Each row of the trials hides in its logs what it states: seen in the logs themselves."""

import math
from itertools import count

import numpy as np
import pytest

from studies.blind_trials.hidden import (
    CREEP_RATIO,
    KNOWN,
    N_STALLED,
    SHORT_RUNS,
    TRACK_ERROR,
    TRACK_SCATTER,
    WHEELS_LATE_S,
    Case,
    Row,
    cases_of,
    dynamic_runs,
    setting_of,
)
from studies.blind_trials.limits import Limits
from studies.blind_trials.trial import GROSS, stage_of
from terrain.effects import BOUNDS, effect_named
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


def test_averages_of_a_command_log_keep_the_integral_of_a_signal():
    """What is logged at 20 Hz turns as far as what was simulated: no speed is lost or aliased."""
    made = stage(Row.KNOWN, 0)
    for run in made.runs[:10]:
        turned = [
            np.trapezoid(run.streams[name].channel(channel), run.streams[name].time_s)
            for name, channel in (("imu", "gyro_z_radps"), ("lidar", "yaw_rate_radps"))
        ]
        assert turned[0] == pytest.approx(turned[1], abs=0.08)


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


def test_the_sensors_are_late_in_turn():
    assert [stage(Row.SENSOR_LATE, n, 3).variant for n in range(6)] == [
        *("gyro", "gyro", "camera", "camera", "gyro", "lidar"),
    ]


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


@pytest.mark.slow
def test_trials_of_the_dynamic_simulation_take_every_setting_in_turn():
    settings = [setting_of(number) for number in range(60)]
    assert {s.scenario for s in settings} == {"complex", "starts", "survey"}
    assert sum(s.hides for s in settings) == 30
    assert all(settings.count(s) == 5 for s in settings)
    quiet, hides = stage(Row.DYNAMIC, 2, 8), stage(Row.DYNAMIC, 3, 8)
    assert quiet.hidden.causes == ()
    assert hides.hidden.causes == ("wheel_radius",)
    assert quiet.variant == hides.variant == "starts"
    assert len(quiet.runs) == 6  # as the command, which holds two of eight out
    assert not {case.robot for case in cases_of(Row.DYNAMIC, 3, 0, 8)} - {"agrimaro"}


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


def test_what_the_logs_do_not_show_is_no_twin_of_what_they_show():
    """Logs of the DRIVE layout have no currents and no tilt."""
    limits = stage(Row.SHORT, 0).limits
    track, motor, accel = (effect_named(n) for n in ("effective_track", "motor_constant", "accel_bias"))
    assert math.isinf(limits.of(motor))
    assert not limits.alike(track, motor)
    assert limits.alike(motor, accel)
    assert not limits.alike(track, effect_named("gyro_scale"))  # the lidar has a heading of its own


def test_short_rows_are_of_the_skid_steer_robot_whatever_is_asked_for():
    for row in (Row.SHORT, Row.KNOWN):
        assert cases_of(row, 2, 5, 8) == [Case(row, n, "husky", SHORT_RUNS, 5) for n in range(2)]
