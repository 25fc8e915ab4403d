"""What is done to runs before causes are searched: faults repaired, lags known, unfit runs excluded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.clocks import Shift, shifts_of
from terrain.discrepancy.evidence import Evidence, move_point
from terrain.discrepancy.health import Fault, faults_of, repaired, unfit_runs
from terrain.discrepancy.health.runs import Excluded
from terrain.discrepancy.latencies import Latencies, latencies_of, starting_values
from terrain.discrepancy.residuals import low_pass_of, rows_of
from terrain.discrepancy.search import Problem
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import Effect
from terrain.errors import DataError

MIN_RUNS = 3
"""Least number of runs: with fewer none is left to validate a fit."""

REST_MPS = 0.02
"""Fastest that a wheel turns, by its sensor's noise, in a run that does not drive."""


class Prepared(NamedTuple):
    """Runs that are fit to be compared.

    Parameters
    ----------
    problem : of these runs, faults repaired
    faults : that were found and repaired, in all runs that were given
    excluded : runs that are unfit
    seeds : lags of sensors, by parameter, that are so large that a search has to start from them
    aligned : information of the runs with these lags built in
    shift : clocks of the runs behind that
    """

    problem: Problem
    faults: tuple[Fault, ...]
    excluded: tuple[Excluded, ...]
    seeds: Mapping[str, float]
    aligned: Evidence
    shift: Shift


def prepare(signals: Sequence[Signals], simulation: Simulation, library: Sequence[Effect]) -> Prepared:
    """Return runs without faults, without unfit ones, and the lags of their sensors.

    Raises
    ------
    DataError
        if too few runs are fit, or their clocks are further apart than is searched.
    """
    low_pass = low_pass_of(signals)
    plain = [
        rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass) for run in signals
    ]
    latencies = latencies_of(signals, simulation)
    faults = faults_of(signals, plain, simulation, low_pass, latencies=latencies)
    runs = repaired(signals, faults)
    if faults:
        latencies = latencies_of(runs, simulation)
    problem = Problem(runs, simulation, low_pass, tuple(library))
    seeds, aligned, shift = _aligned(problem, latencies)
    excluded = unfit_runs(runs, aligned, shift)
    if excluded:
        gone = {run.run_id for run in excluded}
        kept = tuple(run for run in runs if run.run_id not in gone)
        if len(kept) < MIN_RUNS:
            reasons = "; ".join(f"{run.run_id}: {run.reason}" for run in excluded[:3])
            raise DataError(f"runs: only {len(kept)} of {len(signals)} are fit to be compared ({reasons})")
        problem = problem._replace(signals=kept)
        seeds, aligned, shift = _aligned(problem, latencies_of(kept, simulation))
    if not any(np.nanmax(np.abs(run.wheel_speed_mps), initial=0.0) > REST_MPS for run in problem.signals):
        n = len(problem.signals)
        raise DataError(f"runs: in all {n} the wheels are at rest; runs that drive are required")
    return Prepared(problem, faults, excluded, seeds, aligned, shift)


def _aligned(problem: Problem, latencies: Latencies) -> tuple[dict[str, float], Evidence, Shift]:
    """Return lags to start from, the information of the runs with them built in, and their clocks there."""
    values = starting_values(latencies)
    seeds = {name: value for name, value in values.items() if name in problem.parameters}
    there = move_point(problem.simulation.vector, tuple(seeds), np.array(list(seeds.values())))
    aligned = problem.at(there)
    return seeds, aligned, shifts_of(aligned)
