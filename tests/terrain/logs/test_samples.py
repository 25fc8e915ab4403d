from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from terrain.logs.samples import longest_rise


@given(st.lists(st.integers(-20, 20), max_size=12))
def test_the_longest_rise_rises_and_nothing_longer_does(numbers):
    rise = [numbers[i] for i in longest_rise(np.array(numbers, dtype=float))]
    assert all(a < b for a, b in pairwise(rise))
    best = [1] * len(numbers)  # by the plain quadratic recursion
    for i, number in enumerate(numbers):
        best[i] = 1 + max((best[j] for j in range(i) if numbers[j] < number), default=0)
    assert len(rise) == max(best, default=0)
