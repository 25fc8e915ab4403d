r"""Reader of the Husky log of DRIVE: random wheel commands in, lidar pose out.

``samples.csv.gz`` holds windows of 40 samples at 20 Hz (Baril et al., DRIVE: Data-driven Robot Input Vector
Exploration, ICRA 2024; repository norlab-ulaval/DRIVE, ``calib_data/test_husky``).  Three windows belong to
a command, one while the robot changes its speed (``steady`` 0) and two after (``steady`` 1): they become a
run ``step_000``, ``step_001``, ...  Terrain is not published, so no run has a label.

============  ==========================================  ===============================================
stream        channels                                    from
============  ==========================================  ===============================================
``wheels``    ``speed_left_mps speed_right_mps``          ``wheel_left wheel_right`` (rad/s) times the
                                                          maker's wheel radius, 0.165 m
``imu``       ``gyro_z_radps``                            ``imu_yaw``, a rate and no angle
\             ``accel_x_mps2 accel_y_mps2 accel_z_mps2``  ``-imu_ax -imu_ay imu_az``, specific force
``lidar``     ``speed_x_mps speed_y_mps yaw_rate_radps``  ``icp_x icp_y icp_yaw``, see :func:`body_twists`
``commands``  ``wheel_left_radps wheel_right_radps``      ``cmd_left cmd_right`` as published
============  ==========================================  ===============================================

Little of the file is documented.  What is assumed here was held against the other columns:

- *Windows* follow on one another, and so do commands.  The one after a change of speed begins a sample
  late (wheel speeds, which are new every second sample, repeat across that edge in 15 % of the cases, and
  in 50 % elsewhere); into the last one of five begins with the sample before it, which is read once.
  Within a window the clock is the nominal one; at its edge it is accurate to one sample.
- *Runs* begin where ``steady`` falls to 0.  ``step`` of such a window may still be the one before (62 of
  201), so that the windows after it number the run.
- ``imu_yaw`` is the rate of ``icp_yaw`` (slope 1.00, offset 2 mrad/s).  The accelerometer is turned by half
  a turn about z: speeding up and turning left both read negative, and the tilt of the lidar pose agrees.
- ``icp_yaw`` is a difference of two wrapped angles, and the position of a window is turned by the mean of
  the first five of them, not by the first: ``icp_x`` points along the mean heading of the first 0.25 s.
  Where the heading wraps within these (11 windows) that mean is no direction that the robot ever had.
- *Late*: the lidar lags the gyro by 0.16 s; after that their yaw rates agree to 0.03 rad/s rms.  The wheel
  speeds lag the gyro by 0.26 s while speeds change.  Both are held from one message to the next, about
  0.1 s.  Times are as logged; nothing is shifted.
- ``cmd_*`` are no wheel speeds: below its limits the robot drives 1.8 times as fast forward and turns its
  wheels 0.8 times as fast against each other.  Commands go up to 14.7 rad/s, steady wheels to 6.1 rad/s.
- ``steady``, ``icp_z``, ``icp_roll`` and ``icp_pitch`` are left out: the first says which window of a
  command it is, the others are relative to each window's own start.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from terrain.errors import LogError
from terrain.logs.csv_table import data_row, read_columns, short_name
from terrain.logs.samples import checked_stream
from terrain.records import Array, RunLog

FILE_NAME = "samples.csv.gz"

WHEEL_RADIUS_M = 0.165
"""Nominal radius of a Husky A200 wheel, as the maker has it."""

STREAMS: dict[str, dict[str, tuple[str, float]]] = {
    "wheels": {
        "speed_left_mps": ("wheel_left", WHEEL_RADIUS_M),
        "speed_right_mps": ("wheel_right", WHEEL_RADIUS_M),
    },
    "imu": {
        "gyro_z_radps": ("imu_yaw", 1.0),
        "accel_x_mps2": ("imu_ax", -1.0),
        "accel_y_mps2": ("imu_ay", -1.0),
        "accel_z_mps2": ("imu_az", 1.0),
    },
    "commands": {
        "wheel_left_radps": ("cmd_left", 1.0),
        "wheel_right_radps": ("cmd_right", 1.0),
    },
}
"""Column and factor of each channel that is read as it stands."""

TWIST_CHANNELS: tuple[str, ...] = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
"""Channels of the stream ``lidar``."""

HALF_WIDTH_S = 0.3
"""Poses to either side that a speed is fitted to: about six."""

OUTAGE_S = 0.2
"""A pose that was waited for so long (two scans) is stale when it comes, and so are those right behind."""

QUEUE = 3
"""So many new poses in as many samples come out of a queue, since a scan takes two samples."""

MAX_GAIN_PER_S = 4.0
"""Largest standard deviation of a speed for each unit of the pose's; 2.3 in the middle of a window."""

_KEYS = ("step", "window", "steady", "time")
_POSE = ("icp_x", "icp_y", "icp_yaw")
_N_FRAME = 5  # samples whose mean heading the authors turned the positions of a window by
_MAX_OVERLAP = 5  # samples; 3 is the most that is there


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """The whole file: n windows of k samples."""

    name: str
    step: Array  # (n,)
    steady: Array  # (n,)
    time_s: Array  # (k,) within a window
    values: dict[str, Array]  # by stream (n, k, channels)


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per command of the file ``samples.csv.gz`` in ``folder``; call it with ``repair=``.

    The list is empty when there is no such file.  The file is read at once, for all of them.

    Raises
    ------
    LogError
        if the file is broken or lacks a column, holds a cell that is no number, or windows that are not
        all sampled alike.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return []
    windows = _read_windows(path)
    starts = np.flatnonzero(windows.steady == 0)
    if starts.size == 0 or starts[0] != 0:
        raise LogError(f"{windows.name}: the first window has steady 1; a command begins with steady 0")
    ends = [*starts[1:].tolist(), len(windows.steady)]
    return [partial(_run, windows, start, end) for start, end in zip(starts.tolist(), ends, strict=True)]


def body_twists(pose: Array, period_s: float) -> Array:
    r"""Return speeds forward and to the left and yaw rate from poses that are held between two scans.

    A parabola is fitted to the poses within :data:`HALF_WIDTH_S` of each sample, each pose counted once,
    when it is new.  Its slope is turned into the body's axes by its heading,

    .. math:: v = R(-\psi)\,\dot p, \qquad
              \psi = \texttt{yaw} - \tfrac15 \textstyle\sum_{i<5} \texttt{yaw}_i ,

    the sum being over the angles as published, with their jumps of a full turn.

    NaN where poses are too few or too much to one side for a slope (:data:`MAX_GAIN_PER_S`), as within
    about 0.3 s of a window's edge.  The first pose of a window is not used, since its age is
    unknown; nor are poses that come out of a queue, as after an outage (:data:`OUTAGE_S`, :data:`QUEUE`).
    On the published file 65 % of the samples have a twist.  Poses scatter about their parabola by 19 mm
    forward, 5 mm sideways and 3 mrad, hence the twist by 0.05 m/s, 0.012 m/s and 0.007 rad/s.

    Parameters
    ----------
    pose : (n, k, 3) ``icp_x``, ``icp_y`` and ``icp_yaw`` of n windows, as published; NaN where missing
    period_s : time from sample to sample

    Returns
    -------
    (n, k, 3) of the point that the pose is of, with the channels :data:`TWIST_CHANNELS`

    Examples
    --------
    Half a metre a second, straight on:

    >>> pose = np.zeros((1, 40, 3))
    >>> pose[0, :, 0] = 0.5 * 0.1 * (np.arange(40) // 2)
    >>> body_twists(pose, 0.05)[0, 20].round(6).tolist()
    [0.5, 0.0, 0.0]
    """
    n, k, _ = pose.shape
    frame_yaw = pose[:, :_N_FRAME, 2].mean(axis=1)
    dated = _dated(pose, period_s)
    turned = pose.copy()
    known = np.isfinite(pose[..., 2])
    for window in range(n):
        turned[window, known[window], 2] = np.unwrap(pose[window, known[window], 2])
    half = round(HALF_WIDTH_S / period_s)
    lag = np.arange(-half, half + 1) / half
    powers = lag[:, None] ** np.arange(3)
    padding = [(0, 0), (half, half)]
    weight = np.pad(dated, padding).astype(np.float64)
    weighted = np.pad(np.where(dated[..., None], turned, 0.0), [*padding, (0, 0)])
    view = np.lib.stride_tricks.sliding_window_view
    width = 2 * half + 1
    products = (powers[:, :, None] * powers[:, None, :]).reshape(width, 9)
    normal = (view(weight, width, axis=1) @ products).reshape(n, k, 3, 3)
    seen = normal[..., 0, 0] >= 3.0
    inverse = np.full_like(normal, np.nan)
    inverse[seen] = np.linalg.inv(normal[seen])
    # of the parabola: (n, k, power, channel of the pose)
    curve = inverse @ np.swapaxes(view(weighted, width, axis=1) @ powers, -1, -2)
    with np.errstate(invalid="ignore"):
        certain = np.sqrt(inverse[..., 1, 1]) / (half * period_s) <= MAX_GAIN_PER_S
    slope = np.where(certain[..., None], curve[..., 1, :] / (half * period_s), np.nan)
    heading = curve[..., 0, 2] - frame_yaw[:, None]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack(
        [
            cos * slope[..., 0] + sin * slope[..., 1],
            cos * slope[..., 1] - sin * slope[..., 0],
            slope[..., 2],
        ],
        axis=-1,
    )


def _dated(pose: Array, period_s: float) -> Array:
    """Return (n, k) true where a pose is new and was not delayed in a queue."""
    new = np.zeros(pose.shape[:2], dtype=bool)
    new[:, 1:] = (np.diff(pose, axis=1) != 0.0).any(axis=-1)
    new &= np.isfinite(pose).all(axis=-1)
    window, sample = np.nonzero(new)
    first = np.diff(window, prepend=-1) != 0
    waited = np.where(first, sample, np.diff(sample, prepend=0))
    heads = first | (waited > 1)  # of rows of poses that came sample by sample
    row = np.cumsum(heads) - 1
    queued = (waited[heads] >= round(OUTAGE_S / period_s)) | (np.bincount(row) >= QUEUE)
    dated = np.zeros_like(new)
    dated[window, sample] = ~queued[row]
    return dated


def _run(windows: _Windows, start: int, end: int, *, repair: bool = False) -> RunLog:
    """Return the run of the windows ``start`` to ``end``, the last not included."""
    if end - start < 2:
        raise LogError(
            f"{windows.name}: the command of step {windows.step[start]} has one window only, "
            f"at least one with steady 1 must follow it"
        )
    steps = np.unique(windows.step[start + 1 : end])
    if steps.size > 1:
        raise LogError(
            f"{windows.name}: the windows of one command have the steps {', '.join(map(str, steps))}"
        )
    kept, time_s = _on_one_clock(windows, start, end)
    run_id = f"step_{steps[0]:03d}"
    dropped: Counter[str] = Counter()
    streams = {}
    for name, values in windows.values.items():
        is_lidar = name == "lidar"
        columns = () if is_lidar else [column for column, _ in STREAMS[name].values()]
        streams[name] = checked_stream(
            f"{windows.name}, {run_id}",
            time_s,
            values[start:end][kept],
            TWIST_CHANNELS if is_lidar else list(STREAMS[name]),
            row_of=int,  # times are made here: no row is at fault
            columns=columns,
            repairs=dropped if repair else None,
            unknown_is_a_value=is_lidar,
        )
    return RunLog(
        run_id, "husky", streams, source=f"{windows.name}, step {steps[0]}, DRIVE layout", dropped=dropped
    )


def _on_one_clock(windows: _Windows, start: int, end: int) -> tuple[Array, Array]:
    """Return which samples (windows, k) to keep, and the time of these from the first one of the run."""
    time_s = windows.time_s
    period_s = float(time_s[1] - time_s[0])
    logged = np.concatenate([windows.values[name][start:end] for name in ("wheels", "imu")], axis=-1)
    kept = np.ones(logged.shape[:2], dtype=bool)
    at_s = np.zeros(end - start)
    for i in range(1, end - start):
        before, after = logged[i - 1], logged[i]
        lengths = range(1, _MAX_OVERLAP + 1)
        if np.array_equal(before[-2], before[-1], equal_nan=True):
            lengths = range(0)  # a row that was held says nothing
        again = max((n for n in lengths if np.array_equal(before[-n:], after[:n], equal_nan=True)), default=0)
        kept[i, :again] = False
        lost = 1 if windows.steady[start + i - 1] == 0 and not again else 0
        at_s[i] = at_s[i - 1] + (time_s.size - again + lost) * period_s
    return kept, (at_s[:, None] + time_s - time_s[0])[kept]


def _read_windows(path: Path) -> _Windows:
    sources = {name: list(columns.values()) for name, columns in STREAMS.items()}
    read = [*_KEYS, *_POSE, *(column for pairs in sources.values() for column, _ in pairs)]
    table = read_columns(path, read)
    keys = _checked_keys(path, table[:, : len(_KEYS)])
    n, k, _ = keys.shape
    time_s = keys[0, :, 3]
    period_s = round(float(time_s[-1] - time_s[0]) / (k - 1), 9)
    columns = dict(zip(read, table.T.reshape(-1, n, k), strict=True))
    values = {
        name: np.stack([columns[column] * factor for column, factor in pairs], axis=-1)
        for name, pairs in sources.items()
    }
    values["lidar"] = body_twists(np.stack([columns[name] for name in _POSE], axis=-1), period_s)
    step, steady = (keys[:, 0, i].astype(np.int64) for i in (0, 2))
    return _Windows(short_name(path), step, steady, np.arange(k) * period_s, values)


def _checked_keys(path: Path, keys: Array) -> Array:
    """Return step, window, steady and time as (n, k, 4), or say which window is not as the others."""
    name = short_name(path)
    if not len(keys):
        raise LogError(f"{name}: has no rows of data")
    for row, key in np.argwhere(~np.isfinite(keys)):
        raise LogError(
            f"{name}: {_KEYS[key]} at row {data_row(path, int(row))} is not finite ({keys[row, key]})"
        )
    starts = np.flatnonzero(np.diff(keys[:, 1], prepend=np.nan) != 0.0)
    sizes = np.diff(starts, append=len(keys))
    windows = [f"window {number:.15g}" for number in keys[starts, 1]]
    k = int(sizes[0])
    for i in np.flatnonzero(sizes != k):
        raise LogError(f"{name}: {windows[i]} has {sizes[i]} samples, the first one has {k}")
    if k <= _N_FRAME:
        raise LogError(f"{name}: windows have {k} samples, more than {_N_FRAME} are needed")
    keys = keys.reshape(-1, k, len(_KEYS))
    time_s = keys[0, :, 3]
    period_s = (time_s[-1] - time_s[0]) / (k - 1)
    if period_s <= 0.0 or np.ptp(np.diff(time_s)) > 1e-3 * period_s:
        raise LogError(f"{name}: time does not rise evenly in {windows[0]}")
    for i in np.flatnonzero(np.abs(keys[..., 3] - time_s).max(axis=1) > 1e-3 * period_s):
        raise LogError(f"{name}: time in {windows[i]} is not that of {windows[0]}")
    for key, accepted, highest in ((0, "one whole number from 0 up", np.inf), (2, "0 or 1 throughout", 1.0)):
        value = keys[..., key]
        first = value[:, :1]
        fits = (value == first) & (first == np.floor(first)) & (first >= 0.0) & (first <= highest)
        for i in np.flatnonzero(~fits.all(axis=1)):
            found = ", ".join(f"{v:.15g}" for v in np.unique(value[i]))
            raise LogError(f"{name}: {_KEYS[key]} in {windows[i]} is {found}; it must be {accepted}")
    return keys
