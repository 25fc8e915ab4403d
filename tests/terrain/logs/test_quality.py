import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from terrain.logs.plausibility import stream_quality
from terrain.records import Stream


@pytest.mark.parametrize("dataset", ["borealtc", "vulpi"])
def test_the_published_runs_raise_no_false_alarm(datasets_dir, dataset):
    for run in load_runs(datasets_dir / dataset):
        for name, stream in run.streams.items():
            quality = stream_quality(stream)
            assert (quality.stuck, quality.n_gaps) == ((), 0), (run.run_id, name)
            assert quality.jitter_s < 1e-6


@pytest.fixture
def wheels():
    rng = np.random.default_rng(0)
    speeds = np.round(0.5 + 0.05 * rng.standard_normal((300, 2)), 2)
    currents = np.round(np.abs(rng.standard_normal((300, 2))), 2)
    names = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
    return Stream(np.arange(300) / 6.5, np.hstack([speeds, currents]), names)


def hold(stream, channel, first, last):
    values = stream.values.copy()
    values[first:last, stream.channels.index(channel)] = values[first, stream.channels.index(channel)]
    return Stream(stream.time_s, values, stream.channels)


def test_an_imu_channel_that_freezes_is_stuck(make_run):
    imu = make_run().streams["imu"]
    assert stream_quality(imu).stuck == ()
    assert stream_quality(hold(imu, "accel_y_mps2", 50, 60)).stuck == ()
    frozen = stream_quality(hold(imu, "accel_y_mps2", 50, 80))
    assert frozen.stuck == ("accel_y_mps2",)
    assert frozen.longest_constant_s["accel_y_mps2"] == pytest.approx(0.58)


def test_a_wheel_is_stuck_only_while_the_other_side_moves(wheels):
    assert stream_quality(wheels).stuck == ()
    assert stream_quality(hold(wheels, "speed_left_mps", 100, 180)).stuck == ("speed_left_mps",)
    steady = hold(hold(wheels, "speed_left_mps", 0, 300), "speed_right_mps", 0, 300)
    assert stream_quality(steady).stuck == ()


def test_a_current_rests_at_its_floor_but_not_for_the_whole_run(wheels):
    assert stream_quality(hold(wheels, "current_left_a", 100, 180)).stuck == ()
    assert stream_quality(hold(wheels, "current_left_a", 0, 300)).stuck == ("current_left_a",)


def test_gaps_and_missing_samples_are_counted_and_placed(wheels):
    values = wheels.values.copy()
    values[[3, 7], 1] = np.nan
    kept = np.delete(np.arange(300), [20, 100, 101, 102])
    quality = stream_quality(Stream(wheels.time_s[kept], values[kept], wheels.channels))
    assert quality.n_gaps == 2
    assert quality.longest_gap_s == pytest.approx(4 / 6.5)
    assert quality.longest_gap_at_s == pytest.approx(99 / 6.5)
    assert [*quality.n_nonfinite.values()] == [0, 2, 0, 0]
    assert quality.rate_hz == pytest.approx(6.5)


def test_a_dead_channel_is_counted_and_not_called_stuck(wheels):
    values = wheels.values.copy()
    values[:, 0] = np.nan
    quality = stream_quality(Stream(wheels.time_s, values, wheels.channels))
    assert quality.stuck == ()
    assert quality.n_nonfinite["speed_left_mps"] == 300
