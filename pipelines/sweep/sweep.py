"""``terrain sweep``: hyper-parameters of the SVM, chosen on inner folds of whole runs.

One fold of whole runs is held out before the search and never seen by it; on it the result is compared with
the default choice.  Trials are suggested in batches by a tree-structured Parzen estimator (optuna) whose seed
is that of the batch, so that neither the number of processes nor an interruption changes what is tried.  Each
batch is added to ``trials.jsonl``; nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.crossval.crossval import samples_of
from pipelines.crossval.evaluation import Examples
from pipelines.crossval.extras import examples_of
from pipelines.crossval.splits import folds_of
from pipelines.data.datasets import data_digest
from pipelines.learn.parallel import parallel
from pipelines.learn.recipes import feature_matrix
from pipelines.models.params_file import BEST_FILE, SvmParams, write_params
from pipelines.reporting.progress import Progress, silent
from pipelines.sweep.settings import SweepSettings
from terrain.bootstrap import percentile_interval
from terrain.classify.confidence import run_weights
from terrain.classify.inner import inner_splits
from terrain.classify.paired import Difference, Outcome, compare_outcomes
from terrain.classify.svm import GroupedSVC
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.records import Array, RunLog

BATCH = 4
"""Trials that are suggested together; a batch does not depend on how many are computed at once."""

SPACE = {"C": (0.3, 300.0), "gamma": (0.03, 3.0), "percentile": (40.0, 100.0)}
"""C and gamma are searched on a logarithmic scale."""

N_INNER_FOLDS = 5
TRIALS_FILE, STUDY_FILE = "trials.jsonl", "sweep.json"
VERSION = 1
N_DRAWS = 1000


class Trial(NamedTuple):
    """Hyper-parameters, and the accuracy on inner folds with its 95 % interval over runs."""

    params: SvmParams
    accuracy: float
    accuracy_ci: tuple[float, float]


class SweepReport(NamedTuple):
    """A finished search.

    Parameters
    ----------
    dataset, data_digest : of the runs
    trials, resumed : candidates that were tried, and how many of them lay there already
    best : the most accurate on inner folds
    held_out : accuracy on the runs that were held out of the search: ``a`` the default choice, ``b`` the best
    held_out_runs : these runs
    params_file : for ``--params``
    """

    dataset: str
    data_digest: str
    trials: int
    resumed: int
    best: Trial
    held_out: Difference
    held_out_runs: tuple[str, ...]
    params_file: Path


def sweep(
    runs: Sequence[RunLog], settings: SweepSettings, dataset: str, progress: Progress = silent
) -> SweepReport:
    """Search hyper-parameters, or go on with a search.

    Parameters
    ----------
    runs : labelled runs
    settings : windows, seed, number of trials, folder
    dataset : name of the data, for the record
    progress : called as trials are done

    Raises
    ------
    ConfigError
        if the recipe has other hyper-parameters, optuna is not installed, or the folder holds a search of
        other data, settings or another version.
    LogError
        if the folder is damaged.
    """
    if settings.recipe != "svm":
        raise ConfigError(f"terrain sweep searches hyper-parameters of 'svm', not of {settings.recipe!r}")
    optuna = _optuna()
    samples = samples_of(runs, settings.evaluation)
    examples = examples_of(feature_matrix(settings.new_recipe(), samples.cut.windows), samples)
    outer = folds_of(samples, "grouped", 1, settings.seed)[0]
    digest = data_digest(runs)
    trials = _begin(settings, digest)
    resumed = len(trials)
    kept = Examples(*(part[outer.train] for part in examples))
    shared = (kept, samples.gap, settings.seed)
    progress("trials", len(trials), settings.trials)
    while len(trials) < settings.trials:
        suggested = _suggest(optuna, trials, settings)
        for trial in parallel(_evaluate, shared, ((params,) for params in suggested), settings.jobs):
            trials.append(trial)
            progress("trials", len(trials), settings.trials)
        text = "".join(json.dumps(_as_line(trial)) + "\n" for trial in trials)
        atomic_write(settings.out / TRIALS_FILE, text)
    best = max(trials[: settings.trials], key=lambda trial: trial.accuracy)
    held_out = _held_out(examples, outer.train, outer.test, best.params, samples.gap, settings.seed)
    report = SweepReport(
        dataset,
        digest,
        len(trials),
        resumed,
        best,
        held_out,
        tuple(np.unique(samples.group[outer.test].astype(str)).tolist()),
        settings.out / BEST_FILE,
    )
    figures = {"accuracy": best.accuracy, "accuracy_ci": best.accuracy_ci, "held_out": held_out._asdict()}
    write_params(report.params_file, best.params, {"dataset": dataset, "data_digest": digest, **figures})
    return report


def _optuna() -> Any:
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ConfigError("terrain sweep needs optuna: pip install 'terrain-slip[sweep]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


def _begin(settings: SweepSettings, digest: str) -> list[Trial]:
    """Return the trials that lie in the folder of the same search; make the folder otherwise."""
    out = settings.out
    shared = {name: value for name, value in settings.shared().items() if name not in ("n_jobs", "repeats")}
    content = {"version": VERSION, "space": SPACE, "data_digest": digest, "settings": shared}
    text = json.dumps(content, indent=2, sort_keys=True, default=str) + "\n"
    file, lines = out / STUDY_FILE, out / TRIALS_FILE
    if not file.exists():
        if out.exists() and any(out.iterdir()):
            raise ConfigError(f"{out}: holds other files than those of a search")
        out.mkdir(parents=True, exist_ok=True)
        atomic_write(file, text)
        return []
    if file.read_text(encoding="utf-8") != text:
        raise ConfigError(
            f"{out}: holds a search of other runs, settings or another version: name another folder"
        )
    try:
        found = [_of_line(json.loads(line)) for line in lines.read_text(encoding="utf-8").splitlines()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise LogError(f"{lines}: is damaged ({error})") from error
    return found


def _as_line(trial: Trial) -> dict[str, Any]:
    return {"params": trial.params._asdict(), "accuracy": trial.accuracy, "accuracy_ci": trial.accuracy_ci}


def _of_line(line: Any) -> Trial:
    low, high = line["accuracy_ci"]
    return Trial(SvmParams(**line["params"]), float(line["accuracy"]), (float(low), float(high)))


def _suggest(optuna: Any, trials: Sequence[Trial], settings: SweepSettings) -> list[SvmParams]:
    """Return the next batch: it depends on the trials before it and on the seed, and on nothing else."""
    seed = int.from_bytes(hashlib.sha256(f"{settings.seed} {len(trials)}".encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=2 * BATCH, constant_liar=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    distributions = {
        name: optuna.distributions.FloatDistribution(low, high, log=name != "percentile")
        for name, (low, high) in SPACE.items()
    }
    for trial in trials:
        study.add_trial(
            optuna.trial.create_trial(
                params=trial.params._asdict(), distributions=distributions, value=trial.accuracy
            )
        )
    asked = [study.ask(distributions).params for _ in range(min(BATCH, settings.trials - len(trials)))]
    return [SvmParams(**{name: float(f"{value:.4g}") for name, value in each.items()}) for each in asked]


def _evaluate(examples: Examples, gap: int, seed: int, params: SvmParams) -> Trial:
    """Return the accuracy of one candidate on inner folds of whole runs."""
    correct = np.full(len(examples.terrain), np.nan)
    for train, test in inner_splits(examples.terrain, examples.group, N_INNER_FOLDS, seed, gap):
        fitted = _fit((params,), examples, train, gap, seed)
        correct[test] = fitted.predict(examples.features[test]) == examples.terrain[test]
    known = np.isfinite(correct)
    weights = run_weights(
        examples.group[known].astype(str), examples.terrain[known], N_DRAWS, np.random.default_rng(seed)
    )
    draws = weights @ correct[known] / weights.sum(axis=1)
    return Trial(params, float(correct[known].mean()), percentile_interval(draws))


def _fit(candidates: Sequence[SvmParams], examples: Examples, rows: Array, gap: int, seed: int) -> GroupedSVC:
    classifier = GroupedSVC(candidates, gap=gap, seed=seed) if candidates else GroupedSVC(gap=gap, seed=seed)
    return classifier.fit(examples.features[rows], examples.terrain[rows], groups=examples.group[rows])


def _held_out(
    examples: Examples, train: Array, test: Array, best: SvmParams, gap: int, seed: int
) -> Difference:
    """Return the accuracy of the default choice and of the best candidate on runs that no trial has seen."""
    outcomes = []
    for candidates in ((), (best,)):
        fitted = _fit(candidates, examples, train, gap, seed)
        probability = fitted.predict_proba(examples.features[test])
        predicted = fitted.classes_[probability.argmax(axis=1)]
        outcomes.append(
            Outcome(
                examples.group[test].astype(str),
                examples.terrain[test],
                (predicted == examples.terrain[test])[None],
                probability.max(axis=1)[None],
            )
        )
    return compare_outcomes(outcomes[0], outcomes[1], np.random.default_rng(seed)).accuracy
