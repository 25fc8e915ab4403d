import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from features.windows import (
    INTERPOLATED,
    RATE_SLACK,
    SteadyMotion,
    WindowRule,
    cut_at,
    cut_windows,
    label_windows,
    layout_of,
    max_missing,
)
from terrain.errors import ConfigError, DataError
from terrain.records import Label, RunLog, Stream

WHEELS = ("speed_left_mps", "speed_right_mps")


def make_run(run_id="a", imu_hz=50.0, wheels_hz=10.0, duration_s=8.0, speed_mps=1.0, **changes):
    """IMU whose values are the sample's own number, wheels at a constant speed."""
    imu_s, wheels_s = np.arange(0, duration_s, 1 / imu_hz), np.arange(0, duration_s, 1 / wheels_hz)
    streams = {
        "imu": Stream(imu_s, np.arange(imu_s.size, dtype=float)[:, None], ("accel_z_mps2",)),
        "wheels": Stream(wheels_s, np.full((wheels_s.size, 2), speed_mps), WHEELS),
    }
    return RunLog(run_id, "husky", streams | changes, (Label(0.0, duration_s, "grass"),))


def replaced(stream, rows, values=None):
    """Return a stream without some rows, or with other values in them."""
    if values is None:
        return Stream(np.delete(stream.time_s, rows), np.delete(stream.values, rows, axis=0), stream.channels)
    changed = stream.values.copy()
    changed[rows] = values
    return Stream(stream.time_s, changed, stream.channels)


@settings(max_examples=50)
@given(
    length_s=st.floats(0.5, 3.0),
    stride_s=st.floats(0.05, 3.0),
    imu_hz=st.floats(20.0, 200.0),
    wheels_hz=st.floats(9.0, 40.0),
)
def test_a_window_holds_the_first_samples_at_or_after_its_start(length_s, stride_s, imu_hz, wheels_hz):
    run = make_run(imu_hz=imu_hz, wheels_hz=wheels_hz)
    cut = cut_windows([run], WindowRule(length_s, stride_s, steady=None))
    layout = layout_of([run])
    assert not cut.dropped
    assert len(cut.windows)
    np.testing.assert_allclose(np.diff(cut.windows.start_s), stride_s)
    for name, values in cut.windows.values.items():
        n = layout.n_samples(name, length_s)
        assert values.shape[2] == n
        assert n <= length_s * layout.rate_hz[name] + RATE_SLACK < n + 1
    number = cut.windows.values["imu"][:, 0]
    assert (np.diff(number, axis=1) == 1).all()  # every sample once, none made up
    first_s = run.streams["imu"].time_s[number[:, 0].astype(int)]
    assert (first_s >= cut.windows.start_s - 1e-6).all()
    assert (first_s < cut.windows.start_s + 1 / imu_hz + 1e-6).all()


def test_a_fault_drops_the_windows_that_it_touches_and_no_other():
    run = make_run()
    for stream, rows, values, reason in (
        ("imu", slice(120, 126), None, "gap"),
        ("imu", slice(100, 106), None, "gap"),  # at the very start of the window
        ("imu", slice(120, 170), None, "gap"),
        ("imu", slice(120, 200, 10), None, "not finite"),  # eight that were lost one by one
        ("imu", slice(194, 200), np.nan, "not finite"),
        ("wheels", [20, 24, 30], np.inf, "not finite"),
        ("wheels", slice(20, 40), 0.0, "not moving"),
        ("wheels", slice(20, 30), 0.5, "not steady"),
    ):
        cut = cut_windows([make_run(**{stream: replaced(run.streams[stream], rows, values)})])
        assert (cut.windows.start_s.tolist(), cut.dropped) == ([0.0, 4.0, 6.0], {reason: 1})
    slip = Stream(np.arange(0, 8, 0.1), np.full((80, 1), np.nan), ("slip_left_ratio",))
    unknown = cut_windows([make_run(slip=slip)]).windows.values["slip"]  # a value, which drops nothing
    assert len(unknown) == 4
    assert np.isnan(unknown).all()


def test_few_missing_samples_are_interpolated_and_counted_and_no_window_is_lost():
    """Values are the number of their sample, which a line between its neighbours has, too, but not at the ends."""
    run = make_run()
    whole = cut_windows([run])
    for rows, values, n in (
        ([120], None, 1),
        ([120], np.nan, 1),
        (slice(120, 125), None, 5),
        (slice(120, 125), np.nan, 5),
        ([105, 150, 220], np.nan, 3),
        ([105, 150, 220], None, 3),
    ):
        cut = cut_windows([make_run(imu=replaced(run.streams["imu"], rows, values))])
        assert (len(cut.windows), cut.dropped, cut.filled) == (4, {}, {INTERPOLATED: n})
        np.testing.assert_allclose(cut.windows.values["imu"], whole.windows.values["imu"], rtol=1e-12)
    cut = cut_windows([make_run(imu=replaced(run.streams["imu"], [100, 399], np.nan))])
    assert cut.windows.values["imu"][1, 0, :2].tolist() == [101.0, 101.0]
    assert cut.windows.values["imu"][3, 0, -2:].tolist() == [398.0, 398.0]
    assert whole.filled == {}


def test_the_deviation_of_noise_falls_by_less_than_a_fifth_of_its_scatter_where_samples_are_missing():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((2000, 100))
    time_s = np.arange(noise.size) / 50
    values = noise.ravel().copy()
    missing = rng.permuted(np.tile(np.arange(100) < max_missing(100), (2000, 1)), axis=1)
    values[missing.ravel()] = np.nan
    stream = Stream(time_s, values[:, None], ("accel_z_mps2",))
    cut = cut_windows([RunLog("a", "husky", {"imu": stream})], WindowRule(steady=None))
    assert cut.filled == {INTERPOLATED: 2000 * max_missing(100)}
    found, whole = (each.std(axis=1) for each in (cut.windows.values["imu"][:, 0], noise))
    assert -0.2 * whole.std() < np.mean(found - whole) < -0.1 * whole.std()


def test_steady_motion_is_judged_on_means_of_the_faster_wheel():
    rng = np.random.default_rng(1)
    time_s = np.arange(0, 8, 0.1)

    def dropped(left, right):
        noise = 0.05 * rng.standard_normal((80, 2))
        wheels = Stream(time_s, np.stack([left, right], axis=1) + noise, WHEELS)
        return dict(cut_windows([make_run(wheels=wheels)]).dropped)

    still, fast = np.zeros(80), np.ones(80)
    rule = SteadyMotion()
    assert dropped(still + 0.02, fast) == {}  # turning about one wheel is motion
    assert dropped(fast, fast + 0.8 * rule.max_accel_mps2 * time_s) == {}
    assert dropped(fast, fast + 1.3 * rule.max_accel_mps2 * time_s) == {"not steady": 4}
    assert dropped(-fast, -fast - 1.3 * rule.max_accel_mps2 * time_s) == {"not steady": 4}


def test_a_window_across_a_boundary_of_labels_has_no_label():
    run = RunLog("a", "husky", make_run().streams, (Label(0, 3, "ice"), Label(3, 8, "snow")))
    assert label_windows(run, np.array([0.0, 1.0, 1.5, 3.0, 6.0, 6.5]), 2.0).tolist() == [
        *("ice", "ice", "", "snow", "snow", "")
    ]
    assert list(cut_windows([run]).windows.terrain) == ["ice", "", "snow", "snow"]


def test_rules_that_mean_nothing_and_runs_that_do_not_fit_together_are_refused_by_name():
    for name, value in (("length_s", 0.0), ("length_s", np.nan), ("stride_s", -1.0), ("stride_s", np.inf)):
        with pytest.raises(ConfigError, match=f"window {name} is {value}; it must be positive and finite"):
            WindowRule(**{name: value})
    run = make_run()
    imu = run.streams["imu"]
    turned = make_run("b", imu=Stream(imu.time_s, imu.values, ("accel_x_mps2",)))
    with pytest.raises(DataError, match="run b has no stream 'imu', which other runs have"):
        layout_of([run, RunLog("b", "husky", {"wheels": run.streams["wheels"]})])
    with pytest.raises(DataError, match=r"run b, stream 'imu': channel 'accel_\w_mps2' is not in all runs"):
        layout_of([run, turned])
    with pytest.raises(DataError, match="run c, stream 'imu' runs at 55 Hz where 50 Hz is expected"):
        cut_windows([run, make_run("b"), make_run("c", imu_hz=55.0)])
    with pytest.raises(DataError, match="run b, stream 'imu': channel 'accel_z_mps2' is missing"):
        cut_windows([turned], layout=layout_of([run]))
    with pytest.raises(DataError, match=r"run a lasts 1\.00 s, shorter than a window of 2 s"):
        cut_windows([make_run(duration_s=1.0)])
    with pytest.raises(DataError, match="holds 3 samples of stream 'wheels' at 10 Hz; at least 4"):
        cut_windows([run], WindowRule(0.3))
    with pytest.raises(DataError, match="steady motion cannot be judged without wheel speeds"):
        cut_windows([RunLog("a", "husky", {"imu": imu})])
    beyond = r"run a, stream 'imu': channel 'accel_z_mps2' is 1e\+13 at 3\.00 s.*beyond 1e\+12"
    with pytest.raises(DataError, match=beyond):
        cut_windows([make_run(imu=replaced(imu, [150], 1e13))])
    # The live chain drops such a window and goes on.
    live = make_run(imu=replaced(imu, slice(150, 160), 1e200)).streams
    _, reason, _ = cut_at(live, np.arange(0.0, 8.0, 2.0), WindowRule(), layout_of([run]))
    assert reason.tolist() == ["", "not finite", "", ""]
    with pytest.raises(DataError, match="there is no run"):
        layout_of([])
    with pytest.raises(ConfigError, match=r"a rate is given of stream 'lidar'; .*wheels.* are used"):
        layout_of([run], rate_hz={"lidar": 10.0})
