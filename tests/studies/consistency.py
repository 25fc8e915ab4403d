"""NEES by group of states and coverage of slip intervals, by terrain, over runs of several scenarios."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.estimate.consistency import (
    COVERAGE_HEADING,
    FILTER,
    GROUPS,
    RUNS_A_SCENARIO,
    SCENARIOS,
    TerrainConsistency,
    consistency_by_terrain,
)
from pipelines.report import Progress, Report, Result, Table, described, format_value, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from terrain.control.comparison import MeanInterval
from terrain.robots import load_robot
from terrain.terramechanics.soil import soil_names

EXAMPLE = "python tests/studies consistency --runs 20 --seed 1200"


class Settings(BaseSettings):
    """Which runs are simulated and filtered."""

    runs: int = setting(RUNS_A_SCENARIO, "Of each scenario on each terrain.", ge=1)
    seed: int = setting(0, "Of all runs.", ge=0)
    robot: str = setting("agrimaro", "Swerve robot.")
    filter_name: str = setting(FILTER, "Filter.", "--filter")
    scenarios: tuple[str, ...] = setting(SCENARIOS, "By commas.", separated=True)
    terrains: tuple[str, ...] = setting(tuple(soil_names()), "By commas.", separated=True)
    camera_lost_s: float = setting(
        0.0, "Time in s without a camera, from the middle of each run.", "--camera-lost", ge=0.0
    )
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)


@dataclass(frozen=True)
class Consistency(Result):
    """Consistency of a filter by terrain."""

    seed: int = described("of all runs")
    filter: str = described("that was examined")
    consistency: tuple[TerrainConsistency, ...] = described("NEES by group of states and coverage of slip")


def run(settings: Settings, progress: Progress = silent) -> Consistency:
    """Simulate and filter runs of some scenarios on each terrain, and compare errors with their variance."""
    rows = consistency_by_terrain(
        *(load_robot(settings.robot), settings.seed, settings.runs, settings.filter_name, progress),
        *(settings.n_jobs, settings.terrains, settings.scenarios, settings.camera_lost_s),
    )
    return Consistency(settings.seed, settings.filter_name, rows)


def report(result: Consistency) -> Report:
    """Return a line a terrain, a column a group of states, and the coverage of slip."""
    rows = result.consistency
    groups = [key for key in GROUPS if key in rows[0].nees]
    coverage = [row.slip_coverage.mean for row in rows if row.slip_coverage.mean is not None]
    lowest = format_value(min(coverage, default=None), ".1%")
    cells = tuple(
        (row.terrain, *(shown(value) for value in (*(row.nees[key] for key in groups), row.slip_coverage)))
        for row in rows
    )
    columns = ("terrain", *(GROUPS[key] for key in groups), COVERAGE_HEADING)
    return Report(
        f"Consistency of {result.filter}",
        f"On the worst of {len(rows)} terrains {lowest} of the slips lie in their 95 % interval, in "
        f"{rows[0].n_runs} runs a terrain.",
        parts=(
            Table(
                columns, cells, title="NEES a state (1 is consistent), and coverage of 95 % intervals of slip"
            ),
        ),
    )


def shown(value: MeanInterval) -> str:
    """Return a mean and half of its 95 % interval.

    Examples
    --------
    >>> shown(MeanInterval(0.912, (0.862, 0.962), 9)), shown(MeanInterval(4.86, (2.3, 7.42), 9))
    ('0.91 ± 0.05', '4.9 ± 2.6')
    """
    if value.mean is None:
        return format_value(None)
    digits = 1 if value.mean >= 1.0 else 2
    half = f" ± {(value.ci[1] - value.ci[0]) / 2:.{digits}f}" if value.ci else ""
    return f"{value.mean:.{digits}f}{half}"
