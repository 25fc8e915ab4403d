"""Windows are indexed as scikit-learn indexes its samples."""

import numpy as np
import pytest
from sklearn.utils import _safe_indexing, indexable
from sklearn.utils.validation import _num_samples

from terrain.records import Windows


@pytest.fixture
def windows():
    n = 6
    return Windows(
        {
            "imu": np.arange(n * 2 * 3, dtype=float).reshape(n, 2, 3),
            "wheels": np.arange(n * 4.0).reshape(n, 1, 4),
        },
        {"imu": ("gyro_z_radps", "accel_x_mps2"), "wheels": ("speed_left_mps",)},
        {"imu": 3.0, "wheels": 4.0},
        1.0,
        np.arange(n, dtype=float),
        np.array(list("aabbcc"), dtype=object),
        np.array(["ice", "ice", "mud", "mud", "ice", "ice"], dtype=object),
    )


def test_windows_have_the_size_of_a_table(windows):
    assert len(windows) == _num_samples(windows) == 6
    assert windows.shape == (6, 2 * 3 + 4)
    indexable(windows, windows.terrain, windows.run_id)


@pytest.mark.parametrize(
    ("index", "rows"),
    [
        (np.array([4, 0, 0]), [4, 0, 0]),
        (np.array([False, True, False, True, False, False]), [1, 3]),
        (slice(1, 5, 2), [1, 3]),
        ([5, -1], [5, 5]),
        (2, [2]),
        (np.int64(3), [3]),
        (np.empty(0, dtype=int), []),
    ],
)
def test_an_index_selects_the_same_rows_of_every_field(windows, index, rows):
    found = windows[index]
    assert isinstance(found, Windows)
    assert found.shape == (len(rows), windows.shape[1])
    for name, values in windows.values.items():
        np.testing.assert_array_equal(found.values[name], values[rows])
    for name in ("start_s", "run_id", "terrain"):
        np.testing.assert_array_equal(getattr(found, name), getattr(windows, name)[rows])
    assert (found.channels, found.rate_hz, found.length_s) == (windows.channels, windows.rate_hz, 1.0)


def test_scikit_learn_indexes_windows_as_it_indexes_arrays(windows):
    rows = np.array([5, 2])
    np.testing.assert_array_equal(_safe_indexing(windows, rows).start_s, [5.0, 2.0])


@pytest.mark.parametrize("field", ["start_s", "run_id", "terrain"])
def test_fields_of_different_lengths_are_refused(windows, field):
    fields = {name: getattr(windows, name) for name in Windows.__dataclass_fields__}
    with pytest.raises(ValueError, match=r"one entry a window|does not fit"):
        Windows(**fields | {field: fields[field][:-1]})
