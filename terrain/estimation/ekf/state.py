"""What a filter carries from one sample to the next, and the arrays that hold it for the kernel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from terrain.errors import DataError
from terrain.estimation.ekf.arrays import Columns, Memory, NoiseArrays
from terrain.estimation.ekf.kernel import PER_ROW, PER_SENSOR
from terrain.estimation.ekf.model import FilterModel, FilterSettings, Noise
from terrain.records import Array

_SLACK_S = 1e-9  # what sums of steps may be off by


class FilterState(NamedTuple):
    """All that a filter carries from one sample to the next; :func:`initial_state` makes the first.

    ``mean`` to ``log_likelihood`` are what :class:`~terrain.records.StateTrack` holds of one instant; the
    rest is the filter's own.  ``time_s`` is NaN before the first sample.
    """

    time_s: float
    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: float
    log_likelihood: float
    pending_time_s: float
    rejected_s: Array
    counts: Array
    sensors: tuple[str, ...]

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not taken so far, as counts by kind."""
        return dropped_counts(self.sensors, self.counts)


def initial_state(model: FilterModel, noise: Noise) -> FilterState:
    """Return what a filter knows before the first sample."""
    k = len(model.sensors)
    return FilterState(
        math.nan,
        model.initial_mean,
        _initial_variance(model, noise),
        np.full(k, np.nan),
        np.zeros(k, np.int8),
        np.zeros(k, np.int8),
        math.inf,
        0.0,
        math.nan,
        np.full(k, -1.0),
        np.zeros(len(PER_ROW) + k * len(PER_SENSOR), np.int64),
        model.sensor_names,
    )


def columns_of(model: FilterModel, n: int, *, keep: bool = True) -> Columns:
    """Return columns for n samples, those but ``taken`` without rows unless kept; no sensor was used yet."""
    d, k, rows = len(model.states), len(model.sensors), n if keep else 0
    return Columns(
        np.empty((rows, d)),
        np.empty((rows, d, d)),
        np.full((rows, k), np.nan),
        np.zeros((rows, k), np.int8),
        np.zeros((rows, k), np.int8),
        np.empty(rows),
        np.zeros(n, np.bool_),
    )


def in_one(arrays: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Return one buffer that holds copies of arrays of one type, and the arrays as views of it.

    Examples
    --------
    >>> buffer, (one, two) = in_one([np.zeros(2), np.ones((2, 2))])
    >>> two[0, 1] = 5.0
    >>> buffer.tolist()
    [0.0, 0.0, 1.0, 5.0, 1.0, 1.0]
    """
    buffer = np.concatenate([np.ravel(array) for array in arrays])
    ends = np.cumsum([np.size(array) for array in arrays])
    parts = np.split(buffer, ends[:-1])
    return buffer, [part.reshape(np.shape(array)) for part, array in zip(parts, arrays, strict=True)]


def memory_of(state: FilterState) -> Memory:
    """Return copies of what the kernel moves."""
    clock = [state.time_s, state.pending_time_s, state.reference_age_s, state.log_likelihood]
    moved = (state.mean, state.cov, clock, state.rejected_s, state.counts)
    return Memory(*(np.array(part, order="C") for part in moved))


def dropped_counts(sensors: tuple[str, ...], counts: Array) -> dict[str, int]:
    """Return the counts that are not zero, by kind."""
    kinds = (*PER_ROW, *(f"{sensor} {what}" for sensor in sensors for what in PER_SENSOR))
    return {kind: count for kind, count in zip(kinds, counts.tolist(), strict=True) if count}


def _initial_variance(model: FilterModel, noise: Noise) -> Array:
    return np.diag(model.initial_std**2) if noise.initial_variance is None else noise.initial_variance


@lru_cache(maxsize=16)
def noise_arrays(model: FilterModel, noise: Noise, settings: FilterSettings) -> NoiseArrays:
    """Return what the kernel is given of noise and settings, checked against the model."""
    d, m = len(model.states), len(model.rows)
    for name in ("process_variance", "initial_variance"):
        matrix = getattr(noise, name)
        if matrix is not None and len(matrix) != d:
            raise DataError(f"filter {model.name}: {name} is for {len(matrix)} states, it has {d}")
    if noise.measurement_variance.shape[-1] != m:
        given = noise.measurement_variance.shape[-1]
        raise DataError(f"filter {model.name}: measurement_variance is for {given} rows, it has {m}")
    return NoiseArrays(
        _initial_variance(model, noise).copy(),
        noise.process_variance.copy(),
        _gate_thresholds(model, settings),
        settings.reopen_after_s - _SLACK_S,
        settings.max_gap_s + _SLACK_S,
    )


@lru_cache(maxsize=16)
def _gate_thresholds(model: FilterModel, settings: FilterSettings) -> Array:
    """Return the largest squared innovation that is believed, by its number of rows."""
    widest = max(len(rows) for _, rows in model.sensors)
    found: Array = chdtri(np.arange(1.0, widest + 1), 1 - settings.gate_probability)
    return np.append(np.inf, found)
