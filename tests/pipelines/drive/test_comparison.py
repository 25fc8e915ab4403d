"""`terrain drive`: controllers at equal conditions, what their report states, and what is refused."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pipelines.drive import controllers
from pipelines.drive.comparison import DriveResult, belief_notes, compare
from pipelines.drive.controllers import DriveInputs, drive_once
from pipelines.drive.drive import Settings
from pipelines.drive.run_figures import run_figures
from pipelines.live.model import TerrainModel
from pipelines.report.numbers import NOT_KNOWN
from pipelines.report.terminal import terminal_text
from terrain.control.controllers import CONTROLLERS, make_controller
from terrain.control.drive_comparison import Comparison, steepest_grade
from terrain.control.drive_curves import DriveCurves
from terrain.control.drive_evaluation import METRICS, evaluate_drive
from terrain.control.drive_metrics import drive_history
from terrain.control.pilot_settings import PilotStatus
from terrain.control.power_state import DriveState
from terrain.control.situations import SituationOptions, make_situation
from terrain.control.slip_table import load_slip_table
from terrain.control.terrain_source import TerrainEstimate
from terrain.robots import load_robot

SHORT = Settings(
    scenario="straight", controllers=("plain",), seeds=2, first_seed=300, duration_s=6.0, n_jobs=1
)
ALL = SHORT.with_(controllers=("plain", "ramp", "thesis", "fallback", "true_terrain+track", "known:clay"))
ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
INPUTS = DriveInputs(ROBOT, TABLE)


@pytest.mark.slow
def test_every_controller_has_every_metric_on_any_number_of_processes():
    result = compare(ALL, INPUTS)
    assert tuple(result.controllers) == ALL.controllers
    for metrics in result.controllers.values():
        assert set(METRICS) <= set(metrics)
        assert metrics["energy_j_per_m"].n == metrics["distance_m"].n == 2
        low, high = metrics["distance_m"].ci
        assert low < metrics["distance_m"].mean < high
    ramp, track = (result.controllers[name]["distance_m"].mean for name in ("ramp", "true_terrain+track"))
    assert ramp == pytest.approx(track, rel=0.01)  # the ramp travels as far
    two = compare(ALL.with_(n_jobs=2), INPUTS)
    assert json.dumps(result.as_json(), allow_nan=False) == json.dumps(two.as_json(), allow_nan=False)


def test_one_controller_alone_is_driven():
    for name in ("ramp", "thesis"):
        found = compare(SHORT.with_(controllers=(name,), seeds=1), INPUTS)
        assert found.controllers[name]["distance_m"].mean > 2.0
        assert found.controllers[name]["distance_m"].ci is None


@pytest.mark.slow
def test_traction_control_starts_gently_in_any_direction():
    situation = make_situation("starts", ROBOT, "grass", 301)
    peaks = {}
    for angle in (0.0, 0.25 * math.pi, 0.5 * math.pi, math.pi):
        speed = situation.scenario.twist[:, 0]
        twist = np.column_stack([speed * math.cos(angle), speed * math.sin(angle), np.zeros(len(speed))])
        turned = situation._replace(scenario=replace(situation.scenario, twist=twist))
        for name in ("plain", "fallback"):
            run = drive_once(INPUTS, make_controller(name, TABLE, 0.05), turned)
            history = drive_history(run, ROBOT, turned.conditions.radius_factors)
            peaks[name, angle] = evaluate_drive(run, history, ROBOT, turned)["slip_peak"]
        assert peaks["plain", angle] > 1.6 * peaks["fallback", angle], angle
    assert peaks["fallback", 0.5 * math.pi] == pytest.approx(peaks["fallback", 0.0], rel=0.15)


def test_a_drive_with_path_tracking_keeps_its_heading():
    names = ("fallback", "fallback+track")
    settings = SHORT.with_(controllers=names, duration_s=15.0, leg_backlash_rad=0.02)
    result = compare(settings, INPUTS)
    free, tracked = (result.controllers[name]["yaw_drift_rad"].mean for name in names)
    assert tracked < 0.2 * free


def test_sliding_back_is_negative_distance():
    settings = SHORT.with_(terrain="snow", grade_deg=28.0, controllers=("plain",), seeds=1)
    metrics = compare(settings, INPUTS).controllers["plain"]
    assert metrics["distance_m"].mean < 0.0
    assert metrics["final_speed_mps"].mean < 0.0
    assert metrics["immobilised"].mean >= 1


def test_the_steepest_grade_is_found():
    plain = make_controller("plain", TABLE, 0.05)

    def drive(grade_deg):
        options = SituationOptions(duration_s=8.0, grade_deg=grade_deg)
        return drive_once(INPUTS, plain, make_situation("slope", ROBOT, "dry_sand", 302, options))

    assert 8.0 < steepest_grade(drive) < 20.0


class Scripted:
    """A source that gives one output every 2 s, and refuses a window in between."""

    certain = settled = False

    def __init__(self, terrain, probability):
        self.output, self.n_refused, self.next_s = (terrain, probability), 0, 2.0

    def update(self, sample, estimates):
        if sample.time_s < self.next_s:
            return []
        self.next_s += 2.0
        self.n_refused += self.next_s == 6.0
        return [TerrainEstimate(sample.time_s, *self.output)] if self.next_s != 6.0 else []


def scripted(monkeypatch, probability, duration_s=16.0):
    """The drives on grass, with a classifier of that probability."""
    names = ("plain", "thesis", "thesis:classified", "classified")
    monkeypatch.setattr(controllers, "Classifier", lambda model, robot: Scripted("grass", probability))
    settings = SHORT.with_(controllers=names, seeds=2, duration_s=duration_s)
    model = TerrainModel(None, None)  # which only the source uses
    return compare(settings, DriveInputs(ROBOT, TABLE, model))


@pytest.mark.slow
def test_the_thesis_takes_the_targets_of_the_classified_terrain(monkeypatch):
    result = scripted(monkeypatch, 0.9)
    base, classified = (result.controllers[name] for name in ("thesis", "thesis:classified"))
    assert base["believed_ratio"].mean is None
    assert 0.4 < classified["believed_ratio"].mean < 0.8  # from the third window on, as the second is refused
    counts = [classified[name].mean for name in ("n_accepted", "n_below_threshold", "n_refused")]
    assert counts == [7, 0, 1]
    assert base["mean_speed_mps"].mean != classified["mean_speed_mps"].mean
    assert belief_notes(result.compared) == ()


def test_the_thesis_with_the_true_terrain_drives_on_its_targets():
    """The same as the thesis with a table whose fallback has the targets of that terrain."""
    entry = dict(TABLE.targets["grass"])
    grass = replace(TABLE, targets={**TABLE.targets, TABLE.fallback: entry})
    settings = SHORT.with_(seeds=1)
    adapting = compare(settings.with_(controllers=("thesis:true_terrain+track",)), INPUTS)
    fixed = compare(settings.with_(controllers=("thesis+track",)), DriveInputs(ROBOT, grass))
    (found,), (expected,) = adapting.controllers.values(), fixed.controllers.values()
    assert found["energy_j_per_m"] == expected["energy_j_per_m"]
    assert found["believed_ratio"].mean == 1.0


@pytest.mark.slow
def test_no_gain_is_credited_to_a_classifier_that_was_never_believed(monkeypatch):
    result = scripted(monkeypatch, 0.3, duration_s=8.0)
    for name in ("classified", "thesis:classified"):
        assert result.controllers[name]["believed_ratio"].mean == 0.0
        assert result.controllers[name]["n_below_threshold"].mean == 3
    notes = belief_notes(result.compared)
    assert [note.split()[0] for note in notes] == ["thesis:classified", "classified"]
    assert "knew the terrain at no time" in notes[0]
    assert "0 accepted, 3 below the threshold, 1 refused" in notes[0]
    assert notes[1] in terminal_text(result.report)
    assert "classified compared" not in result.report.answer
    assert "thesis compared with plain" in result.report.answer


SPREAD = np.array([-0.06, 0.04, -0.04, 0.06])
"""Of a metric over the four seeds."""


def a_result(names=("plain", "ramp", "true_terrain"), values=None, n_seeds=4, **more):
    """A result whose metrics have the mean 1, 2, ... in the order of the controllers.

    Parameters
    ----------
    values : by controller and metric, the values of the seeds in place of those
    """
    rows = {}
    for place, name in enumerate(names):
        metrics = dict.fromkeys(METRICS, 1.0 + place + SPREAD) | {"distance_5s_m": 3.0 - 0.1 * place + SPREAD}
        metrics |= (values or {}).get(name, {})
        seeds = zip(*metrics.values(), strict=True)
        rows[name] = tuple(dict(zip(metrics, row, strict=True)) for row in seeds)[:n_seeds]
    about = {"scenario": "starts", "terrain": "grass", "robot": "agrimaro", "table": "default"} | more
    about |= {"delay_s": 0.05, "grade_deg": 0.0, "ramp_mps2": 0.6582, "seeds": tuple(range(n_seeds))}
    return DriveResult(**about, controllers=Comparison(about["scenario"], rows).means, rows=rows)


def text_of(result):
    text = terminal_text(result.report, details=True, width=600)
    return " ".join(text.replace("\N{MINUS SIGN}", "-").replace("\xa0", " ").split())


def test_the_report_names_every_controller_and_metric():
    names = (*CONTROLLERS, "known:clay", "target:0.2", "true_terrain+track")
    result = a_result(names)
    text = text_of(result)
    assert all(f" {name} " in text for name in (*names, *METRICS))
    assert "largest slip slip_peak 1 (0.906 to 1.09) 2 (1.91 to 2.09)" in text
    assert "no more than 0.658 m/s²" in text
    assert "without error. With path tracking." in text
    assert len(terminal_text(result.report).splitlines()) <= 25
    assert [panel.marks[0].x for panel in result.report.picture.panels] == [list(names)] * 3
    frame = result.to_pandas()
    assert (len(frame), set(frame["controller"])) == (4 * len(names), set(names))


def test_unknown_values_are_a_dash_and_values_of_few_seeds_state_it():
    nan, few = np.full(4, math.nan), np.array([math.nan, math.nan, 0.25, math.nan])
    values = {name: {"slip_peak": nan, "lock_s": nan} for name in ("plain", "ramp")}
    values["true_terrain"] = {"slip_peak": few, "lock_s": nan}
    text = text_of(a_result(values=values))
    assert f"slip_peak {NOT_KNOWN} {NOT_KNOWN} 0.25, n 1" in text
    assert "Not defined here: longest lock of a wheel (lock_s)" in text
    one = a_result(n_seeds=1)
    assert "one seed, which gives no interval" in one.report.answer
    assert " *" not in text_of(one)


def test_a_drive_shows_states_refusals_and_terrains():
    """2 s at 0.8 m/s: limited in the first, one refusal at its end, braking in the last half second."""
    time_s = np.arange(100) / 50
    true = dict.fromkeys(("true_mps", "slip", "slip_least", "slip_largest"), np.full(100, 0.8))
    status = dict.fromkeys(PilotStatus._fields, np.full(100, 0.2)) | {"desired_mps": np.ones(100)}
    states = [float(DriveState.TRACTION), float(DriveState.STEADY), float(DriveState.BRAKING)]
    status["drive_state_code"] = np.repeat(states, [50, 25, 25])
    status["status_code"] = np.where(np.arange(100) == 50, 2.0, 0.0)
    strips = {"true": [(0.0, 1.0, "grass"), (1.0, 2.0, "clay")], "classified": [(1.0, 2.0, "clay")]}
    own = DriveCurves(time_s, **true, control_s=time_s, control=status, aimed=np.full(100, 0.2),
                      is_open_loop=False, terrains=strips)  # fmt: skip
    one, other = run_figures({"true_terrain": own, "plain": own._replace(is_open_loop=True, terrains={})})
    assert one.panels[0].marks[0].x == [(0.0, 1.0, "traction: speed rises"), (1.5, 1.98, "braking")]
    assert one.panels[1].marks[2].x == [(1.0, 1.02, "no correction: stale")]
    labels = [{getattr(mark, "label", "") for mark in figure.panels[1].marks} for figure in (one, other)]
    assert labels[0] - labels[1] >= {"target", "target with its floor"}
    assert (len(one.panels), len(other.panels)) == (4, 2)
    assert one.panels[1].y_range == other.panels[1].y_range
