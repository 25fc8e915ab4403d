"""Which effects a trial may hide together."""

import numpy as np

from terrain.discrepancy.trials.drives import rich_drives
from terrain.discrepancy.trials.limits import limits_of
from terrain.effects import effect_named
from terrain.robots import load_robot


def test_two_effects_that_a_third_can_stand_for_are_known():
    """Equal latencies of IMU and camera are a clock offset; a payload is neither."""
    husky = load_robot("husky")
    limits = limits_of(husky, rich_drives(np.random.default_rng(1), 3))
    pair = effect_named("imu_latency"), effect_named("camera_latency")
    assert limits.spanned(pair, effect_named("clock_offset"))
    assert not limits.spanned(pair, effect_named("payload"))
    assert not limits.alike(pair[0], effect_named("clock_offset"))
