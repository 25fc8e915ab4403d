import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import LogError
from terrain.kinematics.wheels import rolling_matrix
from terrain.logs import robotino
from terrain.logs.digest import data_digest
from terrain.logs.robotino import HELD, NO_SIGN, SCALED
from terrain.robots import load_robot

PIXEL_M = 0.0018
COLUMNS = (
    *("t", "xsetspeed", "ysetspeed", "setvel", "m1setvel", "m2setvel", "m3setvel"),
    *("m1pos", "m2pos", "m3pos", "m1vel", "m2vel", "m3vel", "m1cur", "m2cur", "m3cur"),
    *("xcur", "ycur", "rotcur", "xpos", "ypos", "ang", "dx", "dy", "dang"),
)
ROBOT = load_robot("robotino")


def columns_of(twist=(0.08, 0.06, 0.0), slip=0.2, heading=0.3, n=120, scale=1.0137):
    """Return what the logger writes of a robot that slips alike in all directions, as it turns and drives."""
    rng = np.random.default_rng(3)
    time_s = np.cumsum(rng.uniform(0.029, 0.033, n))
    motor = (
        16.0 / 0.04 * np.array(twist) @ rolling_matrix(ROBOT.wheel_positions_m, ROBOT.wheel_directions_rad).T
    )
    yaw = heading + (1 - slip) * twist[2] * time_s
    step = np.exp(1j * yaw) * complex(twist[0], twist[1]) * (1 - slip)
    place = np.concatenate([[0], np.cumsum((step[1:] + step[:-1]) / 2 * np.diff(time_s))]) + 1.5 - 0.7j
    held = np.floor(time_s / 0.0187) * 0.0187  # the counts' own clock
    table = dict.fromkeys(COLUMNS, np.zeros(n))
    table |= dict(zip(("t", "xsetspeed", "ysetspeed", "setvel"), (time_s * 1e3, *twist), strict=True))
    for i in range(3):
        table[f"m{i + 1}setvel"] = motor[i]
        table[f"m{i + 1}pos"] = np.round(held * motor[i] * 2000 / (2 * np.pi))
        table[f"m{i + 1}vel"] = motor[i] * scale
        table[f"m{i + 1}cur"] = 0.4 + 0.1 * i
    table |= {"xpos": place.real / PIXEL_M, "ypos": -place.imag / PIXEL_M, "ang": np.degrees(yaw) - 90.0}
    return {
        name: np.broadcast_to(np.asarray(values, dtype=float), n).copy() for name, values in table.items()
    }


def write_log(path: Path, table, header=COLUMNS):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [";".join(f"long name of {name}" for name in header) + ";", ";".join("u" for _ in header) + ";"]
    rows += [";".join(header) + ";"]
    rows += [";".join(str(table[name][i]) for name in header) + ";" for i in range(len(table["t"]))]
    with gzip.open(path, "wt", encoding="utf-8") as file:
        file.write("\n".join(rows) + "\n")


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "robotino"
    folder.mkdir()
    scales = {"pixel_resolution_x": PIXEL_M * 1e3, "pixel_resolution_y": PIXEL_M * 1e3}
    (folder / "camera_params.json").write_text(json.dumps(scales))
    return folder


def written(root, table=None, where="one_surface/moss/exp07.csv.gz", **keywords):
    write_log(root / where, columns_of() if table is None else table, **keywords)
    return root


def test_a_run_comes_back_in_the_frames_of_the_project(root):
    twist, slip, heading = (0.08, 0.06, 0.0), 0.2, 0.3
    (run,) = load_runs(written(root, columns_of(twist, slip, heading)))
    assert (run.run_id, run.robot, run.terrains, run.session) == ("moss_07", "robotino", ("moss",), "")
    wheels, pose = run.streams["wheels"], run.streams["pose"]
    speeds = np.column_stack([wheels.channel(f"speed_{i}_mps") for i in (1, 2, 3)])
    expected = np.array(twist) @ rolling_matrix(ROBOT.wheel_positions_m, ROBOT.wheel_directions_rad).T
    # The hold of the counts, 19 ms, against the 3.7 s of the run.
    np.testing.assert_allclose(speeds.mean(axis=0), expected, atol=0.005 * np.hypot(*twist[:2]))
    span_s = pose.time_s[-1] - pose.time_s[0]
    moved = pose.values[-1, :2] - pose.values[0, :2]
    along = (1 - slip) * np.array(
        [
            np.cos(heading) * twist[0] - np.sin(heading) * twist[1],
            np.sin(heading) * twist[0] + np.cos(heading) * twist[1],
        ]
    )
    np.testing.assert_allclose(moved / span_s, along, atol=1e-9)
    np.testing.assert_allclose(pose.channel("yaw_rad"), heading, atol=1e-12)
    np.testing.assert_allclose(run.streams["commands"].values, np.broadcast_to(twist, (120, 3)))


def test_every_change_is_counted_and_named(root):
    table = columns_of()
    for name in ("xpos", "ypos", "ang"):
        table[name][40:43] = table[name][39]
    (run,) = load_runs(written(root, table))
    assert run.dropped == {SCALED: 3, NO_SIGN: 3, HELD: 3}
    assert len(run.streams["pose"]) == 117


def test_the_scale_of_a_rate_is_that_of_its_counts_whatever_the_direction(root):
    for number, twist in enumerate([(0.1, 0.0, 0.0), (-0.05, 0.0866, 0.0), (0.0, 0.0, 0.6)]):
        write_log(root / f"one_surface/moss/exp{number:02d}.csv.gz", columns_of(twist, scale=1.05))
    for run, twist in zip(load_runs(root), [(0.1, 0, 0), (-0.05, 0.0866, 0), (0, 0, 0.6)], strict=True):
        expected = (
            np.array(twist, float) @ rolling_matrix(ROBOT.wheel_positions_m, ROBOT.wheel_directions_rad).T
        )
        speeds = run.streams["wheels"].values[:, -3:].mean(axis=0)
        np.testing.assert_allclose(speeds, expected, atol=0.006 * np.abs(expected).max())


def test_names_come_from_the_folders(root):
    table = columns_of()
    for where in ("one_surface/草地/exp01", "two_surfaces/moss_cork/exp02", "weights/cork/exp03"):
        write_log(root / f"{where}.csv.gz", table)
    motors = {name: table[name] for name in COLUMNS[:1] + COLUMNS[4:16]}
    write_log(root / "dc_motor/bench.csv.gz", motors, tuple(motors))
    write_log(root / "weights/cork/uniform_load.csv.gz", motors, tuple(motors))
    runs = {run.run_id: run for run in load_runs(root)}
    assert sorted(runs) == ["dc_motor_bench", "moss_cork_02", "weights_cork_03", "草地_01"]
    assert runs["草地_01"].terrains == ("草地",)
    assert (runs["moss_cork_02"].terrains, runs["moss_cork_02"].session) == ((), "moss_cork")
    assert (runs["weights_cork_03"].terrains, runs["weights_cork_03"].session) == (("cork",), "weights_cork")
    assert sorted(runs["dc_motor_bench"].streams) == ["wheels"]


def test_a_folder_of_the_data_set_is_read_alone(root):
    write_log(root / "one_surface/moss/exp01.csv.gz", columns_of())
    write_log(root / "one_surface/cork/exp01.csv.gz", columns_of())
    assert [run.run_id for run in load_runs(root / "one_surface" / "moss")] == ["moss_01"]


def _cell(column, row, value):
    def change(table):
        table[column] = table[column].astype(object)
        table[column][row] = value

    return change


def _restart(table):
    table["t"][80:] -= table["t"][80]


def _lost(table):
    for name in ("xpos", "ypos", "ang"):
        table[name][:] = table[name][0]


def _other_session(table):
    table["m2setvel"] += 5.0


@pytest.mark.parametrize(
    ("change", "message", "repaired"),
    [
        (
            _cell("m2cur", 5, "high"),
            "m2cur at row 9 is 'high', which is no number",
            "cells that are no number",
        ),
        (_restart, "time goes back at row 84", "rows with a bad time"),
        (_lost, "the camera shows 1 different poses while the wheels turn", robotino.BLIND),
        (_cell("m3vel", slice(None), "nan"), "channel motor_3_radps", "channels with nothing finite"),
        (_other_session, "the commanded motor speeds are 5 rad/s away", None),
        (_cell("t", slice(1, None), "nan"), "time at row 5 is not finite", None),
    ],
    ids=["text", "clock", "camera", "dead wheel", "other session", "no time"],
)
def test_a_fault_is_refused_in_one_sentence_and_counted_when_repaired(
    root, change, message, repaired, caplog
):
    table = columns_of()
    change(table)
    written(root, table)
    write_log(root / "one_surface/moss/exp08.csv.gz", columns_of())
    with pytest.raises(LogError) as error:
        load_runs(root)
    assert message in str(error.value)
    assert str(error.value).startswith("moss/exp07.csv.gz: ")
    assert "\n" not in str(error.value)
    runs = {run.run_id: run for run in load_runs(root, repair=True)}
    if repaired is None:
        assert list(runs) == ["moss_08"]
        assert len(caplog.messages) == 1
    else:
        assert runs["moss_07"].dropped[repaired] >= 1


def test_a_missing_column_and_a_damaged_file_are_named(root):
    header = tuple(name for name in COLUMNS if name != "m2vel")
    written(root, header=header)
    with pytest.raises(LogError, match=r"moss/exp07\.csv\.gz: column 'm2vel' is missing"):
        load_runs(root)
    whole = (root / "one_surface/moss/exp07.csv.gz").read_bytes()
    (root / "one_surface/moss/exp07.csv.gz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogError, match=r"moss/exp07\.csv\.gz: is no whole gzip file"):
        load_runs(root)


@pytest.mark.parametrize("scale", ["null", '"wide"', "-1", "0", "true"])
def test_a_camera_without_a_scale_is_refused(root, scale):
    written(root)
    (root / "camera_params.json").write_text(f'{{"pixel_resolution_x": 1.8, "pixel_resolution_y": {scale}}}')
    with pytest.raises(LogError, match=r"pixel_resolution_y is .*millimetres a pixel are required"):
        load_runs(root)


def test_measured_runs_go_where_they_are_commanded(measured):
    """A sign or a frame that is wrong would turn the path; slip only shortens it."""
    runs = load_runs(measured("robotino") / "one_surface" / "table")
    for run in runs:
        pose, commands = run.streams["pose"], run.streams["commands"]
        moved = np.diff(pose.values[[0, -1], :2], axis=0)[0]
        heading = pose.channel("yaw_rad").mean()
        course = np.arctan2(moved[1], moved[0]) - heading
        twist = commands.values[10]
        apart = np.angle(np.exp(1j * (course - np.arctan2(twist[1], twist[0]))))
        assert abs(apart) < np.radians(8.0), run.run_id


def test_import_and_read_again_give_one_digest(root, tmp_path):
    written(root)
    out = tmp_path / "runs"
    result = convert(ConvertSettings(data=root, out=out))
    again = load_runs(out)
    assert data_digest(again) == data_digest(load_runs(root)) == result.digest
    assert again[0].dropped == load_runs(root)[0].dropped
