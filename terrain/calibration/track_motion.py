"""Motion of a tracked robot from poses, beside what its own sensors measured: samples to identify slip from.

Poses of cameras or satellites are differentiated by local polynomials of second order over a window of a few
tenths of a second; speeds of the tracks, gyro and tilt are smoothed by the same polynomials, so that all are
alike late and alike smooth.  With poses of 1 mm at 100 Hz and a window of 0.6 s a velocity is within 0.6
mm/s, and an arc at 30 deg/s is seen 0.2 % too slow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.angles import unwrapped
from terrain.errors import DataError
from terrain.estimation.observers.rows import feed_of, rows_of
from terrain.estimation.observers.slip_model import TIGHT_RATIO, next_displacement
from terrain.estimation.observers.slip_odometry import ROWS
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

HALF_WINDOW_S = 0.3
SPACING_S = 0.2
"""Of the samples: their windows overlap, and errors of one run are taken together anyhow."""

STEADY_S = 0.3
"""From the start of motion: belts and soil settle."""

MIN_SPEED_MPS = 0.01
"""Of the faster track; below, slip is noise over noise."""

STRAIGHT_RATIO = 0.1
"""Tightness of a turn below which the robot drives straight: noise of encoders is well below."""

_MIN_SAMPLES = 5  # in a window, of three coefficients


class SlipSamples(NamedTuple):
    """Samples (n,) of steady motion of one or several runs.

    Parameters
    ----------
    left_mps, right_mps : speeds of the tracks
    yaw_rate_radps, roll_rad, pitch_rad : gyro and tilt
    displacement_rad : yaw since the turn began
    forward_mps, lateral_mps : velocity of the body, from poses
    run : number of the run of each sample
    """

    left_mps: Array
    right_mps: Array
    yaw_rate_radps: Array
    roll_rad: Array
    pitch_rad: Array
    displacement_rad: Array
    forward_mps: Array
    lateral_mps: Array
    run: Array

    @property
    def tightness(self) -> Array:
        """Difference of the speeds of the tracks over the sum of their magnitudes."""
        total = np.abs(self.left_mps) + np.abs(self.right_mps)
        return np.asarray(np.abs(self.right_mps - self.left_mps) / total)

    @property
    def straight(self) -> SlipSamples:
        """The samples of straight motion."""
        return self.where(self.tightness < STRAIGHT_RATIO)

    @property
    def turning(self) -> SlipSamples:
        """The samples of turns that are tight enough for the laws of turning to hold alone."""
        return self.where(self.tightness >= TIGHT_RATIO)

    def where(self, chosen: Array) -> SlipSamples:
        """Return the samples that a mask (n,) chooses."""
        return SlipSamples(*(column[chosen] for column in self))


@njit(cache=True)
def local_polynomial(time_s: Array, values: Array, at_s: Array, half_window_s: float) -> Array:
    """Return values and slopes (m, k, 2) of parabolas through the samples around each of m times.

    Parameters
    ----------
    time_s : (n,) rising
    values : (n, k); NaN is left out
    at_s : (m,) rising
    half_window_s : samples within it, on either side, count alike

    Notes
    -----
    NaN where the window reaches beyond the samples, or holds fewer than five.
    """
    n, k, m = len(time_s), values.shape[1], len(at_s)
    out = np.full((m, k, 2), np.nan)
    first = 0
    for row in range(m):
        if at_s[row] - half_window_s < time_s[0] or at_s[row] + half_window_s > time_s[n - 1]:
            continue
        while first < n and time_s[first] < at_s[row] - half_window_s:
            first += 1
        for column in range(k):
            normal, right, count, i = np.zeros((3, 3)), np.zeros(3), 0, first
            while i < n and time_s[i] <= at_s[row] + half_window_s:
                if np.isfinite(values[i, column]):
                    t = (time_s[i] - at_s[row]) / half_window_s
                    powers = np.array([1.0, t, t * t])
                    normal += np.outer(powers, powers)
                    right += powers * values[i, column]
                    count += 1
                i += 1
            if count >= _MIN_SAMPLES:
                found = np.linalg.solve(normal, right)
                out[row, column, 0], out[row, column, 1] = found[0], found[1] / half_window_s
    return out


@njit(cache=True)
def _displacements(time_s: Array, speeds: Array, rate: Array, length_m: float) -> Array:
    out, total = np.zeros(len(time_s)), 0.0
    for i in range(1, len(time_s)):
        pair = (speeds[i, 0], speeds[i, 1])
        total = next_displacement(total, pair, rate[i], length_m, time_s[i] - time_s[i - 1])
        out[i] = total
    return out


def odometry_rows(run: RunLog, robot: TrackedRobot) -> tuple[Array, Array]:
    """Return the ticks (n,) of a run's encoders, and what an odometry takes at each (n, 5).

    Raises
    ------
    DataError
        if the run has no speeds of tracks.
    """
    return rows_of(run, feed_of(run, robot, ROWS))


def slip_samples(
    runs: Sequence[RunLog], robot: TrackedRobot, half_window_s: float = HALF_WINDOW_S
) -> SlipSamples:
    """Return samples of steady motion of all runs that have poses.

    Parameters
    ----------
    runs : with the streams wheels, imu and pose
    robot : that drove them
    half_window_s : of the polynomials

    Raises
    ------
    DataError
        if no run has a sample of steady motion.
    """
    parts = [
        _samples(number, run, robot, half_window_s)
        for number, run in enumerate(runs)
        if "pose" in run.streams and len(run.streams["pose"]) > _MIN_SAMPLES
    ]
    joined = SlipSamples(*(np.concatenate(column) for column in zip(*parts, strict=True))) if parts else None
    if joined is None or not len(joined.run):
        raise DataError(f"none of {len(runs)} runs has poses of a moving robot: slip needs them")
    return joined


def _samples(number: int, run: RunLog, robot: TrackedRobot, half_window_s: float) -> SlipSamples:
    time_s, rows = odometry_rows(run, robot)
    pose = run.streams["pose"]
    values = np.array(pose.values)
    values[:, 2] = unwrapped(values[:, 2])
    at_s = np.arange(time_s[0] + half_window_s, time_s[-1], SPACING_S)
    seen = local_polynomial(pose.time_s, values, at_s, half_window_s)
    own = local_polynomial(time_s, rows, at_s, half_window_s)[:, :, 0]
    turned = np.interp(
        at_s, time_s, _displacements(time_s, rows[:, :2], np.nan_to_num(rows[:, 2]), robot.contact_length_m)
    )
    cos, sin = np.cos(seen[:, 2, 0]), np.sin(seen[:, 2, 0])
    forward = cos * seen[:, 0, 1] + sin * seen[:, 1, 1]
    lateral = cos * seen[:, 1, 1] - sin * seen[:, 0, 1]
    moving = np.abs(own[:, :2]).max(axis=1) > MIN_SPEED_MPS
    began = at_s[np.argmax(moving)] if moving.any() else np.inf
    steady = moving & (at_s >= began + STEADY_S) & np.isfinite(own[:, :3]).all(axis=1)
    steady &= np.isfinite(forward) & np.isfinite(own[:, 3:]).all(axis=1)
    left, right, rate, roll, pitch = own.T
    which = np.full(len(at_s), number)
    found = SlipSamples(left, right, rate, roll, pitch, turned, forward, lateral, which)
    return found.where(steady)
