"""Values held from one message to the next: twists of poses, dates of poses, straight lines between, and frames."""

import itertools

import numpy as np
import pytest

from terrain.logs.drive import (
    N_FRAME,
    DriveRobot,
    body_twists,
    find_runs,
    frame_coefficient,
    is_first_pose,
    read_window_poses,
    undo_hold,
)

from .held_poses import PERIOD_S, N, published_pose


def test_a_circle_gives_its_twist_back_wherever_the_heading_wraps():
    """Exactly: an arc driven steadily is a straight line in its own axes."""
    twists = (0.6, 0.0, 0.9), (-0.4, 0.1, 0.5), (0.0, 0.0, 0.8), (0.7, -0.05, 0.0)
    for twist, yaw_0 in itertools.product(twists, (0.0, -0.1, np.pi - 0.04)):
        found = body_twists(published_pose(*twist, yaw_0)[None], PERIOD_S)[0][0]
        seen = np.isfinite(found).all(axis=1)
        assert seen[8:-8].all()
        assert not seen[[0, 1, -2, -1]].any()
        np.testing.assert_allclose(found[seen], np.broadcast_to(twist, (seen.sum(), 3)), atol=1e-9)


def test_the_noise_of_a_twist_is_that_of_the_pose_times_its_gain():
    rng, noise = np.random.default_rng(4), 0.005
    windows = [published_pose(0.5, 0.0, 0.3, yaw, noise=noise, rng=rng) for yaw in rng.uniform(-3, 3, 300)]
    twists, _ = body_twists(np.array(windows), PERIOD_S)
    middle = twists[:, 14:26].reshape(-1, 3)
    assert np.abs(middle.mean(axis=0) - (0.5, 0.0, 0.3)).max() < 0.002
    # six or seven poses 0.1 s apart: 1 / sqrt(sum t^2) is 1.9 to 2.4; the mean of the first five headings,
    # and the turn by the heading's own noise, add little
    assert np.all((middle.std(axis=0) > 1.7 * noise) & (middle.std(axis=0) < 2.7 * noise))
    # where a slope is uncertain, none is given
    seen = np.isfinite(twists).all(axis=(0, 2))
    assert seen.sum() > 25
    assert twists[:, seen].std(axis=0).max() < 4.5 * noise


def test_poses_out_of_a_queue_are_not_taken_at_their_time():
    """An outage of 0.5 s; then five scans that waited come within 0.2 s."""
    pose = published_pose(0.5, 0.0, 0.6, 0.3)
    queued = pose.copy()
    queued[14:24] = pose[12]
    for late, scan in enumerate(range(14, 24, 2)):
        queued[24 + late] = pose[scan]
    queued[29:] = pose[29:]
    queued[29] = pose[24]
    twists = body_twists(queued[None], PERIOD_S)[0][0]
    seen = np.isfinite(twists).all(axis=1)
    np.testing.assert_allclose(twists[seen], np.broadcast_to((0.5, 0.0, 0.6), (seen.sum(), 3)), atol=0.01)
    assert not seen[14:26].any()
    assert seen[6:9].all()
    assert np.diff(queued[:, 2]).max() / PERIOD_S > 1.0  # taken at their time they would have been far off


def test_a_pose_that_took_longer_is_dated_when_its_registration_began():
    """Registrations of 0.15 to 0.35 s, one after the other: a pose is of when its own began."""
    rng, twist, windows = np.random.default_rng(8), (1.0, -0.1, 1.2), []
    for yaw_0 in rng.uniform(-3.0, 3.0, 60):
        fine = published_pose(*twist, yaw_0, hold=1)
        starts = np.cumsum(rng.choice([3, 4, 5, 6, 7], 20, p=[0.15, 0.3, 0.3, 0.15, 0.1])) - rng.integers(3)
        logged = fine.copy()
        for begun, done, next_done in zip(starts, starts[1:], [*starts[2:], N], strict=False):
            if done < N:
                logged[done:next_done] = fine[max(begun, 0)]
        logged[: starts[1]] = fine[0]
        windows.append(logged)
    twists, _ = body_twists(np.array(windows), PERIOD_S)
    seen = np.isfinite(twists).all(axis=2)
    assert seen.mean() > 0.3
    # of the first pose of a window nothing is known, and heading is that of the first five as held
    assert np.median(np.abs(twists[seen][:, 2] - twist[2])) < 1e-9
    assert np.median(np.abs(np.hypot(*twists[seen][:, :2].T) - np.hypot(*twist[:2]))) < 1e-9


def test_a_pose_that_never_changes_or_is_missing_gives_no_speed_and_not_zero():
    missing = published_pose(0.5, 0.0, 0.2, 0.0)[None].copy()
    missing[0, 10:] = np.nan
    assert np.isnan(body_twists(np.zeros((1, N, 3)), PERIOD_S)[0]).all()
    assert np.isnan(body_twists(missing, PERIOD_S)[0][0, 12:]).all()


def test_straight_lines_keep_every_measurement_and_hold_what_was_measured_again():
    measured = np.random.default_rng(3).normal(size=12)
    measured[5] = measured[4]  # measured again, and the same
    values = np.column_stack([measured.repeat(4), np.full(48, np.nan)])
    line, unknown = undo_hold(values, np.arange(48) * PERIOD_S, [4, 4]).T
    np.testing.assert_array_equal(line[::4], measured)
    assert (line[16:21] == measured[4]).all()
    assert np.ptp(line[20:24]) > 0.0
    assert np.isnan(unknown).all()


def windows(mean_of_five, n=150, seed=0, side_slip_s=0.15):
    """Return poses and wheel speeds of windows in which the yaw rate changes; turns slip to the outside."""
    rng = np.random.default_rng(seed)
    pose, wheels = np.zeros((n, N, 3)), np.zeros((n, N, 2))
    time = np.arange(N) * PERIOD_S
    for k in range(n):
        before, after, speed = rng.uniform(-1.5, 1.5, 2), rng.uniform(-1.5, 1.5, 2), rng.uniform(-1.0, 1.0)
        rate = before[0] + (after[0] - before[0]) * np.clip((time - 0.3) / 0.8, 0.0, 1.0)
        yaw = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * PERIOD_S)])
        velocity = speed * (1.0 - 1j * side_slip_s * rate) * np.exp(1j * yaw)
        path = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * PERIOD_S)])
        held = np.arange(N) // 2 * 2  # a scan every second sample
        seen = path[held] + 0.01 * (rng.standard_normal(20) + 1j * rng.standard_normal(20)).repeat(2)
        heading = yaw[held] - yaw[0]
        seen = seen * np.exp(-1j * heading[:N_FRAME].mean()) if mean_of_five else seen
        pose[k] = np.column_stack([seen.real, seen.imag, heading])
        wheels[k] = speed
    return pose, wheels


@pytest.mark.parametrize("mean_of_five", [True, False])
def test_the_frame_of_positions_is_that_of_robots_that_change_their_turning(mean_of_five):
    for seed in range(2):
        session = windows(mean_of_five, seed=seed)
        coefficient, std = frame_coefficient(*session, PERIOD_S)
        assert abs(coefficient - (-1.0 if mean_of_five else 0.0)) < 4.0 * std < 0.8
        assert is_first_pose(*session, PERIOD_S) is not mean_of_five


def test_robots_that_drive_straight_or_stand_do_not_show_it():
    pose, wheels = windows(False)
    pose[..., 1:] = 0.0
    assert not is_first_pose(pose, wheels, PERIOD_S)
    assert not is_first_pose(np.zeros((30, N, 3)), np.zeros((30, N, 2)), PERIOD_S)
    assert np.isnan(frame_coefficient(*(each[:5] for each in windows(False)), PERIOD_S)).all()


def test_the_frame_of_measured_sessions(measured):
    for name, first in (("drive_marmotte", True), ("drive_warthog_terrains/sand_1", False)):
        read = find_runs(measured(name), DriveRobot("robot", 0.2))[0]
        assert any("frame of the first pose" in kind for kind in read().dropped) is first


def test_poses_of_windows_are_those_of_the_lidar(measured):
    """Two routes: poses a second apart, and the twists that are fitted to them."""
    folder, robot = measured("drive_marmotte"), DriveRobot("marmotte", 0.119)
    poses, errors = read_window_poses(folder, robot), []
    for read in find_runs(folder, robot)[:40]:
        run = read(repair=True)
        lidar = run.streams["lidar"]
        for window in poses[run.run_id]:
            inside = (lidar.time_s >= window.time_s[0]) & (lidar.time_s <= window.time_s[-1])
            rate = lidar.values[inside, 2]
            if np.isfinite(rate).sum() > 20:
                known = np.nanmean(rate) * np.ptp(window.time_s)
                errors.append(known - window.pose[-1, 2])
    assert len(errors) > 60
    assert np.median(np.abs(errors)) < 0.1
