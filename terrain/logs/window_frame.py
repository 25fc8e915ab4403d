r"""The frame that the positions of windows are in: that of the first pose, or the mean of the first five.

The authors of DRIVE turned the positions of each window by the mean heading of its first five samples; in
other sets of theirs they are in the frame of the first pose.  Nothing in the files says which.  While a robot
turns the two differ, and a path that is laid out by lidar headings and wheel directions shows it: with the
chords :math:`\Delta p_k` between the poses of a window and the middle headings :math:`\bar\psi_k`,

.. math:: \rho = \arg \sum_k \pm \Delta p_k e^{-i \bar\psi_k} = a\, \bar\psi_{1..5} - c\, w + b ,

where a is -1 for the mean of five and 0 for the first pose, c is the side slip in turns, which turns all of a
window's path alike, and w its mean yaw rate.  A robot that changes its turning distinguishes a from c.
"""

from __future__ import annotations

import numpy as np

from terrain.logs.lidar_twist import N_FRAME, dated, new_poses, usual_wait
from terrain.records import Array

MIN_DISTANCE_M = 0.15
"""Windows with a shorter path have no direction: poses scatter by a centimetre."""

MIN_WINDOWS = 20
"""So few windows say nothing of a session."""

STEADY_RAD = 0.1
"""Deviation from which a window counts less: wheels that spin, registrations that jump."""

ITERATIONS = 30
"""Of the reweighted least squares."""


def frame_coefficient(pose: Array, wheels_mps: Array, period_s: float) -> tuple[float, float]:
    """Return a, and its standard deviation; NaN where too few windows turn and move.

    Parameters
    ----------
    pose : (n, k, 3) x, y and yaw of n windows, as published
    wheels_mps : (n, k, 2) circumferential speeds, of which the sign of the mean is used
    period_s : time from sample to sample

    Notes
    -----
    Windows whose published heading jumps by a turn within its first samples are left out: their mean is no
    heading.
    """
    new = new_poses(pose)
    scan = usual_wait(new)
    found = [
        row
        for window, arrived, ahead in zip(pose, new, np.nanmean(wheels_mps, axis=(1, 2)), strict=True)
        if (row := _direction(window, np.flatnonzero(arrived), scan, period_s, ahead)) is not None
    ]
    if len(found) < MIN_WINDOWS:
        return np.nan, np.nan
    direction, first, turned, weight = np.array(found).T
    terms = np.column_stack([first, turned, np.ones(len(found))])
    fitted, left, believed = np.zeros(3), direction, weight
    for _ in range(ITERATIONS):
        normal = (terms * believed[:, None]).T @ terms
        if np.linalg.cond(normal) > 1e12:  # nothing turned
            return np.nan, np.nan
        fitted = np.linalg.solve(normal, (terms * believed[:, None]).T @ direction)
        left = direction - terms @ fitted
        believed = weight / np.maximum(1.0, np.abs(left) / STEADY_RAD)
    variance = np.linalg.inv(normal) * np.average(left**2, weights=believed)
    return float(fitted[0]), float(np.sqrt(variance[0, 0]))


def is_first_pose(coefficient: float, std: float) -> bool:
    """Return whether positions are in the frame of the first pose: a is 0 beyond doubt, and -1 is not.

    Examples
    --------
    >>> is_first_pose(0.13, 0.17), is_first_pose(-0.9, 0.13), is_first_pose(-0.4, 0.3)
    (True, False, False)
    """
    return bool(abs(coefficient) < 3.0 * std and coefficient + 1.0 > 3.0 * std)


def _direction(
    window: Array, arrival: Array, scan: int, period_s: float, ahead_mps: float
) -> tuple[float, float, float, float] | None:
    """Return direction, mean of the first headings, yaw rate and weight of a window; None without any."""
    at, usable = dated(arrival, len(window), scan)
    came = window[arrival][usable]
    if len(came) < 4 or np.abs(np.diff(window[: N_FRAME + 1, 2])).max() > np.pi / 2:
        return None
    yaw = np.unwrap(came[:, 2])
    chords = np.diff(came[:, 0] + 1j * came[:, 1]) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    path = np.sign(ahead_mps) * chords.sum()
    if not abs(path) >= MIN_DISTANCE_M:
        return None
    rate = (yaw[-1] - yaw[0]) / (np.ptp(at[usable]) * period_s)
    return float(np.angle(path)), window[:N_FRAME, 2].mean() - window[0, 2], rate, min(abs(path), 1.0)
