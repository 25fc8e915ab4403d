"""Radius, track and delays that are hidden in simulated logs come back within their intervals."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from pipelines.report.results import silent
from pipelines.slip import calibrate
from terrain.calibration.skid_steer import (
    LIDAR_DELAY,
    RADIUS,
    TRACK,
    WHEELS_DELAY,
    identify,
)
from terrain.errors import ConfigError, DataError
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot

NOMINAL_M = 0.3
TWIST = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")


def steps(rng, n_steps, duration_s=3.0, rate_hz=100.0):
    """Commands of speed and yaw rate, each held for some seconds and low-passed."""
    n = round(duration_s * rate_hz)
    speed = np.repeat(rng.uniform(-1.5, 1.5, n_steps), n)
    turn = np.repeat(rng.uniform(-0.8, 0.8, n_steps) * rng.integers(0, 2, n_steps), n)
    kernel = np.exp(-np.arange(60) / 15.0)
    kernel /= kernel.sum()
    return [np.convolve(signal, kernel)[: len(signal)] for signal in (speed, turn)]


def driven(radius_m, track_m, lidar_s, wheels_s, seed, terrain="asphalt", slip=0.01, n_steps=8, session=""):
    """A run of a robot whose radius, track and delays are known; lidar at 10 Hz, gyro at 50, wheels at 20."""
    rng = np.random.default_rng(seed)
    speed, turn = steps(rng, n_steps)
    t = np.arange(len(speed)) / 100.0

    def late(signal, at_s, delay_s):
        return np.interp(at_s - delay_s, t, signal)

    imu_s, wheels_at_s, lidar_at_s = (np.arange(0.0, t[-1], step) for step in (0.02, 0.05, 0.1))
    rolled = speed / (1.0 - slip)
    # a nominal radius makes of a smaller one's turns a higher speed; the track is one of these speeds
    sides = [
        late(rolled * NOMINAL_M / radius_m + sign * turn * track_m / 2, wheels_at_s, wheels_s)
        for sign in (-1, 1)
    ]
    wheels = np.column_stack(sides) + rng.normal(0.0, 0.01, (len(wheels_at_s), 2))
    lidar = np.column_stack(
        [late(speed, lidar_at_s, lidar_s), 0.0 * lidar_at_s, late(turn, lidar_at_s, lidar_s)]
    )
    lidar += rng.normal(0.0, 0.03, lidar.shape)
    gyro = late(turn, imu_s, 0.0) + rng.normal(0.0, 0.01, len(imu_s))
    streams = {
        "wheels": Stream(wheels_at_s, wheels, ("speed_left_mps", "speed_right_mps")),
        "imu": Stream(imu_s, gyro[:, None], ("gyro_z_radps",)),
        "lidar": Stream(lidar_at_s, lidar, TWIST),
    }
    labels = (Label(0.0, float(t[-1]), terrain),) if terrain else ()
    return RunLog(f"run_{seed:03d}", "warthog", streams, labels, session=session)


HIDDEN = [(0.287, 1.8, 0.3, 0.05), (0.31, 1.5, 0.45, 0.12), (0.3, 2.1, 0.1, 0.0)]


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("seed", [0, 1])
def test_hidden_values_come_back_within_their_intervals(hidden, seed):
    runs = [driven(*hidden, 100 * seed + i) for i in range(12)]
    found = {f.parameter: f for f in identify(runs, NOMINAL_M, ("asphalt",))}
    for name, value in zip((RADIUS, TRACK, LIDAR_DELAY, WHEELS_DELAY), hidden, strict=True):
        finding = found[name]
        assert finding.determined
        # 95 % of intervals hold the value; here each is widened to hold all 24
        middle, half = (finding.low + finding.high) / 2, (finding.high - finding.low) / 2
        assert abs(middle - value) < 1.5 * half, (name, finding)
        assert half < {RADIUS: 0.012, TRACK: 0.1, LIDAR_DELAY: 0.02, WHEELS_DELAY: 0.02}[name]


def test_intervals_hold_the_truth_as_often_as_they_state():
    """The track alone, which has no assumption in it: of 40 data sets at least 34 (2 % chance at 95 %)."""
    held = 0
    for seed in range(40):
        runs = [driven(0.29, 1.8, 0.3, 0.05, 1000 * seed + i, n_steps=4) for i in range(8)]
        finding = identify(runs, NOMINAL_M, ("asphalt",))[1]
        held += finding.low <= 1.8 <= finding.high
    assert held >= 34


def test_the_slip_that_is_assumed_is_in_the_interval_of_the_radius():
    for slip in (0.0, 0.02):
        runs = [driven(0.29, 1.8, 0.3, 0.05, i, slip=slip) for i in range(12)]
        finding = identify(runs, NOMINAL_M, ("asphalt",))[0]
        assert finding.low < 0.29 < finding.high
        assert "slip of 0 to 2 %" in finding.note


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


def test_runs_without_a_lidar_are_one_sentence(tmp_path):
    run = driven(0.29, 1.8, 0.3, 0.05, 0)
    write_run(replace(run, streams={n: s for n, s in run.streams.items() if n != "lidar"}), tmp_path / "runs")
    with pytest.raises(
        DataError, match="drive 'skid_steer' is not calibrated from logs without the stream 'lidar'"
    ):
        calibrate.run(calibrate.Settings(data=tmp_path / "runs", robot="warthog"), silent)


def test_a_section_with_a_wrong_key_or_unit_is_one_sentence(tmp_path):
    text, file = _warthog_text(), tmp_path / "mine.yaml"
    file.write_text(text.replace("effective_track_m:", "effective_width_m:"))
    with pytest.raises(ConfigError, match="identified: key 'effective_width_m' is unknown"):
        load_robot(file)
    file.write_text(text.replace("0.41, unit: s", "0.41, unit: ms"))
    with pytest.raises(ConfigError, match="lidar_delay_s has the unit 'ms', 's' is required"):
        load_robot(file)


def _warthog_text():
    from terrain.files.resources import data_folder

    return (data_folder("robots") / "warthog.yaml").read_text()


def overlap(finding, name, robot):
    """Whether a finding is what the package's robot states, within 2.5 of its own half intervals."""
    half = (finding.high - finding.low) / 2
    return abs(finding.value - robot.identified[name]) < 2.5 * half


@pytest.mark.parametrize("robot_name", ["warthog", "marmotte"])
def test_what_the_package_states_is_what_measured_logs_show(measured, robot_name):
    folder = {"warthog": "drive_warthog_terrains", "marmotte": "drive_marmotte"}[robot_name]
    robot = load_robot(robot_name)
    runs = load_runs(measured(folder), robot=robot_name)
    found = {f.parameter.partition(".")[2]: f for f in identify(runs, robot.wheel_radius_m, ("asphalt",))}
    for name in robot.identified:
        assert overlap(found[name], name, robot), (name, found[name])
    assert found["rolling_radius_m"].low < 1.02 * robot.wheel_radius_m
    assert found["rolling_radius_m"].high > 0.98 * robot.wheel_radius_m
    assert 1.0 < robot.identified["effective_track_m"] / robot.track_m < 2.0
