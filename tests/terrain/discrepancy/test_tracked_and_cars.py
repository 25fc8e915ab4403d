"""Tracked and car-like robots: one wheel of a car, words of sprockets, and a region without a steering."""

import numpy as np
import pytest
from studies.blind_trials.drives import CAR_MPS2, STEP_HZ, car_drives
from studies.blind_trials.limits import limits_of

from terrain.discrepancy.health import candidate_changes
from terrain.discrepancy.powertrain import traces_of
from terrain.discrepancy.robot_terms import in_robot_terms, value_in_robot_terms
from terrain.discrepancy.runs import signals_of
from terrain.discrepancy.verdict import Value
from terrain.effects import effect_named
from terrain.errors import DataError
from terrain.extension import region_of
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate

CAR, MARMOTTE, PATAKO = (load_robot(name) for name in ("adap2e", "marmotte", "patako"))


def test_drives_of_a_car_keep_to_what_it_can_and_part_stiffness_from_a_slide_on_side_slopes():
    drives = car_drives(np.random.default_rng(0), CAR, 3, 60.0)
    for twist in drives.twists:
        speed, turn = twist[:, 0], twist[:, 2]
        assert speed.min() < 0.0 < 1.5 < speed.max() <= 0.5 * CAR.speed_max_mps
        assert not twist[-1].any()
        assert np.abs(np.diff(speed)).max() * STEP_HZ <= CAR_MPS2 + 1e-9
        curvature = turn[speed != 0.0] / speed[speed != 0.0]
        assert np.abs(curvature).max() < np.tan(CAR.steering_max_rad) / CAR.wheelbase_m
    limits = limits_of(CAR, drives)
    stiffness, slide = effect_named("cornering_stiffness"), effect_named("side_hill_slip")
    assert not limits.alike(stiffness, slide)
    for over, explained in ((3.0, False), (0.01, True)):
        hidden = {"cornering_stiffness_ratio": over * limits.of(stiffness)}
        assert limits.in_place_of(stiffness, hidden, slide) == explained


def test_a_log_of_a_car_has_one_wheel_a_region_and_no_columns_to_exchange():
    run = simulate(CAR, np.tile((1.0, 0.0, 0.2), (501, 1)), Ground(), 0)
    region = region_of([run], CAR)
    assert region.wheel_speed_mps[1] == pytest.approx(1.0, abs=1e-3)
    assert region.yaw_rate_radps[1] == pytest.approx(0.2, abs=1e-3)
    without = RunLog("a", CAR.name, {k: v for k, v in run.streams.items() if k != "steering"})
    assert region_of([without], CAR).yaw_rate_radps is None
    with pytest.raises(DataError, match="no stream 'steering'"):
        signals_of(without, CAR)
    assert all(change.wheel < 1 and change.pair == (0, 1) for change in candidate_changes(CAR))
    assert traces_of([run] * 5, CAR)[0].measured.shape[1] == 1


def test_words_are_those_of_the_robot():
    radius = Value("wheel_radius_ratio", 0.05, "ratio", 0.045, 0.055)
    assert in_robot_terms("wheel_radius", [radius], MARMOTTE).startswith(
        "a sprocket radius of 0.1250 m (described"
    )
    assert "assumed" in in_robot_terms("wheel_radius", [radius], PATAKO)
    side = Value("one_sided_radius_ratio", 0.05, "ratio", 0.045, 0.055)
    assert in_robot_terms("one_sided_radius", [side], MARMOTTE).startswith("sprockets that are 5.0 % larger")
    less = Value("understeer_s2pm", 0.03, "s2pm", 0.025, 0.035)
    text = in_robot_terms("understeer", [less], CAR)
    assert text == "an understeer of 0.030 s²/m (described: 0 s²/m), which turns it 9.1 % less at 2 m/s"
    soft = value_in_robot_terms("cornering_stiffness_ratio", -0.2, -0.25, -0.15, CAR)
    assert soft == "12000 N/rad (11250 to 12750)"
