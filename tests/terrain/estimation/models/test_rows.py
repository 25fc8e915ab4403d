"""Rows of observers: what a tick has of each stream, live as of a whole log, and samples that cannot be."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.estimation.live import LiveObserver
from terrain.estimation.models import observer as observer_rows
from terrain.estimation.models.choice import make_observer
from terrain.estimation.models.observer import (
    ROWS,
    ObserverFeed,
    ObserverStatus,
)
from terrain.records import Reading, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import QUIET, PrescribedSlip
from terrain.simulation.run import simulate

UGV = load_robot("orchard_ugv")
NAMES = tuple(name for name in ROWS if "rear" not in name and "front" not in name)


def rows_of(run):
    return observer_rows.rows_of(run, UGV, NAMES)


def feed_of(run):
    return ObserverFeed(UGV, NAMES, {name: stream.channels for name, stream in run.streams.items()})


def push(feed, name, time_s, values):
    feed.queues[name].push(np.array(time_s), values)


def tick(feed, time_s):
    due = {name: queue.take(time_s) for name, queue in feed.queues.items()}
    return feed.tick(time_s, np.array([0.4, 0.6]), due)


def without(run, *names):
    return RunLog(run.run_id, run.robot, {k: v for k, v in run.streams.items() if k not in names})


@pytest.fixture(scope="module")
def run():
    return simulate(UGV, np.tile([0.4, 0.6], (301, 1)), PrescribedSlip(0.9, 0.8), 0, sensors=QUIET)


def test_rows_hold_what_sensors_without_noise_measured(run):
    time_s, rows, dropped = rows_of(without(run, "pose"))
    truth = run.streams["truth"]
    at = np.searchsorted(truth.time_s, time_s - 1e-9)
    assert rows[:, :2] == pytest.approx(np.tile([0.4, 0.6], (len(rows), 1)))
    assert rows[5:, NAMES.index("yaw_rate_radps")] == pytest.approx(truth.values[at[5:], 7], abs=1e-9)
    fixed = np.isfinite(rows[:, 2])
    assert fixed.sum() == len(run.streams["gnss"])
    assert np.isfinite(rows[:, 4]).tolist() == fixed.tolist()
    assert rows[fixed, 2:5] == pytest.approx(truth.values[at[fixed], :3], abs=1e-9)
    assert not dropped


def test_a_fix_between_two_ticks_is_brought_to_the_later_one(run):
    gnss, compass = run.streams["gnss"], run.streams["compass"]
    late = {"gnss": 0.013, "compass": 0.013}
    shifted = {k: Stream(s.time_s + late.get(k, 0.0), s.values, s.channels) for k, s in run.streams.items()}
    _, rows, _ = rows_of(without(RunLog("a", "orchard_ugv", shifted), "pose"))
    fixed = np.flatnonzero(np.isfinite(rows[:, 2]))[10]
    step = rows[fixed, 2:4] - gnss.values[10, :2]
    heading = compass.values[10, 0]
    assert step == pytest.approx(0.007 * 0.5 * np.array([math.cos(heading), math.sin(heading)]))


def test_a_sample_that_is_missing_is_held_for_a_while_and_then_unknown(run):
    imu = run.streams["imu"]
    kept = (imu.time_s < 1.0) | (imu.time_s > 2.0)
    lost = dict(run.streams) | {"imu": Stream(imu.time_s[kept], imu.values[kept], imu.channels)}
    time_s, rows, _ = rows_of(RunLog("a", "orchard_ugv", lost))
    gyro = rows[:, NAMES.index("yaw_rate_radps")]
    unknown = time_s[np.isnan(gyro)]
    assert unknown.min() == pytest.approx(1.1, abs=0.021)
    assert unknown.max() == pytest.approx(2.0, abs=0.021)


def test_samples_that_cannot_be_are_left_out_and_counted(run):
    channels = {name: stream.channels for name, stream in run.streams.items()}
    live = LiveObserver(make_observer("tracked", UGV), UGV, channels)
    imu = np.full((1, 9), 0.1)
    live.step({"wheels": Reading(np.array([0.0, 0.02]), np.full((2, 2), 0.1))})
    assert live.latest.time_s == 0.02
    live.step({"imu": Reading(np.array([0.03, 0.03]), np.vstack([imu, imu]))})
    live.step({"imu": Reading(np.array([0.02]), np.full((1, 4), 0.1)), "pose": "nothing"})
    live.step({"wheels": Reading(np.array([0.02, 0.01, math.nan]), np.full((3, 2), 0.1))})
    assert live.dropped == {
        "imu: stamp does not increase": 1,
        "wheels: stamp does not increase": 3,
        "imu: unreadable": 1,
        "pose: unreadable": 1,
    }
    live.step({"wheels": Reading(np.array([0.04]), np.array([[math.inf, math.nan]]))})
    assert live.latest.status is ObserverStatus.BAD_INPUT


def test_a_log_without_what_the_observer_takes_is_refused(run):
    with pytest.raises(ConfigError, match="'speed_left_mps' must be among them"):
        ObserverFeed(UGV, NAMES, {"wheels": ("motor_1_radps",)})
    with pytest.raises(DataError, match="has no stream wheels"):
        rows_of(without(run, "wheels"))


def test_stamps_that_are_no_time_and_channels_that_are_unknown_do_not_take_the_others_along(run):
    feed = feed_of(run)
    imu = run.streams["imu"].values[:4].copy()
    imu[1, 2] = np.nan
    push(feed, "imu", [0.0, np.inf, 0.005, 0.01], imu)
    known = imu[[0, 2, 3], 2].mean()
    assert tick(feed, 0.02)[NAMES.index("yaw_rate_radps")] == pytest.approx(known)
    push(feed, "imu", [0.03], np.where(np.arange(9) == 2, np.nan, imu[:1]))
    row = tick(feed, 0.04)
    assert np.isfinite(row[NAMES.index("roll_rad")])
    assert row[NAMES.index("yaw_rate_radps")] == pytest.approx(imu[3, 2])  # held


def test_a_pose_that_is_lost_leaves_the_satellites_and_bad_fixes_are_none(run):
    pose, gnss = run.streams["pose"], run.streams["gnss"]
    lost = Stream(pose.time_s, np.full_like(pose.values, np.nan), pose.channels)
    _, rows, _ = rows_of(replace(run, streams={**run.streams, "pose": lost}))
    assert np.isfinite(rows[:, 2]).sum() == len(gnss)
    values = gnss.values.copy()
    values[:, gnss.channels.index("std_position_m")] = 1.5
    spoilt = replace(run, streams={**run.streams, "gnss": Stream(gnss.time_s, values, gnss.channels)})
    _, rows, dropped = rows_of(without(spoilt, "pose"))
    assert np.isnan(rows[:, 2]).all()
    assert dropped["gnss: inaccurate"] == len(gnss)


@pytest.mark.parametrize(("tick_s", "late"), [(0.35, False), (0.45, True)])
def test_a_fix_that_waited_long_for_the_wheels_is_left_out_and_counted(run, tick_s, late):
    feed = feed_of(without(run, "pose"))
    for name in ("gnss", "compass"):
        push(feed, name, [0.1], run.streams[name].values[:1])
    row = tick(feed, tick_s)
    assert np.isnan(row[2:5]).tolist() == [late] * 3
    assert feed.dropped == ({"gnss: late": 1, "compass: late": 1} if late else {})
