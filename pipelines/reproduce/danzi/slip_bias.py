"""Section 6.1 of Danzi, AgriMaRo thesis: slip estimated with wheel rows that assume zero slip."""

from __future__ import annotations

from pipelines.reproduce.danzi.runs import (
    ROBOT,
    estimate_with_both_filters,
    seeded_runs,
    steady_mean,
    true_slip,
)
from pipelines.reproduce.over_runs import over_runs
from pipelines.reproduce.results import Finding, Row, Verdict, verdict_of
from terrain.robots import Robot, load_robot


def slip_bias(seed: int, quick: bool) -> Finding:
    """Estimate slip on grass, straight ahead and in an arc, from zero-slip wheel rows and the camera."""
    robot = load_robot(ROBOT)
    scenarios = {"straight": "straight on", "arc": "in an arc of 0.3 rad/s"}
    return Finding([_row(robot, name, words, seed, quick) for name, words in scenarios.items()])


def _row(robot: Robot, scenario: str, words: str, seed: int, quick: bool) -> Row:
    runs = seeded_runs(robot, "grass", scenario, seed, quick)
    thesis, vio15 = estimate_with_both_filters(runs, robot)
    true = over_runs([steady_mean(true_slip(one), one) for one in thesis])
    slip = over_runs([steady_mean(one.slip.slip_ratio, one) for one in thesis])
    low_by = 1.0 - slip.mean / true.mean
    agrees = verdict_of(slip.mean, true.spread) is Verdict.AS_PRINTED
    return Row(
        what=f"Steady slip on grass, {words}, by the thesis' filter",
        where="6.1, 7.2.3",
        printed="the true value, in steady driving",
        simulated=slip.mean,
        spread=slip.spread,
        unit="ratio",
        verdict=Verdict.AS_PRINTED if agrees else Verdict.CORRECTED,
        why=f"{100 * low_by:.0f} % low: wheel rows that assume zero slip pull the estimated speed towards "
        "that of the wheels. A slip speed of each wheel among the states (vio15) removes this bias.",
        beside={
            "true": true.mean,
            "vio15": over_runs([steady_mean(one.slip.slip_ratio, one) for one in vio15]).mean,
        },
    )
