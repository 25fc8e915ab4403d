"""Section 4.6.1 of Danzi, AgriMaRo thesis: the noise of the wheels raised and that of the IMU lowered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import CLASS_COLOURS
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reporting.numbers import format_number
from pipelines.reproduce.danzi.runs import (
    NO_SLIP_RATIO,
    ROBOT,
    mean_between,
    seeded_runs,
    steady_mean,
    true_slip,
)
from pipelines.reproduce.over_runs import over_runs
from pipelines.reproduce.results import Finding, Picture, Row, holds
from terrain.estimation.estimate import Estimate, estimate_run
from terrain.estimation.filters.swerve_noise import adaptive_noise
from terrain.records import Array
from terrain.robots import load_robot

FACTORS = (1.0, 1e2, 1e4, 1e6)
"""Factors by which the noise of the wheels is raised and that of the IMU lowered."""
WHEEL_SPEED_MPS = 1.0
"""Commanded wheel speed of the scenario ``straight``."""
FREQUENT = 1 / 3
"""Fraction of the runs from which on an event is frequent."""


def adaptive_tuning(seed: int, quick: bool) -> Finding:
    """Estimate slip over one minute on grass with each factor."""
    robot = load_robot(ROBOT)
    length_s = 30.0 if quick else 60.0
    runs = seeded_runs(robot, "grass", "straight", seed, quick, duration_s=length_s)
    estimates = {
        factor: [
            estimate_run(run, robot, "encoder12", tuning="thesis", noise=adaptive_noise(robot, factor))
            for run in runs
        ]
        for factor in FACTORS
    }
    true = over_runs([steady_mean(true_slip(one), one) for one in estimates[max(FACTORS)]]).mean
    picture = Picture(
        "Adaptive tuning on one run: the higher the assumed noise of the wheels, the more the speed is an "
        "integral of the accelerometer, and its error that of the bias. With low noise of the wheels the "
        "speed is wrong by the slip.",
        _drift_figure({factor: row[0] for factor, row in estimates.items()}),
    )
    return Finding([_slip_error(estimates, true, length_s), _drift(estimates, true, length_s)], [picture])


def _slip_error(estimates: Mapping[float, Sequence[Estimate]], true: float, length_s: float) -> Row:
    errors = {
        factor: over_runs([_slip_error_ratio(one, length_s) for one in row])
        for factor, row in estimates.items()
    }
    best = min(errors.values(), key=lambda error: error.mean)
    return Row(
        what="Absolute error of the slip over the last 10 s, with the best of four factors",
        where="4.6.1",
        printed="no factor gives the real slip",
        simulated=best.mean,
        spread=best.spread,
        unit="ratio",
        verdict=holds(best.mean > NO_SLIP_RATIO),
        why="With low noise of the wheels the slip is zero; with high noise it is the integrated bias of the "
        "accelerometer, which differs between runs. An error of 0.01 would pass for the real slip.",
        beside={"true slip": true} | {f"factor {f:g}": error.mean for f, error in errors.items()},
    )


def _drift(estimates: Mapping[float, Sequence[Estimate]], true: float, length_s: float) -> Row:
    drifts = {factor: [abs(_drift_mps(one)) for one in row] for factor, row in estimates.items()}
    most = max(FACTORS)
    drift = over_runs(drifts[most])
    slip_speed_mps = true * WHEEL_SPEED_MPS
    n_runs = len(drifts[most])
    n_diverged = sum(value > slip_speed_mps for value in drifts[most])
    return Row(
        what=f"Drift of the speed from 10 s to {length_s:g} s, factor {most:g}",
        where="4.6.1",
        printed="diverged frequently",
        simulated=drift.mean,
        spread=drift.spread,
        unit="m/s",
        verdict=holds(n_diverged >= FREQUENT * n_runs),
        why=f"{n_diverged} of {n_runs} runs drift by more than the slip speed to be estimated, "
        f"{format_number(slip_speed_mps)} m/s. Speed over ground has to be measured.",
        beside={f"factor {f:g}": over_runs(drifts[f]).mean for f in FACTORS[:-1]},
    )


def _slip_error_ratio(estimate: Estimate, length_s: float) -> float:
    last = mean_between(estimate.blind.slip_ratio, estimate, length_s - 10.0, length_s)
    return abs(last - steady_mean(true_slip(estimate), estimate))


def _drift_mps(estimate: Estimate) -> float:
    error = _speed_error_mps(estimate)
    return float(error[-50:].mean() - error[np.abs(estimate.track.time_s - 10.0) < 0.5].mean())


def _speed_error_mps(estimate: Estimate) -> Array:
    assert estimate.truth is not None  # simulated
    column = estimate.track.states.index("speed_x_mps")
    return np.asarray(estimate.track.state("speed_x_mps") - estimate.truth[:, column])


def _drift_figure(estimates: Mapping[float, Estimate]) -> Figure:
    return lines_figure(
        "Adaptive tuning: error of the speed, grass",
        "error of the speed [m/s]",
        [
            Line(one.track.time_s, _speed_error_mps(one), colour, f"factor {factor:g}")
            for (factor, one), colour in zip(estimates.items(), CLASS_COLOURS, strict=False)
        ],
    )
