"""How runs respond to their wheels: measured beside predicted on one clock, and the gain between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.clocks import CLOCKED, INDEPENDENT_HZ, Latencies, Shift
from terrain.discrepancy.runs import INPUTS, Rows
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.records import Array
from terrain.signals import agreement

#: Places of the channels: gyro, speed ahead and left, accelerometer, sum and difference of the currents, heading rate.
G, X, Y, A, AMPS, T, H = range(len(CHANNELS))
#: Channels that follow the wheels whatever the effects are: of a lateral speed, a lever arm sets the sign.
MOTION = [G, X, H]
FOLLOWERS = [*MOTION, A, AMPS, T]  #: Channels whose gain is above zero, whatever the effects are.
#: Channel that measures the clock of a channel; currents are on that of the wheels.
CLOCK_OF = {G: GYRO, X: SPEED_X, Y: SPEED_X, A: GYRO, H: HEADING}
#: Root mean square of a prediction (rad/s, m/s, m/s^2, A), by channel, from which a run is asked for its response:
#: several times the bias and noise of the sensors.
LEAST = np.array([0.1, 0.08, 0.03, 0.1, 0.5, 0.5, 0.1])
#: Largest zero of a channel: half more than the bounds of the catalogue's biases, and for a heading rate and a speed,
#: which have none, as much and a slow robot's speed.
LARGEST = {G: 0.3, X: 0.3, A: 3.0, H: 0.3}
OFFSET_SIGMAS = 4.0  #: A zero is over the largest by so many standard deviations.
MIN_ROWS = 10
#: A zero is identified only where the prediction comes so near to zero, over its range: beyond, it is that of the gain.
NEAR_ZERO = 0.1

MAX_FIT = 0.9999  #: Largest correlation that counts: beyond it the noise of the sensors decides.


class Agreement(NamedTuple):
    """How channels of runs (runs, channels) follow what the wheels predict."""

    #: about the zero of the sensor where it is beyond that of any, of the accelerometer about its mean, since its bias
    #: is large, of the speed of a robot that drives sideways that of its vector; 0 where the prediction is too small to
    #: ask for
    correlation: Array
    likelihood: Array  #: twice the logarithm that they gain by following with a gain above zero
    #: likewise, of the accelerometer that of its acceleration, beside gravity and a bias; NaN where unknown
    gain: Array


def on_own_clocks(rows: Sequence[Rows], lags: Latencies | Shift) -> tuple[Rows, ...]:
    """Return runs with the prediction of each channel on the clock by which it is measured.

    The clock is the run's own, where it measures one, else that of all runs together; without it the median of those
    that are known.
    """
    if isinstance(lags, Shift):
        own_s, rate, common_s = lags.lag_s, lags.rate, medians(lags.lag_s)
    else:
        found, rate = lags.channels, 0.0
        common_s = np.array([found[name].delay_s if name in found else math.nan for name in CLOCKED])
        own_s = np.tile(common_s, (len(rows), 1))
    common_s = np.where(np.isfinite(common_s), common_s, np.nan_to_num(medians(common_s[:, None])))
    own_s = np.where(np.isfinite(own_s), own_s, common_s)
    shifted = []
    for run, late_s in zip(rows, own_s, strict=True):
        predicted = run.predicted.copy()
        for c, name in CLOCK_OF.items() if run.time_s.size else ():
            at_s = run.time_s - late_s[CLOCKED.index(name)] - rate * (run.time_s - run.time_s.mean())
            predicted[:, c] = np.interp(at_s, run.time_s, run.predicted[:, c])
        shifted.append(run._replace(predicted=predicted))
    return tuple(shifted)


def medians(table: Array) -> Array:
    """Return the medians of columns, NaN where nothing is known."""
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else np.nan for x in table.T])


def agreement_of(runs: Sequence[Rows], sideways: bool = False) -> Agreement:
    """Return how the channels of runs, on their clocks, follow the wheels of a robot that may drive ``sideways``."""
    every = []
    for run in runs:
        measured, predicted = run.measured.copy(), run.predicted.copy()
        for c in MOTION:  # a sensor that was not zeroed follows all the same
            zero, std = zero_of(run, c)
            if abs(zero) > LARGEST[c] + OFFSET_SIGMAS * std:
                measured[:, c] -= zero
        known = np.isfinite(measured) & np.isfinite(predicted)
        n, rows = known.sum(axis=0), known[:, A]
        climb = GRAVITY_MPS2 * np.sin(run.inputs[rows, INPUTS.index("grade_rad")])
        accel, basis = (
            measured[rows, A],
            np.column_stack([predicted[rows, A] - climb, climb, np.ones_like(climb)]),
        )
        for values in (measured, predicted) if n[A] else ():
            values[:, A] -= values[rows, A].mean()
        power = (np.where(known, predicted, 0.0) ** 2).sum(axis=0)
        asked = np.sqrt(power / np.maximum(n, 1)) > LEAST
        correlation, gain = agreement(measured, predicted)
        if sideways:  # either speed may be too small to ask for, and both together say where the body goes
            (correlation[X],), (gain[X],) = agreement(
                measured[:, [X, Y]].reshape(-1, 1), predicted[:, [X, Y]].reshape(-1, 1)
            )
            asked[X] = np.sqrt(power[[X, Y]].sum() / max(n[X], 1)) > LEAST[Y]
        correlation = np.where(asked, correlation, 0.0)
        gain[correlation == 0.0] = np.nan
        if correlation[A] != 0.0:
            varies = np.std(basis[:, 0]) > 0.5 * LEAST[A]
            gain[A] = np.linalg.lstsq(basis, accel, rcond=None)[0][0] if varies else np.nan
        n_independent = n * min(run.period_s * INDEPENDENT_HZ, 1.0)
        likelihood = -n_independent * np.log1p(-(np.clip(correlation, 0.0, MAX_FIT) ** 2))
        every.append((correlation, likelihood, gain))
    return Agreement(*np.array(every).transpose(1, 0, 2))


def joined(runs: Sequence[Rows]) -> Rows:
    """Return runs as one, for what they measure and predict."""
    time_s, measured, predicted, inputs = (
        np.concatenate(each)
        for each in zip(*((run.time_s, run.measured, run.predicted, run.inputs) for run in runs), strict=True)
    )
    return runs[0]._replace(time_s=time_s, measured=measured, predicted=predicted, inputs=inputs)


def zero_of(run: Rows, channel: int) -> tuple[float, float]:
    """Return what a channel measures where nothing is predicted, and its standard deviation.

    They are NaN where the prediction does not come near zero, or where the constant is out of the range of what was
    measured: then it is an extrapolation.
    """
    known = np.isfinite(run.measured[:, channel]) & np.isfinite(run.predicted[:, channel])
    measured, predicted = run.measured[known, channel], run.predicted[known, channel]
    if known.sum() < MIN_ROWS:
        return math.nan, math.nan
    low, high = float(predicted.min()), float(predicted.max())
    margin = NEAR_ZERO * (high - low) + LEAST[channel]
    if low > margin or high < -margin:
        return math.nan, math.nan
    value, std = first_of_fit([np.ones(measured.size)], predicted, measured, channel, run.period_s)
    return (value, std) if measured.min() <= value <= measured.max() else (math.nan, math.nan)


def first_of_fit(
    columns: list[Array], predicted: Array, measured: Array, channel: int, period_s: float
) -> tuple[float, float]:
    """Return the coefficient of the first column, fitted beside a gain where the prediction varies, and its error."""
    varies = np.std(predicted) > LEAST[channel]
    basis = np.column_stack([*columns, *([predicted] if varies else [])])
    fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
    n_independent = max(measured.size * min(period_s, 1.0), 1.0)  # what is left changes within seconds
    spread = np.linalg.pinv(basis.T @ basis / measured.size)[0, 0] / n_independent
    return float(fit[0]), float(np.std(measured - basis @ fit) * np.sqrt(spread))
