"""Features and samples of windows: names, sets, definitions, what they do not see, and windows of another kind."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.base import clone

from features.extractor import (
    FeatureExtractor,
    SampleExtractor,
    derived_channels,
    slip_features,
    speed_features,
)
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Windows

IMU = tuple(
    f"{kind}_{axis}_{unit}" for kind, unit in (("gyro", "radps"), ("accel", "mps2")) for axis in "xyz"
)
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
CHANNELS = {
    "imu": IMU,
    "wheels": WHEELS,
    "slip": ("slip_left_ratio", "slip_right_ratio"),
    "estimator": ("track_width_m", "speed_x_mps"),
}
RATE_HZ = {"imu": 100.0, "wheels": 6.5, "slip": 20.0, "estimator": 10.0}


def draw_windows(n=12, streams=tuple(CHANNELS), **changes):
    rng = np.random.default_rng(0)
    fields = {
        "values": {s: rng.standard_normal((n, len(CHANNELS[s]), int(2 * RATE_HZ[s]))) for s in streams},
        "channels": {s: CHANNELS[s] for s in streams},
        "rate_hz": {s: RATE_HZ[s] for s in streams},
        "length_s": 2.0,
        "start_s": np.arange(float(n)),
        "run_id": np.array(["a"] * n),
        "terrain": np.array(["ice", "snow"] * (n // 2)),
    }
    return Windows(**fields | changes)


def test_every_column_has_a_unique_name_with_a_unit():
    windows = draw_windows()
    extractor = FeatureExtractor(level_sets=SIGNAL_SETS).fit(windows)
    names = extractor.get_feature_names_out().tolist()
    assert extractor.transform(windows).shape == (len(windows), len(names))
    assert len(set(names)) == len(names)
    for name, feature in zip(names, extractor.features_, strict=True):
        assert name == f"{feature.name} [{feature.unit}]"
        assert feature.unit
        assert set() < feature.sets <= set(SIGNAL_SETS)
    assert {"imu.gyro_z.std [rad/s]", "wheels.current_total.rms [A]", "imu.accel_norm.centroid [Hz]"} <= {
        *names
    }


def test_a_set_switched_off_takes_away_exactly_the_features_it_is_part_of():
    windows = draw_windows()
    whole = FeatureExtractor().fit(windows)
    for off in SIGNAL_SETS:
        part = FeatureExtractor([name for name in SIGNAL_SETS if name != off]).fit(windows)
        kept = np.array([off not in feature.sets for feature in whole.features_])
        assert 0 < kept.sum() < len(kept)
        assert part.get_feature_names_out().tolist() == whole.get_feature_names_out()[kept].tolist()
        np.testing.assert_array_equal(part.transform(windows), whole.transform(windows)[:, kept])


def test_one_by_one_is_all_at_once_and_the_order_of_channels_is_no_matter():
    windows = draw_windows(10)
    extractor = FeatureExtractor().fit(windows)
    together = extractor.transform(windows)
    one_by_one = np.concatenate([extractor.transform(windows[i]) for i in range(len(windows))])
    np.testing.assert_allclose(one_by_one, together, rtol=1e-9, atol=1e-12)
    turned = draw_windows(
        10,
        values={name: values[:, ::-1] for name, values in windows.values.items()},
        channels={name: channels[::-1] for name, channels in windows.channels.items()},
    )
    np.testing.assert_array_equal(extractor.transform(turned), together)


def test_windows_of_another_kind_and_sets_without_a_channel_are_refused():
    windows = draw_windows()
    extractor, few = FeatureExtractor().fit(windows), draw_windows(streams=("imu", "wheels", "estimator"))
    without_current = draw_windows(
        values=windows.values | {"wheels": windows.values["wheels"][:, [0, 1, 3]]},
        channels=windows.channels | {"wheels": (*WHEELS[:2], WHEELS[3])},
    )
    shorter = windows.values | {"imu": windows.values["imu"][:, :, :180]}
    for message, other in {
        "the windows lack wheels.current_left_a: they have imu with ": without_current,
        "the windows lack slip.slip_left_ratio, ": few,
        "stream 'imu' runs at 50 Hz; the features were learned at 100 Hz": draw_windows(
            rate_hz=RATE_HZ | {"imu": 50.0}
        ),
        "windows last 1.7 s; the features were learned on 2 s": draw_windows(length_s=1.7),
        "a window holds 180 samples of stream 'imu'; the features were learned on 200": draw_windows(
            values=shorter, rate_hz=RATE_HZ | {"imu": 98.0}
        ),
    }.items():
        with pytest.raises(DataError, match=message):
            extractor.transform(other)
    with pytest.raises(ConfigError, match="unknown signal set 'lidar'; there are imu, wheels, currents"):
        FeatureExtractor(["imu", "lidar"]).fit(windows)
    with pytest.raises(DataError, match="hold no channel of the signal sets slip"):
        FeatureExtractor(["slip"]).fit(few)


def by_name(imu, wheels):
    features, table = speed_features({"imu": imu, "wheels": wheels}, {"imu": IMU, "wheels": WHEELS})
    return dict(zip([feature.name for feature in features], table.T, strict=True))


@pytest.mark.parametrize("track_m", [0.57, 1.6])
def test_the_effective_track_width_is_recovered_from_streams_of_two_rates(track_m):
    """Windows of 2 s of a robot that follows random turns on an effective track width."""
    rng = np.random.default_rng(0)
    phase, period_s = rng.uniform(0, 6.3, (30, 1)), rng.uniform(1.0, 5.0, (30, 1))

    def difference_mps(time_s):
        return 0.3 + 0.2 * np.sin(2 * np.pi * time_s / period_s + phase)

    imu = 0.02 * rng.standard_normal((30, 6, 200))
    imu[:, 2] += difference_mps(np.arange(200) / 100) / track_m
    half = difference_mps(np.arange(13) / 6.5) / 2
    wheels = np.stack([0.5 - half, 0.5 + half, 1 + half, 1 + half], axis=1)
    gain = by_name(imu, wheels)["turning.yaw_per_wheel_difference"]
    # In the fastest turns the eighths of 13 wheel samples are not quite the eighths of 200 IMU samples.
    assert gain * track_m == pytest.approx(1.0, abs=0.1)
    assert np.mean(gain) * track_m == pytest.approx(1.0, abs=0.015)


def test_per_speed_features_match_their_definitions():
    rng = np.random.default_rng(0)
    imu, wheels = rng.standard_normal((5, 6, 200)), rng.uniform(0.3, 0.6, (5, 4, 13))
    slow, fast = by_name(imu, wheels), by_name(imu, wheels * [[2.0], [2.0], [1.0], [1.0]])
    current = "wheels.current_left.per_speed"
    np.testing.assert_allclose(fast[current], slow[current] / 2)
    for name in ("imu.gyro_x.log_std_per_speed", "imu.accel_z.log_std_per_speed"):
        np.testing.assert_allclose(fast[name], slow[name] - np.log10(2))
    effort = "wheels.log_drive_effort"
    np.testing.assert_allclose(fast[effort], slow[effort] + np.log10(2), atol=1e-3)
    backwards = by_name(imu, wheels * [[-1.0], [-1.0], [1.0], [1.0]])
    for name in slow:
        if not name.startswith("turning"):
            np.testing.assert_allclose(backwards[name], slow[name])


def test_slip_features_tell_driving_from_braking_wheels_whichever_side_and_direction():
    rng = np.random.default_rng(0)
    wheels = np.stack([np.full((6, 20), 0.4), np.full((6, 20), 0.8)], axis=1)
    slip = np.array([-0.2, 0.3])[:, None] + 0.02 * rng.standard_normal((6, 2, 40))  # the outer wheel drives
    slip[1, 0], slip[2] = np.nan, np.nan
    names = ("speed_left_mps", "speed_right_mps"), ("slip_left_ratio", "slip_right_ratio", "slip_body_ratio")

    def table(wheels, slip):
        body = np.full((6, 1, 40), 9.0)  # of the body: no wheel's
        values = {"wheels": wheels, "slip": np.concatenate([slip, body], axis=1)}
        features, found = slip_features(values, dict(zip(values, names, strict=True)))
        assert [each.name for each in features] == ["slip.traction", "slip.braking", "slip.scatter"]
        return found

    found = table(wheels, slip)
    np.testing.assert_allclose(found[[0, 3, 4, 5]], np.tile([0.3, -0.2, 0.02], (4, 1)), atol=0.01)
    assert found[1] == pytest.approx([0.3, 0.3, 0.02], abs=0.01)  # of one wheel alone
    assert np.isnan(found[2]).all()
    np.testing.assert_array_equal(table(wheels[:, ::-1], slip[:, ::-1]), found)
    np.testing.assert_allclose(table(-wheels, -slip), found)
    assert slip_features({"wheels": wheels}, {"wheels": names[0]})[1].shape == (6, 0)


def test_norms_do_not_see_how_the_sensor_is_mounted():
    rng = np.random.default_rng(0)
    imu = rng.standard_normal((3, 6, 40))
    there, names = derived_channels(imu, IMU)
    turned, _ = derived_channels(np.kron(np.eye(2), Rotation.random(rng=rng).as_matrix()) @ imu, IMU)
    assert names == ("gyro_norm_radps", "accel_norm_mps2")
    np.testing.assert_allclose(turned, there, rtol=1e-10)
    assert there[1, 1, 7] == pytest.approx(np.linalg.norm(imu[1, 3:, 7]))


def test_each_column_is_a_sample_of_its_channel_after_the_features():
    windows = draw_windows(6)
    windows.values["slip"][0, 0, 3] = np.nan
    extractor = SampleExtractor().fit(windows)
    found = extractor.transform(windows)
    assert [each.stream for each in extractor.columns_] == list(CHANNELS)
    assert found.shape == (6, sum(each.width for each in extractor.columns_))
    imu, wheels = found[:, :1200].reshape(6, 6, 200), found[:, 1200:1252].reshape(6, 4, 13)
    np.testing.assert_allclose(imu.mean(axis=2), 0.0, atol=1e-12)
    np.testing.assert_allclose(wheels[:, 0].mean(axis=1), 0.0, atol=1e-12)  # how fast it was driven
    np.testing.assert_array_equal(wheels[:, 2:], windows.values["wheels"][:, 2:])  # a current has a level
    assert np.isnan(found).sum() == 1  # an unknown slip leaves the known ones
    estimated = found[:, -40:].reshape(6, 2, 20).mean(axis=2)
    assert (np.abs(estimated) < 1e-12).tolist() == [[False, True]] * 6  # a track width is no speed
    names = extractor.get_feature_names_out()
    assert (len(names), names[0]) == (found.shape[1], "imu.gyro_x.sample [rad/s]")
    levels = SampleExtractor(level_sets=("imu",)).fit_transform(windows)
    np.testing.assert_array_equal(levels[:, :200], windows.values["imu"][:, 0])
    both = clone(SampleExtractor(with_features=True)).fit(windows)
    expected = [FeatureExtractor().fit_transform(windows), found]
    np.testing.assert_array_equal(both.transform(windows), np.concatenate(expected, axis=1))
    assert len(both.get_feature_names_out()) == both.transform(windows).shape[1]
