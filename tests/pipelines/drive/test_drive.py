"""`terrain drive`: who drives, on which days, and how fairly they are compared."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pipelines.drive.controllers import CONTROLLERS, drive_once, make_driver
from pipelines.drive.drive import (
    KEYS,
    DriveSettings,
    _share_distance,
    drive,
    judge,
    steepest,
)
from terrain.control.drive_metrics import course_of
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
SHORT = DriveSettings("straight", "grass", ("plain", "target:0.15"), seeds=2, first_seed=300, duration_s=6.0)


ALL = replace(SHORT, controllers=("plain", "ramp", "thesis", "fixed", "oracle+track", "told:clay"))


def test_processes_change_nothing():
    settings = replace(ALL, duration_s=3.0)
    one, two = (drive(ROBOT, TABLE, settings, n_jobs=n) for n in (1, 2))
    assert json.dumps(one, allow_nan=False) == json.dumps(two, allow_nan=False)


def test_every_controller_has_every_figure():
    one = drive(ROBOT, TABLE, ALL)
    assert tuple(one["controllers"]) == ALL.controllers
    for figures in one["controllers"].values():
        assert set(KEYS) <= set(figures)
        assert figures["energy_j_per_m"]["n"] == figures["distance_m"]["n"] == 2
        low, high = figures["distance_m"]["ci"]
        assert low < figures["distance_m"]["mean"] < high
    ramp, track = (one["controllers"][name]["distance_m"]["mean"] for name in ("ramp", "oracle+track"))
    assert ramp == pytest.approx(track, rel=0.01)  # the ramp is as fast as gets as far


def test_one_controller_alone_is_driven():
    for name in ("ramp", "thesis"):
        found = drive(ROBOT, TABLE, replace(SHORT, controllers=(name,), seeds=1))
        assert found["controllers"][name]["distance_m"]["mean"] > 2.0
        assert found["controllers"][name]["distance_m"]["ci"] is None


def test_energy_is_compared_over_the_way_that_all_made():
    fast, slow = np.array([0.0, 4.0, 8.0]), np.array([0.0, 3.0, 6.0])
    stuck = np.array([0.0, 0.5, 1.0])
    energy = np.array([0.0, 100.0, 300.0])
    rows = {
        name: [{"_energy": (way, energy)}] for name, way in (("fast", fast), ("slow", slow), ("stuck", stuck))
    }
    _share_distance(rows)
    assert rows["slow"][0]["energy_j_per_m"] == pytest.approx(300.0 / 6.0)
    assert rows["fast"][0]["energy_j_per_m"] == pytest.approx(200.0 / 6.0)
    assert math.isnan(rows["stuck"][0]["energy_j_per_m"])


def test_ours_starts_gently_whichever_way_it_is_told_to_go():
    settings = DriveSettings("starts", "grass", ("plain",), 1, 301)
    where = settings.situation(ROBOT, 301)
    peaks = {}
    for angle in (0.0, 0.25 * math.pi, 0.5 * math.pi, math.pi):
        speed = where.scenario.twist[:, 0]
        twist = np.column_stack([speed * math.cos(angle), speed * math.sin(angle), np.zeros(len(speed))])
        turned = where._replace(scenario=replace(where.scenario, twist=twist))
        for name in ("plain", "fixed"):
            driver = make_driver(name, TABLE, 0.05)
            run = drive_once(ROBOT, driver, turned, 0.05)
            course = course_of(run, ROBOT, turned.conditions.radius_factors)
            row = judge(run, course, ROBOT, turned, driver)
            peaks[name, angle] = row["slip_peak"]
        assert peaks["plain", angle] > 1.6 * peaks["fixed", angle], angle
    assert peaks["fixed", 0.5 * math.pi] == pytest.approx(peaks["fixed", 0.0], rel=0.15)


def test_a_drive_that_is_held_to_its_way_keeps_its_heading():
    names = ("fixed", "fixed+track")
    settings = replace(SHORT, controllers=names, duration_s=15.0, leg_backlash_rad=0.02)
    free, held = (
        drive(ROBOT, TABLE, settings)["controllers"][name]["yaw_drift_rad"]["mean"] for name in names
    )
    assert held < 0.2 * free


def test_the_command_line_names_the_controllers_that_there_are():
    from pipelines.cli.main import DRIVE_CONTROLLERS

    assert DRIVE_CONTROLLERS == CONTROLLERS


def test_a_robot_that_slides_back_makes_no_way():
    settings = replace(SHORT, terrain="snow", grade_deg=28.0, controllers=("plain",), seeds=1)
    figures = drive(ROBOT, TABLE, settings)["controllers"]["plain"]
    assert figures["distance_m"]["mean"] < 0.0
    assert figures["final_speed_mps"]["mean"] < 0.0
    assert figures["immobilised"]["mean"] >= 1


def test_the_steepest_grade_is_what_it_climbs():
    settings = DriveSettings("slope", "dry_sand", ("plain",), 1, 302, duration_s=8.0)
    found = steepest(ROBOT, make_driver("plain", TABLE, 0.05), settings, 302)
    assert 8.0 < found < 20.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"controllers": ()}, "no controller"),
        ({"controllers": ("plain", "plain")}, "twice"),
        ({"controllers": ("best",)}, "'best' is unknown"),
        ({"controllers": ("told:mars",)}, "no entry 'mars'"),
        ({"controllers": ("target:1.5",)}, "0 to below 1"),
        ({"controllers": ("plain+track",)}, "knows no place"),
        ({"seeds": 0}, "seeds is 0"),
        ({"delay_s": -0.1}, "0 to 0.5 s"),
        ({"delay_s": math.nan}, "0 to 0.5 s"),
        ({"scenario": "slope", "grade_deg": 5.0}, "leave the grade out"),
        ({"terrain": "course"}, "does not go with"),
        ({"speed_mps": 99.0}, "speed"),
        ({"controllers": ("ramp",), "ramp_mps2": 0.0}, "above zero"),
        ({"controllers": ("learned",)}, "needs a classifier"),
        ({"controllers": ("learned+track",)}, "needs a classifier"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_sentence(changes, said):
    with pytest.raises(ConfigError, match=said) as refusal:
        drive(ROBOT, TABLE, replace(SHORT, **changes))
    assert "\n" not in str(refusal.value)
