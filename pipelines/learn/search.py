"""Hyper-parameters of the SVM, searched on inner folds of whole runs.

One fold of whole runs is held out before the search and never seen by it; on it the result is compared with the
default choice.  Trials are suggested in batches by a tree-structured Parzen estimator (optuna) whose seed is
that of the batch, so that neither the number of processes nor an interruption changes what is tried.  Each batch
is added to ``trials.jsonl``; a search that was interrupted goes on.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import TypeAdapter

from features.protocols import folds_of
from pipelines.learn.evaluate import evaluate
from pipelines.learn.parallel import parallel
from pipelines.learn.training_data import TrainingData
from pipelines.report.results import Progress, as_json
from terrain.classify.folds import Fold, inner_splits, units_of
from terrain.classify.held_out import Examples
from terrain.classify.metrics import Difference, Outcome, accuracy_interval, compare_outcomes
from terrain.classify.svm import CANDIDATES, Candidate, GroupedSVC
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.files.names import printable

BATCH = 4  #: Trials that are suggested together; a batch does not depend on how many are computed at once

SPACE = {"C": (0.3, 300.0), "gamma": (0.03, 3.0), "percentile": (40.0, 100.0)}
"""C and gamma are searched on a logarithmic scale."""

N_INNER_FOLDS = 5
BEST_FILE, TRIALS_FILE, STUDY_FILE = "best.json", "trials.jsonl", "search.json"
VERSION = 1


class Trial(NamedTuple):
    """Hyper-parameters, and the accuracy on inner folds with its 95 % interval over sessions or runs."""

    params: Candidate
    accuracy: float
    accuracy_ci: tuple[float, float]


class SearchResult(NamedTuple):
    """A finished search."""

    #: trials, resumed: candidates that were tried, and how many of them lay there already
    trials: int
    resumed: int
    best: Trial  #: the most accurate on inner folds
    #: accuracy on the runs that were held out of the search: ``a`` the default choice, ``b`` the best
    held_out: Difference
    held_out_runs: tuple[str, ...]  #: these runs
    params_file: Path  #: for ``--params``


def search(
    data: TrainingData, n_trials: int, folder: Path, seed: int, n_jobs: int, progress: Progress
) -> SearchResult:
    """Search hyper-parameters, or go on with a search.

    Parameters
    ----------
    data : labelled windows by their features
    n_trials : candidates that are tried
    folder : of the trials and the result
    seed : deals runs into folds, and of what is suggested
    n_jobs : processes at once
    progress : called as trials are done

    Raises
    ------
    ConfigError
        if optuna is not installed, or the folder holds a search of other data, settings or another version.
    LogError
        if the folder is damaged.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ConfigError("--search needs optuna: pip install 'terrain-slip[sweep]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    samples = data.samples
    examples = Examples(data.features, samples.terrain, samples.group)
    outer = folds_of(samples, "grouped", 1, seed)[0]
    first = data.recipe[0]
    made_of = [dict(first.layout_.channels), dict(first.layout_.rate_hz), first.length_s_, samples.gap]
    content = {"version": VERSION, "space": SPACE, "data_digest": data.digest, "seed": seed, "cut": made_of}
    trials = _begin(folder, json.dumps(as_json(content), indent=2, sort_keys=True) + "\n")
    resumed = len(trials)
    kept = Examples(*(part[outer.train] for part in examples))
    progress("trials", resumed, n_trials)
    while len(trials) < n_trials:
        suggested = _suggest(optuna, trials, n_trials, seed)
        each = [(params,) for params in suggested]
        for trial in parallel(_tried, (kept, samples.gap, seed), each, n_jobs):
            trials.append(trial)
            progress("trials", len(trials), n_trials)
        lines = "".join(json.dumps(as_json(trial)) + "\n" for trial in trials)
        atomic_write(folder / TRIALS_FILE, lines)
    best = max(trials[:n_trials], key=lambda trial: trial.accuracy)
    default, found = (  # on runs that no trial has seen
        Outcome.of(evaluate(GroupedSVC(of, gap=samples.gap, seed=seed), examples, [outer]), samples.unit)
        for of in (CANDIDATES, (best.params,))
    )
    held_out = compare_outcomes(default, found, np.random.default_rng(seed)).accuracy
    runs = tuple(np.unique(samples.run_id[outer.test]).tolist())
    result = SearchResult(len(trials), resumed, best, held_out, runs, folder / BEST_FILE)
    document = {"version": VERSION, "data_digest": data.digest, "held_out": held_out, **best._asdict()}
    atomic_write(result.params_file, json.dumps(as_json(document), indent=2) + "\n")
    return result


def _begin(folder: Path, text: str) -> list[Trial]:
    """Return the trials that lie in the folder of the same search; make the folder otherwise."""
    file, lines = folder / STUDY_FILE, folder / TRIALS_FILE
    if not file.exists():
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(f"{folder}: holds other files than those of a search")
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(file, text)
        return []
    if file.read_text(encoding="utf-8") != text:
        raise ConfigError(
            f"{folder}: holds a search of other runs, settings or another version: name another --trials"
        )
    try:
        adapter = TypeAdapter(Trial)
        return [adapter.validate_json(line) for line in lines.read_text(encoding="utf-8").splitlines()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise LogError(f"{lines}: is damaged ({printable(str(error).splitlines()[0])[:200]})") from error


def _suggest(optuna: Any, trials: Sequence[Trial], n_trials: int, seed: int) -> list[Candidate]:
    """Return the next batch: it depends on the trials before it and on the seed, and on nothing else."""
    drawn = int.from_bytes(hashlib.sha256(f"{seed} {len(trials)}".encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(seed=drawn, n_startup_trials=2 * BATCH, constant_liar=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    distributions: Mapping[str, Any] = {
        name: optuna.distributions.FloatDistribution(low, high, log=name != "percentile")
        for name, (low, high) in SPACE.items()
    }
    for trial in trials:
        of = {"params": trial.params._asdict(), "distributions": distributions, "value": trial.accuracy}
        study.add_trial(optuna.trial.create_trial(**of))
    asked = [study.ask(distributions).params for _ in range(min(BATCH, n_trials - len(trials)))]
    return [Candidate(**{name: float(f"{value:.4g}") for name, value in each.items()}) for each in asked]


def _tried(examples: Examples, gap: int, seed: int, params: Candidate) -> Trial:
    """Return the accuracy of one candidate on inner folds of whole runs."""
    _, terrain, group = examples
    splits = inner_splits(terrain, group, N_INNER_FOLDS, seed, gap)
    folds = [Fold(0, number, *rows) for number, rows in enumerate(splits)]
    held_out = evaluate(GroupedSVC((params,), gap=gap, seed=seed), examples, folds)
    known = held_out.tested
    correct = held_out.correct[0, known]
    unit = units_of(terrain, group)[known]
    interval = accuracy_interval(correct * 1.0, unit, terrain[known], np.random.default_rng(seed))
    return Trial(params, float(correct.mean()), interval)
