import csv
import gzip

import numpy as np
import pytest

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.digest import data_digest
from terrain.logs.drive import FILE_NAME, STREAMS, DriveRobot, find_runs
from terrain.logs.held import body_twists, undo_hold
from terrain.logs.imu_axes import GYRO_TURNED
from terrain.robots import load_robot

RADIUS_M = 0.165
HUSKY = DriveRobot("husky", RADIUS_M)
PERIOD_S = 0.05
N = 40
COLUMNS = (
    *("step", "window", "steady", "time", "cmd_left", "cmd_right", "wheel_left", "wheel_right"),
    *("icp_x", "icp_y", "icp_z", "icp_roll", "icp_pitch", "icp_yaw", "imu_yaw", "imu_ax", "imu_ay", "imu_az"),
)


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def published_pose(speed_x, speed_y, yaw_rate, yaw_0, hold=2, noise=0.0, rng=None):
    """Return (40, 3) of a robot on a circle, as the authors cut and turn it.

    A scan every ``hold`` samples, kept until the next; yaw a difference of wrapped angles; positions turned
    by the mean of the first five wrapped angles.
    """
    fine = np.arange(N) // hold * hold * PERIOD_S
    yaw = yaw_0 + yaw_rate * fine
    # the chord of an arc, in closed form: the integral of R(yaw) v
    start = np.exp(1j * yaw_0) * (speed_x + 1j * speed_y)
    turned = np.exp(1j * yaw_rate * fine)
    place = start * ((turned - 1.0) / (1j * yaw_rate) if yaw_rate else fine)
    if rng is not None:
        scatter = rng.normal(0.0, noise, (N // hold, 3)).repeat(hold, axis=0)
        place, yaw = place + scatter[:, 0] + 1j * scatter[:, 1], yaw + scatter[:, 2]
    angle = wrapped(yaw)
    place = (place - place[0]) * np.exp(-1j * angle[:5].mean())
    return np.column_stack([place.real, place.imag, angle - angle[0]])


@pytest.mark.parametrize("yaw_0", [0.0, 2.0, -0.1, np.pi - 0.04, -np.pi + 0.04])
@pytest.mark.parametrize(
    "twist", [(0.6, 0.0, 0.9), (0.6, 0.0, -0.9), (-0.4, 0.1, 0.5), (0.0, 0.0, 0.8), (0.7, -0.05, 0.0)]
)
def test_a_circle_gives_its_twist_back_wherever_the_heading_wraps(twist, yaw_0):
    """Exactly: an arc driven steadily is a straight line in its own axes."""
    found = body_twists(published_pose(*twist, yaw_0)[None], PERIOD_S)[0][0]
    seen = np.isfinite(found).all(axis=1)
    assert seen[8:-8].all()
    assert not seen[[0, 1, -2, -1]].any()
    np.testing.assert_allclose(found[seen], np.broadcast_to(twist, (seen.sum(), 3)), atol=1e-9)


def test_the_noise_of_a_twist_is_that_of_the_pose_times_its_gain():
    rng = np.random.default_rng(4)
    noise = 0.005
    windows = [published_pose(0.5, 0.0, 0.3, yaw, noise=noise, rng=rng) for yaw in rng.uniform(-3, 3, 300)]
    found, _ = body_twists(np.array(windows), PERIOD_S)
    middle = found[:, 14:26].reshape(-1, 3)
    assert np.abs(middle.mean(axis=0) - (0.5, 0.0, 0.3)).max() < 0.002
    # six or seven poses 0.1 s apart: 1 / sqrt(sum t^2) is 1.9 to 2.4; the mean of the first five headings,
    # and the turn by the heading's own noise, add little
    assert np.all((middle.std(axis=0) > 1.7 * noise) & (middle.std(axis=0) < 2.7 * noise))
    # where a slope is uncertain, none is given
    seen = np.isfinite(found).all(axis=(0, 2))
    assert seen.sum() > 25
    assert found[:, seen].std(axis=0).max() < 4.5 * noise


def test_poses_out_of_a_queue_are_not_taken_at_their_time():
    """An outage of 0.5 s; then five scans that waited come within 0.2 s."""
    pose = published_pose(0.5, 0.0, 0.6, 0.3)
    held = pose.copy()
    held[14:24] = pose[12]
    for late, scan in enumerate(range(14, 24, 2)):
        held[24 + late] = pose[scan]
    held[29:] = pose[29:]
    held[29] = pose[24]
    found = body_twists(held[None], PERIOD_S)[0][0]
    seen = np.isfinite(found).all(axis=1)
    np.testing.assert_allclose(found[seen], np.broadcast_to((0.5, 0.0, 0.6), (seen.sum(), 3)), atol=0.01)
    assert not seen[14:26].any()
    assert seen[6:9].all()
    # taken at their time they would have been far off
    naive = np.diff(held[:, 2]).max() / PERIOD_S
    assert naive > 1.0


def test_a_pose_that_took_longer_is_dated_when_its_registration_began():
    """Registrations of 0.15 to 0.35 s, one after the other: a pose is of when its own began."""
    rng = np.random.default_rng(8)
    twist = (1.0, -0.1, 1.2)
    windows = []
    for yaw_0 in rng.uniform(-3.0, 3.0, 60):
        fine = published_pose(*twist, yaw_0, hold=1)
        starts = np.cumsum(rng.choice([3, 4, 5, 6, 7], 20, p=[0.15, 0.3, 0.3, 0.15, 0.1])) - rng.integers(3)
        held = fine.copy()
        for begun, done, next_done in zip(starts, starts[1:], [*starts[2:], N], strict=False):
            if done < N:
                held[done:next_done] = fine[max(begun, 0)]
        held[: starts[1]] = fine[0]
        windows.append(held)
    found, _ = body_twists(np.array(windows), PERIOD_S)
    seen = np.isfinite(found).all(axis=2)
    assert seen.mean() > 0.3
    # of the first pose of a window nothing is known, and heading is that of the first five as held
    assert np.median(np.abs(found[seen][:, 2] - twist[2])) < 1e-9
    speed = np.hypot(*found[seen][:, :2].T)
    assert np.median(np.abs(speed - np.hypot(*twist[:2]))) < 1e-9
    # dated when they came, speeds are off by the spread of the waits over the time between the poses
    naive = np.concatenate(
        [
            np.diff(w[:, 2][np.flatnonzero(np.diff(w[:, 2])) + 1]) / np.diff(np.flatnonzero(np.diff(w[:, 2])))
            for w in windows
        ]
    )
    assert np.std(naive / PERIOD_S) > 0.2


def test_a_pose_that_never_changes_or_is_missing_gives_no_speed_and_not_zero():
    still = np.zeros((1, N, 3))
    missing = published_pose(0.5, 0.0, 0.2, 0.0)[None].copy()
    missing[0, 10:] = np.nan
    assert np.isnan(body_twists(still, PERIOD_S)[0]).all()
    assert np.isnan(body_twists(missing, PERIOD_S)[0][0, 12:]).all()


def table(steps=3, windows=3, seed=0, twist=(0.5, 0.0, 0.4)):
    """Return rows of a small file: ``steps`` commands; wheels new every second sample, as published."""
    rng = np.random.default_rng(seed)
    rows = []
    for window in range(steps * windows):
        step, part = divmod(window, windows)
        pose = published_pose(*twist, rng.uniform(-3.0, 3.0))
        wheels = rng.normal(3.0, 0.1, (N // 2, 2)).repeat(2, axis=0)
        imu = rng.normal([0.4, 1.0, 2.0, 9.8], 0.1, (N, 4))
        for i in range(N):
            # the first window of a command still has the number of the one before, as a third of them do
            number = max(step - 1, 0) if part == 0 else step
            rows.append(
                [
                    *(number, window, int(part > 0), i * PERIOD_S, 2.0 + step, 4.0, *wheels[i]),
                    *(*pose[i, :2], 0.0, 0.0, 0.0, pose[i, 2], *imu[i]),
                ]
            )
    return rows


def write(folder, rows, columns=COLUMNS):
    folder.mkdir(exist_ok=True)
    with gzip.open(folder / FILE_NAME, "wt", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return folder


def test_every_command_is_a_run_with_its_channels_in_si_units(tmp_path):
    rows = table()
    runs = [read() for read in find_runs(write(tmp_path / "log", rows), HUSKY)]
    assert [run.run_id for run in runs] == ["step_000", "step_001", "step_002"]
    of = {name: np.array(rows)[:, i].reshape(3, 3 * N) for i, name in enumerate(COLUMNS)}
    for i, run in enumerate(runs):
        assert (run.robot, run.labels, dict(run.dropped)) == ("husky", (), {})
        assert set(run.streams) == {"wheels", "imu", "lidar", "commands"}
        streams = run.streams
        time_s = streams["wheels"].time_s
        # one sample is lost after the first window, none after the second
        assert time_s[[0, N - 1, N, 2 * N - 1, 2 * N, -1]] == pytest.approx([0, 1.95, 2.05, 4.0, 4.05, 6.0])
        for stream in streams.values():
            assert np.array_equal(stream.time_s, time_s)
        left = streams["wheels"].channel("speed_left_mps")
        np.testing.assert_array_equal(left, of["wheel_left"][i] * RADIUS_M)
        np.testing.assert_array_equal(streams["imu"].channel("accel_y_mps2"), -of["imu_ay"][i])
        np.testing.assert_array_equal(streams["imu"].channel("gyro_z_radps"), of["imu_yaw"][i])
        np.testing.assert_array_equal(streams["commands"].channel("wheel_left_radps"), of["cmd_left"][i])
        found = streams["lidar"].values[np.isfinite(streams["lidar"].values).all(axis=1)]
        assert len(found) > 60
        assert np.abs(found - (0.5, 0.0, 0.4)).max() < 0.01


def test_a_sample_that_two_windows_share_is_read_once(tmp_path):
    rows = table(steps=1)
    logged = slice(COLUMNS.index("wheel_left"), COLUMNS.index("icp_x"))
    for row, before in ((N, N - 1), (2 * N, 2 * N - 2), (2 * N + 1, 2 * N - 1)):
        rows[row][logged] = rows[before][logged]
        rows[row][-4:] = rows[before][-4:]
    run = find_runs(write(tmp_path / "log", rows), HUSKY)[0]()
    assert len(run.streams["wheels"]) == 3 * N - 3
    np.testing.assert_allclose(run.streams["wheels"].time_s, np.arange(3 * N - 3) * PERIOD_S, atol=1e-9)
    kept = np.delete(np.arange(3 * N), [N, 2 * N, 2 * N + 1])
    np.testing.assert_array_equal(
        run.streams["imu"].channel("accel_z_mps2"), np.array(rows)[kept, COLUMNS.index("imu_az")]
    )


def test_a_log_that_stands_still_is_not_taken_for_a_repeated_one(tmp_path):
    rows = table(steps=1)
    for row in rows:
        row[COLUMNS.index("wheel_left") : COLUMNS.index("icp_x")] = [0.0, 0.0]
        row[-4:] = [0.0, 0.0, 0.0, 9.8]
    assert len(find_runs(write(tmp_path / "log", rows), HUSKY)[0]().streams["wheels"]) == 3 * N


def change(row, column, value):
    def apply(rows):
        rows[row][COLUMNS.index(column)] = value
        return rows

    return apply


def change_window(window, column, value):
    def apply(rows):
        for row in rows[window * N : (window + 1) * N]:
            row[COLUMNS.index(column)] = value
        return rows

    return apply


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: [], "log/samples.csv.gz: has no rows of data"),
        (change(7, "icp_x", "1.2.3"), "log/samples.csv.gz: icp_x at row 9 is '1.2.3', which is no number"),
        (change(7, "steady", "nan"), "log/samples.csv.gz: steady at row 9 is not finite (nan)"),
        (change(7, "time", ""), "time at row 9 is not finite (nan)"),
        (change(7, "time", 0.5), "time does not rise evenly in window 0"),
        (change(47, "time", 0.5), "time in window 1 is not that of window 0"),
        (change(47, "step", 1), "step in window 1 is 0, 1; it must be one whole number from 0 up"),
        (change_window(4, "steady", 2), "steady in window 4 is 2; it must be 0 or 1 throughout"),
        (change_window(4, "step", 0.5), "step in window 4 is 0.5; it must be one whole number from 0 up"),
        (change_window(0, "steady", 1), "the first window has steady 1; a command begins with steady 0"),
        (change_window(5, "step", 7), "the windows of one command have the steps 1, 7"),
        (change_window(1, "steady", 0), "the command of step 0 has one window only, at least one with"),
        (lambda rows: rows[: 4 * N], "the command of step 0 has one window only"),
        (lambda rows: rows[:-3], "window 8 has 37 samples, the first one has 40"),
        (lambda rows: [row for i, row in enumerate(rows) if i % N < 5], "windows have 5 samples, more"),
        (lambda rows: [*rows[:30], rows[30][:4], *rows[31:]], "row 32 has 4 cells, the header has 18"),
        (change_window(0, "icp_x", ""), None),
    ],
)  # fmt: skip
def test_a_broken_file_is_refused_in_one_sentence(tmp_path, spoil, message):
    folder = write(tmp_path / "log", spoil(table()))
    if message is None:
        assert np.isnan(load_runs(folder)[0].streams["lidar"].values[:N]).all()
        return
    with pytest.raises(LogError) as error:
        load_runs(folder)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_column_that_is_missing_or_dead_is_named(tmp_path):
    folder = write(tmp_path / "log", [row[:-1] for row in table()], COLUMNS[:-1])
    with pytest.raises(LogError, match=r"log/samples\.csv\.gz: column 'imu_az' is missing \(the file has"):
        load_runs(folder)
    dead = table()
    for window in (3, 4, 5):
        dead = change_window(window, "wheel_left", "")(dead)
    folder = write(tmp_path / "log", dead)
    with pytest.raises(LogError, match=r"step_001: channel speed_left_mps \(column wheel_left\) has nothing"):
        load_runs(folder)
    assert load_runs(folder, repair=True)[1].dropped == {"channels with nothing finite": 1}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda whole: b"", "is empty"),
        (lambda whole: whole[:2000], "is no whole gzip file"),
        (lambda whole: whole[:1000] + bytes(200) + whole[1200:], "is no whole gzip file"),
        (lambda whole: b"step,window\n1,2\n", "is no whole gzip file"),
        (lambda whole: gzip.compress(b"\xff\xfe\x00step"), "is no CSV text"),
    ],
)
def test_a_broken_archive_is_refused(tmp_path, content, message):
    path = write(tmp_path / "log", table()) / FILE_NAME
    path.write_bytes(content(path.read_bytes()))
    with pytest.raises(LogError, match=rf"^log/samples\.csv\.gz: {message}"):
        load_runs(path.parent)


def test_repair_skips_a_command_that_has_one_window_only(tmp_path, caplog):
    runs = load_runs(write(tmp_path / "log", table()[: 4 * N]), repair=True)
    assert [run.run_id for run in runs] == ["step_000"]
    assert "the command of step 0 has one window only" in caplog.text


def numbers(run, stream, channel):
    return run.streams[stream].channel(channel)


def sessions(tmp_path, names=("asphalt_1", "asphalt_2", "sand_1")):
    folder = tmp_path / "logs"
    folder.mkdir()
    for seed, name in enumerate(names):
        write(folder / name, table(steps=2, seed=seed))
    return folder


def robot_file(tmp_path, name="mule", **changed):
    path = tmp_path / f"{name}.yaml"
    values = {"wheel_radius_m": 0.3, "track_m": 1.08, "wheelbase_m": 0.9, "mass_kg": 280.0} | changed
    lines = [
        f"{key}: {{value: {value}, unit: {key.rpartition('_')[2]}, source: me}}"
        for key, value in values.items()
        if value is not None and key != "drive"
    ]
    path.write_text(
        "\n".join([f"name: {name}", f"drive: {changed.get('drive', 'skid_steer')}", *lines]) + "\n"
    )
    return path


def test_sessions_are_read_as_one_data_set_of_the_robot_that_is_named(tmp_path):
    folder, robot = sessions(tmp_path), robot_file(tmp_path)
    runs = load_runs(folder, robot=robot)
    assert [run.run_id for run in runs] == [
        f"{session}_step_00{i}" for session in ("asphalt_1", "asphalt_2", "sand_1") for i in (0, 1)
    ]
    assert {run.robot for run in runs} == {"mule"}
    assert [run.session for run in runs] == [run.run_id[:-9] for run in runs]
    assert [run.terrains for run in runs] == [("asphalt",)] * 4 + [("sand",)] * 2
    for run in runs:
        (label,) = run.labels
        assert label.start_s <= run.start_s
        assert run.end_s < label.end_s
    alone = load_runs(folder / "sand_1", robot=robot)
    assert data_digest(alone) == data_digest(runs[4:])
    # the radius is the robot's: the same wheels are faster by the ratio of the two
    as_husky = load_runs(folder / "sand_1")
    assert {run.robot for run in as_husky} == {"husky"}
    np.testing.assert_allclose(
        numbers(alone[0], "wheels", "speed_left_mps") / numbers(as_husky[0], "wheels", "speed_left_mps"),
        0.3 / RADIUS_M,
    )


def test_the_session_is_saved_and_loaded(tmp_path):
    settings = ConvertSettings(data=sessions(tmp_path), out=tmp_path / "raw", robot=str(robot_file(tmp_path)))
    found = convert(settings)
    runs = load_runs(tmp_path / "raw")
    assert {run.session for run in runs} == {"asphalt_1", "asphalt_2", "sand_1"}
    assert data_digest(runs) == found.digest


def test_a_folder_that_is_no_plain_set_of_sessions_is_refused(tmp_path, caplog):
    folder = sessions(tmp_path)
    (folder / "empty_1").mkdir()
    with pytest.raises(
        LogError, match=r"empty_1: has no samples\.csv\.gz, which the other sessions beside it"
    ):
        load_runs(folder)
    assert len(load_runs(folder, repair=True)) == 6
    assert len(caplog.messages) == 1
    (folder / "empty_1").rmdir()
    (folder / "SNOW").mkdir()
    for name in ("imu_1.csv", "pro_1.csv"):
        (folder / "SNOW" / name).write_text("time\n0\n")
    with pytest.raises(LogError, match="mixes the layouts borealtc and drive; choose one with --format"):
        load_runs(folder)
    write(folder, table(steps=1))
    with pytest.raises(
        LogError, match=r"holds samples\.csv\.gz itself and in asphalt_1; give the folder of one"
    ):
        load_runs(folder, layout="drive")
    with pytest.raises(LogError, match="holds no run"):
        load_runs(tmp_path / "logs" / "SNOW", layout="drive")


def test_a_robot_that_cannot_have_driven_the_log_is_refused(tmp_path):
    folder = write(tmp_path / "log", change_window(4, "wheel_left", 9.5)(table()))
    with pytest.raises(LogError, match=r"turn at up to 9\.5 rad/s, those of robot husky at up to 6\.1 rad/s"):
        load_runs(folder)
    assert len(load_runs(folder, robot=robot_file(tmp_path))) == 3
    with pytest.raises(ConfigError, match="robot agrimaro: drive 'swerve' does not fit logs of DRIVE"):
        load_runs(folder, robot="agrimaro")
    with pytest.raises(ConfigError, match="key 'wheel_radius_m' is missing"):
        load_runs(folder, robot=robot_file(tmp_path, wheel_radius_m=None))


def test_a_wheel_speed_held_for_long_is_a_measurement_where_it_is_new(tmp_path):
    """Sides that are new in turn every fifth sample, speeding up evenly after a stop: a held value lags by
    up to four samples, a straight line by none, and nothing moves before the wheels do."""
    rows = table(steps=1)
    time_s = np.arange(3 * N) * PERIOD_S
    time_s[N:] += PERIOD_S
    true = np.maximum(0.0, time_s - 2.5)
    for column, first in (("wheel_left", 1), ("wheel_right", 3)):
        update = np.maximum((np.arange(3 * N) - first) // 5 * 5 + first, 0)
        for row, at in zip(rows, update, strict=True):
            row[COLUMNS.index(column)] = true[at]
    (run,) = load_runs(write(tmp_path / "log", rows))
    found = run.streams["wheels"].values / RADIUS_M
    moving = (time_s > 2.8) & (time_s < time_s[-6])
    np.testing.assert_allclose(found[moving], np.column_stack([true, true])[moving], atol=1e-9)
    assert not found[time_s < 2.2].any()


def test_straight_lines_keep_every_measurement_and_holds_what_was_measured_again():
    rng = np.random.default_rng(3)
    measured = rng.normal(size=12)
    measured[5] = measured[4]  # measured again, and the same
    held = measured.repeat(4)
    time_s = np.arange(held.size) * PERIOD_S
    found = undo_hold(held[:, None], time_s, [4])[:, 0]
    np.testing.assert_array_equal(found[::4], measured)
    assert (found[16:21] == measured[4]).all()
    assert np.ptp(found[20:24]) > 0.0
    assert np.isnan(undo_hold(np.full((8, 1), np.nan), time_s[:8], [4])).all()


WARTHOG = ("asphalt_1", "asphalt_2", "asphalt_3", "gravel_1", "sand_1", "sand_2")


@pytest.fixture(scope="module")
def warthog_runs(measured):
    measured(f"drive_warthog_terrains/gravel_1/{FILE_NAME}")
    return load_runs(measured("drive_warthog_terrains"), robot="warthog")


def test_all_sessions_of_the_warthog_are_read(warthog_runs):
    assert [run.run_id for run in warthog_runs] == [f"{s}_step_{i:03d}" for s in WARTHOG for i in range(100)]
    assert {run.session: run.terrains for run in warthog_runs} == {s: (s[:-2],) for s in WARTHOG}


@pytest.mark.parametrize("session", WARTHOG)
def test_the_warthogs_lidar_agrees_with_its_wheels_and_its_gyro(warthog_runs, session):
    """Steady turns, means of a window each: the slope is one, but for skidding.

    The gyro's sign is turned on the gravel, and there alone.
    """
    lidar, gyro, wheels = [], [], []
    for run in warthog_runs:
        if run.session == session:
            window = slice(-N, None)
            rate = numbers(run, "lidar", "yaw_rate_radps")[window]
            if np.isfinite(rate).sum() > 10:
                lidar.append(np.nanmean(rate))
                gyro.append(numbers(run, "imu", "gyro_z_radps")[window].mean())
                left, right = run.streams["wheels"].values[window].mean(axis=0)
                wheels.append((right - left) / load_robot("warthog").track_m)
    assert len(lidar) > 50
    slope = np.polyfit(gyro, lidar, 1)
    assert slope[0] == pytest.approx(1.0, abs=0.05)
    turned = {run.dropped.get(GYRO_TURNED, 0) for run in warthog_runs if run.session == session}
    assert turned == {int(session == "gravel_1")}
    turned = np.polyfit(wheels, lidar, 1)[0]
    assert 0.45 < turned < 0.7


@pytest.fixture(scope="module")
def husky_file(measured):
    return measured(f"drive_husky/{FILE_NAME}")


@pytest.fixture(scope="module")
def husky_runs(husky_file):
    return load_runs(husky_file.parent)


def test_the_published_file_agrees_with_the_plain_csv_module(husky_file, husky_runs):
    """Two routes, every cell: nothing is lost but the samples that two windows share."""
    with gzip.open(husky_file, "rt", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [run.run_id for run in husky_runs] == [f"step_{i:03d}" for i in range(201)]
    assert sum(len(run.streams["imu"]) for run in husky_runs) == len(rows) - 42
    for number in (1, 5, 200):
        of_run = [row for row in rows if int(row["window"]) // 3 == number]
        run = husky_runs[number]
        at = np.rint(run.streams["imu"].time_s / PERIOD_S).astype(int)
        assert np.all(np.diff(at) >= 1)
        assert at[-1] <= 3 * N
        for name, columns in STREAMS.items():
            for channel, (column, factor) in columns.items():
                found = run.streams[name].channel(channel).tolist()
                scale = factor * (RADIUS_M if name == "wheels" else 1.0)
                listed = [float(row[column]) * scale for row in of_run]
                if len(found) == len(listed):
                    assert found == listed
                else:
                    assert set(found) <= set(listed)


def test_the_lidar_agrees_with_the_gyro_and_the_wheels(husky_runs):
    """The gyro knows nothing of the pose: one slope, no offset, and a lag of 0.16 s."""
    spans = [slice(0, N - 3), slice(N + 3, 2 * N - 3), slice(2 * N + 3, 3 * N)]
    lidar, gyro, ahead = [], [], []
    for run in husky_runs:
        for span in spans:
            rate = run.streams["lidar"].channel("yaw_rate_radps")[span]
            raw = run.streams["imu"].channel("gyro_z_radps")[span]
            smooth = np.convolve(raw, np.ones(9) / 9, mode="same")
            lidar.append(rate[10:-4])
            gyro.append(smooth[10:-4])
            ahead.append(smooth[7 : 7 + len(lidar[-1])])
    lidar, gyro, ahead = (np.concatenate(part) for part in (lidar, gyro, ahead))
    seen = np.isfinite(lidar)
    assert seen.mean() > 0.75
    slope, offset = np.polyfit(ahead[seen], lidar[seen], 1)
    assert slope == pytest.approx(1.0, abs=0.03)
    assert abs(offset) < 0.005
    assert np.std(lidar[seen] - ahead[seen]) < 0.05 < np.std(lidar[seen] - gyro[seen])


def test_wheels_run_faster_than_the_ground_in_straight_driving(husky_runs):
    ratios, accelerations = [], []
    for run in husky_runs:
        left, right = run.streams["wheels"].values[N:].T
        speed = run.streams["lidar"].channel("speed_x_mps")[N:]
        wheel_speed = (left + right) / 2
        if np.abs(left - right).mean() < 0.15 and np.abs(wheel_speed).mean() > 0.3:
            ratios.append(np.nanmean(speed) / wheel_speed.mean())
        start = run.streams["wheels"].values[[0, N - 1]].mean(axis=1)
        accelerations.append(
            (start[1] - start[0], run.streams["imu"].channel("accel_x_mps2")[:N].mean() * 1.95)
        )
    assert len(ratios) >= 5
    assert 0.92 < np.median(ratios) < 1.0
    gained, integrated = np.transpose(accelerations)
    assert np.corrcoef(gained, integrated)[0, 1] > 0.6  # negative with the axes as published


def test_import_writes_what_was_read(tmp_path):
    folder = write(tmp_path / "log", table())
    found = convert(ConvertSettings(data=folder, out=tmp_path / "raw", layout="drive"))
    assert (found.n_runs, found.labels) == (3, {})
    assert data_digest(load_runs(tmp_path / "raw")) == found.digest == data_digest(load_runs(folder))
