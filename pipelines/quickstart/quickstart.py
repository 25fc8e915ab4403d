"""``terrain quickstart``: import or simulate, cross-validate, train, predict, and a report, in one go."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pipelines.crossval.crossval import crossval, merge_notes
from pipelines.crossval.settings import CrossvalSettings
from pipelines.data.convert import ImportResult
from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import data_digest, load_runs
from pipelines.data.duplicates import distinct_runs
from pipelines.estimate.consistency import TerrainConsistency
from pipelines.quickstart.holding_out import divide
from pipelines.quickstart.results import KeptRuns, QuickstartResult
from pipelines.quickstart.settings import QuickstartSettings
from pipelines.reporting.progress import Progress, silent
from terrain.errors import DataError
from terrain.estimation.labelled import TerrainSlip
from terrain.files.atomic import atomic_folder, atomic_write, ensure_writable
from terrain.logs.write import write_run
from terrain.records import RunLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT_FILE = "report.html"
SIMULATED = "simulated AgriMaRo"


class _Source(NamedTuple):
    """The runs, and what is known of them because they were simulated."""

    runs: list[RunLog]
    slip: tuple[TerrainSlip, ...] | None
    consistency: tuple[TerrainConsistency, ...] | None
    figures: dict[str, Figure]


def quickstart(
    settings: QuickstartSettings,
    progress: Progress = silent,
    evaluation: CrossvalSettings | None = None,
    runs_a_terrain: int | None = None,
) -> QuickstartResult:
    """Evaluate, train and apply a classifier, on a folder of labelled runs or on simulated ones.

    Parameters
    ----------
    settings : where runs are read, and where runs (``out/runs``) and report (``out/report.html``) go; without
        data, runs are simulated and filtered (:mod:`terrain.estimation.labelled`); where there are enough,
        some are held out, and these are predicted
    progress : called as the work goes on
    evaluation : how the recipe is evaluated; ``settings.evaluation`` by default
    runs_a_terrain : simulated runs of each terrain
    """
    from pipelines.crossval_figures.figures import all_figures
    from pipelines.data.tracking import ensure_tracking
    from pipelines.learn.load import load_model
    from pipelines.learn.predict import predict
    from pipelines.learn.train import train
    from pipelines.quickstart.page import html_report
    from terrain.control.slip_table import load_slip_table

    began_s = time.monotonic()
    evaluation = evaluation or settings.evaluation
    data, out = settings.data, settings.out
    ensure_writable(out)
    ensure_tracking()
    runs, slip, consistency, figures = (
        _simulated(evaluation, runs_a_terrain, progress)
        if data is None
        else _Source(load_runs(data), None, None, {})
    )
    _refuse_other_runs(runs, data, out / "runs")
    distinct = distinct_runs(runs, merge=settings.merge_duplicates)
    runs = distinct.runs
    dataset = SIMULATED if data is None else data.resolve().name
    training, held_out = divide(runs)
    report = crossval(training, evaluation, progress).named(dataset, data_digest(training))
    report = replace(report, notes=(*merge_notes(distinct.merged), *report.notes))
    imported = _keep(runs, data, out / "runs", progress)
    trained = train(training, settings.training(evaluation), dataset, progress)
    model_uri = trained.model_uri
    progress("predict", 0, 1)
    predicted = predict(held_out or runs, load_model(model_uri), load_slip_table())
    progress("predict", 1, 1)
    result = QuickstartResult(
        dataset=dataset,
        data_digest=trained.data_digest,
        commit=trained.commit,
        seed=evaluation.seed,
        crossval=report,
        train=trained,
        predict=predicted,
        imported=imported,
        slip=slip,
        consistency=consistency,
        commands=_commands(settings, evaluation.seed, model_uri, runs_a_terrain, held_out),
        held_out=tuple(run.run_id for run in held_out),
        report=out / REPORT_FILE,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        elapsed_s=time.monotonic() - began_s,
    )
    progress("report", 0, 1)
    pictures = all_figures(report, trained.importance)  # type: ignore[arg-type]
    atomic_write(result.report, html_report(result, {**figures, **pictures}))
    progress("report", 1, 1)
    return result


def _simulated(evaluation: CrossvalSettings, runs_a_terrain: int | None, progress: Progress) -> _Source:
    from pipelines.estimate.consistency import RUNS_A_SCENARIO, consistency_by_terrain
    from pipelines.estimate.figures import motion_figure, slip_figure
    from terrain.estimation.labelled import ROBOT, RUNS_A_TERRAIN, labelled_runs
    from terrain.robots import load_robot

    seed, n_jobs = evaluation.seed, evaluation.n_jobs
    runs, slip, example = labelled_runs(seed, runs_a_terrain or RUNS_A_TERRAIN, progress)
    n_runs = min(runs_a_terrain or RUNS_A_SCENARIO, RUNS_A_SCENARIO)
    consistency = consistency_by_terrain(load_robot(ROBOT), seed, n_runs, progress=progress, n_jobs=n_jobs)
    figures = {"slip": slip_figure(example), "motion": motion_figure(example)}
    return _Source(runs, slip, consistency, figures)


def _commands(
    settings: QuickstartSettings,
    seed: int,
    model_uri: str,
    runs_a_terrain: int | None,
    held_out: Sequence[RunLog],
) -> tuple[str, ...]:
    """Return what to type for the same, step by step."""
    data, steps = settings.data, []
    names = shlex.quote(",".join(run.run_id for run in held_out))
    without, only = (f" --without {names}", f" --only {names}") if held_out else ("", "")
    if data is None:
        from terrain.estimation.labelled import FILTER, ROBOT, RUNS_A_TERRAIN, SCENARIO

        data = settings.out / "runs"
        steps = [
            f"terrain simulate --robot {ROBOT} --terrain all --scenario {SCENARIO} "
            f"--runs {runs_a_terrain or RUNS_A_TERRAIN} --vary --seed {seed} --out LOGS",
            f"terrain estimate --data LOGS --filter {FILTER} --out {data}",
        ]
    return (
        *steps,
        f"terrain crossval --data {data} --protocol grouped --seed {seed}{without}",
        f"terrain train --data {data} --name {settings.name} --seed {seed}{without}",
        f"terrain predict --model {model_uri} --data {data}{only}",
    )


def _refuse_other_runs(runs: list[RunLog], data: Path | None, folder: Path) -> None:
    if folder.exists() and data_digest(load_runs(folder)) != data_digest(runs):
        raise DataError(f"{folder}: holds other runs than {data or 'this simulation'}; choose another --out")


def _keep(runs: list[RunLog], data: Path | None, folder: Path, progress: Progress) -> KeptRuns:
    """Write run folders into ``folder``; earlier ones of the same data are used as they are."""
    if folder.exists():
        progress("write runs", len(runs), len(runs))
        return KeptRuns(folder, len(runs), reused=True)
    if data is not None:
        imported = convert(ConvertSettings(data=data, out=folder), progress)
        assert isinstance(imported, ImportResult)
        return KeptRuns(folder, len(runs), reused=False, imported=imported)
    with atomic_folder(folder) as unfinished:
        for number, run in enumerate(runs, 1):
            write_run(run, unfinished)
            progress("write runs", number, len(runs))
    return KeptRuns(folder, len(runs), reused=False)
