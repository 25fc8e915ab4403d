import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.classify.change_points import SHIFT_LEAST, _partition, change_points


def cost(z, ends, penalty):
    parts = [z[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    return sum(np.square(part - part.mean(axis=0)).sum() for part in parts) + penalty * (len(parts) - 1)


@given(st.integers(0, 1000), st.sampled_from([0.5, 5.0, 50.0]))
def test_the_partition_is_the_best_of_all_of_them(seed, penalty):
    z = np.random.default_rng(seed).normal(size=(9, 2)) + 3.0 * (np.arange(9) > seed % 9)[:, None]
    found = _partition(z, 2, penalty)
    every = [
        [*inner, 9]
        for k in range(5)
        for inner in itertools.combinations(range(2, 8), k)
        if (np.diff([0, *inner, 9]) >= 2).all()
    ]
    assert cost(z, found, penalty) == pytest.approx(min(cost(z, ends, penalty) for ends in every))


def test_noise_alone_and_short_runs_have_no_stretch():
    rng = np.random.default_rng(0)
    assert sum(len(change_points(rng.normal(size=(60, 8)))) for _ in range(100)) == 0
    assert change_points(np.zeros((5, 3))) == []
    assert change_points(np.ones((40, 3))) == []


@given(st.integers(0, 1000), st.integers(3, 40), st.integers(4, 15))
def test_a_stretch_is_found_where_it_is(seed, first, length):
    z = np.random.default_rng(seed).normal(size=(60, 6))
    z[first : first + length] += 15.0
    found = change_points(z)
    assert (found[0].first, found[-1].end) == (first, first + length)
    assert all(each.shift > SHIFT_LEAST for each in found)
