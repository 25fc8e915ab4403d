"""`terrain drive`: controllers, seeds, and equal conditions for their comparison."""

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from pipelines.drive import controllers
from pipelines.drive.belief import belief_notes
from pipelines.drive.controller_names import CONTROLLERS, earlier_name
from pipelines.drive.controllers import DriveInputs, drive_once, make_controller
from pipelines.drive.drive import drive, load_inputs, steepest
from pipelines.drive.screen import print_drive
from pipelines.drive.settings import DriveSettings
from pipelines.drive.view import drive_view
from pipelines.live.terrain_source import TerrainEstimate
from pipelines.models.model_files import TerrainModel
from pipelines.reporting.json_file import as_json
from terrain.control.drive_evaluation import (
    METRICS,
    EnergyCurve,
    energy_at_equal_distance,
    evaluate_drive,
)
from terrain.control.drive_metrics import drive_history
from terrain.control.situations import make_situation
from terrain.errors import ConfigError

SHORT = DriveSettings(
    scenario="straight",
    controllers=("plain", "target:0.15"),
    seeds=2,
    first_seed=300,
    duration_s=6.0,
    jobs=1,
)
ALL = SHORT.with_(controllers=("plain", "ramp", "thesis", "fallback", "true_terrain+track", "known:clay"))
INPUTS = load_inputs(SHORT)
ROBOT, TABLE = INPUTS.robot, INPUTS.table


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes():
    one, two = (drive(ALL.with_(duration_s=3.0, jobs=n), INPUTS) for n in (1, 2))
    assert json.dumps(as_json(one), allow_nan=False) == json.dumps(as_json(two), allow_nan=False)


@pytest.mark.slow
def test_every_controller_has_every_metric():
    result = drive(ALL, INPUTS)
    assert tuple(result.controllers) == ALL.controllers
    for metrics in result.controllers.values():
        assert set(METRICS) <= set(metrics)
        assert metrics["energy_j_per_m"].n == metrics["distance_m"].n == 2
        low, high = metrics["distance_m"].ci
        assert low < metrics["distance_m"].mean < high
    ramp, track = (result.controllers[name]["distance_m"].mean for name in ("ramp", "true_terrain+track"))
    assert ramp == pytest.approx(track, rel=0.01)  # the ramp travels as far


def test_one_controller_alone_is_driven():
    for name in ("ramp", "thesis"):
        found = drive(SHORT.with_(controllers=(name,), seeds=1), INPUTS)
        assert found.controllers[name]["distance_m"].mean > 2.0
        assert found.controllers[name]["distance_m"].ci is None


def test_controllers_have_their_earlier_names_on_the_command_line_and_in_json():
    settings = SHORT.with_(controllers="oracle+track,told:clay,fixed", seeds=1, duration_s=3.0)
    assert settings.controllers == ("true_terrain+track", "known:clay", "fallback")
    document = as_json(drive(settings, INPUTS))
    for key in ("controllers", "rows"):
        for name in settings.controllers:
            assert document[key][name] == document[key][earlier_name(name)]
    assert set(document["rows"]) == {*settings.controllers, "oracle+track", "told:clay", "fixed"}


def test_energy_is_compared_over_the_distance_that_all_travelled():
    energy = np.array([0.0, 100.0, 300.0])
    fast, slow, stuck = (
        EnergyCurve(np.array(distance_m), energy)
        for distance_m in ([0.0, 4.0, 8.0], [0.0, 3.0, 6.0], [0.0, 0.5, 1.0])
    )
    found = energy_at_equal_distance([fast, slow, stuck])
    assert found == pytest.approx([200.0 / 6.0, 300.0 / 6.0, math.nan], nan_ok=True)


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
    result = drive(settings, INPUTS)
    free, tracked = (result.controllers[name]["yaw_drift_rad"].mean for name in names)
    assert tracked < 0.2 * free


def test_sliding_back_is_negative_distance():
    settings = SHORT.with_(terrain="snow", grade_deg=28.0, controllers=("plain",), seeds=1)
    metrics = drive(settings, INPUTS).controllers["plain"]
    assert metrics["distance_m"].mean < 0.0
    assert metrics["final_speed_mps"].mean < 0.0
    assert metrics["immobilised"].mean >= 1


def test_the_steepest_grade_is_found():
    settings = DriveSettings(scenario="slope", terrain="dry_sand", controllers=("plain",), duration_s=8.0)
    assert 8.0 < steepest(settings, INPUTS, make_controller("plain", TABLE, 0.05), 302) < 20.0


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
    return drive(settings, DriveInputs(ROBOT, TABLE, model))


@pytest.mark.slow
def test_the_thesis_takes_the_targets_of_the_classified_terrain(monkeypatch):
    result = scripted(monkeypatch, 0.9)
    base, classified = (result.controllers[name] for name in ("thesis", "thesis:classified"))
    assert base["believed_ratio"].mean is None
    assert 0.4 < classified["believed_ratio"].mean < 0.8  # from the third window on, as the second is refused
    counts = [classified[name].mean for name in ("n_accepted", "n_below_threshold", "n_refused")]
    assert counts == [7, 0, 1]
    assert base["mean_speed_mps"].mean != classified["mean_speed_mps"].mean
    assert belief_notes(result) == ()


@pytest.mark.parametrize("suffix", ["", "+track"])
def test_the_thesis_with_the_true_terrain_drives_on_its_targets(suffix):
    """The same as the thesis with a table whose fallback has the targets of that terrain."""
    entry = dict(TABLE.targets["grass"])
    grass = replace(TABLE, targets={**TABLE.targets, TABLE.fallback: entry})
    settings = SHORT.with_(seeds=1)
    name = f"thesis:true_terrain{suffix}"
    adapting = drive(settings.with_(controllers=(name,)), INPUTS)
    fixed = drive(settings.with_(controllers=(f"thesis{suffix}",)), DriveInputs(ROBOT, grass))
    key = "energy_j_per_m"
    assert adapting.controllers[name][key] == fixed.controllers[f"thesis{suffix}"][key]
    assert adapting.controllers[name]["believed_ratio"].mean == 1.0


@pytest.mark.slow
def test_no_gain_is_credited_to_a_classifier_that_was_never_believed(monkeypatch):
    result = scripted(monkeypatch, 0.3, duration_s=8.0)
    for name in ("classified", "thesis:classified"):
        assert result.controllers[name]["believed_ratio"].mean == 0.0
        assert result.controllers[name]["n_below_threshold"].mean == 3
    notes = belief_notes(result)
    assert [note.split()[0] for note in notes] == ["thesis:classified", "classified"]
    assert "knew the terrain at no time" in notes[0]
    assert "0 accepted, 3 below the threshold, 1 refused" in notes[0]
    with Console(file=io.StringIO(), width=110) as console:
        print_drive(result, console)
    assert " ".join(notes[1].split()) in " ".join(console.file.getvalue().split())
    view = drive_view(result, {})
    assert view.notes == notes
    assert "classified compared" not in view.verdict
    assert "thesis compared with plain" in view.verdict


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controllers": ()}, "no controller"),
        ({"controllers": ("plain", "plain")}, "twice"),
        ({"controllers": ("fixed", "fallback")}, "twice"),
        ({"controllers": ("best",)}, f"'best' is unknown: use {', '.join(CONTROLLERS)}"),
        ({"controllers": ("known:mars",)}, "no entry 'mars'"),
        ({"controllers": ("target:1.5",)}, "0 to below 1"),
        ({"controllers": ("plain+track",)}, "estimates no pose"),
        ({"seeds": 0}, "seeds is 0"),
        ({"delay_s": -0.1}, "0 to 0.5 s"),
        ({"delay_s": math.nan}, "0 to 0.5 s"),
        ({"scenario": "slope", "grade_deg": 5.0}, "leave the grade out"),
        ({"grade_deg": 40.0}, "-30 to 30 degrees"),
        ({"radius_factors": "1,2"}, "three ratios"),
        ({"model": "models:/m"}, "not among the controllers"),
        ({"terrain": "course"}, "does not go with"),
        ({"speed_mps": 99.0}, "speed"),
        ({"controllers": ("ramp",), "ramp_mps2": 0.0}, "above zero"),
        ({"controllers": ("classified",)}, "needs a classifier"),
        ({"controllers": ("learned+track",)}, "needs a classifier"),
        ({"controllers": ("thesis:classified",)}, "'thesis:classified' needs a classifier"),
        ({"controllers": ("thesis:fallback",)}, "'thesis:fallback' is unknown"),
    ],
)
def test_invalid_settings_are_refused_in_one_sentence(changes, message):
    with pytest.raises(ConfigError, match=message) as refusal:
        drive(SHORT.with_(**changes), INPUTS)
    assert "\n" not in str(refusal.value)
