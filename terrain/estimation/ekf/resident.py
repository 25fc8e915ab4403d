"""The filter step on memory that stays: for loops that cannot wait."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numba.core.types.function_type import CompileResultWAP

from terrain.entry_point import entry_point
from terrain.errors import DataError
from terrain.estimation.ekf.arrays import FilterArrays, Memory, SampleArrays
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
    columns_of,
    dropped_counts,
    in_one,
    initial_state,
    memory_of,
    noise_arrays,
)
from terrain.records import Array

BIASES = ("gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2")
"""States that are of a sensor, and stay what they are while the robot does anything."""

_follows, _run = entry_point(follows), entry_point(run)


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
        d, m = len(model.states), len(model.rows)
        first = memory_of(initial_state(model, noise))
        floats, moved = in_one(first[:4])
        self._memory = Memory(moved[0], moved[1], moved[2], moved[3], first.counts)
        self.buffers = floats, first.counts
        self._columns, self._sensors = columns_of(model, 1), model.sensor_names
        self._noise_variance = noise.measurement_variance
        self._states, self._walk = model.states, np.diagonal(noise.process_variance)
        rows = np.empty((1, m)), np.empty((1, m)), np.zeros((1, d)), np.zeros((1, len(model.inputs)))
        self._sample = SampleArrays(np.empty(1), *rows)
        self.functions = _addresses(model)
        self.arrays = FilterArrays(
            model.arrays,
            noise_arrays(model, noise, settings),
            self._sample,
            self._memory,
            self._columns,
        )
        self.mean, self.cov, self.use = self._memory.x, self._memory.p, self._columns.use[0]

    def step(self, time_s: float, z: Array, given: Given = NOTHING_GIVEN) -> bool:
        """Take in one sample; return False where its stamp did not advance, or leapt."""
        r, walk, inputs = given
        sample = self._sample
        sample.stamps[0], sample.values[0] = time_s, z
        sample.variances[0] = self._noise_variance if r is None else r
        sample.walks[0] = 0.0 if walk is None else walk
        sample.inputs[0] = 0.0 if inputs is None else inputs
        _run(self.arrays, *self.functions)
        return bool(self._columns.taken[0])

    def known(self, states: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation of those of some states that the filter has, by name."""
        places = {name: self._states.index(name) for name in states if name in self._states}
        return {name: (float(self.mean[i]), math.sqrt(float(self.cov[i, i]))) for name, i in places.items()}

    def begin_from(self, known: Mapping[str, tuple[float, float]], age_s: float) -> tuple[str, ...]:
        """Start from what was known of some states; return the names of those that are used.

        Parameters
        ----------
        known : mean and standard deviation by name of the state
        age_s : time since then, for which each walks; none is believed less than without it

        Raises
        ------
        DataError
            if a sample was taken already.
        """
        if not math.isnan(self._memory.clock[0]):
            raise DataError("a filter that runs cannot start from another state")
        used = [name for name in known if name in self._states]
        for name in used:
            i = self._states.index(name)
            mean, std = known[name]
            variance = std**2 + float(self._walk[i]) * age_s
            if variance < self.cov[i, i]:
                self.mean[i], self.cov[i, i] = mean, variance
        return tuple(used)

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        found: int = _follows(time_s, self._memory.clock, self.arrays.noise.max_gap_s)
        return found

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
