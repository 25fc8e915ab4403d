r"""Values that a log holds from one message to the next: encoders that report rarely, and poses of a lidar.

What is held is read at the rate at which it really changes; poses give speeds of the body, and the frame that the
positions of windows are in: that of the first pose, or the mean of the first five.  The authors of DRIVE turned the
positions of each window by the mean heading of its first five samples; in other sets of theirs they are in the frame
of the first pose.  Nothing in the files says which.  While a robot
turns the two differ, and a path that is laid out by lidar headings and wheel directions shows it: with the
chords :math:`\Delta p_k` between the poses of a window and the middle headings :math:`\bar\psi_k`,

.. math:: \rho = \arg \sum_k \pm \Delta p_k e^{-i \bar\psi_k} = a\, \bar\psi_{1..5} - c\, w + b ,

where a is -1 for the mean of five and 0 for the first pose, c is the side slip in turns, which turns all of a
window's path alike, and w its mean yaw rate.  A robot that changes its turning distinguishes a from c.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.records import Array

CHANNELS: tuple[str, ...] = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
"""What :func:`body_twists` returns."""

MAX_HELD_S = 0.1
"""A value that is usually held for longer is read as straight lines.  Held for 0.1 s it lags by 0.025 s
on samples at 20 Hz, half a sample; held for 0.25 s by 0.1 s."""

HALF_WIDTH_SCANS = 3
"""Poses to either side that a speed is fitted to: about six, enough for a parabola and its noise."""

OUTAGE_SCANS = 2
"""A pose that took so many usual waits is stale when it comes, and so are those right behind."""

QUEUE = 3
"""So many new poses in as many samples come out of a queue, since a registration takes longer than that."""

MAX_GAIN_PER_S = 4.0
"""Largest standard deviation of a speed for each unit of the pose's; 2.3 in the middle of a window of 40
samples with a pose in every second one."""

N_FRAME = 5  #: Samples whose mean heading the authors of DRIVE turned the positions of a window by

MAX_STD = (0.2, 0.2, 0.2)
"""Standard deviations, in m/s and rad/s, beyond which a recording's lidar has lost the robot: poses scatter
by 0.01 m about a parabola elsewhere, which is 0.03 m/s, and by 0.3 m where a registration jumps.  Of
recordings of a Warthog that takes 1 % of the twists, of a Husky on wet grass a sixth."""

MIN_JUDGED_SCANS = 5.0
"""So few poses at least show their scatter about a parabola, which takes three of them."""

MIN_DISTANCE_M = 0.15  #: Windows with a shorter path have no direction: poses scatter by a centimetre
MIN_WINDOWS = 20  #: So few windows show nothing of a session
STEADY_RAD = 0.1  #: Deviation from which a window counts less: wheels that spin, registrations that jump
ITERATIONS = 30  #: Of the reweighted least squares


def undo_hold(values: Array, time_s: Array, holds: Sequence[int]) -> Array:
    """Return held columns (n, c) as straight lines between the samples where they are new, if held for several.

    A value that stays for longer than the usual number of samples, one a column, was measured again and is the
    same: it is held until the usual time before the next one.

    Examples
    --------
    >>> undo_hold(np.array([[0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 8.0]]).T, np.arange(7.0), [2]).T.tolist()
    [[0.0, 0.0, 0.0, 2.0, 4.0, 6.0, 8.0]]
    """
    columns = []
    for column, held in zip(values.T, holds, strict=True):
        new = np.flatnonzero(np.diff(column, prepend=np.nan) != 0.0)
        known = np.sort(np.concatenate([new, new[1:][np.diff(new) > held] - held]))
        columns.append(np.interp(time_s, time_s[known], column[known]) if held > 1 else column)
    return np.column_stack(columns)


def usual_hold(values: Array, period_s: float) -> int:
    """Return the median samples from one new value (n stretches, k samples) to the next; 1: short or unknown.

    Examples
    --------
    >>> usual_hold(np.arange(40.0)[None] // 5, 0.05), usual_hold(np.arange(40.0)[None] // 2, 0.05)
    (5, 1)
    """
    usual = usual_wait(np.diff(values, axis=1) != 0.0)
    return usual if usual * period_s > MAX_HELD_S * (1.0 + 1e-6) else 1


def usual_wait(new: Array) -> int:
    """Return the median number of samples from one new value (n, k) to the next, at least 1."""
    stretch, sample = np.nonzero(new)
    waits = np.diff(sample)[np.diff(stretch) == 0]
    return max(int(np.median(waits)), 1) if waits.size else 1


def new_poses(pose: Array) -> Array:
    """Return (n, k) true where a pose (n, k, 3) is not the one before."""
    new = np.zeros(pose.shape[:2], dtype=bool)
    new[:, 1:] = (np.diff(pose, axis=1) != 0.0).any(axis=-1)
    return new & np.isfinite(pose).all(axis=-1)


def dated_poses(pose: Array, new: Array, scan: int) -> tuple[Array, Array, Array]:
    """Return when (m,) the usable new poses of a window (k, 3) are dated, these, yaw unwrapped, and when they came.

    A pose is of the time at which its registration began, when the one before came out: one that took longer than
    the usual wait ``scan`` is that much older.  (On sand, where a Warthog's waits are uneven, that takes the error of
    the yaw rate against the gyro from 0.44 to 0.24 rad/s.)  The first pose of a window that comes late is not used,
    since its age is unknown; nor are poses that come out of a queue or after an outage (:data:`OUTAGE_SCANS`,
    :data:`QUEUE`).
    """
    arrival = np.flatnonzero(new)
    came = pose[arrival]
    came[:, 2] = np.unwrap(came[:, 2])
    if not arrival.size:
        return arrival, came, arrival
    waited = np.diff(arrival, prepend=0)
    heads = np.concatenate([[True], waited[1:] > 1])  # of rows of poses that came sample by sample
    row = np.cumsum(heads) - 1
    queued = (waited[heads] >= OUTAGE_SCANS * scan) | (np.bincount(row) >= QUEUE)
    at = np.concatenate([arrival[:1], arrival[:-1] + scan])
    usable = ~queued[row] & (at < len(pose))
    usable[0] &= arrival[0] <= scan  # what came before the window is not known
    return at[usable], came[usable], arrival[usable]


def body_twists(pose: Array, period_s: float, frame_yaw: Array | None = None) -> tuple[Array, Array]:
    r"""Return speeds forward and to the left and yaw rate from poses that are held between two scans, and deviations.

    What the robot drove from one dated pose (:func:`dated_poses`) to the next, as an arc, is summed in its own axes,

    .. math:: \Delta s = \frac{\Delta\psi / 2}{\sin(\Delta\psi / 2)} R(-\bar\psi)\,\Delta p, \qquad
              \psi = \texttt{yaw} - \tfrac15 \textstyle\sum_{i<5} \texttt{yaw}_i ,

    with the mean heading :math:`\bar\psi` of the two, so that a steady twist is a straight line in time,
    however tight the turn; the sum over the first five is of the angles as published, with their jumps of a
    full turn.  A parabola is fitted to the sums within :data:`HALF_WIDTH_SCANS` usual waits of each sample,
    and its slope is the twist.  NaN where poses are too few or too much to one side for a slope
    (:data:`MAX_GAIN_PER_S`), as within three waits of a window's edge.

    Parameters
    ----------
    pose : (n, k, 3) x, y and yaw of n windows, as published; NaN where missing
    period_s : time from sample to sample
    frame_yaw : (n,) heading of the frame of the positions in that of the yaw; the mean over the first five
        by default, as the samples of DRIVE have it, 0 for poses in one fixed frame

    Returns
    -------
    twist : (n, k, 3) of the point that the pose is of, with the channels :data:`CHANNELS`
    std : (n, k, 3) its standard deviations by the scatter of the poses about the parabola; NaN where fewer than
        :data:`MIN_JUDGED_SCANS` poses show one

    Examples
    --------
    Half a metre a second, straight on:

    >>> pose = np.zeros((1, 40, 3))
    >>> pose[0, :, 0] = 0.5 * 0.1 * (np.arange(40) // 2)
    >>> body_twists(pose, 0.05)[0][0, 20].round(6).tolist()
    [0.5, 0.0, 0.0]
    """
    n, k, _ = pose.shape
    new = new_poses(pose)
    scan = usual_wait(new)
    weight, driven = np.zeros((n, k)), np.zeros((n, k, 3))
    if frame_yaw is None:
        frame_yaw = pose[:, :N_FRAME, 2].mean(axis=1)
    for window in range(n):
        at, came, _ = dated_poses(pose[window], new[window], scan)
        weight[window, at] = 1.0
        driven[window, at] = _driven(came, frame_yaw[window])
    half = HALF_WIDTH_SCANS * scan
    powers = (np.arange(-half, half + 1) / half)[:, None] ** np.arange(3)
    padding = [(0, 0), (half, half)]
    view = np.lib.stride_tricks.sliding_window_view
    width = 2 * half + 1
    products = (powers[:, :, None] * powers[:, None, :]).reshape(width, 9)
    normal = (view(np.pad(weight, padding), width, axis=1) @ products).reshape(n, k, 3, 3)
    seen = normal[..., 0, 0] >= 3.0
    inverse = np.full_like(normal, np.nan)
    inverse[seen] = np.linalg.inv(normal[seen])
    sums = np.swapaxes(view(np.pad(driven, [*padding, (0, 0)]), width, axis=1) @ powers, -1, -2)
    fitted = inverse @ sums
    slope = fitted[..., 1, :] / (half * period_s)
    with np.errstate(invalid="ignore"):
        gain_per_s = np.sqrt(inverse[..., 1, 1]) / (half * period_s)
        certain = gain_per_s <= MAX_GAIN_PER_S
        squares = view(np.pad(driven**2, [*padding, (0, 0)]), width, axis=1).sum(axis=-1)
        left = np.maximum(squares - (fitted * sums).sum(axis=-2), 0.0)
        judged = normal[..., 0, 0] >= MIN_JUDGED_SCANS
        spare = np.where(judged, normal[..., 0, 0] - 3.0, np.nan)
        std = np.sqrt(left / spare[..., None]) * gain_per_s[..., None]
    return np.where(certain[..., None], slope, np.nan), np.where(certain[..., None], std, np.nan)


def _driven(pose: Array, frame_yaw: float) -> Array:
    """Return distance forward, to the left, and yaw (m, 3), each from the first of the poses (m, 3)."""
    turned = np.diff(pose[:, 2])
    heading = pose[:-1, 2] + turned / 2 - frame_yaw
    cos, sin = np.cos(heading), np.sin(heading)
    chord = np.diff(pose[:, :2], axis=0) / np.sinc(turned / (2 * np.pi))[:, None]
    along = np.column_stack(
        [cos * chord[:, 0] + sin * chord[:, 1], cos * chord[:, 1] - sin * chord[:, 0], turned]
    )
    return np.concatenate([np.zeros((min(len(pose), 1), 3)), np.cumsum(along, axis=0)])


def frame_coefficient(pose: Array, wheels_mps: Array, period_s: float) -> tuple[float, float]:
    """Return a, and its standard deviation; NaN where too few windows turn and move.

    Windows whose published heading jumps by a turn within its first samples are left out: their mean is no heading.

    ``pose`` is (n, k, 3), as published; of the wheels' circumferential speeds (n, k, 2) the sign of the mean is used.
    """
    new = new_poses(pose)
    scan = usual_wait(new)
    rows = []
    for window, arrived, ahead_mps in zip(pose, new, np.nanmean(wheels_mps, axis=(1, 2)), strict=True):
        at, came, _ = dated_poses(window, arrived, scan)
        if len(came) < 4 or np.abs(np.diff(window[: N_FRAME + 1, 2])).max() > np.pi / 2:
            continue
        yaw = came[:, 2]
        chords = np.diff(came[:, 0] + 1j * came[:, 1]) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
        path = np.sign(ahead_mps) * chords.sum()
        if abs(path) >= MIN_DISTANCE_M:
            rate = (yaw[-1] - yaw[0]) / (np.ptp(at) * period_s)
            first = window[:N_FRAME, 2].mean() - window[0, 2]
            rows.append((float(np.angle(path)), first, rate, min(abs(path), 1.0)))
    if len(rows) < MIN_WINDOWS:
        return np.nan, np.nan
    direction, first, turned, weight = np.array(rows).T
    terms = np.column_stack([first, turned, np.ones(len(rows))])
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


def is_first_pose(pose: Array, wheels_mps: Array, period_s: float) -> bool:
    """Return whether positions are in the frame of the first pose: a is 0 beyond doubt, and -1 is not."""
    coefficient, std = frame_coefficient(pose, wheels_mps, period_s)
    return bool(abs(coefficient) < 3.0 * std and coefficient + 1.0 > 3.0 * std)
