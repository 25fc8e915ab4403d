"""How far the yaw of a filter leaves the truth on long drives, with a camera and after the loss of it.

A study on the command line::

    python -m pipelines.estimate.long_drives --runs 12 --minutes 30 --seed 0
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from pipelines.estimate.consistency import GROUPS
from pipelines.reporting.progress import Progress, silent
from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.coverage import nees_by_group, slip_coverage
from terrain.estimation.estimate import estimate_run
from terrain.robots import Robot, load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

SCENARIO, FILTER = "complex", "vio15"
LOST_S = 60.0
"""For so long at the end of a drive there is no camera."""


class LongDrive(NamedTuple):
    """A drive's errors and consistency.

    Parameters
    ----------
    terrain : soil
    yaw_error_rad : largest, while there is a camera
    blind_yaw_error_rad : at the end, after :data:`LOST_S` without one
    nees : a state, by group of states; 1 is consistent
    slip_coverage : ratio of slips within their stated 95 % interval
    """

    terrain: str
    yaw_error_rad: float
    blind_yaw_error_rad: float
    nees: dict[str, float]
    slip_coverage: float


def drive_long(robot: Robot, terrain: str, seed: int, number: int, duration_s: float) -> LongDrive:
    """Simulate and filter a drive whose camera is lost for its last minute.

    Raises
    ------
    ConfigError
        if the drive is not longer than two minutes, or the filter does not fit the robot.
    """
    if not duration_s > 2 * LOST_S:
        raise ConfigError(f"a drive of {duration_s:g} s is too short: more than {2 * LOST_S:g} s are needed")
    seen_s = duration_s - LOST_S
    faults = Faults(camera_lost_s=((seen_s, duration_s),))
    run = simulate_run(
        robot, terrain, SCENARIO, seed, number, vary=True, duration_s=duration_s, faults=faults
    )
    estimate = estimate_run(run, robot, FILTER)
    track, yaw = estimate.track, estimate.track.states.index("yaw_rad")
    assert estimate.truth is not None  # a simulated run has it
    error_rad = np.abs(wrapped(track.mean[:, yaw] - estimate.truth[:, yaw]))
    return LongDrive(
        terrain,
        float(np.nanmax(error_rad[track.time_s < seen_s])),
        float(error_rad[np.isfinite(error_rad)][-1]),
        nees_by_group(estimate),
        slip_coverage(estimate),
    )


def drives_long(
    robot: Robot, seed: int, runs: int, duration_s: float, progress: Progress = silent, n_jobs: int = 0
) -> tuple[LongDrive, ...]:
    """Return some long drives, over the terrains in turn; the seed decides all that is drawn."""
    from joblib import Parallel, delayed

    terrains = soil_names()
    jobs = [(terrains[i % len(terrains)], seed, i + 1, duration_s) for i in range(runs)]
    pool = Parallel(n_jobs=n_jobs or os.cpu_count() or 1, return_as="generator")
    found = []
    for drive in pool(delayed(drive_long)(robot, *job) for job in jobs):
        found.append(drive)
        progress("long drives", len(found), runs)
    return tuple(found)


def print_drives(drives: Sequence[LongDrive], console: Any) -> None:
    """Print a line a drive, the largest errors, and the mean NEES of all drives by group of states."""
    from rich.table import Column

    from pipelines.reporting.terminal import compact_table, number_columns

    columns = number_columns("with a camera, rad", f"after {LOST_S:g} s without, rad", "coverage of slip")
    title = "largest error of the yaw, and coverage of 95 % intervals of slip"
    table = compact_table(Column("terrain", no_wrap=True), *columns, title=title)
    for drive in drives:
        yaw = f"{drive.yaw_error_rad:.4f}", f"{drive.blind_yaw_error_rad:.4f}"
        table.add_row(drive.terrain, *yaw, f"{drive.slip_coverage:.3f}")
    largest = max(d.yaw_error_rad for d in drives), max(d.blind_yaw_error_rad for d in drives)
    coverage = float(np.mean([drive.slip_coverage for drive in drives]))
    table.add_row("largest, mean", *(f"{error:.4f}" for error in largest), f"{coverage:.3f}")
    console.print(table)
    nees = compact_table(
        "states", *number_columns("NEES"), title="NEES a state over all drives (1 is consistent)"
    )
    for key in (key for key in GROUPS if key in drives[0].nees):
        nees.add_row(GROUPS[key], f"{np.mean([drive.nees[key] for drive in drives]):.2f}")
    console.print(nees)


def main(
    runs: Annotated[int, typer.Option(min=1, help="Number of drives.")] = 12,
    minutes: Annotated[float, typer.Option(help="Length of each.")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="Of all drives.")] = 0,
    robot: str = "agrimaro",
    jobs: Annotated[int, typer.Option(min=0, help="Processes at once; 0 for one a core.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json")] = None,
) -> None:
    """Print how far the yaw leaves the truth on long simulated drives."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        drives = drives_long(load_robot(robot), seed, runs, 60.0 * minutes, progress, jobs)
    print_drives(drives, output_console())
    write_json(json_file, {"seed": seed, "minutes": minutes, "drives": [drive._asdict() for drive in drives]})


if __name__ == "__main__":
    typer.run(main)
