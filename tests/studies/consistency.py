"""NEES by group of states and coverage of slip intervals, by terrain, over runs of several scenarios."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, Names, setting
from pipelines.report.tree import Report, Table
from terrain.control.drive_metrics import MeanInterval, mean_interval
from terrain.estimation.consistency import consistency_report, lagged_slip_at
from terrain.estimation.estimate import Estimate, estimate_run
from terrain.robots import Robot, load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Faults
from terrain.terramechanics.soil import soil_names

EXAMPLE = "python tests/studies consistency --runs 20 --seed 1200"
SCENARIOS = ("survey", "starts", "complex")
"""Varied steady driving, hard starts and stops, and turns in every direction."""

FILTER = "vio15"
RUNS_A_SCENARIO = 4

GROUPS = {name: name.replace("_", " ") for name in ("position", "yaw", "speed", "yaw_rate", "accel")} | {
    "steer": "steering",
    "gyro_bias": "gyro bias",
    "slip_speed": "slip speed",
    "imu_yaw_offset": "yaw offset",
}
"""Groups of states by their names, and how they are shown."""

COVERAGE_HEADING = "coverage of slip"


class TerrainConsistency(NamedTuple):
    """Consistency of a filter in ``n_runs`` runs on a terrain, means over runs with their 95 % intervals."""

    terrain: str
    n_runs: int
    nees: dict[str, MeanInterval]  #: a state, by group of states (:data:`GROUPS`); 1 is consistent
    slip_coverage: MeanInterval  #: ratio of slips within their stated 95 % interval


def nees_by_group(estimate: Estimate) -> dict[str, float]:
    """Return the mean NEES of a simulated run, a state, of each group of states; empty without a truth."""
    states = consistency_report(estimate.track, estimate.truth)["states"]
    return {group.name: group.mean_per_dof for group in states if group.name != "all"}


def slip_coverage(estimate: Estimate, between_s: tuple[float, float] = (-math.inf, math.inf)) -> float:
    """Return the ratio of slips between two times whose 95 % interval contains the true slip; NaN without any.

    The truth comes behind the low-pass of the encoders, as the filter's inputs do.
    """
    if "truth" not in estimate.run.streams:
        return math.nan
    slip = estimate.slip
    error = np.abs(slip.mean - lagged_slip_at(estimate.run, estimate.robot, slip.time_s))
    known = np.isfinite(error) & np.isfinite(slip.std)
    known &= ((slip.time_s >= between_s[0]) & (slip.time_s <= between_s[1]))[:, None]
    inside = error[known] <= ndtri(0.975) * slip.std[known]
    return float(inside.mean()) if inside.size else math.nan


def consistency_by_terrain(
    robot: Robot,
    seed: int,
    runs: int = RUNS_A_SCENARIO,
    filter_name: str = FILTER,
    progress: Progress = silent,
    n_jobs: int = 1,
    terrains: Sequence[str] = soil_names(),
    scenarios: Sequence[str] = SCENARIOS,
    lost_s: float = 0.0,
) -> tuple[TerrainConsistency, ...]:
    """Simulate and filter runs of some scenarios on each terrain, and compare errors with their variance.

    Of each run soil, slope, load, tyres, driving and noise are drawn; for ``lost_s`` from its middle there is no
    camera, and coverage is that of this time.
    """
    from joblib import Parallel, delayed

    jobs = [
        (terrain, scenario, number)
        for terrain in terrains
        for scenario in scenarios
        for number in range(1, runs + 1)
    ]
    pool = Parallel(n_jobs=n_jobs, return_as="generator")
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


class Settings(JobsSettings):
    """Which runs are simulated and filtered."""

    runs: int = setting(RUNS_A_SCENARIO, "Of each scenario on each terrain.", ge=1)
    seed: int = setting(0, "Of all runs.", ge=0)
    robot: str = setting("agrimaro", "Swerve robot.")
    filter_name: str = setting(FILTER, "Filter.", "--filter")
    scenarios: Names = setting(SCENARIOS, "By commas.")
    terrains: Names = setting(tuple(soil_names()), "By commas.")
    camera_lost_s: float = setting(
        0.0, "Time in s without a camera, from the middle of each run.", "--camera-lost", ge=0.0
    )


class Consistency(Result):
    """Consistency of a filter by terrain."""

    seed: int = described("of all runs")
    filter: str = described("that was examined")
    consistency: tuple[TerrainConsistency, ...] = described("NEES by group of states and coverage of slip")


def run(settings: Settings, progress: Progress = silent) -> Consistency:
    """Simulate and filter runs of some scenarios on each terrain, and compare errors with their variance."""
    rows = consistency_by_terrain(
        *(load_robot(settings.robot), settings.seed, settings.runs, settings.filter_name, progress),
        *(settings.jobs, settings.terrains, settings.scenarios, settings.camera_lost_s),
    )
    return Consistency(settings.seed, settings.filter_name, rows)


def report(result: Consistency) -> Report:
    """Return a line a terrain, a column a group of states, and the coverage of slip."""
    rows, title = result.consistency, "NEES a state (1 is consistent), and coverage of 95 % intervals of slip"
    groups = [key for key in GROUPS if key in rows[0].nees]
    coverage = [row.slip_coverage.mean for row in rows if row.slip_coverage.mean is not None]
    cells = tuple(
        (row.terrain, *(shown(value) for value in (*(row.nees[key] for key in groups), row.slip_coverage)))
        for row in rows
    )
    columns = ("terrain", *(GROUPS[key] for key in groups), COVERAGE_HEADING)
    return Report(
        f"Consistency of {result.filter}",
        f"On the worst of {len(rows)} terrains {format_value(min(coverage, default=None), '.1%')} of the slips lie in "
        f"their 95 % interval, in {rows[0].n_runs} runs a terrain.",
        parts=(Table(columns, cells, title=title),),
    )


def shown(value: MeanInterval) -> str:
    """Return a mean and half of its 95 % interval."""
    if value.mean is None:
        return format_value(None)
    digits = 1 if value.mean >= 1.0 else 2
    half = f" ± {(value.ci[1] - value.ci[0]) / 2:.{digits}f}" if value.ci else ""
    return f"{value.mean:.{digits}f}{half}"
