"""What ``terrain explain`` and ``terrain explain-trials`` print."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console

from pipelines.explain.results import Explanation, TrialsResult
from pipelines.explain.wording import effect_label, gain_text, quantity, verdict_text
from pipelines.reporting.numbers import format_known, percent
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from terrain.discrepancy.filter_gain import Comparison
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.trials.scoring import FOUND_TRIALS
from terrain.discrepancy.verdict import Cause, Diagnosis


def print_explain(result: Explanation, console: Console) -> None:
    """Print what the simulation lacks, with which evidence, the gain, and what could not be detected."""
    diagnosis = result.diagnosis
    print_lines(
        console,
        (f"{diagnosis.robot}, {diagnosis.n_runs} runs: {diagnosis.verdict.value}", verdict_text(diagnosis)),
    )
    if diagnosis.causes:
        _print_causes(diagnosis.causes, console)
    print_lines(console, _diagnosis_lines(diagnosis))
    print_lines(console, result.notes)
    print_lines(console, _gain_lines(result))
    print_lines(console, result.skipped)
    if result.extended is not None:
        print_lines(console, (f"extended description: {result.extended.file}",))
    print_lines(console, (f"page: {result.page}",))


def _print_causes(causes: tuple[Cause, ...], console: Console) -> None:
    table = compact_table(text_column("cause"), *number_columns("value", "95 %", "held-out gain", "z"))
    for cause in causes:
        for place, each in enumerate(cause.values):
            first = place == 0
            table.add_row(
                effect_label(cause.name) if first else "",
                f"{each.value:.4g} {each.unit}",
                f"{each.low:.4g} to {each.high:.4g}",
                percent(cause.gain) if first else "",
                f"{cause.z:.1f}" if first else "",
            )
    console.print(table)


def _diagnosis_lines(diagnosis: Diagnosis) -> Iterator[str]:
    for left in diagnosis.unexplained:
        yield f"unexplained: {left.channel} depends on {left.input}"
    if diagnosis.not_excited:
        names = ", ".join(limit.name for limit in diagnosis.not_excited)
        yield f"the driving would not have shown: {names}"
    for cause in diagnosis.causes:
        if cause.aliases:
            yield f"no log distinguishes {cause.name} from {', '.join(cause.aliases)}"
    for effects in diagnosis.ambiguous_sets:
        values = ", ".join(
            f"{name} {quantity(each.name, each.value)}"
            for name in effects
            for each in diagnosis.ambiguous_values.get(name, ())
        )
        yield f"one of: {values}"
    if diagnosis.next_drive is not None:
        drive = ", ".join(f"{key} {value}" for key, value in diagnosis.next_drive._asdict().items())
        yield f"what to drive next: {drive}"
    for run in diagnosis.excluded_runs:
        yield f"excluded: {run.run_id}: {run.reason}"


def _gain_lines(result: Explanation) -> Iterator[str]:
    gain = result.gain
    if gain.gain is None:
        yield f"gain on held-out runs not measured: {gain.reason}"
        return
    yield gain_text(gain.gain)
    trained = gain.comparisons.get("classifier")
    if trained is not None:
        yield f"classifier trained in simulation, on measured runs: {_accuracy_text(trained)}"


def _accuracy_text(trained: Comparison) -> str:
    if trained.reason:
        return f"not measured: {trained.reason}"
    accuracy = trained.errors["accuracy"]
    text = f"accuracy {accuracy.before:.1%} before, {accuracy.after:.1%} after"
    if accuracy.change_ci is not None:
        text += ", change {:+.1%} to {:+.1%}".format(*accuracy.change_ci)
    return text


def print_explain_trials(result: TrialsResult, console: Console) -> None:
    """Print how often blind trials came out right, beside the bars, and how small an effect is found."""
    table = compact_table(text_column("figure"), *number_columns("of", "rate", "95 %"), "required", "met")
    for name, score in result.table.items():
        table.add_row(
            name,
            f"{score.hits}/{score.of}",
            percent(score.rate),
            f"{score.low:.1%} to {score.high:.1%}",
            score.bar,
            ("yes" if score.met else "no") if score.bar else "",
        )
    console.print(table)
    if Row.FOUND in result.rows:
        _print_found(result, console)
    seconds = result.seconds
    line = (
        f"{len(result.trials)} trials of {result.runs} runs, seed {result.seed}; a diagnosis took "
        f"{seconds.median:.2f} s (median), {seconds.worst:.2f} s (worst)"
    )
    print_lines(console, (line,))


def _print_found(result: TrialsResult, console: Console) -> None:
    found = result.found_from
    names = sorted({effect for effects in found.values() for effect in effects})
    if not names:
        console.print(f"row found: no effect had {FOUND_TRIALS} trials; a larger --n is required")
        return
    table = compact_table("nine in ten are found from, over the limit", *number_columns(*found))
    for effect in names:
        table.add_row(effect, *(format_known(found[robot].get(effect), "{:.2f}", "") for robot in found))
    console.print(table)
