"""Label runs: list windows of low confidence, set or remove labels, have a model propose them, take answers."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import model_validator

from pipelines.report import (
    Column,
    Progress,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    enumerated,
    plural,
    silent,
)
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from terrain.errors import ConfigError, DataError
from terrain.files.names import plain_name

if TYPE_CHECKING:
    from pipelines.learn.model_file import TerrainModel
    from terrain.classify.proposals import LabelSource, Proposal
    from terrain.logs.recorded_windows import DoubtfulWindow, RunWindows
    from terrain.records import Label, RunLog

EXAMPLE = "terrain label runs/ --run GRASS_01 --from 2 --to 6 --terrain SNOW"

SOURCES_FILE = "label_sources.json"
"""Beside a run: where each of its labels comes from."""


class Settings(BaseSettings):
    """Whose windows are listed."""

    data: Path = setting(..., "A run folder, or a folder of run folders.", option="FOLDER")
    run: str | None = setting(None, "Id of the run that is listed or labelled.")
    from_s: float | None = setting(None, "Start of the label in s, on the clock of the run.", option="--from")
    to_s: float | None = setting(None, "End of the label in s.", option="--to")
    whole: bool = setting(False, "Label the whole run.", option="--all")
    terrain: str | None = setting(None, "Terrain that the label names; an empty one removes labels.")
    remove: bool = setting(False, "Remove labels in place of setting one.")
    model: str | None = setting(None, "Model that proposes labels of the runs: as of train, or a folder.")
    ask: int = setting(10, "Questions, the stretches most worth an answer.", ge=0)
    proposals: Path = setting(Path("proposals.csv"), "Table of the proposals, to be answered.")
    answers: Path | None = setting(None, "Table with answers: a terrain, 'yes', or 'none'.")
    out: Path | None = setting(None, "New folder of the runs with their labels.")
    accept: float = setting(0.9, "Confidence from which a proposal needs no answer.", ge=0.0, le=1.01)
    new_class: bool = setting(False, "Accept answers with terrains that are not known yet.")

    @property
    def sets(self) -> bool:
        """Whether labels are changed."""
        return self.remove or self.terrain is not None

    @property
    def new_terrain(self) -> str:
        """Terrain of the label; empty where labels are removed."""
        return "" if self.remove else (self.terrain or "")

    @model_validator(mode="after")
    def _check_proposals(self) -> Self:
        if self.model is not None and (self.answers is not None or self.sets):
            raise ConfigError("--model proposes labels: leave out --answers, --terrain and --remove")
        if (self.answers is None) != (self.out is None):
            raise ConfigError("--answers FILE sets labels in the new folder --out DIR: give both")
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        placed = self.whole or self.from_s is not None or self.to_s is not None
        if placed and not self.sets:
            raise ConfigError("an interval needs --terrain NAME, or --remove")
        if not self.sets:
            return self
        if self.run is None:
            raise ConfigError("a label needs --run ID")
        if self.remove and self.terrain:
            raise ConfigError("--terrain sets a label and --remove removes it: give one of the two")
        if self.terrain and not plain_name(self.terrain):
            raise ConfigError(f"--terrain is {self.terrain!r}: use letters, digits and ' ._+-'")
        if self.whole == (self.from_s is not None and self.to_s is not None):
            raise ConfigError("a label needs --from and --to in s, or --all for the whole run")
        if self.whole and (self.from_s is not None or self.to_s is not None):
            raise ConfigError("--all is the whole run: leave out --from and --to")
        for option, value in (("--from", self.from_s), ("--to", self.to_s)):
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"{option} is {value!r}, a time in s is required")
        if self.from_s is not None and self.to_s is not None and not self.from_s < self.to_s:
            raise ConfigError(
                f"--from is {self.from_s:g} and --to {self.to_s:g}: the label ends before it starts"
            )
        return self


@dataclass(frozen=True)
class DoubtfulResult(Result):
    """Windows of low confidence of all runs of a folder, in the order of the runs and of time."""

    data: Path = described("folder of the runs")
    runs: tuple[RunWindows, ...] = described(
        "of each run, how many windows there are, are doubtful, lack a label"
    )
    windows: tuple[DoubtfulWindow, ...] = described("windows whose outputs do not count")


@dataclass(frozen=True)
class LabelResult(Result):
    """A run whose labels were changed."""

    run_id: str = described("id of the run")
    folder: Path = described("folder of the run")
    start_s: float = described("start of the interval", "s")
    end_s: float = described("end of the interval", "s")
    terrain: str = described("of the label; empty where labels were removed")
    labels: tuple[Label, ...] = described("all labels of the run")


@dataclass(frozen=True)
class ProposalsResult(Result):
    """Proposals for the runs of a folder, and the file that waits for answers."""

    data: Path = described("folder of the runs")
    file: Path = described("table of the proposals")
    n_runs: int = described("number of runs")
    n_asked: int = described("number of questions")
    n_taken_over: int = described("proposals that need no answer")
    proposals: tuple[Proposal, ...] = described("stretches with the terrain that the model proposes")


@dataclass(frozen=True)
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
    """List doubtful windows, or change labels, or propose them, or take answers, as the settings have it.

    Raises
    ------
    LogError, DataError
        if there is no run, a file is damaged, or a run lacks what the model requires.
    ConfigError
        if there is no run of the id, an interval is outside of it, or answers do not fit.
    TerrainError
        if a file cannot be written.
    """
    from terrain.logs.labels import set_label
    from terrain.logs.recorded_windows import doubtful_windows

    if settings.model is not None:
        from pipelines.learn.load import load_model

        return propose_labels(settings, load_model(settings.model))
    if settings.answers is not None and settings.out is not None:
        return write_labels(settings, settings.answers, settings.out)
    if settings.sets and settings.run is not None:
        terrain = settings.new_terrain
        changed = set_label(settings.data, settings.run, terrain, settings.from_s, settings.to_s)
        folder, start_s, end_s, labels = changed
        return LabelResult(settings.run, folder, start_s, end_s, terrain, labels)
    return DoubtfulResult(settings.data, *doubtful_windows(settings.data, settings.run))


def propose_labels(settings: Settings, model: TerrainModel) -> ProposalsResult:
    """Write the proposals of a model for the runs of a folder, the questions first.

    Raises
    ------
    LogError, DataError
        if there is no run, or a run lacks what the model requires.
    """
    from pipelines.data.datasets import load_runs
    from pipelines.learn.predict import model_windows
    from pipelines.learn.proposals import write_proposals
    from pipelines.live.model import assess
    from pipelines.live.windows import filter_of
    from terrain.classify.proposals import propose, questions

    runs = load_runs(settings.data)
    proposals: list[Proposal] = []
    for run in runs:
        windows = model_windows(run, model, skip_short=True).windows
        if len(windows):
            found = assess(model, windows)
            outputs = found.probability, found.supported, found.unknown
            of_model = model.info.classes, filter_of(model.info).prior
            proposals += propose(run.run_id, windows.start_s, windows.length_s, *outputs, *of_model)
    if not proposals:
        raise DataError(f"{settings.data}: no run holds a window that the model classifies")
    asked = questions(proposals, settings.ask)
    write_proposals(settings.proposals, proposals, asked)
    taken = sum(each.taken_over(settings.accept) for i, each in enumerate(proposals) if i not in set(asked))
    return ProposalsResult(settings.data, settings.proposals, len(runs), len(asked), taken, tuple(proposals))


def write_labels(settings: Settings, answers: Path, out: Path) -> AnswersResult:
    """Write the runs of a folder to another one, with the labels that were answered or taken over.

    A person's answer stands above a label that a run has, and that above a proposal of the model.

    Parameters
    ----------
    settings : whose folder of runs was proposed for, and which proposals are taken over
    answers : table of proposals with answers
    out : folder that is made; refused where it is there

    Raises
    ------
    LogError, ConfigError
        as :func:`pipelines.learn.proposals.read_answers`; also if no label would be added.
    """
    from pipelines.data.datasets import load_runs
    from pipelines.learn.proposals import read_answers
    from terrain.classify.proposals import LabelSource, label_of, with_label
    from terrain.files.atomic import atomic_folder
    from terrain.logs.write import write_run
    from terrain.records import Label

    if out.exists():
        raise ConfigError(f"{out}: exists already; the runs are written to a folder of their own")
    runs = load_runs(settings.data)
    spans_s = {run.run_id: _span_s(run) for run in runs}
    terrains = sorted({label.terrain for run in runs for label in run.labels})
    rows = read_answers(answers, spans_s, terrains, new_class=settings.new_class)
    written: dict[str, tuple[LabelSource, ...]] = {}
    left_open = 0
    labelled = []
    for run in runs:
        labels = [LabelSource(*label, "measured", None) for label in run.labels]
        for row in (row for row in rows if row.proposal.run_id == run.run_id):
            added = label_of(row.proposal, row.answer, settings.accept)
            if added is None:
                left_open += not row.answer
            else:
                labels = with_label(labels, added)
        written[run.run_id] = tuple(sorted(labels))
        labelled.append(replace(run, labels=tuple(Label(*each[:3]) for each in written[run.run_id])))
    if not any(each.source != "measured" for labels in written.values() for each in labels):
        raise ConfigError(
            f"{answers}: no answer, and no proposal of a confidence of {settings.accept:g}, adds a label: "
            "nothing is written"
        )
    with atomic_folder(out) as folder:
        for run in labelled:
            sources = [each._asdict() for each in written[run.run_id]]
            text = json.dumps({"labels": sources}, indent=2, allow_nan=False) + "\n"
            write_run(run, folder, beside={SOURCES_FILE: text})
    counts = Counter(each.source for labels in written.values() for each in labels)
    return AnswersResult(out, len(runs), dict(sorted(counts.items())), left_open, written)


def _span_s(run: RunLog) -> tuple[float, float]:
    streams = run.streams.values()
    return (
        float(min(stream.time_s[0] for stream in streams)),
        float(max(stream.time_s[-1] + 1.0 / stream.rate_hz for stream in streams)),
    )


def time_text(time_s: float) -> str:
    """Return a time that can be given back to the command without loss.

    Examples
    --------
    >>> time_text(2.0), time_text(4.7300000001), time_text(-0.0)
    ('2', '4.73', '0')
    """
    return f"{time_s + 0.0:.6f}".rstrip("0").rstrip(".")


def report(result: DoubtfulResult | LabelResult | ProposalsResult | AnswersResult) -> Report:
    """Return what is doubtful, was changed, is asked or was written."""
    if isinstance(result, LabelResult):
        return _label_report(result)
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
    return _doubtful_report(result)


def _doubtful_report(result: DoubtfulResult) -> Report:
    n_windows = sum(run.n_windows or 0 for run in result.runs)
    open_ones = sum(run.n_without_label for run in result.runs)
    windows = tuple(
        (
            row.run_id,
            time_text(row.start_s),
            time_text(row.end_s),
            row.terrain or (f"refused: {row.refused}" if row.refused else "unknown"),
            row.probability,
            row.label or "",
        )
        for row in result.windows
    )
    columns = ("run", "from s", "to s", "classified", Column("probability", ".2f"), "label")
    runs = tuple(
        (
            run.run_id,
            "none recorded" if run.n_windows is None else run.n_windows,
            run.n_doubtful,
            run.n_without_label,
        )
        for run in result.runs
    )
    return Report(
        title="Windows of low confidence",
        answer=f"{len(result.windows)} of {plural(n_windows, 'recorded window')} are of low confidence, "
        f"{open_ones} of them without a label",
        parts=(Table(columns, windows),) if windows else (),
        details=(Section("By run", (Table(("run", "windows", "low confidence", "without label"), runs),)),),
        next_step=f"terrain label {result.data} --run ID --from S --to S --terrain NAME",
    )


def _label_report(result: LabelResult) -> Report:
    done = f"labelled {result.terrain}" if result.terrain else "without a label"
    labels = tuple((time_text(a), time_text(b), terrain) for a, b, terrain in result.labels)
    return Report(
        title="Labels",
        answer=f"{result.run_id}: {time_text(result.start_s)} to {time_text(result.end_s)} s {done}",
        parts=(Table(("from s", "to s", "terrain"), labels),) if labels else (),
        next_step=f"terrain inspect {result.folder}",
    )


def _proposals_report(result: ProposalsResult) -> Report:
    from terrain.classify.proposals import questions

    asked = [result.proposals[i] for i in questions(result.proposals, result.n_asked)]
    rows = tuple(
        (
            row.run_id,
            row.start_s,
            row.end_s,
            row.terrain,
            row.confidence,
            row.supported_ratio,
            row.unknown_ratio,
        )
        for row in asked
    )
    columns = (
        "run",
        Column("from s", ".1f"),
        Column("to s", ".1f"),
        "proposed",
        Column("confidence", ".2f"),
        Column("supported", ".1%"),
        Column("unknown", ".1%"),
    )
    rest = len(result.proposals) - result.n_asked
    return Report(
        title="Proposed labels",
        answer=f"{plural(len(result.proposals), 'proposal')} for {plural(result.n_runs, 'run')} in {result.file}: "
        f"{plural(result.n_asked, 'question')}; of the other {rest}, {result.n_taken_over} need no answer",
        parts=(
            *((Table(columns, rows, title="worth an answer, the first the most"),) if rows else ()),
            Text("answer with a terrain, 'yes' or 'none' in the column answer", kind="note"),
        ),
        next_step=f"terrain label {result.data} --answers {result.file} --out NEW",
    )
