"""Quickstart: the whole job on your runs, or on simulated ones: slip, evaluation, training, prediction, a report.

One fold assignment and no check beside the headline, so that a first look is soon there; the commands that it
ends with give all figures.
"""

from __future__ import annotations

import math
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.report.figure import Figure
from pipelines.report.numbers import enumerated, format_value
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, setting
from pipelines.report.tree import Column, Report, Section, Table, Text
from terrain.errors import DataError

if TYPE_CHECKING:
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.predict import Predictions
    from pipelines.learn.train import TrainResult
    from pipelines.slip.labelled import TerrainSlip
    from terrain.records import RunLog

EXAMPLE = "terrain quickstart --data logs/"
REPORT_FILE = "report.html"
SIMULATED = "simulated AgriMaRo"
REPEATS = 1


class Settings(JobsSettings):
    """Which runs are used, where the report goes, and under which name the model is registered."""

    data: Path | None = setting(None, "Folder of labelled runs; without, runs are simulated.")
    robot: str | None = setting(None, "Robot of these runs, by name or its YAML file.")
    mapping: Path | None = setting(None, "YAML file that describes how to read them (docs/mapping.md).")
    out: Path = setting(Path("terrain-report"), "Folder of the runs and the report.")
    name: str = setting("quickstart", "Name of the registered model.")
    seed: int = setting(0, "Deals runs into folds; of the simulation, too.", ge=0)
    merge_duplicates: bool = setting(False)
    """Treat runs that hold the same measurements as one run instead of refusing them."""
    runs_a_terrain: int = setting(6, "Simulated runs of each terrain.", ge=2, option="--runs")


class QuickstartResult(Result):
    """Evaluation, model and predictions, and where they come from."""

    dataset: str = described("name of the data")
    data_digest: str = described("digest of the runs that were evaluated and trained on")
    commit: str = described("of the code")
    seed: int = described("of folds and simulation")
    crossval: CrossvalResult = described("evaluation on held-out runs")
    train: TrainResult = described("the registered model")
    predict: Predictions = described("of the runs that were held out")
    imported: Mapping[str, Any] = described("where the runs lie, and what reading them found")
    slip: tuple[TerrainSlip, ...] | None = described("estimated and true, by terrain; None of your own runs")
    commands: tuple[str, ...] = described("what to type for the same, step by step")
    report_file: Path = described("the page")
    held_out: tuple[str, ...] = described("runs that the model was neither evaluated nor trained on")
    figures: tuple[Figure, ...] = ()

    def as_json(self) -> Any:
        """Return the described fields; the evaluation is given once, beside the training."""
        found = super().as_json()
        del found["train"]["crossval"]
        return found


def run(settings: Settings, progress: Progress = silent) -> QuickstartResult:
    """Evaluate, train and apply a classifier, on a folder of labelled runs or on simulated ones.

    Runs go to ``out/runs``, the page to ``out/report.html``.  Where there are enough, some runs are held out, and
    these are predicted.
    """
    from pipelines.data.datasets import load
    from pipelines.data.settings import RunsSettings
    from pipelines.data.tracking import ensure_tracking
    from pipelines.learn.model_file import read_model
    from pipelines.learn.predict import predict
    from pipelines.learn.train import TrainingSettings, train
    from pipelines.learn.training_data import data_of_runs
    from terrain.classify.folds import hold_out_runs
    from terrain.control.slip_table import load_slip_table
    from terrain.files.atomic import ensure_writable
    from terrain.logs.duplicates import distinct_runs

    data, out = settings.data, settings.out
    reading: dict[str, Any] = {"robot": settings.robot, "mapping": settings.mapping}
    ensure_writable(out)
    ensure_tracking()
    with _compiling_ahead():
        given: Sequence[RunLog]
        slip, figures, doubts = None, tuple[Figure, ...](), list[str]()
        if data is None:
            # kernels are compiled when they are imported: meanwhile, not before
            from pipelines.slip.filtered import motion_figure, slip_figure
            from pipelines.slip.labelled import labelled_runs

            given, slip, example = labelled_runs(settings.seed, settings.runs_a_terrain, progress)
            figures = slip_figure(example), motion_figure(example)
        else:
            given, _, doubts = load(RunsSettings(data=data, **reading))
        runs, _ = distinct_runs(given, merge=settings.merge_duplicates)
        dataset = SIMULATED if data is None else data.resolve().name
        training, held_out = hold_out_runs(runs)
        kept = _keep(given, data, out / "runs", reading, progress)
        asked = TrainingSettings(
            name=settings.name, seed=settings.seed, n_jobs=settings.n_jobs, repeats=REPEATS
        )
        # without an evaluation given, that of the training shares its fits with the worth of the channels
        trained = train(data_of_runs(training, asked), asked, dataset, progress)
        predicted = predict(held_out or runs, read_model(trained.model_uri), load_slip_table())
    result = QuickstartResult.of(
        trained,
        settings,
        train=trained,
        predict=predicted,
        imported=kept,
        slip=slip,
        commands=_commands(settings, trained.model_uri, held_out),
        report_file=out / REPORT_FILE,
        held_out=tuple(each.run_id for each in held_out),
        figures=figures,
    ).with_doubts(doubts)
    result.report.save(result.report_file)
    return result


@contextmanager
def _compiling_ahead() -> Iterator[None]:
    """Have a process of its own compile the kernels that prediction needs, where they are not compiled yet."""
    words = [sys.executable, "-c", "import pipelines.live.windows"]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as ahead:
        try:
            yield
        finally:
            ahead.kill()


def _commands(settings: Settings, model_uri: str, held_out: Sequence[RunLog]) -> tuple[str, ...]:
    """Return what to type for the same, step by step, with all repeats and checks."""
    data, seed, steps = settings.data, settings.seed, []
    names = shlex.quote(",".join(run.run_id for run in held_out))
    without, only = (f" --without {names}", f" --only {names}") if held_out else ("", "")
    asked = (("--robot", settings.robot), ("--mapping", settings.mapping))
    reading = "".join(f" {option} {shlex.quote(str(each))}" for option, each in asked if each is not None)
    if data is None:
        from pipelines.slip.labelled import FILTER, ROBOT, SCENARIO

        data = settings.out / "runs"
        steps = [
            f"terrain simulate --robot {ROBOT} --terrain all --scenario {SCENARIO} "
            f"--runs {settings.runs_a_terrain} --vary --seed {seed} --out LOGS",
            f"terrain estimate --data LOGS --filter {FILTER} --out {data}",
        ]
    return (
        *steps,
        f"terrain crossval --data {data}{reading} --protocol grouped --seed {seed}{without}",
        f"terrain train --data {data}{reading} --name {settings.name} --seed {seed}{without}",
        f"terrain predict --model {model_uri} --data {data}{reading}{only}",
    )


def _keep(
    runs: Sequence[RunLog], data: Path | None, folder: Path, reading: Mapping[str, Any], progress: Progress
) -> dict[str, Any]:
    """Write run folders into ``folder``; earlier ones of the same data are used as they are, others refused."""
    from pipelines.data.datasets import load
    from pipelines.data.settings import RunsSettings
    from terrain.files.atomic import atomic_folder
    from terrain.logs.run_folders import data_digest, write_run

    kept = {"out": folder, "n_runs": len(runs), "reused": folder.exists()}
    if kept["reused"]:
        if data_digest(load(RunsSettings(data=folder, robot=reading["robot"]))[0]) != data_digest(runs):
            raise DataError(
                f"{folder}: holds other runs than {data or 'this simulation'}; choose another --out"
            )
        progress("write runs", len(runs), len(runs))
    elif data is not None:
        from pipelines.data import convert

        return vars(convert.run(convert.Settings(data=data, out=folder, **reading), progress)) | kept
    else:
        with atomic_folder(folder) as unfinished:
            for number, each in enumerate(runs, 1):
                write_run(each, unfinished)
                progress("write runs", number, len(runs))
    return kept


def report(result: QuickstartResult) -> Report:
    """Return the accuracy and what was predicted first; evaluation, training and slip are folded."""
    evaluation, training, predicted = result.crossval.report, result.train.report, result.predict.report
    first = evaluation.parts[:1]
    if result.slip is not None:
        columns = (
            *("terrain", "runs", Column("slip", "+.3f"), Column("true slip", "+.3f")),
            *(Column("RMSE", ".4f"), Column("NEES", ".2f")),
        )
        worst = max((row.slip_rmse for row in result.slip if math.isfinite(row.slip_rmse)), default=0.0)
        title = f"steady slip of the simulated runs, at most {format_value(worst, '.4f')} off"
        first = [Table(columns, [tuple(row) for row in result.slip], title=title)]
    predicted_runs = (
        f"Predictions are those of {enumerated(result.held_out)}, held out: the model was neither trained nor "
        "evaluated on them."
        if result.held_out
        else "The runs are too few to hold one out: predictions are those of training runs."
    )
    return replace(
        evaluation,
        title=f"From logs to slip: {result.dataset}",
        parts=[
            Section("", [Text(f"{result.train.verdict}."), Text(predicted_runs), Text(predicted.answer)]),
            *first,
            Text(f"report: {result.report_file}"),
        ],
        details=[
            *([Section("A run in detail", result.figures)] if result.figures else []),
            Section("Evaluation and training", [*training.parts, *training.details]),
            Section("Predictions", [*predicted.parts, *predicted.details]),
            Section("Step by step", [Text("\n".join(result.commands), "code")]),
        ],
        next_step=result.commands[-3],
    )
