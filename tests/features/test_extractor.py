from collections import Counter

import numpy as np
import pytest
from sklearn.base import clone
from skops import io

from features.extractor import FeatureExtractor
from features.matrix import LEFT_OUT, LEVEL_STATISTICS
from features.stream import WindowStream
from features.windows import WindowRule, cut_windows, layout_of
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import RunLog, Stream, Windows

CHANNELS = {
    "imu": tuple(
        f"{kind}_{axis}_{unit}" for kind, unit in (("gyro", "radps"), ("accel", "mps2")) for axis in "xyz"
    ),
    "wheels": ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a"),
    "slip": ("slip_left_ratio", "slip_right_ratio"),
    "estimator": ("track_width_m", "speed_x_mps"),
}
RATE_HZ = {"imu": 100.0, "wheels": 6.5, "slip": 20.0, "estimator": 10.0}


def draw_windows(n=12, seed=0, streams=tuple(CHANNELS), **changes):
    rng = np.random.default_rng(seed)
    values = {s: rng.standard_normal((n, len(CHANNELS[s]), int(2 * RATE_HZ[s]))) for s in streams}
    fields = {
        "values": values,
        "channels": {s: CHANNELS[s] for s in streams},
        "rate_hz": {s: RATE_HZ[s] for s in streams},
        "length_s": 2.0,
        "start_s": np.arange(float(n)),
        "run_id": np.array(["a"] * n),
        "terrain": np.array(["ice", "snow"] * (n // 2)),
    }
    return Windows(**fields | changes)


def without(windows, stream, channel):
    keep = [i for i, name in enumerate(windows.channels[stream]) if name != channel]
    names = tuple(windows.channels[stream][i] for i in keep)
    return draw_windows(
        len(windows),
        values=windows.values | {stream: windows.values[stream][:, keep]},
        channels=windows.channels | {stream: names},
    )


def test_every_column_has_a_unique_name_with_a_unit():
    windows = draw_windows()
    extractor = FeatureExtractor(level_sets=SIGNAL_SETS).fit(windows)
    names = extractor.get_feature_names_out()
    assert extractor.transform(windows).shape == (len(windows), len(names))
    assert [name for name, n in Counter(names).items() if n > 1] == []
    for name, feature in zip(names, extractor.features_, strict=True):
        assert name == f"{feature.name} [{feature.unit}]"
        assert feature.unit
        assert feature.sets
        assert feature.sets <= set(SIGNAL_SETS)
    assert "imu.gyro_z.std [rad/s]" in names
    assert "wheels.current_total.rms [A]" in names
    assert "imu.accel_norm.centroid [Hz]" in names


@pytest.mark.parametrize("off", SIGNAL_SETS)
def test_a_set_switched_off_takes_away_exactly_the_features_it_is_part_of(off):
    windows = draw_windows()
    whole = FeatureExtractor().fit(windows)
    part = FeatureExtractor([name for name in SIGNAL_SETS if name != off]).fit(windows)
    kept = np.array([off not in feature.sets for feature in whole.features_])
    assert 0 < kept.sum() < len(kept)
    assert part.get_feature_names_out().tolist() == whole.get_feature_names_out()[kept].tolist()
    np.testing.assert_array_equal(part.transform(windows), whole.transform(windows)[:, kept])


def test_levels_that_are_no_terrain_are_left_out_by_default():
    windows = draw_windows()

    def levels(extractor):
        return {
            f.name for f in extractor.fit(windows).features_ if f.name.rpartition(".")[2] in LEVEL_STATISTICS
        }

    by_default, all_levels = levels(FeatureExtractor()), levels(FeatureExtractor(level_sets=SIGNAL_SETS))
    assert all_levels - by_default == {
        f"{stream}.{channel}.{statistic}"
        for stream, channel in [
            *(("wheels", f"speed_{side}") for side in ("left", "right")),
            ("estimator", "speed_x"),
            *(("imu", name.rpartition("_")[0]) for name in CHANNELS["imu"]),
            *(("imu", name) for name in ("gyro_norm", "accel_norm")),
        ]
        for statistic in LEFT_OUT["imu" if stream == "imu" else "wheels"]
    }
    assert by_default < all_levels


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


def test_live_windows_give_the_features_of_the_log():
    rng = np.random.default_rng(0)
    streams = {}
    for name in ("imu", "wheels"):
        time_s = np.arange(0, 21, 1 / RATE_HZ[name])
        streams[name] = Stream(
            time_s, rng.normal(0.5, 0.1, (time_s.size, len(CHANNELS[name]))), CHANNELS[name]
        )
    run = RunLog("a", "husky", streams)
    windows = cut_windows([run]).windows
    extractor = FeatureExtractor().fit(windows)
    live = WindowStream(WindowRule(), layout_of([run]))
    events = sorted((t, name, i) for name, s in streams.items() for i, t in enumerate(s.time_s))
    rows = [
        extractor.transform(window)
        for t, name, i in events
        for window in live.push(name, t, streams[name].values[i])
    ]
    assert len(rows) == len(windows) == 10
    np.testing.assert_allclose(np.concatenate(rows), extractor.transform(windows), rtol=1e-9, atol=1e-12)


def test_slip_that_is_unknown_makes_slip_features_unknown_and_no_other():
    windows = draw_windows()
    windows.values["slip"][3] = np.nan
    extractor = FeatureExtractor().fit(windows)
    unknown = np.isnan(extractor.transform(windows))
    of_slip = np.array([feature.sets == {"slip"} for feature in extractor.features_])
    assert unknown[3, of_slip].all()
    unknown[3, of_slip] = False
    assert not unknown.any()


@pytest.mark.parametrize("stream", ["imu", "wheels", "estimator"])
def test_flat_channels_give_finite_features(stream):
    windows = draw_windows()
    windows.values[stream][:] = 0.0
    extractor = FeatureExtractor().fit(windows)
    bad = ~np.isfinite(extractor.transform(windows)).all(axis=0)
    assert set(extractor.get_feature_names_out()[bad]) <= {"turning.yaw_per_wheel_difference [rad/m]"}


def test_windows_of_another_kind_are_refused():
    windows = draw_windows()
    extractor = FeatureExtractor().fit(windows)
    cases = {
        "the windows lack wheels.current_left_a: they have imu with ": without(
            windows, "wheels", "current_left_a"
        ),
        "the windows lack slip.slip_left_ratio, ": draw_windows(streams=("imu", "wheels", "estimator")),
        "stream 'imu' runs at 50 Hz; the features were learned at 100 Hz": draw_windows(
            rate_hz=RATE_HZ | {"imu": 50.0}
        ),
        "windows last 1.7 s; the features were learned on 2 s": draw_windows(length_s=1.7),
        "a window holds 180 samples of stream 'imu'; the features were learned on 200": draw_windows(
            values=windows.values | {"imu": windows.values["imu"][:, :, :180]},
            rate_hz=RATE_HZ | {"imu": 98.0},
        ),
    }
    for message, other in cases.items():
        with pytest.raises(DataError, match=message):
            extractor.transform(other)


@pytest.mark.parametrize(
    ("first_hz", "second_hz"), [(99.97, 100.02), (100.02, 99.97), (98.0, 101.5), (101.5, 98.0)]
)
def test_windows_cut_from_two_sets_of_runs_fit_each_other(first_hz, second_hz):
    def cut(rate_hz, seed):
        time_s = np.arange(0.0, 40.0, 1 / rate_hz)
        noise = np.random.default_rng(seed).standard_normal((len(time_s), 1))
        run = RunLog("a", "husky", {"imu": Stream(time_s, noise, ("accel_z_mps2",))}, ((0.0, 40.0, "ice"),))
        return cut_windows([run], WindowRule(steady=None)).windows

    first, second = cut(first_hz, 0), cut(second_hz, 1)
    extractor = FeatureExtractor().fit(first)
    other = extractor.transform(second)
    if abs(first_hz / second_hz - 1) < 1e-3:  # a nominal rate gives one number of samples
        assert first.values["imu"].shape[2] == second.values["imu"].shape[2] == 200
    names = extractor.get_feature_names_out().tolist()
    own = FeatureExtractor().fit(second).transform(second)
    spread = own[:, names.index("imu.accel_z.std [m/s^2]")]
    np.testing.assert_allclose(other[:, names.index("imu.accel_z.std [m/s^2]")], spread, rtol=0.05)


def test_a_set_that_is_unknown_or_has_no_channel_is_refused():
    with pytest.raises(ConfigError, match="unknown signal set 'lidar'; there are imu, wheels, currents"):
        FeatureExtractor(["imu", "lidar"]).fit(draw_windows())
    with pytest.raises(DataError, match="hold no channel of the signal sets slip"):
        FeatureExtractor(["slip"]).fit(draw_windows(streams=("imu", "wheels")))


def test_it_is_a_scikit_learn_transformer():
    extractor = FeatureExtractor(("imu",), ("imu",))
    assert clone(extractor).get_params() == {"signal_sets": ("imu",), "level_sets": ("imu",)}
    windows = draw_windows()
    fitted = extractor.fit(windows)
    again = clone(fitted)
    assert not hasattr(again, "features_")
    np.testing.assert_array_equal(again.fit_transform(windows), fitted.transform(windows))


def test_a_trained_model_is_stored_without_pickle():
    windows = draw_windows()
    extractor = FeatureExtractor().fit(windows)
    stored = io.dumps(extractor)
    unknown = io.get_untrusted_types(data=stored)
    assert set(unknown) <= {
        "builtins.frozenset",
        "features.cross_channel.Feature",
        "features.extractor.FeatureExtractor",
        "features.windows.Layout",
    }
    loaded = io.loads(stored, trusted=unknown)
    np.testing.assert_array_equal(loaded.transform(windows), extractor.transform(windows))
    assert loaded.get_feature_names_out().tolist() == extractor.get_feature_names_out().tolist()
