"""What ``terrain estimate`` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Column, Table

from pipelines.estimate.results import EstimateResult
from pipelines.reporting.numbers import format_known
from terrain.estimation.stuck import StuckInterval
from terrain.estimation.summary import EstimateSummary
from terrain.estimation.tuned_noise import TunedNoise

_RIGHT = ("slip", "std", "true", "stale s", "NEES", "NIS cam.", "speed RMSE", "dropped", "gated")


def print_estimates(result: EstimateResult, console: Console) -> None:
    """Print slip, its truth where it is known, and how consistent the filter was, a run a line."""
    table = Table(
        Column("run", overflow="fold"),
        *(Column(name, justify="right") for name in _RIGHT),
        title=f"filter {result.filter}, {result.tuning} noise",
    )
    for row in result.runs:
        table.add_row(*_cells(row))
    console.print(table)
    if result.tuned is not None:
        console.print(_tuning_words(result.tuned))
    for row in result.runs:
        if row.motion is not None and row.stuck is not None:
            console.print(f"{row.run_id}: {_motion_words(row.motion, row.stuck)}", highlight=False)
    if not all(row.slip_observable for row in result.runs):
        console.print(
            "blind: this filter takes no measurement of the speed over ground, so the figure is the wheels "
            "against themselves, and the slip in the tracks is NaN; where logs have poses or a lidar twist, "
            "terrain measure-slip measures it"
        )
    for sentence in result.clocks:
        console.print(sentence, highlight=False)
    if result.out is not None:
        console.print(f"runs with state and slip written to {result.out}", highlight=False)
    for sentence in result.skipped:
        console.print(sentence, highlight=False)


def _cells(row: EstimateSummary) -> tuple[str, ...]:
    return (
        row.run_id,
        format_known(row.slip_mean, "{:+.4f}") + ("" if row.slip_observable else " blind"),
        format_known(row.slip_std, "{:.4f}"),
        format_known(row.slip_true_mean, "{:+.4f}"),
        f"{row.stale_s:.1f}",
        format_known(row.nees, "{:.2f}"),
        format_known(row.nis.get("camera_speed"), "{:.2f}"),
        format_known(row.speed_rmse_mps, "{:.4f}"),
        str(row.n_dropped),
        str(row.n_gated),
    )


def _motion_words(motion: Mapping[str, float], stuck: Sequence[StuckInterval]) -> str:
    """Return when a robot was stuck, and for how long nothing is known of its motion."""
    times = ", ".join(f"{interval.start_s:.1f} to {interval.end_s:.1f} s" for interval in stuck)
    found = f"stuck from {times}" if stuck else "not seen to be stuck"
    known = f"moving for {motion['moving']:.1f} s, at rest for {motion['at_rest']:.1f} s"
    return f"{found}; {known}, unknown for {motion['unknown']:.1f} s"


def _tuning_words(tuned: TunedNoise) -> str:
    scales = ", ".join(f"{name} {scale:.3g} ({tuned.status[name]})" for name, scale in tuned.scales.items())
    return f"process variances scaled on {', '.join(tuned.runs)}: {scales}"
