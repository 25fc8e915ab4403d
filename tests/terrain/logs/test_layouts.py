"""Published layouts: each is written with a known motion, read back, damaged, and compared with the measured logs."""

import csv
import gzip
import json
import math
from collections import Counter

import numpy as np
import pytest

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.kinematics.wheels import rolling_matrix
from terrain.logs.drive import LOST, NOT_RECORDED, STILL, STREAMS
from terrain.logs.imu_axes import GYRO_IN_DEGREES, GYRO_TURNED, NO_SIGN, POWER_SIGN, TURNED, current_sign
from terrain.logs.robotino import BLIND, HELD, SCALED
from terrain.logs.run_folders import data_digest, write_run
from terrain.robots import load_robot

from .held_poses import PERIOD_S, N, published_pose

BAD_CELL, BAD_TIME, DEAD = "cells that are no number", "rows with a bad time", "channels with nothing finite"
SKIPPED = "skipped"  # the whole run, by a repair
HUSKY_RADIUS_M, PIXEL_M = 0.165, 0.0018
WARTHOG, ROBOTINO = load_robot("warthog"), load_robot("robotino")
WINDOW_COLUMNS = (
    *("step", "window", "steady", "time", "cmd_left", "cmd_right", "wheel_left", "wheel_right"),
    *("icp_x", "icp_y", "icp_z", "icp_roll", "icp_pitch", "icp_yaw", "imu_yaw", "imu_ax", "imu_ay", "imu_az"),
)
MOTOR_COLUMNS = (
    *("t", "xsetspeed", "ysetspeed", "setvel", "m1setvel", "m2setvel", "m3setvel"),
    *("m1pos", "m2pos", "m3pos", "m1vel", "m2vel", "m3vel", "m1cur", "m2cur", "m3cur"),
    *("xcur", "ycur", "rotcur", "xpos", "ypos", "ang", "dx", "dy", "dang"),
)
TRIALS = """\
trial_num,beta,slip,Vry,avg_Vx,std_Vx,avg_Vry,std_Vry,avg_Fx,std_Fx,avg_Fy,std_Fy,avg_Fz,std_Fz,avg_angle,avg_Z,std_Z
1.0,0.0,-1.0,0.0,10.0,0.2,0.0,0.0,0.5,0.6,41.0,5.4,-20.5,0.9,0.0,-50.0,0.01
2.0,90.0,0.5,20.0,10.0,0.2,20.0,0.3,40.0,3.5,-3.0,0.9,-14.0,0.5,90.1,-70.0,0.4
1.0,30.0,0.0,10.0,10.0,0.2,10.0,0.3,10.0,1.0,4.0,0.9,-22.0,0.2,30.0,-21.0,0.0
"""


def held(values, every):
    return values[np.arange(len(values)) // every * every]


def windows(steps=3, seed=0, twist=(0.5, 0.0, 0.4)):
    """Return the columns of a session: three windows a command; wheels new every second sample, as published."""
    rng = np.random.default_rng(seed)
    rows = []
    for window in range(3 * steps):
        step, part = divmod(window, 3)
        pose = published_pose(*twist, rng.uniform(-3.0, 3.0))
        wheels = rng.normal(3.0, 0.1, (N // 2, 2)).repeat(2, axis=0)
        imu = rng.normal([0.4, 1.0, 2.0, 9.8], 0.1, (N, 4))
        # the first window of a command still has the number of the one before, as a third of them do
        number = max(step - 1, 0) if part == 0 else step
        head = np.column_stack([np.tile([number, window, int(part > 0)], (N, 1)), np.arange(N) * PERIOD_S])
        commands = np.tile([2.0 + step, 4.0], (N, 1))
        rows.append(np.column_stack([head, commands, wheels, pose[:, :2], np.zeros((N, 3)), pose[:, 2], imu]))
    return dict(zip(WINDOW_COLUMNS, np.concatenate(rows).T.copy(), strict=True))


def recording(steps=((0, "", 8.0), (1, "idle", 3.0), (1, "calib", 6.0), (2, "calib", 6.0)), seed=0):
    """Return the columns of a robot whose speed and yaw rate are sines of the time."""
    rng = np.random.default_rng(seed)
    n = [round(duration_s / PERIOD_S) for *_, duration_s in steps]
    t = PERIOD_S * np.arange(sum(n))
    state = np.repeat([state for _, state, _ in steps], n)
    speed = np.where(state == "idle", 0.0, 0.8 + 0.4 * np.sin(0.9 * t))
    rate = np.where(state == "idle", 0.0, 0.3 * np.sin(0.6 * t))
    yaw = np.cumsum(rate) * PERIOD_S
    place = np.cumsum(speed * np.exp(1j * yaw)) * PERIOD_S
    left, right = (held((speed + s * rate * 0.9) / WARTHOG.wheel_radius_m, 5) for s in (-1, 1))
    columns = {"time": t, "calib_state": state, "calib_step": np.repeat([step for step, *_ in steps], n)}
    columns |= {
        "meas_left_vel": left,
        "meas_right_vel": right,
        "cmd_vel_x": np.where(state == "calib", 0.8, 0.0),
    }
    columns |= dict.fromkeys(("cmd_vel_omega", "icp_pos_z", "icp_quat_x", "icp_quat_y"), np.zeros(len(t)))
    columns |= {"icp_pos_x": held(place.real, 2), "icp_pos_y": held(place.imag, 2)}
    columns |= {"icp_quat_z": held(np.sin(yaw / 2), 2), "icp_quat_w": held(np.cos(yaw / 2), 2)}
    gyro, accel = (0.0, 0.0, rate), (np.gradient(speed, PERIOD_S), speed * rate, 9.81)
    for i, axis in enumerate("xyz"):
        columns[f"imu_{axis}"] = gyro[i] + rng.normal(0.0, 0.005, len(t))
        columns[f"imu_acceleration_{axis}"] = accel[i] + rng.normal(0.0, 0.1, len(t))
    columns |= {"left_wheel_voltage": np.full(len(t), 48.0), "right_wheel_voltage": np.full(len(t), 48.1)}
    columns |= {
        "left_wheel_current": held(6.0 - 10.0 * rate, 20),
        "right_wheel_current": held(1.0 + 12.0 * rate, 20),
    }
    return columns


def motors(twist=(0.08, 0.06, 0.0), slip=0.2, heading=0.3, n=120, scale=1.0137):
    """Return what the logger writes of a robot that slips alike in all directions, as it turns and drives."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.029, 0.033, n))
    rolling = rolling_matrix(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad)
    motor = 16.0 / 0.04 * np.array(twist) @ rolling.T
    yaw = heading + (1 - slip) * twist[2] * t
    step = np.exp(1j * yaw) * complex(twist[0], twist[1]) * (1 - slip)
    place = np.concatenate([[0], np.cumsum((step[1:] + step[:-1]) / 2 * np.diff(t))]) + 1.5 - 0.7j
    columns = dict.fromkeys(MOTOR_COLUMNS, 0.0)
    columns |= dict(zip(MOTOR_COLUMNS, (t * 1e3, *twist, *motor), strict=False))
    for i in range(3):  # counts have a clock of their own
        columns[f"m{i + 1}pos"] = np.round(np.floor(t / 0.0187) * 0.0187 * motor[i] * 2000 / (2 * np.pi))
        columns[f"m{i + 1}vel"], columns[f"m{i + 1}cur"] = motor[i] * scale, 0.4 + 0.1 * i
    columns |= {"xpos": place.real / PIXEL_M, "ypos": -place.imag / PIXEL_M, "ang": np.degrees(yaw) - 90.0}
    return {name: np.broadcast_to(np.asarray(each, float), n).copy() for name, each in columns.items()}


def save(path, columns, head=0, delimiter=",", end=""):
    """Write columns as packed rows below some lines of a head."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [delimiter.join(map(str, row)) + end for row in zip(*columns.values(), strict=True)]
    line = delimiter.join(columns) + end
    path.write_bytes(gzip.compress("\n".join([line] * (head + 1) + rows + [""]).encode()))


SAVED = {
    "drive": (windows, "log/samples.csv.gz", {}),
    "drive-recording": (recording, "warthog_wet_grass/first.csv.gz", {}),
    "robotino": (motors, "one_surface/moss/exp07.csv.gz", {"head": 2, "delimiter": ";", "end": ";"}),
}


@pytest.fixture
def write(tmp_path):
    """Return what writes columns of a layout, as changed, and gives the folder of the data."""

    def apply(layout, change=None, columns=None, place=None):
        make, file, form = SAVED[layout]
        columns = make() if columns is None else columns
        if change is not None:
            change(columns)
        data = tmp_path / layout
        save(data / (place or file), columns, **form)
        if layout == "robotino":
            scale = json.dumps({f"pixel_resolution_{axis}": PIXEL_M * 1e3 for axis in "xy"})
            (data / "camera_params.json").write_text(scale)
        return data / "log" if layout == "drive" and place is None else data

    return apply


@pytest.fixture
def testbed(tmp_path):
    folder = tmp_path / "testbed"
    folder.mkdir()
    (folder / "smooth.csv").write_text(TRIALS)
    return folder


TEXTS = {
    "borealtc": "SNOW/imu_01.csv",
    "testbed": "smooth.csv",
}  # layouts of plain text, with the file that is changed


@pytest.fixture
def make(request, write, edit):
    """Return what makes the data of any layout, its columns, or its lines of text, as changed."""

    def apply(layout, change=None):
        if layout not in TEXTS:
            return write(layout, change)
        data = request.getfixturevalue({"borealtc": "borealtc_dir"}.get(layout, layout))
        if change is not None:
            edit(data / TEXTS[layout], change)
        return data

    return apply


@pytest.mark.parametrize("layout", [*TEXTS, *SAVED])
def test_run_folders_give_the_same_runs_and_digest(layout, make, tmp_path):
    data = make(layout)
    runs = load_runs(data, layout=layout)
    result = convert(ConvertSettings(data=data, out=tmp_path / "out"))
    again = load_runs(tmp_path / "out")
    assert data_digest(again) == result.digest == data_digest(runs)
    for one, other in zip(runs, again, strict=True):
        assert (one.run_id, one.session, one.dropped) == (other.run_id, other.session, other.dropped)
        (label,) = one.labels or [None]
        assert label is None or all(
            label.start_s <= s.time_s[0] and s.time_s[-1] < label.end_s for s in one.streams.values()
        )


def cell(column, row, value):
    def change(columns):
        columns[column] = columns[column].astype(object)
        columns[column][row] = value

    return change


def window(number, column, value):
    return cell(column, slice(number * N, (number + 1) * N), value)


def rows(kept):
    def change(columns):
        for name, each in columns.items():
            columns[name] = each[kept(np.arange(len(each)))]

    return change


def without(column):
    return lambda columns: columns.pop(column)


def restart(name, row):
    def change(columns):
        columns[name][row:] -= columns[name][row]

    return change


def line(place, text):
    return lambda lines: [*lines[:place], text, *lines[place + 1 :]]


def torn(lines):
    return [*lines[:9], lines[9][:20], *lines[10:]]


LOCKED, ASIDE, ROLLING = TRIALS.splitlines()[1:]
FAULTS = [
    ("drive", rows(lambda i: i < 0), "log/samples.csv.gz: has no rows of data", None),
    ("drive", cell("steady", 7, "nan"), "log/samples.csv.gz: steady at row 9 is not finite (nan)", None),
    ("drive", cell("time", 7, 0.5), "time does not rise evenly in window 0", None),
    ("drive", cell("time", 47, 0.5), "time in window 1 is not that of window 0", None),
    ("drive", cell("step", 47, 1), "step in window 1 is 0, 1; it must be one whole number from 0 up", None),
    ("drive", window(4, "steady", 2), "steady in window 4 is 2; it must be 0 or 1 throughout", None),
    ("drive", window(4, "step", 0.5), "step in window 4 is 0.5; it must be one whole number", None),
    ("drive", window(0, "steady", 1), "the first window has steady 1; a command begins with", None),
    ("drive", window(5, "step", 7), "the windows of one command have the steps 1, 7", SKIPPED),
    ("drive", rows(lambda i: i < 4 * N), "the command of step 0 has one window only, at least one", SKIPPED),
    ("drive", rows(lambda i: i < 9 * N - 3), "window 8 has 37 samples, the first one has 40", None),
    ("drive", rows(lambda i: i % N < 5), "windows have 5 samples, more than 5 are needed", None),
    ("drive", without("imu_az"), "column 'imu_az' is missing (the file has", None),
    ("drive", cell("wheel_left", slice(3 * N, 6 * N), ""), "channel speed_left_mps (column wheel_left)", DEAD),
    ("drive", window(4, "wheel_left", 9.5), "turn at up to 9.5 rad/s, those of robot husky at up to 6.1", None),
    ("drive-recording", without("calib_state"), "column 'calib_state' is missing", None),
    ("drive-recording", cell("imu_z", 7, "north"), "imu_z at row 9 is 'north', which is no number", BAD_CELL),
    ("drive-recording", cell("calib_step", 7, 1.5), "calib_step at row 9 is 1.5; it must be a whole", None),
    ("drive-recording", restart("time", 300), "time goes back at row 302", BAD_TIME),
    ("robotino", restart("t", 80), "time goes back at row 84", BAD_TIME),
    ("robotino", cell("m3vel", slice(None), "nan"), "channel motor_3_radps (column m3vel) has nothing", DEAD),
    ("robotino", cell("m2setvel", slice(None), 99.0), "the commanded motor speeds are", None),
    ("robotino", cell("t", slice(1, None), "nan"), "time at row 5 is not finite", None),
    ("borealtc", lambda lines: [lines[0] + ",wx", *(line + ",0" for line in lines[1:])], "'wx' is there twice",
     SKIPPED),
    ("borealtc", lambda lines: lines[:1], "SNOW/imu_01.csv: has 0 usable rows of data, at least 2 are", SKIPPED),
    ("borealtc", lambda lines: [*lines[:30], "", lines[31], lines[30]], "goes back at row 33 (0.58 s after 0.6 s)",
     BAD_TIME),
    ("borealtc", lambda lines: [*lines[:30], *lines[29:]], "time repeats at row 31 (0.56 s twice)", BAD_TIME),
    ("borealtc", torn, "row 10 has 2 cells, the header has 7", "rows with missing or extra cells"),
    ("testbed", line(3, LOCKED.replace("41.0", "soft")), "smooth.csv: avg_Fy at row 4 is 'soft', which is no", SKIPPED),
    ("testbed", line(3, LOCKED.replace("41.0", "inf")), "avg_Fy at row 4 is 'inf', a finite mean is required", SKIPPED),
    ("testbed", line(3, LOCKED.replace("41.0", "")), "avg_Fy at row 4 is '', a finite mean is required", SKIPPED),
    ("testbed", line(3, LOCKED.rpartition(",")[0]), "row 4 has missing or extra cells", SKIPPED),
    ("testbed", line(3, ASIDE), "row 4 repeats the trial of row 3, number for number", SKIPPED),
    ("testbed", line(3, ROLLING.replace("30.0,0.0", "30.0,0.3")), "row 4: slip is 0.3, that of its", SKIPPED),
    ("testbed", line(3, ROLLING.replace("-22.0", "22.0")), "row 4: avg_Fz is 22 N, that of a wheel", SKIPPED),
    ("testbed", line(3, ROLLING.replace("1.0,30.0", "0.5,30.0")), "row 4: trial_num is 0.5, a whole number", SKIPPED),
    ("testbed", line(3, ROLLING.replace("1.0,30.0", "1.0,300.0")), "row 4: beta is 300 degrees, -90 to 90", SKIPPED),
    ("testbed", line(3, ROLLING.replace("10.0,10.0", "10.0,0.0")), "row 4: avg_Vx is 0 mm/s, a speed of", SKIPPED),
    ("testbed", line(3, ROLLING.replace("4.0,0.9", "4.0,-0.9")),
     "std_Fy at row 4 is '-0.9', a standard deviation is a number from 0", "spreads that are negative or no number"),
    ("testbed", lambda lines: lines[:1], "smooth.csv: has no rows of data, a trial a row is needed", None),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "change", "message", "repaired"), FAULTS)
def test_a_fault_is_one_sentence_and_counted_or_skipped_by_a_repair(
    layout, change, message, repaired, make, caplog
):
    data = make(layout, change)
    with pytest.raises(LogError) as error:
        load_runs(data)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    if repaired is None:
        with pytest.raises(LogError):
            load_runs(data, repair=True)
        return
    runs = load_runs(data, repair=True)
    if repaired == SKIPPED:
        assert 1 <= len(runs) <= 2
        assert caplog.messages == [f"run skipped: {error.value}"]
    else:
        assert sum((Counter(run.dropped) for run in runs), Counter())[repaired] >= 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda whole: b"", "has no names of columns in row 3"),
        (lambda whole: whole[: len(whole) // 2], "is no whole gzip file"),
        (lambda whole: whole[:1000] + bytes(200) + whole[1200:], "is no whole gzip file"),
        (lambda whole: b"step,window\n1,2\n", "is no whole gzip file"),
        (lambda whole: gzip.compress(b"\xff\xfe\x00step"), "is no CSV text"),
    ],
)
def test_a_broken_archive_is_one_sentence_and_leaves_the_others(write, caplog, content, message):
    data = write("robotino")
    (path,) = data.rglob("*.gz")
    torn = path.with_name("torn08.csv.gz")
    torn.write_bytes(content(path.read_bytes()))
    with pytest.raises(LogError, match=rf"torn08\.csv\.gz: {message}"):
        load_runs(data)
    assert len(load_runs(data, repair=True)) == 1
    assert len(caplog.messages) == 1


# BorealTC


def test_a_missing_partner_and_streams_that_never_meet_are_refused_by_name(borealtc_dir, edit):
    def later(lines):
        cells = [line.split(",") for line in lines[1:]]
        return [lines[0], *(",".join([str(float(row[0]) + 100.0), *row[1:]]) for row in cells)]

    edit(borealtc_dir / "SNOW" / "pro_01.csv", later)
    with pytest.raises(
        LogError, match=r"^SNOW_01: the streams do not overlap in time \(imu 0 to 3.98 s, wheels 100"
    ):
        load_runs(borealtc_dir)
    (borealtc_dir / "ICE" / "pro_01.csv").unlink()
    with pytest.raises(LogError, match=r"^ICE/pro_01\.csv: is missing$"):
        load_runs(borealtc_dir)


def test_repair_drops_what_strict_refuses_counts_it_and_touches_nothing_else(borealtc_dir, edit):
    def spoil_all(lines):
        cells = lines[41].split(",")
        lines[41] = ",".join([*cells[:3], "ERR", *cells[4:]])
        lines[60] = lines[60][:15]  # torn row
        lines[70] = "0.1," + lines[70].split(",", 1)[1]  # time goes back
        lines[80] = "," + lines[80].split(",", 1)[1]  # time is missing
        return lines

    whole = load_runs(borealtc_dir)[1].streams["imu"]
    edit(borealtc_dir / "SNOW" / "imu_01.csv", spoil_all)
    run = load_runs(borealtc_dir, repair=True)[1]
    assert run.dropped == {BAD_CELL: 1, "rows with missing or extra cells": 1, BAD_TIME: 2}
    expected, kept = whole.values.copy(), np.delete(np.arange(len(whole)), [59, 69, 79])
    expected[40, 2] = np.nan
    np.testing.assert_array_equal(run.streams["imu"].time_s, whole.time_s[kept])
    np.testing.assert_array_equal(run.streams["imu"].values, expected[kept])


# sessions of DRIVE


def test_every_command_is_a_run_with_its_channels_in_si_units(write):
    columns = windows()
    runs = load_runs(write("drive", columns=columns))
    assert [run.run_id for run in runs] == ["step_000", "step_001", "step_002"]
    for i, run in enumerate(runs):
        assert (run.robot, run.labels, dict(run.dropped)) == ("husky", (), {})
        time_s = run.streams["wheels"].time_s
        # one sample is lost after the first window, none after the second
        assert time_s[[0, N - 1, N, 2 * N - 1, 2 * N, -1]] == pytest.approx([0, 1.95, 2.05, 4.0, 4.05, 6.0])
        for name, sources in STREAMS.items():
            assert np.array_equal(run.streams[name].time_s, time_s)
            for channel, (column, factor) in sources.items():
                scale = factor * (HUSKY_RADIUS_M if name == "wheels" else 1.0)
                expected = columns[column].reshape(3, -1)[i] * scale
                np.testing.assert_array_equal(run.streams[name].channel(channel), expected)
        twist = run.streams["lidar"].values[np.isfinite(run.streams["lidar"].values).all(axis=1)]
        assert len(twist) > 60
        assert np.abs(twist - (0.5, 0.0, 0.4)).max() < 0.01


@pytest.fixture
def sessions(write):
    for seed, name in enumerate(("asphalt_1", "asphalt_2", "sand_1")):
        folder = write("drive", columns=windows(2, seed), place=f"{name}/samples.csv.gz")
    return folder


@pytest.fixture
def mule(tmp_path):
    """A robot with wheels of 0.3 m."""
    path = tmp_path / "mule.yaml"
    numbers = {"wheel_radius_m": 0.3, "track_m": 1.08, "wheelbase_m": 0.9, "mass_kg": 280.0}
    lines = [f"{k}: {{value: {v}, unit: {k.rpartition('_')[2]}, source: me}}" for k, v in numbers.items()]
    path.write_text("\n".join(["name: mule", "drive: skid_steer", *lines]) + "\n")
    return path


def test_sessions_are_read_as_one_data_set_of_the_robot_that_is_named(sessions, mule, tmp_path):
    runs = load_runs(sessions, robot=mule)
    assert [run.run_id for run in runs] == [f"{run.session}_step_00{i % 2}" for i, run in enumerate(runs)]
    assert Counter(run.session for run in runs) == {"asphalt_1": 2, "asphalt_2": 2, "sand_1": 2}
    assert {run.robot for run in runs} == {"mule"}
    assert [run.terrains for run in runs] == [("asphalt",)] * 4 + [("sand",)] * 2
    alone = load_runs(sessions / "sand_1", robot=mule)
    assert data_digest(alone) == data_digest(runs[4:])
    # the radius is the robot's: the same wheels are faster by the ratio of the two
    left, of_husky = (
        each[0].streams["wheels"].channel("speed_left_mps")
        for each in (alone, load_runs(sessions / "sand_1"))
    )
    np.testing.assert_allclose(left / of_husky, 0.3 / HUSKY_RADIUS_M)
    with pytest.raises(ConfigError, match="robot agrimaro: drive 'swerve' does not fit logs of DRIVE"):
        load_runs(sessions, robot="agrimaro")


def test_a_folder_that_is_no_plain_set_of_sessions_is_refused(sessions, write, caplog):
    (sessions / "empty_1").mkdir()
    with pytest.raises(
        LogError, match=r"empty_1: has no samples\.csv\.gz, which the other sessions beside it"
    ):
        load_runs(sessions)
    assert len(load_runs(sessions, repair=True)) == 6
    assert len(caplog.messages) == 1
    (sessions / "empty_1").rename(sessions / "SNOW")
    for name in ("imu_1.csv", "pro_1.csv"):
        (sessions / "SNOW" / name).write_text("time\n0\n")
    with pytest.raises(LogError, match="mixes the layouts borealtc and drive; choose one with --format"):
        load_runs(sessions)
    write("drive", place="samples.csv.gz")
    with pytest.raises(
        LogError, match=r"holds samples\.csv\.gz itself and in asphalt_1; give the folder of one"
    ):
        load_runs(sessions, layout="drive")


# whole recordings of DRIVE


def test_commands_and_hand_driving_become_runs_in_si_units(write):
    columns = recording()
    runs = load_runs(write("drive-recording", columns=columns))
    assert [run.run_id[-8:] for run in runs] == ["hand_000", "step_001", "step_002"]
    for run in runs:
        assert (run.robot, run.terrains) == ("warthog", ("wet_grass",))
        assert run.session == "warthog_wet_grass_first"
        assert ("commands" in run.streams) == ("step" in run.run_id)
    run, rows = runs[2], slice(340, 460)
    t = columns["time"][rows]
    speed, rate = 0.8 + 0.4 * np.sin(0.9 * t), 0.3 * np.sin(0.6 * t)
    wheels, lidar, pose = (run.streams[name] for name in ("wheels", "lidar", "pose"))
    inner = slice(8, -8)
    # straight lines between updates 0.25 s apart are within the curvature of a sine, steps are not
    bound = 0.4 * 0.9**2 * 0.25**2 / 8 + 0.9 * 0.3 * 0.6**2 * 0.25**2 / 8
    assert np.abs(wheels.values[:, :2].mean(axis=1) - speed)[inner].max() < 1.2 * bound
    assert np.abs(held(speed, 5) - speed).max() > 5 * bound
    assert np.abs(lidar.values - np.column_stack([speed, 0.0 * speed, rate]))[inner].max() < 0.02
    assert pose.rate_hz == pytest.approx(10.0)
    x = np.interp(pose.time_s + t[0], columns["time"], columns["icp_pos_x"])
    assert np.abs(pose.values[:, 0] - x).max() < 1.2 * PERIOD_S * 2


def test_an_imu_that_is_mounted_upside_down_is_turned_and_counted(write):
    def turn(columns):
        for axis in "yz":
            columns[f"imu_{axis}"] *= -1
            columns[f"imu_acceleration_{axis}"] *= -1

    straight, turned = load_runs(write("drive-recording")), load_runs(write("drive-recording", turn))
    for one, other in zip(straight, turned, strict=True):
        np.testing.assert_allclose(one.streams["imu"].values, other.streams["imu"].values)
    counts = sum((Counter(run.dropped) for run in turned), Counter())
    assert (counts[TURNED], counts[GYRO_TURNED]) == (2, 1)


def test_what_an_instrument_logs_otherwise_or_not_is_seen_and_counted(write):
    """A gyro in degrees; an IMU that begins late; columns of zeros; currents without a sign."""

    def change(columns):
        for name in columns:
            if name.startswith("imu_"):
                columns[name][:30] = 0.0
                columns[name] *= 1.0 if "accel" in name else 180.0 / np.pi
        columns["left_wheel_voltage"] *= 0.0
        for side in ("left", "right"):
            columns[f"{side}_wheel_current"] = np.abs(columns[f"{side}_wheel_current"])

    plain, runs = load_runs(write("drive-recording")), load_runs(write("drive-recording", change))
    assert plain[0].dropped.get(POWER_SIGN) is None
    assert runs[0].dropped == plain[0].dropped | {GYRO_IN_DEGREES: 1, NOT_RECORDED: 1, NO_SIGN: 2}
    assert runs[0].streams["imu"].time_s[0] == pytest.approx(30 * PERIOD_S)
    np.testing.assert_allclose(runs[1].streams["imu"].values, plain[1].streams["imu"].values)
    assert "voltage_left_v" not in runs[0].streams["wheels"].channels
    blank = load_runs(
        write("drive-recording", lambda c: c.update({n: 0.0 * c[n] for n in c if n[:4] == "imu_"}))
    )
    assert all("imu" not in run.streams for run in blank)
    speed = np.repeat([1.0, -1.0], 50)[:, None]
    assert current_sign(np.repeat([4.0, -5.0], 50)[:, None], speed) == ""


def test_a_pose_that_jumps_is_unknown_and_counted_and_lost_throughout_it_is_refused(write):
    def jump(columns):
        columns["icp_pos_x"][400:402] += 30.0

    def lose(columns):
        columns["icp_pos_x"] = held(np.random.default_rng(1).uniform(-30.0, 30.0, len(columns["time"])), 2)

    run = load_runs(write("drive-recording", jump))[2]
    assert run.dropped[LOST] > 0
    pose, lidar = run.streams["pose"], run.streams["lidar"]
    assert np.nanmax(np.abs(np.diff(pose.values[:, 0]))) < 1.0
    assert np.isnan(lidar.values[54:62]).all()
    assert np.isfinite(lidar.values[90:110]).all()
    with pytest.raises(LogError, match="lidar has lost the robot throughout"):
        load_runs(write("drive-recording", lose))


def test_a_run_in_which_the_lidar_shows_nothing_lacks_its_streams_and_is_read_again(write, tmp_path):
    def lose_first(columns):  # driven by hand
        n = 200
        for name in ("icp_pos_x", "icp_quat_z"):
            columns[name][:n] = held(np.random.default_rng(1).uniform(-30.0, 30.0, n), 2)

    runs = load_runs(write("drive-recording", lose_first))
    for run in runs:
        write_run(run, tmp_path / "out")
    again = load_runs(tmp_path / "out")
    assert [set(run.streams) for run in again] == [set(run.streams) for run in runs]
    assert {name for run in again for name in run.streams} >= {"lidar", "pose"}
    assert "lidar" not in again[0].streams


def test_commands_that_move_nothing_or_are_interrupted_are_no_run_or_two(write):
    def stand(columns, rows=slice(120, 240)):
        for side in ("left", "right"):
            columns[f"meas_{side}_vel"][rows] = 0.0

    columns = recording(((1, "calib", 6.0), (2, "calib", 6.0), (3, "calib", 6.0)))
    runs = load_runs(write("drive-recording", stand, columns))
    assert [run.run_id[-8:] for run in runs] == ["step_001", "step_003"]
    assert runs[0].dropped[STILL] == 1
    interrupted = recording(((1, "calib", 4.0), (1, "idle", 3.0), (1, "calib", 6.0)))
    runs = load_runs(write("drive-recording", columns=interrupted))
    assert [run.run_id[-10:] for run in runs] == ["t_step_001", "step_001_2"]
    with pytest.raises(LogError, match="its wheels turn for no more than a moment"):
        load_runs(write("drive-recording", lambda columns: stand(columns, slice(None))))


def test_the_folder_names_robot_and_terrain(write):
    fast = cell("meas_left_vel", slice(None), 12.0)
    with pytest.raises(LogError, match="name the robot that drove it"):
        load_runs(write("drive-recording", fast, place="husky_sand/first.csv.gz") / "husky_sand")
    with pytest.raises(LogError, match="has to name robot and terrain"):
        load_runs(write("drive-recording", place="warthog/first.csv.gz"))
    (write("drive-recording") / "warthog").rename(write("drive-recording") / "rover_sand")
    with pytest.raises(ConfigError, match="robot 'rover' is unknown"):
        load_runs(write("drive-recording"))


# Robotino


def test_a_run_comes_back_in_the_frames_of_the_project(write):
    """The scale of motor rates too, which is that of their counts."""
    twist, slip, heading = (0.08, 0.06, 0.0), 0.2, 0.3
    (run,) = load_runs(write("robotino", columns=motors(twist, slip, heading, scale=1.05)))
    assert (run.run_id, run.robot, run.terrains, run.session) == ("moss_07", "robotino", ("moss",), "")
    pose, along = run.streams["pose"], (1 - slip) * np.exp(1j * heading) * complex(*twist[:2])
    drift = (pose.values[-1, :2] - pose.values[0, :2]) / (pose.time_s[-1] - pose.time_s[0])
    np.testing.assert_allclose(drift, [along.real, along.imag], atol=1e-9)
    np.testing.assert_allclose(pose.channel("yaw_rad"), heading, atol=1e-12)
    np.testing.assert_allclose(run.streams["commands"].values, np.broadcast_to(twist, (120, 3)))
    rolled = np.array(twist) @ rolling_matrix(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad).T
    speeds = [run.streams["wheels"].channel(f"speed_{i}_mps").mean() for i in (1, 2, 3)]
    # the hold of the counts, 19 ms, against the 3.7 s of the run
    np.testing.assert_allclose(speeds, rolled, atol=0.006 * np.abs(rolled).max())


def test_every_change_is_counted_and_a_camera_that_sees_nothing_is_refused(write):
    def hold(columns, rows=slice(40, 43)):
        for name in ("xpos", "ypos", "ang"):
            columns[name][rows] = columns[name][rows.start - 1 if rows.start else 0]

    (run,) = load_runs(write("robotino", hold))
    assert run.dropped == {SCALED: 3, "currents without a sign": 3, HELD: 3}
    assert len(run.streams["pose"]) == 117
    data = write("robotino", lambda columns: hold(columns, slice(0, None)))
    with pytest.raises(LogError, match="the camera shows 1 different poses while the wheels turn"):
        load_runs(data)
    assert load_runs(data, repair=True)[0].dropped[BLIND] == 1
    for scale in ("null", '"wide"', "-1", "0", "true"):
        (data / "camera_params.json").write_text(
            f'{{"pixel_resolution_x": 1.8, "pixel_resolution_y": {scale}}}'
        )
        with pytest.raises(LogError, match=r"pixel_resolution_y is .*millimetres a pixel are required"):
            load_runs(data)


def test_names_come_from_the_folders(write):
    for where in ("one_surface/草地/exp01", "two_surfaces/moss_cork/exp02", "weights/cork/exp03"):
        write("robotino", place=f"{where}.csv.gz")
    bare = {name: each for name, each in motors().items() if name in MOTOR_COLUMNS[:1] + MOTOR_COLUMNS[4:16]}
    for where in ("dc_motor/bench", "weights/cork/uniform_load"):
        data = write("robotino", columns=dict(bare), place=f"{where}.csv.gz")
    runs = {run.run_id: (run.terrains, run.session, len(run.streams)) for run in load_runs(data)}
    assert runs == {
        "dc_motor_bench": ((), "", 1),
        "moss_cork_02": ((), "moss_cork", 3),
        "weights_cork_03": (("cork",), "weights_cork", 3),
        "草地_01": (("草地",), "", 3),
    }
    assert [run.run_id for run in load_runs(data / "one_surface")] == ["草地_01"]


# wheel testbed


def test_signs_of_trials_are_those_of_the_projects_frames(testbed):
    locked, aside, _ = load_runs(testbed)
    assert [locked.run_id, locked.robot, locked.session] == ["smooth_trial_001", "testbed_smooth", "smooth"]
    assert locked.terrains == ("dry_sand",)
    of_locked = {"force_x_n": -41.0, "sinkage_wheel_m": 0.05, "slip_commanded_ratio": -1.0}
    of_aside = {
        "force_y_n": 40.0,
        "force_z_n": 14.0,
        "slip_angle_commanded_rad": math.pi / 2,
        "speed_wheel_mps": 0.02,
    }
    for run, expected in ((locked, of_locked), (aside, of_aside)):
        for name, value in expected.items():
            assert run.streams["testbed"].channel(name) == pytest.approx([value, value])


# the measured logs


def test_measured_trials_agree_with_physics(measured):
    runs = load_runs(measured("wheel_testbed"))
    names = ("force_x_n", "force_y_n", "force_z_n", "slip_measured_ratio", "slip_angle_commanded_rad")
    first = [[run.streams["testbed"].channel(name)[0] for run in runs] for name in names]
    pull, side, load, slip, angle = np.array(first)
    assert len(runs) > 10
    braked = (np.abs(angle) < 0.01) & (slip < -0.4)
    assert (pull[braked] < -0.5 * load[braked]).all()
    assert (np.abs(side[np.abs(angle) < 0.01]) < 0.15 * load[np.abs(angle) < 0.01]).all()
    assert (side[angle > 0.2] > 0.0).all()


def test_measured_robotinos_go_where_they_are_commanded(measured):
    """A sign or a frame that is wrong would turn the path; slip only shortens it."""
    for run in load_runs(measured("robotino") / "one_surface" / "table"):
        pose, twist = run.streams["pose"], run.streams["commands"].values[10]
        path = np.diff(pose.values[[0, -1], :2] @ [1, 1j])[0] * np.exp(-1j * pose.channel("yaw_rad").mean())
        assert abs(np.angle(path / complex(*twist[:2]))) < np.radians(8.0), run.run_id


def test_the_published_file_agrees_with_the_plain_csv_module(measured, measured_runs):
    """Two routes, every cell: nothing is lost but the samples that two windows share."""
    husky_runs = measured_runs("drive_husky")
    with gzip.open(measured("drive_husky/samples.csv.gz"), "rt", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [run.run_id for run in husky_runs] == [f"step_{i:03d}" for i in range(201)]
    assert sum(len(run.streams["imu"]) for run in husky_runs) == len(lines) - 42
    for number in (1, 5, 200):
        of_run = [line for line in lines if int(line["window"]) // 3 == number]
        for name, columns in STREAMS.items():
            for channel, (column, factor) in columns.items():
                values = husky_runs[number].streams[name].channel(channel).tolist()
                scale = factor * (HUSKY_RADIUS_M if name == "wheels" else 1.0)
                listed = [float(line[column]) * scale for line in of_run]
                assert values == listed if len(values) == len(listed) else set(values) <= set(listed)


SESSIONS = ("asphalt_1", "asphalt_2", "asphalt_3", "gravel_1", "sand_1", "sand_2")
RECORDINGS = ("husky_wet_grass", "warthog_asphalt", "warthog_grass")
GIVEN = [
    ("drive_husky", "", 3),
    *(pytest.param("drive_warthog_terrains", each, 6, marks=pytest.mark.slow) for each in SESSIONS),
    *(pytest.param("drive_recordings", each, 6, marks=pytest.mark.slow) for each in RECORDINGS),
]
"""Folder, session, and by how many samples the lidar comes later."""


@pytest.mark.parametrize(("folder", "session", "lag"), GIVEN)
def test_lidar_wheels_and_gyro_of_measured_runs_agree(measured, measured_runs, folder, session, lag):
    """Wheels outrun the ground and turn the robot less than they say; the gyro knows nothing of the pose."""
    warthog = folder == "drive_warthog_terrains"
    if warthog:
        measured(f"{folder}/gravel_1/samples.csv.gz")
    runs = measured_runs(folder, robot="warthog" if warthog else None)
    runs = [run for run in runs if run.session.startswith(session)]
    rows, kinds = [], {kind for run in runs for kind in run.dropped}
    for run in runs:
        if "lidar" not in run.streams:  # it showed nothing in this run
            continue
        lidar, wheels = run.streams["lidar"].values[lag:], run.streams["wheels"].values[:-lag, :2]
        gyro, imu = np.full(len(lidar), np.nan), run.streams.get("imu", ())
        if len(imu) == len(run.streams["wheels"]):
            gyro = imu.channel("gyro_z_radps")[:-lag]
        rows.append(np.column_stack([lidar, wheels.mean(axis=1), wheels[:, 1] - wheels[:, 0], gyro]))
    rows = np.concatenate(rows)
    forward, _, turn, speed, across, gyro = rows[np.isfinite(rows[:, 0])].T
    assert len(forward) > 500
    assert 0.75 < (forward @ speed) / (speed @ speed) < 1.02
    assert 1.0 / 2.2 < (turn @ across) / (across @ across) < 1.0 / 0.9
    known = np.isfinite(gyro)
    if session == "husky_wet_grass":
        assert not known.any()
        assert NO_SIGN in kinds
        return
    assert (turn[known] @ gyro[known]) / (gyro[known] @ gyro[known]) == pytest.approx(1.0, abs=0.07)
    if folder == "drive_husky":  # its axes are not as published
        gained = [np.diff(run.streams["wheels"].values[[0, N - 1]].mean(axis=1))[0] for run in runs]
        accel = [run.streams["imu"].channel("accel_x_mps2")[:N].mean() for run in runs]
        assert np.corrcoef(gained, accel)[0, 1] > 0.6
    elif folder == "drive_recordings":
        assert POWER_SIGN in kinds
        # a side that drives backwards takes a negative current, as one that drives forwards a positive one
        sides = np.concatenate([run.streams["wheels"].values for run in runs])
        faster = np.abs(sides[:, :2]).argmax(axis=1)[:, None]
        speed, current = (
            np.take_along_axis(each, faster, axis=1)[:, 0] for each in (sides[:, :2], sides[:, 2:4])
        )
        assert np.nanmean(current[speed < -0.5]) < -2.0 < 2.0 < np.nanmean(current[speed > 0.5])
    else:
        assert {run.dropped.get(GYRO_TURNED, 0) for run in runs} == {int(session == "gravel_1")}
