"""What commands print: tables and progress on the terminal.  Results go to stdout, progress to stderr."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

from pipelines.classify.splits import counted
from pipelines.reporting.terminal import progress_bar as progress_bar
from terrain.control.slip_table import DRIVE_STATES

MAX_ROWS = 12


def percent(value: float | None) -> str:
    """Return a share as a percentage with one decimal, ``-`` for None."""
    return "-" if value is None else f"{value:.1%}"


def print_crossval(report: dict[str, Any], console: Console) -> None:
    """Print the headline, the classes, and the honest extras."""
    low, high = report["accuracy_ci"]
    spread = report["accuracy_spread"]
    repeats = f", spread over {report['repeats']} fold assignments {spread:.1%}" if spread is not None else ""
    console.print(
        f"{report['dataset']}, protocol {report['protocol']}, recipe {report['recipe']}: "
        f"{report['n_windows']} windows of {report['window_s']:g} s from {report['n_runs']} runs"
    )
    console.print(
        f"accuracy {percent(report['accuracy'])} (95 % over runs: {low:.1%} to {high:.1%}{repeats})",
        highlight=False,
    )
    console.print(
        f"balanced accuracy {percent(report['balanced_accuracy'])}, macro F1 {report['macro_f1']:.3f}, "
        f"vote over 5 s {percent(report['vote_accuracy'])}, calibration error {report['ece']:.3f}",
        highlight=False,
    )
    table = Table("terrain", "windows", "precision", "recall", "F1", title="per class, all repeats together")
    for name, row in report["per_class"].items():
        table.add_row(
            name, str(row["n_windows"]), percent(row["precision"]), percent(row["recall"]), f"{row['f1']:.3f}"
        )
    console.print(table)
    if "speed_only_accuracy" in report:
        console.print(
            f"from wheel speed alone: {percent(report['speed_only_accuracy'])} "
            "(what recognising the driving would give)",
            highlight=False,
        )
        print_slow_fast(report["slow_fast"], console)
        console.print(f"runs: {report['learning_curve']['statement']}", highlight=False)
    for note in (*report["notes"], *report.get("skipped", [])):
        console.print(f"note: {note}", highlight=False)


def print_slow_fast(result: dict[str, Any], console: Console) -> None:
    """Print whether what is learned at one speed holds at another."""
    out = "".join(f"; {name} left out ({reason})" for name, reason in result["left_out"].items())
    if result["status"] == "applicable":
        console.print(
            f"trained slow, tested fast: {percent(result['slow_to_fast'])}; "
            f"back: {percent(result['fast_to_slow'])} ({', '.join(result['classes'])}{out})",
            highlight=False,
        )
    else:
        console.print(f"trained slow, tested fast: not applicable{out}", highlight=False)


def print_training(result: dict[str, Any], console: Console) -> None:
    """Print where the model is and what became of the champion."""
    verdict = "champion" if result["alias_moved"] else "not champion"
    console.print(
        f"model {result['model_uri']} from {result['n_windows']} windows: "
        f"{verdict} ({result['alias_reason']})",
        highlight=False,
    )


def print_predictions(result: dict[str, Any], console: Console) -> None:
    """Print stretches of one terrain a run, with probability and target slip."""
    table = Table(
        "run", "from s", "windows", "terrain", "prob.", "traction", "braking", "steady", title="target slip"
    )
    stretches = list(_stretches(result["windows"]))
    for rows in stretches[:MAX_ROWS]:
        slip = rows[0]["target_slip"]
        probability = sum(row["probability"] for row in rows) / len(rows)
        table.add_row(
            rows[0]["run_id"],
            f"{rows[0]['start_s']:.1f}",
            str(len(rows)),
            rows[0]["terrain"],
            f"{probability:.2f}",
            *(f"{slip[state]:+.2f}" for state in DRIVE_STATES),
        )
    console.print(table)
    if len(stretches) > MAX_ROWS:
        console.print(f"... and {len(stretches) - MAX_ROWS} stretches more; --json has every window")
    fallen = sorted({row["terrain"] for row in result["windows"] if row["slip_entry"] != row["terrain"]})
    if fallen:
        entry = next(row["slip_entry"] for row in result["windows"] if row["slip_entry"] != row["terrain"])
        console.print(f"no entry in the slip table for {', '.join(fallen)}: the fallback {entry!r} stands in")
    unestimated = any("unestimated" in row["status"].values() for row in result["windows"])
    if unestimated:
        console.print(
            f"target slips from the table {result['table_name']!r} are unestimated: nobody measured them"
        )
    if result["accuracy"] is not None:
        trained = len(result["taught_runs"])
        caution = (
            f"; {trained} of {result['n_runs']} runs taught the model: memory, no skill" if trained else ""
        )
        console.print(
            f"accuracy {percent(result['accuracy'])} over {result['n_judged']} labelled windows{caution}",
            highlight=False,
        )
    for name, count in result["unknown_labels"].items():
        console.print(
            f"{count} windows are labelled {name}, which the model never saw: not judged", highlight=False
        )
    for words, counts in (("windows left out", result["dropped"]), ("repaired", result["repaired"])):
        if counts:
            console.print(f"{words}: {counted(counts)}", highlight=False)
    for sentence in result.get("skipped", []):
        console.print(sentence, highlight=False)


def _stretches(windows: list[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    rows: list[dict[str, Any]] = []
    for window in windows:
        if rows and (window["run_id"], window["terrain"]) != (rows[-1]["run_id"], rows[-1]["terrain"]):
            yield rows
            rows = []
        rows.append(window)
    if rows:
        yield rows


def print_learned_slip(result: dict[str, Any], console: Console) -> None:
    """Print curve and targets a terrain, and why some are not learned."""
    right = ("runs", "slips seen", "peak", "90 %", *DRIVE_STATES, "effic.", "J/m")
    table = Table(
        Column("terrain", overflow="fold"),
        "status",
        *(Column(name, justify="right") for name in right),
        title=f"target slip of {result['robot']}, learned from {result['n_runs']} runs",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    for terrain, row in result["terrains"].items():
        reach, interval = row["slip_range"], row["peak_slip_ci"]
        peak = _figure(row["peak_slip"], "{:.3f}") + ("*" if row["peak_status"] == "no_peak" else "")
        table.add_row(
            terrain,
            row["status"],
            str(row["n_runs"]),
            "-" if reach is None else f"{reach[0]:.2f}-{reach[1]:.2f}",
            peak,
            "-" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}",
            *(f"{row['targets'][state]['slip_ratio']:+.3f}" for state in DRIVE_STATES),
            _figure(row.get("traction_efficiency"), "{:.2f}"),
            _figure(row["energy_jpm"]["traction"] if "energy_jpm" in row else None, "{:.0f}"),
        )
    console.print(table)
    if any(row["peak_status"] == "no_peak" for row in result["terrains"].values()):
        console.print(
            "* no peak within the slips seen: the slip at 95 % of the largest net pull seen", highlight=False
        )
    for terrain, row in result["terrains"].items():
        if row["status"] != "estimated":
            source = row["targets"]["traction"]["source"]
            console.print(
                f"{terrain} is {row['status']}: {row['reason']}; its numbers are assumed ({source})",
                highlight=False,
            )
    if result["n_unlabelled"]:
        console.print(f"runs without a label, left out: {result['n_unlabelled']}", highlight=False)
    console.print(f"table written to {result['table']}", highlight=False)
    for sentence in result.get("skipped", []):
        console.print(sentence, highlight=False)


def print_slip(rows: list[dict[str, Any]], console: Console) -> None:
    """Print estimated and true slip a terrain."""
    right = [Column(name, justify="right") for name in ("runs", "slip", "true slip", "RMSE", "NEES")]
    table = Table("terrain", *right, title="steady slip of the simulated runs")
    for row in rows:
        table.add_row(
            row["terrain"],
            str(row["n_runs"]),
            *(_figure(row[key], "{:+.3f}") for key in ("slip_mean", "slip_true_mean")),
            _figure(row["slip_rmse"], "{:.4f}"),
            _figure(row["nees"], "{:.2f}"),
        )
    console.print(table)


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def print_drive(result: dict[str, Any], console: Console) -> None:
    """Print what each controller's drives cost, with their 95 % intervals over days."""
    ramp = result["ramp_mps2"]
    console.print(
        f"{result['robot']}, {result['scenario']} on {result['terrain']}, "
        f"days: {len(result['seeds'])}, table "
        f"{result['table']}, delay {result['delay_s']:g} s"
        + (f", ramp {ramp:.2f} m/s^2" if ramp is not None else ""),
        highlight=False,
    )
    controllers = result["controllers"]
    table = Table(title="mean over days, with its 95 % interval")
    table.add_column("", no_wrap=True)
    for name in controllers:
        table.add_column(name, overflow="fold")
    for key in next(iter(controllers.values())):
        figures = [controllers[name][key] for name in controllers]
        if all(figure["mean"] is None for figure in figures):
            continue
        table.add_row(key, *(_with_interval(figure) for figure in figures))
    console.print(table)


def _with_interval(figure: dict[str, Any]) -> str:
    if figure["mean"] is None:
        return "-"
    half = f" ± {(figure['ci'][1] - figure['ci'][0]) / 2:.2g}" if figure["ci"] else ""
    return f"{figure['mean']:.4g}{half}"
