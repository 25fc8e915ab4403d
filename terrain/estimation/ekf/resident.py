"""The filter step on memory that stays: for loops that cannot wait."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.core.types.function_type import CompileResultWAP

from terrain.entry_point import entry_point
from terrain.errors import DataError
from terrain.estimation.ekf.kernel import AGE, OBSERVE, PROPAGATE, follows, run
from terrain.estimation.ekf.model import (
    DEFAULT_SETTINGS,
    NOTHING_GIVEN,
    FilterModel,
    FilterSettings,
    Given,
    Noise,
)
from terrain.estimation.ekf.state import (
    SLACK_S,
    Columns,
    Memory,
    dropped_counts,
    gate_thresholds,
    in_one,
    initial_state,
    matrices_of,
    memory_of,
)
from terrain.records import Array

_follows, _run = entry_point(follows), entry_point(run)


class FilterArrays(NamedTuple):
    """What the kernel is given beside the model's functions, in its order; one row of each column.

    Parameters
    ----------
    params to position : of the model
    x0 to max_gap_s : first state, noise, gates, and what is known of a sample
    stamps, values : of the sample
    x to counts : the memory
    mean to taken : what is written of the sample
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
    p0: Array
    q: Array
    thresholds: Array
    variances: Array
    walks: Array
    inputs: Array
    reopen_after_s: float
    max_gap_s: float
    stamps: Array
    values: Array
    x: Array
    p: Array
    clock: Array
    rejected_s: Array
    counts: Array
    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: Array
    taken: Array


@njit(cache=True, error_model="numpy")
def run_resident(arrays: FilterArrays, propagate: Any, observe: Any) -> None:
    """Filter one sample; arguments one by one and functions last, as numba warns of tuples of functions."""
    run(
        arrays.params,
        arrays.order,
        arrays.starts,
        arrays.is_reference,
        arrays.is_held,
        arrays.is_angle_row,
        arrays.is_angle_state,
        arrays.is_position,
        arrays.x0,
        arrays.p0,
        arrays.q,
        arrays.thresholds,
        arrays.variances,
        arrays.walks,
        arrays.inputs,
        arrays.reopen_after_s,
        arrays.max_gap_s,
        arrays.stamps,
        arrays.values,
        arrays.x,
        arrays.p,
        arrays.clock,
        arrays.rejected_s,
        arrays.counts,
        arrays.mean,
        arrays.cov,
        arrays.nis,
        arrays.nis_dof,
        arrays.use,
        arrays.reference_age_s,
        arrays.taken,
        propagate,
        observe,
    )


class ResidentFilter:
    """A filter that keeps its memory, for loops that cannot wait: the numbers of :func:`filter_step`.

    Parameters
    ----------
    model, noise, settings : as of :func:`run_filter`; the measurement variance is (m,)

    Raises
    ------
    DataError
        where the noise does not fit the model, or changes from sample to sample.

    Notes
    -----
    ``functions`` and ``arrays`` are what the kernel is given; ``mean`` and ``cov`` are the memory itself,
    which the next step writes over; ``buffers`` are all of it, for callers that go back to an earlier step.
    Most of what :func:`filter_step` takes goes into copies and into finding the model's compiled functions
    anew.
    """

    def __init__(self, model: FilterModel, noise: Noise, settings: FilterSettings = DEFAULT_SETTINGS) -> None:
        if noise.measurement_variance.ndim != 1:
            raise DataError(f"filter {model.name}: measurement_variance must be (m,) for a step at a time")
        p0, q = matrices_of(model, noise)
        d, k, m = len(model.states), len(model.sensors), len(model.rows)
        first = memory_of(initial_state(model, noise))
        floats, moved = in_one(first[:4])
        self._memory = Memory(moved[0], moved[1], moved[2], moved[3], first.counts)
        self.buffers = floats, first.counts
        self._columns = Columns(
            np.empty((1, d)),
            np.empty((1, d, d)),
            np.full((1, k), np.nan),
            np.zeros((1, k), np.int8),
            np.zeros((1, k), np.int8),
            np.empty(1),
            np.zeros(1, np.bool_),
        )
        self._sensors, self._max_gap_s = model.sensor_names, settings.max_gap_s + SLACK_S
        self._noise_variance, self._variance = noise.measurement_variance, np.empty((1, m))
        self._walk, self._inputs = np.zeros((1, d)), np.zeros((1, len(model.inputs)))
        self._stamp, self._z = np.empty(1), np.empty((1, m))
        self.functions = _addresses(model)
        given = (
            *model._constants,
            *(p0, q, gate_thresholds(model, settings), self._variance, self._walk, self._inputs),
            *(settings.reopen_after_s - SLACK_S, self._max_gap_s),
            *(self._stamp, self._z, *self._memory, *self._columns),
        )
        self.arrays = FilterArrays._make(given)
        self.mean, self.cov, self.use = self._memory.x, self._memory.p, self._columns.use[0]

    def step(self, time_s: float, z: Array, given: Given = NOTHING_GIVEN) -> bool:
        """Take in one sample; return False where its stamp did not advance, or leapt."""
        r, walk, inputs = given
        self._stamp[0] = time_s
        self._z[0] = z
        self._variance[0] = self._noise_variance if r is None else r
        self._walk[0] = 0.0 if walk is None else walk
        self._inputs[0] = 0.0 if inputs is None else inputs
        _run(*self.arrays, *self.functions)
        return bool(self._columns.taken[0])

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        return _follows(time_s, self._memory.clock, self._max_gap_s)  # type: ignore[no-any-return]

    @property
    def reference_age_s(self) -> float:
        """Time since the speed over ground was last measured; infinite before the first."""
        return float(self._memory.clock[AGE])

    @property
    def nis(self) -> dict[str, float]:
        """NIS of each sensor at the last step, a row; NaN where it measured nothing or is not a number."""
        squares, rows = self._columns.nis[0].tolist(), self._columns.nis_dof[0].tolist()
        found = zip(self._sensors, squares, rows, strict=True)
        return {name: square / n if n else math.nan for name, square, n in found}

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not taken so far, as counts by kind."""
        return dropped_counts(self._sensors, self._memory.counts)


def _addresses(model: FilterModel) -> tuple[Any, Any]:
    """Return the addresses of a model's functions: finding them costs more than a step."""
    propagate, observe = (
        CompileResultWAP(f.overloads[tuple(signature.args)])
        for f, signature in ((model.propagate, PROPAGATE), (model.observe, OBSERVE))
    )
    return propagate, observe
