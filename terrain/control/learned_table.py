"""The table of target slips of the terrains that were learned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import median_low
from typing import Any

from terrain.control.slip_table import DRIVE_STATES, SIGN, CurveEntry, SlipTable, load_slip_table
from terrain.records import SlipTarget, TargetStatus
from terrain.robots import Robot
from terrain.simulation.slip_sweep import learning_runs
from terrain.slip_learning.curve import SlipCurve
from terrain.slip_learning.laws import LAW_PARAMETERS
from terrain.slip_learning.learn import LearnedTerrain, TerrainRun, learn_terrain, terrain_runs
from terrain.slip_learning.targets import Targets, energy_jpm, tractive_efficiency
from terrain.terramechanics.soil import load_soil

FALLBACK = "unknown"
DIGITS = 4
"""Of slips and ratios of forces in the table: a hundredth of their standard deviation."""


def simulated_table(
    robot: Robot, terrains: Sequence[str], seed: int, progress: Callable[[int, int], None]
) -> SlipTable:
    """Return target slips learned from simulated runs on terrains, as ``terrain learn-slip`` learns them.

    Parameters
    ----------
    robot : swerve robot
    terrains : soils
    seed : of the runs, and of what is learned from them
    progress : gets the number of terrains that are done, and of all
    """
    learned = []
    for done, terrain in enumerate(terrains, start=1):
        measured = [one for log in learning_runs(robot, terrain, seed) for one in terrain_runs(log, robot)]
        learned.append(learn_terrain(load_soil(terrain).name, measured, seed))
        progress(done, len(terrains))
    return learned_table(learned, robot, "learned")


def learned_table(learned: Sequence[LearnedTerrain], robot: Robot, name: str) -> SlipTable:
    """Return the table: learned numbers, assumed ones where nothing was learned, and the fallback.

    The fallback is for a terrain without an entry: of each drive state the lower median of the estimated
    terrains' numbers, and the packaged table's own without any.  The least of them would not do: on soft
    terrain the slip for tiles would not overcome the resistance.

    Parameters
    ----------
    learned : of each terrain
    robot : that drove
    name : of the table
    """
    default = load_slip_table()
    targets: dict[str, Mapping[str, SlipTarget]] = {}
    curves, reasons = {}, {}
    for entry in learned:
        if entry.curve is not None and entry.targets is not None:
            targets[entry.terrain] = _estimated(entry.terrain, entry.targets, entry.curve.n_runs)
            curves[entry.terrain] = curve_entry(entry.curve, entry.targets, robot)
        else:
            targets[entry.terrain] = _assumed(entry, default)
            reasons[entry.terrain] = entry.reason
    reasons.setdefault(FALLBACK, "used for a terrain without an entry")
    targets.setdefault(FALLBACK, _fallback(targets, default))
    return SlipTable(name, FALLBACK, targets, robot.name, curves, reasons)


def _estimated(terrain: str, targets: Targets, n_runs: int) -> dict[str, SlipTarget]:
    found = {}
    for state in DRIVE_STATES:
        slip, std, source = targets.of(state)
        numbers = round(slip, DIGITS), round(std, DIGITS), n_runs
        found[state] = SlipTarget(terrain, state, *numbers, TargetStatus.ESTIMATED, source)
    return found


def _assumed(entry: LearnedTerrain, default: SlipTable) -> dict[str, SlipTarget]:
    found = {}
    for state, assumed in default.lookup(entry.terrain).items():
        source = f"table {default.name}, {assumed.terrain}: {assumed.source}"
        numbers = assumed.slip_ratio, math.nan, 0
        found[state] = SlipTarget(entry.terrain, state, *numbers, entry.status, source)
    return found


def _fallback(targets: Mapping[str, Mapping[str, SlipTarget]], default: SlipTable) -> dict[str, SlipTarget]:
    estimated = [
        by_state for by_state in targets.values() if by_state["traction"].status is TargetStatus.ESTIMATED
    ]
    chosen = {}
    for state in DRIVE_STATES:
        if estimated:
            slip = SIGN[state] * median_low(abs(by_state[state].slip_ratio) for by_state in estimated)
            source = "lower median of the terrains estimated here"
        else:
            slip = default.targets[default.fallback][state].slip_ratio
            source = f"table {default.name}, its fallback"
        chosen[state] = SlipTarget(FALLBACK, state, slip, math.nan, 0, TargetStatus.UNESTIMATED, source)
    return chosen


def curve_entry(curve: SlipCurve, targets: Targets, robot: Robot) -> CurveEntry:
    """Return what the table holds of a curve, rounded."""
    energy = {
        state: round(energy_jpm(curve, targets.of(state).slip_ratio, robot), 1) for state in DRIVE_STATES
    }
    named = zip(LAW_PARAMETERS[curve.law], curve.parameters, strict=True)
    working = targets.working_slip_ratio
    return CurveEntry(
        law=curve.law,
        parameters={name: round(value, DIGITS + 1) for name, value in named},
        peak_slip_ratio=round(curve.peak.slip_ratio, DIGITS),
        peak_interval_ratio=_rounded(curve.peak_interval),
        peak_status=curve.peak.status,
        slip_range_ratio=_rounded(curve.slip_range),
        resistance_ratio=round(curve.resistance_ratio, DIGITS),
        resistance_std=round(curve.resistance_std, DIGITS),
        balance_slip_ratio=round(curve.balance_slip_ratio, DIGITS),
        peak_based_slip_ratio=round(targets.peak_based_slip_ratio, DIGITS),
        working_slip_ratio=None if math.isnan(working) else round(working, DIGITS),
        traction_efficiency_ratio=round(tractive_efficiency(curve, targets.traction.slip_ratio), 3),
        traction_energy_jpm=energy["traction"],
        braking_energy_jpm=energy["braking"],
        steady_energy_jpm=energy["steady"],
        n_runs=curve.n_runs,
    )


def run_row(run: TerrainRun) -> dict[str, Any]:
    """Return how much one run shows on one terrain, and mass and resistance by its force balance."""
    mass_kg, mass_std_kg, ratio, std = run.balance
    slips = run.bins.slip_ratio
    return {
        "run_id": run.run_id,
        "terrain": run.terrain,
        "n_samples": run.n_samples,
        "n_bins": len(slips),
        "slip_range": _rounded((float(slips.min()), float(slips.max()))) if len(slips) else None,
        "mass_kg": round(mass_kg, 1),
        "mass_std_kg": round(mass_std_kg, 1),
        "resistance_ratio": round(ratio, DIGITS),
        "resistance_std": round(std, DIGITS),
        "left_out": run.left_out,
    }


def terrain_row(learned: LearnedTerrain, slips: SlipTable) -> dict[str, Any]:
    """Return whether and why the targets of a terrain are learned; what is of a curve only where one was."""
    curve = slips.curves.get(learned.terrain)
    row = {
        "status": learned.status,
        "reason": learned.reason or None,
        "n_runs": len(learned.runs_with_bins),
        "n_samples": sum(run.n_samples for run in learned.runs),
        "slip_range": None if math.isnan(learned.slip_range[0]) else _rounded(learned.slip_range),
        "peak_slip": curve and curve.peak_slip_ratio,
        "peak_slip_ci": curve and curve.peak_interval_ratio,
        "peak_status": curve and curve.peak_status,
        "targets": slips.target_rows(learned.terrain),
    }
    if curve is None or learned.curve is None:
        return row
    return row | {
        "law": curve.law,
        "parameters": curve.parameters,
        "resistance_ratio": curve.resistance_ratio,
        "resistance_std": curve.resistance_std,
        "balance_slip": curve.balance_slip_ratio,
        "working_slip": curve.working_slip_ratio,
        "peak_based_slip": curve.peak_based_slip_ratio,
        "traction_efficiency": curve.traction_efficiency_ratio,
        "energy_jpm": {state: getattr(curve, f"{state}_energy_jpm") for state in DRIVE_STATES},
        "scores": {law: round(score, 3) for law, score in learned.curve.scores.items()},
    }


def _rounded(pair: tuple[float, float]) -> tuple[float, float]:
    return round(pair[0], DIGITS), round(pair[1], DIGITS)
