"""How far the yaw of a filter leaves the truth on long drives, with a camera and after the loss of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, setting
from pipelines.report.tree import Column, Pairs, Report, Table
from studies.consistency import GROUPS, nees_by_group, slip_coverage
from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.estimate import estimate_run
from terrain.robots import Robot, load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults
from terrain.terramechanics.soil import soil_names

EXAMPLE = "python tests/studies long-drives --runs 12 --minutes 30 --seed 0"
SCENARIO, FILTER = "complex", "vio15"
LOST_S = 60.0  #: For so long at the end of a drive there is no camera


class Settings(JobsSettings):
    """Which drives are simulated."""

    runs: int = setting(12, "Number of drives, over the terrains in turn.", ge=1)
    minutes: float = setting(30.0, "Length of each.")
    seed: int = setting(0, "Of all drives.", ge=0)
    robot: str = setting("agrimaro", "Swerve robot.")


class LongDrive(NamedTuple):
    """A drive's errors and consistency."""

    terrain: str  #: soil
    yaw_error_rad: float  #: largest, while there is a camera
    blind_yaw_error_rad: float  #: at the end, after :data:`LOST_S` without one
    nees: dict[str, float]  #: a state, by group of states; 1 is consistent
    slip_coverage: float  #: ratio of slips within their stated 95 % interval


class LongDrives(Result):
    """Errors of all drives."""

    seed: int = described("of all drives")
    minutes: float = described("length of each", "min")
    drives: tuple[LongDrive, ...] = described("errors and consistency of each drive")


def drive_long(robot: Robot, terrain: str, seed: int, number: int, duration_s: float) -> LongDrive:
    """Simulate and filter a drive whose camera is lost for its last minute."""
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


def run(settings: Settings, progress: Progress = silent) -> LongDrives:
    """Drive over the terrains in turn; the seed decides all that is drawn."""
    from joblib import Parallel, delayed

    robot, terrains, duration_s = load_robot(settings.robot), soil_names(), 60.0 * settings.minutes
    jobs = [(terrains[i % len(terrains)], settings.seed, i + 1, duration_s) for i in range(settings.runs)]
    pool = Parallel(n_jobs=settings.jobs, return_as="generator")
    found = []
    for drive in pool(delayed(drive_long)(robot, *job) for job in jobs):
        found.append(drive)
        progress("long drives", len(found), settings.runs)
    return LongDrives(settings.seed, settings.minutes, tuple(found))


def report(result: LongDrives) -> Report:
    """Return the errors of each drive, the largest, and the mean NEES by group of states."""
    drives = result.drives
    largest, blind = (
        max(getattr(drive, name) for drive in drives) for name in ("yaw_error_rad", "blind_yaw_error_rad")
    )
    columns = (
        *(
            "terrain",
            Column("yaw with a camera", ".4f", "rad"),
            Column(f"after {LOST_S:g} s without", ".4f", "rad"),
        ),
        Column("coverage of slip", ".3f"),
    )
    rows = tuple((d.terrain, d.yaw_error_rad, d.blind_yaw_error_rad, d.slip_coverage) for d in drives)
    known = [key for key in GROUPS if key in drives[0].nees]
    nees = tuple((GROUPS[key], float(np.mean([drive.nees[key] for drive in drives])), ".2f") for key in known)
    coverage = float(np.mean([drive.slip_coverage for drive in drives]))
    return Report(
        "Long drives",
        f"The yaw is off by at most {largest:.4f} rad with a camera and {blind:.4f} rad after {LOST_S:g} s without "
        f"one, in {len(drives)} drives of {result.minutes:g} minutes; {coverage:.1%} of the slips lie in their 95 % "
        "interval.",
        parts=(
            Table(columns, rows, title="Largest error of the yaw, and coverage of 95 % intervals of slip"),
            Pairs(nees, title="NEES a state over all drives (1 is consistent)"),
        ),
    )
