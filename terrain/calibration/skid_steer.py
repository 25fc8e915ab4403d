r"""Rolling radius, effective track and delays of a skid-steer or tracked robot, from lidar poses and wheels.

Over steady stretches of a second, with the speeds of the sides by the described wheel radius r,

.. math:: v_{lidar} = (1 - s) \frac{\rho}{r} \frac{v_l + v_r}{2}, \qquad
          \omega_{lidar} = \frac{v_r - v_l}{B} ,

where rho is the rolling radius of a tyre under its load (of a track that of the sprocket), s the slip of a
side that drives straight on, and B the effective track, skidding included (Mandow et al., Experimental
kinematics for wheeled skid-steer mobile robots, IROS 2007).  Radius and slip are separated by an assumption
on s alone: :data:`SLIP_RATIO` on hard ground, where a tyre rolls on, :data:`SOFT_SLIP_RATIO` elsewhere; the
interval holds all of it.  B goes with r: with another described radius it scales alike, and it is one of the
terrain and of the turns driven.

Delays are those at which yaw rates agree best: of lidar and wheels behind the gyro, of the lidar behind the
wheels where there is no gyro.

Intervals come from a jackknife over sessions, which share weather, ground and mounting, or over runs where
there are too few sessions: then the next outing may differ by more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean

from terrain.calibration.finding import Finding, around, undetermined
from terrain.identify import half_width, jackknife
from terrain.records import Array, RunLog
from terrain.signals import peak

#: Of tyres that drive straight on over hard ground: a rolling resistance of 0.02 to 0.04 of the load over a slip
#: stiffness of 2 to 10 loads.
SLIP_RATIO = (0.0, 0.02)
#: Of tyres or tracks elsewhere: assumed, since nothing in a log tells it from the radius.
SOFT_SLIP_RATIO = (0.0, 0.05)
STRETCH_S = 1.0
#: Streams are brought to one grid: lidar twists are fits over 0.6 s, faster motion is not in them.
GRID_S = 0.05
MAX_SPEED_CHANGE_MPS = 0.05
#: From one half of a steady stretch to the other, of the mean and of the difference of the sides.
MAX_TURN_CHANGE_MPS = 0.1
#: Least part of a stretch for which the lidar has a twist: windows of DRIVE lack them at their edges.
MIN_SEEN = 0.5
MIN_SPEED_MPS = 0.4
MAX_CURVATURE_PER_M = 0.15  #: Slower, or in a tighter curve, it is not straight driving.
MIN_YAW_RATE_RADPS = 0.15  #: Slower turns are as small as their errors.
TRIMMED = 0.2  #: Part of the stretches that is left out at either end: wheels that spin, poses that jump.
MAX_DELAY_S = 1.0
MIN_GROUPS = 4
#: A fifth of a sample of logs at 20 Hz: no number of runs makes an interval narrower.
DELAY_RESOLUTION_S = 0.01
#: Of squares of yaw rates in rad^2/s^2, over a run: less are no turns, and show no delay.
MIN_TURN_SUM = 0.5
RADIUS, TRACK = "identified.rolling_radius_m", "identified.effective_track_m"
LIDAR_DELAY, WHEELS_DELAY = "identified.lidar_delay_s", "identified.wheels_delay_s"


class Driven(NamedTuple):
    """A run on an even grid: sides (n, 2) in m/s, gyro (n,), twist (n, 3) of the lidar; NaN where unknown."""

    run_id: str
    session: str
    sides_mps: Array
    gyro_radps: Array
    twist: Array


def driven(run: RunLog) -> Driven | None:
    """Return a run on the grid of this module; None where it has no lidar or no sides."""
    wheels, lidar = run.streams.get("wheels"), run.streams.get("lidar")
    sides = ("speed_left_mps", "speed_right_mps")
    twist = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    if wheels is None or lidar is None or not set(sides) <= set(wheels.channels):
        return None
    grid_s = np.arange(wheels.time_s[0], wheels.time_s[-1], GRID_S)
    imu = run.streams.get("imu")
    gyro = np.full(len(grid_s), np.nan)
    if imu is not None and "gyro_z_radps" in imu.channels:
        gyro = np.interp(grid_s, imu.time_s, imu.channel("gyro_z_radps"), left=np.nan, right=np.nan)
    return Driven(
        run.run_id,
        run.session,
        np.column_stack([np.interp(grid_s, wheels.time_s, wheels.channel(name)) for name in sides]),
        gyro,
        np.column_stack([np.interp(grid_s, lidar.time_s, lidar.channel(name)) for name in twist]),
    )


class Summary(NamedTuple):
    """What one run shows."""

    run_id: str  #: of the run
    session: str
    #: (m, 4) of steady ones: mean and difference of the sides, speed and yaw rate of the lidar
    stretches: Array
    lidar_sums: Array  #: (lags, 3) sums of products and squares of yaw rates at each lag
    wheels_sums: Array


def identify(runs: Sequence[RunLog], wheel_radius_m: float, hard: Sequence[str]) -> list[Finding]:
    """Return rolling radius, effective track and delays, or why these runs do not determine them.

    Runs of one robot that are labelled as hard ground are used, all of them where no run has a label; the described
    wheel radius is that by which the runs' wheel speeds were made.
    """
    labelled = any(run.labels for run in runs)
    chosen = [run for run in runs if not labelled or (run.terrains and set(run.terrains) <= set(hard))]
    found = [each for run in chosen if (each := driven(run)) is not None]
    names = [RADIUS, TRACK, LIDAR_DELAY, WHEELS_DELAY]
    if not found:
        why = "no run has the streams lidar and wheels"
        if labelled and not chosen:
            why = f"no run is labelled as hard ground ({', '.join(hard)})"
        return undetermined(names, why)
    any_gyro = any(np.isfinite(each.gyro_radps).any() for each in found)
    summaries = [_summary(each, any_gyro) for each in found]
    delay_s, _ = _lidar_delay(summaries)
    shift = max(round(delay_s / GRID_S), 0) if math.isfinite(delay_s) else 0
    summaries = [
        summary._replace(stretches=_steady(each, shift))
        for summary, each in zip(summaries, found, strict=True)
    ]
    groups = _groups(summaries)
    low, high = SLIP_RATIO if labelled else SOFT_SLIP_RATIO
    where = "hard ground" if labelled else "unlabelled ground"
    rolling = _jackknifed(
        RADIUS,
        groups,
        lambda some: _trimmed(wheel_radius_m * _straight(some)),
        f"slip of {100 * low:g} to {100 * high:g} % assumed in straight driving on {where}: only the radius "
        "less the slip is to be seen",
    )
    rolling = rolling._replace(
        value=rolling.value * (1 / (1 - low) + 1 / (1 - high)) / 2,
        low=rolling.low / (1 - low),
        high=rolling.high / (1 - high),
    )
    track_note = f"skidding included, by the described radius, on {where}"
    behind = "behind the gyro" if any_gyro else "behind the wheels: there is no gyro"
    wheels_delay = _jackknifed(WHEELS_DELAY, groups, _wheels_delay, behind)
    if not any_gyro:
        (wheels_delay,) = undetermined([WHEELS_DELAY], "there is no gyro")
    return [
        rolling,
        _jackknifed(TRACK, groups, _track, track_note),
        _jackknifed(LIDAR_DELAY, groups, _lidar_delay, behind),
        wheels_delay,
    ]


def _groups(found: Sequence[Summary]) -> list[list[Summary]]:
    """Return the runs by session, or one by one where there are too few sessions."""
    sessions: dict[str, list[Summary]] = {}
    for each in found:
        sessions.setdefault(each.session, []).append(each)
    if "" not in sessions and len(sessions) >= MIN_GROUPS:
        return list(sessions.values())
    return [[each] for each in found]


def _jackknifed(
    name: str,
    groups: Sequence[list[Summary]],
    estimate: Callable[[Sequence[Summary]], tuple[float, int]],
    note: str,
) -> Finding:
    """Return an estimate with the interval of a jackknife over those groups that take part in it."""
    used = [group for group in groups if estimate(group)[1]]
    k = len(used)
    if k < MIN_GROUPS:
        reason = (
            f"{k} runs or sessions show it: {MIN_GROUPS} at least, of steady driving straight on and in turns"
        )
        return undetermined([name], reason)[0]
    value, n = estimate([each for group in used for each in group])
    std = jackknife(lambda some: estimate([each for i in some for each in used[i]])[0], k)
    of_grid = DELAY_RESOLUTION_S if name in (LIDAR_DELAY, WHEELS_DELAY) else 0.0
    half = math.hypot(float(half_width(std, k - 1)), of_grid)
    if not math.isfinite(value) or not math.isfinite(half):
        return undetermined([name], "nothing in the runs shows it")[0]
    runs = tuple(each.run_id for group in used for each in group)
    counted = "steady stretches" if name in (RADIUS, TRACK) else "runs"
    return around(name, value, half, n, counted, runs, note)


def _summary(run: Driven, any_gyro: bool) -> Summary:
    wheels = run.sides_mps[:, 1] - run.sides_mps[:, 0]
    first = run.gyro_radps if any_gyro else wheels
    return Summary(
        run.run_id,
        run.session,
        np.empty((0, 4)),
        _lagged_sums(first, run.twist[:, 2]),
        _lagged_sums(first, wheels),
    )


def _lagged_sums(first: Array, late: Array) -> Array:
    """Return sums (lags, 3) of the products and squares of two signals, one later by each lag."""
    n = round(MAX_DELAY_S / GRID_S)
    sums = np.zeros((2 * n + 1, 3))
    for i, lag in enumerate(range(-n, n + 1)):
        a, b = (first[: len(first) - lag], late[lag:]) if lag >= 0 else (first[-lag:], late[:lag])
        there = np.isfinite(a) & np.isfinite(b)
        a, b = a[there], b[there]
        sums[i] = a @ b, a @ a, b @ b
    return sums


def _steady(run: Driven, shift: int) -> Array:
    """Return the steady stretches (m, 4) of :class:`Summary`, with the lidar earlier by ``shift`` samples.

    A lidar's twists may have holes: what is averaged are the samples that it has, half of them at least.
    """
    n = round(STRETCH_S / GRID_S)
    length = len(run.sides_mps) - shift
    if length < n:
        return np.empty((0, 4))
    sides, twist = run.sides_mps[:length], run.twist[shift : shift + length]
    table = np.column_stack([sides.mean(axis=1), sides[:, 1] - sides[:, 0], twist[:, 0], twist[:, 2]])
    parts = table[: length // n * n].reshape(-1, n, 4)
    change = np.abs(parts[:, : n // 2, :2].mean(axis=1) - parts[:, n // 2 :, :2].mean(axis=1))
    seen = np.isfinite(parts).all(axis=2)
    steady = (change <= (MAX_SPEED_CHANGE_MPS, MAX_TURN_CHANGE_MPS)).all(axis=1)
    steady &= seen.mean(axis=1) >= MIN_SEEN
    weight = seen[steady][..., None] / seen[steady].sum(axis=1)[:, None, None]
    return np.asarray((np.nan_to_num(parts[steady]) * weight).sum(axis=1))


def _straight(some: Sequence[Summary]) -> Array:
    """Return the speed of the lidar over that of the wheels of straight stretches."""
    speed, _, forward, turn = np.concatenate([each.stretches for each in some]).T
    straight = (np.abs(speed) >= MIN_SPEED_MPS) & (np.abs(turn) <= MAX_CURVATURE_PER_M * np.abs(speed))
    return np.asarray(forward[straight] / speed[straight])


def _trimmed(values: Array) -> tuple[float, int]:
    """Return the trimmed mean and the number of values; a jackknife does not judge a median right."""
    return (float(trim_mean(values, TRIMMED)) if len(values) else math.nan), len(values)


def _track(some: Sequence[Summary]) -> tuple[float, int]:
    """Return the difference of the sides over the yaw rate of stretches that turn, and how many they are."""
    stretches = np.concatenate([each.stretches for each in some])
    _, across, _, turn = stretches[np.abs(stretches[:, 3]) >= MIN_YAW_RATE_RADPS].T
    return (float(across @ turn / (turn @ turn)) if len(turn) else math.nan), len(turn)


def _lidar_delay(some: Sequence[Summary]) -> tuple[float, int]:
    return _best_lag([each.lidar_sums for each in some])


def _wheels_delay(some: Sequence[Summary]) -> tuple[float, int]:
    return _best_lag([each.wheels_sums for each in some])


def _best_lag(of_runs: Sequence[Array]) -> tuple[float, int]:
    """Return the lag in s at which two yaw rates are most alike, and the number of runs that show them."""
    n = round(MAX_DELAY_S / GRID_S)
    turning = [sums for sums in of_runs if sums[:, 1:].min() > 0.0 and sums[n, 1] >= MIN_TURN_SUM]
    if not turning:
        return math.nan, 0
    products, one, other = np.sum(turning, axis=0).T
    lags_s = GRID_S * np.arange(-n, n + 1)
    best_s = peak(lags_s, products / np.sqrt(one * other))
    return (best_s if abs(best_s) < lags_s[-1] else math.nan), len(turning)
