"""Windows are indexed as scikit-learn indexes its samples."""

import numpy as np
import pytest
from sklearn.utils import _safe_indexing, indexable
from sklearn.utils.validation import _num_samples

from terrain.records import WINDOW_COLUMNS, Windows

WINDOWS = Windows(
    {"imu": np.arange(36.0).reshape(6, 2, 3), "wheels": np.arange(24.0).reshape(6, 1, 4)},
    {"imu": ("gyro_z_radps", "accel_x_mps2"), "wheels": ("speed_left_mps",)},
    {"imu": 3.0, "wheels": 4.0},
    1.0,
    np.arange(6.0),
    np.array(list("aabbcc"), dtype=object),
    np.array(["ice", "ice", "mud", "mud", "ice", "ice"], dtype=object),
    np.array(["monday", "monday", "", "", "tuesday", "tuesday"], dtype=object),
)
MASK = np.array([False, True, False, True, False, False])
INDICES = [(np.array([4, 0, 0]), [4, 0, 0]), (MASK, [1, 3]), (slice(1, 5, 2), [1, 3]), ([5, -1], [5, 5])]
INDICES += [(2, [2]), (np.int64(3), [3]), (np.empty(0, dtype=int), [])]


def test_an_index_selects_the_same_rows_of_every_field_and_scikit_learn_takes_them():
    assert len(WINDOWS) == _num_samples(WINDOWS) == 6
    assert WINDOWS.shape == (6, 2 * 3 + 4)
    indexable(WINDOWS, WINDOWS.terrain, WINDOWS.run_id)
    np.testing.assert_array_equal(_safe_indexing(WINDOWS, np.array([5, 2])).start_s, [5.0, 2.0])
    for index, rows in INDICES:
        found = WINDOWS[index]
        assert isinstance(found, Windows)
        assert found.shape == (len(rows), 10)
        for name, values in WINDOWS.values.items():
            np.testing.assert_array_equal(found.values[name], values[rows])
        for name in WINDOW_COLUMNS:
            np.testing.assert_array_equal(getattr(found, name), getattr(WINDOWS, name)[rows])
        assert (found.channels, found.rate_hz, found.length_s) == (WINDOWS.channels, WINDOWS.rate_hz, 1.0)


@pytest.mark.parametrize("field", WINDOW_COLUMNS)
def test_fields_of_different_lengths_are_refused(field):
    fields = {name: getattr(WINDOWS, name) for name in Windows.__dataclass_fields__}
    with pytest.raises(ValueError, match=r"one entry a window|does not fit"):
        Windows(**fields | {field: fields[field][:-1]})
