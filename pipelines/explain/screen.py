"""What ``terrain explain`` and ``terrain explain-trials`` print."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from rich.console import Console

from pipelines.explain.results import Explanation, HeldOutGain, TrialsResult
from pipelines.explain.wording import (
    caveat_text,
    effect_label,
    gain_text,
    unexplained_text,
    varying_text,
    verdict_text,
)
from pipelines.reporting.numbers import format_known, percent
from pipelines.reporting.quantities import quantity, unit_label
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.reporting.words import in_words_of
from terrain.discrepancy.channel_words import CHANNEL_WORDS
from terrain.discrepancy.filter_gain import Comparison
from terrain.discrepancy.statements import SESSION_COLUMNS, session_rows, split_ruled_out
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.trials.scoring import FOUND_TRIALS
from terrain.discrepancy.verdict import Cause, Diagnosis


def print_explain(result: Explanation, console: Console) -> None:
    """Print faults, a sentence a channel, the verdict, causes, gains, and what was withdrawn or is left."""
    diagnosis = result.diagnosis
    say = partial(_say, result.drive, console)
    say(f"{diagnosis.robot}, {diagnosis.n_runs} runs: {diagnosis.verdict.value}")
    say(*(f"fault: {fault.sentence}" for fault in diagnosis.faults))
    say(*(f"- {statement.text}" for statement in result.statements), verdict_text(diagnosis))
    if diagnosis.causes:
        _print_causes(diagnosis.causes, result.drive, console)
    if rows := session_rows(diagnosis):
        table = compact_table(*map(text_column, SESSION_COLUMNS))
        for row in rows:
            table.add_row(*(in_words_of(result.drive, cell) for cell in row))
        console.print(table)
    _print_gain(result.gain, console)
    sentences = () if result.powertrain is None else result.powertrain.sentences
    say(*_diagnosis_lines(diagnosis), *result.notes, *(f"powertrain: {text}" for text in sentences))
    if result.next_command is not None:
        print_lines(console, (f"what to drive next: {result.next_command}",))
    extended = [] if result.extended is None else [f"extended description: {result.extended.file}"]
    print_lines(console, (*result.skipped, *extended, f"page: {result.page}"))


def _say(drive: str, console: Console, *lines: str) -> None:
    print_lines(console, (in_words_of(drive, line) for line in lines))


def _print_causes(causes: tuple[Cause, ...], drive: str, console: Console) -> None:
    table = compact_table(text_column("cause"), *number_columns("value", "95 %", "held-out gain", "z"))
    for cause in causes:
        for place, each in enumerate(cause.values):
            first = place == 0
            table.add_row(
                in_words_of(drive, effect_label(cause.name)) if first else "",
                f"{each.value:.4g} {unit_label(each.unit) or each.unit}",
                f"{each.low:.4g} to {each.high:.4g}",
                percent(cause.gain) if first else "",
                f"{cause.z:.1f}" if first else "",
            )
    console.print(table)


def _print_gain(found: HeldOutGain, console: Console) -> None:
    gain, nameless = found.gain, found.nameless
    if gain is None:
        print_lines(console, (f"gain on held-out runs not measured: {found.reason}",))
    else:
        columns = number_columns("rms before", "after", "square less by", "95 %", "nameless learner")
        table = compact_table(text_column("channel"), *columns)
        for name, each in gain.channels.items():
            label, unit = CHANNEL_WORDS[name]
            learned = None if nameless is None else nameless.channels.get(name)
            table.add_row(
                label,
                f"{each.rms_before:.3g} {unit}",
                f"{each.rms_after:.3g}",
                percent(each.reduction.ratio),
                f"{each.reduction.low:.1%} to {each.reduction.high:.1%}",
                "" if learned is None else percent(learned.ratio),
            )
        console.print(table)
        print_lines(console, (gain_text(gain),))
    if nameless is not None:
        print_lines(console, (nameless.sentence,))
    trained = found.comparisons.get("classifier")
    if trained is not None:
        text = _accuracy_text(trained)
        print_lines(console, (f"classifier trained in simulation, on measured runs: {text}",))


def _diagnosis_lines(diagnosis: Diagnosis) -> Iterator[str]:
    varying = {each.name for each in diagnosis.varying}
    for cause in diagnosis.causes:
        if cause.aliases:
            yield f"no log distinguishes {cause.name} from {', '.join(cause.aliases)}"
        if cause.caveat and cause.name not in varying:
            yield f"{effect_label(cause.name)}: {caveat_text(cause.caveat)}"
    for effects in diagnosis.ambiguous_sets:
        values = ", ".join(
            f"{name} {quantity(each.name, each.value)}"
            for name in effects
            for each in diagnosis.ambiguous_values.get(name, ())
        )
        yield f"one of: {values}"
    for effect in split_ruled_out(diagnosis)[0]:
        values = ", ".join(quantity(each.name, each.value) for each in effect.values)
        yield f"withdrawn: {effect_label(effect.name)} {values}: {effect.reason}"
    for each in diagnosis.varying:
        yield varying_text(each)
    for left in diagnosis.unexplained:
        yield f"unexplained: {left.channel} {unexplained_text(left, diagnosis)}"
    if diagnosis.not_excited:
        names = ", ".join(limit.name for limit in diagnosis.not_excited)
        yield f"the driving would not have shown: {names}"
    for run in diagnosis.excluded_runs:
        yield f"excluded: {run.run_id}: {run.reason}"


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
