"""Lag of each sensor behind the wheels, from all runs together, and its parts: a clock, and latencies.

A short run measures no clock: it holds one change of the command, of which a camera may see a half.  A lag
that is common to all runs is measured by all of them: the likelihood of each run, its gain and constant free,
is a function of the lag, and their sum has one peak.  Signs are free too, since a turned sign is found later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.clocks import (
    CLOCKED,
    FINE_S,
    MAX_LAG_S,
    MIN_EXCITATION,
    MIN_LAG_S,
)
from terrain.discrepancy.residuals import low_pass_of, prepare_inputs
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.records import Array
from terrain.signals import Pair, common_delay
from terrain.simulation.planar.replay import replay

LAGS_S = np.arange(MIN_LAG_S, MAX_LAG_S + 1e-9, FINE_S)

EDGE_S = MAX_LAG_S + 10 * FINE_S
"""Before and after a run its first and last prediction are held: commands are."""

SMOOTH = np.hanning(27)[1:-1] / np.hanning(27).sum()
"""Window of half a second over the prediction: encoders that are read a few times a second are held, and the
likelihood of a lag has kinks where edges meet samples."""

NO_LAG_S = np.zeros(1)

MIN_KNOWN = 10
"""Samples of a channel in a run, below which gain and constant leave nothing to compare."""

INDEPENDENT_HZ = 5.0
"""Samples a second that count as independent: what a robot does changes within 2 Hz."""

MIN_RUNS = 3
"""Least number of runs for a standard deviation."""

MIN_GAIN = 30.0
"""Twice the log-likelihood that a lag has to gain over the median of all lags, to be one: a channel that
follows the wheels gains hundreds, one that does not follows them nowhere."""

MIN_STD_S = 0.002
"""A tenth of the grid's step: runs that agree to less are limited by it."""

SIGMAS, GROSS_S = 3.0, 0.1
"""A search starts from a lag beyond so many standard deviations, and beyond the second: what is less, a
search that is linear about no lag finds by itself and names by its shape, and slip that follows the traction
looks like 0.08 s."""

SHAPE_GAIN = 10.0
"""Twice the log-likelihood by which a delay has to fit better than a low-pass of the encoders."""


class Latency(NamedTuple):
    """How far a channel is behind what the wheels predict, common to all runs.

    Parameters
    ----------
    channel : of :data:`~terrain.discrepancy.clocks.CLOCKED`
    lag_s, std_s : over what the simulation has of it already, and its standard deviation by bootstrap over
        runs; negative where the wheels are late
    n_runs : that measure it
    """

    channel: str
    lag_s: float
    std_s: float
    n_runs: int


class Latencies(NamedTuple):
    """Lags of all channels, and their parts.

    Parameters
    ----------
    channels : those of which a lag is measured
    clock_s, clock_std_s : of the earlier of IMU and camera behind the wheels; NaN if neither is measured
    imu_s, imu_std_s : of the IMU behind that; NaN where it is not measured, or where a delay of the
        yaw motion looks the same
    camera_s, camera_std_s : of the camera behind that; NaN where it is not measured
    is_delay : whether the wheels are late by a delay, and not by a low-pass of their encoders
    """

    channels: tuple[Latency, ...]
    clock_s: float
    clock_std_s: float
    imu_s: float
    imu_std_s: float
    camera_s: float
    camera_std_s: float
    is_delay: bool


class _RunPair(NamedTuple):
    """A channel of a run beside what is expected of it, and how many of its samples are independent."""

    pair: Pair
    n_independent: float


def latencies_of(signals: Sequence[Signals], simulation: Simulation, seed: int = 0) -> Latencies:
    """Return the lag of each channel behind the wheels, common to all runs.

    The gyro measures the IMU; heading rate and speed measure the camera, which is the earlier of the two: a
    body may move late, and no channel can be early.  A gyro that is late behind the speed alone may be that
    of a body that turns late; only a heading distinguishes the two.

    Parameters
    ----------
    signals : of all runs
    simulation : its prediction may be wrong in size and in sign
    seed : of the bootstrap
    """
    pairs = [_pairs(run, simulation) for run in signals]
    lags = {}
    for c, name in enumerate(CLOCKED):
        own = [pair[c] for pair in pairs if c in pair]
        if len(own) < MIN_RUNS:
            continue
        table = np.array([_gain(pair, LAGS_S) for pair in own])
        total = table.sum(axis=0)
        if total.max() - np.median(total) < MIN_GAIN:
            continue
        found = common_delay(LAGS_S, table, seed=seed)
        lags[name] = Latency(name, found.delay_s, max(found.std_s, MIN_STD_S), len(own))
    return Latencies(tuple(lags.values()), *_parts(lags), is_delay=_is_delay(pairs, lags))


def _parts(lags: Mapping[str, Latency]) -> tuple[float, float, float, float, float, float]:
    """Return clock, latency of the IMU and latency of the camera, each with its standard deviation."""
    gyro, heading = lags.get(GYRO), lags.get(HEADING)
    camera = min((lags[name] for name in (HEADING, SPEED_X) if name in lags), key=_lag_s, default=None)
    if gyro is None or camera is None:
        only = gyro or camera
        clock = (math.nan, math.nan) if only is None else (only.lag_s, only.std_s)
        return (*clock, math.nan, math.nan, math.nan, math.nan)
    std_s = math.hypot(gyro.std_s, camera.std_s)
    if gyro.lag_s <= camera.lag_s:
        return gyro.lag_s, gyro.std_s, 0.0, std_s, camera.lag_s - gyro.lag_s, std_s
    imu = (math.nan, math.nan)
    if heading is not None:
        imu = max(gyro.lag_s - heading.lag_s, 0.0), math.hypot(gyro.std_s, heading.std_s)
    return camera.lag_s, camera.std_s, *imu, 0.0, std_s


def _lag_s(latency: Latency) -> float:
    return latency.lag_s


def starting_values(latencies: Latencies) -> dict[str, float]:
    """Return parameters by which a search may start, of what is significant; none where nothing is late.

    Keys are ``clock_offset_s``, which is negative where the wheels are late, ``camera_latency_s`` and
    ``imu_latency_s``.  A clock is left out where a low-pass of the encoders explains late wheels as well.
    """
    values = {}
    clock_s = latencies.clock_s
    if _is_significant(clock_s, latencies.clock_std_s) and (clock_s > 0 or latencies.is_delay):
        values["clock_offset_s"] = clock_s
    if _is_significant(latencies.camera_s, latencies.camera_std_s):
        values["camera_latency_s"] = latencies.camera_s
    if _is_significant(latencies.imu_s, latencies.imu_std_s):
        values["imu_latency_s"] = latencies.imu_s
    return values


def _is_significant(lag_s: float, std_s: float) -> bool:
    return bool(abs(lag_s) > max(SIGMAS * std_s, GROSS_S))


def _pairs(run: Signals, simulation: Simulation) -> dict[int, _RunPair]:
    """Return the channels of a run that are measured and of which something is expected, by place."""
    dt, wheel_speed, steer, grade, roll, measured = prepare_inputs(run, low_pass_of([run]))
    planar = simulation.planar_on(run.terrain)
    predicted = np.asarray(replay(planar, simulation.vector, dt, wheel_speed, steer, grade, roll))
    at_s = dt * np.arange(len(predicted))
    half_s = FINE_S * (SMOOTH.size // 2)
    wide_s = np.arange(-EDGE_S - half_s, at_s[-1] + EDGE_S + half_s, FINE_S)
    fine_s = wide_s[SMOOTH.size // 2 : -(SMOOTH.size // 2)]
    pairs = {}
    for c, name in enumerate(CLOCKED):
        values, expected = (each[:, CHANNELS.index(name)] for each in (measured, predicted))
        known = np.isfinite(values)
        if known.sum() >= MIN_KNOWN and np.std(expected[known]) > MIN_EXCITATION:
            fine = np.convolve(np.interp(wide_s, at_s, expected), SMOOTH, mode="valid")
            n = float(known.sum() * dt * INDEPENDENT_HZ)
            time_s = at_s - fine_s[0]
            slope = np.gradient(fine, FINE_S)
            pairs[c] = _RunPair(Pair(time_s, np.ascontiguousarray(values), FINE_S, fine, slope, 0.0), n)
    return pairs


def _gain(run: _RunPair, lags_s: Array) -> Array:
    """Return twice the log-likelihood (lags,) that a run gains by following the prediction."""
    return np.asarray(
        -run.n_independent * np.log1p(-np.minimum(run.pair.correlations(lags_s, 0.0) ** 2, 0.9999))
    )


def _is_delay(pairs: Sequence[dict[int, _RunPair]], lags: Mapping[str, Latency]) -> bool:
    """Return whether wheels that are late are so by a delay, and not by a low-pass of time constant ``T``.

    What a body does is ahead of late wheels: ``x(t + T)`` by a delay, ``x + T dx/dt`` by a low-pass.
    """
    late_s = np.arange(0.0, -MIN_LAG_S, FINE_S)
    gained = 0.0
    for name in lags:
        delay, low_pass = np.zeros((2, late_s.size))
        for run, n in (each[CLOCKED.index(name)] for each in pairs if CLOCKED.index(name) in each):
            delay += _gain(_RunPair(run, n), -late_s)
            ahead = [run._replace(reference=run.reference + late * run.slope) for late in late_s]
            low_pass += [_gain(_RunPair(each, n), NO_LAG_S)[0] for each in ahead]
        gained += delay.max() - low_pass.max()
    return bool(gained > SHAPE_GAIN)
