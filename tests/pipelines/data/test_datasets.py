import shutil

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from terrain.logs.run_folders import data_digest, write_run

from .foreign_bags import refused


def test_the_measured_data_sets_are_read_whole(datasets_dir):
    borealtc, vulpi = (load_runs(datasets_dir / name) for name in ("borealtc", "vulpi"))
    assert (len(borealtc), len(vulpi)) == (51, 18)
    assert {label.terrain for run in vulpi for label in run.labels} == {
        "CONCRETE", "DIRT_ROAD", "PLOUGHED", "UNPLOUGHED",
    }  # fmt: skip
    assert [run.run_id for run in borealtc] == sorted(run.run_id for run in borealtc)
    assert sum(len(run.streams["imu"]) for run in borealtc) == pytest.approx(340_000, rel=0.1)
    for run in [
        *borealtc,
        *vulpi,
    ]:  # columns are taken by name: gravity is on z, wheels turn at walking speed
        assert 8.0 < np.mean(run.streams["imu"].channel("accel_z_mps2")) < 11.0
        assert np.max(np.abs(run.streams["wheels"].channel("speed_left_mps"))) < 1.6


def test_run_folders_and_a_single_run_folder_are_found_and_two_of_one_id_refused(tmp_path, make_run):
    for run_id in ("SNOW_02", "SNOW_01"):
        write_run(make_run(run_id), tmp_path)
    assert [run.run_id for run in load_runs(tmp_path)] == ["SNOW_01", "SNOW_02"]
    assert [run.run_id for run in load_runs(tmp_path / "SNOW_02")] == ["SNOW_02"]
    shutil.copytree(tmp_path / "SNOW_01", tmp_path / "copy")
    refused(r"2 runs have the id 'SNOW_01' \(.*/SNOW_01 and .*/copy\)", tmp_path)


def test_what_holds_no_run_and_options_that_do_not_go_together_are_refused(tmp_path):
    for layout in ("auto", "runs", "borealtc"):
        refused(r"holds no run; accepted are run folders \(run.json\), the BorealTC", tmp_path, layout=layout)
        refused("nowhere: does not exist; accepted are", tmp_path / "nowhere", layout=layout)
    (tmp_path / "file.csv").touch()
    refused("file.csv: is no folder", tmp_path / "file.csv")
    refused("--format is 'rosbag': input should be 'auto', 'runs'", tmp_path, layout="rosbag")
    refused("the layout 'csv' needs a mapping file", tmp_path, layout="csv")
    of_csv = {"layout": "runs", "mapping": tmp_path / "map.yaml"}
    refused("a mapping file is for CSV files, not for the layout 'runs'", tmp_path, **of_csv)


def test_repair_skips_and_reports_what_cannot_be_read(borealtc_dir, caplog):
    (borealtc_dir / "SNOW" / "pro_01.csv").unlink()
    (borealtc_dir / "ICE" / "imu_01.csv").write_text("")
    refused(None, borealtc_dir)
    runs = load_runs(borealtc_dir, repair=True)
    assert [run.run_id for run in runs] == ["SNOW_02"]
    assert caplog.messages == [
        "run skipped: ICE/imu_01.csv: is empty (a header and at least 2 rows are needed)",
        "run skipped: SNOW/pro_01.csv: is missing",
    ]
    (borealtc_dir / "SNOW" / "pro_02.csv").unlink()
    refused(r"not one run could be read, the first for this: ICE/imu_01\.csv: is", borealtc_dir, repair=True)


def test_align_moves_the_wheels_of_runs_whose_clocks_can_be_compared(datasets_dir, tmp_path):
    for name in ("imu_04.csv", "pro_04.csv"):
        (tmp_path / "ASPHALT").mkdir(exist_ok=True)
        shutil.copy(datasets_dir / "borealtc" / "ASPHALT" / name, tmp_path / "ASPHALT")
    (plain,), (aligned,) = load_runs(tmp_path), load_runs(tmp_path, align=True)
    assert data_digest([plain]) != data_digest([aligned])
    assert aligned.streams["imu"] is not None
    # The wheel file is 1.07 s shorter; on the clock of the IMU the two end together within half a second.
    assert plain.streams["imu"].time_s[-1] - plain.streams["wheels"].time_s[-1] > 1.0
    assert abs(aligned.streams["imu"].time_s[-1] - aligned.streams["wheels"].time_s[-1]) < 0.6
