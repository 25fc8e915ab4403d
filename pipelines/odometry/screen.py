"""What ``terrain odometry`` prints."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Column, Table

from pipelines.odometry.results import OdometryResult
from terrain.calibration.odometry_judge import LegScores

_RIGHT = ("RMSE [m]", "median", "heading", "below encoder [%]", "below gyro [%]")


def print_odometry(result: OdometryResult, console: Console) -> None:
    """Print the errors of each kind of odometry by the length of a leg, and the slip model."""
    for scores in result.scores:
        console.print(_table(scores, f"{result.robot}: position after {scores.length_s:.2g} s, held out"))
    if result.adaptive is not None:
        title = f"last windows of {result.adaptive.n_legs} commands, by efficiencies of the windows before"
        console.print(_table(result.adaptive, title))
    table = Table("slip model", *(Column(name, justify="right") for name in ("value", "95 % from", "to")))
    for name, found in result.parameters.items():
        table.add_row(name, f"{found.value:.4g}", f"{found.low:.4g}", f"{found.high:.4g}")
    console.print(table)
    x_m, y_m = result.observed_point_m
    console.print(
        f"the poses are of a point {100 * x_m:+.1f} cm ahead and {100 * y_m:+.1f} cm to the left, turned by "
        f"{math.degrees(result.observed_angle_rad):+.1f} degrees, {result.delay_s:.2f} s late",
        highlight=False,
    )
    for sentence in result.notes:
        console.print(sentence, highlight=False)
    if result.written is not None:
        console.print(f"slip model of all {result.n_runs} runs written to {result.written}", highlight=False)


def _table(scores: LegScores, title: str) -> Table:
    table = Table(
        "odometry",
        *(Column(name, justify="right") for name in _RIGHT),
        title=f"{title}: {scores.n_legs} legs of {scores.n_runs} runs, {scores.path_m:.2g} m apart",
    )
    for kind in scores.kinds:
        table.add_row(
            kind.kind,
            f"{kind.rmse_m:.3f} ({kind.rmse_ci_m[0]:.3f} to {kind.rmse_ci_m[1]:.3f})",
            f"{kind.median_m:.3f}",
            f"{math.degrees(kind.yaw_rmse_rad):.1f}°",
            _percent(kind.gain_encoder, kind.gain_encoder_ci),
            _percent(kind.gain_gyro, kind.gain_gyro_ci),
        )
    return table


def _percent(gain: float, interval: tuple[float, float]) -> str:
    if gain == 0.0:
        return ""
    return f"{100 * gain:.0f} ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"
