"""Benchmarks on the screen."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from pipelines.bench.fleet import FleetBench
from pipelines.bench.results import LiveBench, Soak, Spread
from pipelines.reporting.terminal import print_lines


def print_bench(result: LiveBench, console: Console) -> None:
    """Print each figure with its unit."""
    table = Table("stage", "median", "99 %", "largest", title="latency")

    def row(name: str, found: Spread, unit: str) -> None:
        table.add_row(name, *(f"{value:.3g} {unit}" for value in found))

    row("control step", result.step_us, "us")
    row("control step while a window is classified", result.step_beside_window_us, "us")
    row("control step at 50 Hz in real time", result.step_paced_us, "us")
    row("window to terrain", result.window_ms, "ms")
    row("round trip, one robot at 100 Hz", result.websocket_ms, "ms")
    console.print(table)
    many = Table(
        "robots", "median", "99 %", "samples lost", title="control steps at 20 Hz, samples at 100 Hz"
    )
    for one in result.by_sessions:
        many.add_row(
            str(one.sessions), f"{one.median_ms:.2f} ms", f"{one.p99_ms:.2f} ms", str(one.lost_samples)
        )
    console.print(many)
    print_lines(
        console,
        [
            f"start to the first observation {result.start_s:.2f} s, memory {result.rss_mb:.0f} MB, "
            f"after all robots {result.rss_loaded_mb:.0f} MB"
        ],
    )


def print_soak(result: Soak, console: Console) -> None:
    """Print what the service did, and what is not accepted of it."""
    table = Table("fault", "made", title=f"{result.minutes:g} minutes, seed {result.seed}")
    for kind, n in sorted(result.faults.items()):
        table.add_row(kind, str(n))
    console.print(table)
    lines = [
        f"{result.steps} steps: {result.not_finite} not finite, {result.stale} stale, "
        f"{result.wrong_session} of another robot, {result.unanswered} unanswered; {result.crashes} crashes",
        f"memory {result.rss_mb[0]:.0f} MB at first, {result.rss_mb[-1]:.0f} MB at last: "
        f"{result.memory_growth:+.1%} from the first third to the last",
        *(f"not accepted: {problem}" for problem in result.problems),
    ]
    print_lines(console, lines if result.problems else [*lines, "nothing that is not accepted"])


def print_fleet(result: FleetBench, console: Console) -> None:
    """Print time and memory by size and number of processes, and what follows from them."""
    table = Table(
        "runs", "processes", "seconds", "runs/s", "CPU seconds", "peak memory", title="features of a fleet"
    )
    for one in result.points:
        table.add_row(
            str(one.n_runs),
            str(one.n_workers),
            f"{one.seconds:.1f}",
            f"{one.runs_per_s:.1f}",
            f"{one.cpu_s:.1f}",
            f"{one.peak_mb:.0f} MB",
        )
    console.print(table)
    ups = "; ".join(f"{n} processes {times:.2f} times one" for n, times in result.speed_up.items())
    print_lines(
        console,
        [
            f"time a run deviates by at most {result.nonlinearity_ratio:.1%} from that of the largest size, "
            f"processor time a run by {result.cpu_nonlinearity_ratio:.1%}",
            f"peak memory of all processes grows by {result.memory_growth_ratio:+.1%} "
            "from the smallest to the largest size",
            *([ups] if ups else []),
            f"before: runs of {result.run_s:g} s generated in {result.generate_ms:.1f} ms each, "
            f"all of them generated and written in {result.write_s:.1f} s",
        ],
    )
