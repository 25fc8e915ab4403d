"""Windows over links that deliver in batches, late and in bursts are those of samples in time."""

import numpy as np
import pytest

from features.stream import WindowFeed
from features.windows import Layout, WindowRule
from terrain.estimation.clocks import REWIND_S, Clocks
from terrain.estimation.live import estimated_channels, make_live_filter
from terrain.records import Reading
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults

STREAMS = ("wheels", "steering", "imu", "odometry")
LEAST_RATIO = 0.99
RULE = WindowRule(1.0, steady=None)
IMU = ("gyro_z_radps", "accel_z_mps2")
#: The filter of a robot, and what the windows take of it.
ROBOTS = {
    "agrimaro": ("vio15", {"estimator": ("speed_x_mps", "yaw_rate_radps"), "slip": ("slip_1_ratio",)}),
    "husky": ("slip", {"estimator": ("yaw_rate_radps",)}),
}


def layout_of(run, estimated):
    rate_hz = {name: 1.0 / float(np.median(np.diff(run.streams[name].time_s))) for name in ("imu", "wheels")}
    rates = {"imu": rate_hz["imu"], **dict.fromkeys(estimated, rate_hz["wheels"])}
    return Layout({"imu": IMU, **estimated}, rates)


def arrivals(run, seed):
    """Return when each sample arrives: in batches of 10 to 200 ms, jitter, hangs to 200 ms, within the rewind."""
    rng, found = np.random.default_rng(seed), {}
    end_s = run.streams["wheels"].time_s[-1]
    hangs = [(rng.uniform(0.0, end_s), rng.uniform(0.0, 0.2)) for _ in range(6)]
    for name, stream in run.streams.items():
        if name not in STREAMS:
            continue
        batch_s = rng.uniform(0.01, 0.2)
        phase_s = rng.uniform(0.0, batch_s)
        at_s = np.ceil((stream.time_s - phase_s) / batch_s) * batch_s + phase_s
        at_s += rng.uniform(0.0, 0.02, len(stream))
        for start_s, duration_s in hangs:
            at_s = np.where((at_s > start_s) & (at_s < start_s + duration_s), start_s + duration_s, at_s)
        in_reach = stream.time_s + REWIND_S - 0.03  # less a period of the wheels, and a step's jitter
        found[name] = np.maximum.accumulate(np.minimum(np.maximum.accumulate(at_s), in_reach))
    return found


def windows_over(run, name, arrival_s, rate_hz, is_driven):
    """Return the windows of a drive by their start, of samples that arrive at given times."""
    filter_name, estimated = ROBOTS[name]
    robot = load_robot(name)
    channels = {stream: run.streams[stream].channels for stream in arrival_s}
    estimator = make_live_filter(filter_name, robot, channels)
    feed = WindowFeed(
        RULE, layout_of(run, estimated), channels, estimated_channels(filter_name, robot), robot
    )
    clocks, windows, done = Clocks(), [], dict.fromkeys(arrival_s, 0)
    for now_s in np.arange(0.0, run.streams["wheels"].time_s[-1] + 0.5, 1.0 / rate_hz):
        readings = {}
        for stream, at_s in arrival_s.items():
            n, first = int(np.searchsorted(at_s, now_s + 1e-9, side="right")), done[stream]
            if n > first:
                samples = run.streams[stream]
                readings[stream] = Reading(samples.time_s[first:n], samples.values[first:n])
                done[stream] = n
        if is_driven:
            time_s, readings = clocks.step(now_s, readings)
            estimates = estimator.step(readings, time_s)
        else:
            estimates = estimator.step(readings)
        windows += feed.push(readings, estimates)
    windows += feed.push({}, estimator.settle(all_of_them=True))
    return {round(float(window.start_s[0]), 6): window.values for window in windows}


def share_of_equal(name, is_driven, seeds, duration_s):
    without = Faults(by_chance=False)
    run = simulate_run(load_robot(name), "grass", "survey", 1, duration_s=duration_s, faults=without)
    n_equal = n_windows = 0
    in_time = {stream: run.streams[stream].time_s for stream in STREAMS if stream in run.streams}
    expected = windows_over(run, name, in_time, 50.0, is_driven=False)
    assert len(expected) >= duration_s - 2
    for seed in seeds:
        windows = windows_over(run, name, arrivals(run, seed), (20.0, 50.0)[seed % 2], is_driven)
        n_windows += len(expected)
        for start_s, values in expected.items():
            other = windows.get(start_s, {})
            n_equal += all(np.array_equal(v, other.get(s), equal_nan=True) for s, v in values.items())
    return n_equal / n_windows


LINKS = [("agrimaro", True), ("agrimaro", False), ("husky", False)]


@pytest.mark.parametrize(("name", "is_driven"), LINKS)
def test_windows_over_a_bad_link_are_those_of_samples_in_time(name, is_driven):
    assert share_of_equal(name, is_driven, range(2), 12.0) >= LEAST_RATIO


@pytest.mark.slow
@pytest.mark.parametrize(("name", "is_driven"), LINKS)
def test_windows_over_many_links_are_those_of_samples_in_time(name, is_driven):
    assert share_of_equal(name, is_driven, range(200, 267), 28.0) >= LEAST_RATIO
