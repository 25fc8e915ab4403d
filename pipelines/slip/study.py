"""Coverage of the interval of a learned peak and error of the peak, over many simulated terrains.

A case is one terrain with the runs of :data:`terrain.simulation.slip_sweep.LEARNING_DRIVES`.  The truth is
the peak of the described soil's own net traction under a third of the robot's weight, by the same definition
over the slips that the case observes.

    python -m pipelines.slip.study --cases 100 --seed 0
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from scipy.special import betaincinv

from pipelines.reporting.progress import Progress, silent
from terrain.constants import GRAVITY_MPS2
from terrain.records import TargetStatus
from terrain.robots import Robot, load_robot
from terrain.simulation.slip_sweep import LEARNING_DRIVES, Drive, learning_runs
from terrain.slip_learning.curve import N_BOOTSTRAP
from terrain.slip_learning.learn import learn_terrain, terrain_runs
from terrain.slip_learning.peak import Peak, PeakStatus, net_peak
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.traction import net_pull

WELL_COVERED_SLIP = 0.5
"""Slips observed up to here and beyond cover a curve well: the peaks of hard terrain are at 0.2 to 0.35."""


class Case(NamedTuple):
    """The estimated and the true peak of one learned terrain."""

    terrain: str
    seed: int
    law: str
    peak_slip: float
    interval: tuple[float, float]
    peak_status: PeakStatus
    slip_range: tuple[float, float]
    true_slip: float
    true_status: PeakStatus

    @property
    def inside(self) -> bool:
        """Whether the interval contains the true peak."""
        return self.interval[0] <= self.true_slip <= self.interval[1]

    def as_json(self) -> dict[str, Any]:
        """Return the fields, and whether the interval contains the truth."""
        return self._asdict() | {"status": TargetStatus.ESTIMATED, "inside": self.inside}


class Coverage(NamedTuple):
    """Coverage and error over cases.

    Parameters
    ----------
    n : cases
    coverage, coverage_ci : ratio of intervals that contain the true peak, and its exact 95 % interval
    error_mean, error_median_abs, error_max_abs : of the peak slip
    within_003 : ratio of cases with an error of at most 0.03
    width_median : of the intervals
    well_covered : cases with slips up to :data:`WELL_COVERED_SLIP` and beyond
    status_right : cases with the true status of the peak
    """

    n: int
    coverage: float
    coverage_ci: tuple[float, float] | None
    error_mean: float
    error_median_abs: float
    error_max_abs: float
    within_003: float
    width_median: float
    well_covered: int
    status_right: int

    def as_json(self) -> dict[str, Any]:
        """Return the fields; a ratio within 0.03 by that name."""
        return {name.replace("within_003", "within_0.03"): value for name, value in self._asdict().items()}


@dataclass(frozen=True, slots=True)
class StudyResult:
    """Coverage over all learned cases and by terrain; the keys of ``--json``, those of ``all`` at the top."""

    n_cases: int
    n_learned: int
    all: Coverage
    terrains: Mapping[str, Coverage]
    cases: tuple[Case, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the fields, with those of ``all`` in its place."""
        document: dict[str, Any] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            document |= value.as_json() if isinstance(value, Coverage) else {each.name: value}
        return document


def true_peak(robot: Robot, terrain: str, slip_range: tuple[float, float]) -> Peak:
    """Return the peak of a described soil's net traction within a range of slips, under a third of the robot.

    Examples
    --------
    >>> true_peak(load_robot("agrimaro"), "snow", (0.0, 0.6))
    Peak(slip_ratio=0.3115, status=<PeakStatus.PEAK: 'peak'>)
    """
    soil, body = load_soil(terrain), robot.body
    geometry = robot.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    return net_peak(lambda slips: net_pull(soil, load_n, slips, *geometry), *slip_range)


def run_case(
    robot: Robot,
    terrain: str,
    seed: int,
    drives: tuple[Drive, ...] = LEARNING_DRIVES,
    n_bootstrap: int = N_BOOTSTRAP,
) -> Case | None:
    """Simulate and learn one terrain; None where its targets are not learned."""
    measured = [
        each for run in learning_runs(robot, terrain, seed, drives) for each in terrain_runs(run, robot)
    ]
    learned = learn_terrain(terrain, measured, seed, n_bootstrap)
    curve = learned.curve
    if curve is None or learned.status is not TargetStatus.ESTIMATED:
        return None
    true = true_peak(robot, terrain, curve.slip_range)
    return Case(
        terrain=terrain,
        seed=seed,
        law=curve.law,
        peak_slip=curve.peak.slip_ratio,
        interval=curve.peak_interval,
        peak_status=curve.peak.status,
        slip_range=curve.slip_range,
        true_slip=true.slip_ratio,
        true_status=true.status,
    )


def study(
    robot: Robot,
    seeds: Sequence[int],
    terrains: Sequence[str] = soil_names(),
    n_bootstrap: int = N_BOOTSTRAP,
    progress: Progress = silent,
) -> list[Case | None]:
    """Return a case a seed, over the terrains in turn."""
    cases = []
    for done, seed in enumerate(seeds, start=1):
        cases.append(run_case(robot, terrains[seed % len(terrains)], seed, n_bootstrap=n_bootstrap))
        progress("cases", done, len(seeds))
    return cases


def clopper_pearson(hits: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a probability by ``hits`` of ``n``.

    Examples
    --------
    >>> low, high = clopper_pearson(90, 100)
    >>> round(low, 3), round(high, 3)
    (0.824, 0.951)
    """
    tail = (1 - level) / 2
    low = float(betaincinv(hits, n - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, n - hits, 1 - tail)) if hits < n else 1.0
    return low, high


def summary(cases: Sequence[Case | None]) -> StudyResult:
    """Return coverage and error, of all and by terrain; cases that were not learned are counted apart."""
    learned = [case for case in cases if case is not None]
    return StudyResult(
        n_cases=len(cases),
        n_learned=len(learned),
        all=_coverage(learned),
        terrains={
            terrain: _coverage([case for case in learned if case.terrain == terrain])
            for terrain in sorted({case.terrain for case in learned})
        },
        cases=tuple(learned),
    )


def _coverage(cases: Sequence[Case]) -> Coverage:
    n, hits = len(cases), sum(case.inside for case in cases)
    if not n:
        return Coverage(0, math.nan, None, math.nan, math.nan, math.nan, math.nan, math.nan, 0, 0)
    error = np.array([case.peak_slip - case.true_slip for case in cases])
    return Coverage(
        n=n,
        coverage=hits / n,
        coverage_ci=clopper_pearson(hits, n),
        error_mean=float(error.mean()),
        error_median_abs=float(np.median(np.abs(error))),
        error_max_abs=float(np.abs(error).max()),
        within_003=float(np.mean(np.abs(error) <= 0.03)),
        width_median=float(np.median([case.interval[1] - case.interval[0] for case in cases])),
        well_covered=sum(case.slip_range[1] >= WELL_COVERED_SLIP for case in cases),
        status_right=sum(case.peak_status is case.true_status for case in cases),
    )


def main(
    cases: Annotated[int, typer.Option(min=1)] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of the first case.")] = 0,
    robot: str = "agrimaro",
    json_file: Annotated[Path | None, typer.Option("--json")] = None,
) -> None:
    """Print coverage of the peak's interval over seeded cases."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import progress_bar

    with progress_bar() as progress:
        result = summary(study(load_robot(robot), range(seed, seed + cases), progress=progress))
    for name, row in [("all", result.all), *result.terrains.items()]:
        low, high = row.coverage_ci or (math.nan, math.nan)
        typer.echo(
            f"{name:18s} n {row.n:3d}  coverage {row.coverage:.3f} ({low:.3f} to {high:.3f})  "
            f"error mean {row.error_mean:+.4f} median {row.error_median_abs:.4f} "
            f"max {row.error_max_abs:.4f}  within 0.03 {row.within_003:.2f}  "
            f"width {row.width_median:.3f}  well covered {row.well_covered}  "
            f"status right {row.status_right}"
        )
    typer.echo(f"not learned: {result.n_cases - result.n_learned} of {result.n_cases}")
    write_json(json_file, result)


if __name__ == "__main__":
    typer.run(main)
