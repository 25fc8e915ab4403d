"""The samples of windows as columns, beside their features or alone."""

import numpy as np
import pytest
from sklearn.base import clone

from features.extractor import FeatureExtractor
from features.sample_extractor import SampleExtractor
from features.samples import is_centred
from terrain.errors import DataError
from terrain.records import Windows

CHANNELS = {
    "imu": ("gyro_z_radps", "accel_z_mps2"),
    "wheels": ("speed_left_mps", "current_left_a"),
    "slip": ("slip_left_ratio",),
    "truth": ("speed_x_mps",),
}
RATE_HZ = {"imu": 100.0, "wheels": 10.0, "slip": 20.0, "truth": 10.0}


@pytest.fixture
def windows():
    rng = np.random.default_rng(0)
    values = {s: 3.0 + rng.standard_normal((6, len(c), int(2 * RATE_HZ[s]))) for s, c in CHANNELS.items()}
    names = np.array(["a"] * 6)
    return Windows(values, CHANNELS, RATE_HZ, 2.0, np.arange(6.0), names, np.array(["ice", "snow"] * 3))


def test_each_column_is_a_sample_of_its_channel(windows):
    extractor = SampleExtractor()
    found = extractor.fit_transform(windows)
    assert [each.stream for each in extractor.columns_] == ["imu", "wheels", "slip"]  # nothing of the truth
    assert found.shape == (6, sum(each.width for each in extractor.columns_))
    imu = found[:, :400].reshape(6, 2, 200)
    np.testing.assert_allclose(imu.mean(axis=2), 0.0, atol=1e-12)
    wheels = found[:, 400:440].reshape(6, 2, 20)
    np.testing.assert_allclose(wheels[:, 0].mean(axis=1), 0.0, atol=1e-12)  # how fast it was driven
    np.testing.assert_array_equal(wheels[:, 1], windows.values["wheels"][:, 1])  # a current has a level
    np.testing.assert_array_equal(found[:, 440:], windows.values["slip"][:, 0])
    names = extractor.get_feature_names_out()
    assert (len(names), names[0], names[-1]) == (
        480,
        "imu.gyro_z.sample [rad/s]",
        "slip.slip_left.sample [1]",
    )


def test_levels_are_kept_on_request(windows):
    found = SampleExtractor(level_sets=("imu",)).fit_transform(windows)
    np.testing.assert_array_equal(found[:, :200], windows.values["imu"][:, 0])
    assert is_centred("estimator", "speed_x_mps", ())
    assert not is_centred("estimator", "track_width_m", ())
    assert not is_centred("imu", "accel_z_mps2", ("imu",))


def test_features_come_before_the_samples(windows):
    both = SampleExtractor(with_features=True).fit(windows)
    features = FeatureExtractor().fit(windows)
    expected = [features.transform(windows), SampleExtractor().fit_transform(windows)]
    np.testing.assert_array_equal(both.transform(windows), np.concatenate(expected, axis=1))
    assert len(both.get_feature_names_out()) == both.transform(windows).shape[1]
    assert clone(both).with_features


def test_an_unknown_slip_leaves_the_known_ones(windows):
    windows.values["slip"][0, 0, 3] = np.nan
    found = SampleExtractor().fit_transform(windows)
    assert np.isnan(found).sum() == 1


def test_windows_of_other_channels_are_refused(windows):
    extractor = SampleExtractor().fit(windows)
    with pytest.raises(DataError, match=r"the windows lack imu\.accel_z_mps2: they have"):
        extractor.transform(
            Windows(
                windows.values | {"imu": windows.values["imu"][:, :1]},
                CHANNELS | {"imu": ("gyro_z_radps",)},
                RATE_HZ, 2.0, windows.start_s, windows.run_id, windows.terrain,
            )
        )  # fmt: skip
