"""Section 6.1 of Danzi, AgriMaRo thesis: slip on grass while the camera measures nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, GRID, INK, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reporting.numbers import format_number
from pipelines.reproduce.danzi.runs import (
    ROBOT,
    estimate_with_both_filters,
    mean_between,
    seeded_runs,
    true_slip,
)
from pipelines.reproduce.over_runs import OverRuns, over_runs
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from terrain.estimation.estimate import Estimate
from terrain.records import Array
from terrain.robots import load_robot
from terrain.simulation.conditions import Faults

LOST_S = (10.0, 13.0)
"""When the camera measures nothing."""
LAST_S = (LOST_S[1] - 0.5, LOST_S[1])
"""When the slip is evaluated."""


def camera_lost(seed: int, quick: bool) -> Finding:
    """Estimate slip on grass with the camera lost for 3 s."""
    robot = load_robot(ROBOT)
    faults = Faults(camera_lost_s=(LOST_S,), by_chance=False)
    runs = seeded_runs(robot, "grass", "straight", seed, quick, duration_s=16.0, faults=faults)
    thesis, vio15 = estimate_with_both_filters(runs, robot)
    true = _at_the_end(vio15, true_slip).mean
    std = _at_the_end(vio15, lambda one: one.slip.slip_std).mean
    error = _at_the_end(vio15, lambda one: one.slip.slip_ratio - true_slip(one))
    worst = max(map(abs, error.spread))
    rows = [
        _row(
            "by the thesis' filter",
            _at_the_end(thesis, lambda one: one.blind.slip_ratio),
            "Only the wheels determine the speed now, and the slip falls to zero at once, without any "
            "indication of a fault. The filter here therefore reports no slip (NaN) until the camera "
            "is back.",
            {"true": true},
        ),
        _row(
            "by vio15",
            _at_the_end(vio15, lambda one: one.slip.slip_ratio),
            "The slip speeds drift as far as the covariance of the filter allows, here by up to "
            f"{format_number(worst)}; the slip is marked stale.",
            {"true": true, "standard deviation by the filter": std},
        ),
    ]
    picture = Picture(
        f"The camera lost from {LOST_S[0]:g} to {LOST_S[1]:g} s on grass: the slip by the thesis' filter "
        "falls to zero; vio15 maintains it, with a band of two standard deviations that grows.",
        _lost_figure(thesis[0], vio15[0]),
    )
    return Finding(rows, [picture])


def _at_the_end(estimates: Sequence[Estimate], slip: Callable[[Estimate], Array]) -> OverRuns:
    """Return the mean of a slip (n, wheels) over the last 0.5 s without the camera."""
    return over_runs([mean_between(slip(one), one, *LAST_S) for one in estimates])


def _row(what: str, slip: OverRuns, why: str, beside: dict[str, float]) -> Row:
    return Row(
        what=f"Slip on grass at the end of {LOST_S[1] - LOST_S[0]:g} s without the camera, {what}",
        where="6.1",
        printed="not given",
        simulated=slip.mean,
        spread=slip.spread,
        unit="ratio",
        verdict=Verdict.NOT_PRINTED,
        why=why,
        beside=beside,
    )


def _lost_figure(thesis: Estimate, vio15: Estimate) -> Figure:
    time_s = vio15.track.time_s
    shown = (time_s > LOST_S[0] - 3.0) & (time_s < LOST_S[1] + 3.0)
    estimated, std = vio15.slip.slip_ratio.mean(axis=1), vio15.slip.slip_std.mean(axis=1)

    def shade(axes: Axes) -> None:
        axes.axvspan(*LOST_S, color=GRID, lw=0, label="camera lost")
        low, high = (estimated - 2 * std)[shown], (estimated + 2 * std)[shown]
        axes.fill_between(time_s[shown], low, high, color=BLUE, alpha=0.18, lw=0)

    curves = {
        "vio15, ± 2 std": (estimated, BLUE),
        "thesis' filter": (thesis.blind.slip_ratio.mean(axis=1), VERMILION),
        "true": (true_slip(vio15).mean(axis=1), INK),
    }
    return lines_figure(
        "Slip on grass with the camera lost for 3 s",
        "slip, mean of the wheels",
        [Line(time_s[shown], values[shown], colour, label) for label, (values, colour) in curves.items()],
        shade,
    )
