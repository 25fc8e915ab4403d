"""`terrain drive --faults`: drives with sensor faults, their report, and what is refused."""

import json
import math

import numpy as np
import pytest

from pipelines.drive.drive import Settings
from pipelines.drive.faults import bars_text, drawn_cases, drive_faults, fault_loop
from pipelines.live.pilot import LivePilot
from pipelines.report.results import as_json
from terrain.control.drive_metrics import drive_history, stopping_distance
from terrain.control.fault_drives import (
    BARS,
    FAULT_SITUATIONS,
    RATIO_ABOVE_MPS,
    FaultCase,
    Place,
    drive_case,
    drive_references,
    evaluate_case,
    fault_drive,
    fault_figures,
    make_fault_situation,
)
from terrain.control.robot_control import PilotSettings
from terrain.control.situations import simulate_situation
from terrain.control.slip_table import load_slip_table
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
SLIPS = load_slip_table()
LOOP = fault_loop(ROBOT, SLIPS)
FEW = Settings(
    faults="loss_odometry,duplicates_imu",
    situations="start",
    durations_s="3,inf",
    draw="duplicates_imu",
    first_seed=400,
    n_jobs=1,
)


@pytest.mark.parametrize("name", FAULT_SITUATIONS)
def test_a_drive_by_plain_commands_is_evaluated_from_its_log(name):
    situation, start_s = make_fault_situation(name, ROBOT, "grass", 400)
    pilot = LivePilot(ROBOT, settings=PilotSettings(controller="plain"))
    run = simulate_situation(ROBOT, situation, pilot.step, 0.05)
    history = drive_history(run, ROBOT, situation.conditions.radius_factors)
    drive = fault_drive(run, history, ROBOT, situation.scenario)
    assert drive.desired_mps == pytest.approx(run.streams["control"].channel("desired_mps"))
    assert drive.commanded_mps == pytest.approx(drive.desired_mps)
    at = int(np.searchsorted(drive.time_s, start_s))
    changes = drive.desired_mps[at - 1] - drive.desired_mps[at + 1]
    assert (changes < 0, changes > 0) == (name == "start", name == "stop")
    steady = (drive.time_s > 4.0) & (drive.time_s < 6.0)
    slip = 1.0 - drive.speed_mps / drive.commanded_mps.clip(1e-9)
    assert drive.true_slip_ratio[steady].mean() == pytest.approx(slip[steady].mean(), abs=0.03)
    assert drive.body_slip_ratio[steady].mean() == pytest.approx(slip[steady].mean(), abs=0.02)
    assert np.isnan(drive.true_slip_ratio[drive.speed_mps < RATIO_ABOVE_MPS / 10]).mean() > 0.7
    found = fault_figures(drive, drive, drive, start_s, math.inf)
    assert (found.overspeed_s, found.not_ok_s) == (0.0, 0.0)
    assert found.slip_peak_ratio == found.plain_slip_peak_ratio > 0.1
    if name == "stop":
        assert found.stop_ratio == 1.0
        assert found.stop_m == stopping_distance(history, start_s)
    else:
        assert math.isnan(found.stop_ratio)


@pytest.fixture(scope="module")
def few():
    return drive_faults(FEW, ROBOT, SLIPS)


def test_a_lost_camera_ends_ok_late_and_duplicates_cost_nothing(few):
    rows = {(row.case.fault, row.case.duration_s): row for row in few.rows}
    assert len(rows) == len(few.rows) == 4
    lost = rows["loss_odometry", math.inf]
    assert lost.figures.not_ok_s > 1.0  # the status changes some time after the camera is lost
    assert math.isnan(lost.figures.recovery_s)
    assert lost.bars["ok_ends"] is (lost.figures.ok_total_s <= 0.3)
    assert rows["loss_odometry", 3.0].figures.recovery_s < 1.0
    for duration_s in (3.0, math.inf):
        row = rows["duplicates_imu", duration_s]
        assert not row.unmet
        assert row.figures.not_ok_s == 0.0
        assert row.figures.slip_error_ratio == row.figures.clean_slip_error_ratio
    assert all(set(row.bars) == set(BARS) for row in few.rows)
    assert sum(bar.n_met + bar.n_unmet + bar.n_not_judged for bar in few.bars.values()) == 4 * len(BARS)
    (clean,) = few.clean
    assert clean["start_s"] == 1.0
    assert clean["slip_error_ratio"] < 0.03


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes(few):
    two = drive_faults(FEW.with_(n_jobs=2), ROBOT, SLIPS)
    assert json.dumps(as_json(few), allow_nan=False) == json.dumps(as_json(two), allow_nan=False)


def test_a_fault_and_an_exception_of_the_pilot_act_from_when_they_begin_and_show_in_their_row(monkeypatch):
    step, case = LivePilot.step, FaultCase("loss_imu", 1.0, "start", "grass", 402)
    references = drive_references(LOOP, Place(*case[2:]))

    def failing(self, sample):
        if "imu" not in sample.readings and sample.time_s > 0.9:
            raise ZeroDivisionError("nothing to divide")
        return step(self, sample)

    drive = drive_case(LOOP, case)[0]
    before = drive.time_s < references.start_s
    for name in ("ok", "slip_ratio", "speed_mps", "commanded_mps"):
        found, clean = getattr(drive, name), getattr(references.clean, name)
        assert np.array_equal(found[before], clean[before], equal_nan=True)
    assert not np.array_equal(drive.slip_ratio, references.clean.slip_ratio, equal_nan=True)
    monkeypatch.setattr(LivePilot, "step", failing)
    row = evaluate_case(LOOP, case, references)
    assert (row.figures.n_exceptions, row.bars["finite"]) == (50, False)
    assert row.exception == "ZeroDivisionError: nothing to divide"
    assert row.bars["recovery"]  # the filter waits for its low-pass after the gap


def test_the_report_counts_what_is_met_and_names_what_is_not(few):
    duplicates, lost = (
        [row for row in few.rows if row.case.fault == name] for name in ("duplicates_imu", "loss_odometry")
    )
    assert bars_text(duplicates) == "met"
    unmet = any(row.unmet for row in lost)
    assert (bars_text(lost) == "met") == (not unmet)
    answer = few.report.answer
    assert answer.startswith(f"{few.n_met} of 4 drives with a sensor fault meet all bars")
    assert ("not met with loss_odometry" in answer) == unmet
    assert [row[1:4] for row in few.report.parts[0].rows] == [bar[1:] for bar in few.bars.values()]
    drawn = drawn_cases(few.rows, ("duplicates",))
    assert drawn == [FaultCase("duplicates_imu", math.inf, "start", "grass", 400)]
    assert all(case.fault == "loss_odometry" for case in drawn_cases(few.rows))
    (figure,) = few.drawn
    assert figure.title == "duplicates_imu, for good: start on grass, seed 400"
    assert figure.panels[0].marks[0].x[0][0] == few.clean[0]["start_s"]
