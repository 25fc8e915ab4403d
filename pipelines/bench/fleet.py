"""``terrain bench fleet``: features of ever more runs, with ever more processes: time and peak memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import NamedTuple

import numpy as np

from pipelines.bench.fleet_runs import RUN_S, fleet_loaders, fleet_run, write_fleet_run
from pipelines.bench.memory import cpu_s, peak_memory
from pipelines.bench.settings import FleetSettings
from pipelines.feature_store.build import build_store
from pipelines.feature_store.settings import FeaturesSettings
from pipelines.learn.parallel import end_processes, parallel
from pipelines.reporting.progress import Progress, silent

FRACTIONS = (0.1, 0.3, 1.0)
"""Of the runs that were asked for: three sizes show whether time and memory follow their number."""

WARM_RUNS = 24
"""Before a measurement: processes are started, kernels are compiled and loaded."""

N_GENERATED = 50
"""Runs by which the time to generate one is measured."""


class FleetPoint(NamedTuple):
    """Features of so many runs by so many processes; ``cpu_s`` and ``peak_mb`` are of all together."""

    n_runs: int
    n_workers: int
    seconds: float
    runs_per_s: float
    cpu_s: float
    peak_mb: float


@dataclass(frozen=True, slots=True)
class FleetBench:
    """Time and memory against the number of runs.

    Parameters
    ----------
    run_s, seed : length of a run, and of the fleet
    generate_ms : to generate a run in memory
    write_s : to generate and write all of them as run folders, by as many processes as the most measured
    points : the measurements
    nonlinearity_ratio : largest deviation of the time a run from that of the largest size, same processes
    cpu_nonlinearity_ratio : the same of processor time, which other work on the machine hardly changes
    memory_growth_ratio : largest growth of the peak from the smallest to the largest size, same processes
    speed_up : by number of processes, times one process at the largest size; empty without one
    """

    run_s: float
    seed: int
    generate_ms: float
    write_s: float
    points: tuple[FleetPoint, ...]
    nonlinearity_ratio: float
    cpu_nonlinearity_ratio: float
    memory_growth_ratio: float
    speed_up: dict[int, float]


def bench_fleet(settings: FleetSettings, progress: Progress = silent) -> FleetBench:
    """Measure making a store of features of a generated fleet on this machine.

    Parameters
    ----------
    settings : runs, processes, seed
    progress : of the measurements

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    sizes = sorted({max(round(fraction * settings.runs), 1) for fraction in FRACTIONS})
    begun_s = perf_counter()
    for number in range(N_GENERATED):
        fleet_run(settings.seed, number)
    generate_ms = (perf_counter() - begun_s) * 1e3 / N_GENERATED
    with TemporaryDirectory(dir=settings.scratch, prefix="fleet-") as folder:
        runs = Path(folder) / "runs"
        begun_s = perf_counter()
        numbers = ((number,) for number in range(sizes[-1]))
        shared = (settings.seed, runs)
        for done, _ in enumerate(parallel(write_fleet_run, shared, numbers, max(settings.workers))):
            progress("write runs", done + 1, sizes[-1])
        write_s = perf_counter() - begun_s
        points: list[FleetPoint] = []
        for n_workers in settings.workers:
            end_processes()
            _measure(runs, min(WARM_RUNS, sizes[-1]), n_workers)
            for n_runs in sizes:
                progress("measure", len(points), len(sizes) * len(settings.workers))
                points.append(_measure(runs, n_runs, n_workers))
        progress("measure", len(points), len(points))
    return FleetBench(
        run_s=RUN_S,
        seed=settings.seed,
        generate_ms=generate_ms,
        write_s=write_s,
        points=tuple(points),
        nonlinearity_ratio=nonlinearity([(p.n_workers, p.n_runs, p.seconds) for p in points]),
        cpu_nonlinearity_ratio=nonlinearity([(p.n_workers, p.n_runs, p.cpu_s) for p in points]),
        memory_growth_ratio=memory_growth(points),
        speed_up=speed_ups(points),
    )


def _measure(runs: Path, n_runs: int, n_workers: int) -> FleetPoint:
    with TemporaryDirectory(dir=runs.parent, prefix="store-") as out:
        settings = FeaturesSettings(out=Path(out), n_jobs=n_workers)
        with peak_memory() as peak:
            begun_s, begun_cpu_s = perf_counter(), cpu_s()
            build_store(fleet_loaders(runs, n_runs), settings)
            seconds, used_s = perf_counter() - begun_s, cpu_s() - begun_cpu_s
    return FleetPoint(n_runs, n_workers, seconds, n_runs / seconds, used_s, peak.mb)


def _by_workers(points: Sequence[FleetPoint]) -> list[list[FleetPoint]]:
    """Return the points of each number of processes, by size."""
    numbers = sorted({point.n_workers for point in points})
    return [sorted(point for point in points if point.n_workers == number) for number in numbers]


def nonlinearity(times: Sequence[tuple[int, int, float]]) -> float:
    """Return the largest deviation of the time a run from that of the largest size with as many processes.

    Parameters
    ----------
    times : (processes, runs, time in s) of each measurement

    Examples
    --------
    >>> round(nonlinearity([(1, 10, 1.1), (1, 100, 10.0)]), 3)
    0.1
    """
    deviations = []
    for n_workers in {each[0] for each in times}:
        same = sorted((n_runs, time_s) for n, n_runs, time_s in times if n == n_workers)
        of_largest_s = same[-1][1] / same[-1][0]
        deviations += [abs(time_s / n_runs / of_largest_s - 1.0) for n_runs, time_s in same]
    return float(np.max(deviations))


def memory_growth(points: Sequence[FleetPoint]) -> float:
    """Return the largest growth of the peak from the smallest to the largest size."""
    return float(np.max([same[-1].peak_mb / same[0].peak_mb - 1.0 for same in _by_workers(points)]))


def speed_ups(points: Sequence[FleetPoint]) -> dict[int, float]:
    """Return by number of processes how many times faster than one they are, at the largest size."""
    largest = {same[-1].n_workers: same[-1].seconds for same in _by_workers(points)}
    return {n: largest[1] / seconds for n, seconds in largest.items() if n > 1} if 1 in largest else {}
