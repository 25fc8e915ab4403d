"""NEES by group of states and coverage of slip intervals, by terrain, over runs of several scenarios.

On the command line, beside ``terrain quickstart``, which shows it::

    python -m pipelines.estimate.consistency --runs 20 --seed 0
    python -m pipelines.estimate.consistency --runs 5 --scenarios starts --camera-lost 10
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from pipelines.reporting.progress import Progress, silent
from terrain.control.comparison import MeanInterval, mean_interval
from terrain.estimation.coverage import nees_by_group, slip_coverage
from terrain.estimation.estimate import estimate_run
from terrain.robots import Robot, load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

SCENARIOS = ("survey", "starts", "complex")
"""Varied steady driving, hard starts and stops, and turns in every direction."""

FILTER = "vio15"
RUNS_A_SCENARIO = 4

GROUPS = {
    "position": "position",
    "yaw": "yaw",
    "speed": "speed",
    "yaw_rate": "yaw rate",
    "accel": "accel",
    "steer": "steering",
    "gyro_bias": "gyro bias",
    "slip_speed": "slip speed",
    "imu_yaw_offset": "yaw offset",
}
"""Groups of states by their names, and how they are shown."""

COVERAGE_HEADING = "coverage of slip"


class TerrainConsistency(NamedTuple):
    """Consistency of a filter on a terrain, means over runs with their 95 % intervals.

    Parameters
    ----------
    terrain, n_runs : of how many runs
    nees : a state, by group of states (:data:`GROUPS`); 1 is consistent
    slip_coverage : ratio of slips within their stated 95 % interval
    """

    terrain: str
    n_runs: int
    nees: dict[str, MeanInterval]
    slip_coverage: MeanInterval


def consistency_by_terrain(
    robot: Robot,
    seed: int,
    runs: int = RUNS_A_SCENARIO,
    filter_name: str = FILTER,
    progress: Progress = silent,
    n_jobs: int = 0,
    terrains: Sequence[str] = soil_names(),
    scenarios: Sequence[str] = SCENARIOS,
    lost_s: float = 0.0,
) -> tuple[TerrainConsistency, ...]:
    """Simulate and filter runs of some scenarios on each terrain, and compare errors with their variance.

    Parameters
    ----------
    robot : swerve robot
    seed : of everything that is drawn: soil, slope, load, tyres, driving and noise of each run
    runs : of each scenario on each terrain
    filter_name : one of :data:`terrain.estimation.estimate.FILTERS`
    progress : of the runs
    n_jobs : processes at once; 0 for one a core
    terrains : names of soils
    scenarios : names of scenarios
    lost_s : for so long from the middle of each run there is no camera, and coverage is that of this time

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, or there is no such terrain.
    """
    from joblib import Parallel, delayed

    jobs = [
        (terrain, scenario, number)
        for terrain in terrains
        for scenario in scenarios
        for number in range(1, runs + 1)
    ]
    pool = Parallel(n_jobs=n_jobs or os.cpu_count() or 1, return_as="generator")
    found: dict[str, list[dict[str, float]]] = {terrain: [] for terrain in terrains}
    work = pool(delayed(_run_figures)(robot, *job, seed, filter_name, lost_s) for job in jobs)
    for done, ((terrain, _, _), figures) in enumerate(zip(jobs, work, strict=True), 1):
        found[terrain].append(figures)
        progress("consistency", done, len(jobs))
    return tuple(_terrain_row(terrain, rows) for terrain, rows in found.items())


def _run_figures(
    robot: Robot, terrain: str, scenario: str, number: int, seed: int, filter_name: str, lost_s: float
) -> dict[str, float]:
    run = simulate_run(robot, terrain, scenario, seed, number, vary=True)
    between_s = (-math.inf, math.inf)
    if lost_s > 0.0:
        middle_s = float(run.streams["wheels"].time_s.mean())
        between_s = (middle_s, middle_s + lost_s)
        faults = Faults(camera_lost_s=(between_s,))
        run = simulate_run(robot, terrain, scenario, seed, number, vary=True, faults=faults)
    estimate = estimate_run(run, robot, filter_name)
    return nees_by_group(estimate) | {COVERAGE_HEADING: slip_coverage(estimate, between_s)}


def _terrain_row(terrain: str, rows: Sequence[dict[str, float]]) -> TerrainConsistency:
    means = {key: mean_interval([row[key] for row in rows]) for key in rows[0]}
    coverage = means.pop(COVERAGE_HEADING)
    return TerrainConsistency(terrain, len(rows), means, coverage)


def print_consistency(rows: Sequence[TerrainConsistency], console: Any) -> None:
    """Print a line a terrain, a column a group of states, and the coverage of slip."""
    from rich.table import Column

    from pipelines.reporting.terminal import compact_table, number_columns

    groups = [key for key in GROUPS if key in rows[0].nees]
    columns = number_columns(*(GROUPS[key] for key in groups), COVERAGE_HEADING)
    title = "NEES a state (1 is consistent), and coverage of 95 % intervals of slip"
    table = compact_table(Column("terrain", no_wrap=True), *columns, title=title)
    for row in rows:
        values = [*(row.nees[key] for key in groups), row.slip_coverage]
        table.add_row(row.terrain, *map(with_half_interval, values))
    console.print(table)


def with_half_interval(value: MeanInterval) -> str:
    r"""Return a mean and half of its 95 % interval, in two lines.

    Examples
    --------
    >>> with_half_interval(MeanInterval(0.912, (0.862, 0.962), 9))
    '0.91\n±0.05'
    >>> with_half_interval(MeanInterval(4.86, (2.3, 7.42), 9))
    '4.9\n±2.6'
    """
    if value.mean is None:
        return "-"
    digits = 1 if value.mean >= 1.0 else 2
    half = f"\n±{(value.ci[1] - value.ci[0]) / 2:.{digits}f}" if value.ci else ""
    return f"{value.mean:.{digits}f}{half}"


def main(
    runs: Annotated[int, typer.Option(min=1, help="Of each scenario on each terrain.")] = RUNS_A_SCENARIO,
    seed: Annotated[int, typer.Option(min=0, help="Of all runs.")] = 0,
    robot: str = "agrimaro",
    filter_name: Annotated[str, typer.Option("--filter")] = FILTER,
    scenarios: Annotated[str, typer.Option(help="By commas.")] = ",".join(SCENARIOS),
    camera_lost: Annotated[
        float, typer.Option(min=0.0, help="Time in s without a camera, from the middle of each run.")
    ] = 0.0,
    jobs: Annotated[int, typer.Option(min=0, help="Processes at once; 0 for one a core.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json")] = None,
) -> None:
    """Print NEES by group of states and coverage of slip, by terrain, over simulated runs."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        rows = consistency_by_terrain(
            *(load_robot(robot), seed, runs, filter_name, progress, jobs, soil_names()),
            *(scenarios.split(","), camera_lost),
        )
    print_consistency(rows, output_console())
    write_json(json_file, {"seed": seed, "filter": filter_name, "consistency": rows})


if __name__ == "__main__":
    typer.run(main)
