import numpy as np
import pytest

from features.response import ResponseExtractor
from terrain.errors import DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Windows

NAMES = ("speed_1_mps", "speed_2_mps", "current_1_a", "current_2_a")


def windows_of(values, names=NAMES, **more):
    streams = {"wheels": np.asarray(values, dtype=float), **more}
    channels = {"wheels": names, "slip": ("slip_1_ratio", "slip_2_ratio")}
    n = len(streams["wheels"])
    of_streams = {name: channels[name] for name in streams}, dict.fromkeys(streams, 4.0)
    return Windows(
        streams, *of_streams, 2.0, np.arange(float(n)), np.array(["a"] * n), np.array(["cork"] * n)
    )


def test_means_leave_out_what_stands_and_a_signed_current_is_positive_where_it_drives():
    speed, current = np.full(8, 0.2), np.full(8, 3.0)
    speed[:2], current[:2] = 0.0, 9.0  # the wheels do not turn yet
    for signed in (current + 1.0, -current - 1.0):
        found = ResponseExtractor().fit_transform(windows_of([[speed, -speed, current, signed]]))
        np.testing.assert_allclose(found, [[0.2, -0.2, 3.0, 4.0]])


def test_slip_is_a_response_positive_in_traction_and_may_be_missing():
    speed = np.full(8, 0.2)
    slip = np.full((1, 2, 8), np.nan)
    slip[0, 0, 3:5] = 0.3
    slip[0, 1, :] = -0.1
    windows = windows_of([[speed, -speed, speed, speed]], slip=slip)
    extractor = ResponseExtractor(("wheels", "slip")).fit(windows)
    assert extractor.columns_ == (2, 2)
    np.testing.assert_allclose(extractor.transform(windows), [[0.2, -0.2, 0.3, 0.1]])
    assert extractor.get_feature_names_out()[-1] == "slip.slip_2.mean [1]"


def test_windows_without_responses_or_wheels_are_refused():
    speed = np.full((1, 2, 8), 0.2)
    for sets, windows, sentence in (
        (SIGNAL_SETS, windows_of(speed, NAMES[:2]), "no response of each wheel"),
        (("wheels", "slip"), windows_of(np.tile(speed, (1, 2, 1))), "no response of each wheel"),
        (SIGNAL_SETS, windows_of(speed, NAMES[2:]), "at the speeds of the wheels"),
    ):
        with pytest.raises(DataError, match=sentence):
            ResponseExtractor(sets).fit(windows)
