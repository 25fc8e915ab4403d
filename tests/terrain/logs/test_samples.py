from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.logs.samples import BAD_TIME, checked_stream, longest_rise

CHANNELS = ["gyro_z_radps", "accel_x_mps2"]


def stream_of(time_s, values=None, **options):
    time_s = np.array(time_s, dtype=float)
    values = np.ones((time_s.size, 2)) if values is None else np.array(values, dtype=float)
    return checked_stream("A/imu_1.csv", time_s, values, CHANNELS, row_of=lambda i: i + 2, **options)


@given(st.lists(st.integers(-20, 20), max_size=12))
def test_the_longest_rise_rises_and_nothing_longer_does(numbers):
    rise = [numbers[i] for i in longest_rise(np.array(numbers, dtype=float))]
    assert all(a < b for a, b in pairwise(rise))
    best = [1] * len(numbers)  # by the plain quadratic recursion
    for i, number in enumerate(numbers):
        best[i] = 1 + max((best[j] for j in range(i) if numbers[j] < number), default=0)
    assert len(rise) == max(best, default=0)


@pytest.mark.parametrize("spike_s", [1e6, -1e6, np.nan, 5.0])
def test_one_bad_time_costs_one_row_on_repair(spike_s):
    time_s = np.arange(10.0)
    time_s[6] = spike_s
    dropped = Counter()
    stream = stream_of(time_s, repairs=dropped)
    assert stream.time_s.tolist() == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert dropped == {BAD_TIME: 1}
