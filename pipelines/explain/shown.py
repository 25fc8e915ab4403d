"""Runs as figures show them, and the stretch of a run that is shown as an example."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipelines.explain.results import DiagnosedRuns
from pipelines.reporting.numbers import shorten
from terrain.discrepancy.extend import rows_before_after
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.residuals import INPUTS, Rows
from terrain.effects import CHANNELS
from terrain.records import Array

STRETCH_S = 20.0
"""Length of the stretch that is drawn large."""

STRETCH_STEP_S = 1.0
"""Distance of the stretches among which it is chosen."""

EXAMPLE_QUANTILE = 0.8
"""Quantile of the residuals' size at which the example is chosen, among runs and among stretches of a run."""

INPUT_LABELS = {
    "speed_mps": "speed [m/s]",
    "turn_mps": "turn [m/s]",
    "steer_rad": "steering [rad]",
    "grade_rad": "grade [rad]",
    "roll_rad": "roll [rad]",
    "force_ratio": "force [weight]",
}
"""Inputs of the simulation over which residuals are drawn."""


class ShownRun(NamedTuple):
    """A run as it is drawn, low-pass filtered.

    Parameters
    ----------
    run_id, terrain : of the run
    held_out : whether it was held out of the diagnosis
    time_s : (m,)
    pace_mps : (m,) speed of the wheels, with which noise grows
    measured, before : (m, channels)
    after : (m, channels) with the causes built in; None where none was named
    inputs : (m,) of the simulation, by name and unit
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

    def part(self, start_s: float, end_s: float) -> ShownRun:
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

    @property
    def title(self) -> str:
        """Title of the whole run."""
        name = shorten(self.run_id, 40) + (f", {shorten(self.terrain, 24)}" if self.terrain else "")
        return name + (", held out" if self.held_out else "")

    @property
    def stretch_title(self) -> str:
        """Title of a stretch."""
        name = shorten(self.run_id, 40) + (f", {shorten(self.terrain, 24)}" if self.terrain else "")
        return f"{name}: {self.time_s[0]:.0f} to {self.time_s[-1]:.0f} s"


def shown_runs(diagnosed: DiagnosedRuns) -> list[ShownRun]:
    """Return all runs as they are drawn, those behind the diagnosis first; excluded ones are left out."""
    excluded = {run.run_id for run in diagnosed.diagnosis.excluded_runs}
    runs = []
    for run in (*diagnosed.used, *diagnosed.held_out):
        if run.run_id in excluded:
            continue
        before, after = rows_before_after(diagnosed.simulation, diagnosed.extended, run, diagnosed.low_pass)
        if len(before.time_s):
            runs.append(
                ShownRun(
                    run_id=before.run_id,
                    terrain=before.terrain,
                    held_out=run in diagnosed.held_out,
                    time_s=before.time_s,
                    pace_mps=before.pace_mps,
                    measured=before.measured,
                    before=before.predicted,
                    after=None if after is None else after.predicted,
                    inputs=_inputs(before),
                )
            )
    return runs


def _inputs(rows: Rows) -> dict[str, Array]:
    columns = {INPUT_LABELS[name]: rows.inputs[:, i] for i, name in enumerate(INPUTS) if name in INPUT_LABELS}
    return columns | {"time [s]": rows.time_s}


def channels_of(runs: Sequence[ShownRun]) -> list[str]:
    """Return the channels that any run has."""
    seen = np.any([np.isfinite(run.measured).any(axis=0) for run in runs], axis=0)
    return [name for name, there in zip(CHANNELS, seen, strict=True) if there]


def residual_size(run: ShownRun, noise: Noise) -> float:
    """Return the mean squared residual of a run over that of noise, before; NaN where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = ((run.measured - run.before) / noise.size(run.pace_mps)) ** 2
    known = squared[np.isfinite(squared)]
    return float(known.mean()) if known.size else math.nan


def example_stretch(runs: Sequence[ShownRun], noise: Noise, span_s: float = STRETCH_S) -> ShownRun:
    """Return a stretch of a run whose residuals over the noise are larger than most, not the largest."""

    def size(run: ShownRun) -> float:
        return residual_size(run, noise)

    run = _at_quantile(runs, size)
    starts = np.arange(run.time_s[0], max(run.time_s[-1] - span_s, run.time_s[0]) + 1e-9, STRETCH_STEP_S)
    return _at_quantile([run.part(start, start + span_s) for start in starts], size)


def _at_quantile(runs: Sequence[ShownRun], size: Callable[[ShownRun], float]) -> ShownRun:
    sizes = np.array([size(run) for run in runs])
    order = [i for i in np.argsort(sizes, kind="stable") if np.isfinite(sizes[i])]
    return runs[order[round(EXAMPLE_QUANTILE * (len(order) - 1))]] if order else runs[0]
