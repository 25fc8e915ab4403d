import json

import numpy as np
import pytest

from pipelines.data import convert, inspect
from pipelines.data.datasets import load_runs
from pipelines.report.results import as_json
from pipelines.report.terminal import terminal_text
from terrain.errors import TerrainError
from terrain.logs.run_folders import data_digest, write_run
from terrain.records import RunLog, Stream


def converted(data, out, **options):
    return convert.run(convert.Settings(data=data, out=out, **options))


def inspected(data):
    return inspect.run(inspect.Settings(data=data))


def tree(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_imported_runs_are_the_runs_that_were_read(borealtc_dir, tmp_path):
    (borealtc_dir / "notes.mcap").write_text("no bag")  # beside files of another layout no matter
    steps = []
    asked = convert.Settings(data=borealtc_dir, out=tmp_path / "out")
    result = convert.run(asked, progress=lambda *step: steps.append(step))
    assert steps == [("write runs", n, 3) for n in (1, 2, 3)]
    assert result.run_ids == ("ICE_01", "SNOW_01", "SNOW_02")
    assert (result.labels, result.dropped, result.skipped) == ({"ICE": 1, "SNOW": 2}, {}, ())
    assert result.digest == data_digest(load_runs(tmp_path / "out")) == data_digest(load_runs(borealtc_dir))


def test_what_cannot_be_read_or_written_is_one_sentence_and_touches_nothing(borealtc_dir, tmp_path, make_run):
    write_run(make_run("SNOW_02", seed=9), tmp_path / "taken")
    (tmp_path / "mcap").mkdir()
    (tmp_path / "mcap" / "SNOW_02.mcap").write_text("mine")
    (tmp_path / "file").write_text("an obstacle")
    for out, target, fault in (
        ("taken", "runs", "SNOW_02: is there already, and is left as it is"),
        ("mcap", "mcap", "SNOW_02.mcap: is there already"),
        ("file/out", "runs", "cannot be written"),
        ("out", "runs", r"SNOW/pro_02\.csv: column 'velL' is missing"),
    ):
        if out == "out":
            (borealtc_dir / "SNOW" / "pro_02.csv").write_text("time\n")
        before = tree(tmp_path)
        with pytest.raises(TerrainError, match=fault) as error:
            converted(borealtc_dir, tmp_path / out, to=target)
        assert "\n" not in str(error.value)
        assert tree(tmp_path) == before
    assert not (tmp_path / "out").exists()


def test_a_run_whose_numbers_cannot_be_true_is_refused_and_counted_with_repair(tmp_path, make_run):
    run = make_run("ICE_01")
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[:, imu.channels.index("accel_z_mps2")] += 1e4
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    write_run(RunLog(run.run_id, run.robot, streams, run.labels), tmp_path / "runs")
    with pytest.raises(TerrainError, match=r"ICE_01: implausible .* with --repair"):
        converted(tmp_path / "runs", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    result = converted(tmp_path / "runs", tmp_path / "out", repair=True)
    assert any(kind.startswith("implausible ") for kind in result.dropped)


def test_repair_is_counted_and_the_counts_travel_with_the_runs(borealtc_dir, tmp_path, edit):
    edit(borealtc_dir / "SNOW" / "imu_01.csv", lambda lines: [*lines[:30], *lines[29:]])
    (borealtc_dir / "ICE" / "pro_01.csv").unlink()
    result = converted(borealtc_dir, tmp_path / "out", repair=True)
    assert (result.run_ids, result.dropped) == (("SNOW_01", "SNOW_02"), {"rows with a bad time": 1})
    assert result.skipped == ("run skipped: ICE/pro_01.csv: is missing",)
    assert [run.dropped for run in inspected(tmp_path / "out").runs] == [{"rows with a bad time": 1}, {}]


def test_inspect_shows_rates_gaps_stuck_channels_missing_values_and_the_clock(borealtc_dir, edit):
    def spoil(lines):
        rows = [line.split(",") for line in lines]
        for row in rows[100:150]:
            row[6] = "9.81"  # az freezes
        rows[20][1] = ""
        return [",".join(row) for row in rows[:60] + rows[70:]]

    edit(borealtc_dir / "SNOW" / "imu_01.csv", spoil)
    report = as_json(inspected(borealtc_dir))
    json.dumps(report, allow_nan=False)
    run = next(run for run in report["runs"] if run["run_id"] == "SNOW_01")
    imu = run["streams"]["imu"]
    assert (imu["n"], imu["n_gaps"], imu["stuck"]) == (190, 1, ["accel_z_mps2"])
    figures = (imu["rate_hz"], imu["longest_gap_s"], imu["longest_gap_at_s"])
    assert figures == pytest.approx((50.0, 11 / 50, 58 / 50))
    assert imu["n_nonfinite"]["gyro_x_radps"] == 1
    assert run["streams"]["wheels"]["stuck"] == []
    assert (run["clock"]["status"], run["clock"]["offset_s"]) == ("not excited", None)


def test_runs_without_wheels_or_with_a_foreign_robot_are_inspected_too(tmp_path, make_run):
    run = make_run()
    write_run(RunLog("A", "husky", {"imu": run.streams["imu"]}), tmp_path)
    write_run(RunLog("B", "somebody's own", run.streams), tmp_path)
    result = inspected(tmp_path)
    assert [run.clock for run in result.runs] == [None, None]
    assert result.runs[0].terrains == ()
    assert list(result.to_pandas()["stream"]) == ["imu", *run.streams]
    assert len(terminal_text(result.report).splitlines()) <= 25
    assert np.isfinite(result.runs[1].streams["wheels"].rate_hz)
