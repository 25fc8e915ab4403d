"""`terrain drive`: controllers at equal conditions, what their report states, and what is refused."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipelines.drive import comparison
from pipelines.drive.comparison import DriveInputs, DriveResult, belief_notes, compare, drive_once
from pipelines.drive.drive import Settings
from pipelines.live.model import TerrainModel
from pipelines.report.numbers import NOT_KNOWN
from pipelines.report.terminal import terminal_text
from terrain.control.controllers import CONTROLLERS, make_controller
from terrain.control.drive_metrics import METRICS, Comparison, drive_history, evaluate_drive
from terrain.control.situations import make_situation
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import TerrainEstimate
from terrain.errors import ConfigError
from terrain.robots import load_robot

SHORT = Settings(
    scenario="straight", controllers=("plain",), seeds=2, first_seed=300, duration_s=6.0, n_jobs=1
)
SOME = SHORT.with_(controllers=("plain", "ramp", "thesis", "true_terrain+track"))
ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
INPUTS = DriveInputs(ROBOT, TABLE)


@pytest.mark.slow
def test_every_controller_has_every_metric_on_any_number_of_processes():
    result = compare(SOME, INPUTS)
    assert tuple(result.controllers) == SOME.controllers
    for metrics in result.controllers.values():
        assert set(METRICS) <= set(metrics)
        assert metrics["energy_j_per_m"].n == metrics["distance_m"].n == 2
        low, high = metrics["distance_m"].ci
        assert low < metrics["distance_m"].mean < high
    ramp, track = (result.controllers[name]["distance_m"].mean for name in ("ramp", "true_terrain+track"))
    assert ramp == pytest.approx(track, rel=0.01)  # the ramp travels as far
    two = compare(SOME.with_(n_jobs=2, ramp_mps2=result.ramp_mps2), INPUTS)
    assert json.dumps(result.as_json(), allow_nan=False) == json.dumps(two.as_json(), allow_nan=False)


def test_few_controllers_at_one_seed_and_path_tracking_keeps_the_heading():
    names = ("fallback", "fallback+track", "ramp")
    settings = SHORT.with_(
        controllers=names, seeds=1, duration_s=8.0, radius_factors=(1.0, 1.0, 1.05), ramp_mps2=0.7
    )
    result = compare(settings, INPUTS)
    free, tracked, _ = (result.controllers[name]["yaw_drift_rad"].mean for name in names)
    assert tracked < 0.3 * free
    assert result.ramp_mps2 == 0.7
    for found in result.controllers.values():
        assert found["distance_m"].mean > 4.0
        assert found["distance_m"].ci is None


@pytest.mark.slow
def test_traction_control_starts_gently_sideways():
    situation = make_situation("starts", ROBOT, "grass", 301)
    sideways = replace(situation.scenario, twist=np.roll(situation.scenario.twist, 1, axis=1))
    peaks, turned = [], situation._replace(scenario=sideways)
    for name in ("plain", "fallback"):
        run = drive_once(INPUTS, make_controller(name, TABLE, 0.05), turned)
        history = drive_history(run, ROBOT, turned.conditions.radius_factors)
        peaks.append(evaluate_drive(run, history, ROBOT, turned)["slip_peak"])
    assert peaks[0] > 1.6 * peaks[1]


def test_sliding_back_is_negative_distance():
    settings = SHORT.with_(terrain="snow", grade_deg=28.0, controllers=("plain",), seeds=1)
    metrics = compare(settings, INPUTS).controllers["plain"]
    assert metrics["distance_m"].mean < 0.0
    assert metrics["final_speed_mps"].mean < 0.0
    assert metrics["immobilised"].mean >= 1


class Scripted:
    """A source that gives one output every 2 s, and refuses a window in between."""

    certain = settled = False

    def __init__(self, terrain, probability):
        self.output, self.outputs, self.next_s = (terrain, probability), [], 2.0

    def update(self, sample, estimates):
        self.outputs = []
        if sample.time_s < self.next_s:
            return []
        self.next_s += 2.0
        refused = "refused" if self.next_s == 6.0 else ""
        self.outputs = [SimpleNamespace(refused=refused)]
        return [] if refused else [TerrainEstimate(sample.time_s, *self.output)]


@pytest.mark.slow
def test_the_thesis_takes_the_targets_of_the_classified_terrain(monkeypatch):
    monkeypatch.setattr(comparison, "pilot_classifier", lambda *given: Scripted("grass", 0.9))
    settings = SHORT.with_(controllers=("thesis", "thesis:classified"), seeds=1, duration_s=16.0)
    result = compare(settings, DriveInputs(ROBOT, TABLE, TerrainModel(None, None)))  # for the source alone
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
    settings = SHORT.with_(seeds=1, duration_s=5.0)
    adapting = compare(settings.with_(controllers=("thesis:true_terrain+track",)), INPUTS)
    fixed = compare(settings.with_(controllers=("thesis+track",)), DriveInputs(ROBOT, grass))
    (found,), (expected,) = adapting.controllers.values(), fixed.controllers.values()
    assert found["energy_j_per_m"] == expected["energy_j_per_m"]
    assert found["believed_ratio"].mean == 1.0


def test_the_report_names_every_controller_and_metric_and_what_is_not_known():
    """The means are 1, 2, ... in the order of the controllers, and of few seeds where so many have the metric."""
    names = (*CONTROLLERS, "known:clay", "target:0.2", "true_terrain+track")
    rows = {}
    for place, name in enumerate(names, start=1):
        metrics = dict.fromkeys(METRICS, place + np.array([-0.06, 0.04, -0.04, 0.06]))
        metrics |= {"lock_s": np.full(4, math.nan), "adapt_s": [math.nan, math.nan, 0.25, math.nan]}
        if name == "classified":
            metrics |= {"believed_ratio": np.zeros(4), "n_accepted": np.zeros(4)}
        rows[name] = tuple({key: each[i] for key, each in metrics.items()} for i in range(4))
    about = {"scenario": "course", "terrain": "grass", "robot": "agrimaro", "table": "default"}
    about |= {"delay_s": 0.05, "grade_deg": 0.0, "ramp_mps2": 0.6582, "seeds": (0, 1, 2, 3)}
    result = DriveResult(**about, controllers=Comparison("course", rows).means, rows=rows)
    text = terminal_text(result.report, details=True, width=600)
    text = " ".join(text.replace("\N{MINUS SIGN}", "-").replace("\xa0", " ").split())
    for shown in (
        *(*(f" {name} " for name in names), *METRICS, f" adapt_s {NOT_KNOWN} ", " 0.25, n 1 "),
        *("largest slip slip_peak 1 (0.906 to 1.09) 2 (1.91 to 2.09)", "no more than 0.658 m/s²"),
        "classified knew the terrain at no time (outputs of its classifier in a drive: 0 accepted",
        "Not defined here: longest lock of a wheel (lock_s)",
    ):
        assert shown in text
    assert "classified compared" not in result.report.answer
    assert "Compared with ramp: largest slip" in result.report.answer
    assert len(terminal_text(result.report).splitlines()) <= 25
    assert [panel.marks[0].x for panel in result.report.picture.panels] == [list(names)] * 3
    assert (len(result.to_pandas()), set(result.to_pandas()["controller"])) == (4 * len(names), set(names))
    one = replace(result, seeds=(0,), rows={name: each[:1] for name, each in rows.items()})
    assert "one seed, which gives no interval" in one.report.answer


def test_a_controller_that_needs_a_classifier_is_not_driven_without():
    situation = make_situation("straight", ROBOT, "grass", 0)
    for name in ("classified+track", "thesis:classified"):
        with pytest.raises(ConfigError, match=f"'{name.replace('+', '.')}' needs a classifier"):
            drive_once(INPUTS, make_controller(name, TABLE, 0.05), situation)
