"""What the page of a diagnosis shows, section by section, as texts that its templates only lay out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pipelines.explain.results import Explanation
from pipelines.explain.wording import (
    CHANNEL_WORDS,
    channel_label,
    effect_label,
    enumerated,
    gain_text,
    interval,
    limit_text,
    number,
    percentage,
    percentage_interval,
    terrain_text,
    unit_label,
    value_with_interval,
    verdict_text,
)
from pipelines.reporting.numbers import NBSP, NOT_KNOWN, sentence
from pipelines.reporting.pictures import Image
from pipelines.reporting.versions import versions
from terrain.discrepancy.filter_gain import Comparison
from terrain.discrepancy.gain import ChannelGain, Gain
from terrain.discrepancy.health.runs import Clock
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


class FigureView(NamedTuple):
    """A figure with its heading."""

    heading: str
    image: Image


class RunPicture(NamedTuple):
    """Figure of a whole run: title, file beside the page, and the image if the page holds it."""

    title: str
    file: str
    image: Image | None


class VerdictView(NamedTuple):
    """Verdict, gain and warnings, a sentence each."""

    verdict: str
    gain: str
    warnings: tuple[str, ...]


class ValueView(NamedTuple):
    """A parameter with its value."""

    name: str
    value: str
    unit: str
    interval: str


class CauseView(NamedTuple):
    """A cause with its parameters."""

    name: str
    aliases: str
    values: tuple[ValueView, ...]
    gain: str
    gain_interval: str
    channels: str
    z: str


class AmbiguousView(NamedTuple):
    """An effect of an ambiguous set: its values, and the driving that would show it."""

    name: str
    values: str
    needs: str


class NextDriveView(NamedTuple):
    """The next drive, and why it is suggested."""

    drive: str
    reason: str


class UnexplainedView(NamedTuple):
    """A channel whose residual depends on an input."""

    channel: str
    input: str
    z: str
    ratio: str


class ChannelGainView(NamedTuple):
    """Residuals of a channel before and after."""

    channel: str
    unit: str
    rms_before: str
    rms_after: str
    white_before: str
    white_after: str
    reduction: str
    interval: str
    remark: str


class GainView(NamedTuple):
    """The gain of all channels, and of each."""

    text: str
    channels: tuple[ChannelGainView, ...]
    clusters: str
    runs: str
    excluded: str


class ErrorView(NamedTuple):
    """An error of a filter or a classifier before and after."""

    name: str
    unit: str
    before: str
    after: str
    change: str


class ComparisonView(NamedTuple):
    """Errors of a filter or a classifier, or why there are none."""

    title: str
    reason: str
    errors: tuple[ErrorView, ...]


class LimitView(NamedTuple):
    """A detection limit, and the driving that shows the effect."""

    text: str
    needs: str


class RuledOutView(NamedTuple):
    """An effect that is not the answer."""

    name: str
    reason: str
    z: str


class ClockView(NamedTuple):
    """The clock of a run."""

    run: str
    offset: str
    std: str


class Entry(NamedTuple):
    """A name with a text."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class PageView:
    """What the page shows; a section without content is left out.

    Parameters
    ----------
    heading, lead : of the page
    verdict, figures, runs, causes, ambiguous, next_drive, unexplained : sections in their order
    gain : None where it was not measured, for ``gain_reason``
    comparisons : of the filter and the classifier
    missed, limits : detection limits of effects that the runs did not excite, and of all others
    ruled_out, excluded, clocks, provenance : sections in their order
    """

    heading: str
    lead: str
    verdict: VerdictView
    figures: tuple[FigureView, ...]
    runs: tuple[RunPicture, ...]
    causes: tuple[CauseView, ...]
    ambiguous: tuple[tuple[AmbiguousView, ...], ...]
    next_drive: NextDriveView | None
    unexplained: tuple[UnexplainedView, ...]
    gain: GainView | None
    gain_reason: str
    comparisons: tuple[ComparisonView, ...]
    missed: tuple[LimitView, ...]
    limits: tuple[LimitView, ...]
    ruled_out: tuple[RuledOutView, ...]
    excluded: tuple[Entry, ...]
    clocks: tuple[ClockView, ...]
    provenance: tuple[Entry, ...]


def page_view(result: Explanation, figures: Sequence[FigureView], runs: Sequence[RunPicture]) -> PageView:
    """Return what the page of a result shows."""
    diagnosis, gain = result.diagnosis, result.gain
    missed = {limit.name for limit in diagnosis.not_excited}
    return PageView(
        heading=f"What the simulation of {diagnosis.robot} gets wrong",
        lead=_lead(result),
        verdict=_verdict(result),
        figures=tuple(figures),
        runs=tuple(runs),
        causes=tuple(map(_cause, diagnosis.causes)),
        ambiguous=tuple(_ambiguous(names, diagnosis) for names in diagnosis.ambiguous_sets),
        next_drive=_next_drive(diagnosis),
        unexplained=tuple(
            UnexplainedView(
                channel_label(left.channel),
                left.input,
                number(round(left.z, 1)),
                percentage(left.ratio) if left.ratio else NOT_KNOWN,
            )
            for left in diagnosis.unexplained
        ),
        gain=None if gain.gain is None else _gain(gain.gain),
        gain_reason=gain.reason or "",
        comparisons=() if gain.gain is None else tuple(_comparisons(gain.comparisons)),
        missed=tuple(_limit(limit, True) for limit in diagnosis.limits if limit.name in missed),
        limits=tuple(_limit(limit, False) for limit in diagnosis.limits if limit.name not in missed),
        ruled_out=tuple(map(_ruled_out, diagnosis.ruled_out)),
        excluded=tuple(Entry(run.run_id, run.reason) for run in diagnosis.excluded_runs),
        clocks=tuple(map(_clock, diagnosis.clocks)),
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


def _cause(cause: Cause) -> CauseView:
    return CauseView(
        name=effect_label(cause.name),
        aliases=", ".join(map(effect_label, cause.aliases)),
        values=tuple(
            ValueView(each.name, number(each.value), unit_label(each.unit), interval(each.low, each.high))
            for each in cause.values
        ),
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


def _next_drive(diagnosis: Diagnosis) -> NextDriveView | None:
    coming = diagnosis.next_drive
    if coming is None:
        return None
    return NextDriveView(f"scenario {coming.scenario}, grade deg {coming.grade_deg}", sentence(coming.reason))


def _gain(gain: Gain) -> GainView:
    return GainView(
        gain_text(gain),
        tuple(_channel_gain(name, found) for name, found in gain.channels.items()),
        gain.clusters,
        ", ".join(gain.run_ids),
        ", ".join(run.run_id for run in gain.excluded),
    )


def _channel_gain(name: str, found: ChannelGain) -> ChannelGainView:
    label, unit = CHANNEL_WORDS[name]
    reduction, remark = found.reduction, ""
    if reduction.refused:
        remark = "worse than before" if reduction.high < 0.0 else "no gain to claim"
    return ChannelGainView(
        label,
        unit,
        number(found.rms_before),
        number(found.rms_after),
        number(found.white_before),
        number(found.white_after),
        percentage(reduction.ratio),
        percentage_interval(reduction.low, reduction.high),
        remark,
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


def _limit(limit: Limit, missed: bool) -> LimitView:
    return LimitView(limit_text(limit, missed), limit.needs)


def _ruled_out(effect: RuledOut) -> RuledOutView:
    values = " and ".join(map(value_with_interval, effect.values))
    reason = f"{effect.reason}; it would be {values}" if values else effect.reason
    return RuledOutView(effect_label(effect.name), reason, number(round(effect.z, 1)))


def _clock(clock: Clock) -> ClockView:
    return ClockView(clock.run_id, _milliseconds(clock.offset_s), _milliseconds(clock.std_s))


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
