"""The table of proposed labels, which a person answers: a CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from terrain.classify.proposals import NONE, YES, Proposal
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.files.names import plain_name, shown


class Answered(NamedTuple):
    """A proposal and its answer; an empty one leaves it to its confidence."""

    proposal: Proposal
    answer: str


COLUMNS = (*Proposal._fields, "ask", "answer")
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
