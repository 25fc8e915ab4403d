"""Blind trials of the diagnosis over many processes: see :mod:`terrain.discrepancy.trials`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from pydantic import field_validator

from pipelines.report.settings import Settings, setting
from pipelines.reporting.progress import Progress, silent
from terrain.discrepancy.trials.rows import Row
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from terrain.discrepancy.trials.hidden_effects import Case
    from terrain.discrepancy.trials.scoring import Score
    from terrain.discrepancy.trials.trial import Trial


class TrialsSettings(Settings):
    """Blind trials: how many of which kind."""

    n: int = setting(
        100,
        "Trials of each row; row 'found' takes the effects in turn, 50 trials a round, and gives a result "
        "after 5 rounds.",
        ge=1,
    )
    seed: int = setting(0, "Of all that is drawn.", ge=0)
    rows: tuple[str, ...] = setting(
        tuple(row.value for row in Row), "Kinds of trials, by commas.", separated=True
    )
    runs: int = setting(8, "Runs of each trial; 80 of 6 s in rows short and known.")
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    @field_validator("rows")
    @classmethod
    def _check_rows(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        if not rows or len(set(rows)) < len(rows) or set(rows) - set(Row):
            raise ValueError(f"--rows is {','.join(rows)!r}; some of {','.join(Row)} are required, each once")
        return rows

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs or os.cpu_count() or 1


class Seconds(NamedTuple):
    """Duration of a diagnosis."""

    median: float
    worst: float


@dataclass(frozen=True, slots=True, eq=False)
class TrialsResult:
    """Result of ``terrain explain-trials``.

    Parameters
    ----------
    n, seed, rows, runs : as in the settings
    table : scores by name
    found_from : by robot and effect, the amplitude over the detection limit from which nine in ten are found
    seconds : that a diagnosis took
    trials : every single one
    """

    n: int
    seed: int
    rows: tuple[str, ...]
    runs: int
    table: Mapping[str, Score]
    found_from: Mapping[str, Mapping[str, float]]
    seconds: Seconds
    trials: tuple[Trial, ...]


def run_trials(cases: Sequence[Case], n_jobs: int = 1, progress: Progress = silent) -> list[Trial]:
    """Return the trials of all cases, in their order."""
    from joblib import Parallel, delayed

    from terrain.discrepancy.trials.hidden_effects import Case
    from terrain.discrepancy.trials.trial import run_trial

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
    import numpy as np

    from terrain.discrepancy.preparation import MIN_RUNS
    from terrain.discrepancy.trials.hidden_effects import cases_of
    from terrain.discrepancy.trials.scoring import found_from, table_of

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


def print_explain_trials(result: TrialsResult, console: Console) -> None:
    """Print how often blind trials came out right, beside the bars, and how small an effect is found."""
    from pipelines.reporting.numbers import percent
    from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column

    table = compact_table(text_column("figure"), *number_columns("of", "rate", "95 %"), "required", "met")
    for name, score in result.table.items():
        table.add_row(
            name,
            f"{score.hits}/{score.of}",
            percent(score.rate),
            f"{score.low:.1%} to {score.high:.1%}",
            score.bar,
            ("yes" if score.met else "no") if score.bar else "",
        )
    console.print(table)
    if Row.FOUND in result.rows:
        _print_found(result, console)
    seconds = result.seconds
    line = (
        f"{len(result.trials)} trials of {result.runs} runs, seed {result.seed}; a diagnosis took "
        f"{seconds.median:.2f} s (median), {seconds.worst:.2f} s (worst)"
    )
    print_lines(console, (line,))


def _print_found(result: TrialsResult, console: Console) -> None:
    from pipelines.reporting.numbers import format_known
    from pipelines.reporting.terminal import compact_table, number_columns
    from terrain.discrepancy.trials.scoring import FOUND_TRIALS

    found = result.found_from
    names = sorted({effect for effects in found.values() for effect in effects})
    if not names:
        console.print(f"row found: no effect had {FOUND_TRIALS} trials; a larger --n is required")
        return
    table = compact_table("nine in ten are found from, over the limit", *number_columns(*found))
    for effect in names:
        table.add_row(effect, *(format_known(found[robot].get(effect), "{:.2f}", "") for robot in found))
    console.print(table)
