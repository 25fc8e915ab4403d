"""Remark 1 of Tazzari et al.: errors stay in proportion to additive disturbances; the bound as a number."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from pipelines.reporting.drawing import BLUE, GREEN, GREY, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reproduce.results import Finding, Picture, Row, holds
from pipelines.reproduce.tazzari.runs import MOTIONS, TrackMotion, orchard_ugv
from terrain.estimation.observers.tracked_stability import (
    ErrorBound,
    disturbance_bound,
    error_matrix,
    regressor,
)
from terrain.records import Array

STEP_S, DURATION_S = 0.05, 120.0
SIZE = 0.02
"""Of the disturbance: 2 cm/s, 0.02 rad/s and 0.02 1/s together."""


def disturbances(seed: int, quick: bool) -> Finding:
    """Drive the error system with disturbances of a fixed size: constant, random, and the worst there is."""
    rows, pictures = [], []
    for motion in MOTIONS:
        m = regressor(0.0, *motion.speed_mps, orchard_ugv().half_track_m)
        a = error_matrix(m, np.ones(3), np.eye(2), float(m[2] @ motion.eta_ratio))
        bound, found = disturbance_bound(a), _driven(a, np.random.default_rng(seed), quick)
        rows.append(_row(motion, bound, found))
        pictures.append(_picture(motion, bound, found))
    return Finding(rows, pictures)


def _driven(a: Array, rng: np.random.Generator, quick: bool) -> dict[str, Array]:
    """Return the norms (n,) of the errors, from an error of efficiency of 0.2 at the start."""
    n = round(DURATION_S / STEP_S) // (2 if quick else 1)
    exact = expm(STEP_S * np.block([[a, np.eye(5)], [np.zeros((5, 10))]]))
    weakest = np.linalg.svd(np.linalg.inv(a))[2][0]
    towards = np.empty((n, 5))
    towards[n - 1] = np.linalg.svd(np.linalg.inv(a))[0][:, 0]
    for k in range(n - 1, 0, -1):
        towards[k - 1] = exact[:5, :5].T @ towards[k]
    forces = {
        "constant": np.tile(weakest, (n, 1)),
        "random": rng.standard_normal((n, 5)),
        "worst at the end": towards,
    }
    found = {}
    for name, force in forces.items():
        x, norms = np.array([0.0, 0.0, 0.0, 0.2, 0.2]), np.empty(n)
        for k in range(n):
            unit = force[k] / max(float(np.linalg.norm(force[k])), 1e-300)
            x = exact[:5, :5] @ x + exact[:5, 5:] @ (SIZE * unit)
            norms[k] = np.linalg.norm(x)
        found[name] = norms
    return found


def _limit(bound: ErrorBound, n: int) -> Array:
    time_s = STEP_S * (1 + np.arange(n))
    decayed = bound.overshoot_ratio * np.exp(-bound.rate_ps * time_s) * np.hypot(0.2, 0.2)
    return np.asarray(decayed + bound.disturbance_s * SIZE)


def _row(motion: TrackMotion, bound: ErrorBound, found: dict[str, Array]) -> Row:
    inside = all((norms <= _limit(bound, len(norms))).all() for norms in found.values())
    late = max(float(norms[len(norms) // 2 :].max()) for norms in found.values())
    return Row(
        what=f"Largest error under disturbances of {SIZE:g}, {motion.words}",
        where="remark 1",
        printed="input-to-state stable",
        simulated=late,
        unit="ratio",
        verdict=holds(inside),
        why="The norm of all errors (metre, radian and ratio alike) in the second half of the time. The "
        "bound of the Lyapunov equation holds for constant, random and the worst disturbances; the paper "
        "states none.",
        beside={
            "bound": bound.disturbance_s * SIZE,
            "error per disturbance by the bound [s]": bound.disturbance_s,
            "rate by the bound [1/s]": bound.rate_ps,
        },
    )


def _picture(motion: TrackMotion, bound: ErrorBound, found: dict[str, Array]) -> Picture:
    n = len(found["constant"])
    time_s = STEP_S * (1 + np.arange(n))
    lines = [
        Line(time_s, _limit(bound, n), VERMILION, "bound"),
        Line(time_s, found["worst at the end"], BLUE, "worst disturbance"),
        Line(time_s, found["constant"], GREEN, "constant"),
        Line(time_s, found["random"], GREY, "random"),
    ]
    return Picture(
        f"Norm of the errors under disturbances of {SIZE:g}, {motion.words}, and the bound on it.",
        lines_figure(f"Remark 1 as a bound, {motion.words}", "norm of the errors", lines),
    )
