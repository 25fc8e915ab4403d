"""What commands print: tables and progress on the terminal.  Results go to stdout, progress to stderr."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

from pipelines.reporting.terminal import progress_bar as progress_bar
from terrain.control.slip_table import DRIVE_STATES


def percent(value: float | None) -> str:
    """Return a share as a percentage with one decimal, ``-`` for None."""
    return "-" if value is None else f"{value:.1%}"


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


def print_explain(result: dict[str, Any], console: Console) -> None:
    """Print what the simulation lacks, how sure that is, what it is worth, and what was not seen."""
    from pipelines.explain.page import gain_words, quantity, verdict_words, words_of

    console.print(f"{result['robot']}, {result['n_runs']} runs: {result['verdict']}", highlight=False)
    console.print(verdict_words(result), highlight=False)
    if result["causes"]:
        table = Table(
            Column("cause", overflow="fold"),
            *(Column(name, justify="right") for name in ("value", "95 %", "held-out gain", "z")),
            box=SIMPLE,
            padding=(0, 1, 0, 0),
        )
        for cause in result["causes"]:
            for place, each in enumerate(cause["parameters"]):
                first = place == 0
                table.add_row(
                    words_of(cause["name"]) if first else "",
                    f"{each['value']:.4g} {each['unit']}",
                    f"{each['ci'][0]:.4g} to {each['ci'][1]:.4g}",
                    percent(cause["held_out_gain"]) if first else "",
                    f"{cause['z']:.1f}" if first else "",
                )
        console.print(table)
    for left in result["unexplained"]:
        console.print(f"without a name: {left['channel']} follows {left['input']}", highlight=False)
    if result["not_excited"]:
        names = ", ".join(limit["name"] for limit in result["not_excited"])
        console.print(f"the driving would not have shown: {names}", highlight=False)
    for effect in result["causes"]:
        if effect["aliases"]:
            console.print(
                f"no log tells {effect['name']} from {', '.join(effect['aliases'])}", highlight=False
            )
    for names in result["ambiguous_sets"]:
        told = ", ".join(
            f"{name} {quantity(each['name'], each['value'])}"
            for name in names
            for each in result["ambiguous_values"].get(name, ())
        )
        console.print(f"one of: {told}", highlight=False)
    if result["next_drive"] is not None:
        told = ", ".join(f"{key} {value}" for key, value in result["next_drive"].items())
        console.print(f"what to drive next: {told}", highlight=False)
    for run in result["excluded_runs"]:
        console.print(f"left out: {run['run_id']}: {run['reason']}", highlight=False)
    for note in result.get("notes", ()):
        console.print(note, highlight=False)
    gained = result["gain"]
    if gained["measured"]:
        console.print(gain_words(gained), highlight=False)
        if trained := gained.get("classifier"):
            if trained["reason"]:
                told = f"not measured: {trained['reason']}"
            else:
                accuracy = trained["errors"]["accuracy"]
                told = "{:.1%} right before, {:.1%} after".format(accuracy["before"], accuracy["after"])
                told += ", change {:+.1%} to {:+.1%}".format(*accuracy["change_ci"])
            console.print(f"classifier taught in simulation, on measured runs: {told}", highlight=False)
    else:
        console.print(f"gain on untouched runs not measured: {gained['reason']}", highlight=False)
    for sentence in result.get("skipped", []):
        console.print(sentence, highlight=False)
    if result["extended"]:
        console.print(f"extended description: {result['extended']['file']}", highlight=False)
    console.print(f"page: {result['page']}", highlight=False)


def print_explain_trials(result: dict[str, Any], console: Console) -> None:
    """Print how often blind trials came out right, beside the bars, and how small an effect is found."""
    from pipelines.explain.trials import FOUND_TRIALS

    right = [Column(name, justify="right") for name in ("of", "rate", "95 %")]
    table = Table(
        Column("figure", overflow="fold"), *right, "wanted", "met", box=SIMPLE, padding=(0, 1, 0, 0)
    )
    for name, rate in result["table"].items():
        table.add_row(
            name,
            f"{rate['hits']}/{rate['of']}",
            percent(rate["rate"]),
            f"{rate['low']:.1%} to {rate['high']:.1%}",
            rate["bar"],
            ("yes" if rate["met"] else "no") if rate["bar"] else "",
        )
    console.print(table)
    if "found" in result["rows"]:
        found = result["found_from"]
        names = sorted({effect for effects in found.values() for effect in effects})
        if names:
            columns = [Column(robot, justify="right") for robot in found]
            table = Table(
                "nine in ten are found from, over the limit", *columns, box=SIMPLE, padding=(0, 1, 0, 0)
            )
            for effect in names:
                cells = [f"{found[r][effect]:.2f}" if effect in found[r] else "" for r in found]
                table.add_row(effect, *cells)
            console.print(table)
        else:
            console.print(f"row found: no effect had {FOUND_TRIALS} trials; --n is too small to say more")
    seconds = result["seconds"]
    console.print(
        f"{len(result['trials'])} trials of {result['runs']} runs, seed {result['seed']}; a diagnosis took "
        f"{seconds['median']:.2f} s in the middle, {seconds['worst']:.2f} s at worst",
        highlight=False,
    )


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
