"""The innovations of each measurement, for inspection: a filter keeps only their squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrain.angles import wrapped
from terrain.estimation.ekf.model import FilterModel, FilterSettings, Noise
from terrain.records import Array, StateTrack


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
