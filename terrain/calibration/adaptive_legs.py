"""The adaptive observer judged on windows of DRIVE: a command's last window by efficiencies of the first.

The lidar poses of all windows but the last are fixes for the observer, brought to the body by the mount that
odometry was fitted with; the motion over the last one is dead reckoning with the efficiencies of the tracks
that it came to, without another fix and without the gyro.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.calibration.odometry_legs import Leg, composed, window_bridge
from terrain.calibration.track_motion import odometry_rows
from terrain.estimation.observers.family import ObserverStatus, observe
from terrain.estimation.observers.tracked import ROWS, tracked_observer
from terrain.estimation.observers.tracked_settings import TrackedSettings
from terrain.logs.drive_poses import WindowPoses
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

SETTINGS = TrackedSettings(
    observation_gain_ps=(2.0, 2.0, 2.0), normalised=True, position_std_m=0.03, yaw_std_rad=0.04
)
"""Gains that settle within four seconds at any speed, and about the noise of these poses."""


def efficiencies_before(
    run: RunLog, windows: Sequence[WindowPoses], robot: TrackedRobot, delay_s: float, mount: Array
) -> Array | None:
    """Return the efficiencies (2,) of the left and the right track before a command's last window.

    None where there are fewer than two windows, gaps that are not bridged, or too few fixes.

    Parameters
    ----------
    run : of the command
    windows : its poses
    robot : that drove
    delay_s : of the poses behind the gyro and the tracks
    mount : (3,) of :class:`~terrain.calibration.odometry_fit.FittedOdometry`
    """
    if len(windows) < 2:
        return None
    time_s, own = odometry_rows(run, robot)
    rows = np.full((len(time_s), len(ROWS)), np.nan)
    rows[:, :2], rows[:, 5] = own[:, :2], own[:, 2]
    origin = np.zeros(3)
    for k, window in enumerate(windows[:-1]):
        if k > 0:
            bridge = window_bridge(run, windows[k - 1].time_s[-1], window.time_s[0])
            if bridge is None:
                return None
            origin = composed(origin, bridge)
        for stamp_s, pose in zip(window.time_s - delay_s, window.pose, strict=True):
            tick = int(np.argmin(np.abs(time_s - stamp_s)))
            if abs(time_s[tick] - stamp_s) < 0.5 * (time_s[1] - time_s[0]) + 1e-9:
                rows[tick, 2:5] = of_body(composed(origin, pose), mount)
        origin = composed(origin, window.pose[-1])
    until = int(np.searchsorted(time_s, windows[-2].time_s[-1] - delay_s, side="right"))
    if until < 2:
        return None
    track = observe(tracked_observer(robot, SETTINGS), time_s[:until], rows[:until])
    if track.status[-1] == ObserverStatus.STARTING:
        return None
    eta = track.mean[-1, [track.states.index(f"eta_{side}_ratio") for side in ("left", "right")]]
    return np.asarray(eta)


def of_body(pose: Array, mount: Array) -> Array:
    """Return the pose (3,) of the body where that of the observed point is measured, both from 0.

    Examples
    --------
    >>> mount = np.array([-0.05, 0.01, 0.02])
    >>> of_body(of_point(np.array([1.0, 0.5, 0.8]), mount), mount).round(6).tolist()
    [1.0, 0.5, 0.8]
    """
    lever = complex(mount[0], mount[1])
    seen = complex(pose[0], pose[1]) * np.exp(1j * mount[2])
    body = seen + lever - lever * np.exp(1j * pose[2])
    return np.array([body.real, body.imag, pose[2]])


def of_point(pose: Array, mount: Array) -> Array:
    """Return the pose (3,) of the observed point, for that of the body: the inverse of :func:`of_body`."""
    lever = complex(mount[0], mount[1])
    seen = (complex(pose[0], pose[1]) + lever * np.exp(1j * pose[2]) - lever) * np.exp(-1j * mount[2])
    return np.array([seen.real, seen.imag, pose[2]])


def dead_reckoning(leg: Leg, eta: Array, robot: TrackedRobot) -> Array:
    """Return the change of pose (3,) of the body over a leg with efficiencies (2,): Tazzari (5).

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> speeds, still = np.full((20, 2), 0.5), np.zeros(20)
    >>> leg = Leg(0, np.zeros(3), 0.1, speeds, still, np.zeros((20, 2)), 2.0)
    >>> dead_reckoning(leg, np.array([0.9, 0.9]), load_robot("marmotte")).round(3).tolist()
    [0.9, 0.0, 0.0]
    """
    left, right = (leg.speeds_mps * eta).T
    turned = (right - left) / robot.track_m * leg.step_s
    yaw = np.cumsum(turned) - 0.5 * turned
    ahead = 0.5 * (left + right) * leg.step_s
    return np.array([(ahead * np.cos(yaw)).sum(), (ahead * np.sin(yaw)).sum(), turned.sum()])
