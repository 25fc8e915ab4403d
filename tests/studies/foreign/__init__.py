"""Foreign worlds as examiners: effects hidden in simulators that share no equation with the package.

A plain simulator (:mod:`studies.foreign.physics`) and scenes of MuJoCo with contacts of its own
(:mod:`studies.foreign.scenes`, by ``pip install mujoco``) drive robots whose descriptions ``terrain explain`` has
calibrated; something changes, and it is asked what.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.util import find_spec

import numpy as np
from pydantic import field_validator

from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, Names, setting
from pipelines.report.tree import Column, Report, Table
from studies.blind_trials.scoring import Score
from studies.foreign.scoring import FALSE, by_effect, table_of
from studies.foreign.trial import ROWS, Case, ForeignTrial, cases_of, run_case
from terrain.errors import ConfigError

EXAMPLE = "python tests/studies foreign --n 40 --seed 4001 --rows plain_skid,nothing"


class Settings(JobsSettings):
    """Trials in foreign worlds: how many of which kind."""

    n: int = setting(20, "Trials of each row; a row takes the effects of its world in turn.", ge=1)
    seed: int = setting(0, "Of all that is drawn.", ge=0)
    rows: Names = setting(("plain_skid", "plain_car", "plain_swerve", "plain_omni", "nothing"), "By commas.")

    @field_validator("rows")
    @classmethod
    def _check_rows(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        if not rows or len(set(rows)) < len(rows) or set(rows) - set(ROWS):
            raise ValueError(
                f"--rows is {','.join(rows)!r}; some of {','.join(ROWS)} are required, each once"
            )
        return rows


class ForeignResult(Result):
    """Scores of trials in foreign worlds, with every single one."""

    n: int = described("trials of each row")
    seed: int = described("of all that was drawn")
    rows: tuple[str, ...] = described("kinds of trials")
    table: Mapping[str, Score] = described("scores by name")
    seconds: tuple[float, float] = described("that a trial took: median, longest", "s")
    trials: tuple[ForeignTrial, ...] = described("every single one")


def run(settings: Settings, progress: Progress = silent) -> ForeignResult:
    """Run trials in foreign worlds and return their scores; a trial depends on the seed, its row and its number.

    Raises
    ------
    ConfigError
        if rows of MuJoCo are asked for and it is not installed.
    """
    from joblib import Parallel, delayed

    if any(row.startswith("mujoco_") for row in settings.rows) and not find_spec("mujoco"):
        raise ConfigError("rows of MuJoCo's scenes need the package mujoco, which is not installed")
    cases: list[Case] = [case for row in settings.rows for case in cases_of(row, settings.n, settings.seed)]
    cases.sort(key=lambda case: (case.engine, case.world))  # a process calibrates few worlds
    trials: list[ForeignTrial] = []
    size = max(len(cases) // (4 * settings.jobs), 1)
    results: Iterable[ForeignTrial] = Parallel(settings.jobs, return_as="generator", batch_size=size)(
        delayed(run_case)(case) for case in cases
    )
    for trial in results:
        trials.append(trial)
        progress("trials", len(trials), len(cases))
    seconds = [trial.seconds for trial in trials]
    return ForeignResult(
        n=settings.n,
        seed=settings.seed,
        rows=settings.rows,
        table=table_of(trials),
        seconds=(float(np.median(seconds)), max(seconds)),
        trials=tuple(trials),
    )


def report(result: ForeignResult) -> Report:
    """Return how often answers came out right, beside the bars, and by effect."""
    barred = [score for score in result.table.values() if score.bar]
    columns = ("figure", "of", Column("rate", ".1%"), Column("95 %", ".1%"), "required", "met")
    rows = tuple(
        (
            *(name, f"{one.hits}/{one.of}", one.rate, (one.low, one.high), one.bar),
            ("yes" if one.met else "no") if one.bar else "",
        )
        for name, one in result.table.items()
    )
    effects = Table(("world", "hidden", "trials", "answers"), tuple(by_effect(result.trials)))
    false = tuple(
        (f"{t.engine} {t.world}", t.number, t.effect or "nothing", f"{t.size:.4g}", _answer_text(t))
        for t in result.trials
        if t.outcome in FALSE or (not t.effect and t.outcome != "silent")
    )
    return Report(
        "Trials in foreign worlds",
        f"{sum(bool(score.met) for score in barred)} of {len(barred)} required rates are met in {len(result.trials)} "
        f"trials, seed {result.seed}; one took {result.seconds[0]:.1f} s (median).",
        parts=[Table(columns, rows), effects, Table(("world", "number", "hidden", "size", "answer"), false)],
    )


def _answer_text(trial: ForeignTrial) -> str:
    answer = trial.answer
    values = ", ".join(f"{name} {value[0]:.3g}" for name, value in answer.named.items())
    sets = "; ".join(" or ".join(names) for names in answer.sets)
    parts = values, sets, ", ".join(answer.varying), "; ".join(answer.faults), answer.refusal
    return " | ".join(part for part in parts if part) or ", ".join((*answer.unexplained, *answer.learned))
