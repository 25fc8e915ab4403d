from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.errors import LogError
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


@pytest.mark.parametrize(
    ("time_s", "message"),
    [
        ([0.0, 12.43, 12.41], "A/imu_1.csv: time goes back at row 4 (12.41 s after 12.43 s)"),
        ([0.0, 0.1, 0.1], "A/imu_1.csv: time repeats at row 4 (0.1 s twice)"),
        ([0.0, np.nan, 0.1], "A/imu_1.csv: time at row 3 is not finite (nan)"),
        ([0.0], "A/imu_1.csv: has 1 usable rows of data, at least 2 are needed"),
    ],
)
def test_bad_times_are_refused_with_row_and_value(time_s, message):
    with pytest.raises(LogError) as error:
        stream_of(time_s)
    assert str(error.value) == message


def test_a_dead_channel_is_refused_and_stays_nan_on_repair():
    values = [[1.0, np.nan], [np.inf, np.inf], [3.0, np.nan]]
    with pytest.raises(LogError, match="channel accel_x_mps2 has nothing finite in its 3 rows"):
        stream_of([0, 1, 2], values)
    dropped = Counter()
    repaired = stream_of([0, 1, 2], values, repairs=dropped)
    assert repaired.channels == tuple(CHANNELS)
    assert np.isnan(repaired.values).tolist() == [[False, True], [True, True], [False, True]]
    assert dropped == {"channels with nothing finite": 1}


@pytest.mark.parametrize("spike_s", [1e6, -1e6, np.nan, 5.0])
def test_one_bad_time_costs_one_row_on_repair(spike_s):
    time_s = np.arange(10.0)
    time_s[6] = spike_s
    dropped = Counter()
    stream = stream_of(time_s, repairs=dropped)
    assert stream.time_s.tolist() == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert dropped == {BAD_TIME: 1}
