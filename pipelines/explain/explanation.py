"""What an explanation answers, as JSON and as a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.explain import figures
from pipelines.report.json_file import as_json
from pipelines.report.numbers import enumerated, format_value, sentence
from pipelines.report.results import Result, described
from pipelines.report.tree import Column, Pairs, Part, Report, Section, Table, Text
from pipelines.report.versions import versions
from terrain.discrepancy.channel_words import CHANNEL_WORDS
from terrain.discrepancy.compared import ComparedRun, channels_of, example_stretch, telling_runs
from terrain.discrepancy.diagnosed_runs import DiagnosedRuns, HeldOutGain
from terrain.discrepancy.powertrain_answer import PowertrainAnswer
from terrain.discrepancy.robot_terms import quantity
from terrain.discrepancy.sentences import (
    channel_label,
    effect_label,
    gain_text,
    in_words_of,
    limit_text,
    quantity_interval,
    value_with_interval,
    varying_text,
    verdict_text,
)
from terrain.discrepancy.statements import SESSION_COLUMNS, Statement, session_rows, split_ruled_out
from terrain.discrepancy.verdict import Diagnosis, Value
from terrain.effects import effect_named
from terrain.robots import Robot

if TYPE_CHECKING:
    import pandas as pd

PICTURED = STATED = 3
"""Channels of the first picture, and of the sentences beside the answer: those of which most is stated."""

COMPARISON_TITLES = {"filter": "Error of the filter {name}", "classifier": "Classifier {name}"}
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


@dataclass(frozen=True, eq=False, repr=False)
class ExplainResult(Result):
    """What the simulation of a robot gets wrong about runs, and what building that in gains.

    In JSON the fields of the diagnosis stand beside the others.

    Parameters
    ----------
    robot : as it was tested
    diagnosed : runs with their diagnosis, beside the simulation
    extended : the robot with the causes built in; None where none was named
    extended_file : of the extended robot, if it was written
    n_pictures : most runs that are drawn; None for all
    """

    robot: Robot
    diagnosed: DiagnosedRuns
    extended: Robot | None
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
    powertrain: PowertrainAnswer | None = described("from commanded to measured wheel speeds, where logged")
    model: str | None = described(
        "extended description that was tested; null for the robot's own", default=None
    )
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read", default=())
    page: Path | None = described("page that was written", default=None)
    extended_file: Path | None = None
    n_pictures: int | None = 6

    @property
    def diagnosis(self) -> Diagnosis:
        """What the simulation gets wrong, with its evidence."""
        return self.diagnosed.diagnosis

    def as_json(self) -> dict[str, Any]:
        """Return the described fields, those of the diagnosis, and what the runs were used for."""
        runs, extended = self.diagnosed, self.extended
        beside = {
            **self.diagnosis.as_json(),
            "built_in": runs.simulation.effects,
            "terrain_matches": runs.terrains,
            "used": [run.run_id for run in runs.used],
            "held_out": [run.run_id for run in runs.held_out],
            "extended": extended and {"file": self.extended_file, "effects": extended.effects},
        }
        return {**super().as_json(), **as_json(beside)}

    def to_pandas(self) -> pd.DataFrame:
        """Return the parameters of the named causes, a row each."""
        import pandas as pd

        rows = [
            {"cause": cause.name, **value._asdict(), "held_out_gain": cause.gain, "z": cause.z}
            for cause in self.diagnosis.causes
            for value in cause.values  # noqa: PD011
        ]
        return pd.DataFrame(rows, columns=["cause", *Value._fields, "held_out_gain", "z"])


def report(result: ExplainResult) -> Report:
    """Return what the simulation gets wrong and the gain, then the causes, then all that they rest on."""
    diagnosis, runs = result.diagnosis, result.diagnosed
    held_out = f"{len(runs.held_out)} held out for the gain" if runs.held_out else ""
    lead = f"{diagnosis.n_runs} runs compared", held_out, result.data, result.terrain
    picture = None
    if shown := result.gain.judged or runs.compared:  # held-out runs where there are any
        stretch = example_stretch(shown, runs.noise)
        there = channels_of([stretch])
        stated = [each.channel for each in result.statements if each.channel in there and each.found]
        picture = figures.run_figure(stretch, runs.noise, (stated or there)[:PICTURED])
    written = Report(
        title=f"What the simulation of {diagnosis.robot} gets wrong",
        answer=f"{verdict_text(diagnosis)} {gain_text(result.gain.gain, result.gain.reason)}",
        picture=picture,
        parts=list(_decisive_parts(result)),
        details=[section for section in _details(result) if section.parts],
        lead=" · ".join(filter(None, lead)),
    )
    worded: Report = in_words_of(result.robot.drive, written)
    return replace(worded, next_step=result.next_command or "")


def _decisive_parts(result: ExplainResult) -> Iterator[Part]:
    """Yield what a user decides by: faults, causes with intervals, rivals, and what was not detectable."""
    diagnosis = result.diagnosis
    for fault in diagnosis.faults:
        yield Text(f"Fault of the logs, repaired before anything was compared: {fault.sentence}", "warning")
    if diagnosis.excluded_runs:
        excluded = ", ".join(run.run_id for run in diagnosis.excluded_runs)
        yield Text(f"Runs that were excluded as unfit: {excluded}.", "warning")
    for statement in [each for each in result.statements if each.found][:STATED]:
        yield Text(sentence(statement.text))
    if diagnosis.causes:
        yield _causes(result)
    for names in diagnosis.ambiguous_sets:
        yield _rivals(names, diagnosis)
    for each in diagnosis.varying:
        yield Text(varying_text(each))
    if result.gain.nameless is not None:
        yield Text(result.gain.nameless.sentence)
    if n := len(diagnosis.not_excited):
        of = len(diagnosis.limits)
        yield Text(f"Of {of} parameters that may be wrong, {n} could not have been detected.")
    for note in result.notes:
        yield Text(note, "note")
    for skipped in result.skipped:
        yield Text(skipped, "warning")
    if result.extended_file is not None:
        yield Pairs([("extended robot", str(result.extended_file))])


def _causes(result: ExplainResult) -> Table:
    rows: list[tuple[Any, ...]] = []
    notes = ["Values are added to what the description has already."]
    varying = [each.name for each in result.diagnosis.varying]
    for cause in result.diagnosis.causes:
        label = effect_label(cause.name)
        beside: tuple[Any, ...] = (cause.gain, cause.z, result.terms.get(cause.name, ""))
        for place, value in enumerate(cause.values):
            numbers = quantity(value.name, value.value), quantity_interval(value)
            rows.append(("", *numbers, None, None, "") if place else (label, *numbers, *beside))
        if cause.aliases:
            aliases = enumerated([effect_label(alias) for alias in cause.aliases])
            notes.append(f"No log distinguishes {label} from {aliases}.")
        if cause.caveat and cause.name not in varying:
            notes.append(f"{label}: {cause.caveat}.")
    gain, terms = Column("held-out gain", PERCENT), Column("the robot has", long=True)
    return Table(("cause", "value", "95 %", gain, Column("z", Z), terms), rows, note=" ".join(notes))


def _rivals(names: Sequence[str], diagnosis: Diagnosis) -> Table:
    rows = []
    for name in names:
        effect = effect_named(name)
        needs = [effect.needs]
        needs += [
            f"{channel_label(channel)} distinguishes it from {effect_label(other)}"
            for other, channel in effect.twins
            if other in names
        ]
        values = ", ".join(map(value_with_interval, diagnosis.ambiguous_values.get(name, ())))
        rows.append((effect_label(name), values, "; ".join(needs)))
    return Table(("one of", "its value, if it acts alone", NEEDS), rows)


def _gain_parts(found: HeldOutGain) -> Iterator[Part]:
    """Yield by channel what an extension and a black-box reference gain, and what it is for a filter or classifier."""
    gain, learned = found.gain, {} if found.nameless is None else found.nameless.channels
    if gain is None:
        if learned:
            columns = ("channel", "unit", "rms", Column("square less by a black-box reference", PERCENT))
            rows = [(*CHANNEL_WORDS[name], each.rms_before, each.ratio) for name, each in learned.items()]
            yield Table(columns, rows)
        return
    gains: list[tuple[Any, ...]] = []
    for name, own in gain.channels.items():
        ratio, low, high = own.reduction
        remark = "" if not own.reduction.refused else "worse" if high < 0.0 else "no gain to claim"
        sizes, black_box = (own.rms_before, own.rms_after), learned[name].ratio if name in learned else None
        gains.append((*CHANNEL_WORDS[name], *sizes, ratio, (low, high), remark, black_box))
    excluded = enumerated([run.run_id for run in gain.excluded])
    note = (
        f"Low-pass filtered. Intervals: 95 %, bootstrap over {gain.clusters}. The answer's gain is of all "
        "channels whitened, with differences from run to run removed. The black-box reference is a Bayesian "
        "linear regression of the residual on the simulation's inputs, their products and rates, fitted to "
        f"the runs behind the diagnosis and judged on the same {len(gain.run_ids)} held-out runs."
    )
    yield Table(
        (
            *("channel", "unit", "rms before", "after", Column("square less by", PERCENT)),
            *(Column("95 %", PERCENT), "", Column("by a black-box reference", PERCENT)),
        ),
        gains,
        note=f"{note} Excluded as unfit: {excluded}." if excluded else note,
    )
    for kind, words in COMPARISON_TITLES.items():
        if (compared := found.comparisons.get(kind)) is None:
            continue
        title = words.format(name=compared.name)
        if compared.reason:
            yield Text(f"{title}: not measured: {compared.reason}.")
        elif compared.errors:
            changes = [
                (*ERROR_LABELS[key], each.before, each.after, each.change_ci)
                for key, each in compared.errors.items()
            ]
            yield Table(("figure", "unit", "before", "after", "change, 95 %"), changes, title)


def _open_parts(diagnosis: Diagnosis) -> Iterator[Part]:
    """Yield the effects that were withdrawn, what is left unexplained, and the effects that are ruled out."""
    withdrawn, ruled_out = split_ruled_out(diagnosis)
    if withdrawn:
        rows: list[tuple[Any, ...]] = []
        for each in withdrawn:
            values = " and ".join(map(value_with_interval, each.values))
            rows.append((effect_label(each.name), values, sentence(each.reason), each.z))
        note = "These effects reduce the residual, and something speaks against each as its cause."
        yield Table(("withdrawn", "value it would have", WHY, Column("z", Z)), rows, note=note)
    if diagnosis.unexplained:
        alike = {each.name: f"resembles {effect_label(each.name)}, which was withdrawn" for each in withdrawn}
        unexplained = []
        for left in diagnosis.unexplained:
            how = alike.get(left.input, f"depends on {left.input}")
            unexplained.append((channel_label(left.channel), how, left.z, left.ratio or None))
        note = (
            "Beside all causes the residual of the channel depends on the input, and no effect of the library "
            "explains it. The input is the clearest of some thirty that were tried."
        )
        part = Column("part of its squared residual", PERCENT)
        yield Table(("unexplained", "its residual", Column("z", Z), part), unexplained, note=note)
    if ruled_out:
        excluded = [(effect_label(each.name), sentence(each.reason), each.z) for each in ruled_out]
        yield Table(("ruled out: these runs would have shown it", WHY, Column("z", Z)), excluded)


def _details(result: ExplainResult) -> Iterator[Section]:
    """Yield all that the answer rests on; sections may be empty."""
    diagnosis, runs = result.diagnosis, result.diagnosed
    statements = [tuple(each.text.split(": ", 1)) for each in result.statements]
    yield Section("Channel by channel", [Pairs(statements)])
    yield Section("Gain on held-out runs, channel by channel", list(_gain_parts(result.gain)))
    yield Section("What was withdrawn, and what is unexplained", list(_open_parts(diagnosis)))
    if (powertrain := result.powertrain) is not None:
        given = (
            "The simulation is given the measured wheel speeds, so that this is no part of the residuals. "
            "Intervals hold 95 % over runs."
        )
        stated = [*map(Text, powertrain.sentences), Text(given, "note")]
        yield Section("From commanded to measured wheel speeds", stated)
    if coming := diagnosis.next_drive:
        slope = f", on a slope of {coming.grade_deg:g}°" if coming.grade_deg else ""
        why = f"Scenario {coming.scenario}{slope}: {coming.reason}. In simulation first:"
        yield Section("What to drive next", [Text(why), Text(result.next_command or "", "code")])
    yield Section("What the residuals depend on", list(_dependence_parts(runs)))
    whole: Sequence[ComparedRun] = [*runs.compared, *result.gain.judged]
    if result.n_pictures is not None:
        whole = telling_runs(whole, runs.noise, result.n_pictures)
    drawn = [figures.run_figure(run, runs.noise, channels_of([run])) for run in whole]
    yield Section("Whole runs", drawn)
    missed = [limit.name for limit in diagnosis.not_excited]
    limits: list[Part] = []
    for is_missed, title in ((True, "not excited by the driving"), (False, "detection limit")):
        listed = [limit for limit in diagnosis.limits if (limit.name in missed) is is_missed]
        if listed:
            texts = [(limit_text(limit, is_missed), limit.needs) for limit in listed]
            limits.append(Table((Column(title, long=True), NEEDS), texts))
    meaning = "Not detected does not mean absent: at its limit an effect is found nine times in ten."
    yield Section("What would not have been detected", [*limits, Text(meaning, "note")])
    health: list[Part] = []
    if diagnosis.excluded_runs:
        health.append(Table(("excluded run", WHY), diagnosis.excluded_runs))
    if diagnosis.clocks:
        behind = Column("IMU and camera behind the wheels", ".1f", "ms")
        clocks = [(each.run_id, 1e3 * each.offset_s, 1e3 * each.std_s) for each in diagnosis.clocks]
        health.append(
            Table(("clock of the run", behind, behind._replace(title="standard deviation")), clocks)
        )
    yield Section("Health of the logs", health)
    built_in = [f"{name} {format_value(value)}" for name, value in runs.simulation.effects.items()]
    provenance: list[tuple[Any, ...]] = [
        ("data", f"{result.data} ({result.data_digest[:12]})"),
        ("description", result.description),
        ("effects built in already", ", ".join(built_in) or "none"),
        ("terrain", "; ".join([match.text for match in runs.terrains])),
        ("effects that may be named", f"{len(result.effects)}: {enumerated(result.effects)}"),
        ("runs behind the diagnosis", enumerated([run.run_id for run in runs.used])),
        ("runs held out, drawn by the seed", enumerated([run.run_id for run in runs.held_out]) or "none"),
        ("seed", result.seed),
        ("versions", versions()),
    ]
    yield Section("Where these numbers come from", [Pairs(provenance)])


def _dependence_parts(runs: DiagnosedRuns) -> Iterator[Part]:
    """Yield by session, by parts of the data, by input and by frequency how far the two are apart."""
    diagnosis, compared = runs.diagnosis, runs.compared
    if rows := session_rows(diagnosis):
        note = (
            "The causes named of all runs together, fitted to the runs of each session alone. Intervals "
            "include the scatter between its runs. Sessions of a terrain agree where Welch's test of equal "
            "means does not reject that at 1 %."
        )
        yield Table(SESSION_COLUMNS, rows, "By session", note)
    if runs.parts:
        yield figures.parts_figure(runs.parts)
    rows_of_residuals = [
        (*CHANNEL_WORDS[name], before.rms, before.noise, before.systematic, after.rms, after.systematic)
        for name, before in diagnosis.residual_before.items()
        for after in (diagnosis.residual_after[name],)
    ]
    systematic = Column("systematic", PERCENT, shade=True)
    yield Table(
        ("channel", "unit", "rms", "noise", systematic, "rms with the causes", systematic),
        rows_of_residuals,
        "How much of it is systematic",
        "The part of the squared residual that is not noise. Noise is what is left when every effect of the "
        "library is freed, and levels and what depends on speed and turn are taken off. Differences from run "
        "to run, as of the tyre pressure, count as systematic.",
    )
    if compared:
        channels = channels_of(compared)
        strongest, every = figures.dependence_figures(compared, runs.noise, channels)
        yield strongest
        yield figures.spectra_figure(compared, runs.noise, runs.low_pass.cutoff_hz, channels)
        yield Section("Every input", every)
