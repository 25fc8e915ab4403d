"""What ``terrain can`` prints when it stops."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console

from pipelines.can_bridge.results import BridgeReport, Latency
from pipelines.reporting.terminal import print_lines


def print_report(report: BridgeReport, console: Console) -> None:
    """Print frames, what was dropped by kind, states and latencies."""
    print_lines(
        console,
        [
            f"{report.interface} {report.channel}: {report.duration_s:.1f} s, {report.frames_in} frames in, "
            f"{report.frames_used} used, {report.frames_out} out",
            *_counts("samples", report.samples),
            *_counts("dropped", report.dropped),
            *_counts("bus errors", report.bus_errors),
            *_counts("sent as the end of the range", report.clipped),
            *_counts("control steps", report.states),
            *([f"control steps left out: {report.ticks_missed}"] if report.ticks_missed else []),
            f"wheels to correction: {_latency(report.wheels_to_correction)}",
            f"control step: {_latency(report.step)}",
        ],
    )


def _counts(title: str, counts: Mapping[str, int]) -> list[str]:
    return [f"{title}: " + ", ".join(f"{name} {n}" for name, n in counts.items())] if counts else []


def _latency(latency: Latency) -> str:
    if latency.median_ms is None or latency.p99_ms is None:
        return "none"
    return f"median {latency.median_ms:.2f} ms, p99 {latency.p99_ms:.2f} ms"
