"""What the observer of Tazzari et al. does where the trees of an orchard hide the satellites, and at rest."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from pipelines.reporting.drawing import BLUE, GRID, INK, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.reproduce.tazzari.runs import (
    CIRCLE,
    PAPER,
    STRAIGHT,
    ObservedRun,
    constant_speeds,
    observed,
    seeds,
)
from terrain.estimation.observers.family import ObserverStatus
from terrain.simulation.tracked.given_slip import GivenSlip

LOST_S = (40.0, 50.0)
STAND_S = (60.0, 660.0)


def missing_fixes(seed: int, quick: bool) -> Finding:
    """Lose the fixes for 10 s on the circle, and stand for 10 minutes after a straight run."""
    speeds, slip = constant_speeds(CIRCLE, 80.0), GivenSlip(*CIRCLE.eta_ratio)
    lost = [observed(slip, speeds, each, lost_s=[LOST_S]) for each in seeds(seed, quick)]
    stop = constant_speeds(STRAIGHT, STAND_S[1] / (5.0 if quick else 1.0))
    stop[np.arange(len(stop)) * 0.02 >= STAND_S[0]] = 0.0
    stood = observed(GivenSlip(*STRAIGHT.eta_ratio), stop, seed)
    return Finding([_lost_row(lost), *_standing_rows(stood)], [_picture(lost[0])])


def _lost_row(runs: list[ObservedRun]) -> Row:
    off_m, stated_m, resets = [], [], 0
    for run in runs:
        k = int(np.searchsorted(run.time_s, LOST_S[1] - 0.01)) - 1
        off_m.append(float(np.hypot(*(run.track.mean[k, :2] - run.pose[k, :2]))))
        stated_m.append(float(np.hypot(*run.track.std[k, :2])))
        resets += int(np.sum(run.track.status == ObserverStatus.RESET))
    return Row(
        what=f"Position error after {LOST_S[1] - LOST_S[0]:g} s without a fix, circle",
        where="I",
        printed="not given",
        simulated=float(np.mean(off_m)),
        spread=(min(off_m), max(off_m)),
        unit="m",
        verdict=Verdict.NOT_PRINTED,
        why="The efficiencies are kept and the pose is dead reckoning with them; at the next fix the pose "
        f"begins anew ({resets} times in {len(runs)} runs), as the interval is longer than "
        f"{PAPER.longest_interval_s:g} s.",
        beside={"standard deviation stated by the observer": float(np.mean(stated_m))},
    )


def _standing_rows(run: ObservedRun) -> list[Row]:
    standing = np.flatnonzero(run.track.status == ObserverStatus.STANDING)
    standing = standing[run.time_s[standing] > STAND_S[0] + 1.0]
    change = np.abs(run.track.slip[standing] - run.track.slip[standing[0]]).max()
    off_m = np.hypot(*(run.track.mean[standing, :2] - run.pose[standing, :2]).T)
    minutes = (run.time_s[standing[-1]] - run.time_s[standing[0]]) / 60.0
    return [
        Row(
            what=f"Change of the slip in {minutes:.1f} minutes at rest",
            where="IV",
            printed="speeds are positive (assumption 1)",
            simulated=float(change),
            unit="ratio",
            verdict=Verdict.NOT_PRINTED,
            why="A track that is slower than 2 cm/s counts as standing: the regressor is 0, and the noise of "
            "fixes moves no estimate. The position is the fixes, low-pass filtered.",
            beside={"largest position error [m]": float(off_m.max())},
        )
    ]


def _picture(run: ObservedRun) -> Picture:
    shown = (run.time_s > LOST_S[0] - 10.0) & (run.time_s < LOST_S[1] + 10.0)
    time_s, off = run.time_s[shown], (run.track.mean[:, :2] - run.pose[:, :2])[shown]
    std = np.hypot(*run.track.std[shown, :2].T)

    def shade(axes: Axes) -> None:
        axes.axvspan(*LOST_S, color=GRID, lw=0, label="no fix")

    lines = [
        Line(time_s, np.hypot(*off.T), BLUE, "error of the position"),
        Line(time_s, 2.0 * std, VERMILION, "2 std, stated"),
        Line(time_s, np.zeros(len(time_s)), INK, "_zero"),
    ]
    return Picture(
        f"Position error on the circle without a fix from {LOST_S[0]:g} to {LOST_S[1]:g} s, and what the "
        "observer states.",
        lines_figure("Dead reckoning with the estimated efficiencies", "position error [m]", lines, shade),
    )
