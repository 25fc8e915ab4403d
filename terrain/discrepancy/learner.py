"""What a learner without names reaches on runs held out: how much of the residual is there to be found.

Measured minus simulated of each channel is regressed on the inputs of the simulation, their products,
magnitudes and rates, a few rows before and after, by Bayesian linear regression, whose two variances are
set by the data (MacKay, Bayesian interpolation, Neural Computation 1992; ``BayesianRidge`` of scikit-learn).
It is fitted to the runs behind the diagnosis and judged on the others: what it removes there and the named
causes do not, some cause without a name makes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.evidence import MIN_CLUSTERS
from terrain.discrepancy.held_out import ratio_of_sums
from terrain.discrepancy.runs import measured_channels
from terrain.effects import CHANNELS
from terrain.records import Array

DRIVEN = ("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad", "sideways_mps")
"""Inputs that are logged; the force is the simulation's own."""

LAGS = (-2, -1, 1, 2)
"""Rows by which inputs are taken later and earlier: a third of a second at the rate of a 50 Hz log, where any
sensor may be the late one."""

LEAST_RANGE = 1e-6  #: Spread of a column that counts as constant


class ChannelReference(NamedTuple):
    """Residual of one channel on the runs held out, and behind the reference, in the channel's unit."""

    rms_before: float
    rms_after: float
    reduction: float  #: part of the square that the reference removes; below 0 where it adds to it
    named_reduction: float  #: part that the named causes remove; NaN where none was named
    left_to_find_from: float
    """Lower end of the 95 % interval, by bootstrap over runs, of what the reference removes beyond the named
    causes; NaN where runs are too few: what one run has in common in itself is no cause."""


class Reference(NamedTuple):
    """What a black-box reference reaches, beside the named causes."""

    n_runs: int  #: held out, on which it is judged
    reduction: float  #: of the squares of all channels, each over its noise
    named_reduction: float
    channels: Mapping[str, ChannelReference]


def black_box_reference(
    used: Sequence[ComparedRun], held_out: Sequence[ComparedRun], noise: Mapping[str, float], seed: int = 0
) -> Reference | None:
    """Return what a black-box reference, fitted to the runs used, reaches on runs held out; None without any.

    Squares of channels are added over the ``noise`` of each.
    """
    if not used or not held_out:
        return None
    from sklearn.linear_model import BayesianRidge

    columns, test = [np.concatenate([_regressors(run) for run in runs]) for runs in (used, held_out)]
    n_rows = np.array([len(run.time_s) for run in held_out])
    channels, total = {}, np.zeros(3)
    for name in measured_channels(used):
        c = CHANNELS.index(name)
        before = np.concatenate([run.residual(False)[:, c] for run in held_out])
        target = np.concatenate([run.residual(False)[:, c] for run in used])
        judged = np.isfinite(before)
        if not judged.any():
            continue
        # a constant where nothing varies
        known = np.isfinite(target) & np.isfinite(columns).all(axis=1)
        left = np.array([before[judged]] * 3)  # before, behind the reference, and with the named causes
        mean, spread = columns[known].mean(axis=0), columns[known].std(axis=0)
        use = spread > LEAST_RANGE
        if use.any() and target[known].std() > 0.0:
            x, there = [(rows[:, use] - mean[use]) / spread[use] for rows in (columns[known], test[judged])]
            left[1] -= BayesianRidge().fit(x, target[known]).predict(np.nan_to_num(there))
        elif known.any():
            left[1] -= float(target[known].mean())
        if held_out[0].after is not None:
            left[2] = np.concatenate([run.residual(True)[:, c] for run in held_out])[judged]
        square = np.zeros((3, judged.size))
        square[:, judged] = left**2
        by_run = np.add.reduceat(square, np.cumsum(n_rows) - n_rows, axis=1)
        by_run = by_run[:, np.add.reduceat(judged, np.cumsum(n_rows) - n_rows) > 0]
        low = math.nan
        if by_run.shape[1] >= MIN_CLUSTERS:
            low = ratio_of_sums(by_run[2] - by_run[1], by_run[0], seed)[1][0]
        squares = square.sum(axis=1)
        if held_out[0].after is None:
            squares[2] = math.nan
        rms = np.sqrt(squares / judged.sum()).tolist()
        channels[name] = ChannelReference(rms[0], rms[1], *_removed(squares), low)
        if noise.get(name, math.nan) > 0:
            total += squares / noise[name] ** 2
    return Reference(len(held_out), *_removed(total), channels)


def _removed(squares: Array) -> tuple[float, float]:
    """Return the parts of the first square that are removed in the second and in the third."""
    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = (1.0 - squares[1:] / squares[0]).tolist()
    return first, second


def _regressors(run: ComparedRun) -> Array:
    """Return the regressors (m, k) of a run: a row at its ends takes the last input that there is."""
    inputs = [run.inputs[name] for name in DRIVEN]
    driven = [*inputs[:2], inputs[-1]]  # that is 0, and left out, but of omni robots
    plain = [*inputs, *[np.abs(x) for x in driven], *[np.tanh(x / 0.05) for x in driven]]
    products = [a * b for a, b in combinations_with_replacement(inputs, 2)]
    signed = [x * np.abs(x) for x in driven]
    at = np.arange(len(run.time_s))
    rates = [np.gradient(x) if at.size > 1 else np.zeros_like(x) for x in inputs]
    moving = np.column_stack([*inputs[:3], inputs[-1], inputs[0] * inputs[1], *signed])
    late = [moving[np.clip(at - lag, 0, at.size - 1)] for lag in LAGS]
    return np.hstack([np.column_stack([*plain, *products, *signed, *rates]), *late])
