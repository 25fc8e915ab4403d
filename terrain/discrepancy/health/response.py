"""How each run responds to its wheels: measured beside predicted on one clock, and the gain between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.clocks import CLOCKED, Shift
from terrain.discrepancy.latencies import INDEPENDENT_HZ, Latencies
from terrain.discrepancy.residuals import INPUTS, Rows
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
)
from terrain.records import Array

G, X, Y, A, AMPS, T, H = (
    CHANNELS.index(name) for name in (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
)
"""Columns of the channels."""

MOTION = (G, X, H)
"""Channels that follow the wheels whatever the effects are: of a lateral speed, a lever arm sets the sign."""

CLOCK_OF = {G: GYRO, X: SPEED_X, Y: SPEED_X, A: GYRO, H: HEADING}
"""Channel that measures the clock of a channel; currents are on that of the wheels."""

LEAST = {G: 0.1, X: 0.08, Y: 0.03, A: 0.1, AMPS: 0.5, T: 0.5, H: 0.1}
"""Root mean square of a prediction (rad/s, m/s, m/s^2, A) from which a run is asked for its response: several
times the bias and noise of the sensors."""

MAX_FIT = 0.9999
"""Largest correlation that counts: beyond it the noise of the sensors decides."""


class Response(NamedTuple):
    """A run, each measured row beside the prediction of its own clock.

    Parameters
    ----------
    run_id, terrain : of the run
    period_s : of its rows
    measured, predicted : (m, channels)
    climb_mps2 : (m,) part of the predicted specific force that is gravity
    """

    run_id: str
    terrain: str
    period_s: float
    measured: Array
    predicted: Array
    climb_mps2: Array


def responses_of(
    rows: Sequence[Rows], latencies: Latencies | None = None, shift: Shift | None = None
) -> tuple[Response, ...]:
    """Return the responses of runs, each channel on its clock.

    Parameters
    ----------
    rows : of all runs
    latencies : of all runs together; without them the medians of those that each run measures
    shift : of each run, where it measures one of its own
    """
    common: dict[str, float] = {}
    if latencies is not None:
        common = {lag.channel: lag.lag_s for lag in latencies.channels}
    elif shift is not None:
        for name, lag_s in zip(CLOCKED, shift.lag_s.T, strict=True):
            if np.isfinite(lag_s).any():
                common[name] = float(np.median(lag_s[np.isfinite(lag_s)]))
    usual_s = float(np.median(list(common.values()))) if common else 0.0
    found = []
    for i, run in enumerate(rows):
        own = {} if shift is None else dict(zip(CLOCKED, shift.lag_s[i], strict=True))
        known = {name: float(lag) for name, lag in own.items() if np.isfinite(lag)}
        predicted = run.predicted.copy()
        centred_s = run.time_s - run.time_s.mean() if run.time_s.size else run.time_s
        rate = 0.0 if shift is None else shift.rate
        for c, name in CLOCK_OF.items() if run.time_s.size else ():
            late_s = known.get(name, common.get(name, usual_s)) + rate * centred_s
            predicted[:, c] = np.interp(run.time_s - late_s, run.time_s, run.predicted[:, c])
        period_s = float(np.median(np.diff(run.time_s))) if run.time_s.size > 1 else 0.0
        climb = GRAVITY_MPS2 * np.sin(run.inputs[:, INPUTS.index("grade_rad")])
        found.append(Response(run.run_id, run.terrain, period_s, run.measured, predicted, climb))
    return tuple(found)


def fits(response: Response) -> tuple[Array, Array]:
    """Return correlation about zero of each channel (channels,), and twice the log-likelihood that it gains.

    Both are 0 where the prediction is too small to ask for.  The accelerometer's is about its mean, since
    its bias is large.
    """
    measured, predicted = response.measured, response.predicted
    known = np.isfinite(measured) & np.isfinite(predicted)
    n = known.sum(axis=0)
    m, p = np.where(known, measured, 0.0), np.where(known, predicted, 0.0)
    if n[A]:
        for each in (m, p):
            each[:, A] -= np.where(known[:, A], each[:, A].sum() / n[A], 0.0)
    power = (p * p).sum(axis=0)
    asked = np.sqrt(power / np.maximum(n, 1)) > np.array([LEAST[c] for c in range(len(CHANNELS))])
    norm = np.sqrt(power * (m * m).sum(axis=0))
    correlation = np.divide((m * p).sum(axis=0), norm, out=np.zeros(len(n)), where=asked & (norm > 0))
    ahead = np.clip(correlation, 0.0, MAX_FIT)
    n_independent = n * min(response.period_s * INDEPENDENT_HZ, 1.0)
    return correlation, -n_independent * np.log1p(-(ahead**2))


def gains_of(response: Response) -> tuple[Array, Array]:
    """Return the gain of each channel (channels,) about zero, and its correlation; NaN and 0 where unknown.

    The accelerometer's is that of its acceleration, beside gravity and a bias.
    """
    correlation = fits(response)[0]
    known = np.isfinite(response.measured) & np.isfinite(response.predicted)
    m, p = np.where(known, response.measured, 0.0), np.where(known, response.predicted, 0.0)
    power = (p * p).sum(axis=0)
    gain = np.divide((m * p).sum(axis=0), power, out=np.full(len(power), np.nan), where=correlation != 0.0)
    rows = known[:, A]
    if correlation[A] != 0.0:
        climb = response.climb_mps2[rows]
        basis = np.column_stack([p[rows, A] - climb, climb, np.ones(climb.size)])
        if np.std(basis[:, 0]) > 0.5 * LEAST[A]:
            gain[A] = np.linalg.lstsq(basis, m[rows, A], rcond=None)[0][0]
        else:
            gain[A] = np.nan
    return gain, correlation
