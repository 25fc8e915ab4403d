"""Label runs: list windows of low confidence, set or remove labels, have a model propose them, take answers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import ConfigDict, TypeAdapter, ValidationError, model_validator

from pipelines.learn.settings import TrustSettings
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Section, Table, Text
from terrain.errors import ConfigError, DataError, LogError
from terrain.files.names import plain_name

if TYPE_CHECKING:
    from pipelines.live.model import ModelInfo
    from terrain.classify.proposals import LabelSource, Proposal
    from terrain.logs.run_folders import DoubtfulWindow, RunWindows
    from terrain.records import Label, RunLog

EXAMPLE = "terrain label runs/ --run GRASS_01 --from 2 --to 6 --terrain SNOW"

PERCENT = ".1%"

SOURCES_FILE = "label_sources.json"  #: Beside a run: where each of its labels comes from


class Settings(TrustSettings):
    """Whose windows are listed."""

    data: Path = setting(..., "A run folder, or a folder of run folders.", option="FOLDER")
    run: str | None = setting(None, "Id of the run that is listed or labelled.")
    from_s: float | None = setting(None, option="--from", allow_inf_nan=False)
    """Start of the label in s, on the clock of the run."""
    to_s: float | None = setting(None, "End of the label in s.", "--to", allow_inf_nan=False)
    whole: bool = setting(False, "Label the whole run.", option="--all")
    terrain: str | None = setting(None, "Terrain that the label names; an empty one removes labels.")
    remove: bool = setting(False, "Remove labels in place of setting one.")
    model: str | None = setting(None, "Model that proposes labels of the runs: as of train, or a folder.")
    ask: int = setting(10, "Questions, the stretches most worth an answer.", ge=0)
    proposals: Path = setting(Path("proposals.csv"), "Table of the proposals, to be answered.")
    answers: Path | None = setting(None, "Table with answers: a terrain, 'yes', or 'none'.")
    out: Path | None = setting(None, "New folder of the runs with their labels.")
    error: float = setting(0.02, "Part of what is taken over unasked that may be wrong.", ge=0.0, le=1.0)
    new_class: bool = setting(False, "Accept answers with terrains that are not known yet.")

    @property
    def sets(self) -> bool:
        """Whether labels are changed."""
        return self.remove or self.terrain is not None

    @model_validator(mode="after")
    def _check(self) -> Self:
        begins, ends = self.from_s is not None, self.to_s is not None
        proposed = self.model is not None and (self.answers is not None or self.sets)
        refusals = {
            "--model proposes labels: leave out --answers, --terrain and --remove": proposed,
            "--answers FILE sets labels in the new folder --out DIR: give both": (
                (self.answers is None) != (self.out is None)
            ),
            "an interval needs --terrain NAME, or --remove": (
                (self.whole or begins or ends) and not self.sets
            ),
            "a label needs --run ID": self.sets and self.run is None,
            "--terrain sets a label and --remove removes it: give one of the two": self.remove
            and self.terrain,
            f"--terrain is {self.terrain!r}: use letters, digits and ' ._+-'": (
                self.terrain and not plain_name(self.terrain)
            ),
            "a label needs --from and --to in s, or --all for the whole run": (
                self.sets and self.whole == (begins and ends)
            ),
            "--all is the whole run: leave out --from and --to": self.whole and (begins or ends),
            f"--from is {self.from_s} and --to {self.to_s}: the label ends before it starts": (
                self.from_s is not None and self.to_s is not None and self.from_s >= self.to_s
            ),
        }
        for sentence, applies in refusals.items():
            if applies:
                raise ConfigError(sentence)
        return self


class DoubtfulResult(Result):
    """Windows of low confidence of all runs of a folder, in the order of the runs and of time."""

    data: Path = described("folder of the runs")
    runs: tuple[RunWindows, ...] = described("of each run, how many windows there are, doubtful, unlabelled")
    windows: tuple[DoubtfulWindow, ...] = described("windows whose outputs do not count")


class LabelResult(Result):
    """A run whose labels were changed."""

    run_id: str = described("id of the run")
    folder: Path = described("folder of the run")
    start_s: float = described("start of the interval", "s")
    end_s: float = described("end of the interval", "s")
    terrain: str = described("of the label; empty where labels were removed")
    labels: tuple[Label, ...] = described("all labels of the run")


class ProposalsResult(Result):
    """Proposals for the runs of a folder, and the file that waits for answers."""

    data: Path = described("folder of the runs")
    file: Path = described("table of the proposals")
    n_runs: int = described("number of runs")
    n_asked: int = described("number of questions")
    n_taken_over: int = described("proposals that need no answer")
    taken_over: str = described("from which confidence, and what held-out runs show of it")
    proposals: tuple[Proposal, ...] = described("stretches with the terrain that the model proposes")


class AnswersResult(Result):
    """Runs that were written with their labels."""

    out: Path = described("folder of the runs")
    n_runs: int = described("number of runs")
    n_labels: dict[str, int] = described("labels by their source")
    n_left_open: int = described("stretches without a label")
    runs: dict[str, tuple[LabelSource, ...]] = described("labels of each run, with their sources")


def run(
    settings: Settings, progress: Progress = silent
) -> DoubtfulResult | LabelResult | ProposalsResult | AnswersResult:
    """List doubtful windows, or change labels, or propose them, or take answers, as the settings have it."""
    from terrain.logs.run_folders import doubtful_windows, set_label

    if settings.model is not None:
        return _propose(settings, settings.model)
    if settings.answers is not None and settings.out is not None:
        return _write_labels(settings, settings.answers, settings.out)
    if settings.sets and settings.run is not None:
        terrain = "" if settings.remove else settings.terrain or ""
        changed = set_label(settings.data, settings.run, terrain, settings.from_s, settings.to_s)
        return LabelResult(run_id=settings.run, terrain=terrain, **changed)
    return DoubtfulResult(settings.data, *doubtful_windows(settings.data, settings.run))


def _propose(settings: Settings, model_uri: str) -> ProposalsResult:
    """Write the proposals of a model for the runs of a folder as CSV with empty answers, the questions first."""
    import pandas as pd

    from pipelines.data.datasets import load
    from pipelines.data.settings import RunsSettings
    from pipelines.live.assess import assess
    from pipelines.live.windows import prior_of, windows_of_log
    from terrain.classify.proposals import propose, questions, taken_from
    from terrain.files.atomic import atomic_write

    model, (runs, _, doubts) = settings.read_model(model_uri), load(RunsSettings(data=settings.data))
    of_model = model.info.classes, prior_of(model.info)
    proposals: list[Proposal] = []
    for run in runs:
        windows = windows_of_log(run, model.info, skip_short=True).windows
        if len(windows):
            found = assess(model, windows)
            outputs = found.probability, found.supported, found.unknown
            proposals += propose(run.run_id, windows.start_s, windows.length_s, *outputs, *of_model)
    if not proposals:
        raise DataError(f"{settings.data}: no run holds a window that the model classifies")
    asked = questions(proposals, settings.ask)
    rest = [i for i in range(len(proposals)) if i not in set(asked)]
    if (least := taken_from(model.info.taken_over, settings.error)) is not None:
        for i in rest:
            taken = proposals[i].terrain in least.terrains and proposals[i].certain(least.confidence)
            proposals[i] = proposals[i]._replace(taken_over=taken)
    table = pd.DataFrame([proposals[i] for i in (*asked, *rest)])
    table["ask"], table["answer"] = [*range(1, len(asked) + 1), *("" for _ in rest)], ""
    atomic_write(settings.proposals, table.to_csv(index=False, float_format="%.6g"))
    n_taken, words = sum(each.taken_over for each in proposals), taken_over_words(model.info, settings.error)
    counts = len(runs), len(asked), n_taken
    result = ProposalsResult(settings.data, settings.proposals, *counts, words, tuple(proposals))
    return result.with_doubts(doubts)


def taken_over_words(info: ModelInfo, error: float) -> str:
    """Return in a sentence what a model takes over unasked, or why nothing."""
    from terrain.classify.proposals import taken_from

    if not info.taken_over:
        return "No proposal is taken over unasked: the model held no run out that shows how many are wrong."
    taken = taken_from(info.taken_over, error)
    least = taken or min(info.taken_over, key=lambda each: each.wrong_upper)
    shown = (
        f"from a confidence of {least.confidence:g} {format_value(least.wrong, PERCENT)} of the time is wrong in "
        f"{plural(least.n_units, f'training {least.unit}')} when held out, at most "
        f"{format_value(least.wrong_upper, PERCENT)} with 95 %"
    )
    another = "; what another day does is not shown" if least.unit == "run" else ""
    if taken is None:
        return (
            f"No proposal is taken over unasked, as more than {format_value(error, PERCENT)} (--error) may be wrong: "
            f"{shown}; label more, or answer."
        )
    return f"Proposals are taken over unasked: {shown}{another}."


def _write_labels(settings: Settings, answers: Path, out: Path) -> AnswersResult:
    """Write the runs of a folder to a new one, with the labels that were answered or taken over.

    A person's answer stands above a label that a run has, and that above a proposal of the model.
    """
    from pipelines.data.datasets import load
    from pipelines.data.settings import RunsSettings
    from terrain.classify.proposals import LabelSource, label_of, with_label
    from terrain.files.atomic import atomic_folder
    from terrain.logs.run_folders import write_run
    from terrain.records import Label

    if out.exists():
        raise ConfigError(f"{out}: exists already; the runs are written to a folder of their own")
    runs, _, doubts = load(RunsSettings(data=settings.data))
    labels = {run.run_id: [LabelSource(*label, "measured", None) for label in run.labels] for run in runs}
    left_open = 0
    for proposal, answer in _checked_answers(answers, runs, new_class=settings.new_class):
        added = label_of(proposal, answer)
        if added is None:
            left_open += not answer
        else:
            labels[proposal.run_id] = with_label(labels[proposal.run_id], added)
    counts = Counter(each.source for of_run in labels.values() for each in of_run)
    if not set(counts) - {"measured"}:
        raise ConfigError(
            f"{answers}: no answer, and no proposal that is taken over, adds a label: nothing is written"
        )
    written = {run_id: tuple(sorted(of_run)) for run_id, of_run in labels.items()}
    with atomic_folder(out) as folder:
        for run in runs:
            of_run = written[run.run_id]
            sources = {"labels": [each._asdict() for each in of_run]}
            text = json.dumps(sources, indent=2, allow_nan=False) + "\n"
            labelled = replace(run, labels=tuple(Label(*each[:3]) for each in of_run))
            write_run(labelled, folder, beside={SOURCES_FILE: text})
    found = AnswersResult(out, len(runs), dict(sorted(counts.items())), left_open, written)
    return found.with_doubts(doubts)


def _checked_answers(file: Path, runs: Sequence[RunLog], *, new_class: bool) -> list[tuple[Proposal, str]]:
    """Return the proposals of a table with their answers; an empty one leaves a proposal to its confidence."""
    from terrain.classify.proposals import Proposal, check_answers
    from terrain.files.documents import first_fault
    from terrain.logs.samples import whole_run_label
    from terrain.logs.tables import text_rows

    proposal = TypeAdapter(Proposal, config=ConfigDict(allow_inf_nan=False))
    rows = []
    for number, cells in text_rows(file, (*Proposal._fields, "answer")):
        if cells is None:
            raise LogError(f"{file}, line {number}: is no proposal: it is longer or shorter than the header")
        try:
            found = proposal.validate_python(dict(zip(Proposal._fields, cells[:-1], strict=True)))
        except ValidationError as error:
            raise LogError(f"{file}, line {number}: is no proposal ({first_fault(error)})") from error
        rows.append((found, cells[-1].strip()))
    spans_s = {run.run_id: whole_run_label(run.streams, "")[:2] for run in runs}
    terrains = {label.terrain for run in runs for label in run.labels}
    try:
        check_answers(rows, spans_s, terrains, new_class=new_class)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None
    return rows


def time_text(time_s: float) -> str:
    """Return a time that can be given back to the command without loss.

    Examples
    --------
    >>> time_text(2.0), time_text(4.7300000001), time_text(-0.0)
    ('2', '4.73', '0')
    """
    return f"{time_s + 0.0:.6f}".rstrip("0").rstrip(".")


INTERVAL = (
    Column("from s", of=lambda row: time_text(row.start_s)),
    Column("to s", of=lambda row: time_text(row.end_s)),
)


def report(result: DoubtfulResult | LabelResult | ProposalsResult | AnswersResult) -> Report:
    """Return what is doubtful, was changed, is asked or was written."""
    if isinstance(result, LabelResult):
        done = f"labelled {result.terrain}" if result.terrain else "without a label"
        labels = Table((*INTERVAL, Column("terrain", of="terrain")), result.labels)
        return Report(
            title="Labels",
            answer=f"{result.run_id}: {time_text(result.start_s)} to {time_text(result.end_s)} s {done}",
            parts=(labels,) if result.labels else (),
            next_step=f"terrain inspect {result.folder}",
        )
    if isinstance(result, ProposalsResult):
        return _proposals_report(result)
    if isinstance(result, AnswersResult):
        counts = enumerated([f"{n} by {source}" for source, n in result.n_labels.items()])
        return Report(
            title="Labels",
            answer=f"{plural(result.n_runs, 'run')} in {result.out}: labels {counts}; "
            f"{result.n_left_open} stretches without one",
            next_step=f"terrain train --data {result.out}",
        )
    columns = (
        Column("run", of="run_id"),
        *INTERVAL,
        Column(
            "classified",
            of=lambda row: row.terrain or (f"refused: {row.refused}" if row.refused else "unknown"),
        ),
        Column("probability", ".2f", of="probability"),
        Column("label", of="label"),
    )
    of_run = ("run", "windows", "low confidence", "without label")
    n_windows = sum(run.n_windows or 0 for run in result.runs)
    return Report(
        title="Windows of low confidence",
        answer=f"{len(result.windows)} of {plural(n_windows, 'recorded window')} are of low confidence, "
        f"{sum(run.n_without_label for run in result.runs)} of them without a label",
        parts=(Table(columns, result.windows),) if result.windows else (),
        details=(Section("By run", (Table(of_run, result.runs),)),),
        next_step=f"terrain label {result.data} --run ID --from S --to S --terrain NAME",
    )


def _proposals_report(result: ProposalsResult) -> Report:
    from terrain.classify.proposals import questions

    ends = [Column(name, ".1f") for name in ("from s", "to s")]
    ratios = [Column(name, ".1%") for name in ("supported", "unknown")]
    columns: list[Column | str] = ["run", *ends, "proposed", Column("confidence", ".2f"), *ratios]
    asked = [result.proposals[i] for i in questions(result.proposals, result.n_asked)]
    table = Table(columns, asked, title="worth an answer, the first the most")
    rest = len(result.proposals) - result.n_asked
    return Report(
        title="Proposed labels",
        answer=f"{plural(len(result.proposals), 'proposal')} for {plural(result.n_runs, 'run')} in {result.file}: "
        f"{plural(result.n_asked, 'question')}; of the other {rest}, {result.n_taken_over} need no answer",
        parts=(
            *((table,) if asked else ()),
            Text(result.taken_over),
            Text("answer with a terrain, 'yes' or 'none' in the column answer", kind="note"),
        ),
        next_step=f"terrain label {result.data} --answers {result.file} --out NEW",
    )
