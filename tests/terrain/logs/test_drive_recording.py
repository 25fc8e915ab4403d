"""Whole recordings of DRIVE: written with a known motion, read back; and the measured ones."""

import csv
import gzip
from collections import Counter

import numpy as np
import pytest

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.digest import data_digest
from terrain.logs.drive_recording import LOST, NOT_RECORDED, STILL
from terrain.logs.imu_axes import GYRO_IN_DEGREES, GYRO_TURNED, NO_SIGN, POWER_SIGN, TURNED, current_sign
from terrain.logs.samples import BAD_CELL, BAD_TIME
from terrain.robots import load_robot

PERIOD_S = 0.05
RADIUS_M = load_robot("warthog").wheel_radius_m
TRACK_M = 1.8
COLUMNS = (
    *("time", "joy_switch", "icp_index", "calib_state", "calib_step", "meas_left_vel", "meas_right_vel"),
    *("cmd_vel_x", "cmd_vel_omega", "icp_pos_x", "icp_pos_y", "icp_pos_z"),
    *(f"icp_quat_{axis}" for axis in "xyzw"),
    *(f"imu_{axis}" for axis in "xyz"),
    *(f"imu_acceleration_{axis}" for axis in "xyz"),
    *(f"{side}_wheel_{what}" for what in ("voltage", "current") for side in ("left", "right")),
)


def held(values, every):
    return values[np.arange(len(values)) // every * every]


def recording(steps=((0, "", 8.0), (1, "idle", 3.0), (1, "calib", 6.0), (2, "calib", 6.0)), seed=0):
    """Return the columns of a robot whose speed and yaw rate are sines of the time, by name."""
    rng = np.random.default_rng(seed)
    n = [round(duration_s / PERIOD_S) for *_, duration_s in steps]
    t = PERIOD_S * np.arange(sum(n))
    still = np.repeat([state == "idle" for _, state, _ in steps], n)
    speed = np.where(still, 0.0, 0.8 + 0.4 * np.sin(0.9 * t))
    rate = np.where(still, 0.0, 0.3 * np.sin(0.6 * t))
    yaw = np.cumsum(rate) * PERIOD_S
    x, y = np.cumsum(speed * np.cos(yaw)) * PERIOD_S, np.cumsum(speed * np.sin(yaw)) * PERIOD_S
    left, right = (held((speed + sign * rate * TRACK_M / 2) / RADIUS_M, 5) for sign in (-1, 1))
    zero = np.zeros(len(t))
    return {
        "time": t,
        "joy_switch": np.array(["False"] * len(t)),
        "icp_index": np.arange(len(t)) // 2,
        "calib_state": np.repeat([state for _, state, _ in steps], n),
        "calib_step": np.repeat([step for step, *_ in steps], n),
        "meas_left_vel": left,
        "meas_right_vel": right,
        "cmd_vel_x": np.where(np.repeat([state == "calib" for _, state, _ in steps], n), 0.8, 0.0),
        "cmd_vel_omega": zero,
        "icp_pos_x": held(x, 2),
        "icp_pos_y": held(y, 2),
        "icp_pos_z": zero,
        "icp_quat_x": zero,
        "icp_quat_y": zero,
        "icp_quat_z": held(np.sin(yaw / 2), 2),
        "icp_quat_w": held(np.cos(yaw / 2), 2),
        "imu_x": rng.normal(0.0, 0.01, len(t)),
        "imu_y": rng.normal(0.0, 0.01, len(t)),
        "imu_z": rate + rng.normal(0.0, 0.005, len(t)),
        "imu_acceleration_x": np.gradient(speed, PERIOD_S) + rng.normal(0.0, 0.1, len(t)),
        "imu_acceleration_y": speed * rate + rng.normal(0.0, 0.1, len(t)),
        "imu_acceleration_z": 9.81 + rng.normal(0.0, 0.1, len(t)),
        "left_wheel_voltage": np.full(len(t), 48.0),
        "right_wheel_voltage": np.full(len(t), 48.1),
        "left_wheel_current": held(6.0 - 10.0 * rate, 20),
        "right_wheel_current": held(1.0 + 12.0 * rate, 20),
    }


@pytest.fixture
def save(tmp_path):
    def write(columns, folder="warthog_wet_grass", name="first.csv.gz"):
        path = tmp_path / "data" / folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with gzip.open(path, "wt", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
        return tmp_path / "data"

    return write


def test_commands_and_hand_driving_become_runs_in_si_units(save):
    runs = load_runs(save(recording()))
    assert [run.run_id.removeprefix("warthog_wet_grass_first_") for run in runs] == [
        *("hand_000", "step_001", "step_002")
    ]
    for run in runs:
        assert (run.robot, run.terrains, run.session) == (
            *("warthog", ("wet_grass",)),
            "warthog_wet_grass_first",
        )
        assert ("commands" in run.streams) == ("step" in run.run_id)
    run = runs[1]
    assert run.streams["commands"].channels == ("speed_x_mps", "yaw_rate_radps")
    assert run.streams["pose"].channels == ("position_x_m", "position_y_m", "yaw_rad")
    assert run.streams["pose"].rate_hz == pytest.approx(10.0)


def test_the_motion_that_was_driven_is_read_back(save):
    columns = recording()
    run = next(run for run in load_runs(save(columns)) if run.run_id.endswith("step_002"))
    rows = slice(340, 460)
    t = columns["time"][rows]
    speed, rate = 0.8 + 0.4 * np.sin(0.9 * t), 0.3 * np.sin(0.6 * t)
    wheels, lidar = run.streams["wheels"], run.streams["lidar"]
    inner = slice(8, -8)
    # straight lines between updates 0.25 s apart are within the curvature of a sine, steps are not
    bound = 0.4 * 0.9**2 * 0.25**2 / 8 + 0.9 * 0.3 * 0.6**2 * 0.25**2 / 8
    mean = wheels.values[:, :2].mean(axis=1)
    assert np.abs(mean - speed)[inner].max() < 1.2 * bound
    assert np.abs(held(speed, 5) - speed).max() > 5 * bound
    assert np.isfinite(lidar.values[inner]).all()
    assert np.abs(lidar.values[inner, 0] - speed[inner]).max() < 0.02
    assert np.abs(lidar.values[inner, 1]).max() < 0.02
    assert np.abs(lidar.values[inner, 2] - rate[inner]).max() < 0.02
    pose = run.streams["pose"]
    x = np.interp(pose.time_s + t[0], columns["time"], columns["icp_pos_x"])
    assert np.abs(pose.values[:, 0] - x).max() < 1.2 * PERIOD_S * 2


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)])
def test_an_imu_mounted_any_level_side_up_is_turned_and_counted(save, signs):
    plain, turned = recording(), recording()
    for axis, sign in zip("xyz", signs, strict=True):
        turned[f"imu_{axis}"] = sign * turned[f"imu_{axis}"]
        turned[f"imu_acceleration_{axis}"] = sign * turned[f"imu_acceleration_{axis}"]
    straight = load_runs(save(plain))
    found = load_runs(save(turned))
    for one, other in zip(straight, found, strict=True):
        np.testing.assert_allclose(one.streams["imu"].values, other.streams["imu"].values)
    counts = sum((Counter(run.dropped) for run in found), Counter())
    assert counts[TURNED] == sum(sign < 0 for sign in signs)
    assert counts[GYRO_TURNED] == int(signs[2] < 0)


def test_a_gyro_in_degrees_is_read_in_radians(save):
    columns = recording()
    for axis in "xyz":
        columns[f"imu_{axis}"] = np.rad2deg(columns[f"imu_{axis}"])
    plain, found = load_runs(save(recording())), load_runs(save(columns))
    assert found[0].dropped[GYRO_IN_DEGREES] == 1
    np.testing.assert_allclose(found[1].streams["imu"].values, plain[1].streams["imu"].values)


def test_what_was_not_recorded_is_left_out_and_not_zero(save):
    columns = recording()
    for name in columns:
        if name.startswith("imu_") or name == "left_wheel_voltage":
            columns[name] = np.zeros(len(columns["time"]))
    runs = load_runs(save(columns))
    assert all("imu" not in run.streams for run in runs)
    assert "voltage_left_v" not in runs[0].streams["wheels"].channels
    assert runs[0].dropped[NOT_RECORDED] == 7


def test_the_imu_begins_with_its_first_message(save):
    columns = recording()
    for name in columns:
        if name.startswith("imu_"):
            columns[name][:30] = 0.0
    imu = load_runs(save(columns))[0].streams["imu"]
    assert imu.time_s[0] == pytest.approx(30 * PERIOD_S)
    assert np.isfinite(imu.values).all()


def test_currents_are_marked_by_their_sign(save):
    columns = recording()
    assert load_runs(save(columns))[0].dropped.get(POWER_SIGN) is None
    for side in ("left", "right"):
        columns[f"{side}_wheel_current"] = np.abs(columns[f"{side}_wheel_current"])
    assert load_runs(save(columns))[0].dropped[NO_SIGN] == 2
    speed = np.repeat([1.0, -1.0], 50)[:, None]
    assert current_sign(np.repeat([4.0, -5.0], 50)[:, None], speed) == ""
    assert current_sign(np.r_[np.full(40, 4.0), np.full(10, -3.0), np.full(50, 5.0)][:, None], speed) == (
        POWER_SIGN
    )


def test_a_current_with_the_sign_of_the_power_gets_that_of_the_torque(save):
    """Drive forwards, brake, drive backwards: what is logged is the torque times the sense of rotation."""
    columns = recording(((1, "calib", 20.0),))
    t = columns["time"]
    speed = np.sin(0.5 * t)
    torque = 7.0 * np.gradient(speed, PERIOD_S) + 2.0 * np.sign(speed)
    for side in ("left", "right"):
        columns[f"meas_{side}_vel"] = held(speed, 5) / RADIUS_M
        columns[f"{side}_wheel_current"] = held(torque * np.sign(speed), 20)
    (run,) = load_runs(save(columns))
    assert run.dropped[POWER_SIGN] == 2
    found = run.streams["wheels"].channel("current_left_a")[::20]
    expected = torque[::20][: len(found)]
    turning = np.abs(speed[::20][: len(found)]) > 0.2
    np.testing.assert_allclose(found[turning], expected[turning], atol=1e-9)


def test_a_pose_that_jumps_is_unknown_and_counted(save):
    columns = recording()
    columns["icp_pos_x"][400:402] += 30.0
    run = next(run for run in load_runs(save(columns)) if run.run_id.endswith("step_002"))
    assert run.dropped[LOST] > 0
    pose, lidar = run.streams["pose"], run.streams["lidar"]
    assert np.nanmax(np.abs(np.diff(pose.values[:, 0]))) < 1.0
    assert np.nanmax(np.abs(lidar.values)) < 1.5
    assert np.isnan(lidar.values[54:62]).all()
    assert np.isfinite(lidar.values[90:110]).all()


def test_a_command_under_which_nothing_moves_is_no_run_and_is_counted(save):
    columns = recording(((1, "calib", 6.0), (2, "calib", 6.0), (3, "calib", 6.0)))
    for side in ("left", "right"):
        columns[f"meas_{side}_vel"][120:240] = 0.0
    runs = load_runs(save(columns))
    assert [run.run_id[-8:] for run in runs] == ["step_001", "step_003"]
    assert runs[0].dropped[STILL] == 1


def test_a_command_that_an_operator_interrupted_is_two_runs(save):
    steps = ((1, "calib", 4.0), (1, "idle", 3.0), (1, "calib", 6.0))
    assert [run.run_id[-10:] for run in load_runs(save(recording(steps)))] == ["t_step_001", "step_001_2"]


def spoil(name, row, value):
    def change(columns):
        columns[name] = columns[name].astype(object)
        columns[name][row] = value

    return change


def restart(columns):
    columns["time"][300:] -= columns["time"][300]


def lose(columns):
    rng = np.random.default_rng(1)
    columns["icp_pos_x"] = held(rng.uniform(-30.0, 30.0, len(columns["time"])), 2)


def stand(columns):
    for side in ("left", "right"):
        columns[f"meas_{side}_vel"] = np.zeros(len(columns["time"]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("imu_z"), "column 'imu_z' is missing"),
        (lambda c: c.pop("calib_state"), "column 'calib_state' is missing"),
        (spoil("imu_z", 7, "north"), "imu_z at row 9 is 'north', which is no number"),
        (spoil("calib_step", 7, 1.5), "calib_step at row 9 is 1.5; it must be a whole number"),
        (restart, "time does not rise at row 302 .* a clock that restarts"),
        (lose, "lidar has lost the robot throughout"),
        (stand, "its wheels turn for no more than a moment"),
    ],
)
def test_a_broken_recording_is_refused_in_one_sentence_and_leaves_the_others(save, change, message, caplog):
    broken = recording()
    change(broken)
    save(recording(), name="whole.csv.gz")
    data = save(broken, name="broken.csv.gz")
    with pytest.raises(LogError, match=message) as refused:
        load_runs(data)
    assert "broken.csv.gz" in str(refused.value)
    runs = load_runs(data, repair=True)
    assert sum("whole" in run.run_id for run in runs) == 3
    mended = [run for run in runs if "broken" in run.run_id]
    assert mended or len(caplog.messages) == 1
    if mended:
        counts = sum((Counter(run.dropped) for run in mended), Counter())
        assert counts[BAD_CELL] + counts[BAD_TIME] > 0


def test_a_damaged_archive_is_one_sentence_and_leaves_the_others(save, caplog):
    data = save(recording(), name="whole.csv.gz")
    whole = (data / "warthog_wet_grass/whole.csv.gz").read_bytes()
    (data / "warthog_wet_grass/torn.csv.gz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogError, match=r"torn\.csv\.gz: is no whole gzip file"):
        load_runs(data)
    assert len(load_runs(data, repair=True)) == 3
    assert len(caplog.messages) == 1


def test_the_folder_names_robot_and_terrain(save):
    with pytest.raises(LogError, match="has to name robot and terrain"):
        load_runs(save(recording(), folder="warthog"))
    with pytest.raises(ConfigError, match="robot 'rover' is unknown"):
        load_runs(save(recording(), folder="rover_sand"))


def test_wheels_of_another_robot_are_refused(save):
    columns = recording()
    columns["meas_left_vel"] = columns["meas_left_vel"] * 3.0
    with pytest.raises(LogError, match="name the robot that drove it"):
        load_runs(save(columns, folder="husky_sand"))


RECORDINGS = (("husky_wet_grass", 47), ("warthog_asphalt", 9), ("warthog_grass", 61))


@pytest.fixture(scope="module")
def measured_runs(measured):
    return load_runs(measured("drive_recordings"))


def by_sample(run):
    """Return the twist of the lidar 0.3 s later, mean speed and difference of the wheels, and gyro."""
    lag = 6
    lidar, wheels = run.streams["lidar"].values[lag:], run.streams["wheels"].values[:-lag, :2]
    gyro = np.full(len(lidar), np.nan)
    if "imu" in run.streams and len(run.streams["imu"]) == len(run.streams["wheels"]):
        gyro = run.streams["imu"].channel("gyro_z_radps")[:-lag]
    return np.column_stack([lidar, wheels.mean(axis=1), wheels[:, 1] - wheels[:, 0], gyro])


@pytest.mark.parametrize("folder", [name for name, _ in RECORDINGS])
def test_of_measured_recordings_lidar_wheels_and_gyro_agree(measured_runs, folder):
    runs = [run for run in measured_runs if run.session.startswith(folder)]
    assert len(runs) >= 5
    assert {run.terrains for run in runs} == {(folder.partition("_")[2],)}
    rows = np.concatenate([by_sample(run) for run in runs])
    rows = rows[np.isfinite(rows[:, 0])]
    assert len(rows) > 500
    forward, _, turn, speed, across, gyro = rows.T
    # wheels run faster than the ground, and a sideways speed is none
    assert 0.75 < (forward @ speed) / (speed @ speed) < 1.02
    assert 1.0 / 2.2 < (turn @ across) / (across @ across) < 1.0 / 0.9
    if folder.startswith("warthog"):
        known = np.isfinite(gyro)
        assert (turn[known] @ gyro[known]) / (gyro[known] @ gyro[known]) == pytest.approx(1.0, abs=0.06)
        assert POWER_SIGN in {kind for run in runs for kind in run.dropped}
        # a side that drives backwards takes a negative current, as one that drives forwards a positive one
        rows = np.concatenate([run.streams["wheels"].values for run in runs])
        faster = np.abs(rows[:, :2]).argmax(axis=1)
        speed = np.take_along_axis(rows[:, :2], faster[:, None], axis=1)[:, 0]
        current = np.take_along_axis(rows[:, 2:4], faster[:, None], axis=1)[:, 0]
        assert np.nanmean(current[speed < -0.5]) < -2.0 < 2.0 < np.nanmean(current[speed > 0.5])
    else:
        assert not any("imu" in run.streams for run in runs)
        assert NO_SIGN in {kind for run in runs for kind in run.dropped}


def test_import_writes_what_was_read(save, tmp_path):
    data, out = save(recording()), tmp_path / "out"
    result = convert(ConvertSettings(data=data, out=out))
    assert data_digest(load_runs(out)) == result.digest == data_digest(load_runs(data))
