import numpy as np
import pytest

from terrain.classify.slow_fast import Applicability, run_speeds, slow_fast_split

PLAN = {
    "ASPHALT": (0.3, 0.4, 0.7, 0.8),
    "GRASS": (0.9, 0.5, 1.0, 0.6),
    "GRAVEL": (0.1, 0.2, 0.3, 0.4, 0.5),
}


def windows_of(plan, duration_s=32.0, stride_s=2.0):
    """Return wheel speeds, run, terrain and start of windows of 2 s, one run ``TERRAIN_i`` a speed."""
    rng, rows = np.random.default_rng(0), []
    for terrain, speeds in plan.items():
        for i, speed in enumerate(speeds):
            for start_s in np.arange(0.0, duration_s - 1.9, stride_s):
                rows.append((speed + 0.005 * rng.normal(size=20), f"{terrain}_{i}", terrain, start_s))
    return [np.array(column) for column in zip(*rows, strict=True)]


def test_the_speed_of_a_run_is_that_where_it_moves():
    fastest = np.vstack(
        [np.full((6, 20), 0.01), np.full((4, 20), 0.6), np.zeros((3, 20)), np.full((1, 20), np.nan)]
    )
    speeds = run_speeds(fastest, np.repeat(["creeps", "rests", "unknown"], [10, 3, 1]))
    assert speeds.pop("creeps") == 0.6
    assert np.isnan(list(speeds.values())).all()


def test_each_class_is_split_at_its_own_median_speed():
    fastest, run_id, terrain, start_s = windows_of(PLAN)
    side, split = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert (split.left_out, split.status) == ({}, Applicability.APPLICABLE)
    slow, fast = (set(run_id[side == name].tolist()) for name in ("slow", "fast"))
    assert slow == {"ASPHALT_0", "ASPHALT_1", "GRASS_1", "GRASS_3", "GRAVEL_0", "GRAVEL_1", "GRAVEL_2"}
    assert fast == {"ASPHALT_2", "ASPHALT_3", "GRASS_0", "GRASS_2", "GRAVEL_3", "GRAVEL_4"}
    assert split.classes["GRASS"] == pytest.approx((0.55, 0.95), abs=0.02)


def test_a_class_with_too_little_on_a_side_is_left_out_and_named():
    three = PLAN | {"GRAVEL": (0.3, 0.4, 0.8)}
    fastest, run_id, terrain, start_s = windows_of(three)
    side, split = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert split.left_out == {"GRAVEL": "fast runs: 1"}
    assert split.status is Applicability.NOT_APPLICABLE  # three classes are needed
    assert set(side[terrain == "GRAVEL"]) == {""}
    for stride_s in (2.0, 0.5):  # windows that overlap cover no more, though they are more
        _, split = slow_fast_split(*windows_of(PLAN, 28.0, stride_s), 2.0)
        assert split.left_out["ASPHALT"] == "slow runs: 56 s"


def test_a_run_slow_on_one_class_and_fast_on_another_is_on_no_side():
    """Its windows would otherwise train and test at once."""
    fastest, run_id, terrain, start_s = windows_of(PLAN)
    run_id = np.where(np.isin(run_id, ["GRASS_1", "GRAVEL_4"]), "mixed", run_id)
    side, _ = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert set(side[run_id == "mixed"]) == {""}
    assert not set(run_id[side == "slow"]) & set(run_id[side == "fast"])
