"""``terrain inspect``: rates, lengths, gaps, stuck channels, and whether the loggers keep one clock."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.runs.datasets import data_digest, load_runs
from terrain.errors import ConfigError, DataError
from terrain.logs.clock import ClockEstimate, estimate_clock
from terrain.logs.quality import StreamQuality, stream_quality
from terrain.records import RunLog
from terrain.robots import load_robot

if TYPE_CHECKING:
    from rich.console import Console


def inspect_logs(
    folder: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
) -> dict[str, Any]:
    """Return what shape the runs under a folder are in.

    Parameters
    ----------
    folder, layout, mapping, repair : as in :func:`pipelines.runs.datasets.load_runs`

    Returns
    -------
    dict that JSON can hold: ``n_runs``, ``digest``, ``skipped`` and ``runs``; of each run ``run_id``,
    ``terrains``, ``dropped``, ``streams`` (``n``, ``rate_hz``, ``duration_s``, ``n_gaps``, ``longest_gap_s``,
    ``longest_gap_at_s``, ``jitter_s``, ``stuck``, ``n_nonfinite`` by channel, ``longest_constant_s`` by
    channel) and ``clock`` (the fields of :class:`~terrain.logs.clock.ClockEstimate`; None for what is not
    estimated, and for ``clock`` as a whole where the run has no gyro or no speeds of a left and a right
    wheel, or its robot is unknown)

    Raises
    ------
    LogError
        if a run cannot be read.
    """
    skipped: list[str] = []
    runs = load_runs(folder, layout=layout, mapping=mapping, repair=repair, on_skip=skipped.append)
    return {
        "n_runs": len(runs),
        "digest": data_digest(runs),
        "skipped": skipped,
        "runs": [_inspected(run) for run in runs],
    }


def print_inspection(report: dict[str, Any], console: Console) -> None:
    """Print what :func:`inspect_logs` returns as a table: a row per stream, the clock beside the wheels."""
    from rich.table import Table

    table = Table(title=f"{report['n_runs']} runs, digest {report['digest'][:12]}")
    for heading, right in (
        ("run", False),
        ("stream", False),
        ("rate Hz", True),
        ("length s", True),
        ("gaps", True),
        ("longest s", True),
        ("missing", True),
        ("stuck", False),
        ("clock of the wheels against the IMU", False),
    ):
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for run in report["runs"]:
        for name, stream in run["streams"].items():
            table.add_row(
                run["run_id"],
                name,
                f"{stream['rate_hz']:.2f}",
                f"{stream['duration_s']:.2f}",
                str(stream["n_gaps"]),
                f"{stream['longest_gap_s']:.2f}" if stream["n_gaps"] else "",
                str(sum(stream["n_nonfinite"].values())),
                ", ".join(stream["stuck"]),
                _clock_words(run["clock"]) if name == "wheels" else "",
            )
    console.print(table)
    for run in report["runs"]:
        if run["dropped"]:
            counts = ", ".join(f"{n} {kind}" for kind, n in run["dropped"].items())
            console.print(f"{run['run_id']}: dropped {counts}")
    for sentence in report["skipped"]:
        console.print(sentence)


def _inspected(run: RunLog) -> dict[str, Any]:
    try:
        clock: dict[str, Any] | None = _clock_dict(estimate_clock(run, track_m=load_robot(run.robot).track_m))
    except (ConfigError, DataError):
        clock = None
    return {
        "run_id": run.run_id,
        "terrains": list(run.terrains),
        "dropped": dict(run.dropped),
        "streams": {name: _stream_dict(stream_quality(stream)) for name, stream in run.streams.items()},
        "clock": clock,
    }


def _stream_dict(quality: StreamQuality) -> dict[str, Any]:
    channels = quality.channels.items()
    found = {key: value for key, value in quality._asdict().items() if key != "channels"}
    return _none_for_nan(found) | {
        "stuck": list(quality.stuck),
        "n_nonfinite": {name: channel.n_nonfinite for name, channel in channels},
        "longest_constant_s": {name: channel.longest_constant_s for name, channel in channels},
    }


def _clock_dict(estimate: ClockEstimate) -> dict[str, Any]:
    return _none_for_nan(estimate._asdict())


def _none_for_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}


def _clock_words(clock: dict[str, Any] | None) -> str:
    if clock is None:
        return "no gyro, no speeds of a left and a right wheel, or an unknown robot"
    if clock["offset_s"] is None:
        return str(clock["status"])
    words = f"{clock['status']}: offset {clock['offset_s']:+.3f} ± {clock['offset_std_s']:.3f} s"
    if clock["rate"] is not None:
        words += f", rate {100 * clock['rate']:+.2f} ± {100 * clock['rate_std']:.2f} %"
    return words
