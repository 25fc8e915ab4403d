import numpy as np
import pytest

from terrain.classify.response_change import (
    BLOCK_S,
    MIN_BLOCKS,
    ChangeDetector,
    DetectorSettings,
    calibrate,
    changes_of,
    steady_blocks,
)
from terrain.errors import DataError

STD = 0.1


def log_of(rng, change_s=None, step=0.2, length_s=15.0, speed=0.1):
    time_s = np.cumsum(rng.uniform(0.028, 0.034, int(length_s / 0.031)))
    current = 0.5 + rng.normal(0.0, STD, (time_s.size, 3))
    if change_s is not None:
        current[time_s >= change_s, 1] += step
    wheels = np.tile([speed, -speed / 2, -speed / 2], (time_s.size, 1)) + rng.normal(
        0, 0.002, (time_s.size, 3)
    )
    return time_s, current, wheels


@pytest.fixture(scope="module")
def settings():
    rng = np.random.default_rng(0)
    return calibrate([log_of(rng) for _ in range(100)], 0.02)


def test_quiet_runs_give_an_alarm_as_rarely_as_it_was_asked_for(settings):
    rng = np.random.default_rng(1)
    alarms = sum(bool(changes_of(*log_of(rng), settings)) for _ in range(100))
    assert settings.false_alarm_ratio <= 0.02
    assert alarms <= 8  # of 100 at 2 %, and a threshold from 100


def test_a_hidden_change_is_found_soon_and_dated_well(settings):
    rng = np.random.default_rng(2)
    late, apart, steps, found = [], [], [], 0
    for _ in range(40):
        change_s = rng.uniform(4.0, 11.0)
        changes = changes_of(*log_of(rng, change_s), settings)
        after = [each for each in changes if each.alarm_s >= change_s]
        if after:
            found += 1
            late.append(after[0].alarm_s - change_s)
            apart.append(after[0].change_s - change_s)
            steps.append(after[0].after[1] - after[0].before[1])
    assert found == 40
    assert np.median(late) < 2.0
    assert np.abs(np.median(apart)) < 2 * BLOCK_S  # an alarm dates with three blocks after the change
    assert np.median(steps) > 0.08  # diluted by the blocks before it


def test_a_change_of_regime_is_no_change_of_ground(settings):
    rng = np.random.default_rng(3)
    for speeds in ((0.1, 0.2), (0.1, -0.1), (0.1, 0.0)):
        parts = [log_of(rng, length_s=6.0, speed=speed) for speed in speeds]
        parts[1][1][:] += 0.5 * (speeds[1] != 0.1)
        time_s = np.concatenate([parts[0][0], parts[0][0][-1] + parts[1][0]])
        joined = (
            time_s,
            *(np.concatenate([one, other]) for one, other in zip(*(p[1:] for p in parts), strict=True)),
        )
        assert changes_of(*joined, settings) == []


def test_missing_samples_are_tolerated(settings):
    rng = np.random.default_rng(4)
    time_s, current, wheels = log_of(rng, 7.0, step=0.3)
    current[rng.random(current.shape) < 0.3] = np.nan
    current[100:140] = np.nan
    found = changes_of(time_s, current, wheels, settings)
    assert 1 <= len(found) <= 2  # blocks of fewer samples scatter more than those of the threshold
    assert found[0].change_s == pytest.approx(7.0, abs=2 * BLOCK_S)


def test_sample_by_sample_is_the_whole_log(settings):
    log = log_of(np.random.default_rng(5), 6.0)
    detector = ChangeDetector(settings)
    live = [each for sample in zip(*log, strict=True) if (each := detector.update(*sample)) is not None]
    batch = changes_of(*log, settings)
    assert [(a.alarm_s, a.change_s) for a in live] == [(b.alarm_s, b.change_s) for b in batch]


def test_runs_too_short_for_a_threshold_are_refused():
    rng = np.random.default_rng(6)
    with pytest.raises(DataError, match="no run is driven steadily for"):
        calibrate([log_of(rng, length_s=1.0)])
    with pytest.raises(DataError, match="no run is driven steadily for"):
        calibrate([])


def test_blocks_begin_when_the_wheels_have_settled():
    blocks = steady_blocks(*log_of(np.random.default_rng(7), length_s=4.0))
    assert blocks[0].end_s - BLOCK_S >= 0.7
    assert np.diff([each.end_s for each in blocks]) == pytest.approx(BLOCK_S)
    assert len(blocks) >= 2 * MIN_BLOCKS
    endless = DetectorSettings(np.eye(3), np.inf, 0, 0.0)
    assert changes_of(*log_of(np.random.default_rng(8), 2.0), endless) == []
