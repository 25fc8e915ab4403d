"""The adaptive observer of tracked vehicles: how fast and how well it settles, and what it does at faults."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.observers import tracked
from terrain.estimation.observers.family import ObserverStatus, observe
from terrain.estimation.observers.tracked import tracked_observer
from terrain.estimation.observers.tracked_settings import TrackedSettings
from terrain.estimation.observers.tracked_stability import excitation
from terrain.robots import load_robot
from terrain.slip import slip_ratio

ROBOT = load_robot("orchard_ugv")
D = ROBOT.half_track_m
HZ, EVERY = 50, 5
STRAIGHT = (0.6, 0.6), (0.87, 0.87)
CIRCLE = (0.4, 0.6), (1.10, 0.80)
PAPER = TrackedSettings()
NORMALISED = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True)
RAW = {"position_std_m": 0.02, "yaw_std_rad": math.radians(0.5)}


def drive(speeds, eta, duration_s=60.0, rng=None, position_std_m=0.0, yaw_std_rad=0.0, gyro=False):
    """Return times, rows of the observer, true poses (n, 3) and true efficiencies (n, 2) of a drive.

    Speeds and efficiencies are pairs (left, right), of numbers or of arrays (n,); between ticks the robot
    moves along an arc with their means.
    """
    n = round(duration_s * HZ) + 1
    speed, eta = (np.stack([np.broadcast_to(side, n) for side in pair], axis=-1) for pair in (speeds, eta))
    ground = np.empty((n - 1, 2))
    for j in range(2):
        ground[:, j] = (speed[1:, j] + speed[:-1, j]) / 2 * (eta[1:, j] + eta[:-1, j]) / 2
    turn = (ground[:, 1] - ground[:, 0]) / (2 * D * HZ)
    yaw = np.r_[0.0, np.cumsum(turn)]
    chord = ground.mean(axis=1) / HZ * np.sinc(turn / (2 * np.pi))
    middle = yaw[:-1] + turn / 2
    pose = np.stack(
        [np.r_[0.0, np.cumsum(chord * np.cos(middle))], np.r_[0.0, np.cumsum(chord * np.sin(middle))], yaw],
        axis=-1,
    )
    rows = np.full((n, 6), np.nan)
    rows[:, :2] = speed
    rows[::EVERY, 2:5] = pose[::EVERY]
    if rng is not None:
        noise = rng.standard_normal((len(rows[::EVERY]), 3))
        rows[::EVERY, 2:5] += noise * [position_std_m, position_std_m, yaw_std_rad]
    rows[:, 4] = np.pi - np.remainder(np.pi - rows[:, 4], 2 * np.pi)  # as a compass shows it
    if gyro:
        rows[:, 5] = (eta[:, 1] * speed[:, 1] - eta[:, 0] * speed[:, 0]) / (2 * D)
    return np.arange(n) / HZ, rows, pose, eta


def efficiencies(track):
    return np.stack([track.state("eta_left_ratio"), track.state("eta_right_ratio")], axis=-1)


def settling_s(time_s, found, true, ratio):
    """Return when both efficiencies stay within a ratio of the true ones."""
    return time_s[np.flatnonzero((abs(found - true) > ratio * true).any(axis=1))[-1] + 1]


def names(track):
    return [ObserverStatus(code).name for code in track.status]


@pytest.mark.parametrize(("drive_of", "bars_s"), [(STRAIGHT, (7, 11)), (CIRCLE, (4, 8))])
@pytest.mark.parametrize("gyro", [False, True])
def test_it_settles_with_the_gains_of_the_paper(drive_of, bars_s, gyro):
    time_s, rows, _, eta = drive(*drive_of, gyro=gyro)
    found = efficiencies(observe(tracked_observer(ROBOT), time_s, rows))
    for ratio, bar_s in zip((0.05, 0.02), bars_s, strict=True):
        assert settling_s(time_s, found, eta, ratio) <= bar_s
    np.testing.assert_allclose(found[-1], eta[-1], atol=2e-4)


@pytest.mark.parametrize("speed_mps", [0.3, 0.6, 1.0])
def test_the_normalised_gain_settles_as_fast_at_every_speed(speed_mps):
    time_s, rows, _, eta = drive((speed_mps, speed_mps), (0.87, 0.87), 20.0)
    found = efficiencies(observe(tracked_observer(ROBOT, NORMALISED), time_s, rows))
    assert settling_s(time_s, found, eta, 0.02) <= 4.0


@pytest.mark.parametrize("drive_of", [STRAIGHT, CIRCLE])
def test_raw_fixes_of_2_cm_leave_half_a_percent(drive_of):
    time_s, rows, _, eta = drive(*drive_of, 150.0, np.random.default_rng(0), **RAW)
    found = efficiencies(observe(tracked_observer(ROBOT), time_s, rows))
    rmse = np.sqrt(np.mean((found - eta)[time_s > 30] ** 2, axis=0))
    assert rmse.max() <= 0.005


@pytest.mark.parametrize("settings", [PAPER, NORMALISED])
@pytest.mark.parametrize("drive_of", [STRAIGHT, CIRCLE])
def test_errors_are_as_large_as_stated(settings, drive_of):
    """Squared errors of pose and efficiencies, normalised by their covariance, average to 1."""
    squares, rng = [], np.random.default_rng(0)
    observer = tracked_observer(ROBOT, replace(settings, eta_std_ratio=0.05))
    for _ in range(30):
        walk = settings.eta_walk_ratio / math.sqrt(HZ) * rng.standard_normal((2, 40 * HZ + 1))
        true = np.array(drive_of[1])[:, None] + 0.05 * rng.standard_normal((2, 1)) + np.cumsum(walk, axis=1)
        _, rows, pose, eta = drive(drive_of[0], tuple(true), 40.0, rng, **RAW)
        memory = np.array(observer.start)
        for k, row in enumerate(rows):
            memory = observer.step(observer.params, memory, row, 1 / HZ)
            if k > 25 * HZ and k % (2 * HZ) == 0:
                estimate = observer.read(observer.params, memory).mean
                off = np.r_[pose[k] - estimate[:3], eta[k] - estimate[5:7]]
                off[2] = math.remainder(off[2], 2 * math.pi)
                cov = memory[tracked.COVARIANCE : tracked.CROSS].reshape(5, 5)
                squares.append(off @ np.linalg.solve(cov, off) / 5)
    # 30 runs, each at least two independent errors of 5 numbers: 3 * sqrt(2 / 300)
    assert abs(np.mean(squares) - 1) < 0.25


def test_excitation_is_the_closed_form():
    time_s, rows, *_ = drive(*CIRCLE, 40.0)
    found = observe(tracked_observer(ROBOT), time_s, rows).state("excitation_mps")
    assert found[-1] ** 2 == pytest.approx(excitation(0.4, 0.6, D), rel=1e-3)
    assert found[round(2 * HZ)] ** 2 == pytest.approx(excitation(0.4, 0.6, D) * -math.expm1(-2 / 5), rel=2e-2)


@pytest.mark.parametrize(("speeds", "eta"), [((-0.6, -0.5), (0.9, 0.8)), ((-0.4, 0.4), (0.7, 0.9))])
def test_reversed_motion_and_spin_in_place(speeds, eta):
    time_s, rows, pose, _ = drive(speeds, eta, 120.0)
    track = observe(tracked_observer(ROBOT), time_s, rows)
    np.testing.assert_allclose(efficiencies(track)[-1], eta, atol=2e-3)
    np.testing.assert_allclose(
        track.slip[-1], slip_ratio(np.array(speeds), np.array(eta) * speeds), atol=2e-3
    )
    assert abs(np.remainder(track.state("yaw_rad")[-1] - pose[-1, 2] + np.pi, 2 * np.pi) - np.pi) < 0.01
    assert names(track)[-1] == "OK"


def test_slip_of_a_braking_track_is_that_of_the_project():
    time_s, rows, *_ = drive((0.5, 0.5), (1.25, 1.25))
    track = observe(tracked_observer(ROBOT, NORMALISED), time_s, rows)
    np.testing.assert_allclose(track.slip[-1], slip_ratio(0.5, 1.25 * 0.5), atol=1e-3)
    assert (track.slip_std[-1] < track.std[-1, 5:7]).all()
    assert np.isnan(track.slip[0]).all()


@pytest.mark.parametrize("gyro", [False, True])
def test_missing_fixes_are_dead_reckoning_and_long_ones_begin_the_pose_anew(gyro):
    time_s, rows, pose, _ = drive(*CIRCLE, 80.0, gyro=gyro)
    for start_s, end_s in ((50, 51.5), (60, 70)):
        rows[(time_s > start_s) & (time_s < end_s), 2:5] = np.nan
    track = observe(tracked_observer(ROBOT), time_s, rows)
    status, found = np.array(names(track)), efficiencies(track)
    gap = (time_s > 60.6) & (time_s < 70)
    assert (status[gap] == "PREDICTED").all()
    assert (found[gap] == found[gap][0]).all()
    assert status[time_s == 70] == "RESET"
    assert "RESET" not in status[time_s < 70]
    off = np.hypot(*(track.mean[:, :2] - pose[:, :2]).T)
    assert off[gap].max() < 0.02
    assert (off[gap] < 3 * track.std[gap, :2].max(axis=1)).all()
    np.testing.assert_allclose(found[-1], CIRCLE[1], atol=1e-3)


def test_standing_for_an_hour_nothing_drifts():
    rng = np.random.default_rng(0)
    driven = drive(*STRAIGHT, 60.0, rng, **RAW)
    observer = tracked_observer(ROBOT)
    memory = np.array(observer.start)
    for row in driven[1]:
        memory = observer.step(observer.params, memory, row, 1 / HZ)
    place, rows = driven[2][-1], np.full((3600 * 10, 6), np.nan)
    rows[:, :2] = rng.normal(scale=0.004, size=(len(rows), 2))  # encoders that flicker
    rows[:, 2:5] = place + rng.normal(size=(len(rows), 3)) * [0.02, 0.02, 0.009]
    rows[:, 5] = 0.005 + rng.normal(scale=0.002, size=len(rows))  # a gyro with a bias
    for k, row in enumerate(rows):
        memory = observer.step(observer.params, memory, row, 0.1)
        if k == 1:  # the interval in which it stopped has passed
            before = observer.read(observer.params, memory)
        assert memory[tracked.STATUS] in (ObserverStatus.STANDING, ObserverStatus.REJECTED)
    after = observer.read(observer.params, memory)
    np.testing.assert_array_equal(after.slip, before.slip)
    np.testing.assert_array_equal(after.slip_std, before.slip_std)
    assert (abs(after.mean[:3] - place) < 4 * after.std[:3]).all()


@pytest.mark.parametrize("fault", ["jump", "flip", "infinite"])
def test_a_fix_that_cannot_be_is_rejected_and_a_lasting_one_begins_the_pose_anew(fault):
    shift = {"jump": [5.0, 0.0, 0.0], "flip": [0.0, 0.0, math.pi], "infinite": [math.inf, 0.0, 0.0]}[fault]
    time_s, rows, *_ = drive(*CIRCLE, 80.0, np.random.default_rng(0), **RAW)
    once, lasting = np.array(rows), np.array(rows)
    once[time_s == 40, 2:5] += shift
    lasting[time_s >= 40, 2:5] += shift
    observer = tracked_observer(ROBOT)
    clean, track, kept = (observe(observer, time_s, log) for log in (rows, once, lasting))
    assert names(track).count("REJECTED") == 1
    assert names(track)[40 * HZ] == "REJECTED"
    before, after = efficiencies(track)[40 * HZ - 1 : 40 * HZ + 1]
    np.testing.assert_array_equal(before, after)
    np.testing.assert_allclose(efficiencies(track)[-1], efficiencies(clean)[-1], atol=1e-3)
    if fault == "infinite":
        assert "RESET" not in names(kept)
        return
    reset = names(kept).index("RESET")
    assert names(kept).count("RESET") == 1
    assert names(kept).count("REJECTED") == PAPER.n_reset - 1
    np.testing.assert_array_equal(efficiencies(kept)[reset], efficiencies(kept)[40 * HZ - 1])
    off = kept.mean[reset, :2] - lasting[reset, 2:4]
    assert abs(off).max() == 0


def test_a_track_that_stands_keeps_its_efficiency():
    n = 60 * HZ + 1
    left = np.where(np.arange(n) < 40 * HZ, 0.5, 0.0)
    time_s, rows, *_ = drive((left, 0.5), (0.9, 0.8), 60.0)
    track = observe(tracked_observer(ROBOT, NORMALISED), time_s, rows)
    found = efficiencies(track)[41 * HZ :]
    assert set(names(track)[41 * HZ :]) == {"UNEXCITED"}
    assert (found[:, 0] == found[0, 0]).all()
    np.testing.assert_allclose(found[-1], [0.9, 0.8], atol=2e-3)
    assert (np.diff(track.slip_std[41 * HZ :, 0]) >= 0).all()
    assert track.state("excitation_mps")[-1] < 0.1 < track.state("excitation_mps")[39 * HZ]


def test_a_robot_pushed_while_its_tracks_stand():
    time_s, rows, *_ = drive(*STRAIGHT, 10.0, gyro=True)
    rows[5 * HZ :, :2], rows[5 * HZ :, 2:5], rows[5 * HZ :, 5] = 0.0, np.nan, 0.2
    assert set(names(observe(tracked_observer(ROBOT), time_s, rows))[5 * HZ + 1 :]) == {"PUSHED"}


def test_ticks_without_speeds_and_pauses_lose_no_travel_that_is_known():
    time_s, rows, *_ = drive(*CIRCLE, 60.0)
    rows[(np.arange(len(rows)) % 7) == 3, 0] = np.nan
    track = observe(tracked_observer(ROBOT), time_s, rows)
    bad = (np.arange(len(rows)) % 7) == 3
    assert (np.array(names(track)) == "BAD_INPUT").tolist() == bad.tolist()
    np.testing.assert_allclose(efficiencies(track)[-1], CIRCLE[1], atol=2e-3)
    kept = (time_s < 30) | (time_s >= 35)
    paused = observe(tracked_observer(ROBOT), time_s[kept], rows[kept])
    assert names(paused).count("RESET") == 1
    np.testing.assert_allclose(efficiencies(paused)[-1], CIRCLE[1], atol=2e-3)


def test_whatever_comes_in_the_memory_is_finite():
    rng, strange = (
        np.random.default_rng(0),
        [math.nan, math.inf, -math.inf, 0.0, 1e-320, 1e300, -1e9, 7.0, 0.5],
    )
    times = [math.nan, math.inf, -1.0, 0.0, 1e-9, 0.02, 0.3, 5.0, 1e308]
    for settings in (PAPER, NORMALISED, TrackedSettings(adaptation_gain=(1e4, 1e4))):
        observer = tracked_observer(ROBOT, settings)
        memory = np.array(observer.start)
        for k in range(8_000):
            row = rng.uniform(-2, 2, 6) if k % 3 else rng.choice(strange, 6)
            before = memory.copy()
            memory = observer.step(observer.params, memory, row, float(rng.choice(times)))
            assert np.isfinite(memory).all()
            if memory[tracked.STATUS] == ObserverStatus.BAD_INPUT:
                before[[tracked.STATUS, tracked.PENDING]] = memory[[tracked.STATUS, tracked.PENDING]]
                np.testing.assert_array_equal(before, memory)
        assert np.linalg.eigvalsh(memory[tracked.COVARIANCE : tracked.CROSS].reshape(5, 5))[0] > -1e-9


def test_nothing_is_known_before_the_first_fix():
    time_s, rows, *_ = drive(*STRAIGHT, 5.0)
    rows[:100, 2:5] = np.nan
    track = observe(tracked_observer(ROBOT), time_s, rows)
    assert set(names(track)[:100]) == {"STARTING"}
    assert np.isnan(track.mean[:100, :3]).all()
    assert np.isnan(track.slip[:100]).all()
    assert names(track)[100] == "OK"


def test_settings_that_cannot_be():
    for wrong in ({"position_std_m": 0.0}, {"adaptation_gain": (1.0, -1.0)}, {"window_s": math.nan}):
        with pytest.raises(ConfigError, match="above zero is required"):
            tracked_observer(ROBOT, TrackedSettings(**wrong))
