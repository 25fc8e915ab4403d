"""Section 6.1.1 of Danzi, AgriMaRo thesis: variance of the steering within its dead band."""

from __future__ import annotations

from pipelines.reporting.numbers import format_number
from pipelines.reproduce.danzi.runs import ROBOT
from pipelines.reproduce.results import Finding, Row, Verdict, verdict_of
from terrain.robots import load_robot

PRINTED_RAD2 = 1.35e-4
"""(6.8)."""


def dead_band(seed: int, quick: bool) -> Finding:
    """Compare the variance (2 d)^2 / 12 of a uniform distribution over the dead band +-d with (6.8)."""
    half_rad = load_robot(ROBOT).equipment.steering.dead_band_rad
    variance = (2 * half_rad) ** 2 / 12
    printed = (PRINTED_RAD2, PRINTED_RAD2)
    agrees = verdict_of(variance, printed) is Verdict.AS_PRINTED
    row = Row(
        what="Variance of the steering within its dead band",
        where="(6.8)",
        printed=format_number(PRINTED_RAD2),
        printed_interval=printed,
        simulated=variance,
        unit="rad²",
        verdict=Verdict.AS_PRINTED if agrees else Verdict.CORRECTED,
        why=f"0.042²/12 is {format_number(variance)}. The filter is not affected: P_0 rounds to 1.5·10⁻⁴ "
        "with both.",
    )
    return Finding([row])
