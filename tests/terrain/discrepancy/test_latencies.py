"""Lags come back within their own standard deviation, also where runs are short, scatter, and hold values."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs

from pipelines.data.datasets import load_runs
from terrain.discrepancy.clocks import latencies_of
from terrain.discrepancy.runs import Simulation, signals_of
from terrain.effects import GYRO, HEADING, SPEED_X
from terrain.records import RunLog, Stream
from terrain.robots import load_robot

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")


def drive(robot=HUSKY, n=8, duration_s=40.0, effects=None, seed=1) -> list[RunLog]:
    drives = rich_drives(np.random.default_rng(seed), n, duration_s)
    return list(hidden_runs(robot, drives, np.random.SeedSequence(seed), effects or {}))


def with_lidar(run: RunLog, late_s: float) -> RunLog:
    """Replace the camera by a lidar at 10 Hz that is late, and has holes at the edges of its windows."""
    imu, seen = run.streams["imu"], run.streams["odometry"]
    time_s = np.arange(seen.time_s[0], seen.time_s[-1], 0.1)
    logged = (seen, "speed_x_mps"), (imu, "gyro_z_radps")
    values = np.column_stack([np.interp(time_s, each.time_s, each.channel(name)) for each, name in logged])
    values[(time_s % 2.0 < 0.3) | (time_s % 2.0 > 1.7)] = np.nan
    lidar = Stream(time_s + late_s, values, ("speed_x_mps", "yaw_rate_radps"))
    return replace(run, streams={"imu": imu, "wheels": run.streams["wheels"], "lidar": lidar})


def moved(run: RunLog, names: Sequence[str], late_s: float) -> RunLog:
    shifted = {name: replace(run.streams[name], time_s=run.streams[name].time_s + late_s) for name in names}
    return replace(run, streams={**run.streams, **shifted})


def latencies(runs: Sequence[RunLog], robot=HUSKY):
    return latencies_of([signals_of(run, robot) for run in runs], Simulation(robot))


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (HUSKY, {}),
        (AGRIMARO, {"encoder_lag_s": 0.4}),
        (HUSKY, {"yaw_delay_s": 0.4}),
        (AGRIMARO, {"steering_delay_s": 0.4}),
        (HUSKY, {"effective_track_ratio": 1.5, "force_slip_ratio": 2.0}),
    ],
)
def test_nothing_late_and_other_delays_start_no_search(robot, effects):
    assert latencies(drive(robot, effects=effects), robot).starting_values == {}


@pytest.mark.parametrize(("streams", "late_s"), [(("wheels",), 0.27), (("imu", "odometry"), 0.3)])
def test_a_clock_is_found_in_both_signs(streams, late_s):
    found = latencies([moved(run, streams, late_s) for run in drive()])
    expected_s = -late_s if streams == ("wheels",) else late_s
    assert found.starting_values == {"clock_offset_s": pytest.approx(expected_s, abs=0.01)}
    assert list(found.channels) == [GYRO, SPEED_X]


def test_a_sensor_that_is_late_by_itself_is_distinguished_from_the_clock():
    camera = latencies([moved(run, ["odometry"], 0.3) for run in drive()]).starting_values
    assert camera == {"camera_latency_s": pytest.approx(0.3, abs=0.02)}
    imu = latencies([moved(with_lidar(run, 0.0), ["imu"], 0.3) for run in drive()])
    assert imu.starting_values == {"imu_latency_s": pytest.approx(0.3, abs=0.02)}
    alone = latencies([moved(run, ["imu"], 0.3) for run in drive()])  # or it turns late
    assert "imu_latency_s" not in alone.starting_values


def test_short_runs_of_a_wrong_simulation_measure_clocks_together():
    runs = drive(n=40, duration_s=8.0, effects={"effective_track_ratio": 1.5}, seed=3)
    runs = [moved(with_lidar(run, 0.16), ["wheels"], 0.27) for run in runs]
    rng = np.random.default_rng(0)
    for i, run in enumerate(runs):  # scatter of 20 %, and a gyro whose sign is turned
        imu = run.streams["imu"]
        values = imu.values.copy()
        values[:, imu.channels.index("gyro_z_radps")] *= -(1 + 0.2 * rng.standard_normal())
        runs[i] = replace(run, streams={**run.streams, "imu": replace(imu, values=values)})
    found = latencies(runs)
    truth_s = {GYRO: -0.27, SPEED_X: -0.11, HEADING: -0.11}
    for name, lag in found.channels.items():
        assert abs(lag.delay_s - truth_s[name]) < 4 * lag.std_s + 0.02
    assert found.starting_values == {
        "clock_offset_s": pytest.approx(-0.27, abs=0.03),
        "camera_latency_s": pytest.approx(0.16, abs=0.04),
    }


def test_too_few_runs_measure_nothing():
    found = latencies(drive(n=2))
    assert (found.channels, found.starting_values) == ({}, {})


def test_wheels_and_lidar_of_the_measured_husky_are_late(measured):
    runs = load_runs(measured("drive_husky"))
    found = latencies(runs)
    values = found.starting_values
    assert values["clock_offset_s"] == pytest.approx(-0.265, abs=0.03)
    assert values["camera_latency_s"] == pytest.approx(0.16, abs=0.05)
    assert set(values) == {"clock_offset_s", "camera_latency_s"}
