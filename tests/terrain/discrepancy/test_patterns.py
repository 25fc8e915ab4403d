"""Patterns of values by run: each is recognised with its size, and none is seen in values that differ at random."""

import numpy as np
import pytest

from terrain.discrepancy.patterns import Kind, _is_apart, pattern_of

N = 20
PLACE, NO_SESSION = np.arange(float(N)), [""] * N
SESSIONS = ["c", "a", "b", "a", "c"] * 4
IN_GROUP = np.random.default_rng(3).permutation(N) % 2
SHAPES = {
    Kind.TREND: (-0.07 * PLACE / (N - 1), NO_SESSION, -0.07 / (N - 1)),
    Kind.CHANGE: (0.05 * (PLACE >= 13), NO_SESSION, 0.05),
    Kind.GROUPS: (0.05 * IN_GROUP, NO_SESSION, 0.05),
    Kind.ROGUE: (-0.06 * (PLACE == 7), NO_SESSION, -0.06),
    Kind.SESSIONS: (np.array([{"a": 0.0, "b": 0.02, "c": 0.05}[name] for name in SESSIONS]), SESSIONS, 0.02),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_each_pattern_is_recognised_with_its_size_and_runs_that_show_nothing_do_not_count(kind):
    shape, sessions, size = SHAPES[kind]
    rng, covered = np.random.default_rng(1), 0
    for _ in range(40):
        std = 0.002 * np.exp(0.3 * rng.standard_normal(N))
        value = shape + 0.003 * rng.standard_normal(N) + std * rng.standard_normal(N)
        std[4], value[4] = np.inf, 9.0
        found = pattern_of(value, std**2, PLACE, sessions)
        assert (found.kind, found.z > 4.5) == (kind, True)
        step = np.zeros(len(found.coefficients))
        step[1], step[0] = 1.0, 0.0 if kind is Kind.TREND else -1.0
        change, (low, high) = found.at(step)
        assert change == pytest.approx(size, rel=0.35)
        covered += low <= size <= high
    assert covered >= 33  # of 40, where 95 % hold it


@pytest.mark.parametrize("n", [6, 12, 40])
@pytest.mark.parametrize("noise", [0.01, 1.0, 30.0])
def test_values_that_differ_at_random_have_no_pattern(n, noise):
    """Of five kinds, each at a probability that counts all its members."""
    rng, z = np.random.default_rng(n), []
    for _ in range(150):
        std = noise * np.exp(0.3 * rng.standard_normal(n))
        value = rng.standard_normal(n) + std * rng.standard_normal(n)
        z.append(pattern_of(value, std**2, np.arange(float(n)), ["a", "b"] * (n // 2)).z)
    assert np.mean(np.array(z) > 2.0) < 5 * 0.046 + 0.07
    assert max(z) < 4.5


def test_a_terrain_at_the_end_of_the_order_is_a_terrain_and_no_change():
    terrain = ["asphalt"] * 13 + ["sand"] * 7
    value = 0.003 * np.random.default_rng(0).standard_normal(N) + 0.05 * (PLACE >= 13)
    assert pattern_of(value, np.full(N, 1e-6), PLACE, NO_SESSION, terrain).kind is Kind.TERRAINS


def test_few_runs_or_values_that_are_all_alike_have_no_pattern():
    assert pattern_of(PLACE[:5], np.ones(5), PLACE[:5], [""] * 5) is None
    assert pattern_of(np.zeros(N), np.ones(N), PLACE, NO_SESSION) is None
    assert pattern_of(PLACE, np.full(N, np.inf), PLACE, NO_SESSION) is None


LAWS = {
    "uniform": lambda rng, n: rng.random(n),
    "normal": lambda rng, n: rng.standard_normal(n),
    "exponential": lambda rng, n: rng.standard_exponential(n),
    "log-normal": lambda rng, n: np.exp(rng.standard_normal(n)),
    "Student, 3 degrees": lambda rng, n: rng.standard_t(3, n),
}


@pytest.mark.parametrize("law", LAWS)
def test_the_tail_of_a_law_and_its_halves_are_no_groups_of_runs(law):
    """The likelihood of normal scatter alone finds two groups in up to a third of them."""
    rng, groups = np.random.default_rng(5), 0
    for n in (12, 20, 60):
        for _ in range(60):
            value = 0.02 * LAWS[law](rng, n)
            found = pattern_of(value, np.full(n, 1e-8), np.arange(float(n)), [""] * n)
            groups += found.kind is Kind.GROUPS and found.z > 4.5
    assert groups <= 2  # of 180: two percent would be 3.6


def test_half_of_the_runs_are_groups_where_they_are_apart_by_eight_deviations():
    rng, found = np.random.default_rng(6), []
    for _ in range(40):
        value = 0.05 * (rng.permutation(N) % 2) + 0.006 * rng.standard_normal(N)
        pattern = pattern_of(value, np.full(N, 1e-6), PLACE, NO_SESSION)
        found.append(pattern.kind is Kind.GROUPS and pattern.z > 4.5)
    assert np.mean(found) > 0.7


def test_runs_that_agree_by_more_than_their_noise_show_what_it_is():
    """What simulation and robot differ by in all runs alike is taken for noise of each."""
    value = 0.002 * np.random.default_rng(7).standard_normal(N) + 0.05 * (PLACE == 7)
    found = pattern_of(value, np.full(N, 0.006**2), PLACE, NO_SESSION)
    assert (found.kind, found.z > 6.0) == (Kind.ROGUE, True)
    low, high = found.at(np.array([-1.0, 1.0]))[1]
    assert 0.0 < high - low < 4 * 0.006


@pytest.mark.parametrize("n", [6, 20, 80])
def test_the_farthest_of_values_with_heavy_tails_is_seldom_apart(n):
    """One in a hundred is stated, of runs that scatter with Student's distribution of four degrees of freedom."""
    values, apart = np.random.default_rng(n).standard_t(4.0, (1000, n)), 0
    for value in values:
        own = np.arange(n) == np.argmax(np.abs(value - np.median(value)))
        columns = np.column_stack([~own, own]).astype(float)
        means = np.array([value[~own].mean(), value[own].mean()])
        apart += _is_apart(Kind.ROGUE, value, columns, means, np.full(n, 1e6))
    assert apart <= 20
