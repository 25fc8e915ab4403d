"""What questions and self-training are worth: few labels, and runs that the model never saw to judge it.

In each fold of whole runs the training part is one labelled run of each terrain and a pool without labels.
As many pool runs as there are terrains are labelled: chosen by the model's doubt, or at random.  With
self-training, pool runs that the model is certain of are labelled by it, and it is fitted again.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import clone

from features.motion import window_motion
from features.protocols import folds_of, samples_of
from features.recipes import feature_matrix
from pipelines.data.datasets import load_runs
from pipelines.learn.parallel import parallel
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import LearnSettings
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, setting
from pipelines.report.tree import Column, Report, Table
from terrain.classify.folds import Fold, run_of
from terrain.classify.held_out import Examples
from terrain.classify.limits import SUPPORTED, Motion, learn_support, supported_probability
from terrain.classify.metrics import Difference, Outcome, compare_outcomes
from terrain.classify.proposals import Proposal, questions
from terrain.errors import DataError
from terrain.records import Array

EXAMPLE = "python tests/studies labels --data runs --repeats 5"
CERTAIN = 0.9  #: Confidence from which self-training takes a run
STRATEGIES = ("first run of each terrain", "random", "doubt", "random, self-trained", "doubt, self-trained")


class Settings(JobsSettings):
    """On which runs label strategies are compared."""

    data: Path = setting(..., "Folder of labelled runs, more than two of each terrain.")
    repeats: int = setting(5, "Fold assignments.", ge=1)
    seed: int = setting(0, "Deals runs into folds, and draws the first labels.", ge=0)


class Strategy(NamedTuple):
    """Accuracy on held-out runs with the labels of a strategy; ``n_labelled`` runs have one on average."""

    name: str
    n_labelled: float
    accuracy: float


class LabelStudy(Result):
    """The strategies side by side, and their differences paired by run."""

    dataset: str = described("folder of the runs")
    repeats: int = described("fold assignments")
    rows: tuple[Strategy, ...] = described("accuracy on held-out runs by strategy")
    differences: Mapping[str, Difference] = described("of two strategies, paired by run")


def run(settings: Settings, progress: Progress = silent) -> LabelStudy:
    """Compare strategies on a folder of labelled runs."""
    data, repeats = settings.data, settings.repeats
    evaluation = LearnSettings(repeats=repeats, seed=settings.seed, n_jobs=settings.n_jobs)
    samples = samples_of(load_runs(data), evaluation.rule)
    windows = samples.windows
    recipe = recipe_of(evaluation)
    examples = Examples(feature_matrix(recipe, windows), samples.terrain, samples.group)
    motion = window_motion(windows)
    folds = folds_of(samples, "grouped", repeats, settings.seed)
    classes = np.unique(examples.terrain)
    probability = np.full((len(STRATEGIES), repeats, len(windows), len(classes)), np.nan)
    counts = []
    each = [(fold, settings.seed + number) for number, fold in enumerate(folds)]
    given = _fold_labels, (recipe[-1], examples, motion), each, evaluation.jobs
    for fold, (found, n_labelled) in zip(folds, parallel(*given, "labels", progress), strict=True):
        probability[:, fold.repeat, fold.test] = found
        counts.append(n_labelled)
    outcomes = [
        Outcome(
            windows.run_id.astype(str),
            examples.terrain,
            classes[of.argmax(axis=2)] == examples.terrain,
            of.max(axis=2),
        )
        for of in probability
    ]
    pairs = {
        "doubt against random": (1, 2),
        "self-training after random": (1, 3),
        "self-training after doubt": (2, 4),
    }
    rng = np.random.default_rng(settings.seed)
    return LabelStudy(
        data.resolve().name,
        repeats,
        tuple(
            Strategy(name, float(np.mean([c[i] for c in counts])), float(outcomes[i].correct.mean()))
            for i, name in enumerate(STRATEGIES)
        ),
        {name: compare_outcomes(outcomes[a], outcomes[b], rng).accuracy for name, (a, b) in pairs.items()},
    )


def _fold_labels(
    classifier: Any, examples: Examples, motion: Motion | None, fold: Fold, seed: int
) -> tuple[Array, tuple[int, ...]]:
    """Return probabilities (strategies, n, k) of a fold's test rows, and how many runs were labelled for each."""
    rng = np.random.default_rng(seed)
    rows = fold.train
    truth = examples.terrain[rows]
    runs = np.char.add(np.char.add(run_of(examples.group[rows]), " "), truth)
    of_class = [np.unique(runs[truth == name]) for name in np.unique(truth)]
    if len(of_class) < len(np.unique(examples.terrain)):
        raise DataError("a terrain has no run to train on in a fold; add runs")
    first = {str(rng.choice(names)) for names in of_class}
    pool = [str(run) for run in np.unique(runs) if run not in first]
    budget = min(len(of_class), len(pool))
    begun = np.isin(runs, list(first))
    fitted = _fit(classifier, examples, rows, truth, begun)
    proposals = [_proposal(fitted, examples, motion, rows, runs, run, begun) for run in pool]
    chosen = {pool[i] for i in questions(proposals, budget)}
    drawn = set(rng.permutation(pool)[:budget].tolist())
    found, counts = [_on(fitted, examples, fold.test)], [len(first)]
    again = []
    for asked in (drawn, chosen):
        known = np.isin(runs, list(first | asked))
        model = _fit(classifier, examples, rows, truth, known)
        found.append(_on(model, examples, fold.test))
        counts.append(len(first | asked))
        again.append((model, known, [run for run in pool if run not in asked]))
    for model, known, rest in again:
        terrain, used = truth.copy(), known.copy()
        n_taken = 0
        for run in rest:
            proposal = _proposal(model, examples, motion, rows, runs, run, known)
            if proposal.certain(CERTAIN):
                terrain[runs == run], used[runs == run] = proposal.terrain, True
                n_taken += 1
        found.append(_on(_fit(classifier, examples, rows, terrain, used), examples, fold.test))
        counts.append(len(np.unique(runs[known])) + n_taken)
    return np.stack(found), tuple(counts)


def _fit(classifier: Any, examples: Examples, rows: Array, terrain: Array, used: Array) -> Any:
    kept = rows[used]
    return clone(classifier).fit(examples.features[kept], terrain[used], groups=examples.group[kept])


def _on(fitted: Any, examples: Examples, test: Array) -> Array:
    return np.asarray(fitted.predict_proba(examples.features[test]))


def _proposal(
    fitted: Any, examples: Examples, motion: Motion | None, rows: Array, runs: Array, run: str, known: Array
) -> Proposal:
    """Return what a model proposes for a run of one terrain."""
    of = rows[runs == run]
    probability = _on(fitted, examples, of)
    best = int(probability.mean(axis=0).argmax())
    supported = 1.0
    if motion is not None:
        seen, now = motion.of(rows[known]), motion.of(of)
        table = learn_support(
            seen.speed_mps, seen.yaw_rate_radps, examples.terrain[rows[known]], runs[known], fitted.classes_
        )
        near = table.near_runs(now.speed_mps, now.yaw_rate_radps)
        supported = float((supported_probability(probability, near) >= SUPPORTED).mean())
    confidence = float(probability[:, best].mean())
    return Proposal(run, 0.0, float(len(of)), str(fitted.classes_[best]), confidence, supported, 0.0, len(of))


def report(result: LabelStudy) -> Report:
    """Return accuracy by the answers that a model was given, and the differences."""
    rows = tuple(row._asdict().values() for row in result.rows)
    differences = tuple(
        (name, 100 * row.difference, (100 * row.interval[0], 100 * row.interval[1]), row.verdict.value)
        for name, row in result.differences.items()
    )
    chosen = result.differences["doubt against random"]
    return Report(
        f"Labels of {result.dataset}",
        f"Questions chosen by doubt change the accuracy by {100 * chosen.difference:+.1f} points against as many drawn "
        f"at random ({100 * chosen.interval[0]:+.1f} to {100 * chosen.interval[1]:+.1f}), {chosen.verdict.value}.",
        parts=(
            Table(
                ("labels", Column("runs labelled", ".1f"), Column("accuracy", ".1%")), tuple(map(tuple, rows))
            ),
            Table(("difference", Column("points", "+.1f"), Column("95 %", "+.1f"), "verdict"), differences),
        ),
    )
