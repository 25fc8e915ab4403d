r"""Rolling radius, effective track and delays of a skid-steer or tracked robot, from lidar poses and wheels.

Over steady stretches of a second, with the speeds of the sides by the described wheel radius r,

.. math:: v_{lidar} = (1 - s) \frac{\rho}{r} \frac{v_l + v_r}{2}, \qquad
          \omega_{lidar} = \frac{v_r - v_l}{B} ,

where rho is the rolling radius of a tyre under its load (of a track that of the sprocket), s the slip of a
side that drives straight on, and B the effective track, skidding included (Mandow et al., Experimental
kinematics for wheeled skid-steer mobile robots, IROS 2007).  Radius and slip are separated by an assumption
on s alone: :data:`SLIP_RATIO` on hard ground, where a tyre rolls on, :data:`SOFT_SLIP_RATIO` elsewhere.  B goes with
r: with another described radius it scales alike, and it is one of the terrain and of the turns driven.

Delays are those at which yaw rates agree best: of lidar and wheels behind the gyro, of the lidar behind the
wheels where there is no gyro.  What is assumed (the slip, the resolution of a delay) is in the intervals as an error
anywhere within its bounds.

Intervals come from a jackknife over sessions, which share weather, ground and mounting, or over runs where
there are too few sessions: then the next outing may differ by more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean

from terrain.calibration.finding import Finding, around, undetermined
from terrain.identify import half_width, jackknife
from terrain.logs.schema import TWIST
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
N_LAGS = round(1.0 / GRID_S)  #: That are searched to either side.
MIN_GROUPS = 4
#: By which a parabola through three lags is off at some phase of the grid.  What the lidar's 10 Hz leave between
#: samples differs from turn to turn, and is in the scatter of the runs.
RESOLUTION_S = 0.001
#: Of squares of yaw rates in rad^2/s^2, over a run: less are no turns, and show no delay.
MIN_TURN_SUM = 0.5
RADIUS, TRACK = "identified.rolling_radius_m", "identified.effective_track_m"
LIDAR_DELAY, WHEELS_DELAY = "identified.lidar_delay_s", "identified.wheels_delay_s"


class Driven(NamedTuple):
    """A run on an even grid."""

    run_id: str  #: of the run
    session: str
    sides_mps: Array  #: (n, 2)
    gyro_radps: Array  #: (n,) NaN where unknown, and the twist (n, 3) of the lidar
    twist: Array
    lags: tuple[Array, Array] = (np.empty(0), np.empty(0))  #: :func:`lagged_sums` of lidar and wheels
    stretches: Array = np.empty((0, 4))  #: (m, 4) steady ones: mean, difference of the sides, speed, yaw rate


def driven(run: RunLog) -> Driven | None:
    """Return a run on the grid of this module; None where it has no lidar or no sides."""
    wheels, lidar = run.streams.get("wheels"), run.streams.get("lidar")
    sides = ("speed_left_mps", "speed_right_mps")
    if wheels is None or lidar is None or not set(sides) <= set(wheels.channels):
        return None
    grid_s = np.arange(wheels.time_s[0], wheels.time_s[-1], GRID_S)
    imu, gyro = run.streams.get("imu"), np.full(len(grid_s), np.nan)
    if imu is not None and "gyro_z_radps" in imu.channels:
        gyro = np.interp(grid_s, imu.time_s, imu.channel("gyro_z_radps"), left=np.nan, right=np.nan)
    speeds, twist = (
        np.column_stack([np.interp(grid_s, stream.time_s, stream.channel(name)) for name in names])
        for stream, names in ((wheels, sides), (lidar, TWIST))
    )
    return Driven(run.run_id, run.session, speeds, gyro, twist)


def identify(runs: Sequence[RunLog], wheel_radius_m: float, hard: Sequence[str]) -> list[Finding]:
    """Return rolling radius, effective track and delays, or why these runs do not determine them.

    Runs of one robot that are labelled as hard ground are used, all of them where no run has a label; the described
    wheel radius is that by which the runs' wheel speeds were made.
    """
    labelled = any(run.labels for run in runs)
    chosen = [run for run in runs if not labelled or (run.terrains and set(run.terrains) <= set(hard))]
    logs = [log for run in chosen if (log := driven(run)) is not None]
    if not logs:
        why = "no run has the streams lidar and wheels"
        if labelled and not chosen:
            why = f"no run is labelled as hard ground ({', '.join(hard)})"
        return undetermined([RADIUS, TRACK, LIDAR_DELAY, WHEELS_DELAY], why)
    any_gyro = any(np.isfinite(log.gyro_radps).any() for log in logs)
    for i, log in enumerate(logs):
        turn = np.diff(log.sides_mps, axis=1)[:, 0]
        first = log.gyro_radps if any_gyro else turn
        logs[i] = log._replace(lags=(lagged_sums(first, log.twist[:, 2]), lagged_sums(first, turn)))
    delay_s = best_lag(0, logs)[0]
    shift = max(round(delay_s / GRID_S), 0) if math.isfinite(delay_s) else 0
    logs = [log._replace(stretches=steady_stretches(log, shift)) for log in logs]
    sessions: dict[str, list[Driven]] = {}
    for log in logs:
        sessions.setdefault(log.session, []).append(log)
    groups = list(sessions.values())
    if "" in sessions or len(groups) < MIN_GROUPS:
        groups = [[log] for log in logs]
    low, high = SLIP_RATIO if labelled else SOFT_SLIP_RATIO
    least, most = wheel_radius_m / (1 - low), wheel_radius_m / (1 - high)
    where = "hard ground" if labelled else "unlabelled ground"
    behind = "behind the gyro" if any_gyro else "behind the wheels: there is no gyro"
    assumed = (
        f"slip of {100 * low:g} to {100 * high:g} % assumed in straight driving on {where}: only the radius "
        "less the slip is to be seen"
    )
    rows: list[tuple[str, Callable[[Sequence[Driven]], tuple[float, int]], str, float, str]] = [
        (
            RADIUS,
            partial(rolling_radius, (least + most) / 2),
            "steady stretches",
            (most - least) / 2,
            assumed,
        ),
        (TRACK, track, "steady stretches", 0.0, f"skidding included, by the described radius, on {where}"),
        (LIDAR_DELAY, partial(best_lag, 0), "runs", RESOLUTION_S, behind),
        (WHEELS_DELAY, partial(best_lag, 1), "runs", RESOLUTION_S, behind),
    ]
    findings = [over_groups(groups, *row) for row in rows]
    return findings if any_gyro else [*findings[:3], *undetermined([WHEELS_DELAY], "there is no gyro")]


def over_groups(
    groups: Sequence[list[Driven]],
    name: str,
    estimate: Callable[[Sequence[Driven]], tuple[float, int]],
    counted: str,
    bounded: float,
    note: str,
) -> Finding:
    """Return an estimate with the interval of a jackknife over those groups that take part in it.

    An estimate gives its value, and how many of what is counted it is from; ``bounded`` is on either side of it.
    """
    used = [group for group in groups if estimate(group)[1]]
    k = len(used)
    if k < MIN_GROUPS:
        return undetermined(
            [name],
            f"{k} runs or sessions show it: {MIN_GROUPS} at least, of steady driving straight on and in turns",
        )[0]
    every = [log for group in used for log in group]
    value, n = estimate(every)
    std = jackknife(lambda some: estimate([log for i in some for log in used[i]])[0], k)
    half = float(half_width(std, k - 1, bounded=bounded))
    if not math.isfinite(value) or not math.isfinite(half):
        return undetermined([name], "nothing in the runs shows it")[0]
    return around(name, value, half, n, counted, [log.run_id for log in every], note)


def lagged_sums(first: Array, late: Array) -> Array:
    """Return sums (lags, 3) of the products and squares of two signals, one later by each lag."""
    sums = []
    for lag in range(-N_LAGS, N_LAGS + 1):
        a, b = (first[: len(first) - lag], late[lag:]) if lag >= 0 else (first[-lag:], late[:lag])
        there = np.isfinite(a) & np.isfinite(b)
        a, b = a[there], b[there]
        sums.append((a @ b, a @ a, b @ b))
    return np.array(sums)


def steady_stretches(log: Driven, shift: int) -> Array:
    """Return the steady stretches (m, 4) of :class:`Driven`, with the lidar earlier by ``shift`` samples.

    A lidar's twists may have holes: what is averaged are the samples that it has, half of them at least.
    """
    n = round(STRETCH_S / GRID_S)
    length = max(len(log.sides_mps) - shift, 0)
    sides, twist = log.sides_mps[:length], log.twist[shift : shift + length]
    table = np.column_stack([sides.mean(axis=1), sides[:, 1] - sides[:, 0], twist[:, 0], twist[:, 2]])
    parts = table[: length // n * n].reshape(-1, n, 4)
    change = np.abs(parts[:, : n // 2, :2].mean(axis=1) - parts[:, n // 2 :, :2].mean(axis=1))
    seen = np.isfinite(parts).all(axis=2)
    steady = (change <= (MAX_SPEED_CHANGE_MPS, MAX_TURN_CHANGE_MPS)).all(axis=1)
    steady &= seen.mean(axis=1) >= MIN_SEEN
    weight = seen[steady][..., None] / seen[steady].sum(axis=1)[:, None, None]
    return np.asarray((np.nan_to_num(parts[steady]) * weight).sum(axis=1))


def rolling_radius(described_m: float, some: Sequence[Driven]) -> tuple[float, int]:
    """Return the radius by straight stretches, trimmed, and their number; a jackknife does not judge a median right."""
    speed, _, forward, turn = np.concatenate([log.stretches for log in some]).T
    straight = (np.abs(speed) >= MIN_SPEED_MPS) & (np.abs(turn) <= MAX_CURVATURE_PER_M * np.abs(speed))
    ratio = forward[straight] / speed[straight]
    return (described_m * float(trim_mean(ratio, TRIMMED)) if len(ratio) else math.nan), len(ratio)


def track(some: Sequence[Driven]) -> tuple[float, int]:
    """Return the difference of the sides over the yaw rate of stretches that turn, and how many they are."""
    stretches = np.concatenate([log.stretches for log in some])
    _, across, _, turn = stretches[np.abs(stretches[:, 3]) >= MIN_YAW_RATE_RADPS].T
    return (float(across @ turn / (turn @ turn)) if len(turn) else math.nan), len(turn)


def best_lag(which: int, some: Sequence[Driven]) -> tuple[float, int]:
    """Return the lag in s at which two yaw rates are most alike, and the number of runs that show them."""
    sums = [log.lags[which] for log in some]
    turning = [each for each in sums if each[:, 1:].min() > 0.0 and each[N_LAGS, 1] >= MIN_TURN_SUM]
    if not turning:
        return math.nan, 0
    products, one, other = np.sum(turning, axis=0).T
    lags_s = GRID_S * np.arange(-N_LAGS, N_LAGS + 1)
    best_s = peak(lags_s, products / np.sqrt(one * other))
    return (best_s if abs(best_s) < lags_s[-1] else math.nan), len(turning)
