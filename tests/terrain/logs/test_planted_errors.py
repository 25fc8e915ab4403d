"""Errors of unit, sign, axis and size, planted in simulated runs of every kind of drive, and what is stated.

Each run is sound as it is, so that what is found is the error; the robot of the run is the one that was simulated, but
where another is planted.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.data.datasets import verdict, verdicts_of
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

DEGREE = np.pi / 180.0
DRIVES = {
    "husky": ("grass", "complex"),
    "orchard_ugv": ("grass", "complex"),
    "agrimaro": ("grass", "complex"),
    "robotino": ("tiles", "complex"),
    "adap2e": ("grass", "complex"),
    "pallet_truck": ("tiles", "survey"),
}


def judged(run, robot=None):
    """Return the checks of a run as a reader gives it, with the speeds of wheels whose motors are logged."""
    robot = robot or load_robot(run.robot)
    return verdict(with_wheel_speeds(run, robot), robot)


@cache
def sound(robot):
    run = simulate_run(load_robot(robot), *DRIVES[robot], 0, 1, duration_s=40.0)
    return replace(run, streams={name: run.streams[name] for name in run.streams if name != "truth"})


def scaled(stream, factor, *starts):
    """Return what multiplies the channels of a stream that begin with some words."""

    def change(run):
        old = run.streams[stream]
        by = [factor if name.startswith(starts) else 1.0 for name in old.channels]
        return replace(run, streams={**run.streams, stream: replace(old, values=old.values * by)})

    return change


def exchanged(stream, *pairs):
    """Return what exchanges channels of a stream, two and two."""

    def change(run):
        old = run.streams[stream]
        new = dict(zip(old.channels, old.channels, strict=True))
        for a, b in pairs:
            new[a], new[b] = b, a
        values = old.columns([new[name] for name in old.channels])
        return replace(run, streams={**run.streams, stream: replace(old, values=values)})

    return change


def without(stream, channel):
    def change(run):
        old = run.streams[stream]
        kept = [name for name in old.channels if name != channel]
        return replace(
            run, streams={**run.streams, stream: Stream(old.time_s, old.columns(kept), tuple(kept))}
        )

    return change


def shifted(stream, channel, by):
    def change(run):
        old = run.streams[stream]
        values = old.values + by * (np.array(old.channels) == channel)
        return replace(run, streams={**run.streams, stream: replace(old, values=values)})

    return change


def retimed(factor):
    def change(run):
        streams = {name: replace(each, time_s=each.time_s * factor) for name, each in run.streams.items()}
        return replace(run, streams=streams)

    return change


def rolling(run):
    """Return a run over slopes to either side, as its IMU shows them."""
    old = run.streams["imu"]
    roll_rad = 0.12 * np.sin(0.4 * old.time_s)
    rate_radps = 0.12 * 0.4 * np.cos(0.4 * old.time_s)
    added = {"roll_rad": roll_rad, "gyro_x_radps": rate_radps, "accel_y_mps2": 9.81 * np.sin(roll_rad)}
    values = old.values + np.column_stack([added.get(name, 0.0 * roll_rad) for name in old.channels])
    return replace(run, streams={**run.streams, "imu": replace(old, values=values)})


def later(seconds, *names):
    """Return what adds to the time of some streams, or of the second half of all where none is named."""

    def change(run):
        streams = {}
        for name, each in run.streams.items():
            moved = each.time_s >= each.time_s[len(each) // 2] if not names else name in names
            streams[name] = replace(each, time_s=each.time_s + seconds * moved)
        return replace(run, streams=streams)

    return change


def both(*changes):
    def change(run):
        for each in changes:
            run = each(run)
        return run

    return change


def all_fixed(run):
    """Return a run whose receiver has an RTK fix, with the code of NMEA for it."""
    old = run.streams["gnss"]
    values = np.where(np.array(old.channels) == "fix_ratio", 4.0, old.values)
    return replace(run, streams={**run.streams, "gnss": replace(old, values=values)})


BAD, ODD = "implausible", "doubtful"
WEST = scaled("gnss", -1.0, "position_x", "velocity_x")
NORTH = ("position_x_m", "position_y_m"), ("velocity_x_mps", "velocity_y_mps")
PLANTED = [
    # robot, what is done, how bad it is, what is stated of it
    ("husky", scaled("imu", 1 / DEGREE, "gyro"), BAD, "a gyro in deg/s read as rad/s?"),
    ("husky", scaled("imu", 1 / 9.81, "accel"), BAD, "an accelerometer in g read as m/s^2?"),
    ("husky", scaled("imu", -1.0, "accel_z"), BAD, "z points down?"),
    ("husky", scaled("imu", -1.0, "gyro_z"), BAD, "turned sign of the gyro, or sides swapped"),
    ("husky", exchanged("wheels", ("speed_left_mps", "speed_right_mps")), BAD, "sides swapped"),
    ("husky", scaled("wheels", 1 / 0.165, "speed"), BAD, "rad/s or km/h read as m/s?"),
    ("husky", scaled("wheels", 3.6, "speed"), ODD, "rad/s or km/h read as m/s?"),
    ("husky", scaled("wheels", 1e3, "current"), BAD, "in mA?"),
    ("husky", retimed(1e3), BAD, "ms read as s?"),
    ("husky", scaled("imu", -1.0, "accel_x", "accel_y", "gyro_x"), BAD, "pitch_rad of imu is -0.8"),
    ("adap2e", scaled("imu", -1.0, "accel_x", "accel_y", "gyro_x"), ODD, "a turned x axis of the IMU?"),
    ("husky", scaled("odometry", 3.6, "speed"), BAD, "km/h?"),
    ("husky", scaled("odometry", 1e3, "speed"), BAD, "mm?"),
    ("husky", scaled("odometry", -1.0, "speed"), BAD, "odometry moves against the wheels"),
    ("husky", exchanged("odometry", ("speed_x_mps", "speed_y_mps")), BAD, "axes exchanged"),
    ("husky", scaled("imu", 1 / DEGREE, "yaw"), BAD, "the yaw of imu is"),
    ("agrimaro", scaled("imu", 1 / DEGREE, "roll", "pitch"), BAD, "in degrees?"),
    ("agrimaro", lambda run: scaled("imu", -1.0, "roll")(rolling(run)), BAD, "roll_rad of imu is -0.9"),
    ("agrimaro", lambda run: scaled("imu", 1 / DEGREE, "roll")(rolling(run)), BAD, "in degrees?"),
    (
        "agrimaro",
        lambda run: scaled("imu", 1 / DEGREE, "gyro_x")(rolling(run)),
        BAD,
        "a gyro in deg/s read as rad/s?",
    ),
    ("agrimaro", lambda run: scaled("imu", -1.0, "gyro_x")(rolling(run)), BAD, "a turned axis of the gyro"),
    ("orchard_ugv", scaled("pose", 1e3, "position"), BAD, "speed: that of pose is 99"),
    ("orchard_ugv", scaled("pose", 1e2, "position"), BAD, "cm?"),
    (
        "orchard_ugv",
        scaled("pose", 1 / DEGREE, "yaw"),
        BAD,
        "the yaw rate of pose is 57.3 times that of the gyro",
    ),
    ("orchard_ugv", scaled("pose", -1.0, "yaw"), BAD, "the yaw rate of pose is -1 times"),
    ("orchard_ugv", shifted("pose", "yaw_rad", np.pi / 2), BAD, "a yaw off by 90 degrees?"),
    ("orchard_ugv", shifted("pose", "yaw_rad", np.pi), BAD, "a yaw off by 180 degrees?"),
    ("orchard_ugv", exchanged("gnss", *NORTH), BAD, "x and y exchanged (x is east, y north)"),
    ("orchard_ugv", exchanged("gnss", NORTH[0]), BAD, "latitude and longitude exchanged?"),
    ("orchard_ugv", scaled("gnss", -1.0, "velocity_x"), BAD, "a course that is not from north, clockwise"),
    ("husky", without("wheels", "speed_right_mps"), ODD, "'wheels' lacks speed_right_mps"),
    ("orchard_ugv", scaled("gnss", 1 / 111_000.0, "position"), BAD, "in degrees?"),
    ("orchard_ugv", scaled("gnss", 1e3, "position"), BAD, "mm?"),
    ("orchard_ugv", scaled("gnss", 3.6, "velocity"), BAD, "km/h?"),
    ("orchard_ugv", scaled("gnss", 1.9438, "velocity"), ODD, "knots?"),
    ("orchard_ugv", all_fixed, BAD, "codes of NMEA"),
    ("orchard_ugv", scaled("gnss", 1e3, "std"), ODD, "in mm or cm?"),
    ("orchard_ugv", scaled("compass", -1.0, "yaw"), BAD, "the yaw rate of compass is -1 times"),
    ("agrimaro", scaled("steering", 1 / DEGREE, "angle"), BAD, "in degrees?"),
    ("agrimaro", scaled("steering", -1.0, "angle"), BAD, "a turned sign of the steering"),
    ("agrimaro", scaled("wheels", 0.1, "motor"), BAD, "before or after the reduction"),
    (
        "agrimaro",
        scaled("wheels", 60 / (2 * np.pi), "motor"),
        ODD,
        "that of the wheels, 0.56 to 1.8 is expected",
    ),
    ("agrimaro", scaled("odometry", 1e3, "velocity"), BAD, "mm?"),
    ("robotino", scaled("wheels", 1 / 16.0, "motor"), BAD, "before or after the reduction"),
    ("robotino", scaled("pose", 1e3, "position"), BAD, "mm?"),
    ("robotino", scaled("pose", -1.0, "yaw"), BAD, "a turned sign"),
    ("robotino", shifted("pose", "yaw_rad", np.pi / 2), BAD, "turned by"),
    ("adap2e", scaled("steering", 1 / DEGREE, "angle"), BAD, "in degrees?"),
    ("adap2e", scaled("steering", -1.0, "angle"), BAD, "a turned sign of the steering"),
    ("adap2e", scaled("imu", 1 / DEGREE, "gyro"), BAD, "degrees?"),
    ("adap2e", scaled("imu", -1.0, "gyro_z"), BAD, "a turned sign"),
    ("adap2e", scaled("wheels", 3.6, "speed"), ODD, "speed: that of the wheels is 4."),
    ("pallet_truck", exchanged("gnss", *NORTH), BAD, "x and y exchanged"),
    ("adap2e", WEST, BAD, "the turn of the course of the velocity of gnss is -1 times that of the gyro"),
    ("orchard_ugv", scaled("gnss", 1.556, "position_x"), ODD, "without the cosine of the latitude"),
    ("adap2e", shifted("compass", "yaw_rad", np.pi / 2), BAD, "a yaw off by 90 degrees?"),
    ("adap2e", shifted("compass", "yaw_rad", np.pi), BAD, "a yaw off by 180 degrees?"),
    ("husky", scaled("wheels", -1.0, "speed_left"), BAD, "a turned sign of one side?"),
    ("orchard_ugv", scaled("wheels", -1.0, "speed_right"), BAD, "a turned sign of one side?"),
    ("husky", scaled("wheels", -1.0, "current"), ODD, "motors brake at 100 % of the points"),
    ("adap2e", scaled("wheels", -1.0, "current"), ODD, "motors brake at"),
    ("husky", scaled("wheels", 2.0, "speed"), ODD, "0.56 to 1.8 is expected: wheels that slip, or"),
    ("adap2e", exchanged("imu", ("accel_x_mps2", "accel_y_mps2")), ODD, "x and y exchanged?"),
    (
        "husky",
        later(4.0, "imu"),
        ODD,
        "the turn of the wheels and the gyro agree when shifted by -4.0 s: clocks apart, or a delay?",
    ),
    ("adap2e", later(5.0, "gnss"), ODD, "s: clocks apart, or a delay?"),
    ("orchard_ugv", later(3600.0, "pose"), ODD, "stream 'pose' is at no time at which"),
    ("husky", later(3600.0), ODD, "no stream has a sample for 3600 s: two runs in one"),
    ("pallet_truck", scaled("odometry", 3.6, "speed"), BAD, "km/h?"),
]


def test_turns_of_a_few_degrees_a_second_tell_a_turned_sign():
    """A car that is hardly steered; the offset of a gyro is no turn."""
    run = simulate_run(load_robot("adap2e"), "grass", "survey", 80001, 1, duration_s=60.0)
    run = replace(run, streams={name: run.streams[name] for name in run.streams if name != "truth"})
    assert float(run.streams["imu"].channel("gyro_z_radps").std()) < 0.05
    biased = shifted("imu", "gyro_z_radps", 0.02)
    for change, level in ((biased, set()), (both(biased, scaled("steering", -1.0, "angle")), {BAD})):
        odd = [check for check in judged(change(run)) if check.level in (BAD, ODD)]
        assert {str(check.level) for check in odd} == level, odd


def test_a_robot_that_spins_its_wheels_slides_or_digs_in_is_not_doubted():
    """Slip is not one factor at every moment, and a robot that slides has no axis ahead."""
    for robot, terrain, scenario in (
        ("omnirobot", "grass", "survey"),
        ("robotino", "clay", "complex"),
        ("pallet_truck", "tilled_loam", "survey"),
        ("robotino", "firm_soil_gravel", "spot_turn"),
    ):
        run = simulate_run(load_robot(robot), terrain, scenario, 80000, 1, duration_s=40.0, vary=True)
        run = replace(run, streams={name: run.streams[name] for name in run.streams if name != "truth"})
        assert [check for check in judged(run) if check.level in (BAD, ODD)] == []


def test_a_sound_run_over_slopes_has_no_doubt():
    assert {
        str(check.level)
        for check in judged(rolling(sound("agrimaro")))
        if check.check in ("attitude", "tilt")
    } == {"ok"}


@pytest.mark.parametrize("robot", DRIVES)
def test_a_sound_run_of_each_drive_has_no_doubt(robot):
    assert [check for check in judged(sound(robot)) if check.level in (BAD, ODD)] == []


@pytest.mark.parametrize(("robot", "plant", "level", "sentence"), PLANTED)
def test_a_planted_error_is_refused_or_stated_in_a_sentence_that_names_it(robot, plant, level, sentence):
    run = plant(sound(robot))
    stated = [check for check in judged(run) if check.level in (BAD, ODD)]
    assert any(sentence in check.sentence for check in stated if check.level == level), stated


@pytest.mark.parametrize(
    ("robot", "terrain", "scenario"), [("robotino", "dry_sand", "brake"), ("husky", "grass", "stand")]
)
def test_wheels_that_spin_or_stand_are_never_refused(robot, terrain, scenario):
    """Omni wheels slip by 0.98 in sand: wheels that are faster than the ground are at most doubtful."""
    run = simulate_run(load_robot(robot), terrain, scenario, 7, 6, duration_s=25.0)
    assert BAD not in {check.level for check in judged(run)}


@pytest.mark.parametrize("stream", ["compass", "gnss", "imu", "pose", "wheels"])
def test_a_sensor_without_a_finite_value_is_no_error(stream):
    old = sound("orchard_ugv").streams[stream]
    dead = replace(old, values=np.full_like(old.values, np.nan))
    run = sound("orchard_ugv")
    checks = judged(replace(run, streams={**run.streams, stream: dead}))
    assert BAD not in {check.level for check in checks}


@pytest.mark.parametrize("plant", [scaled("odometry", 3.6, "speed"), scaled("odometry", -1.0, "speed")])
def test_runs_of_seconds_show_together_what_none_of_them_shows(plant):
    """Pieces of 6 s of a run; sound ones have no doubt, of one alone nothing is certain."""
    whole, pieces = sound("husky"), []
    for k in range(6):
        streams = {}
        for name, stream in whole.streams.items():
            rows = (stream.time_s >= 6.0 * k) & (stream.time_s < 6.0 * (k + 1))
            streams[name] = replace(stream, time_s=stream.time_s[rows], values=stream.values[rows])
        pieces.append(replace(whole, run_id=f"piece_{k}", streams=streams))
    motion = ("speed", "turns", "direction")
    for runs, level in ((pieces, set()), ([plant(run) for run in pieces], {BAD})):
        found = [check for checks in verdicts_of(runs).values() for check in checks if check.check in motion]
        odd = [check for check in found if check.level in (BAD, ODD)]
        assert {str(check.level) for check in odd if check.sentence.startswith("over 6 runs, ")} == level
        assert all(check.level == ODD for check in odd if not check.sentence.startswith("over"))


@pytest.mark.parametrize(
    ("robot", "change", "sentence"),
    [
        (
            "husky",
            {"track_m": 2.8},
            "another track?",
        ),  # its effective track is less than half of the described
        ("robotino", {"wheel_radius_m": 0.02}, "speed: that of pose is 1.99"),
        ("adap2e", {"wheelbase_m": 0.3}, "turns: the yaw rate of the wheels is "),
    ],
)
def test_a_robot_of_another_size_than_the_logs_is_stated(robot, change, sentence):
    other = replace(load_robot(robot), **change)
    stated = [check for check in judged(sound(robot), other) if check.level in (BAD, ODD)]
    assert any(sentence in check.sentence for check in stated), stated
