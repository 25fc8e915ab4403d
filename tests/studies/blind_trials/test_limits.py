"""Which effects a trial may hide together."""

import numpy as np
import pytest

from studies.blind_trials.drives import command_drives, rich_drives
from studies.blind_trials.limits import Limits, limits_of
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


@pytest.mark.parametrize("least", [0.0, 1e-320, 1e-12])
def test_an_effect_that_drives_hardly_show_is_like_none_that_they_show(least):
    names = "payload_ratio", "turn_drag_s2", "scrub_ratio"
    limits = Limits(names, np.diag([100.0, least, least]))
    payload, drag, scrub = (effect_named(name) for name in ("payload", "turn_drag", "scrub"))
    assert not limits.alike(payload, drag)
    assert limits.alike(drag, scrub)
    assert not limits.spanned((payload, drag), scrub)


def test_a_run_that_stands_shows_little_and_spoils_nothing():
    """One command of eighty may be next to none."""
    husky = load_robot("husky")
    drives = command_drives(np.random.default_rng(0), husky, 3)
    standing = tuple(np.zeros_like(twist) if i == 1 else twist for i, twist in enumerate(drives.twists))
    moved = limits_of(husky, drives._replace(twists=drives.twists[::2], hills=drives.hills[::2]))
    limits = limits_of(husky, drives._replace(twists=standing))
    assert np.isfinite(limits.information).all()
    at = limits.names.index("wheel_radius_ratio")
    assert limits.information[at, at] == pytest.approx(moved.information[at, at], rel=1e-3)
