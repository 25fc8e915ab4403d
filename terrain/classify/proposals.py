r"""Stretches of one ground that a classifier proposes as labels, and which of them are worth a question.

For labels, unlike on the robot, the whole run is known: a stretch is one of the most likely sequence of grounds
under all windows of a run, the path of a hidden Markov model (Viterbi 1967)
whose states are the classes, with the class shares of training taken out of the probabilities and a mean time
on one ground as in :mod:`terrain.classify.terrain_filter`.

**Taken over unasked** is what holds a stated error on labelled runs that the model did not have.  Their stretches are
proposed in the same manner, by the probabilities that each training row has while its unit (session, or run) is held
out of the inner folds.  Of the units with stretches of a confidence c or more, unit i has a time :math:`t_i` in them,
of which the part :math:`w_i` is wrong; errors of a unit come together, so that units are counted and not windows:

.. math:: n = (\sum t_i)^2 / \sum t_i^2, \qquad k = n \sum t_i w_i / \sum t_i

(Kish, Survey Sampling, 1965), and the part that is wrong is, with 95 %, at most the quantile of the beta distribution
with k + 1 and n - k (Clopper and Pearson 1934): without any error 149 units show 2 %, and 59 show 5 %.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import LEVEL, proportion_interval
from terrain.classify.folds import single_run_classes
from terrain.classify.terrain_filter import DWELL_S, OUTLIER_RATIO
from terrain.errors import ConfigError
from terrain.files.names import plain_name, shown
from terrain.records import Array, Windows

MAX_GAP_WINDOWS = 2.0  #: A stretch ends where windows are missing for longer.
#: Confidences from which proposals may be taken over unasked.
CONFIDENCES = (0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
TOLERANCE_S = 0.5  #: A stretch of a table may be that far outside of its run, and reach into the next one.
#: Answers beside the name of a terrain: the proposal is right; the stretch is of no terrain.
YES, NONE = "yes", "none"


def smoothed_classes(probability: Array, time_s: Array, prior: Array) -> Array:
    """Return the class (n,) of each window along the most likely sequence, of windows that do not overlap, in order.

    Maximises ``sum_i log((1 - o) p_i(c_i) / prior(c_i) + o) + sum_i log P(c_i | c_i-1, dt_i)`` with the share
    o of windows that follow no class; a ground is kept with ``exp(-dt / dwell)``, and followed by any other
    alike.
    """
    n, k = probability.shape
    if n == 0:
        return np.zeros(0, dtype=int)
    evidence = np.log((1.0 - OUTLIER_RATIO) * probability / prior + OUTLIER_RATIO)
    score, origin = evidence[0].copy(), np.zeros((n, k), dtype=int)
    for i in range(1, n):
        kept = np.exp(-max(float(time_s[i] - time_s[i - 1]), 0.0) / DWELL_S)
        step = np.full((k, k), np.log((1.0 - kept) / max(k - 1, 1) + 1e-300))
        np.fill_diagonal(step, np.log(kept + 1e-300))
        reached = score[:, None] + step
        origin[i] = reached.argmax(axis=0)
        score = reached.max(axis=0) + evidence[i]
    path = np.empty(n, dtype=int)
    path[-1] = int(score.argmax())
    for i in range(n - 1, 0, -1):
        path[i - 1] = origin[i, path[i]]
    return path


class Proposal(NamedTuple):
    """A stretch of a run, on its clock, and the terrain that a model proposes for it."""

    run_id: str
    start_s: float
    end_s: float
    terrain: str
    confidence: float  #: mean probability of that terrain over the windows
    #: share of the windows whose prediction training runs support; 1 where not counted
    supported_ratio: float
    unknown_ratio: float  #: share of the windows that are like no terrain that was learned
    n_windows: int  #: in the stretch
    taken_over: bool = False  #: whether it becomes a label without an answer

    def certain(self, confidence_least: float) -> bool:
        """Whether it is supported, known, and of a confidence from which it may become a label without a question."""
        return (
            self.confidence >= confidence_least and self.supported_ratio >= 0.5 and self.unknown_ratio < 0.5
        )

    @property
    def doubt(self) -> float:
        """How much an answer would change: improbable, unsupported or unknown; 0 to 3."""
        return 1.0 - self.confidence + 1.0 - self.supported_ratio + self.unknown_ratio


def propose(
    run_id: str,
    start_s: Array,
    length_s: float,
    probability: Array,
    supported: Array,
    unknown: Array,
    classes: Sequence[str],
    prior: Array,
) -> list[Proposal]:
    """Return the proposals for a run, in order of time.

    Parameters
    ----------
    start_s, length_s : (n,) of its windows in order of time, which do not overlap, and their length
    probability : (n, k) in the order of the classes
    supported, unknown : (n,) whether training runs support it, NaN where not counted; whether it is unlike all
    classes, prior : (k,) names, and their shares among the training windows
    """
    path = smoothed_classes(probability, start_s, prior)
    changed = (np.diff(path) != 0) | (np.diff(start_s) > (1.0 + MAX_GAP_WINDOWS) * length_s)
    return [
        Proposal(
            run_id,
            float(start_s[part[0]]),
            float(start_s[part[-1]] + length_s),
            str(classes[path[part[0]]]),
            float(probability[part, path[part[0]]].mean()),
            float(np.where(np.isnan(supported[part]), 1.0, supported[part]).mean()),
            float(unknown[part].mean()),
            len(part),
        )
        for part in np.split(np.arange(len(path)), np.flatnonzero(changed) + 1)
    ]


class TakenOver(NamedTuple):
    """Proposals for held-out training runs of a confidence or more: how many there are, and how many are wrong."""

    confidence: float  #: least mean probability
    ratio: float  #: time in them, of all time
    wrong: float  #: time of that in which they are wrong
    wrong_upper: float  #: not exceeded by it, with 95 %
    n_units: int  #: that have any
    unit: str  #: what is counted as a whole: session or run
    terrains: tuple[str, ...]  #: that were held out whole; others are never taken over


def held_out_errors(
    windows: Windows, probability: Array, classes: Sequence[str], prior: Array, unit: Array
) -> tuple[TakenOver, ...]:
    """Return what is wrong of proposals for training runs by their held-out probabilities, at each confidence.

    Classes with one unit, which no fold held out whole, are not counted.

    Parameters
    ----------
    windows : (n) labelled, of the training runs
    probability : (n, k) of each window when its unit was held out; NaN where it never was
    classes, prior : (k,) names, and their shares among the windows
    unit : (n,) session or run of each window
    """
    run, truth = windows.run_id.astype(str), windows.terrain.astype(str)
    single = single_run_classes(truth, unit)
    terrains = tuple(str(name) for name in classes if name not in single)
    counted = np.isfinite(probability).all(axis=1) & ~np.isin(truth, single)
    parts = []  # unit, confidence, windows, wrong windows of each stretch
    for name in np.unique(run[counted]):
        rows = np.flatnonzero(counted & (run == name))
        rows = rows[np.argsort(windows.start_s[rows], kind="stable")]
        known, none = np.ones(len(rows)), np.zeros(len(rows))
        proposed = propose(
            name, windows.start_s[rows], windows.length_s, probability[rows], known, none, classes, prior
        )
        ends = np.cumsum([each.n_windows for each in proposed])
        for each, own in zip(proposed, np.split(rows, ends[:-1]), strict=True):
            parts.append((unit[own[0]], each.confidence, len(own), (truth[own] != each.terrain).sum()))
    if not parts:
        return ()
    of_unit = np.unique([part[0] for part in parts], return_inverse=True)[1]
    confidence, size, wrong = np.array([part[1:] for part in parts], dtype=float).T
    found = []
    for least in CONFIDENCES:
        kept = confidence >= least
        time, bad = (np.bincount(of_unit[kept], each[kept]) for each in (size, wrong))
        if not time.sum():
            break
        ratio, n = bad.sum() / time.sum(), time.sum() ** 2 / (time**2).sum()
        _, upper = proportion_interval(n * ratio, n, 2 * LEVEL - 1)
        taken = float(time.sum() / size.sum())
        counts = int((time > 0).sum()), "run" if np.array_equal(unit, run) else "session"
        found.append(TakenOver(least, taken, float(ratio), upper, *counts, terrains))
    return tuple(found)


def taken_from(errors: Sequence[TakenOver], error: float) -> TakenOver | None:
    """Return the least confidence from which at most a part of what is taken over is wrong; None without one."""
    return next((each for each in errors if each.wrong_upper <= error), None)


def questions(proposals: Sequence[Proposal], n: int) -> list[int]:
    """Return the places of the proposals that are most worth an answer, at most n, the first the most.

    The doubt of each is divided by the number of chosen ones of its run and of its terrain: ten questions on
    one run would bring one answer.
    """
    runs: Counter[str] = Counter()
    terrains: Counter[str] = Counter()
    left, chosen = list(range(len(proposals))), list[int]()

    def worth(i: int) -> float:
        one = proposals[i]
        return one.doubt / ((1 + runs[one.run_id]) ** 2 * (1 + 0.5 * terrains[one.terrain]))

    while left and len(chosen) < n:
        best = max(left, key=lambda i: (worth(i), -i))
        chosen.append(best)
        left.remove(best)
        runs[proposals[best].run_id] += 1
        terrains[proposals[best].terrain] += 1
    return chosen


class LabelSource(NamedTuple):
    """A label, and where it comes from: ``measured`` as the run had it, a ``person``, or the ``model``."""

    start_s: float
    end_s: float
    terrain: str
    source: str
    confidence: float | None


def label_of(proposal: Proposal, answer: str) -> LabelSource | None:
    """Return the label that an answer sets; None where it sets none, an empty terrain where it removes."""
    span_s = proposal.start_s, proposal.end_s
    if answer:
        terrain = {NONE: "", YES: proposal.terrain}.get(answer, answer)
        return LabelSource(*span_s, terrain, "person", None)
    if not proposal.taken_over:
        return None
    return LabelSource(*span_s, proposal.terrain, "model", proposal.confidence)


def with_label(labels: Sequence[LabelSource], added: LabelSource) -> list[LabelSource]:
    """Return labels with one more: a person's replaces what it covers, the model's only fills gaps.

    Examples
    --------
    >>> person = LabelSource(2.0, 4.0, "mud", "person", None)
    >>> [each[:3] for each in with_label([LabelSource(0.0, 9.0, "ice", "measured", None)], person)]
    [(0.0, 2.0, 'ice'), (4.0, 9.0, 'ice'), (2.0, 4.0, 'mud')]
    """
    if added.source == "model":
        free = not any(each.start_s < added.end_s and added.start_s < each.end_s for each in labels)
        return [*labels, added] if free else list(labels)
    kept = []
    for each in labels:
        parts = (each.start_s, min(each.end_s, added.start_s)), (max(each.start_s, added.end_s), each.end_s)
        kept += [each._replace(start_s=start_s, end_s=end_s) for start_s, end_s in parts if start_s < end_s]
    return [*kept, added] if added.terrain else kept


def check_answers(
    rows: Sequence[tuple[Proposal, str]],
    spans_s: Mapping[str, tuple[float, float]],
    terrains: Iterable[str],
    *,
    new_class: bool,
) -> None:
    """Raise ``ConfigError`` where proposals with their answers do not fit runs of these spans.

    An answer is one of the terrains, one that is proposed, :data:`YES`, :data:`NONE` or empty; with
    ``new_class`` any that can be a name.
    """
    known = {*terrains, *(proposal.terrain for proposal, _ in rows), YES, NONE, ""}
    until_s: dict[str, float] = {}
    for (run_id, start_s, end_s, *_), answer in sorted(rows, key=lambda row: row[0][:2]):
        if run_id not in spans_s:
            raise ConfigError(f"run {shown(run_id)} is none of those whose labels are set")
        first_s, last_s = spans_s[run_id]
        if not first_s - TOLERANCE_S <= start_s < end_s <= last_s + TOLERANCE_S:
            raise ConfigError(
                f"{start_s:g} to {end_s:g} s is no stretch of run {run_id}, which is from "
                f"{first_s:g} to {last_s:g} s"
            )
        if start_s < until_s.get(run_id, -math.inf) - TOLERANCE_S:
            raise ConfigError(f"stretches of run {run_id} overlap at {start_s:g} s")
        until_s[run_id] = end_s
        if answer not in known and not (new_class and plain_name(answer)):
            raise ConfigError(
                f"{shown(answer)} is no terrain that is known here "
                f"({', '.join(sorted(known - {''}))}); --new-class accepts others"
            )
