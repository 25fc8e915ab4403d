"""``terrain label --model`` and ``--answers``: proposals out, answers in, labelled runs out."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from features.windows import cut_windows, join_windows
from pipelines.data.datasets import load_runs, robot_of
from pipelines.label.labels import relabelled
from pipelines.live.windows import lacking_estimates, windows_of_log
from pipelines.models.model_files import TerrainModel
from pipelines.propose.answers_file import NONE, YES, Answered, read_answers, write_proposals
from pipelines.propose.proposals import Proposal, propose, questions
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_folder
from terrain.logs.write import write_run
from terrain.records import Label, RunLog

SOURCES_FILE = "label_sources.json"
"""Beside a run: where each of its labels comes from."""


class LabelSource(NamedTuple):
    """A label, and where it comes from: ``measured`` as the run had it, a ``person``, or the ``model``."""

    start_s: float
    end_s: float
    terrain: str
    source: str
    confidence: float | None


class ProposedLabels(NamedTuple):
    """Proposals for the runs of a folder, and the file that waits for answers."""

    data: Path
    file: Path
    n_runs: int
    n_asked: int
    n_taken_over: int
    proposals: tuple[Proposal, ...]


class WrittenLabels(NamedTuple):
    """Runs that were written with their labels, by source."""

    out: Path
    n_runs: int
    n_labels: dict[str, int]
    n_left_open: int
    runs: dict[str, tuple[LabelSource, ...]]


def propose_labels(
    data: Path, model: TerrainModel, n_asked: int, file: Path, accept: float
) -> ProposedLabels:
    """Write the proposals of a model for the runs of a folder, the questions first.

    Parameters
    ----------
    data : folder of runs in any readable layout
    model : that proposes
    n_asked : questions at most
    file : of the proposals
    accept : least confidence of a proposal that is taken over without an answer

    Raises
    ------
    LogError, DataError
        if there is no run, or a run lacks what the model requires.
    """
    runs = load_runs(data)
    cuts = [
        windows_of_log(run, model.info, robot_of(run, None), skip_short=True)
        if lacking_estimates(run, model.info)
        else cut_windows([run], model.rule, layout=model.layout, skip_short=True)
        for run in runs
    ]
    proposals = propose(join_windows([cut.windows for cut in cuts]), model)
    if not proposals:
        raise DataError(f"{data}: no run holds a window that the model classifies")
    asked = questions(proposals, n_asked)
    write_proposals(file, proposals, asked)
    taken = sum(each.taken_over(accept) for i, each in enumerate(proposals) if i not in set(asked))
    return ProposedLabels(data, file, len(runs), len(asked), taken, tuple(proposals))


def write_labels(data: Path, answers: Path, out: Path, accept: float, *, new_class: bool) -> WrittenLabels:
    """Write the runs of a folder to another one, with the labels that were answered or taken over.

    A person's answer stands above a label that a run has, and that above a proposal of the model.

    Parameters
    ----------
    data : folder of the runs that were proposed for
    answers : table of proposals with answers
    out : folder that is made; refused where it is there
    accept : least confidence of a proposal that is taken over without an answer
    new_class : whether terrains may be answered that neither runs nor proposals have

    Raises
    ------
    LogError, ConfigError
        as :func:`pipelines.propose.answers_file.read_answers`; also if no label would be added.
    """
    if out.exists():
        raise ConfigError(f"{out}: exists already; the runs are written to a folder of their own")
    runs = load_runs(data)
    spans_s = {run.run_id: _span_s(run) for run in runs}
    terrains = sorted({label.terrain for run in runs for label in run.labels})
    rows = read_answers(answers, spans_s, terrains, new_class=new_class)
    written: dict[str, tuple[LabelSource, ...]] = {}
    left_open = 0
    labelled = []
    for run in runs:
        of_run = [row for row in rows if row.proposal.run_id == run.run_id]
        labels = [LabelSource(*label, "measured", None) for label in run.labels]
        for row in of_run:
            added = _label_of(row, accept)
            if added is None:
                left_open += not row.answer
            else:
                labels = _with(labels, added)
        written[run.run_id] = tuple(sorted(labels))
        labelled.append(replace(run, labels=tuple(Label(*each[:3]) for each in written[run.run_id])))
    if not any(each.source != "measured" for labels in written.values() for each in labels):
        raise ConfigError(
            f"{answers}: no answer, and no proposal of a confidence of {accept:g}, adds a label: "
            "nothing is written"
        )
    with atomic_folder(out) as folder:
        for run in labelled:
            sources = [each._asdict() for each in written[run.run_id]]
            text = json.dumps({"labels": sources}, indent=2, allow_nan=False) + "\n"
            write_run(run, folder, beside={SOURCES_FILE: text})
    counts = Counter(each.source for labels in written.values() for each in labels)
    return WrittenLabels(out, len(runs), dict(sorted(counts.items())), left_open, written)


def _label_of(row: Answered, accept: float) -> LabelSource | None:
    """Return the label that a row sets; None where it sets none, an empty terrain where it removes."""
    proposal = row.proposal
    if row.answer == NONE:
        return LabelSource(proposal.start_s, proposal.end_s, "", "person", None)
    if row.answer:
        terrain = proposal.terrain if row.answer == YES else row.answer
        return LabelSource(proposal.start_s, proposal.end_s, terrain, "person", None)
    if not proposal.taken_over(accept):
        return None
    return LabelSource(proposal.start_s, proposal.end_s, proposal.terrain, "model", proposal.confidence)


def _with(labels: Sequence[LabelSource], added: LabelSource) -> list[LabelSource]:
    """Return labels with one more: a person's replaces what it covers, the model's only fills gaps."""
    if added.source == "model":
        free = not any(each.start_s < added.end_s and added.start_s < each.end_s for each in labels)
        return [*labels, added] if free else list(labels)
    kept = []
    for each in labels:
        for part in relabelled([Label(*each[:3])], added.start_s, added.end_s, ""):
            kept.append(each._replace(start_s=part.start_s, end_s=part.end_s))
    return [*kept, added] if added.terrain else kept


def _span_s(run: RunLog) -> tuple[float, float]:
    streams = run.streams.values()
    return (
        float(min(stream.time_s[0] for stream in streams)),
        float(max(stream.time_s[-1] + 1.0 / stream.rate_hz for stream in streams)),
    )
