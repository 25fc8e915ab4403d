r"""Delay of an outside measurement behind the wheels, from changes of speed in many runs.

Twists over short windows by the wheels, :math:`V_w(t)`, and from outside, :math:`V(t + \tau)`, are compared:
with a gain a run and a component that slip makes free,

.. math:: \min_\tau \sum_{runs} \sum_c \min_g \sum_t \left(V_c(t + \tau) - g\,V_{w,c}(t)\right)^2 .

A robot that drives steadily shows no delay at all; starts, stops and turns do.  The interval is that of draws
of runs with replacement (of thirds of a single run), :func:`terrain.signals.common_delay`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.errors import DataError
from terrain.kinematics.wheels import no_slip_twist
from terrain.measured_slip.slips import (
    Travelled,
    travelled,
    wheel_directions,
    wheel_speeds,
    window_rates,
)
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.signals import Delay, DelayStatus, common_delay

SEARCH_S = (-0.4, 1.2)
"""Bounds of the search: a lidar that matches scans comes out up to 0.7 s late; beyond a second it is no delay
but two clocks."""

STEP_S = 0.02
WINDOW_S = 0.3
"""Over which twists are taken: a start takes 0.2 to 0.5 s."""

REST_S = 1.0
"""A log whose wheels stand at its first sample is taken to be of a robot at rest for so long before it: most
recordings begin with the start that shows the delay."""

MIN_KNOWN = 0.3
"""Of the windows of a run, with every delay of the search."""

MAX_STD_S = 0.1
"""A delay that is less certain is not applied."""


def delay_sentence(delay: Delay) -> str:
    """Return by how much the outside measurement is late, in words."""
    if delay.status is not DelayStatus.ESTIMATED:
        return "the delay of the outside measurement was not found, and none is taken off."
    return (
        f"the outside measurement is {delay.delay_s:+.3f} s behind the wheels "
        f"(± {1.96 * delay.std_s:.3f}), which is taken off."
    )


def estimate_delay(runs: Sequence[RunLog], robot: Robot, seed: int = 0) -> Delay:
    """Return by how much the outside measurement of runs lags behind their wheels.

    Parameters
    ----------
    runs : of one robot and one outside sensor; those without either are passed over
    robot : whose logs they are
    seed : of the draws that the interval is from
    """
    lags_s = np.arange(SEARCH_S[0], SEARCH_S[1] + STEP_S / 2, STEP_S)
    curves = []
    for run in runs:
        try:
            curves += _misfits(run, robot, lags_s, 3 if len(runs) == 1 else 1)
        except DataError:
            continue
    return common_delay(lags_s, [-curve for curve in curves], MAX_STD_S, seed)


def _misfits(run: RunLog, robot: Robot, lags_s: Array, n_parts: int) -> list[Array]:
    """Return the misfit (lags,) of each part of a run, relative to what its wheels vary by."""
    time_s, speeds = wheel_speeds(run, robot)
    path = travelled(run, robot)
    if len(path.time_s) < 2:
        return []
    if not np.abs(speeds[0]).max() > 0.0:
        time_s, speeds = _at_rest_before(time_s, speeds)
        path = _standing_before(path)
    start_s = np.arange(time_s[0], time_s[-1] - WINDOW_S, WINDOW_S / 6)
    if start_s.size < 8 * n_parts:
        return []
    end_s = start_s + WINDOW_S
    sums = np.concatenate(
        [
            np.zeros((1, speeds.shape[1])),
            np.cumsum(np.diff(time_s)[:, None] * (speeds[1:] + speeds[:-1]) / 2, 0),
        ]
    )
    known = np.isfinite(sums).all(axis=1)
    one = np.zeros(int(known.sum()), dtype=np.int64)
    u, _ = window_rates(time_s[known], sums[known], one, start_s, end_s, 3, 0.4)
    directions = wheel_directions(run, robot, start_s, end_s)
    rolled, _ = no_slip_twist(robot.wheel_positions_m, directions, u, robot.on_omni_wheels)
    size_m = float(np.linalg.norm(robot.wheel_positions_m, axis=1).max())
    scale = np.array([1.0, 1.0, size_m])
    seen = np.array(
        [
            window_rates(path.time_s, path.values, path.part, start_s + lag_s, end_s + lag_s, 3, 0.4)[0]
            for lag_s in lags_s
        ]
    )
    x, y = rolled * scale, seen * scale
    known_rows = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=2)
    curves = []
    for rows in np.array_split(np.arange(start_s.size), n_parts):
        if known_rows[:, rows].sum(axis=1).min() < max(8, MIN_KNOWN * rows.size):
            continue
        curves.append(
            np.array([_misfit(x[rows], lag[rows], k[rows]) for lag, k in zip(y, known_rows, strict=True)])
        )
    return curves


def _misfit(x: Array, y: Array, known: Array) -> float:
    """Return the mean square of what a gain for each component leaves of y (k, 3) beside x (k, 3)."""
    x, y = x[known], y[known]
    power = (x**2).sum(axis=0)
    gain = (y * x).sum(axis=0) / np.where(power > 0.0, power, 1.0)
    return float(((y - gain * x) ** 2).sum() / len(x))


def _at_rest_before(time_s: Array, speeds: Array) -> tuple[Array, Array]:
    """Return the log of wheels that stand at its first sample, with that rest before it."""
    before = time_s[0] + np.arange(-REST_S, -STEP_S / 2, STEP_S)
    return np.concatenate([before, time_s]), np.concatenate(
        [np.zeros((before.size, speeds.shape[1])), speeds]
    )


def _standing_before(path: Travelled) -> Travelled:
    before = path.time_s[0] + np.arange(-REST_S, -STEP_S / 2, STEP_S)
    return Travelled(
        path.source,
        np.concatenate([before, path.time_s]),
        np.concatenate([np.repeat(path.values[:1], before.size, axis=0), path.values]),
        np.concatenate([np.repeat(path.part[:1], before.size), path.part]),
        path.n_jumps,
        path.n_gaps,
    )
