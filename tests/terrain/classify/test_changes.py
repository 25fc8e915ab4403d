"""Stretches that stand out of a run or break away from their label, and changes of the ground while it drives."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.classify.changes import (
    BLOCK_S,
    SHIFT_LEAST,
    blocks_of,
    breakaways,
    calibrate,
    change_points,
    changes_of,
    partition,
)
from terrain.classify.held_out import HeldOut
from terrain.errors import DataError
from terrain.records import Windows


@settings(max_examples=40)
@given(st.integers(0, 1000), st.sampled_from([0.5, 5.0, 50.0]))
def test_the_partition_is_the_best_of_all_of_them(seed, penalty):
    z = np.random.default_rng(seed).normal(size=(9, 2)) + 3.0 * (np.arange(9) > seed % 9)[:, None]

    def cost(ends):
        parts = [z[a:b] for a, b in itertools.pairwise([0, *ends])]
        return sum(np.square(part - part.mean(axis=0)).sum() for part in parts) + penalty * (len(parts) - 1)

    every = [
        [*inner, 9]
        for k in range(5)
        for inner in itertools.combinations(range(2, 8), k)
        if (np.diff([0, *inner, 9]) >= 2).all()
    ]
    assert cost(partition(z, 2, penalty)) == pytest.approx(min(map(cost, every)))


def test_noise_alone_and_short_runs_have_no_stretch():
    rng = np.random.default_rng(0)
    assert sum(len(change_points(rng.normal(size=(60, 8)))) for _ in range(50)) == 0
    assert change_points(np.zeros((5, 3))) == change_points(np.ones((40, 3))) == []


@settings(max_examples=40)
@given(st.integers(0, 1000), st.integers(3, 40), st.integers(4, 15))
def test_a_stretch_is_found_where_it_is(seed, first, length):
    z = np.random.default_rng(seed).normal(size=(60, 6))
    z[first : first + length] += 15.0
    found = change_points(z)
    assert (found[0][0], found[-1][1]) == (first, first + length)
    assert all(shift > SHIFT_LEAST for *_, shift in found)


START_S = 2.0 * np.arange(30)


def of_run(probability, start_s=START_S):
    """Return the stretches of a run of class 0."""
    classes, n = np.arange(probability.shape[1]).astype(str), len(start_s)
    windows = Windows({}, {}, {}, 2.0, start_s, np.full(n, "a"), np.full(n, "0"))
    return breakaways(HeldOut.of_model(classes, probability, np.full(n, "0")), windows)


@pytest.mark.parametrize("first", [0, 9, 25])
def test_a_hidden_stretch_of_another_terrain_is_found(first):
    """In runs of class 0 whose windows are wrong now and then."""
    n_found = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        column = np.where(rng.random(30) < 0.85, 0, rng.integers(1, 4, 30))
        probability = rng.dirichlet(np.full(4, 0.5), 30) * 0.3
        probability[np.arange(30), column] += 0.7
        probability[first : first + 5] = [0.05, 0.05, 0.85, 0.05]
        found = [each for each in of_run(probability) if each.looks_like == "2"]
        n_found += bool(found)
        if found:
            assert found[0].start_s <= 2.0 * first
            assert found[0].end_s >= 2.0 * first + 10.0
            assert found[0].label_probability < 0.2 < 0.5 < found[0].rest_probability
    assert n_found >= 19


def test_windows_beside_a_pause_are_no_stretch_and_nothing_is_found_in_nothing():
    probability = np.repeat([[0.9, 0.1], [0.1, 0.9], [0.9, 0.1]], [13, 4, 13], axis=0)
    assert len(of_run(probability)) == 1
    paused = START_S + 60.0 * (np.arange(30) >= 15)
    assert of_run(probability, paused) == of_run(np.empty((0, 2)), np.empty(0)) == ()


def log_of(rng, change_s=None, step=0.2, length_s=15.0, speed=0.1):
    time_s = np.cumsum(rng.uniform(0.028, 0.034, int(length_s / 0.031)))
    current = 0.5 + rng.normal(0.0, 0.1, (time_s.size, 3))
    if change_s is not None:
        current[time_s >= change_s, 1] += step
    return time_s, current, speed * np.array([1.0, -0.5, -0.5]) + rng.normal(0, 0.002, (time_s.size, 3))


@pytest.fixture(scope="module")
def quiet():
    """Settings of a detector by runs on one ground."""
    rng = np.random.default_rng(0)
    return calibrate([log_of(rng) for _ in range(60)], 0.02)


def test_quiet_runs_give_an_alarm_as_rarely_as_it_was_asked_for(quiet):
    rng = np.random.default_rng(1)
    alarms = sum(bool(changes_of(*log_of(rng), quiet)) for _ in range(60))
    low, high = quiet.false_alarm_interval
    assert low <= quiet.false_alarm_ratio <= high
    assert low <= 0.02
    assert quiet.false_alarms_a_minute == pytest.approx(
        60 * quiet.false_alarm_ratio / (60 * 15 / 60), rel=0.02
    )
    assert alarms <= 6  # of 60 at 2 %, and a threshold from 60
    for logs in ([log_of(rng, length_s=1.0)], []):
        with pytest.raises(DataError, match="no run is driven steadily for"):
            calibrate(logs)


def test_the_rate_of_false_alarms_is_that_of_units_held_out():
    rng = np.random.default_rng(6)
    # one of six sessions scatters three times as much: held out with its own runs in training, no run shows it
    scales, logs = np.repeat([3.0, 1.0, 1.0, 1.0, 1.0, 1.0], 8), []
    for scale in scales:
        time_s, current, wheels = log_of(rng)
        logs.append((time_s, 0.5 + scale * (current - 0.5), wheels))
    by_run = calibrate(logs, 0.1)
    by_session = calibrate(logs, 0.1, [f"session {i // 8}" for i in range(48)])
    assert by_run.threshold == by_session.threshold
    assert by_session.false_alarm_ratio > by_run.false_alarm_ratio
    assert np.isnan(calibrate(logs[:1], 0.1).false_alarm_ratio)
    assert np.isnan(calibrate(logs[:8], 0.1, ["one session"] * 8).false_alarm_interval).all()


@pytest.mark.slow
def test_the_stated_rate_of_false_alarms_is_that_of_new_runs():
    rng, alarms = np.random.default_rng(7), []
    for _ in range(20):
        found = calibrate([log_of(rng, length_s=6.0) for _ in range(60)], 0.05)
        alarms += [bool(changes_of(*log_of(rng, length_s=6.0), found)) for _ in range(30)]
    assert np.mean(alarms) == pytest.approx(0.05, abs=0.03)


def test_a_hidden_change_is_found_soon_and_dated_well(quiet):
    rng = np.random.default_rng(2)
    late, apart, steps = [], [], []
    for _ in range(20):
        change_s = rng.uniform(4.0, 11.0)
        first = next(each for each in changes_of(*log_of(rng, change_s), quiet) if each.alarm_s >= change_s)
        late.append(first.alarm_s - change_s)
        apart.append(first.change_s - change_s)
        steps.append(first.after[1] - first.before[1])
    assert np.median(late) < 2.0
    assert np.abs(np.median(apart)) < 2 * BLOCK_S  # an alarm dates with three blocks after the change
    assert np.median(steps) > 0.08  # diluted by the blocks before it


def test_a_change_of_regime_is_no_change_of_ground(quiet):
    rng = np.random.default_rng(3)
    for speeds in ((0.1, 0.2), (0.1, -0.1), (0.1, 0.0)):
        parts = [log_of(rng, length_s=6.0, speed=speed) for speed in speeds]
        parts[1][1][:] += 0.5 * (speeds[1] != 0.1)
        parts[1][0][:] += parts[0][0][-1]
        joined = [np.concatenate(both) for both in zip(*parts, strict=True)]
        assert changes_of(*joined, quiet) == []


def test_missing_samples_are_tolerated(quiet):
    rng = np.random.default_rng(4)
    time_s, current, wheels = log_of(rng, 7.0, step=0.3)
    current[rng.random(current.shape) < 0.3] = np.nan
    current[100:140] = np.nan
    found = changes_of(time_s, current, wheels, quiet)
    assert 1 <= len(found) <= 2  # blocks of fewer samples scatter more than those of the threshold
    assert found[0].change_s == pytest.approx(7.0, abs=2 * BLOCK_S)


def test_what_is_found_does_not_depend_on_what_comes_later(quiet):
    log = log_of(np.random.default_rng(5), 6.0)
    whole, ends_s = changes_of(*log, quiet), [block.end_s for block in blocks_of(*log)]
    assert whole
    for n in (200, 300, len(log[0])):
        short = [part[:n] for part in log]
        begun_s = [block.end_s for block in blocks_of(*short)]
        assert begun_s == ends_s[: len(begun_s)]
        known = [each.alarm_s for each in whole if each.alarm_s <= short[0][-1] - BLOCK_S]
        assert [each.alarm_s for each in changes_of(*short, quiet)][: len(known)] == known
