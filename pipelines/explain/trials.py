"""Blind trials of the diagnosis over many processes: see :mod:`terrain.discrepancy.trials`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pipelines.explain.results import Seconds, TrialsResult
from pipelines.explain.settings import TrialsSettings
from pipelines.reporting.progress import Progress, silent
from terrain.discrepancy.preparation import MIN_RUNS
from terrain.discrepancy.trials.hidden_effects import Case, cases_of
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.trials.scoring import found_from, table_of
from terrain.discrepancy.trials.trial import Trial, run_trial
from terrain.errors import ConfigError


def run_trials(cases: Sequence[Case], n_jobs: int = 1, progress: Progress = silent) -> list[Trial]:
    """Return the trials of all cases, in their order."""
    from joblib import Parallel, delayed

    for name in dict.fromkeys(case.robot for case in cases):  # compile once, before workers start
        run_trial(Case(Row.NONE, 0, name, cases[0].n_runs, cases[0].seed))
    trials: list[Trial] = []
    jobs = (delayed(run_trial)(case) for case in cases)
    results: Iterable[Trial] = Parallel(n_jobs=n_jobs, return_as="generator", batch_size=4)(jobs)
    for trial in results:
        trials.append(trial)
        progress("trials", len(trials), len(cases))
    return trials


def explain_trials(settings: TrialsSettings, progress: Progress = silent) -> TrialsResult:
    """Run blind trials and return their scores, with every single trial.

    A trial depends on the seed, its row, its number and the number of runs only.

    Raises
    ------
    ConfigError
        for too few runs.
    """
    if settings.runs < MIN_RUNS:
        raise ConfigError(f"--runs is {settings.runs}; at least {MIN_RUNS} are required, to hold some out")
    cases = [
        case for row in settings.rows for case in cases_of(Row(row), settings.n, settings.seed, settings.runs)
    ]
    trials = run_trials(cases, settings.jobs, progress)
    seconds = [trial.seconds for trial in trials]
    return TrialsResult(
        n=settings.n,
        seed=settings.seed,
        rows=settings.rows,
        runs=settings.runs,
        table=table_of(trials),
        found_from=found_from(trials),
        seconds=Seconds(float(np.median(seconds)), max(seconds)),
        trials=tuple(trials),
    )
