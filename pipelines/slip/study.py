"""How often the interval of a learned peak holds the true one, and how near it is: many simulated terrains.

A case is one terrain with the runs of :data:`terrain.simulation.slip_sweep.LEARNING_DRIVES`.  The truth is
the described soil's own net pull under a third of the unladen robot, asked by the same definition over the
slips that the case has seen.

    python -m pipelines.slip.study --cases 100 --seed 0
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from scipy.special import betaincinv

from pipelines.reporting.progress import Progress, silent
from pipelines.slip.learn_slip import learn_terrain, run_parts
from terrain.constants import GRAVITY_MPS2
from terrain.robots import Robot, load_robot
from terrain.simulation.slip_sweep import LEARNING_DRIVES, Drive, learning_runs
from terrain.slip_learning.slip_curve import N_BOOTSTRAP, Peak, net_peak
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.traction import net_pull

WELL_COVERED_SLIP = 0.5
"""Slips seen up to here and beyond cover a curve well: the peaks of hard ground are at 0.2 to 0.35."""


class Case(NamedTuple):
    """One terrain learned: what was said, and what is true."""

    terrain: str
    seed: int
    status: str
    law: str
    peak_slip: float
    interval: tuple[float, float]
    peak_status: str
    slip_range: tuple[float, float]
    true_slip: float
    true_status: str

    @property
    def inside(self) -> bool:
        """Whether the interval holds the true peak."""
        return self.interval[0] <= self.true_slip <= self.interval[1]


def true_peak(robot: Robot, terrain: str, slip_range: tuple[float, float]) -> Peak:
    """Return the peak of the described soil's net pull within the slips seen, under a third of the robot.

    Examples
    --------
    >>> true_peak(load_robot("agrimaro"), "snow", (0.0, 0.6))
    Peak(slip_ratio=0.3115, status='peak')
    """
    soil, body = load_soil(terrain), robot.equipment.body
    geometry = robot.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    return net_peak(lambda slips: net_pull(soil, load_n, slips, *geometry), *slip_range)


def run_case(
    robot: Robot,
    terrain: str,
    seed: int,
    drives: tuple[Drive, ...] = LEARNING_DRIVES,
    n_bootstrap: int = N_BOOTSTRAP,
) -> Case:
    """Simulate and learn one terrain."""
    parts = [part for run in learning_runs(robot, terrain, seed, drives) for part in run_parts(run, robot)]
    learned = learn_terrain(terrain, parts, seed, n_bootstrap)
    if learned.curve is None:
        nothing = (np.nan, np.nan)
        return Case(terrain, seed, learned.status, "", np.nan, nothing, "", nothing, np.nan, "")
    curve = learned.curve
    true = true_peak(robot, terrain, curve.slip_range)
    return Case(
        terrain,
        seed,
        learned.status,
        curve.law,
        curve.peak.slip_ratio,
        curve.peak_interval,
        curve.peak.status,
        curve.slip_range,
        true.slip_ratio,
        true.status,
    )


def study(
    robot: Robot,
    seeds: Sequence[int],
    terrains: Sequence[str] = soil_names(),
    n_bootstrap: int = N_BOOTSTRAP,
    progress: Progress = silent,
) -> list[Case]:
    """Return a case a seed, over the terrains in turn."""
    cases = []
    for done, seed in enumerate(seeds, start=1):
        cases.append(run_case(robot, terrains[seed % len(terrains)], seed, n_bootstrap=n_bootstrap))
        progress("cases", done, len(seeds))
    return cases


def clopper_pearson(hits: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share by ``hits`` of ``n``.

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


def summary(cases: Sequence[Case]) -> dict[str, Any]:
    """Return coverage and error, of all and by terrain; cases that were not learned are counted apart."""
    learned = [case for case in cases if case.status == "estimated"]
    return {
        "n_cases": len(cases),
        "n_learned": len(learned),
        **_figures(learned),
        "terrains": {
            terrain: _figures([case for case in learned if case.terrain == terrain])
            for terrain in sorted({case.terrain for case in learned})
        },
        "cases": [{**case._asdict(), "inside": case.inside} for case in learned],
    }


def _figures(cases: Sequence[Case]) -> dict[str, Any]:
    hits = sum(case.inside for case in cases)
    error = np.array([case.peak_slip - case.true_slip for case in cases])
    return {
        "n": len(cases),
        "coverage": hits / len(cases) if cases else None,
        "coverage_ci": list(clopper_pearson(hits, len(cases))) if cases else None,
        "error_mean": float(error.mean()) if cases else None,
        "error_median_abs": float(np.median(np.abs(error))) if cases else None,
        "error_max_abs": float(np.abs(error).max()) if cases else None,
        "within_0.03": float(np.mean(np.abs(error) <= 0.03)) if cases else None,
        "width_median": float(np.median([case.interval[1] - case.interval[0] for case in cases]))
        if cases
        else None,
        "well_covered": sum(case.slip_range[1] >= WELL_COVERED_SLIP for case in cases),
        "status_right": sum(case.peak_status == case.true_status for case in cases),
    }


def main(
    cases: Annotated[int, typer.Option(min=1)] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of the first case.")] = 0,
    robot: str = "agrimaro",
    json_file: Annotated[Path | None, typer.Option("--json")] = None,
) -> None:
    """Print coverage of the peak's interval over seeded cases."""
    from pipelines.reporting.screens import progress_bar

    with progress_bar() as progress:
        result = summary(study(load_robot(robot), range(seed, seed + cases), progress=progress))
    for name, row in [("all", result), *result["terrains"].items()]:
        low, high = row["coverage_ci"]
        typer.echo(
            f"{name:18s} n {row['n']:3d}  coverage {row['coverage']:.3f} ({low:.3f} to {high:.3f})  "
            f"error mean {row['error_mean']:+.4f} median {row['error_median_abs']:.4f} "
            f"max {row['error_max_abs']:.4f}  within 0.03 {row['within_0.03']:.2f}  "
            f"width {row['width_median']:.3f}  well covered {row['well_covered']}  "
            f"status right {row['status_right']}"
        )
    typer.echo(f"not learned: {result['n_cases'] - result['n_learned']} of {result['n_cases']}")
    if json_file is not None:
        json_file.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
