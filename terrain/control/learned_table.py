"""Tables of target slips that runs show: by the slip curves of terrains, or by steady slip measured from outside.

A robot that is driven at a constant speed takes the slip at which thrust balances resistance: the *steady*
target, with its error over sessions.  How much more thrust more slip would give, and where its peak is, such runs
do not show; the targets of traction and braking stay assumed, traction at least just above the steady slip,
or no robot would start.  What such a target of one session costs in another session of the same surface is measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import median_low
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.control.slip_table import DRIVE_STATES, SIGN, CurveEntry, SlipTable, load_slip_table
from terrain.records import Array, SlipTarget, TargetStatus
from terrain.robots import Robot, SwerveRobot
from terrain.simulation.run import learning_runs
from terrain.slip_learning.curve import (
    LAW_PARAMETERS,
    MIN_ABOVE_BALANCE_SLIP,
    PEAK_SLIP_RATIO,
    SlipCurve,
    TargetSlip,
    energy_jpm,
    tractive_efficiency,
)
from terrain.slip_learning.learn import LearnedTerrain, TerrainRun, learn_terrain, terrain_runs
from terrain.slip_learning.measured import (
    Measured,
    OperatingPoints,
    measure_steady,
    operating_points,
    surface_slips,
)
from terrain.terramechanics.soil import load_soil

FALLBACK = "unknown"
DIGITS = 4  #: Of slips and ratios of forces in the table: a hundredth of their standard deviation.
MIN_RUNS = 3  #: From fewer, how a median differs from run to run is not known.
N_DRAWS = 1000

FOR_OTHERS = "used for a terrain without an entry"
NO_PEAK = (
    "steady motion alone is used: the slip where thrust balances resistance, which shows no peak of thrust"
)
FEW_RUNS = f"fewer than {MIN_RUNS} runs with a slip in steady motion"
BRAKES = "the median slip is negative: the robot is faster than its wheels, downhill or by a wrong radius"

SPINS_RATIO = 0.8  #: Slip beyond which a robot hardly moves: a fifth of what its wheels roll
SPINS = "the robot hardly moves: its wheels spin, and where thrust balances resistance is not shown"


def simulated_table(
    robot: Robot, terrains: Sequence[str], seed: int, progress: Callable[[int, int], None]
) -> SlipTable:
    """Return target slips learned from simulated runs on soils, as ``terrain learn-slip`` learns them."""
    if not isinstance(robot, SwerveRobot):
        runs = []
        for done, terrain in enumerate(terrains, start=1):
            runs += learning_runs(robot, terrain, seed)
            progress(done, len(terrains))
        return learn_surfaces(measure_steady(runs, robot, seed)[1], robot, "learned", seed)[0]
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
    """
    targets: dict[str, dict[str, SlipTarget]] = {}
    curves, reasons, estimated = {}, {}, []
    for entry in learned:
        terrain = entry.terrain
        if (curve := entry.curve) is None or entry.targets is None:
            targets[terrain] = _assumed(terrain, entry.status)
            reasons[terrain] = entry.reason
            continue
        curves[terrain], numbers = curve_entry(curve, entry.targets, robot), {}
        for state in DRIVE_STATES:
            slip, std, source = entry.targets[state]
            rounded = round(slip, DIGITS), round(std, DIGITS), curve.n_runs
            rest = TargetStatus.ESTIMATED, source, curve.n_sessions
            numbers[state] = SlipTarget(terrain, state, *rounded, *rest)
        targets[terrain] = numbers
        estimated.append(numbers)
    if FALLBACK not in targets:
        targets[FALLBACK] = _assumed(FALLBACK)
        source = "lower median of the terrains estimated here"
        for state, target in targets[FALLBACK].items() if estimated else ():
            slip = SIGN[state] * median_low(abs(entry[state].slip_ratio) for entry in estimated)
            targets[FALLBACK][state] = target._replace(slip_ratio=slip, source=source)
    reasons.setdefault(FALLBACK, FOR_OTHERS)
    return SlipTable(name, FALLBACK, targets, robot.name, curves, reasons)


def _assumed(terrain: str, status: TargetStatus = TargetStatus.UNESTIMATED) -> dict[str, SlipTarget]:
    """Return the numbers of the packaged table for a terrain."""
    table = load_slip_table()
    return {
        state: SlipTarget(
            terrain,
            state,
            target.slip_ratio,
            math.nan,
            0,
            status,
            f"table {table.name}, {target.terrain}: {target.source}",
        )
        for state, target in table.lookup(terrain).items()
    }


def curve_entry(curve: SlipCurve, targets: Mapping[str, TargetSlip], robot: Robot) -> CurveEntry:
    """Return what the table holds of a curve, rounded."""
    energy = {
        f"{state}_energy_jpm": round(energy_jpm(curve, targets[state].slip_ratio, robot), 1)
        for state in DRIVE_STATES
    }
    named = zip(LAW_PARAMETERS[curve.law], curve.parameters, strict=True)
    working = curve.working_slip_ratio
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
        peak_based_slip_ratio=round(PEAK_SLIP_RATIO * curve.peak.slip_ratio, DIGITS),
        working_slip_ratio=None if math.isnan(working) else round(working, DIGITS),
        traction_efficiency_ratio=round(tractive_efficiency(curve, targets["traction"].slip_ratio), 3),
        **energy,
        n_runs=curve.n_runs,
        n_sessions=curve.n_sessions,
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
        "n_sessions": len({run.bins.session for run in learned.runs_with_bins}),
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


class Transfer(NamedTuple):
    """The slip of one session taken for another of the same surface: what it costs."""

    terrain: str  #: surface, and the two sessions
    learned: str
    driven: str
    slip_learned: float  #: medians over runs
    slip_driven: float
    n_learned: int  #: runs with a slip in steady motion
    n_driven: int
    difference: float  #: of what was driven from what was learned
    #: its 95 % interval, by draws of runs of both; NaN where a session has fewer than :data:`MIN_RUNS` runs
    interval: tuple[float, float]


def transfers(measured: Measured, rng: np.random.Generator) -> list[Transfer]:
    """Return what each session of runs, labelled with one terrain each, shows beside each other of the same surface."""
    medians: dict[tuple[str, str], list[float]] = {}
    for run, slip in zip(measured.runs, measured.slips, strict=True):
        known = slip.body_slip[slip.steady & np.isfinite(slip.body_slip)]
        if known.size:
            medians.setdefault((run.terrains[0], run.session), []).append(float(np.median(known)))

    def drawn(values: Array) -> Array:
        return np.asarray(np.median(values[bootstrap_rows(values.size, N_DRAWS, rng)], axis=1))

    shown = []
    for terrain, learned in sorted(medians):
        for driven in sorted(other for place, other in medians if place == terrain and other != learned):
            one, two = np.array(medians[terrain, learned]), np.array(medians[terrain, driven])
            interval = math.nan, math.nan
            if min(one.size, two.size) >= MIN_RUNS:
                interval = percentile_interval(drawn(two) - drawn(one))
            slips = float(np.median(one)), float(np.median(two))
            difference = slips[1] - slips[0]
            shown.append(Transfer(terrain, learned, driven, *slips, one.size, two.size, difference, interval))
    return shown


def learn_surfaces(
    measured: Measured, robot: Robot, name: str, seed: int
) -> tuple[SlipTable, dict[str, dict[str, Any]], dict[str, OperatingPoints], tuple[Transfer, ...]]:
    """Return what runs on one terrain each show.

    Returns
    -------
    table : of target slips
    surfaces : by name: the slip as measured, medians over runs of current and thrust over load with their
        quartiles, targets, and why there are no more
    points : operating points of the runs on each
    transfers : of targets from session to session
    """
    rng, by_terrain = np.random.default_rng(seed), measured.by_terrain()
    slips = surface_slips(measured, rng)
    targets, reasons = dict[str, dict[str, SlipTarget]](), dict[str, str]()
    for terrain, slip in slips.items():  # steady slip where it was measured, assumed numbers elsewhere
        targets[terrain] = assumed = _assumed(terrain)
        # an interval with 0 in it is that of a wheel that hardly slips, whose radius is known to a percent
        reasons[terrain] = BRAKES if slip.slip_ratio < 0.0 and not slip.interval[1] >= 0.0 else NO_PEAK
        if slip.slip_ratio > SPINS_RATIO:
            reasons[terrain] = SPINS
        if slip.n_runs < MIN_RUNS:
            reasons[terrain] = FEW_RUNS
        if reasons[terrain] is not NO_PEAK:
            continue
        low, high = slip.interval
        ratio, std = max(round(slip.slip_ratio, DIGITS), 0.0), round(slip.interval_std, DIGITS)
        source = (
            f"sessions: {slip.n_sessions}, runs: {slip.n_runs}, measured from outside; {low:.3f} to {high:.3f} "
            f"({slip.interval_of.words})"
        )
        estimated = slip.n_runs, TargetStatus.ESTIMATED, source, slip.n_sessions
        assumed["steady"] = SlipTarget(terrain, "steady", ratio, std, *estimated)
        least = min(ratio + MIN_ABOVE_BALANCE_SLIP, 1.0)
        if assumed["traction"].slip_ratio < least:
            source = "assumed: just above the steady slip that was measured"
            assumed["traction"] = assumed["traction"]._replace(slip_ratio=round(least, DIGITS), source=source)
    targets.setdefault(FALLBACK, _assumed(FALLBACK))
    reasons.setdefault(FALLBACK, FOR_OTHERS)
    table = SlipTable(name, FALLBACK, targets, robot.name, {}, reasons)
    points = {terrain: operating_points(own.runs, own.slips, robot) for terrain, own in by_terrain.items()}
    surfaces: dict[str, dict[str, Any]] = {}
    for terrain, slip in slips.items():
        row = surfaces[terrain] = {"slip": slip}
        for key in ("current_a", "thrust_ratio"):  # median, and the quartiles below and above it
            values = getattr(points[terrain], key)
            known = values[np.isfinite(values)]
            low, middle, high = np.quantile(known, [0.25, 0.5, 0.75]) if known.size else np.full(3, math.nan)
            row[key] = float(middle), float(low), float(high)
        row |= {"targets": table.target_rows(terrain), "reason": reasons[terrain]}
    return table, surfaces, points, tuple(transfers(measured, rng))
