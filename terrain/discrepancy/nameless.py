"""What a learner without names reaches on the runs held out: how much of the residual is there to be found.

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
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.compared import ComparedRun, channels_of
from terrain.discrepancy.held_out import N_BOOTSTRAP
from terrain.discrepancy.selection import MIN_CLUSTERS
from terrain.discrepancy.statements import CHANNEL_WORDS, listed
from terrain.effects import CHANNELS
from terrain.records import Array

DRIVEN = ("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad", "sideways_mps")
"""Inputs that are logged; the force is the simulation's own."""

LAGS = (-2, -1, 0, 1, 2)
"""Rows by which inputs are taken later and earlier: a third of a second at the rate of a 50 Hz log, where any
sensor may be the late one."""

LEAST_RANGE = 1e-6
"""Spread of a column that counts as constant."""

LITTLE_LEFT = 0.05
"""Part of the square that a learner has to remove beyond the named causes, at the lower end of its interval,
before something is left to find: less would not change what the simulation is good for."""


class Learned(NamedTuple):
    """Squared residual of one channel on the runs held out.

    Parameters
    ----------
    rms_before, rms_after : root mean square before, and behind the learner, in the channel's unit
    ratio : part of the square that the learner removes; below 0 where it adds to it
    named_ratio : part that the named causes remove; NaN where none was named
    left_low : lower end of the 95 % interval, by bootstrap over runs, of what the learner removes beyond the
        named causes; NaN where runs are too few: what one run has in common in itself is no cause
    """

    rms_before: float
    rms_after: float
    ratio: float
    named_ratio: float
    left_low: float

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        removed = {"reduction": self.ratio, "named_reduction": self.named_ratio}
        rms = {"rms_before": self.rms_before, "rms_after": self.rms_after}
        return {**rms, **removed, "left_to_find_from": self.left_low}


class Nameless(NamedTuple):
    """What a black-box reference reaches, beside the named causes.

    Parameters
    ----------
    n_runs : held out, on which it is judged
    channels : by name
    ratio, named_ratio : of the squares of all channels, each over its noise
    """

    n_runs: int
    channels: Mapping[str, Learned]
    ratio: float
    named_ratio: float

    @property
    def sentence(self) -> str:
        """What the comparison says, in words.

        Examples
        --------
        >>> Nameless(5, {}, 0.97, 0.96).sentence
        'The named causes remove 96 % of the square, a black-box reference 97 %: little is left to find.'
        >>> Nameless(5, {}, 0.01, float("nan")).sentence
        'Nothing was named, and a black-box reference removes 1 % of the square: little is left to find.'
        """
        named = self.named_ratio if math.isfinite(self.named_ratio) else 0.0
        left = self.ratio - named
        learner = f"{100.0 * max(self.ratio, 0.0):.0f} %"
        channels = [
            CHANNEL_WORDS[name][0] for name, each in self.channels.items() if each.left_low > LITTLE_LEFT
        ]
        if channels:
            judged = f"more is left to find in {listed(channels)}"
        elif left > LITTLE_LEFT:
            judged = f"{self.n_runs} runs are too few to state more"
        elif left < -LITTLE_LEFT:
            judged = "it finds less than the names state"
        else:
            judged = "little is left to find"
        if math.isnan(self.named_ratio):
            return f"Nothing was named, and a black-box reference removes {learner} of the square: {judged}."
        return (
            f"The named causes remove {100.0 * named:.0f} % of the square, a black-box reference "
            f"{learner}: {judged}."
        )

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        own = {"n_runs": self.n_runs, "reduction": self.ratio, "named_reduction": self.named_ratio}
        return {**own, "channels": self.channels}


def nameless_gain(
    used: Sequence[ComparedRun],
    held_out: Sequence[ComparedRun],
    noise: Mapping[str, float],
    seed: int = 0,
) -> Nameless | None:
    """Return what a black-box reference reaches on runs held out; None where there are none.

    Parameters
    ----------
    used : runs that it is fitted to
    held_out : on which it and the named causes are judged, behind the same low-pass
    noise : by channel, over which the squares of channels are added
    seed : of the bootstrap
    """
    if not used or not held_out:
        return None
    columns, test = ([_columns(run) for run in runs] for runs in (used, held_out))
    extended = held_out[0].after is not None
    channels: dict[str, Learned] = {}
    total = np.zeros(3)
    for name in channels_of(used):
        c = CHANNELS.index(name)
        before = np.concatenate([run.residual(False)[:, c] for run in held_out])
        known = np.isfinite(before)
        if not known.any():
            continue
        target = np.concatenate([run.residual(False)[:, c] for run in used])
        learned = _predicted(np.concatenate(columns), target, np.concatenate(test)[known])
        after = before[known] - learned
        named = np.full(after.size, np.nan)
        if extended:
            named = np.concatenate([run.residual(True)[:, c] for run in held_out])[known]
        squares = np.array([float(x @ x) for x in (before[known], after, named)])
        rms = np.sqrt(squares / known.sum())
        rival = named if extended else before[known]
        of_run = np.repeat(np.arange(len(held_out)), [len(run.time_s) for run in held_out])[known]
        left_low = _left_low(before[known] ** 2, rival**2 - after**2, of_run, seed)
        channels[name] = Learned(float(rms[0]), float(rms[1]), *_ratios(squares), left_low)
        if noise.get(name, math.nan) > 0:
            total += squares / noise[name] ** 2
    return Nameless(len(held_out), channels, *_ratios(total))


def _left_low(before: Array, more: Array, of_run: Array, seed: int) -> float:
    """Return the lower end of the interval of what is removed more (n,), over the square before (n,)."""
    parts = [np.flatnonzero(of_run == run) for run in np.unique(of_run)]
    if len(parts) < MIN_CLUSTERS:
        return math.nan
    weights = bootstrap_counts(len(parts), N_BOOTSTRAP, seed)
    sums = np.array([[more[part].sum(), before[part].sum()] for part in parts])
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = (weights @ sums[:, 0]) / (weights @ sums[:, 1])
    return float(percentile_interval(ratios)[0]) if np.isfinite(ratios).any() else math.nan


def _ratios(squares: Array) -> tuple[float, float]:
    """Return the parts of the first square that are removed in the second and in the third."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = 1.0 - squares[1:] / squares[0]
    return float(ratios[0]), float(ratios[1])


def _columns(run: ComparedRun) -> Array:
    """Return the regressors (m, k) of a run: a row at its ends takes the last input that there is."""
    inputs = [run.inputs[name] for name in DRIVEN]
    driven = [*inputs[:2], inputs[-1]]  # that is 0, and left out, but of omni robots
    plain = [*inputs, *(np.abs(x) for x in driven), *(np.tanh(x / 0.05) for x in driven)]
    products = [a * b for a, b in combinations_with_replacement(inputs, 2)]
    signed = [x * np.abs(x) for x in driven]
    at = np.arange(len(run.time_s))
    rates = [np.gradient(x) if at.size > 1 else np.zeros_like(x) for x in inputs]
    now = np.column_stack([*plain, *products, *signed, *rates])
    moving = np.column_stack([*inputs[:3], inputs[-1], inputs[0] * inputs[1], *signed])
    late = [moving[np.clip(at - lag, 0, at.size - 1)] for lag in LAGS if lag]
    return np.hstack([now, *late])


def _predicted(columns: Array, target: Array, test: Array) -> Array:
    """Return what a Bayesian linear regression of the target (n,) predicts for the test rows (m, k)."""
    from sklearn.linear_model import BayesianRidge

    known = np.isfinite(target) & np.isfinite(columns).all(axis=1)
    mean, spread = columns[known].mean(axis=0), columns[known].std(axis=0)
    use = spread > LEAST_RANGE
    if not use.any() or not target[known].std() > 0.0:
        return np.full(len(test), float(target[known].mean()) if known.any() else 0.0)
    ridge = BayesianRidge()
    ridge.fit((columns[known][:, use] - mean[use]) / spread[use], target[known])
    out: Array = ridge.predict(np.nan_to_num((test[:, use] - mean[use]) / spread[use]))
    return out
