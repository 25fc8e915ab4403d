"""From a result to what its page shows, section by section."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pipelines.explain.results import Explanation, HeldOutGain
from pipelines.explain.view import (
    AmbiguousView,
    CauseView,
    ChannelGainView,
    ClockView,
    ComparisonView,
    Entry,
    ErrorView,
    FigureView,
    GainView,
    NextDriveView,
    PageView,
    RuledOutView,
    RunPicture,
    UnexplainedView,
    ValueView,
    VerdictView,
)
from pipelines.explain.wording import (
    caveat_text,
    channel_label,
    effect_label,
    gain_text,
    limit_text,
    terrain_text,
    unexplained_text,
    value_with_interval,
    varying_text,
    verdict_text,
)
from pipelines.reporting.numbers import NBSP, NOT_KNOWN, sentence
from pipelines.reporting.quantities import (
    enumerated,
    interval,
    number,
    percentage,
    percentage_interval,
    unit_label,
)
from pipelines.reporting.versions import versions
from terrain.discrepancy.channel_words import CHANNEL_WORDS
from terrain.discrepancy.filter_gain import Comparison
from terrain.discrepancy.gain import ChannelGain
from terrain.discrepancy.health.runs import Clock
from terrain.discrepancy.nameless import Learned
from terrain.discrepancy.statements import session_rows, split_ruled_out
from terrain.discrepancy.verdict import Cause, Diagnosis, Limit, RuledOut
from terrain.effects import LIBRARY

COMPARISON_TITLES = {"filter": "Error of the filter {name}", "classifier": "Classifier {name}"}
ERROR_LABELS = {
    "speed_mps": ("speed, root mean square", "m/s"),
    "yaw_rate_radps": ("yaw rate, root mean square", "rad/s"),
    "slip_ratio": ("mean slip of a run, off by", ""),
    "accuracy": ("accuracy", ""),
}
"""What an error of a filter or a classifier is called, and its unit."""


def page_view(result: Explanation, figures: Sequence[FigureView], runs: Sequence[RunPicture]) -> PageView:
    """Return what the page of a result shows."""
    diagnosis, gain = result.diagnosis, result.gain
    missed = {limit.name for limit in diagnosis.not_excited}
    withdrawn, ruled_out = split_ruled_out(diagnosis)
    return PageView(
        heading=f"What the simulation of {diagnosis.robot} gets wrong",
        lead=_lead(result),
        faults=tuple(sentence(fault.sentence) for fault in diagnosis.faults),
        statements=tuple(sentence(statement.text) for statement in result.statements),
        verdict=_verdict(result),
        gain=_gain(gain),
        gain_reason=gain.reason or "",
        comparisons=() if gain.gain is None else tuple(_comparisons(gain.comparisons)),
        causes=tuple(_cause(cause, result.terms.get(cause.name, "")) for cause in diagnosis.causes),
        ambiguous=tuple(_ambiguous(names, diagnosis) for names in diagnosis.ambiguous_sets),
        withdrawn=tuple(map(_ruled_out, withdrawn)),
        varying=tuple(map(varying_text, diagnosis.varying)),
        unexplained=tuple(
            UnexplainedView(
                channel_label(left.channel),
                unexplained_text(left, diagnosis),
                number(round(left.z, 1)),
                percentage(left.ratio) if left.ratio else NOT_KNOWN,
            )
            for left in diagnosis.unexplained
        ),
        powertrain=() if result.powertrain is None else result.powertrain.sentences,
        next_drive=_next_drive(result),
        sessions=session_rows(diagnosis),
        figures=tuple(figures),
        runs=tuple(runs),
        ruled_out=tuple(map(_ruled_out, ruled_out)),
        missed=tuple(_limit(limit, True) for limit in diagnosis.limits if limit.name in missed),
        limits=tuple(_limit(limit, False) for limit in diagnosis.limits if limit.name not in missed),
        excluded=tuple(Entry(run.run_id, run.reason) for run in diagnosis.excluded_runs),
        clocks=tuple(map(_clock, diagnosis.clocks)),
        clocks_text=_clocks_text(diagnosis.clocks),
        provenance=tuple(_provenance(result)),
    )


def _lead(result: Explanation) -> str:
    parts = [f"{result.diagnosis.n_runs} runs compared"]
    if result.held_out:
        parts.append(f"{len(result.held_out)} held out for the gain")
    parts += [part for part in (result.data, result.terrain) if part]
    return " · ".join(parts)


def _verdict(result: Explanation) -> VerdictView:
    excluded = ", ".join(run.run_id for run in result.diagnosis.excluded_runs)
    warnings = (f"Runs that were excluded as unfit: {excluded}.",) if excluded else ()
    gain = result.gain.gain
    return VerdictView(
        verdict_text(result.diagnosis), "" if gain is None else gain_text(gain), (*warnings, *result.notes)
    )


def _cause(cause: Cause, terms: str) -> CauseView:
    return CauseView(
        name=effect_label(cause.name),
        aliases=", ".join(map(effect_label, cause.aliases)),
        values=tuple(
            ValueView(each.name, number(each.value), unit_label(each.unit), interval(each.low, each.high))
            for each in cause.values
        ),
        terms=terms,
        caveat=caveat_text(cause.caveat),
        gain=percentage(cause.gain),
        gain_interval=percentage_interval(cause.gain_low, cause.gain_high),
        channels=", ".join(map(channel_label, cause.channels)),
        z=number(round(cause.z, 1)),
    )


def _ambiguous(names: Sequence[str], diagnosis: Diagnosis) -> tuple[AmbiguousView, ...]:
    effects = {effect.name: effect for effect in LIBRARY}
    return tuple(
        AmbiguousView(
            effect_label(name),
            ", ".join(map(value_with_interval, diagnosis.ambiguous_values.get(name, ()))),
            "; ".join(
                [
                    effects[name].needs,
                    *(
                        f"{channel_label(channel)} distinguishes it from {effect_label(other)}"
                        for other, channel in effects[name].twins
                        if other in names
                    ),
                ]
            ),
        )
        for name in names
    )


def _next_drive(result: Explanation) -> NextDriveView | None:
    coming = result.diagnosis.next_drive
    if coming is None:
        return None
    slope = f", on a slope of {coming.grade_deg:g}°" if coming.grade_deg else ""
    drive = f"Scenario {coming.scenario}{slope}"
    return NextDriveView(drive, sentence(coming.reason), result.next_command or "")


def _gain(found: HeldOutGain) -> GainView | None:
    gain, nameless = found.gain, found.nameless
    if gain is None and nameless is None:
        return None
    learned = {} if nameless is None else nameless.channels
    text = "" if nameless is None else nameless.sentence
    if gain is None:
        rows = tuple(_learned_row(name, each) for name, each in learned.items())
        return GainView("", text, rows, "", len(found.judged), "")
    return GainView(
        gain_text(gain),
        text,
        tuple(_channel_gain(name, each, learned.get(name)) for name, each in gain.channels.items()),
        gain.clusters,
        len(gain.run_ids),
        ", ".join(run.run_id for run in gain.excluded),
    )


def _learned_row(name: str, each: Learned) -> ChannelGainView:
    label, unit = CHANNEL_WORDS[name]
    return ChannelGainView(label, unit, number(each.rms_before), "", "", "", "", percentage(each.ratio))


def _channel_gain(name: str, found: ChannelGain, learned: Learned | None) -> ChannelGainView:
    label, unit = CHANNEL_WORDS[name]
    reduction, remark = found.reduction, ""
    if reduction.refused:
        remark = "worse than before" if reduction.high < 0.0 else "no gain to claim"
    return ChannelGainView(
        label,
        unit,
        number(found.rms_before),
        number(found.rms_after),
        percentage(reduction.ratio),
        percentage_interval(reduction.low, reduction.high),
        remark,
        NOT_KNOWN if learned is None else percentage(learned.ratio),
    )


def _comparisons(comparisons: Mapping[str, Comparison | None]) -> list[ComparisonView]:
    """Return the comparisons that have errors, or a reason why they have none."""
    shown = []
    for kind, title in COMPARISON_TITLES.items():
        found = comparisons.get(kind)
        if found is None or not (found.errors or found.reason):
            continue
        errors = []
        for key, each in found.errors.items():
            label, unit = ERROR_LABELS[key]
            change = NOT_KNOWN if each.change_ci is None else interval(*each.change_ci)
            errors.append(ErrorView(label, unit, number(each.before), number(each.after), change))
        shown.append(ComparisonView(title.format(name=found.name), found.reason or "", tuple(errors)))
    return shown


def _limit(limit: Limit, missed: bool) -> Entry:
    return Entry(limit_text(limit, missed), limit.needs)


def _ruled_out(effect: RuledOut) -> RuledOutView:
    values = " and ".join(map(value_with_interval, effect.values))
    return RuledOutView(
        effect_label(effect.name), values, sentence(effect.reason), number(round(effect.z, 1))
    )


def _clock(clock: Clock) -> ClockView:
    return ClockView(clock.run_id, _milliseconds(clock.offset_s), _milliseconds(clock.std_s))


def _clocks_text(clocks: Sequence[Clock]) -> str:
    offsets = sorted(clock.offset_s for clock in clocks if math.isfinite(clock.offset_s))
    if not offsets:
        return f"Clocks of {len(clocks)} runs"
    low, middle, high = (_milliseconds(offsets[i]) for i in (0, len(offsets) // 2, -1))
    return (
        f"Clocks of {len(clocks)} runs: the IMU and camera are {middle} behind the wheels ({low} to {high})"
    )


def _milliseconds(time_s: float) -> str:
    text = number(round(1000.0 * time_s, 1))
    return text if text == NOT_KNOWN else f"{text}{NBSP}ms"


def _provenance(result: Explanation) -> list[Entry]:
    built_in = ", ".join(f"{name} {number(value)}" for name, value in result.built_in.items())
    entries = [
        Entry("data", f"{result.data} ({result.data_digest[:12]})"),
        Entry("description", result.description),
        Entry("effects built in already", built_in or "none"),
        Entry("terrain", terrain_text(result.terrains)),
        Entry("effects that may be named", f"{len(result.effects)}: {enumerated(result.effects)}"),
        Entry("runs behind the diagnosis", enumerated(result.used)),
    ]
    if result.held_out:
        held_out = f"{enumerated(result.held_out)}; drawn by the seed"
        entries.append(Entry("runs held out for the gain", held_out))
    entries.append(Entry("seed", str(result.seed)))
    if result.extended is not None:
        entries.append(Entry("extended description", str(result.extended.file)))
    packages = ", ".join(f"{name} {version}" for name, version in versions().items())
    return [*entries, Entry("versions", packages)]
