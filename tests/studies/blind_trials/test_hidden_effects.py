"""The sealed side of the blind trials: its limits agree with the diagnosis' own, and nothing leaks."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from studies.blind_trials.drives import LEAD_S, command_drives, poor_drives, rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.limits import POWER, TEST_SIZE, confusable_class, limits_of
from studies.blind_trials.trial import simulation_of
from terrain.discrepancy.answers import POWER_Z
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.selection import Z_EFFECT
from terrain.effects import effect_named, library_of
from terrain.robots import load_robot

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")


@pytest.fixture(scope="module", params=[HUSKY, AGRIMARO], ids=["husky", "agrimaro"])
def world(request):
    drives = rich_drives(np.random.default_rng(1), 6, 40.0)
    return request.param, drives, limits_of(request.param, drives)


def test_the_cramer_rao_limit_and_the_diagnosis_agree_on_what_can_be_seen(world):
    """Two routes: true motion and the noise that is put in; logs and the noise that is found in them.

    The first takes noise at one pace, the second knows that it is less in slow turns.
    """
    robot, drives, limits = world
    runs = hidden_runs(robot, drives, np.random.SeedSequence(4), {})
    found = diagnose(runs, simulation_of(robot))
    per_std = norm.isf(TEST_SIZE / 2 / limits.library_size) + norm.ppf(POWER)
    ratios = {}
    modifying = {p.name for e in library_of(robot.drive) if e.modifies for p in e.parameters}
    assert all(math.isinf(limit.value) == (limit.name in modifying) for limit in found.limits)
    for limit in found.limits:
        if limit.name in modifying:
            continue
        std = 1 / math.sqrt(limits.information.diagonal()[limits.names.index(limit.name)])
        ratios[limit.name] = limit.value / (Z_EFFECT + POWER_Z) / std
        for effect in library_of(robot.drive):
            if effect.parameters[0].name == limit.name:
                assert limits.of(effect) == pytest.approx(per_std * std)
    assert np.mean([abs(ratio - 1) < 0.4 for ratio in ratios.values()]) > 0.85, ratios
    assert all(0.4 < ratio < 2.5 for ratio in ratios.values()), ratios


def test_limits_fall_with_more_runs_and_rise_where_little_is_driven(world):
    robot, drives, limits = world
    half = limits_of(robot, drives._replace(twists=drives.twists[:3], hills=drives.hills[:3]))
    poor = limits_of(robot, poor_drives(np.random.default_rng(1), 3, 40.0))
    for effect in library_of(robot.drive):
        assert limits.of(effect) < half.of(effect) or effect.modifies
    shown = "steering_delay" if robot is AGRIMARO else "turning_slip"
    assert poor.of(effect_named(shown)) > 3 * half.of(effect_named(shown))
    lever = effect_named("lever_arm")
    along = limits.of(lever, np.array([0.0, 1.0]))
    at = limits.names.index("lever_y_m")
    assert along / limits.of(lever) == pytest.approx(
        math.sqrt(limits.information[at - 1, at - 1] / limits.information[at, at])
    )


def test_an_effect_is_of_its_own_class_and_a_class_is_mutual(world):
    robot, _, limits = world
    library = library_of(robot.drive)
    classes = {effect.name: confusable_class(limits, effect, robot.drive) for effect in library}
    for name, members in classes.items():
        assert name in members
        assert all(name in classes[other] for other in members)
    assert "gyro_bias" not in classes["payload"]


def test_nothing_of_the_truth_leaks_into_the_runs(world):
    robot, drives, _ = world
    some = drives._replace(twists=drives.twists[:2], hills=drives.hills[:2])
    plain, hidden = (
        hidden_runs(robot, some, np.random.SeedSequence(9), effects)
        for effects in ({}, {"payload_ratio": 0.3})
    )
    for run, other in zip(plain, hidden, strict=True):
        assert set(run.streams) <= {"wheels", "imu", "odometry", "steering"}
        assert (run.run_id, run.labels, run.source) == (other.run_id, other.labels, other.source)
        assert run.source == ""
        assert "payload" not in repr(other)
        assert {name: s.channels for name, s in run.streams.items()} == {
            name: s.channels for name, s in other.streams.items()
        }
        # the same draws: an effect on masses leaves gyro noise alone, and shows in the currents
        currents = [f"current_{wheel}_a" for wheel in robot.wheels]
        one, two = (sum(r.streams["wheels"].channel(name) for name in currents) for r in (run, other))
        assert np.std(two - one) > 0.1


def test_the_same_seed_gives_the_same_bytes(world):
    robot, drives, _ = world
    some = drives._replace(twists=drives.twists[:2], hills=drives.hills[:2])

    def bytes_of(seed):
        runs = hidden_runs(robot, some, np.random.SeedSequence(seed), {"gyro_bias_radps": 0.01})
        return [stream.values.tobytes() for run in runs for stream in run.streams.values()]

    assert bytes_of(3) == bytes_of(3)
    assert not set(bytes_of(3)) & set(bytes_of(4))
    assert len(set(bytes_of(3))) == len(bytes_of(3))
    again = rich_drives(np.random.default_rng(1), 6, 40.0)
    assert all((a == b).all() for a, b in zip(again.twists, drives.twists, strict=True))
    assert again.hills == drives.hills


def test_a_clock_that_drifts_starts_with_the_log():
    """Of a log that begins two seconds into a drive, the first stamps of both loggers agree."""
    rate = 0.02
    drives = command_drives(np.random.default_rng(0), HUSKY, 1)
    (plain,), (drifting,) = (
        hidden_runs(HUSKY, drives, np.random.SeedSequence(1), values)
        for values in ({}, {"clock_rate_ratio": rate})
    )
    one, other = (run.streams["imu"].channel("gyro_z_radps") for run in (plain, drifting))
    shown, late = plain.streams["imu"].time_s, drifting.streams["imu"].time_s
    assert late[0] == pytest.approx(shown[0] - rate * LEAD_S, abs=0.02)
    # an event is stamped as late as the clock has drifted since the log began
    event = shown[np.abs(np.diff(one)).argmax()]
    there = late[np.abs(np.diff(other)).argmax()]
    assert there - event == pytest.approx(rate * event, abs=0.03)
