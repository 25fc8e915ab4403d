"""The filter of the terrain over time by its plain form, and what held-out windows choose for it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from terrain.classify import terrain_filter as constants
from terrain.classify.terrain_filter import (
    NOVELTY_WEIGHTS,
    SHARE_POWERS,
    LiveTerrainFilter,
    check_settings,
    choose_settings,
    filter_run,
    filter_sessions,
    novelty_evidence,
    reported,
)
from terrain.errors import ConfigError, DataError

SHARES = np.array([0.5, 0.3, 0.2])
THREE = check_settings(SHARES, 1.0, 1.0)


def draw(seed, n=40, k=3, refused_ratio=0.2):
    """Return class probabilities with refused windows, times with gaps, and scores of novelty."""
    rng = np.random.default_rng(seed)
    probability = rng.dirichlet(np.full(k, 0.3), n)
    probability[rng.random(n) < refused_ratio] = np.nan
    return probability, np.cumsum(rng.choice([0.0, 0.25, 0.25, 2.0, 30.0], n)), rng.normal(0.0, 1.0, n)


def dense_filter(probability, time_s, settings, novelty):
    """Return the beliefs by a full generator matrix and logarithms."""
    prior, share_power, weight = settings
    k = len(prior)
    shares = np.append(np.full(k, (1 - constants.UNKNOWN_RATIO) / k), constants.UNKNOWN_RATIO)
    rate = 1.0 / (constants.DWELL_S * (1.0 - shares[0]))
    generator = rate * (np.tile(shares, (k + 1, 1)) - np.eye(k + 1))
    belief, before_s, output_s, found = shares, time_s[0], -np.inf, []
    for p, now_s, score in zip(probability, time_s, novelty, strict=True):
        belief = belief @ expm(generator * (now_s - before_s))
        before_s = now_s
        if not np.isnan(p).any():
            power = min((now_s - output_s) / constants.EVIDENCE_S, 1.0)
            output_s = now_s
            by_shares, plain = p / prior, p * k  # of which the geometric mean is taken
            ratio = by_shares**share_power * plain ** (1 - share_power)
            mixed = (1 - constants.OUTLIER_RATIO) * ratio + constants.OUTLIER_RATIO
            log_belief = np.log(belief) + power * np.append(np.log(mixed), weight * score)
            belief = np.exp(log_belief - log_belief.max())
            belief = belief / belief.sum()
        found.append(belief)
    return np.array(found)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), power=st.floats(0.0, 1.0), weight=st.floats(0.0, 1.0))
def test_the_filter_agrees_with_a_dense_matrix_exponential(seed, power, weight):
    probability, time_s, novelty = draw(seed)
    settings = check_settings(SHARES, power, weight)
    found = filter_run(probability, time_s, settings, novelty)
    np.testing.assert_allclose(found, dense_filter(probability, time_s, settings, novelty), atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)


def test_posteriors_that_hold_the_shares_need_the_power_1_and_those_that_hold_none_0():
    """Of one likelihood, under the shares and under even ones: the beliefs are the same."""
    rng = np.random.default_rng(0)
    likelihood, time_s = rng.dirichlet(np.ones(3), 60), np.arange(60) / 4
    under = [likelihood * share / (likelihood * share).sum(axis=1)[:, None] for share in (SHARES, np.ones(3))]
    by_shares, plain = (
        [filter_run(each, time_s, check_settings(SHARES, power)) for each in under] for power in (1.0, 0.0)
    )
    even = filter_run(under[1], time_s, check_settings(np.full(3, 1 / 3), 1.0))
    np.testing.assert_allclose(plain[1], even, atol=1e-12)
    # what a window weighs against "unknown" and outliers depends on the shares, which class it speaks for does not
    assert (by_shares[0][:, :3].argmax(axis=1) == even[:, :3].argmax(axis=1)).mean() > 0.95
    assert np.abs(by_shares[0] - even).mean() < np.abs(plain[0] - even).mean() / 2


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_live_filter_gives_what_the_whole_run_gives(seed):
    probability, time_s, novelty = draw(seed)
    time_s, unknown = 5.0 + np.arange(len(time_s)) * 0.25, novelty > 1.0
    belief = filter_run(probability, time_s, THREE, novelty_evidence(novelty, unknown))
    live = LiveTerrainFilter(THREE)
    found = [live.take(*each) for each in zip(time_s, probability, novelty, unknown, strict=True)]
    assert [best for best, _ in found] == reported(belief).tolist()
    for (best, certain), row in zip(found, belief, strict=True):
        assert np.isnan(certain) if best < 0 else certain == row[best]


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 39))
def test_belief_goes_on_through_a_session_as_over_a_gap_and_begins_anew_in_another(seed, n):
    probability, _, novelty = draw(seed)
    end_s = 2.0 + np.concatenate([np.arange(n), np.arange(40 - n)])
    run = np.where(np.arange(40) < n, "b", "a")  # by name the second comes first
    one, two = np.stack([np.full(40, "monday"), run], axis=1), np.stack([run, run], axis=1)
    gap_s = n + 1.0 + 2.0  # the duration of the first run, and the first window of the second
    time_s = np.append(np.arange(n), n - 1 + gap_s + np.arange(40 - n))
    through = filter_sessions(probability, end_s, one, 2.0, THREE, novelty)
    np.testing.assert_allclose(through, filter_run(probability, time_s, THREE, novelty), atol=1e-12)
    mixed = np.random.default_rng(seed).permutation(n)  # rows of a run in any order
    rows = np.append(mixed, np.arange(n, 40))
    again = filter_sessions(probability[rows], end_s[rows], one[rows], 2.0, THREE, novelty[rows])
    np.testing.assert_array_equal(again, through[rows])
    anew = filter_run(probability[n:], end_s[n:], THREE, novelty[n:])
    np.testing.assert_array_equal(filter_sessions(probability, end_s, two, 2.0, THREE, novelty)[n:], anew)
    live = LiveTerrainFilter(THREE)
    for i in range(n):
        live.take(end_s[i], probability[i], novelty[i])
    live.restart(gap_s)  # and the clock begins anew
    evidence = novelty_evidence(novelty, np.zeros(40, dtype=bool))
    batch = filter_run(probability, time_s, THREE, evidence)[n]
    assert live.take(end_s[n], probability[n], novelty[n])[0] == reported(batch[None])[0]


def test_a_clock_that_goes_back_costs_one_window():
    live = LiveTerrainFilter(THREE)
    certain = np.eye(3) * 0.85 + 0.05
    assert [live.take(1000.0 + k, certain[0])[0] for k in range(4)] == [0] * 4
    assert live.take(1.0, certain[1])[0] == 0
    assert [live.take(2.0 + k, certain[1])[0] for k in range(4)][-1] == 1


NAMES = np.array(["grass", "ice", "mud"])
PRIOR = dict(zip(NAMES.tolist(), SHARES.tolist(), strict=True))


def held_out(seed, n_runs=12, n=20, right=0.6, shares=(1.0, 1.0, 1.0)):
    """Return drawn posteriors of windows, which err run by run, and the windows' classes, ends and runs."""
    rng = np.random.default_rng(seed)
    truth = np.repeat(np.arange(n_runs) % 3, n)
    run = np.repeat(np.arange(n_runs), n).astype(str)
    log_odds = rng.normal(0.0, 1.0, (n_runs * n, 3)) + np.repeat(rng.normal(0.0, 0.7, (n_runs, 3)), n, axis=0)
    log_odds[np.arange(len(truth)), truth] += 2.0 * right
    probability = np.exp(log_odds) * shares
    probability /= probability.sum(axis=1, keepdims=True)
    return probability, NAMES[truth], np.tile(2.0 * np.arange(1, n + 1), n_runs), np.stack([run, run], axis=1)


def chosen(seed, novelty=None, **drawn):
    """Return the settings for drawn windows, and how often single windows and the filter are right."""
    probability, terrain, end_s, groups = held_out(seed, **drawn)
    found = choose_settings(probability, terrain, end_s, groups, 2.0, PRIOR, novelty)
    truth = np.searchsorted(NAMES, terrain)
    single = np.mean(probability.argmax(axis=1) == truth)
    if found is None:
        return None, single, single
    belief = filter_sessions(probability, end_s, groups, 2.0, found, novelty)
    return found, single, np.mean(reported(belief) == truth)


@pytest.mark.parametrize("seed", range(12))
def test_on_the_windows_that_choose_the_filter_is_never_worse_than_single_windows(seed):
    _, single, filtered = chosen(seed, right=0.1 * seed)
    assert filtered >= single
    if seed >= 5:
        assert filtered > single + 0.05


def test_power_and_weight_follow_what_held_out_windows_show():
    assert {chosen(seed)[0][1:] for seed in range(5)} == {(SHARE_POWERS[0], NOVELTY_WEIGHTS[0])}  # even
    shares = {"shares": 3 * SHARES**2, "n_runs": 60}
    assert np.mean([chosen(seed, **shares)[0].share_power for seed in range(5)]) > 0.7
    novel = np.full(240, 1.4)  # all that is known is found to be novel
    assert {chosen(seed, novel, right=1.0)[0].novelty_weight for seed in range(5)} <= {0.0, 0.5}
    assert {chosen(seed, -0.2 * novel)[0].novelty_weight for seed in range(5)} == {1.0}


def test_single_windows_are_taken_where_belief_is_always_late_and_what_is_preferred_without_windows():
    _, terrain, end_s, groups = held_out(0)
    prior = dict.fromkeys(NAMES.tolist(), 1 / 3)
    terrain = NAMES[np.arange(len(terrain)) % 3]  # another ground in every window
    always_right = np.where(terrain[:, None] == NAMES, 0.6, 0.2)
    assert choose_settings(always_right, terrain, end_s / 8, groups, 0.25, prior) is None
    for known in (np.full_like(always_right, np.nan), None):
        found = choose_settings(known, terrain, end_s, groups, 2.0, prior)
        assert found[1:] == (SHARE_POWERS[0], NOVELTY_WEIGHTS[0])


def test_what_means_nothing_or_does_not_fit_is_refused():
    for arguments, message in (
        (((1.0,),), "1 classes, at least 2"),
        (((0.0, 1.0),), "prior of class 1 is 0.0"),
        ((SHARES, -0.1), "share power is -0.1, a number from 0 to 1"),
        ((SHARES, np.nan), "share power is nan"),
        ((SHARES, 0.5, 1.5), "novelty weight is 1.5"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_settings(*arguments)
    with pytest.raises(DataError, match=r"shape \(4, 2\), \(4, 3\) is needed"):
        filter_run(np.ones((4, 2)), np.arange(4.0), THREE)
    with pytest.raises(DataError, match="in order of time"):
        filter_run(np.ones((2, 3)), np.array([1.0, 0.0]), THREE)
    with pytest.raises(DataError, match="1 scores of novelty do not fit 2 windows"):
        filter_run(np.ones((2, 3)), np.array([0.0, 1.0]), THREE, np.zeros(1))


def test_what_is_distinguished_is_counted_over_sessions(monkeypatch):
    probability, terrain, end_s, groups = held_out(0)
    session = np.char.add("session of ", terrain)
    session[: len(session) // 2] = np.char.add(session[: len(session) // 2], " before")
    seen, error = [], constants._standard_error
    monkeypatch.setattr(
        constants, "_standard_error", lambda each, unit: seen.append(unit) or error(each, unit)
    )
    choose_settings(probability, terrain, end_s, np.stack([session, groups[:, 1]], axis=1), 2.0, PRIOR)
    assert set(seen[0]) == set(session)
