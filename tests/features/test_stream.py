import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from features.stream import WindowStream
from features.windows import Layout, SteadyMotion, WindowRule, check_layout, cut_windows
from terrain.errors import ConfigError, DataError
from terrain.records import RunLog, Stream

CHANNELS = {
    "imu": ("accel_z_mps2", "gyro_z_radps"),
    "wheels": ("speed_left_mps", "speed_right_mps", "current_left_a"),
    "slip": ("slip_left_ratio",),
}


def merged(streams):
    """All samples in order of time; of equal times, the streams in their order."""
    events = [
        (float(time_s), order, name, row)
        for order, (name, stream) in enumerate(streams.items())
        for time_s, row in zip(stream.time_s, stream.values, strict=True)
    ]
    return [(name, time_s, row) for time_s, _, name, row in sorted(events, key=lambda event: event[:2])]


def streamed(events, rule, layout, **options):
    stream = WindowStream(rule, layout, **options)
    return stream, [window for event in events for window in stream.push(*event)]


def assert_same(batch, found):
    assert [float(window.start_s[0]) for window in found] == batch.start_s.tolist()
    for i, window in enumerate(found):
        assert len(window) == 1
        for name, values in batch.values.items():
            np.testing.assert_array_equal(window.values[name][0], values[i], strict=True)


@st.composite
def logs(draw):
    """A log of several streams: unequal starts, rates off by up to 2 %, jitter, lost samples, NaN bursts."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    names = draw(st.sampled_from([("imu", "wheels"), ("wheels", "imu"), ("imu", "wheels", "slip")]))
    duration_s = draw(st.floats(1.0, 15.0))
    epoch_s = draw(st.sampled_from([0.0, -3.0, 1.7e9]))
    streams, rates_hz = {}, {}
    for name in names:
        rates_hz[name] = draw(st.floats(8.0, 60.0))
        period_s = 1 / (rates_hz[name] * draw(st.floats(0.98, 1.02)))
        n = max(3, int(duration_s / period_s))
        jitter = draw(st.sampled_from([0.0, 0.01, 0.2]))
        time_s = (np.arange(n) + jitter * rng.uniform(-1, 1, n)) * period_s + draw(st.floats(0, 3)) + epoch_s
        values = rng.standard_normal((n, len(CHANNELS[name])))
        if name == "wheels":
            values[:, :2] = 0.4 + 0.05 * values[:, :2] + draw(st.floats(0.0, 0.4)) * np.sin(time_s)[:, None]
        for _ in range(draw(st.integers(0, 3))):
            at = rng.integers(n)
            length = rng.integers(1, max(2, int(draw(st.sampled_from([0.1, 0.8])) / period_s)))
            if rng.random() < 0.5:
                values[at : at + length, 0] = rng.choice([np.nan, np.inf])
            elif n - length > 2:
                keep = np.ones(n, dtype=bool)
                keep[at : at + length] = False
                if keep.sum() > 2:
                    time_s, values, n = time_s[keep], values[keep], int(keep.sum())
        streams[name] = Stream(time_s, values, CHANNELS[name])
    rule = WindowRule(
        length_s=draw(st.floats(0.6, 3.0)),
        stride_s=draw(st.one_of(st.none(), st.floats(1 / max(rates_hz.values()), 5.0))),
        steady=draw(st.sampled_from([None, SteadyMotion(), SteadyMotion(0.3, 0.1)])),
    )
    layout = Layout({name: CHANNELS[name] for name in names}, rates_hz)
    return RunLog("a", "husky", streams), rule, layout


@settings(max_examples=60)
@given(logs())
def test_sample_by_sample_gives_the_very_windows_and_drops_of_the_whole_log(case):
    run, rule, layout = case
    try:
        check_layout(run, layout)
    except DataError:
        reject()  # jitter of a few samples can move the median rate out of what a log may have
    batch = cut_windows([run], rule, layout=layout, skip_short=True)
    stream, found = streamed(merged(run.streams), rule, layout)
    assert_same(batch.windows, found)
    counted = dict(batch.dropped)
    counted.pop("run too short", None)
    assert dict(stream.dropped) == counted
    assert not stream.dropped_samples
    assert stream.filled == sum(batch.filled.values())


def steady_log(duration_s=20.0, imu_hz=50.0, wheels_hz=10.0):
    imu_s, wheels_s = np.arange(0, duration_s, 1 / imu_hz), np.arange(0, duration_s, 1 / wheels_hz)
    rng = np.random.default_rng(0)
    return {
        "imu": Stream(imu_s, rng.standard_normal((imu_s.size, 2)), CHANNELS["imu"]),
        "wheels": Stream(wheels_s, np.ones((wheels_s.size, 3)), CHANNELS["wheels"]),
    }


STREAMS = steady_log()
LAYOUT = Layout({name: CHANNELS[name] for name in STREAMS}, {"imu": 50.0, "wheels": 10.0})
RULE = WindowRule(2.0, 0.5)


def test_a_window_comes_with_its_last_sample_and_each_bad_stamp_costs_only_its_sample():
    stream, batch = WindowStream(RULE, LAYOUT), cut_windows([RunLog("a", "husky", STREAMS)], RULE)
    for name, time_s, row in merged(STREAMS):
        for window in stream.push(name, time_s, row):
            assert time_s - window.start_s[0] == pytest.approx(1.98)
    # Streams may arrive out of order among themselves.
    lagging = sorted(merged(STREAMS), key=lambda event: event[1] + 3.0 * (event[0] == "wheels"))
    assert_same(batch.windows, streamed(lagging, RULE, LAYOUT)[1])
    events = merged(STREAMS)
    bad = [np.nan, np.inf, -np.inf, -1.0, 5.0, 1e300, 1e9]
    for i, time_s in enumerate(bad):  # the last two come one after the other: a wrong stamp confirms no other
        events.insert(len(events) // 2 + 7 * min(i, 5), ("imu", time_s, (9.0, 9.0)))
    events.insert(0, ("imu", 1e9, (9.0, 9.0)))  # nor does a wrong first stamp
    stream, found = streamed(events, RULE, LAYOUT)
    assert_same(batch.windows, found)
    assert stream.dropped_samples == {
        ("imu", "time not finite"): 3,
        ("imu", "time goes back or repeats"): 2,
        ("imu", "time jumps ahead"): 3,
    }
    assert not stream.dropped


def test_a_silent_stream_costs_windows_but_no_memory():
    streams = steady_log(150.0)
    silence = [event for event in merged(streams) if event[0] != "wheels" or not 10 < event[1] < 120]
    stream, found, longest = WindowStream(RULE, LAYOUT), [], 0
    for name, time_s, row in silence:
        found += stream.push(name, time_s, row)
        longest = max(longest, *(len(buffer.time_s) for buffer in stream._buffers.values()))
    assert longest < 2000  # of 5,500 in the silence
    wheels = streams["wheels"]
    there = (wheels.time_s <= 10) | (wheels.time_s >= 120)
    cut = Stream(wheels.time_s[there], wheels.values[there], wheels.channels)
    batch = cut_windows([RunLog("a", "husky", streams | {"wheels": cut})], RULE, layout=LAYOUT)
    assert_same(batch.windows, found)
    assert dict(stream.dropped) == batch.dropped
    # Nor does one that has not begun yet pile anything up.
    stream = WindowStream(RULE, LAYOUT)
    for i in range(10_000):
        assert not stream.push("imu", i / 50, (0.0, 0.0))
    assert len(stream._buffers["imu"].time_s) < 2000
    events = [(name, time_s + 200.0, row) for name, time_s, row in merged(STREAMS)]
    found = [window for event in events for window in stream.push(*event)]
    assert [float(window.start_s[0]) for window in found] == np.arange(200, 218.5, 0.5).tolist()


LEAST = {"imu": 40.0, "wheels": 5.0}


@pytest.mark.parametrize(
    ("imu_hz", "wheels_hz", "resampled"),
    [
        (100.0, 10.0, ("imu resampled from 100 to 50 Hz",)),
        (39.0, 25.2, ("imu resampled from 39 to 50 Hz", "wheels resampled from 25 to 10 Hz")),
        (51.0, 9.8, ()),
    ],
)
def test_windows_of_another_rate_are_resampled_live_as_of_the_log(imu_hz, wheels_hz, resampled):
    layout = Layout(LAYOUT.channels, LAYOUT.rate_hz, LEAST)
    run = RunLog("a", "husky", steady_log(20.0, imu_hz, wheels_hz))
    batch = cut_windows([run], RULE, layout=layout)
    stream, found = streamed(merged(run.streams), RULE, layout)
    assert_same(batch.windows, found)
    assert len(found) > 30
    assert not stream.dropped
    assert not batch.dropped
    assert stream.resampled == resampled == tuple(batch.resampled)
    assert {name: each.shape[2] for name, each in batch.windows.values.items()} == {"imu": 100, "wheels": 20}
    assert dict(batch.windows.rate_hz) == LAYOUT.rate_hz
    np.testing.assert_allclose(batch.windows.values["wheels"], 1.0)


def test_rates_too_low_are_refused_in_one_sentence_of_a_log_and_live():
    layout, streams = Layout(LAYOUT.channels, LAYOUT.rate_hz, LEAST), steady_log(20.0, 25.0)
    sentence = "stream 'imu' runs at 25 Hz; the model, of windows at 50 Hz, needs at least 40 Hz; one that is trained "
    sentence += "with --rate imu=25 takes it"
    with pytest.raises(DataError, match=f"run a, {sentence}"):
        cut_windows([RunLog("a", "husky", streams)], RULE, layout=layout)
    stream, found = streamed(merged(streams), RULE, layout)
    assert not found
    assert dict(stream.dropped) == {sentence: 36}


def test_faults_of_the_programmer_are_raised():
    stream = WindowStream(RULE, LAYOUT)
    with pytest.raises(ConfigError, match="no stream 'lidar' in the layout; it has imu, wheels"):
        stream.push("lidar", 0.0, [1.0])
    with pytest.raises(ValueError, match="'imu' has 2 channels; the sample has 3 values"):
        stream.push("imu", 0.0, [1.0, 2.0, 3.0])
    with pytest.raises(ConfigError, match=r"a step of 6 s is no gap; less than 5 s is accepted"):
        WindowStream(WindowRule(20.0), Layout({"wheels": CHANNELS["wheels"]}, {"wheels": 0.3}))
    with pytest.raises(DataError, match="without wheel speeds"):
        WindowStream(RULE, Layout({"imu": CHANNELS["imu"]}, {"imu": 50.0}))
    with pytest.raises(DataError, match="holds 2 samples of stream 'wheels'"):
        WindowStream(WindowRule(0.2), LAYOUT)
