"""Whether a filter's covariance fits its errors: squared innovations, and errors where the truth is known.

NIS nu' S^-1 nu and NEES e' P^-1 e follow a chi-square law with as many degrees of freedom as nu and e have
entries (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4):
on average one a degree.  Over that, the filter is overconfident; under it, conservative.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from terrain.angles import wrapped
from terrain.errors import DataError
from terrain.estimation.filter import Filter, FilterModel, FilterSettings, Noise
from terrain.records import GATED, USED, Array, StateTrack

OUTSIDE = 0.05
"""Probability outside the bounds, half on each side."""

MOST_GATED = 0.01
"""A sensor of which a larger fraction is gated does not have the noise of the model: 0.01 % is expected."""


class ConsistencyVerdict(StrEnum):
    """How squared errors compare with their chi-square bounds; unknown where there are none."""

    CONSISTENT = "consistent"
    OVERCONFIDENT = "overconfident"
    CONSERVATIVE = "conservative"
    UNKNOWN = "unknown"


class Consistency(NamedTuple):
    """How the errors of one sensor, or of one group of states, agree with the covariance of the filter.

    ``n_independent`` is the effective number of independent values among the n.
    """

    name: str
    n: int
    n_independent: float
    mean_per_dof: float
    low: float
    high: float
    share_outside: float
    gated_fraction: float
    verdict: ConsistencyVerdict


class ConsistencyReport(NamedTuple):
    """NIS of each sensor, and NEES of each group of states of which the truth is known."""

    sensors: tuple[Consistency, ...]
    states: tuple[Consistency, ...]


def consistency_report(track: StateTrack, truth: Array | None = None) -> ConsistencyReport:
    """Judge a track by its innovations, and by the truth where there is one.

    Parameters
    ----------
    track : what the filter gave
    truth : (n, d) in the order of the track's states and at its times; NaN where it is not known

    Returns
    -------
    ConsistencyReport
        the mean per degree of freedom is judged by the two-sided 95 % bounds for as many independent
        values as there are.  States are grouped as their names are (``speed`` has x and y), and all that
        are known together are ``all``.

    Raises
    ------
    DataError
        where the shape of the truth does not fit.
    """
    sensors = []
    for k, name in enumerate(track.sensors):
        used, gated = track.use[:, k] == USED, track.use[:, k] == GATED
        came = int(used.sum() + gated.sum())
        gated_fraction = float(gated.sum() / came) if came else 0.0
        sensors.append(_judge(name, track.nis[used, k], track.nis_dof[used, k], gated_fraction))
    states = []
    if truth is not None:
        values = _fitting(truth, track, track.states)
        known = [state for j, state in enumerate(track.states) if np.isfinite(values[:, j]).any()]
        groups: dict[str, list[str]] = {}
        for state in known:
            groups.setdefault(_group_of(state), []).append(state)
        if len(groups) > 1:
            groups["all"] = known
        for name, members in groups.items():
            squares = nees(track, values[:, [track.states.index(state) for state in members]], members)
            squares = squares[np.isfinite(squares)]
            states.append(_judge(name, squares, np.full(squares.size, len(members)), 0.0))
    return ConsistencyReport(tuple(sensors), tuple(states))


def nees(track: StateTrack, truth: Array, states: Sequence[str] | None = None) -> Array:
    """Return the squared error of each instant over its covariance (n,); NaN where the truth is.

    Parameters
    ----------
    track : what the filter gave
    truth : (n, d) at the track's times, one column a state
    states : the d states in question; all of them without.  Errors of angles (names in ``rad``) are wrapped

    Raises
    ------
    DataError
        where the shape does not fit, or there is no such state.
    """
    states = track.states if states is None else tuple(states)
    for unknown in (state for state in states if state not in track.states):
        raise DataError(f"the track has no state {unknown!r}: it has {', '.join(track.states)}")
    values = _fitting(truth, track, states)
    index = [track.states.index(state) for state in states]
    error = track.mean[:, index] - values
    angles = [i for i, state in enumerate(states) if state.endswith("_rad")]
    error[:, angles] = wrapped(error[:, angles])
    solved = np.linalg.solve(track.cov[:, index][:, :, index], error[..., None])[..., 0]
    squares: Array = np.einsum("ni,ni->n", error, solved)
    return squares


def _fitting(truth: Array, track: StateTrack, states: Sequence[str]) -> Array:
    values = np.asarray(truth, dtype=np.float64)
    if values.shape != (track.time_s.size, len(states)):
        raise DataError(f"truth has shape {values.shape}, {(track.time_s.size, len(states))} is needed")
    return values


def sample_from_model(
    model: FilterModel, noise: Noise, n: int, dt_s: float, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Draw a truth and its measurements from a filter's own equations: on these it has to be consistent.

    Parameters
    ----------
    model, noise : the filter; the truth starts from its initial mean and variance
    n : number of samples
    dt_s : their spacing
    rng : source of the noise

    Returns
    -------
    time_s (n,), truth (n, d), z (n, m)
    """
    d, m = len(model.states), len(model.rows)
    start = Filter(model, noise)
    x = start.mean + np.linalg.cholesky(start.cov) @ rng.standard_normal(d)
    values, vectors = np.linalg.eigh(noise.process_variance * dt_s)
    walk = rng.standard_normal((n, d)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    z = rng.standard_normal((n, m)) * np.sqrt(noise.measurement_variance)
    is_angle_state = np.array([name in model.angle_states for name in model.states])
    is_angle_row = np.array([name in model.angle_rows for name in model.rows])
    params = np.append(model.params, np.zeros(len(model.inputs)))
    truth, x_next, z_hat = np.empty((n, d)), np.zeros(d), np.zeros(m)
    for k in range(n):
        if k > 0:
            model.propagate(x, dt_s, params, x_next, np.zeros((d, d)))
            x = x_next + walk[k]
            x[is_angle_state] = wrapped(x[is_angle_state])
        truth[k] = x
        model.observe(x, params, z_hat, np.zeros((m, d)))
        z[k] += z_hat
    z[:, is_angle_row] = wrapped(z[:, is_angle_row])
    return np.arange(n) * dt_s, truth, z


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """Measurement minus prediction at each instant of a track; NaN where there is none, as after a gap.

    Parameters
    ----------
    time_s : (n,)
    rows : name of each of the m measurements
    value : (n, m)
    std : (n, m) what the filter expected of it, ``sqrt(diag(H P H' + R))`` with the predicted P
    """

    time_s: Array
    rows: tuple[str, ...]
    value: Array
    std: Array

    def row(self, name: str) -> tuple[Array, Array]:
        """Return value (n,) and std (n,) of one measurement."""
        i = self.rows.index(name)
        return self.value[:, i], self.std[:, i]


def innovations(
    model: FilterModel,
    noise: Noise,
    track: StateTrack,
    z: Array,
    max_gap_s: float = FilterSettings.max_gap_s,
    inputs: Array | None = None,
) -> Innovations:
    """Return the innovations of a track, from one step to the next.

    Parameters
    ----------
    model, noise : of the filter that made the track
    track : its states
    z : (n, m) the measurements at the track's times
    max_gap_s : of the filter: over more than that nothing was predicted
    inputs : (n, k) of the step up to each time; zeros without
    """
    n, d, m = len(track.time_s), len(model.states), len(model.rows)
    value, std = np.full((2, n, m), np.nan)
    variance = np.broadcast_to(noise.measurement_variance, (n, m))
    known = np.zeros((n, len(model.inputs))) if inputs is None else inputs
    walk = np.zeros((n, d)) if noise.walk_variance is None else noise.walk_variance
    x_next, z_hat = np.zeros(d), np.zeros(m)
    is_angle = np.array([row in model.angle_rows for row in model.rows])
    for k in range(1, n):
        dt_s = track.time_s[k] - track.time_s[k - 1]
        if dt_s > max_gap_s:
            continue
        f, h, params = np.zeros((d, d)), np.zeros((m, d)), np.append(model.params, known[k])
        model.propagate(np.array(track.mean[k - 1]), dt_s, params, x_next, f)
        model.observe(x_next, params, z_hat, h)
        predicted = f @ track.cov[k - 1] @ f.T + (noise.process_variance + np.diag(walk[k])) * dt_s
        value[k] = z[k] - z_hat
        std[k] = np.sqrt(np.einsum("ij,jk,ik->i", h, predicted, h) + variance[k])
    value[:, is_angle] = wrapped(value[:, is_angle])
    std[np.isnan(value)] = np.nan
    return Innovations(track.time_s, model.rows, value, std)


def _judge(name: str, squares: Array, dof: Array, gated_fraction: float) -> Consistency:
    """Compare squares (n,), each of so many degrees of freedom, with chi-square."""
    if not squares.size:
        nan = float("nan")
        return Consistency(
            name,
            0,
            0.0,
            nan,
            nan,
            nan,
            nan,
            gated_fraction,
            ConsistencyVerdict.OVERCONFIDENT if gated_fraction else ConsistencyVerdict.UNKNOWN,
        )
    dof = dof.astype(np.float64)
    n_independent = _independent(squares / dof)
    total = n_independent * dof.mean()
    low, high = (float(chdtri(total, p)) / total for p in (1 - OUTSIDE / 2, OUTSIDE / 2))
    mean = float(squares.sum() / dof.sum())
    outside = (squares < chdtri(dof, 1 - OUTSIDE / 2)) | (squares > chdtri(dof, OUTSIDE / 2))
    verdict = ConsistencyVerdict.CONSISTENT
    if mean > high or gated_fraction > MOST_GATED:
        verdict = ConsistencyVerdict.OVERCONFIDENT
    elif mean < low:
        verdict = ConsistencyVerdict.CONSERVATIVE
    return Consistency(
        name, squares.size, n_independent, mean, low, high, float(outside.mean()), gated_fraction, verdict
    )


def _independent(values: Array) -> float:
    """Return how many independent values say as much on the mean: n over the autocorrelation time."""
    n = values.size
    centred = values - values.mean()
    spectrum = np.fft.rfft(centred, 2 * n)
    correlation = np.fft.irfft(spectrum * spectrum.conj())[:n]
    if correlation[0] <= 0:
        return float(n)
    rho = correlation / correlation[0]
    negative = np.flatnonzero(rho <= 0)
    end = int(negative[0]) if negative.size else n
    return float(n / max(1.0, 1 + 2 * rho[1:end].sum()))


def _group_of(state: str) -> str:
    """Return a state's name without axis, number and unit.

    Examples
    --------
    >>> _group_of("slip_speed_2_mps"), _group_of("yaw_rad")
    ('slip_speed', 'yaw')
    """
    return re.sub(r"(_[xyz\d])?_[a-z0-9]+$", "", state)
