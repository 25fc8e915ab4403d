"""Radius, track and delays that are hidden in simulated logs come back within their intervals."""

from dataclasses import replace

import pytest
from studies.intervals import NOMINAL_M
from studies.intervals import skid_run as driven

from pipelines.data.datasets import load_runs
from terrain.calibration.skid_steer import LIDAR_DELAY, RADIUS, TRACK, WHEELS_DELAY, identify
from terrain.records import Stream
from terrain.robots import load_robot

HIDDEN = [(0.287, 1.8, 0.3, 0.05), (0.31, 1.5, 0.45, 0.12)]


@pytest.mark.parametrize("hidden", HIDDEN)
def test_hidden_values_come_back_within_their_intervals(hidden):
    runs = [driven(*hidden, i) for i in range(12)]
    found = {f.parameter: f for f in identify(runs, NOMINAL_M, ("asphalt",))}
    for name, value in zip((RADIUS, TRACK, LIDAR_DELAY, WHEELS_DELAY), hidden, strict=True):
        finding = found[name]
        assert finding.determined
        # 95 % of intervals hold the value; here each is widened to hold all 12
        middle, half = (finding.low + finding.high) / 2, (finding.high - finding.low) / 2
        assert abs(middle - value) < 1.5 * half, (name, finding)
        assert half < {RADIUS: 0.012, TRACK: 0.1, LIDAR_DELAY: 0.02, WHEELS_DELAY: 0.02}[name]


def test_only_hard_ground_is_used_and_unlabelled_runs_where_there_is_no_label():
    runs = [driven(0.29, 1.8, 0.3, 0.05, i) for i in range(6)]
    soft = [driven(0.29, 2.6, 0.3, 0.05, 50 + i, terrain="sand") for i in range(6)]
    on_hard = identify(runs + soft, NOMINAL_M, ("asphalt",))[1]
    assert on_hard.value == identify(runs, NOMINAL_M, ("asphalt",))[1].value
    nowhere = identify(soft, NOMINAL_M, ("asphalt",))
    assert not any(finding.determined for finding in nowhere)
    assert nowhere[0].note == "no run is labelled as hard ground (asphalt)"
    bare = [replace(run, labels=()) for run in runs]
    found = identify(bare, NOMINAL_M, ("asphalt",))
    assert found[1].value == on_hard.value
    assert "slip of 0 to 5 %" in found[0].note


def test_sessions_that_differ_widen_the_interval():
    tracks = (1.7, 1.75, 1.85, 1.9, 1.8)
    runs = [
        driven(0.29, track, 0.3, 0.05, 10 * k + i, session=f"s{k}")
        for k, track in enumerate(tracks)
        for i in range(5)
    ]
    by_session = identify(runs, NOMINAL_M, ("asphalt",))[1]
    by_run = identify([replace(run, session="") for run in runs], NOMINAL_M, ("asphalt",))[1]
    assert by_session.high - by_session.low > 1.3 * (by_run.high - by_run.low)
    assert by_session.low < 1.8 < by_session.high


def test_without_turns_or_gyro_it_is_unknown_and_not_zero():
    straight = []
    for i in range(6):
        run = driven(0.29, 1.8, 0.3, 0.05, i)
        still = dict(run.streams)
        for name, factors in (("imu", [0.0]), ("lidar", [1.0, 0.0, 0.0])):
            s = run.streams[name]
            still[name] = Stream(s.time_s, s.values * factors, s.channels)
        s = run.streams["wheels"]
        still["wheels"] = Stream(s.time_s, s.values[:, [0, 0]], s.channels)
        straight.append(replace(run, streams=still))
    found = {f.parameter: f for f in identify(straight, NOMINAL_M, ("asphalt",))}
    assert not any(found[name].determined for name in (TRACK, LIDAR_DELAY, WHEELS_DELAY))
    runs = [driven(0.29, 1.8, 0.3, 0.05, i) for i in range(6)]
    blind = [replace(run, streams={n: s for n, s in run.streams.items() if n != "imu"}) for run in runs]
    found = {f.parameter: f for f in identify(blind, NOMINAL_M, ("asphalt",))}
    assert found[WHEELS_DELAY].note == "there is no gyro"
    assert found[LIDAR_DELAY].low < 0.25 < found[LIDAR_DELAY].high  # behind the wheels: 0.3 - 0.05


@pytest.mark.parametrize("name", ["warthog", "marmotte"])
def test_what_the_package_states_is_what_measured_logs_show(measured, name):
    folder = {"warthog": "drive_warthog_terrains", "marmotte": "drive_marmotte"}[name]
    robot = load_robot(name)
    runs = load_runs(measured(folder), robot=name)
    found = {f.parameter.partition(".")[2]: f for f in identify(runs, robot.wheel_radius_m, ("asphalt",))}
    for name in robot.identified:
        half = (found[name].high - found[name].low) / 2
        assert abs(found[name].value - robot.identified[name]) < 2.5 * half, (name, found[name])
    assert found["rolling_radius_m"].low < 1.02 * robot.wheel_radius_m
    assert found["rolling_radius_m"].high > 0.98 * robot.wheel_radius_m
    assert 1.0 < robot.identified["effective_track_m"] / robot.track_m < 2.0
