"""How far runs deviate from an extended simulation that was fitted without them: see :mod:`terrain.deviation`.

Runs behind a fit are nearer to it than others are.  Each run, or session where there are several, is left out of the
fit in turn: the values of causes step to those that the others give, linearly, and terms are selected and fitted
without it (:func:`terrain.discrepancy.learner.learn_terms`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtri
from scipy.stats import t as student

from terrain.deviation import ChannelDeviation, Deviation
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.earned import units_of
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.learner import Learned
from terrain.discrepancy.noise import TINY, growth_of
from terrain.discrepancy.runs import LowPass, Signals, measured_channels
from terrain.effects import CHANNELS, GYRO, HEADING
from terrain.records import Array

COVERED = 0.95  #: Part of the rows of a further run that the band holds.
TAIL = 0.5 + 0.5 * COVERED  #: Probability up to its upper edge.
N_FITS = 5  #: Of a variance, each weighted by that of the one before.
MIN_UNITS = 3  #: Least number of runs, or sessions, that a deviation is estimated from.


def left_out_residuals(
    runs: Sequence[ComparedRun],
    signals: Sequence[Signals],
    info: Evidence,
    names: Sequence[str],
    learned: Mapping[str, Learned],
) -> list[Array]:
    """Return measured minus predicted (m, channels) of runs by fits without each of them.

    Parameters
    ----------
    runs : beside the extended simulation, with all terms that are kept
    signals : of the runs of the evidence, in its order
    info : around the values of the causes that are built in
    names : of their parameters
    learned : by channel, terms that are kept
    """
    steps = {
        run.run_id: step for run, step in zip(info.rows, _steps(info, names, units_of(signals)), strict=True)
    }
    change = {run.run_id: run.sensitivity[info.places(names)] for run in info.rows}
    residuals = []
    for run in runs:
        left = run.measured - run.simulated - np.tensordot(steps[run.run_id], change[run.run_id], axes=1)
        for shown, each in learned.items():
            if each.term is None or run.run_id not in each.left_out:
                continue
            for channel in {shown, GYRO} if each.term.channel == HEADING else {shown}:
                left[:, CHANNELS.index(channel)] += each.left_out[run.run_id]
        residuals.append(left)
    return residuals


def _steps(info: Evidence, names: Sequence[str], units: Sequence[str]) -> Array:
    """Return the change (runs, k) of parameters by a fit without the unit of each run."""
    a, g = info.clusters(info.places(names))
    unit = np.sqrt(np.maximum(np.einsum("kii->i", a), 1e-30))
    of, tiny = np.array(units), 1e-9 * np.eye(len(names))

    def fitted(rest: Array) -> Array:
        system = a[rest].sum(axis=0) / np.outer(unit, unit) + tiny
        return np.asarray(np.linalg.solve(system, g[rest].sum(axis=0) / unit) / unit)

    every = fitted(of == of)
    without = {name: fitted(of != name) - every for name in dict.fromkeys(units)}
    return np.array([without[name] for name in units])


def deviation_of(
    runs: Sequence[ComparedRun], left: Sequence[Array], units: Sequence[str], low_pass: LowPass
) -> Deviation:
    """Return the deviation of channels that were measured; without enough runs of a channel, of that none.

    Parameters
    ----------
    left : (m, channels) of :func:`left_out_residuals` of each run
    units : run or session by run
    """
    speed = np.concatenate([run.speed_mps for run in runs])
    turn = np.concatenate([run.inputs["turn_mps"] for run in runs])
    every, of = np.concatenate(left), np.repeat(units, [len(each) for each in left])
    powers, channels = np.column_stack([np.ones_like(speed), speed**2, turn**2]), {}
    for name in measured_channels(runs):
        r = every[:, CHANNELS.index(name)]
        known = np.isfinite(r)
        n = len(np.unique(of[known]))
        if n < MIN_UNITS or not r[known].any():
            continue
        rest, per_speed, per_turn = np.sqrt(growth_of(powers[known], r[known] ** 2, N_FITS)).tolist()
        own = ChannelDeviation(rest, per_speed, per_turn, 1.0, n)
        times_95 = _factor(r[known] / own.std(speed[known], turn[known]), of[known])
        channels[name] = own._replace(times_95=times_95)
    return Deviation(low_pass.cutoff_hz, low_pass.rate_hz, channels)


def _factor(ratio: Array, units: Array) -> float:
    """Return half of the 95 % interval over the standard deviation, of residuals over that (m,) and their units (m,).

    It is the quantile over all rows, times that of Student's t over a normal one.  Its degrees of freedom are those of
    the mean squares of units, as they scatter (Satterthwaite, Biometrics Bulletin 1946), or of the level of each, one
    number of a normal law: many where each unit shows the noise, as many as units where each has an offset of its own.
    A few have no such quantile: it is drawn to the normal one as if one row beyond that had been seen.
    """
    _, of, rows = np.unique(units, return_inverse=True, return_counts=True)
    n, square, part = len(rows), float(np.mean(ratio**2)), rows / len(ratio)
    apart = np.bincount(of, weights=ratio**2 - square) / len(ratio)
    level = float(part @ (np.bincount(of, weights=ratio) / rows) ** 2)
    scatter = max(n / (n - 1) * float(apart @ apart), 2.0 * level**2 * float(part @ part), TINY)
    freedom, normal = max(2.0 * square**2 / scatter, 1.0), float(ndtri(TAIL))
    known = freedom / (freedom + 1.0 / (1.0 - COVERED))
    quantile = known * np.quantile(np.abs(ratio), COVERED) + (1.0 - known) * normal * np.sqrt(square)
    return float(quantile * student.ppf(TAIL, freedom) / normal)
