"""Stretches of one ground that a model proposes, which of them are worth a question, and the answers: a CSV."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.learn.model_file import TerrainModel
from pipelines.live.model import assess
from pipelines.live.over_time import filter_of
from terrain.classify.smoothing import smoothed_classes
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.files.names import plain_name, shown
from terrain.records import Array, Windows

MAX_GAP_WINDOWS = 2.0
"""A stretch ends where windows are missing for longer."""

ACCEPTED = 0.9
"""Least mean probability of a proposal that is taken over without a question."""


class Proposal(NamedTuple):
    """A stretch of a run, and the terrain that a model proposes for it.

    Parameters
    ----------
    run_id, start_s, end_s : of the stretch, on the clock of the run
    terrain : proposed
    confidence : mean probability of that terrain over the windows
    supported_ratio : share of the windows whose prediction training runs support; 1 where not counted
    unknown_ratio : share of the windows that are like no terrain that was learned
    n_windows : in the stretch
    """

    run_id: str
    start_s: float
    end_s: float
    terrain: str
    confidence: float
    supported_ratio: float
    unknown_ratio: float
    n_windows: int

    def taken_over(self, confidence_least: float) -> bool:
        """Whether it may become a label without a question."""
        return (
            self.confidence >= confidence_least and self.supported_ratio >= 0.5 and self.unknown_ratio < 0.5
        )

    @property
    def doubt(self) -> float:
        """How much an answer would change: improbable, unsupported or unknown; 0 to 3."""
        return 1.0 - self.confidence + 1.0 - self.supported_ratio + self.unknown_ratio


def propose(windows: Windows, model: TerrainModel) -> list[Proposal]:
    """Return the proposals for runs, in order of run and time.

    Parameters
    ----------
    windows : of the runs, as the model requires them
    model : that proposes

    Raises
    ------
    DataError
        if the windows are not those of the model.
    """
    if not len(windows):
        return []
    found, assessed = [], assess(model, windows)
    supported = np.where(np.isnan(assessed.supported), 1.0, assessed.supported)
    classes = np.asarray(model.info.classes)
    prior = np.array(filter_of(model.info).prior)
    for run_id in dict.fromkeys(windows.run_id):
        rows = np.flatnonzero(windows.run_id == run_id)
        start_s = windows.start_s[rows]
        path = smoothed_classes(assessed.probability[rows], start_s, prior)
        for part in _parts(path, start_s, windows.length_s):
            of = rows[part]
            number = path[part[0]]
            found.append(
                Proposal(
                    str(run_id),
                    float(start_s[part[0]]),
                    float(start_s[part[-1]] + windows.length_s),
                    str(classes[number]),
                    float(assessed.probability[of, number].mean()),
                    float(supported[of].mean()),
                    float(assessed.unknown[of].mean()),
                    len(part),
                )
            )
    return found


def _parts(path: Array, start_s: Array, length_s: float) -> list[Array]:
    """Return the rows of each stretch of one class without a gap."""
    changed = (np.diff(path) != 0) | (np.diff(start_s) > (1.0 + MAX_GAP_WINDOWS) * length_s)
    return np.split(np.arange(len(path)), np.flatnonzero(changed) + 1)


def questions(proposals: Sequence[Proposal], n: int) -> list[int]:
    """Return the places of the proposals that are most worth an answer, at most n, the first the most.

    The doubt of each is divided by the number of chosen ones of its run and of its terrain: ten questions on
    one run would bring one answer.

    Examples
    --------
    >>> rows = [Proposal(run, 0, 9, "ice", p, 1, 0, 4) for run, p in (("a", .5), ("a", .52), ("b", .6))]
    >>> questions(rows, 2)
    [0, 2]
    """
    runs: Counter[str] = Counter()
    terrains: Counter[str] = Counter()
    left, chosen = list(range(len(proposals))), list[int]()
    while left and len(chosen) < n:
        worth = {
            i: proposals[i].doubt
            / ((1 + runs[proposals[i].run_id]) ** 2 * (1 + 0.5 * terrains[proposals[i].terrain]))
            for i in left
        }
        best = max(left, key=lambda i: (worth[i], -i))
        chosen.append(best)
        left.remove(best)
        runs[proposals[best].run_id] += 1
        terrains[proposals[best].terrain] += 1
    return chosen


class Answered(NamedTuple):
    """A proposal and its answer; an empty one leaves it to its confidence."""

    proposal: Proposal
    answer: str


COLUMNS = (*Proposal._fields, "ask", "answer")
YES, NONE = "yes", "none"
"""Answers beside the name of a terrain: the proposal is right; the stretch is of no terrain."""

NUMBERS = ("start_s", "end_s", "confidence", "supported_ratio", "unknown_ratio")
MAX_FILE_BYTES = 1 << 26
TOLERANCE_S = 0.5


def write_proposals(file: Path, proposals: Sequence[Proposal], asked: Sequence[int]) -> None:
    """Write proposals with empty answers as CSV, the questions first, in their order."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    rest = [i for i in range(len(proposals)) if i not in set(asked)]
    for rank, i in [*enumerate(asked, 1), *(("", i) for i in rest)]:
        row = [f"{each:.6g}" if isinstance(each, float) else each for each in proposals[i]]
        writer.writerow([*row, rank, ""])
    atomic_write(file, text.getvalue())


def read_answers(
    file: Path, spans_s: Mapping[str, tuple[float, float]], terrains: Sequence[str], *, new_class: bool
) -> list[Answered]:
    """Return the rows of a table that was answered.

    Parameters
    ----------
    file : as :func:`write_proposals` writes it
    spans_s : first and last time of each run that may be named
    terrains : that may be answered beside those that are proposed
    new_class : whether others may be answered, too

    Raises
    ------
    LogError
        if it is no such table.
    ConfigError
        if it names a run that is not there, stretches that overlap or lie outside of their run, or a terrain
        that is not known.
    """
    rows = _rows(file)
    known = {*terrains, *(row.proposal.terrain for row in rows), YES, NONE, ""}
    until_s: dict[str, float] = {}
    for row in sorted(rows, key=lambda each: each.proposal[:2]):
        run_id, start_s, end_s = row.proposal[:3]
        if run_id not in spans_s:
            raise ConfigError(f"{file}: run {shown(run_id)} is none of those whose labels are set")
        first_s, last_s = spans_s[run_id]
        if not first_s - TOLERANCE_S <= start_s < end_s <= last_s + TOLERANCE_S:
            raise ConfigError(
                f"{file}: {start_s:g} to {end_s:g} s is no stretch of run {run_id}, which is from "
                f"{first_s:g} to {last_s:g} s"
            )
        if start_s < until_s.get(run_id, -math.inf) - TOLERANCE_S:
            raise ConfigError(f"{file}: stretches of run {run_id} overlap at {start_s:g} s")
        until_s[run_id] = end_s
        if row.answer not in known and not (new_class and plain_name(row.answer)):
            raise ConfigError(
                f"{file}: {shown(row.answer)} is no terrain that is known here "
                f"({', '.join(sorted(known - {''}))}); --new-class accepts others"
            )
    return rows


def _rows(file: Path) -> list[Answered]:
    try:
        if file.stat().st_size > MAX_FILE_BYTES:
            raise LogError(f"{file}: is larger than a table of proposals can be")
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{file}: cannot be read ({error})") from error
    reader = csv.DictReader(io.StringIO(text))
    if reader.fieldnames is None or set(COLUMNS) - set(reader.fieldnames):
        raise LogError(f"{file}: is no table of proposals (columns {', '.join(COLUMNS)})")
    found = []
    for number, row in enumerate(reader, 2):
        try:
            numbers = {name: float(row[name]) for name in NUMBERS}
            if not all(map(math.isfinite, numbers.values())):
                raise ValueError("a number is not finite")
            proposal = Proposal(
                run_id=row["run_id"], terrain=row["terrain"], n_windows=int(row["n_windows"]), **numbers
            )
            found.append(Answered(proposal, row["answer"].strip()))
        except (TypeError, ValueError, AttributeError) as error:
            raise LogError(f"{file}, line {number}: is no proposal ({error})") from error
    return found
