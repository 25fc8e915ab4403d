"""Runs beside the simulation, before and after causes are built in: for figures and sentences."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.noise import Noise
from terrain.discrepancy.residuals import INPUTS, LowPass, Rows, binned_means, input_range, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS
from terrain.records import Array

STRETCH_S = 20.0
"""Length of the stretch that is drawn large."""

STRETCH_STEP_S = 1.0
"""Distance of the stretches among which it is chosen."""

EXAMPLE_QUANTILE = 0.8
"""Quantile of the residuals' size at which the example is chosen, among runs and among stretches of a run."""

MIN_SPREAD = 0.01
"""Range of an input in its own unit, below which no dependence can be seen."""


class ComparedRun(NamedTuple):
    """A run beside the simulation, low-pass filtered, faults repaired.

    Parameters
    ----------
    run_id, terrain : of the run
    held_out : whether it was held out of the diagnosis
    time_s : (m,)
    pace_mps : (m,) speed of the wheels, with which noise grows
    measured, before : (m, channels)
    after : (m, channels) with the causes built in; None where none was named
    inputs : (m,) of the simulation, by the names of :data:`terrain.discrepancy.residuals.INPUTS`, and
        ``time_s``
    """

    run_id: str
    terrain: str
    held_out: bool
    time_s: Array
    pace_mps: Array
    measured: Array
    before: Array
    after: Array | None
    inputs: Mapping[str, Array]

    def part(self, start_s: float, end_s: float) -> ComparedRun:
        """Return the stretch from start to end."""
        keep = (self.time_s >= start_s) & (self.time_s <= end_s)
        return self._replace(
            time_s=self.time_s[keep],
            pace_mps=self.pace_mps[keep],
            measured=self.measured[keep],
            before=self.before[keep],
            after=None if self.after is None else self.after[keep],
            inputs={name: values[keep] for name, values in self.inputs.items()},
        )

    def residual(self, extended: bool) -> Array:
        """Return measured minus simulated (m, channels), by the extended simulation or the one before."""
        simulated = self.after if extended else self.before
        assert simulated is not None
        return self.measured - simulated


def compare_runs(
    simulation: Simulation,
    extended: Simulation | None,
    signals: Sequence[Signals],
    low_pass: LowPass,
    held_out: bool = False,
) -> tuple[ComparedRun, ...]:
    """Return runs beside the simulation, and beside the extended one if any; too short ones are left out."""
    compared = []
    for run in signals:
        planar = simulation.planar_on(run.terrain)
        before = rows_of(run, planar, simulation.vector, (), low_pass)
        if not len(before.time_s):
            continue
        after = None if extended is None else rows_of(run, planar, extended.vector, (), low_pass).predicted
        compared.append(
            ComparedRun(
                before.run_id,
                before.terrain,
                held_out,
                before.time_s,
                before.pace_mps,
                before.measured,
                before.predicted,
                after,
                _inputs(before),
            )
        )
    return tuple(compared)


def _inputs(rows: Rows) -> dict[str, Array]:
    named = {name: rows.inputs[:, i] for i, name in enumerate(INPUTS) if not name.endswith("phase_rad")}
    return named | {"time_s": rows.time_s}


def channels_of(runs: Sequence[ComparedRun]) -> list[str]:
    """Return the channels that any run has."""
    seen = np.any([np.isfinite(run.measured).any(axis=0) for run in runs], axis=0)
    return [name for name, there in zip(CHANNELS, np.atleast_1d(seen), strict=True) if there]


def rms_of(runs: Sequence[ComparedRun], channel: str, extended: bool) -> float:
    """Return the root mean square of measured minus simulated in a channel; NaN where nothing is known."""
    c = CHANNELS.index(channel)
    left = np.concatenate([run.residual(extended)[:, c] for run in runs] or [np.empty(0)])
    known = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def residual_size(run: ComparedRun, noise: Noise) -> float:
    """Return the mean squared residual of a run over that of noise, before; NaN where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = ((run.measured - run.before) / noise.size(run.pace_mps)) ** 2
    known = squared[np.isfinite(squared)]
    return float(known.mean()) if known.size else math.nan


def example_stretch(runs: Sequence[ComparedRun], noise: Noise, span_s: float = STRETCH_S) -> ComparedRun:
    """Return a stretch of a run whose residuals over the noise are larger than most, not the largest."""

    def size(run: ComparedRun) -> float:
        return residual_size(run, noise)

    run = _at_quantile(runs, size)
    starts = np.arange(run.time_s[0], max(run.time_s[-1] - span_s, run.time_s[0]) + 1e-9, STRETCH_STEP_S)
    return _at_quantile([run.part(start, start + span_s) for start in starts], size)


def _at_quantile(runs: Sequence[ComparedRun], size: Callable[[ComparedRun], float]) -> ComparedRun:
    sizes = np.array([size(run) for run in runs])
    order = [i for i in np.argsort(sizes, kind="stable") if np.isfinite(sizes[i])]
    return runs[order[round(EXAMPLE_QUANTILE * (len(order) - 1))]] if order else runs[0]


def strongest_input(runs: Sequence[ComparedRun], channel: str) -> str:
    """Return the input over whose bins the mean residual of a channel, before, is largest beyond its error.

    Raises
    ------
    ValueError
        if there is no run.
    """
    c = CHANNELS.index(channel)
    residuals = [run.residual(False)[:, c] for run in runs]

    def size(name: str) -> float:
        found = binned_means([run.inputs[name] for run in runs], residuals)
        error = np.nan_to_num(found.half_interval) / 1.96
        return float(np.mean(found.mean**2 - error**2)) if found.mean.size else -math.inf

    return max(
        (name for name in runs[0].inputs if spread_of(runs, name) > MIN_SPREAD), key=size, default="time_s"
    )


def spread_of(runs: Sequence[ComparedRun], name: str) -> float:
    """Return the range of an input over all runs, outliers left out; 0 where it is not known."""
    values = np.concatenate([run.inputs[name] for run in runs])
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    low, high = input_range(known)
    return high - low


def telling_runs(runs: Sequence[ComparedRun], noise: Noise, n: int) -> list[ComparedRun]:
    """Return so many runs, from the largest residual over the noise to the smallest."""
    if n <= 0:
        return []
    sizes = np.nan_to_num([residual_size(run, noise) for run in runs], nan=-1.0)
    order = np.argsort(-sizes, kind="stable")
    if n >= len(runs):
        return list(runs)
    places = np.unique(np.linspace(0, len(runs) - 1, n).round().astype(int))
    return [runs[order[place]] for place in places]


def without_levels(noise: Noise, runs: Sequence[ComparedRun]) -> Noise:
    """Return the noise with the size that it has without levels and what depends on an input.

    A whitening filter is fitted to all that no effect explains, so that its size holds a constant offset too;
    ``noise.std`` is of what is left when the probes are taken off as well.
    """
    sizes = np.concatenate([noise.size(run.pace_mps) for run in runs]) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = noise.std**2 / sizes.mean(axis=0)
    return noise._replace(growth=noise.growth * np.minimum(factor, 1.0)[:, None])
