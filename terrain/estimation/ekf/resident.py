"""The filter step on memory that stays: for loops that cannot wait."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numba.core.types.function_type import CompileResultWAP

from terrain.errors import DataError
from terrain.estimation.ekf.kernel import AGE, OBSERVE, PENDING, PROPAGATE, TIME, run
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
    ``mean`` and ``cov`` are the memory itself, which the next step writes over; ``buffers`` are all of it,
    for callers that go back to an earlier step.  Most of what :func:`filter_step` takes goes into copies and
    into finding the model's compiled functions anew.
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
        self._run = _bound_run(model)
        self._arguments = (
            *model._constants[2:],
            *(p0, q, gate_thresholds(model, settings), self._variance, self._walk, self._inputs),
            *(settings.reopen_after_s - SLACK_S, self._max_gap_s),
            *(self._stamp, self._z, *self._memory, *self._columns),
        )
        self.mean, self.cov, self.use = self._memory.x, self._memory.p, self._columns.use[0]

    def step(self, time_s: float, z: Array, given: Given = NOTHING_GIVEN) -> bool:
        """Take in one sample; return False where its stamp did not advance, or leapt."""
        r, walk, inputs = given
        self._stamp[0] = time_s
        self._z[0] = z
        self._variance[0] = self._noise_variance if r is None else r
        self._walk[0] = 0.0 if walk is None else walk
        self._inputs[0] = 0.0 if inputs is None else inputs
        self._run(*self._arguments)
        return bool(self._columns.taken[0])

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        seen_s, pending_s = float(self._memory.clock[TIME]), float(self._memory.clock[PENDING])
        if not math.isfinite(time_s):
            return 0
        step_s = time_s - seen_s
        if abs(step_s) > self._max_gap_s:
            believed = 0.0 < time_s - pending_s <= self._max_gap_s
            return (1 if step_s > 0.0 else -1) if believed else 0
        return int(not step_s <= 0.0)

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


def _bound_run(model: FilterModel) -> Callable[..., Any]:
    """Return the loop for the functions of a model, by their addresses.

    The machine code is called directly: finding it, and that of the two functions, costs 17 us a call.
    """
    functions = zip((model.propagate, model.observe), (PROPAGATE, OBSERVE), strict=True)
    (compiled,) = run.overloads.values()
    addresses = (CompileResultWAP(f.overloads[tuple(signature.args)]) for f, signature in functions)
    return partial(compiled.entry_point, *addresses)
