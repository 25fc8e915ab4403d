"""Blind trials of the diagnosis over many processes: effects are hidden in simulated runs, diagnosed and counted.

The trials themselves are those of :mod:`studies.blind_trials`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from pydantic import field_validator

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, Names, setting
from pipelines.report.tree import Column, Report, Table, Text
from studies.blind_trials.scoring import FOUND_TRIALS, Score, found_from, table_of
from studies.blind_trials.trial import Case, Row, Trial, cases_of, run_trial
from terrain.discrepancy.diagnose import MIN_RUNS
from terrain.errors import ConfigError

EXAMPLE = "python tests/studies trials --n 100 --seed 2211 --rows none,strong"


class Settings(JobsSettings):
    """Blind trials: how many of which kind."""

    n: int = setting(
        100,
        "Trials of each row; row 'found' takes the effects in turn, 50 trials a round, and gives a result "
        "after 5 rounds.",
        ge=1,
    )
    seed: int = setting(0, "Of all that is drawn.", ge=0)
    rows: Names = setting(tuple(row.value for row in Row), "Kinds of trials, by commas.")
    runs: int = setting(8, "Runs of each trial; 80 of 6 s in rows short and known.")

    @field_validator("rows")
    @classmethod
    def _check_rows(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        if not rows or len(set(rows)) < len(rows) or set(rows) - set(Row):
            raise ValueError(f"--rows is {','.join(rows)!r}; some of {','.join(Row)} are required, each once")
        return rows


class TrialsResult(Result):
    """Scores of blind trials, with every single one."""

    n: int = described("trials of each row")
    seed: int = described("of all that was drawn")
    rows: tuple[str, ...] = described("kinds of trials")
    runs: int = described("runs of each trial")
    table: Mapping[str, Score] = described("scores by name")
    found_from: Mapping[str, Mapping[str, float]] = described(
        "by robot and effect, the amplitude over the detection limit from which nine in ten are found"
    )
    seconds: tuple[float, float] = described("that a diagnosis took: median, longest", "s")
    trials: tuple[Trial, ...] = described("every single one")


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


def run(settings: Settings, progress: Progress = silent) -> TrialsResult:
    """Run blind trials and return their scores, with every single trial.

    A trial depends on the seed, its row, its number and the number of runs only.
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
        seconds=(float(np.median(seconds)), max(seconds)),
        trials=tuple(trials),
    )


def report(result: TrialsResult) -> Report:
    """Return how often blind trials came out right, beside the bars, and how small an effect is found."""
    barred = [score for score in result.table.values() if score.bar]
    n_met = sum(bool(score.met) for score in barred)
    columns = ("figure", "of", Column("rate", ".1%"), Column("95 %", ".1%"), "required", "met")
    rows = tuple(
        (
            *(name, f"{one.hits}/{one.of}", one.rate, (one.low, one.high), one.bar),
            ("yes" if one.met else "no") if one.bar else "",
        )
        for name, one in result.table.items()
    )
    parts: list[Table | Text] = [Table(columns, rows)]
    if Row.FOUND in result.rows:
        parts.append(_found(result))
    return Report(
        "Blind trials of the diagnosis",
        f"{n_met} of {len(barred)} required rates are met in {len(result.trials)} trials of {result.runs} runs, seed "
        f"{result.seed}; a diagnosis took {result.seconds[0]:.2f} s (median), "
        f"{result.seconds[1]:.2f} s (worst).",
        parts=parts,
    )


def _found(result: TrialsResult) -> Table | Text:
    names = sorted({effect for effects in result.found_from.values() for effect in effects})
    if not names:
        return Text(f"row found: no effect had {FOUND_TRIALS} trials; a larger --n is required")
    robots = list(result.found_from)
    rows = tuple((name, *(result.found_from[robot].get(name) for robot in robots)) for name in names)
    columns = ("nine in ten are found from, over the limit", *(Column(robot, ".2f") for robot in robots))
    return Table(columns, rows)
