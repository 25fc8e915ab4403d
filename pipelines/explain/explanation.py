"""What an explanation answers, as JSON and as a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipelines.explain import figures
from pipelines.explain.against import against_parts, against_text
from pipelines.explain.statements import (
    Statement,
    effect_label,
    gain_text,
    in_words_of,
    percent_text,
    varying_text,
    would_have_shown,
)
from pipelines.report.numbers import enumerated, format_value, sentence
from pipelines.report.results import Result, as_json, described
from pipelines.report.tree import Column, Pairs, Part, Report, Section, Table, Text
from pipelines.report.versions import versions
from terrain.discrepancy.against import Against
from terrain.discrepancy.compared import CHANNEL_WORDS, ComparedRun, example_stretch, off_by, telling_runs
from terrain.discrepancy.diagnosed_runs import DiagnosedRuns, HeldOutGain
from terrain.discrepancy.powertrain import Powertrain
from terrain.discrepancy.robot_terms import (
    in_robot_terms,
    limit_text,
    value_in_robot_terms,
    values_with_intervals,
)
from terrain.discrepancy.runs import measured_channels
from terrain.discrepancy.verdict import Cause, ChannelVerdict, Diagnosis, Tier, Value
from terrain.effects import GYRO, HEADING, PARAMETER, effect_named
from terrain.learned_term import LearnedTerm
from terrain.robots import Robot

ERROR_LABELS = {
    "speed_mps": ("speed, root mean square", "m/s"),
    "yaw_rate_radps": ("yaw rate, root mean square", "rad/s"),
    "slip_ratio": ("mean slip of a run, off by", ""),
    "accuracy": ("accuracy", ""),
}
"""What an error of a filter or a classifier is called, and its unit."""

Z, PERCENT = ".1f", ".1%"
"""Formats of evidence in standard deviations, and of ratios of squares, wherever one stands."""

WHY, NEEDS = Column("why", long=True), Column("driving that shows it", long=True)


class ExplainResult(Result, eq=False):
    """What the simulation of a robot gets wrong about runs, and what building that in gains.

    In JSON the fields of the diagnosis stand beside the others.  ``robot`` is that which was tested, ``extended``
    the same with what was named and learned built in, if anything; ``n_pictures`` runs are drawn at the most, None
    for all.
    """

    robot: Robot
    diagnosed: DiagnosedRuns
    extended: Robot
    data: str = described("name of the data set")
    data_digest: str = described("digest of its runs")
    description: str = described("description of the robot as it was tested")
    terrain: str | None = described("label of the runs that were used; null for all")
    effects: tuple[str, ...] = described("effects that may be named")
    seed: int = described("of the choice of held-out runs and of the bootstrap")
    gain: HeldOutGain = described("on the runs held out")
    statements: tuple[Statement, ...] = described("a sentence for each channel")
    terms: Mapping[str, str] = described("by cause, its value in quantities of the robot's description")
    notes: tuple[str, ...] = described("what a reader has to know of the terrains and sessions")
    next_command: str | None = described("simulates the next drive; null where none is suggested")
    powertrain: Powertrain | None = described("from commanded to measured wheel speeds, where logged")
    against: Against | None = described("what changed to another set of runs", default=None)
    against_data: str = described("name of that data set", default="")
    model: str | None = described("extended description tested; null for the robot's own", default=None)
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read", default=())
    page: Path | None = described("page that was written", default=None)
    extended_file: Path | None = None
    n_pictures: int | None = 6

    @property
    def diagnosis(self) -> Diagnosis:
        """What the simulation gets wrong, with its evidence."""
        return self.diagnosed.diagnosis

    @property
    def is_extended(self) -> bool:
        """Whether anything that was named or learned is built in."""
        built_in = self.diagnosis.built_in or self.diagnosis.latest
        return bool(built_in) or self.extended.learned != self.robot.learned

    def as_json(self) -> dict[str, Any]:
        """Return the described fields, those of the diagnosis, and what the runs were used for."""
        runs, terms = self.diagnosed, self.extended.learned
        learned = [{"channel": term.channel, "says": term.says} for term in terms]
        extended = {"file": self.extended_file, "effects": self.extended.effects, "learned": learned}
        beside = {
            **as_json(self.diagnosis),
            "built_in": runs.simulation.effects,
            "terrain_matches": runs.terrains,
            "used": [run.run_id for run in runs.used],
            "held_out": [run.run_id for run in runs.held_out],
            "extended": extended if self.is_extended else None,
            "learned": runs.learned_gains,
        }
        return {**as_json(beside), **super().as_json()}

    def records(self) -> Iterable[Any]:
        """Return the parameters of what is built in."""
        return (
            {
                "cause": cause.name,
                **value._asdict(),
                "tier": cause.tier,
                "gain": cause.held_out_gain,
                "z": cause.z,
            }
            for cause in self.diagnosis.built_in
            for value in cause.parameters
        )


def report(result: ExplainResult) -> Report:
    """Return what the simulation gets wrong and the gain, then the causes, then all that they rest on."""
    diagnosis, runs = result.diagnosis, result.diagnosed
    held_out = f"{len(runs.held_out)} more held out to check them" if runs.held_out else ""
    lead = f"{diagnosis.n_runs} runs to find causes", held_out, result.data, result.terrain
    picture = None
    if shown := runs.whole or runs.compared:
        stretch = example_stretch(shown, runs.noise)
        there = measured_channels([stretch])
        of = [each.channel for each in channels_that_matter(result) if each.channel in there]
        picture = figures.run_figure(stretch, runs.deviation, (of or there)[:1])
    answer = answer_of(result)
    if result.against is not None:
        answer = f"{against_text(result.against, result.against_data or 'the other runs')} {answer}"
    written = Report(
        title=f"What the simulation of {diagnosis.robot} gets wrong",
        answer=answer,
        picture=picture,
        parts=[five_questions(result), *_decisive_parts(result)],
        details=[section for section in _details(result) if section.parts],
        lead=" · ".join(filter(None, lead)),
    )
    worded: Report = in_words_of(result.robot.drive, written)
    return replace(worded, next_step=result.next_command or "")


# -- The first screen: one sentence, and the five questions that a reader comes with ------------------------

BY = ", by the "
BY_SENSOR = {GYRO: "gyro", HEADING: "poses"}  #: That measure the same motion

STATED = 3  #: Channels, causes or candidates that an answer lists
LEARNED = 2  #: Learned terms that it lists
OPEN = (Tier.CANDIDATE, Tier.UNEXPLAINED)  #: Tiers of channels without a known cause


def channels_that_matter(result: ExplainResult) -> list[ChannelVerdict]:
    """Return the channels in which something is off, that of which most can be removed first."""
    off = [of for of in result.diagnosis.channels if of.tier is not None and of.tier is not Tier.NOT_SHOWN]
    before = result.diagnosis.residual_before

    def removed(of: ChannelVerdict) -> float:
        """Return the square that is or can be removed, over that of the noise."""
        part = max([x for x in (of.gain, of.learner_gain, 0.0) if math.isfinite(x)])
        noise = before[of.channel].noise if of.channel in before else math.nan
        return part * (of.rms_before / noise) ** 2 if noise > 0.0 else part

    return sorted(off, key=lambda of: (of.tier not in (Tier.NAMED, Tier.SET), -removed(of)))


def answer_of(result: ExplainResult) -> str:
    """Return what is wrong and what that is worth, in one sentence in the words of who built the robot."""
    robot, channels = result.diagnosis.robot, channels_that_matter(result)
    learned = [gain for gain in result.diagnosed.learned_gains if gain.reduction > gain.named_reduction]
    if not channels and learned:
        says, removes = learned[0].says, percent_text(learned[0].reduction)
        of = f"the squared error of the {CHANNEL_WORDS[learned[0].channel][0]}"
        return f"No known cause fits what {robot} does here: {says}; a learned term of it removes {removes} of {of}."
    if not channels and result.diagnosis.not_shown:
        return f"These runs confirm nothing that the simulation of {robot} gets wrong, and could not show all of it."
    if not channels:
        return f"These runs show nothing that the simulation of {robot} gets wrong."
    first = channels[0]
    name, unit = CHANNEL_WORDS[first.channel]
    what = _off(result, first)
    causes = [cause for cause in result.diagnosis.built_in if cause.name in first.causes]
    if not causes or not first.gain > 0.0:
        terms_of = [
            term.says for term in result.diagnosed.with_terms.learned if term.channel == first.channel
        ]
        instead = f"; learned instead: {enumerated(terms_of)}" if terms_of else ""
        learner = f"a learner without names removes {percent_text(first.learner_gain)} of its square"
        return f"{_capital(what)}, and no cause could be named for it{instead}; {learner}."
    terms = enumerated([_terms(cause, result) for cause in causes[:STATED]])
    one_of = " (or what looks the same)" if any(cause.tier is Tier.SET for cause in causes) else ""
    how = result.gain.gain.how
    falls = f"the rms error of its {name} falls from {first.rms_before:.2g} to {first.rms_after:.2g} {unit}"
    return f"{_capital(what)}: with {terms}{one_of} {falls}, judged on {how}."


def five_questions(result: ExplainResult) -> Pairs:
    """Return what is wrong, why, how certain that is, what it gains, and what to do next."""
    diagnosis, channels = result.diagnosis, channels_that_matter(result)
    sensors: dict[str, list[str]] = {}  # of one error, which sensors show it
    for of in channels[:STATED]:
        what, _, sensor = _off(result, of).partition(BY)
        sensors[what] = [*sensors.get(what, ()), *filter(None, [sensor])]
    wrong = [f"{what}{f'{BY}{enumerated(by)}' if by else ''}" for what, by in sensors.items()]
    if more := [f"{CHANNEL_WORDS[of.channel][0]} ({_rms(of)})" for of in channels[STATED:]]:
        wrong.append(f"also off: {enumerated(more)}")
    rows = [
        ("What is wrong", _sentences(wrong) or "Nothing that these runs show."),
        ("Why", _why(result)),
        ("How certain", _how_certain(result)),
        ("What it gains", _gains(result)),
        ("What next", next_text(result)),
    ]
    faults = [fault.sentence for fault in diagnosis.faults]
    return Pairs([("Faults of the logs", "; ".join(faults)), *rows] if faults else rows)


def _gains(result: ExplainResult) -> str:
    """Return what the extension removes: with names, with what is learned beside them, and in the first channel."""
    names, whole, parts = result.gain.gain, result.diagnosed.whole_gain, []
    for first in channels_that_matter(result)[:1]:
        if first.gain > 0.0 and len(result.diagnosis.channels) > 1:
            interval = f"{percent_text(first.gain_ci[0], '')} to {percent_text(first.gain_ci[1])}"
            of = f"the squared error of the {CHANNEL_WORDS[first.channel][0]}"
            parts.append(f"what is built in removes {percent_text(first.gain)} ({interval}) of {of}")
    if math.isfinite(names.reduction):
        refused = ", which may be nothing" if names.refused else ""
        interval = f"{percent_text(names.ci[0], '')} to {percent_text(names.ci[1])}"
        parts.append(
            f"over all channels named causes remove {percent_text(names.reduction)} ({interval}){refused}"
        )
    if whole.reduction > (names.reduction if math.isfinite(names.reduction) else 0.0):
        beside = "with the learned terms" if math.isfinite(names.reduction) else "learned terms remove"
        parts.append(f"{beside} {percent_text(whole.reduction)}")
    low, high = percent_text(names.learner_ci[0], ""), percent_text(names.learner_ci[1])
    parts.append(
        f"a black-box learner would remove {percent_text(names.learner_reduction)} ({low} to {high})"
    )
    return f"Against the simulation as it is, on {names.how}: {'; '.join(parts)}."


def _why(result: ExplainResult) -> str:
    """Return what is named, what is one of several, what is learned without a name, and what has no name."""
    diagnosis, parts = result.diagnosis, []
    if diagnosis.causes:
        parts.append(enumerated([_terms(cause, result) for cause in diagnosis.causes]))
    for names in diagnosis.ambiguous_sets:
        members = enumerated([effect_label(name) for name in names], "or")
        built = [cause for cause in diagnosis.of_sets if cause.name in names]
        as_one = f" (built in as {_terms(built[0], result)})" if built else ""
        parts.append(f"one of {members}{as_one}")
    parts += [varying_text(effect, result.robot).removesuffix(".") for effect in diagnosis.varying]
    if terms := _learned_terms(result)[0]:
        more = [f"{n} more below"] if (n := len(terms) - LEARNED) > 0 else []
        parts.append(
            f"without a known cause, learned: {enumerated([*[t.says for t in terms[:LEARNED]], *more])}"
        )
    unexplained = [CHANNEL_WORDS[of.channel][0] for of in channels_that_matter(result) if of.tier in OPEN]
    if unexplained:
        parts.append(f"no known cause for {enumerated(unexplained)}")
    return _sentences(parts) or "Nothing is to be explained."


def _clear(cause: Cause) -> Sequence[Value]:
    """Return the values of a cause whose interval is clear of 0, or all where none is."""
    return [value for value in cause.parameters if value.low * value.high > 0.0] or cause.parameters


def _learned_terms(result: ExplainResult) -> tuple[list[LearnedTerm], list[LearnedTerm]]:
    """Return the learned terms that are built in, and apart those that are no better on the runs held out."""
    no_better = {
        each.channel for each in result.diagnosed.learned_gains if each.reduction <= each.named_reduction
    }
    terms = result.diagnosed.with_terms.learned
    return [t for t in terms if t.channel not in no_better], [t for t in terms if t.channel in no_better]


def _how_certain(result: ExplainResult) -> str:
    """Return the intervals of what is built in, the candidates, and what these drives could not have shown."""
    diagnosis, parts = result.diagnosis, []
    for tier, words in (
        (Tier.NAMED, "confirmed on runs left out of the fit"),
        (Tier.SET, "confirmed as one of a set"),
    ):
        values = [
            f"{effect_label(cause.name)} "
            + enumerated([value_in_robot_terms(*v[:2], *v[3:], result.robot) for v in _clear(cause)])
            for cause in diagnosis.built_in
            if cause.tier is tier
        ]
        if values:
            parts.append(f"{words}, with 95 % intervals: {enumerated(values)}")
    if diagnosis.candidates:
        shown = enumerated([effect_label(each.name) for each in diagnosis.candidates[:STATED]])
        more = f" and {n} more" if (n := len(diagnosis.candidates) - STATED) > 0 else ""
        parts.append(f"not confirmed, and not built in: {shown}{more}")
    if no_better := _learned_terms(result)[1]:
        names = enumerated([CHANNEL_WORDS[term.channel][0] for term in no_better])
        parts.append(f"no better on held-out runs: what was learned of {names}")
    if n := len(diagnosis.not_shown):
        of = len(diagnosis.detection_limits)
        parts.append(f"these drives cannot test {n} of {of} parameters, which may be wrong all the same")
    return _sentences(parts) or "These drives would have shown any error of a tenth of its range."


def next_text(result: ExplainResult) -> str:
    """Return what to do next: drive an experiment, use what was found, or neither."""
    diagnosis, steps = result.diagnosis, []
    if diagnosis.built_in:
        steps.append("simulate and estimate with extended.yaml in place of the robot's file")
    if coming := diagnosis.next_drive:
        where = f"facing up a slope of {coming.grade_deg:g}°" if coming.grade_deg else "on the level"
        steps.append(
            f"drive next_drive.csv ({coming.duration_s:.0f} s of speeds and yaw rates, {where}, on a field of "
            f"{coming.length_m:.0f} by {coming.width_m:.0f} m): {coming.reason}"
        )
    return _sentences(steps) or "Nothing is open that a drive of this robot would show."


def _off(result: ExplainResult, of: ChannelVerdict) -> str:
    """Return by how much a channel is off, in words of the motion where a factor or a level says it."""
    for statement in result.statements:
        if statement.channel == of.channel:
            ratio, level = statement.measured_over_simulated, statement.measured_minus_simulated
            if math.isfinite(ratio) or math.isfinite(level):
                text = off_by(of.channel, ratio, level)
                if of.channel in BY_SENSOR:
                    return f"{text}{BY}{BY_SENSOR[of.channel]}"
                return text.replace("simulated, it is", f"the simulated {CHANNEL_WORDS[of.channel][0]} is")
    return f"the simulated {CHANNEL_WORDS[of.channel][0]} is off by {_rms(of)}"


def _rms(of: ChannelVerdict) -> str:
    return f"{of.rms_before:.2g} {CHANNEL_WORDS[of.channel][1]} rms"


def _terms(cause: Cause, result: ExplainResult) -> str:
    return in_robot_terms(cause.name, cause.parameters, result.robot)


def _sentences(parts: Sequence[str]) -> str:
    return " ".join([f"{_capital(part).removesuffix('.')}." for part in parts])


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


# -- What it rests on --------------------------------------------------------------------------------------


def _ids(runs: Iterable[Any]) -> str:
    return enumerated([run.run_id for run in runs])


def _decisive_parts(result: ExplainResult) -> Iterator[Part]:
    """Yield what a user decides by: faults, causes with intervals, rivals, and what was not detectable."""
    diagnosis = result.diagnosis
    if diagnosis.excluded_runs:
        yield Text(f"Runs that were excluded as unfit: {_ids(diagnosis.excluded_runs)}.", "warning")
    causes: list[tuple[Any, ...]] = []
    notes = [
        "The squared error removed is that of the channels where the cause acts, on runs left out of the fit."
    ]
    for cause in diagnosis.built_in:
        label = effect_label(cause.name)
        beside = cause.held_out_gain, cause.z, result.terms.get(cause.name, "")
        for value in cause.parameters:
            of = f"{label} ({PARAMETER[value.name].label})" if len(cause.parameters) > 1 else label
            at = value_in_robot_terms(value.name, value.value, value.low, value.high, result.robot)
            causes.append((of, at, *beside))
        if cause.aliases:
            notes.append(
                f"No log distinguishes {label} from {enumerated([*map(effect_label, cause.aliases)])}."
            )
        if cause.caveat and all(each.name != cause.name for each in diagnosis.varying):
            notes.append(f"{label}: {cause.caveat}.")
    if causes:
        gain, terms = Column("squared error removed", PERCENT), Column("the robot has", long=True)
        heads = ("cause", "value (95 %)", gain, Column("evidence, z", Z), terms)
        yield Table(heads, causes, note=" ".join(notes))
    for names in diagnosis.ambiguous_sets:
        yield _rivals(names, diagnosis)
    yield from _learned_parts(result.diagnosed)
    if (before := result.gain.built_in_before) is not None:
        yield Text(f"What the description has already: {gain_text(before)}")
    for note in result.notes:
        yield Text(note, "note")
    for skipped in result.skipped:
        yield Text(skipped, "warning")
    if result.extended_file is not None:
        yield Pairs([("extended robot", str(result.extended_file))])


def _learned_parts(diagnosed: DiagnosedRuns) -> Iterator[Part]:
    """Yield what acts without a name, with its gain on the runs held out, or in cross-validation without any."""
    judged = {gain.channel: gain for gain in diagnosed.learned_gains}
    rows: list[tuple[Any, ...]] = []
    for channel, each in diagnosed.learned.items():
        if each.term is None:
            continue
        cells: tuple[Any, ...] = (None, None, each.inner_gain, each.reference_gain, "cross-validated")
        if (gain := judged.get(channel)) is not None:
            remark = "" if gain.reduction > gain.named_reduction else "no better on held-out runs"
            cells = gain.named_reduction, gain.ci, gain.reduction, gain.learner_reduction, remark
        rows.append((CHANNEL_WORDS[channel][0], each.term.says, *cells))
    if rows:
        numbers = "square less by named causes", "the term adds, 95 %", "with the term", "by the learner"
        heads = Column("no known cause in", long=True), Column("a learned term", long=True)
        note = (
            "Sums of products of speed and turn, selected by cross-validation on what the names leave; "
            "outside the speeds and turns that were driven they are off."
        )
        yield Table((*heads, *[Column(name, PERCENT) for name in numbers], ""), rows, note=note)


def _rivals(names: Sequence[str], diagnosis: Diagnosis) -> Table:
    rows = []
    for name in names:
        effect = effect_named(name)
        needs = [effect.needs]
        for other, channel in effect.twins:
            if other in names:
                needs.append(f"{CHANNEL_WORDS[channel][0]} distinguishes it from {effect_label(other)}")
        values = values_with_intervals(diagnosis.ambiguous_values.get(name, ()), ", ")
        rows.append((effect_label(name), values, "; ".join(needs)))
    return Table(("one of", "its value, if it acts alone", NEEDS), rows)


def _gain_parts(diagnosis: Diagnosis, measured: HeldOutGain) -> Iterator[Part]:
    """Yield by channel what an extension and a black-box learner gain, and what it is for a filter or classifier."""
    rows: list[tuple[Any, ...]] = []
    for of in diagnosis.channels:
        built = of.gain, of.gain_ci
        tier = "agrees" if of.tier is None else of.tier.value.replace("_", " ")
        causes = enumerated([*map(effect_label, of.causes)])
        rms = of.rms_before, of.rms_after
        rows.append((*CHANNEL_WORDS[of.channel], tier, causes, *rms, *built, of.learner_gain, of.learner_ci))
    note = (
        f"Behind one low-pass, judged on {measured.gain.how}. Intervals: 95 %, over {measured.gain.clusters}. The "
        "learner is a Bayesian linear regression of the residual on the simulation's inputs, their products and "
        "rates; it is fitted to the same runs as the causes. The answer's gain is over all channels, each weighed "
        "by its noise."
    )
    if measured.gain.excluded_runs:
        note += f" Excluded as unfit: {_ids(measured.gain.excluded_runs)}."
    if rows:
        less, interval = Column("square less by", PERCENT), Column("95 %", PERCENT)
        heads = "channel", "unit", "verdict", "built in", "rms before", "after", less, interval
        yield Table((*heads, Column("by a learner", PERCENT), interval), rows, note=note)
    for kind, compared in measured.comparisons.items():
        if compared is not None and compared.reason:
            yield Text(f"What it changes for the {kind} {compared.name} is not measured: {compared.reason}.")
        elif compared is not None and compared.errors:
            changes = [(*ERROR_LABELS[key], *change) for key, change in compared.errors.items()]
            figures_of = ("figure", "unit", "before", "after", "change, 95 %")
            yield Table(figures_of, changes, f"What it changes for the {kind} {compared.name}")


def _open_parts(diagnosis: Diagnosis) -> Iterator[Part]:
    """Yield the candidates, what is left unexplained, and the effects that are ruled out."""
    rows: list[tuple[Any, ...]] = []
    for each in diagnosis.candidates:
        values = values_with_intervals(each.parameters)
        rows.append((effect_label(each.name), values, sentence(each.reason), each.z))
    if rows:
        note = "These reduce the residual, and something speaks against each as its cause."
        yield Table(("candidate", "value it would have", WHY, Column("z", Z)), rows, note=note)
    rows = [(effect_label(each.name), sentence(each.reason), each.z) for each in would_have_shown(diagnosis)]
    if rows:
        note = "These runs would have shown them."
        yield Table(("ruled out", WHY, Column("z", Z)), rows, note=note)
    if diagnosis.unexplained:
        alike = {
            each.name: f"resembles {effect_label(each.name)}, a candidate" for each in diagnosis.candidates
        }
        unexplained = []
        for left in diagnosis.unexplained:
            what = alike.get(left.input, f"depends on {left.input}")
            unexplained.append((CHANNEL_WORDS[left.channel][0], what, left.z, left.residual_ratio or None))
        note = (
            "Beside all causes the residual of the channel depends on the input, and no effect of the library "
            "explains it. The input is the clearest of some thirty that were tried."
        )
        part = Column("part of its squared residual", PERCENT)
        yield Table(("unexplained", "its residual", Column("z", Z), part), unexplained, note=note)


def _details(result: ExplainResult) -> Iterator[Section]:
    """Yield all that the answer rests on; sections may be empty."""
    diagnosis, runs = result.diagnosis, result.diagnosed
    if result.against is not None:
        name = result.against_data or "the other runs"
        yield Section(f"What changed to {name}", [*against_parts(result.against, name, result.robot)])
    statements = [tuple(each.text.split(": ", 1)) for each in result.statements]
    yield Section("Channel by channel", [Pairs(statements)])
    yield Section("Verdict and gain, channel by channel", [*_gain_parts(diagnosis, result.gain)])
    yield Section("Candidates, and what is unexplained", [*_open_parts(diagnosis)])
    if (powertrain := result.powertrain) is not None:
        given = (
            "The simulation is given the measured wheel speeds, so that this is no part of the residuals. "
            "Intervals hold 95 % over runs."
        )
        stated = [*map(Text, powertrain.sentences), Text(given, "note")]
        yield Section("From commanded to measured wheel speeds", stated)
    yield Section("What the residuals depend on", [*_dependence_parts(runs)])
    whole: Sequence[ComparedRun] = [*runs.compared, *(runs.whole if runs.held_out else ())]
    if result.n_pictures is not None:
        whole = telling_runs(whole, runs.noise, result.n_pictures)
    drawn = [figures.run_figure(run, runs.deviation, measured_channels([run])) for run in whole]
    yield Section("Whole runs", drawn)
    limits = []
    for limit in diagnosis.detection_limits:
        missed = limit in diagnosis.not_shown
        limits.append((limit_text(limit, missed), not missed, limit.needs))
    meaning = "Not detected does not mean absent: at its limit an effect is found nine times in ten."
    heads = Column("detection limit", long=True), "shown by these drives", NEEDS
    yield Section("What would not have been detected", [Table(heads, limits, note=meaning)])
    health: list[Part] = []
    if diagnosis.excluded_runs:
        health.append(Table(("excluded run", WHY), diagnosis.excluded_runs))
    if diagnosis.clocks:
        late = Column("other sensors behind the wheels", ".4f", "s", of="offset_s")
        std = Column("standard deviation", ".4f", "s", of="std_s")
        health.append(Table((Column("clock of the run", of="run_id"), late, std), diagnosis.clocks))
    yield Section("Health of the logs", health)
    built_in = [f"{name} {format_value(value)}" for name, value in runs.simulation.effects.items()]
    provenance: list[tuple[Any, ...]] = [
        ("data", f"{result.data} ({result.data_digest[:12]})"),
        ("description", result.description),
        ("effects built in already", ", ".join(built_in) or "none"),
        ("terrain", "; ".join([match.text for match in runs.terrains])),
        ("effects that may be named", f"{len(result.effects)}: {enumerated(result.effects)}"),
        ("runs behind the diagnosis", _ids(runs.used)),
        ("runs held out, drawn by the seed", _ids(runs.held_out) or "none"),
        ("seed", result.seed),
        ("versions", versions()),
    ]
    yield Section("Where these numbers come from", [Pairs(provenance)])


def _dependence_parts(runs: DiagnosedRuns) -> Iterator[Part]:
    """Yield by session, by parts of the data, by input and by frequency how far the two are apart."""
    diagnosis, compared = runs.diagnosis, runs.compared
    rows = []
    for value in diagnosis.by_session:
        alike = "" if len(value.sessions) < 2 else "agree" if value.agree else "differ"
        for i, own in enumerate(value.sessions):
            first = ("", "") if i else (PARAMETER[value.name].label, value.terrain)
            rows.append((*first, own.session, str(own.runs), own.text, "" if i else alike))
    if rows:
        note = (
            "The causes named of all runs together, fitted to the runs of each session alone. Intervals "
            "include the scatter between its runs. Sessions of a terrain agree where Welch's test of equal "
            "means does not reject that at 1 %."
        )
        heads = ("value", "terrain", "session", "runs", "95 % interval", "sessions of the terrain")
        yield Table(heads, rows, "By session", note)
    if runs.parts:
        yield figures.parts_figure(runs.parts)
    residuals = []
    for name, before in diagnosis.residual_before.items():
        after = diagnosis.residual_after[name]
        residuals.append((*CHANNEL_WORDS[name], *before, after.rms, after.systematic))
    systematic = Column("systematic", PERCENT, shade=True)
    yield Table(
        ("channel", "unit", "rms", "noise", systematic, "rms with the causes", systematic),
        residuals,
        "How much of it is systematic",
        "The part of the squared residual that is not noise. Noise is what is left when every effect of the "
        "library is freed, and levels and what depends on speed and turn are taken off. Differences from run "
        "to run, as of the tyre pressure, count as systematic.",
    )
    if compared:
        strongest, every = figures.dependence_figures(compared, runs.noise)
        yield strongest
        yield figures.spectra_figure(compared, runs.noise, runs.low_pass.cutoff_hz)
        yield Section("Every input", every)
