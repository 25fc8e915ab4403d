r"""How wheels follow commanded speeds: a stepped model of the powertrain, and runs prepared for it.

A command ``c`` (rad/s of each wheel) becomes a wheel speed ``y`` by parts, each of which may be absent::

    a = g_c (c_r + c_l)/2,  b = g_d (c_r - c_l)/2       gains, common to the sides and of their difference
    a, b limited to A and B                             where a command is a speed and a turn to the robot
    x = 0 for |x| < d, min(|x|, 2 (|x| - d)) beyond     deadband d; twice as large commands pass whole
    x limited to the largest wheel speed
    T dy/dt = x(t - D) - y,  |dy/dt| <= s               delay D, time constant T, slew limit s

At the start of a run the command before is not known: its wheels are assumed to go on as they were measured
first, until the first command arrives.

Loggers hold a measurement until the next one comes.  Of each wheel only new samples are compared, so that the
period of the logger is no part of the delay; what its messages need to arrive is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.errors import DataError
from terrain.records import Array, RunLog
from terrain.robots import Robot

STEP_S = 0.02
"""Of the simulated powertrain; a fifth of the shortest delays that robots have."""

MIN_RUNS = 5
"""Fewer do not tell an error from the scatter between runs."""

NAMES = (
    "delay_s",
    "time_constant_s",
    "slew_radps2",
    "deadband_radps",
    "gain_ratio",
    "difference_gain_ratio",
    "common_limit_radps",
    "difference_limit_radps",
    "wheel_limit_radps",
)
"""Parts, as the kernel takes them."""

DELAY, TIME_CONSTANT, SLEW, DEADBAND, GAIN, DIFFERENCE_GAIN, COMMON_LIMIT, DIFFERENCE_LIMIT, WHEEL_LIMIT = (
    range(9)
)

ABSENT = np.array([0.0, 0.0, math.inf, 0.0, 1.0, 1.0, math.inf, math.inf, math.inf])
"""Values of parts that do nothing."""


class Traces(NamedTuple):
    """All runs on one grid.

    Parameters
    ----------
    area_rad : (m, wheels) integrals of the commands from the start of each run
    first : (runs + 1,) rows of each run in the grid
    start_radps : (runs, wheels) first measured wheel speeds
    at, between : (n,) row ahead of each sample, and share of a step behind it
    measured : (n, wheels) wheel speeds
    new : (n, wheels) 1 where a sample of a wheel is new, else 0
    sample : (runs + 1,) samples of each run
    hold_s : period at which new wheel speeds are logged
    """

    area_rad: Array
    first: Array
    start_radps: Array
    at: Array
    between: Array
    measured: Array
    new: Array
    sample: Array
    hold_s: float

    @property
    def n_values(self) -> int:
        """How many values are compared."""
        return int(self.new.sum())


def is_commanded(run: RunLog, robot: Robot) -> bool:
    """Return whether a run logs the commanded and the measured speed of each wheel."""
    if not {"commands", "wheels"} <= run.streams.keys():
        return False
    ordered = {f"wheel_{wheel}_radps" for wheel in robot.logged_wheels}
    commanded = ordered <= set(run.streams["commands"].channels)
    return commanded and set(robot.rate_channels) <= set(run.streams["wheels"].channels)


def traces_of(runs: Sequence[RunLog], robot: Robot) -> Traces:
    """Return the runs that log commanded and measured wheel speeds on one grid.

    Raises
    ------
    DataError
        if fewer than :data:`MIN_RUNS` do.
    """
    area, start, at, between, measured, news, holds = [], [], [], [], [], [], []
    first, sample = [0], [0]
    per_radps = robot.logged_rates(np.full(len(robot.wheels), robot.wheel_radius_m))
    for run in runs:
        if not is_commanded(run, robot):
            continue
        commands, wheels = run.streams["commands"], run.streams["wheels"]
        rates = np.column_stack([wheels.channel(name) for name in robot.rate_channels]) / per_radps
        orders = np.column_stack([commands.channel(f"wheel_{wheel}_radps") for wheel in robot.logged_wheels])
        inside = (wheels.time_s >= commands.time_s[0]) & (wheels.time_s <= commands.time_s[-1])
        inside &= np.isfinite(rates).all(axis=1)
        time_s, rates = wheels.time_s[inside], rates[inside]
        if len(time_s) < 3 or not np.isfinite(orders).all():
            continue
        new, hold_s = _new_samples(time_s, rates)
        any_new = new.any(axis=1)
        if not any_new.any():
            continue
        grid_s = np.arange(time_s[0], time_s[-1] + 2.0 * STEP_S, STEP_S)
        area.append(np.column_stack([_integral(grid_s, commands.time_s, each) for each in orders.T]))
        place = (time_s[any_new] - grid_s[0]) / STEP_S
        row = np.minimum(place.astype(np.int64), len(grid_s) - 2)
        at.append(row + first[-1])
        between.append(place - row)
        measured.append(rates[any_new])
        news.append(new[any_new].astype(float))
        start.append(rates[0])
        holds.append(hold_s)
        first.append(first[-1] + len(grid_s))
        sample.append(sample[-1] + len(row))
    if len(start) < MIN_RUNS:
        raise DataError(
            f"runs: {len(start)} have commanded and measured wheel speeds; at least {MIN_RUNS} are required"
        )
    return Traces(
        np.vstack(area),
        np.array(first),
        np.vstack(start),
        np.concatenate(at),
        np.concatenate(between),
        np.vstack(measured),
        np.vstack(news),
        np.array(sample),
        float(np.median(holds)),
    )


def _integral(time_s: Array, stamps_s: Array, held: Array) -> Array:
    """Return the integral (m,) of a command that is held from stamp to stamp, and after the last."""
    sums = np.concatenate([[0.0], np.cumsum(held[:-1] * np.diff(stamps_s))])
    after = np.maximum(time_s - stamps_s[-1], 0.0) * held[-1]
    return np.asarray(np.interp(time_s, stamps_s, sums) + after)


def _new_samples(time_s: Array, rates: Array) -> tuple[Array, float]:
    """Return which samples (n, wheels) are new, and the period at which they come.

    What stays the same for twice that period is new as well: a wheel that turns steadily.
    """
    new = np.vstack([np.zeros(rates.shape[1], dtype=bool), np.diff(rates, axis=0) != 0.0])
    between = [np.diff(np.flatnonzero(column)) for column in new.T]
    every = int(np.median(np.concatenate(between))) if any(len(each) for each in between) else 1
    for column in new.T:
        last = 0
        for k in range(1, len(time_s)):
            if column[k] or k - last >= 2 * every:
                column[k], last = True, k
    return new, every * float(np.median(np.diff(time_s)))


@njit(cache=True)
def follow(area_rad: Array, start_radps: Array, p: Array, dt: float) -> Array:
    """Return wheel speeds (m, wheels) that follow commands.

    Parameters
    ----------
    area_rad : (m, wheels) integral of the commands (rad/s) up to each step
    start_radps : (wheels,) wheel speeds until the first command arrives
    p : (len(NAMES),) parts
    dt : step in s

    Examples
    --------
    A step from 0 to 1 rad/s, a tenth of a second late:

    >>> step = np.maximum(np.arange(40) - 9.0, 0.0)[:, None] * 0.01
    >>> late = ABSENT.copy()
    >>> late[DELAY] = 0.1
    >>> follow(step, np.zeros(1), late, 0.01)[[18, 20], 0]
    array([0., 1.])
    """
    m, wheels = area_rad.shape
    out = np.empty((m, wheels))
    state, x = start_radps.copy(), np.empty(wheels)
    late = p[0] / dt
    quick = 1.0 - math.exp(-dt / p[1]) if p[1] > 0.0 else 1.0
    furthest = p[2] * dt
    for k in range(m):
        at = k - late
        if at >= 1.0:
            i = int(at)
            part = at - i
            for j in range(wheels):
                x[j] = (area_rad[i, j] - area_rad[i - 1, j]) * (1.0 - part) / dt
                if part > 0.0:
                    x[j] += (area_rad[i + 1, j] - area_rad[i, j]) * part / dt
            if wheels == 2:
                common = min(max(0.5 * p[4] * (x[1] + x[0]), -p[6]), p[6])
                half = min(max(0.5 * p[5] * (x[1] - x[0]), -p[7]), p[7])
                x[0], x[1] = common - half, common + half
            for j in range(wheels):
                goal = x[j] if wheels == 2 else p[4] * x[j]
                size = abs(goal)
                if size < 2.0 * p[3]:
                    goal = math.copysign(max(2.0 * (size - p[3]), 0.0), goal)
                goal = min(max(goal, -p[8]), p[8])
                state[j] += min(max(quick * (goal - state[j]), -furthest), furthest)
        out[k] = state
    return out


@njit(cache=True)
def _predicted(
    area_rad: Array, first: Array, start_radps: Array, at: Array, between: Array, sample: Array, p: Array
) -> Array:
    """Return predicted wheel speeds (n, wheels) at the samples of all runs."""
    out = np.empty((at.size, area_rad.shape[1]))
    for run in range(start_radps.shape[0]):
        speed = follow(area_rad[first[run] : first[run + 1]], start_radps[run], p, STEP_S)
        for n in range(sample[run], sample[run + 1]):
            k = at[n] - first[run]
            for j in range(out.shape[1]):
                out[n, j] = speed[k, j] + between[n] * (speed[k + 1, j] - speed[k, j])
    return out


def predict(traces: Traces, p: Array) -> Array:
    """Return predicted wheel speeds (n, wheels) at the samples."""
    shown: Array = _predicted(
        traces.area_rad, traces.first, traces.start_radps, traces.at, traces.between, traces.sample, p
    )
    return shown


def settled(traces: Traces, p: Array) -> Array:
    """Return the wheel speeds (runs, wheels) that the first commands lead to."""
    at_once = p.copy()
    at_once[[DELAY, TIME_CONSTANT]], at_once[SLEW] = 0.0, math.inf
    first = traces.first[:-1]
    starts = [traces.area_rad[k : k + 2] for k in first.tolist()]
    zero = np.zeros(traces.area_rad.shape[1])
    return np.array([follow(area, zero, at_once, STEP_S)[1] for area in starts])


def left_over(traces: Traces, p: Array) -> Array:
    """Return measured minus predicted wheel speeds (n, wheels), 0 where a sample is not new."""
    return np.asarray((traces.measured - predict(traces, p)) * traces.new)


def squared_errors(traces: Traces, p: Array) -> Array:
    """Return the sum of the squared errors of each run (runs,)."""
    square = (left_over(traces, p) ** 2).sum(axis=1)
    return np.asarray(np.add.reduceat(square, traces.sample[:-1]))
