"""Coverage of the interval of a learned slip peak and error of the peak, over many simulated terrains.

A case is one terrain with the runs of :data:`terrain.simulation.run.LEARNING_DRIVES`.  The truth is
the peak of the described soil's own net traction under a third of the robot's weight, by the same definition
over the slips that the case observes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from scipy.special import betaincinv

from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Table
from terrain.constants import GRAVITY_MPS2
from terrain.records import TargetStatus
from terrain.robots import Robot, load_robot
from terrain.simulation.run import LEARNING_DRIVES, Drive, learning_runs
from terrain.slip_learning.curve import N_BOOTSTRAP, Peak, PeakStatus, net_peak
from terrain.slip_learning.learn import learn_terrain, terrain_runs
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.traction import net_pull

EXAMPLE = "python tests/studies slip-peaks --cases 100 --seed 0"
WELL_COVERED_SLIP = 0.5
"""Slips observed up to here and beyond cover a curve well: the peaks of hard terrain are at 0.2 to 0.35."""


class Settings(BaseSettings):
    """Which terrains are simulated and learned."""

    cases: int = setting(100, "Terrains that are learned, the soils in turn.", ge=1)
    seed: int = setting(0, "Of the first case.", ge=0)
    robot: str = setting("agrimaro", "Swerve robot.")


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
    """Coverage and error over cases."""

    n: int  #: cases
    #: coverage, coverage_ci: ratio of intervals that contain the true peak, and its exact 95 % interval
    coverage: float
    coverage_ci: tuple[float, float] | None
    #: error_mean, error_median_abs, error_max_abs: of the peak slip
    error_mean: float
    error_median_abs: float
    error_max_abs: float
    within_003: float  #: ratio of cases with an error of at most 0.03
    width_median: float  #: of the intervals
    well_covered: int  #: cases with slips up to :data:`WELL_COVERED_SLIP` and beyond
    status_right: int  #: cases with the true status of the peak


class PeaksResult(Result):
    """Coverage over all learned cases and by terrain."""

    n_cases: int = described("cases simulated")
    n_learned: int = described("of them with learned targets")
    all: Coverage = described("coverage and error over all learned cases")
    terrains: Mapping[str, Coverage] = described("the same by terrain")
    cases: tuple[Case, ...] = described("every learned case")

    def as_json(self) -> dict[str, Any]:
        """Return the fields, with those of ``all`` in its place."""
        document: dict[str, Any] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            document |= value._asdict() if isinstance(value, Coverage) else {each.name: value}
        return document


def true_peak(robot: Robot, terrain: str, slip_range: tuple[float, float]) -> Peak:
    """Return the peak of a described soil's net traction within a range of slips, under a third of the robot."""
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
    runs = learning_runs(robot, terrain, seed, drives)
    learned = learn_terrain(
        terrain, [each for run in runs for each in terrain_runs(run, robot)], seed, n_bootstrap
    )
    curve = learned.curve
    if curve is None or learned.status is not TargetStatus.ESTIMATED:
        return None
    true = true_peak(robot, terrain, curve.slip_range)
    return Case(
        *(terrain, seed, curve.law, curve.peak.slip_ratio, curve.peak_interval, curve.peak.status),
        *(curve.slip_range, true.slip_ratio, true.status),
    )


def clopper_pearson(hits: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a probability by ``hits`` of ``n``."""
    tail = (1 - level) / 2
    low = float(betaincinv(hits, n - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, n - hits, 1 - tail)) if hits < n else 1.0
    return low, high


def summary(cases: Sequence[Case | None]) -> PeaksResult:
    """Return coverage and error, of all and by terrain; cases that were not learned are counted apart."""
    learned = [case for case in cases if case is not None]
    names = sorted({case.terrain for case in learned})
    by_terrain = {name: _coverage([case for case in learned if case.terrain == name]) for name in names}
    return PeaksResult(len(cases), len(learned), _coverage(learned), by_terrain, tuple(learned))


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


def run(settings: Settings, progress: Progress = silent) -> PeaksResult:
    """Learn a case a seed, over the terrains in turn."""
    robot, terrains, cases = load_robot(settings.robot), soil_names(), []
    for done in range(settings.cases):
        seed = settings.seed + done
        cases.append(run_case(robot, terrains[seed % len(terrains)], seed))
        progress("cases", done + 1, settings.cases)
    return summary(cases)


def report(result: PeaksResult) -> Report:
    """Return coverage and errors, of all and by terrain."""
    columns = (
        *("terrain", "cases", Column("coverage", ".3f"), Column("95 %", ".3f"), Column("mean error", "+.4f")),
        *(
            Column("median", ".4f"),
            Column("largest", ".4f"),
            Column("within 0.03", ".2f"),
            Column("width", ".3f"),
        ),
        *("well covered", "status right"),
    )
    rows = tuple((name, *row) for name, row in (("all", result.all), *result.terrains.items()))
    low, high = result.all.coverage_ci or (math.nan, math.nan)
    return Report(
        "Interval of a learned slip peak",
        f"{result.all.coverage * result.all.n:.0f} of {result.n_learned} true peaks lie in the interval of the learned "
        f"one ({format_value((low, high), '.3f')}); {result.n_cases - result.n_learned} of {result.n_cases} were "
        "not learned.",
        parts=(Table(columns, rows),),
    )
