"""Trials of the wheel testbed: signs, what is refused, and what a repairing read skips."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from terrain.errors import LogError
from terrain.logs import testbed
from terrain.logs.digest import data_digest
from terrain.logs.write import write_run

HEADER = (
    "trial_num,beta,slip,Vry,avg_Vx,std_Vx,avg_Vry,std_Vry,avg_Fx,std_Fx,avg_Fy,std_Fy,avg_Fz,std_Fz,"
    "avg_angle,avg_Z,std_Z"
)
LOCKED = "1.0,0.0,-1.0,0.0,10.0,0.2,0.0,0.0,0.5,0.6,41.0,5.4,-20.5,0.9,0.0,-50.0,0.01"
ASIDE = "2.0,90.0,0.5,20.0,10.0,0.2,20.0,0.3,40.0,3.5,-3.0,0.9,-14.0,0.5,90.1,-70.0,0.4"
ROLLING = "1.0,30.0,0.0,10.0,10.0,0.2,10.0,0.3,10.0,1.0,4.0,0.9,-22.0,0.2,30.0,-21.0,0.0"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "smooth.csv").write_text("\n".join([HEADER, LOCKED, ASIDE, ROLLING]) + "\n")
    return tmp_path


def test_signs_are_those_of_the_projects_frames(folder):
    locked, aside, _ = load_runs(folder)
    assert [locked.run_id, locked.robot, locked.session] == ["smooth_trial_001", "testbed_smooth", "smooth"]
    assert locked.terrains == ("dry_sand",)
    held, dragged = locked.streams["testbed"], aside.streams["testbed"]
    assert held.channel("force_x_n").tolist() == [-41.0, -41.0]
    assert held.channel("sinkage_wheel_m")[0] == 0.05
    assert held.channel("slip_commanded_ratio")[0] == -1.0
    assert dragged.channel("force_y_n")[0] == 40.0
    assert dragged.channel("force_z_n")[0] == 14.0
    assert dragged.channel("slip_angle_commanded_rad")[0] == pytest.approx(math.pi / 2)
    assert dragged.channel("slip_angle_measured_rad")[0] == pytest.approx(math.radians(90.1))
    assert dragged.channel("speed_wheel_mps")[0] == 0.02


def test_a_folder_of_another_layout_has_no_trial(borealtc_dir):
    assert testbed.find_runs(borealtc_dir) == []


def test_run_folders_give_the_same_runs_and_digest(folder, tmp_path, edit):
    edit(folder / "smooth.csv", lambda lines: [*lines[:3], lines[3].replace(",0.2,-21.0", ",,-21.0")])
    runs = load_runs(folder, layout="testbed")
    for run in runs:
        write_run(run, tmp_path / "runs")
    again = load_runs(tmp_path / "runs")
    assert data_digest(again) == data_digest(runs)
    assert [run.run_id for run in again] == [run.run_id for run in runs]


BROKEN = {
    "a text": (LOCKED.replace("41.0", "soft"), r"smooth.csv: avg_Fy at row 4 is 'soft', which is no number"),
    "infinite": (LOCKED.replace("41.0", "inf"), r"avg_Fy at row 4 is 'inf', a finite mean is required"),
    "missing": (LOCKED.replace("41.0", ""), r"avg_Fy at row 4 is '', a finite mean is required"),
    "short": (LOCKED.rpartition(",")[0], r"row 4 has missing or extra cells"),
    "again": (ASIDE, r"row 4 repeats the trial of row 3, number for number"),
    "another slip": (ROLLING.replace("30.0,0.0", "30.0,0.3"), r"row 4: slip is 0.3, that of its .* is 0.000"),
    "pulled up": (
        ROLLING.replace("-22.0", "22.0"),
        r"row 4: avg_Fz is 22 N, that of a wheel with a load is below 0",
    ),
    "no attempt": (ROLLING.replace("1.0,30.0", "0.5,30.0"), r"row 4: trial_num is 0.5, a whole number"),
    "far angle": (ROLLING.replace("1.0,30.0", "1.0,300.0"), r"row 4: beta is 300 degrees, -90 to 90"),
    "standing": (ROLLING.replace("10.0,10.0", "10.0,0.0"), r"row 4: avg_Vx is 0 mm/s, a speed of travel"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_row_is_refused_in_one_sentence_and_skipped_by_name(fault, folder, edit, caplog):
    row, message = BROKEN[fault]
    edit(folder / "smooth.csv", lambda lines: [*lines[:3], row])
    with pytest.raises(LogError, match=message) as refused:
        load_runs(folder)
    runs = load_runs(folder, repair=True)
    assert [run.run_id for run in runs] == ["smooth_trial_001", "smooth_trial_002"]
    assert caplog.messages == [f"run skipped: {refused.value}"]


def test_a_broken_spread_is_refused_or_unknown_and_counted(folder, edit):
    edit(folder / "smooth.csv", lambda lines: [*lines[:3], ROLLING.replace("4.0,0.9", "4.0,-0.9")])
    with pytest.raises(LogError, match=r"std_Fy at row 4 is '-0.9', a standard deviation is a number from 0"):
        load_runs(folder)
    run = load_runs(folder, repair=True)[2]
    assert run.dropped == {testbed.BAD_SPREAD: 1}
    assert np.isnan(run.streams["testbed"].channel("force_x_std_n")).all()


def test_a_file_without_rows_or_without_a_column_is_refused(folder, edit):
    edit(folder / "smooth.csv", lambda lines: lines[:1])
    with pytest.raises(LogError, match=r"smooth.csv: has no rows of data, a trial a row is needed"):
        load_runs(folder)
    edit(folder / "smooth.csv", lambda lines: [lines[0].replace(",avg_Fz", ""), LOCKED])
    with pytest.raises(LogError, match=r"column 'avg_Fz' is missing"):
        load_runs(folder)


def test_measured_trials_agree_with_physics(measured):
    runs = load_runs(measured("wheel_testbed"))
    stream = {name: [] for name in ("force_x_n", "force_y_n", "force_z_n", "slip_measured_ratio")}
    angle = np.array([run.streams["testbed"].channel("slip_angle_commanded_rad")[0] for run in runs])
    for name, values in stream.items():
        values += [run.streams["testbed"].channel(name)[0] for run in runs]
    pull, side, load, slip = map(np.array, stream.values())
    assert len({run.run_id for run in runs}) == len(runs) > 10
    ahead = np.abs(angle) < 0.01
    assert (pull[ahead & (slip < -0.4)] < -0.5 * load[ahead & (slip < -0.4)]).all()
    assert (np.abs(side[ahead]) < 0.15 * load[ahead]).all()
    assert (side[angle > 0.2] > 0.0).all()
