"""What the loop of the filters is given, moves and writes, in groups; :data:`FILTER_ARRAYS` is their type."""

from __future__ import annotations

from typing import NamedTuple

from numba import boolean, float64, int8, int64, types

from terrain.records import Array

_VECTOR, _MATRIX, _FLAGS, _COUNTS = float64[::1], float64[:, ::1], boolean[::1], int64[::1]


class ModelArrays(NamedTuple):
    """What is fixed by a model.

    Parameters
    ----------
    params : of its functions, the inputs of a sample behind them
    order, starts : places of the rows, sensor by sensor, and where each sensor begins among them
    is_reference, is_held : of each sensor
    is_angle_row : of each row
    is_angle_state, is_position : of each state
    x0 : (d,) the first state
    """

    params: Array
    order: Array
    starts: Array
    is_reference: Array
    is_held: Array
    is_angle_row: Array
    is_angle_state: Array
    is_position: Array
    x0: Array


class NoiseArrays(NamedTuple):
    """What is fixed by noise and settings.

    Parameters
    ----------
    p0, q : (d, d) the first covariance, and what is added to it a second
    thresholds : largest squared innovation that is believed, by its number of rows
    reopen_after_s, max_gap_s : of the settings
    """

    p0: Array
    q: Array
    thresholds: Array
    reopen_after_s: float
    max_gap_s: float


class SampleArrays(NamedTuple):
    """Samples, and what is known of each, or in one row of all, beside its measurements.

    Parameters
    ----------
    stamps : (n,)
    values : (n, m)
    variances, walks, inputs : (n, m), (n, d) and (n, k), or with one row
    """

    stamps: Array
    values: Array
    variances: Array
    walks: Array
    inputs: Array


class Memory(NamedTuple):
    """What is moved from sample to sample."""

    x: Array
    p: Array
    clock: Array
    rejected_s: Array
    counts: Array


class Columns(NamedTuple):
    """What is written of each sample: all but ``taken`` only where they have rows."""

    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: Array
    taken: Array


class FilterArrays(NamedTuple):
    """All that the loop is given beside the functions of the model."""

    model: ModelArrays
    noise: NoiseArrays
    samples: SampleArrays
    memory: Memory
    columns: Columns


_TYPES: dict[type, tuple[types.Type, ...]] = {
    ModelArrays: (_VECTOR, _COUNTS, _COUNTS, *[_FLAGS] * 5, _VECTOR),
    NoiseArrays: (_MATRIX, _MATRIX, _VECTOR, float64, float64),
    SampleArrays: (_VECTOR, *[_MATRIX] * 4),
    Memory: (_VECTOR, _MATRIX, _VECTOR, _VECTOR, _COUNTS),
    Columns: (_MATRIX, float64[:, :, ::1], _MATRIX, int8[:, ::1], int8[:, ::1], _VECTOR, _FLAGS),
}

FILTER_ARRAYS = types.NamedTuple(
    tuple(types.NamedTuple(fields, group) for group, fields in _TYPES.items()), FilterArrays
)
"""Their type in compiled code."""
