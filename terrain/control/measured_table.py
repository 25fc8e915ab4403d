"""The table of target slips that runs at constant speed show: steady slip, measured from outside.

A robot that is driven at a constant speed takes the slip at which thrust balances resistance: the *steady*
target, with its error over runs.  How much more thrust more slip would give, and where its peak is, such runs
do not show; the targets of traction and braking stay assumed, traction at least just above the steady slip,
or no robot would start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.control.learned_table import DIGITS, FALLBACK
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.transfer import MIN_RUNS, Transfer, transfers
from terrain.measured_slip.measure import Measured
from terrain.measured_slip.operating import OperatingPoints, operating_points
from terrain.measured_slip.surfaces import SurfaceSlip, surface_slip
from terrain.records import Array, SlipTarget, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.targets import MIN_ABOVE_BALANCE_SLIP

NO_PEAK = (
    "steady motion alone is used: the slip where thrust balances resistance, which shows no peak of thrust"
)
FEW_RUNS = f"fewer than {MIN_RUNS} runs with a slip in steady motion"
BRAKES = "the median slip is negative: the robot is faster than its wheels, downhill or by a wrong radius"

_Z95 = 1.959964


def measured_table(surfaces: Sequence[SurfaceSlip], robot: Robot, name: str) -> SlipTable:
    """Return the table of a robot: steady slip where it was measured, assumed numbers elsewhere.

    Parameters
    ----------
    surfaces : labelled ones
    robot : that drove
    name : of the table
    """
    default = load_slip_table()
    targets: dict[str, Mapping[str, SlipTarget]] = {}
    reasons: dict[str, str] = {}
    for surface in surfaces:
        reasons[surface.terrain] = reason_of(surface)
        targets[surface.terrain] = _targets(surface, default)
    reasons.setdefault(FALLBACK, "used for a terrain without an entry")
    if FALLBACK not in targets:
        targets[FALLBACK] = _copied(FALLBACK, default.targets[default.fallback], default)
    return SlipTable(name, FALLBACK, targets, robot.name, {}, reasons)


def reason_of(surface: SurfaceSlip) -> str:
    """Return why a surface has no more targets than it has."""
    if surface.n_runs < MIN_RUNS:
        return FEW_RUNS
    return BRAKES if surface.slip_ratio < 0.0 else NO_PEAK


def _targets(surface: SurfaceSlip, default: SlipTable) -> dict[str, SlipTarget]:
    assumed = _copied(surface.terrain, default.lookup(surface.terrain), default)
    if reason_of(surface) is not NO_PEAK:
        return assumed
    low, high = surface.interval
    steady = SlipTarget(
        surface.terrain,
        "steady",
        round(surface.slip_ratio, DIGITS),
        round((high - low) / (2 * _Z95), DIGITS),
        surface.n_runs,
        TargetStatus.ESTIMATED,
        f"median over {surface.n_runs} runs, measured from outside; 95 % {low:.3f} to {high:.3f}",
    )
    traction = assumed["traction"]
    least = min(steady.slip_ratio + MIN_ABOVE_BALANCE_SLIP, 1.0)
    if traction.slip_ratio < least:
        source = "assumed: just above the steady slip that was measured"
        traction = traction._replace(slip_ratio=round(least, DIGITS), source=source)
    return {**assumed, "steady": steady, "traction": traction}


def _copied(terrain: str, entry: Mapping[str, SlipTarget], default: SlipTable) -> dict[str, SlipTarget]:
    return {
        state: target._replace(
            terrain=terrain,
            slip_std=math.nan,
            n_runs=0,
            status=TargetStatus.UNESTIMATED,
            source=f"table {default.name}, {target.terrain}: {target.source}",
        )
        for state, target in entry.items()
    }


class LearnedSurfaces(NamedTuple):
    """What was learned of surfaces.

    Parameters
    ----------
    table : of target slips
    surfaces : by name: the slip as measured, medians over runs of current and thrust over load with their
        quartiles, targets, and why there are no more
    points : operating points of the runs on each
    transfers : of targets from session to session
    """

    table: SlipTable
    surfaces: dict[str, dict[str, Any]]
    points: dict[str, OperatingPoints]
    transfers: tuple[Transfer, ...]


def learn_surfaces(found: Measured, robot: Robot, name: str, seed: int) -> LearnedSurfaces:
    """Return what runs on one terrain each show.

    Parameters
    ----------
    found : runs with their slip
    robot : that drove
    name : of the table
    seed : of the bootstrap
    """
    rng, by_terrain = np.random.default_rng(seed), found.by_terrain()
    slips = {each: surface_slip(each, own.slips, rng) for each, own in by_terrain.items()}
    table = measured_table(list(slips.values()), robot, name)
    points = {each: operating_points(own.runs, own.slips, robot) for each, own in by_terrain.items()}
    surfaces = {
        each: {
            "slip": slip,
            "current_a": _quartiles(points[each].current_a),
            "thrust_ratio": _quartiles(points[each].thrust_ratio),
            "targets": table.target_rows(each),
            "reason": reason_of(slip),
        }
        for each, slip in slips.items()
    }
    return LearnedSurfaces(table, surfaces, points, tuple(transfers(found.runs, found.slips, rng)))


def _quartiles(values: Array) -> tuple[float, float, float]:
    """Return the median, and the quartiles below and above it."""
    known = values[np.isfinite(values)]
    if not known.size:
        return math.nan, math.nan, math.nan
    low, middle, high = np.quantile(known, [0.25, 0.5, 0.75])
    return float(middle), float(low), float(high)
