import json

import numpy as np
import pytest

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.inspect import run as inspect_runs
from pipelines.report.json_file import as_json
from pipelines.report.terminal import terminal_text
from terrain.errors import LogError, TerrainError
from terrain.logs.digest import data_digest
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream


def tree(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_imported_runs_are_the_runs_that_were_read(borealtc_dir, tmp_path):
    steps = []
    asked = ConvertSettings(data=borealtc_dir, out=tmp_path / "out")
    report = as_json(convert(asked, progress=lambda *step: steps.append(step)))
    assert steps == [("write runs", n, 3) for n in (1, 2, 3)]
    assert report["run_ids"] == ["ICE_01", "SNOW_01", "SNOW_02"]
    assert (report["labels"], report["dropped"], report["skipped"]) == ({"ICE": 1, "SNOW": 2}, {}, [])
    assert (
        report["digest"] == data_digest(load_runs(tmp_path / "out")) == data_digest(load_runs(borealtc_dir))
    )
    json.dumps(report, allow_nan=False)


def test_what_cannot_be_read_or_written_is_one_sentence_and_touches_nothing(borealtc_dir, tmp_path, make_run):
    write_run(make_run("SNOW_02", seed=9), tmp_path / "taken")
    (tmp_path / "file").write_text("an obstacle")
    before = tree(tmp_path)
    for out, fault in (
        ("taken", "SNOW_02: is there already, and is left as it is"),
        ("file/out", "cannot be written"),
    ):
        with pytest.raises(TerrainError, match=fault) as error:
            convert(ConvertSettings(data=borealtc_dir, out=tmp_path / out))
        assert "\n" not in str(error.value)
        assert tree(tmp_path) == before
    (borealtc_dir / "SNOW" / "pro_02.csv").write_text("time\n")
    with pytest.raises(LogError, match=r"SNOW/pro_02\.csv: column 'velL' is missing"):
        convert(ConvertSettings(data=borealtc_dir, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_run_whose_numbers_cannot_be_true_is_refused_and_counted_with_repair(tmp_path, make_run):
    run = make_run("ICE_01")
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[:, imu.channels.index("accel_z_mps2")] += 1e4
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    write_run(RunLog(run.run_id, run.robot, streams, run.labels), tmp_path / "runs")
    with pytest.raises(LogError, match=r"ICE_01: implausible .* with --repair"):
        convert(ConvertSettings(data=tmp_path / "runs", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    report = convert(ConvertSettings(data=tmp_path / "runs", out=tmp_path / "out", repair=True))
    assert any(kind.startswith("implausible ") for kind in report.dropped)


def test_repair_is_counted_and_the_counts_travel_with_the_runs(borealtc_dir, tmp_path, edit):
    edit(borealtc_dir / "SNOW" / "imu_01.csv", lambda lines: [*lines[:30], *lines[29:]])
    (borealtc_dir / "ICE" / "pro_01.csv").unlink()
    report = convert(ConvertSettings(data=borealtc_dir, out=tmp_path / "out", repair=True))
    assert report.run_ids == ("SNOW_01", "SNOW_02")
    assert report.dropped == {"rows with a bad time": 1}
    assert report.skipped == ("run skipped: ICE/pro_01.csv: is missing",)
    inspected = inspect_runs(InspectSettings(data=tmp_path / "out"))
    assert [run.dropped for run in inspected.runs] == [{"rows with a bad time": 1}, {}]


def test_inspect_shows_rates_gaps_stuck_channels_missing_values_and_the_clock(borealtc_dir, edit):
    def spoil(lines):
        rows = [line.split(",") for line in lines]
        for row in rows[100:150]:
            row[6] = "9.81"  # az freezes
        rows[20][1] = ""
        return [",".join(row) for row in rows[:60] + rows[70:]]

    edit(borealtc_dir / "SNOW" / "imu_01.csv", spoil)
    report = as_json(inspect_runs(InspectSettings(data=borealtc_dir)))
    json.dumps(report, allow_nan=False)
    run = next(run for run in report["runs"] if run["run_id"] == "SNOW_01")
    imu = run["streams"]["imu"]
    assert (imu["n"], imu["n_gaps"], imu["stuck"]) == (190, 1, ["accel_z_mps2"])
    assert imu["rate_hz"] == pytest.approx(50.0)
    assert imu["longest_gap_s"] == pytest.approx(11 / 50)
    assert imu["longest_gap_at_s"] == pytest.approx(58 / 50)
    assert imu["n_nonfinite"]["gyro_x_radps"] == 1
    assert run["streams"]["wheels"]["stuck"] == []
    assert run["clock"]["status"] == "not excited"
    assert run["clock"]["offset_s"] is None


def test_runs_without_wheels_or_with_a_foreign_robot_are_inspected_too(tmp_path, make_run):
    run = make_run()
    write_run(RunLog("A", "husky", {"imu": run.streams["imu"]}), tmp_path)
    write_run(RunLog("B", "somebody's own", run.streams), tmp_path)
    report = inspect_runs(InspectSettings(data=tmp_path))
    assert [run.clock for run in report.runs] == [None, None]
    assert report.runs[0].terrains == ()
    assert list(report.to_pandas()["stream"]) == ["imu", *run.streams]
    assert len(terminal_text(report.report).splitlines()) <= 25
    assert np.isfinite(report.runs[1].streams["wheels"].rate_hz)
