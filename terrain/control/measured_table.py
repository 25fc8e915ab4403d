"""The table of target slips that runs at constant speed show: steady slip, measured from outside.

A robot that is driven at a constant speed takes the slip at which thrust balances resistance: the *steady*
target, with its error over runs.  How much more thrust more slip would give, and where its peak is, such runs
do not show; the targets of traction and braking stay assumed, traction at least just above the steady slip,
or no robot would start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from terrain.control.learned_table import DIGITS, FALLBACK
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.measured_slip.surfaces import SurfaceSlip
from terrain.records import SlipTarget, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.targets import MIN_ABOVE_BALANCE_SLIP

MIN_RUNS = 3
"""From fewer, how a median differs from run to run is not known."""

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
