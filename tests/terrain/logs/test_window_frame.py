"""The frame of a window's positions is found from robots that change their turning."""

import numpy as np
import pytest

from terrain.logs.drive import DriveRobot, find_runs, read_window_poses
from terrain.logs.held import N_FRAME, frame_coefficient, is_first_pose

PERIOD_S = 0.05


def windows(mean_of_five, n=150, seed=0, side_slip_s=0.15):
    """Return poses and wheel speeds of windows in which the yaw rate changes; turns slip to the outside."""
    rng = np.random.default_rng(seed)
    pose, wheels = np.zeros((n, 40, 3)), np.zeros((n, 40, 2))
    time = np.arange(40) * PERIOD_S
    for k in range(n):
        before, after, speed = rng.uniform(-1.5, 1.5, 2), rng.uniform(-1.5, 1.5, 2), rng.uniform(-1.0, 1.0)
        rate = before[0] + (after[0] - before[0]) * np.clip((time - 0.3) / 0.8, 0.0, 1.0)
        yaw = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * PERIOD_S)])
        velocity = speed * (1.0 - 1j * side_slip_s * rate) * np.exp(1j * yaw)
        path = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * PERIOD_S)])
        held = np.arange(40) // 2 * 2  # a scan every second sample
        seen = path[held] + 0.01 * (rng.standard_normal(20) + 1j * rng.standard_normal(20)).repeat(2)
        heading = yaw[held] - yaw[0]
        seen = seen * np.exp(-1j * heading[:N_FRAME].mean()) if mean_of_five else seen
        pose[k] = np.column_stack([seen.real, seen.imag, heading])
        wheels[k] = speed
    return pose, wheels


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mean_of_five", [True, False])
def test_the_frame_is_found(mean_of_five, seed):
    coefficient, std = frame_coefficient(*windows(mean_of_five, seed=seed), PERIOD_S)
    assert abs(coefficient - (-1.0 if mean_of_five else 0.0)) < 4.0 * std < 0.8
    assert is_first_pose(coefficient, std) is not mean_of_five


def test_robots_that_drive_straight_or_stand_do_not_show_it():
    pose, wheels = windows(False)
    pose[..., 1:] = 0.0
    assert not is_first_pose(*frame_coefficient(pose, wheels, PERIOD_S))
    assert not is_first_pose(*frame_coefficient(np.zeros((30, 40, 3)), np.zeros((30, 40, 2)), PERIOD_S))
    assert np.isnan(frame_coefficient(*(each[:5] for each in windows(False)), PERIOD_S)).all()


@pytest.mark.parametrize(
    ("name", "first"), [("drive_marmotte", True), ("drive_warthog_terrains/sand_1", False)]
)
def test_the_frame_of_measured_sessions(measured, name, first):
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
