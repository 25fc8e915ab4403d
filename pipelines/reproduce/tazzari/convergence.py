"""Section V of Tazzari et al.: how long the efficiencies take to converge, by speed and gains."""

from __future__ import annotations

import numpy as np

from pipelines.reporting.drawing import BLUE, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, holds
from pipelines.reproduce.tazzari.runs import (
    CIRCLE,
    CONVERGED_RATIO,
    NORMALISED,
    PAPER,
    STRAIGHT,
    ObservedRun,
    TrackMotion,
    converged_s,
    observed_motion,
    rms,
    seeds,
)
from terrain.simulation.tracked.run import QUIET

SPEEDS_MPS = (0.3, 0.6, 1.0)
DURATION_S = 60.0


def convergence(seed: int, quick: bool) -> Finding:
    """Observe straight motion at three speeds, without noise, and with noise for the price of a gain."""
    motions = [STRAIGHT._replace(speed_mps=(speed, speed)) for speed in SPEEDS_MPS]
    paper, normalised = (
        [observed_motion(motion, seed, DURATION_S, settings, QUIET) for motion in motions]
        for settings in (PAPER, NORMALISED)
    )
    circle = observed_motion(CIRCLE, seed, DURATION_S, PAPER, QUIET)
    rows = [
        _row(f"straight at {speed:g} m/s, L and Lambda the identity", run, Verdict.NOT_PRINTED, _SLOW)
        for speed, run in zip(SPEEDS_MPS, paper, strict=True)
    ]
    rows.append(_row("circle at 0.4 and 0.6 m/s, the same gains", circle, Verdict.NOT_PRINTED, _CIRCLE))
    times = [converged_s(run, CONVERGED_RATIO[0]) for run in normalised]
    explained = max(times) < min(converged_s(run, CONVERGED_RATIO[0]) for run in paper)
    for speed, run in zip(SPEEDS_MPS, normalised, strict=True):
        rows.append(_row(f"straight at {speed:g} m/s, normalised gain", run, holds(explained), _FAST, _CLAIM))
    rows += [_noise_row(motion, seed, quick) for motion in (STRAIGHT, CIRCLE)]
    return Finding(rows, [_picture(paper[0], normalised[0])])


_CLAIM = "identity gains explain the convergence time"
_SLOW = (
    "Until both errors stay within 5 % of the true efficiency, from 1, without noise. With constant gains "
    "the slowest rate of the error system goes with the square of the speed."
)
_CIRCLE = "The slower track adapts slowest; the efficiencies differ from 1 in opposite directions."
_FAST = (
    "The paper attributes its convergence time to its gains. With Lambda = (M' L^-2 M)^-1 / 4 and L = 2 the "
    "time is the same at every speed, without tuning; what it costs is noise, see below."
)


def _row(words: str, run: ObservedRun, verdict: Verdict, why: str, printed: str = "no time is given") -> Row:
    within_5, within_2 = (converged_s(run, ratio) for ratio in CONVERGED_RATIO)
    return Row(
        what=f"Convergence time, {words}",
        where="V",
        printed=printed,
        simulated=within_5,
        unit="s",
        verdict=verdict,
        why=why,
        beside={"within 2 %": within_2},
    )


def _noise_row(motion: TrackMotion, seed: int, quick: bool) -> Row:
    errors = []
    for settings in (PAPER, NORMALISED):
        runs = [observed_motion(motion, each, settings=settings) for each in seeds(seed, quick)]
        errors.append(float(np.mean([rms((run.estimate - run.eta)[run.time_s > 30.0]) for run in runs])))
    return Row(
        what=f"Steady error of the efficiencies with raw fixes of 2 cm at 10 Hz, {motion.words}",
        where="V",
        printed="robust to raw measurements",
        simulated=errors[0],
        unit="ratio",
        verdict=holds(errors[0] < 0.005),
        why="Root mean square after 30 s, gains of the paper; a faster observer passes on more noise.",
        beside={"normalised gain": errors[1]},
    )


def _picture(paper: ObservedRun, normalised: ObservedRun) -> Picture:
    lines = [
        Line(paper.time_s, paper.estimate[:, 0], BLUE, "L and Λ the identity"),
        Line(normalised.time_s, normalised.estimate[:, 0], VERMILION, "normalised, L = 2"),
    ]
    return Picture(
        "Convergence of the efficiency of the left track at 0.3 m/s, true value 0.87, without noise.",
        lines_figure("Convergence at 0.3 m/s by gains", "efficiency", lines),
    )
