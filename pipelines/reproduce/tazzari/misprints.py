"""Equations of Tazzari et al. that are printed wrong: (11), V above (13), and (9) without wrapping."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from pipelines.reporting.drawing import BLUE, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.reproduce.tazzari.runs import STRAIGHT, orchard_ugv
from terrain.estimation.observers.tracked_stability import regressor
from terrain.records import Array

DURATION_S = 60.0
UNEVEN_PS = np.array([0.2, 0.2, 5.0])
"""Diagonal of an L that is not the identity, far from it so that the growth shows."""


def misprints(seed: int, quick: bool) -> Finding:
    """Integrate the error system (10) in straight motion with the printed and with the right equations."""
    right = regressor(0.0, *STRAIGHT.speed_mps, orchard_ugv().half_track_m)
    printed = np.column_stack([np.abs(right[:, 1]) * [1, 0, 1], -np.abs(right[:, 0]) * [1, 0, 1]])
    start = np.r_[np.zeros(3), 1.0 - np.array(STRAIGHT.eta_ratio)]
    frozen, converged = (_errors(m, np.ones(3), start) for m in (printed, right))
    wave = _errors(right, UNEVEN_PS, np.array([0.3, 0.0, 0.05, 0.0, 0.0]))
    v_printed = 0.5 * (np.sum(wave[:, :3] ** 2 / UNEVEN_PS, axis=1) + np.sum(wave[:, 3:] ** 2, axis=1))
    v_right = 0.5 * np.sum(wave**2, axis=1)
    rows = [
        Row(
            what=f"Error of the efficiencies after {DURATION_S:g} s, straight, from {start[3]:.2f}",
            where="(11)",
            printed="converges to 0",
            simulated=float(np.abs(converged[-1, 3:]).max()),
            unit="ratio",
            verdict=Verdict.CORRECTED,
            why="As printed, the second row of the regressor is the first times -v_L / v_R: its rank is 1, "
            "(14) does not hold, and the error stays as it is. With the signs of (8) its product is the "
            "printed Phi Phi^T and the error vanishes.",
            beside={
                "with (11) as printed": float(np.abs(frozen[-1, 3:]).max()),
                "rank as printed": float(np.linalg.matrix_rank(printed)),
                "rank": float(np.linalg.matrix_rank(right)),
            },
        ),
        Row(
            what="Largest growth of the Lyapunov function with L = diag(0.2, 0.2, 5)",
            where="above (13)",
            printed="never grows",
            simulated=growth(v_right),
            unit="ratio",
            verdict=Verdict.CORRECTED if growth(v_printed) > 1.01 else Verdict.AS_PRINTED,
            why="Largest value over the smallest one before it. With e' L^-1 e as printed the cross terms "
            "cancel only where L is the identity; with e'e they always do, and V' = -e' L e.",
            beside={"with V as printed": growth(v_printed)},
        ),
    ]
    time_s = _times()
    lines = [
        Line(time_s, np.asarray(frozen[:, 3]), VERMILION, "(11) as printed"),
        Line(time_s, np.asarray(converged[:, 3]), BLUE, "corrected"),
    ]
    caption = "Error of the efficiency of the left track in straight motion by (10), with both regressors."
    return Finding(rows, [Picture(caption, lines_figure("The regressor (11)", "error of efficiency", lines))])


def growth(values: Array) -> float:
    """Return the largest ratio of a value to one before it, 1 where none is larger.

    Examples
    --------
    >>> growth(np.array([2.0, 1.0, 1.5, 1.0]))
    1.5
    """
    return float(np.max(values / np.minimum.accumulate(values)))


def _times() -> Array:
    return np.linspace(0.0, DURATION_S, 1201)


def _errors(m: Array, gain_ps: Array, start: Array) -> Array:
    """Return errors (n, 5) of (10), with Lambda the identity, at a constant heading."""
    a = np.block([[-np.diag(gain_ps), -m], [m.T, np.zeros((2, 2))]])
    found = solve_ivp(lambda _, x: a @ x, (0.0, DURATION_S), start, t_eval=_times(), rtol=1e-9, atol=1e-12)
    return np.asarray(found.y.T)
