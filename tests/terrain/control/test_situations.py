import math
from itertools import pairwise

import numpy as np
import pytest

from terrain.control.situations import (
    CAMERA_LOST_S,
    COURSE,
    MIXED,
    N_STARTS,
    SITUATIONS,
    STARTS_HOLD_S,
    SituationOptions,
    make_situation,
    start_times,
)
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.terramechanics.soil import load_soil

ROBOT = load_robot("agrimaro")


def situation(name, robot, terrain, seed, **options):
    return make_situation(name, robot, terrain, seed, SituationOptions(**options))


def terrain_of(name):
    return COURSE if name in (COURSE, MIXED) else "grass"


@pytest.mark.parametrize("name", SITUATIONS)
def test_all_that_is_drawn_depends_on_the_seed(name):
    one, again, other = (situation(name, ROBOT, terrain_of(name), seed) for seed in (3, 3, 4))
    assert one.conditions == again.conditions != other.conditions
    assert np.array_equal(one.scenario.twist, again.scenario.twist)
    assert one.scenario.patches == again.scenario.patches
    assert dict(one.soils) == dict(again.soils) != dict(other.soils)
    assert one.seed.generate_state(4).tolist() == again.seed.generate_state(4).tolist()
    assert (one.scenario.twist[0] == 0).all()
    if name not in (COURSE, MIXED):  # the same in all scenarios, level, and not nominal
        assert one.conditions == situation("starts", ROBOT, "grass", 3).conditions
        assert (one.conditions.grade_ratio, one.conditions.undulation_ratio) == ((0.0, 0.0), 0.0)
        assert one.soils["grass"] != load_soil("grass")


def test_slopes_and_radii_are_the_chosen_ones():
    asked = situation("slope", ROBOT, "grass", 5, grade_deg=10.0, radius_factors=(1.02, 1.0, 1.0)).conditions
    drawn = situation("slope", ROBOT, "grass", 5).conditions
    assert asked.grade_ratio == (pytest.approx(math.tan(math.radians(10))), 0.0)
    assert asked.radius_factors == (1.02, 1.0, 1.0) != drawn.radius_factors
    assert asked.payload_kg == drawn.payload_kg


@pytest.mark.parametrize(("speed_mps", "accel_mps2"), [(1.0, 1.0), (1.5, math.inf)])
def test_starts_begin_at_rest_and_last_as_long_as_is_evaluated(speed_mps, accel_mps2):
    scenario = situation("starts", ROBOT, "grass", 0, speed_mps=speed_mps, accel_mps2=accel_mps2).scenario
    time_s, speed = scenario.time_s, scenario.twist[:, 0]
    starts = start_times(scenario)
    assert len(starts) == N_STARTS
    assert speed.max() == speed_mps
    assert speed[-1] == 0.0
    for start_s in starts:
        ramp_s = speed_mps / accel_mps2
        assert speed[np.searchsorted(time_s, start_s)] == 0.0
        driving = (time_s > start_s + ramp_s + 0.03) & (time_s < start_s + ramp_s + STARTS_HOLD_S - 0.03)
        assert (speed[driving] == speed_mps).all()
    if math.isfinite(accel_mps2):
        assert np.abs(np.diff(speed)).max() == pytest.approx(accel_mps2 / scenario.rate_hz)


def test_mixed_changes_terrain_throughout_and_loses_its_camera():
    mixed = situation(MIXED, ROBOT, COURSE, 1)
    patches, end_m = mixed.scenario.patches, mixed.scenario.distance_m[-1]
    lengths = np.diff([patch.start_m for patch in patches])
    assert 5.0 <= lengths.min() < lengths.max() <= 9.0
    assert patches[-1].start_m > end_m - 9.0
    assert all(a.terrain != b.terrain for a, b in pairwise(patches))
    assert {patch.terrain for patch in patches} <= set(mixed.soils)
    assert mixed.faults.camera_lost_s == (CAMERA_LOST_S,)
    assert mixed.scenario.time_s[-1] > CAMERA_LOST_S[1]


@pytest.mark.parametrize(
    ("name", "terrain", "options", "message"),
    [
        ("race", "grass", {}, "scenario 'race' is unknown: use one of starts, straight"),
        ("starts", COURSE, {}, "scenario 'starts' does not go with terrain 'course'"),
        (MIXED, "grass", {}, "scenario 'mixed' does not go with terrain 'grass'"),
        ("starts", "cheese", {}, "soil 'cheese' is unknown"),
        ("starts", "grass", {"duration_s": 20.0}, "scenario 'starts' is as long as its 3 starts"),
        *[("starts", "grass", {"speed_mps": value}, "speed_mps is") for value in (0.0, 5.0)],
        *[("starts", "grass", {"accel_mps2": value}, "accel_mps2 is") for value in (0.0, math.nan)],
        ("brake", "grass", {"accel_mps2": 2.0}, "accel_mps2 is 2: scenario 'brake' has ramps of its own"),
        (MIXED, COURSE, {"accel_mps2": 2.0}, "accel_mps2 is 2: scenario 'complex' has ramps of its own"),
        (MIXED, COURSE, {"duration_s": 0.0}, "duration_s is 0.0"),
        ("slope", "grass", {"grade_deg": 60.0}, "conditions: grade_ratio is"),
        ("circle", "tiles", {"radius_factors": (0.0, 1.0, 1.0)}, "conditions: radius_factors is"),
    ],
)
def test_invalid_situations_are_refused_in_one_sentence(name, terrain, options, message):
    with pytest.raises(ConfigError) as refused:
        situation(name, ROBOT, terrain, 0, **options)
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)
