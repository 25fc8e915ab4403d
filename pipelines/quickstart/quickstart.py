"""``terrain quickstart``: import or simulate, cross-validate, train, predict, and a report, in one go."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.classify.crossval import CrossvalSettings, crossval
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest, load_runs
from pipelines.runs.import_logs import import_logs
from terrain.errors import DataError
from terrain.files.atomic import atomic_folder, atomic_write, ensure_writable
from terrain.logs.write import write_run
from terrain.records import RunLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT_FILE = "report.html"
SIMULATED = "simulated AgriMaRo"


def quickstart(
    data: Path | None,
    out: Path,
    settings: CrossvalSettings,
    name: str,
    progress: Progress = silent,
    runs_a_terrain: int | None = None,
) -> dict[str, Any]:
    """Do the whole main job, on a folder of labelled runs or from nothing.

    Parameters
    ----------
    data : any readable layout; None to simulate runs and filter them (:mod:`pipelines.classify.labelled`)
    out : folder for the runs (``out/runs``) and the report (``out/report.html``)
    settings : recipe, windows and seed
    name : name of the registered model
    runs_a_terrain : of simulated runs

    Returns
    -------
    dict that JSON can hold
        ``dataset, crossval, train, predict, report, imported`` and where they come from; ``slip`` where runs
        were simulated.
    """
    from pipelines.classify.figures import all_figures
    from pipelines.classify.predict import predict
    from pipelines.classify.train import train
    from pipelines.models.tracking import ensure_tracking, load_model
    from pipelines.quickstart.report import html_report
    from terrain.control.slip_table import load_slip_table

    began_s = time.monotonic()
    ensure_writable(out)
    ensure_tracking()
    runs, slip, pictures = (
        _from_nothing(settings.seed, runs_a_terrain, progress)
        if data is None
        else (load_runs(data), None, {})
    )
    _refuse_other_runs(runs, data, out / "runs")
    dataset = SIMULATED if data is None else data.resolve().name
    report = {"dataset": dataset, "data_digest": data_digest(runs), **crossval(runs, settings, progress)}
    imported = _write(runs, data, out / "runs", progress)
    trained = train(runs, settings, name, dataset, progress, evaluation=report)
    progress("predict", 0, 1)
    predicted = predict(runs, load_model(trained["model_uri"]), load_slip_table())
    progress("predict", 1, 1)
    result = {
        "dataset": dataset,
        "data_digest": report["data_digest"],
        "commit": trained["commit"],
        "seed": settings.seed,
        "crossval": report,
        "train": {key: value for key, value in trained.items() if key != "crossval"},
        "predict": predicted,
        "imported": imported,
        "slip": slip,
        "commands": _commands(data, out, settings.seed, name, trained["model_uri"], runs_a_terrain),
        "report": str(out / REPORT_FILE),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "elapsed_s": time.monotonic() - began_s,
    }
    progress("report", 0, 1)
    figures = {**pictures, **all_figures(report, trained["importance"])}
    atomic_write(out / REPORT_FILE, html_report(result, figures))
    progress("report", 1, 1)
    return result


def _from_nothing(
    seed: int, runs_a_terrain: int | None, progress: Progress
) -> tuple[list[RunLog], list[dict[str, Any]], dict[str, Figure]]:
    from pipelines.classify.labelled import RUNS_A_TERRAIN, labelled_runs
    from pipelines.estimate.figures import motion_figure, slip_figure

    runs, rows, example = labelled_runs(seed, runs_a_terrain or RUNS_A_TERRAIN, progress)
    return runs, rows, {"slip": slip_figure(example), "motion": motion_figure(example)}


def _commands(
    data: Path | None, out: Path, seed: int, name: str, model_uri: str, runs_a_terrain: int | None
) -> list[str]:
    """Return what to type for the same, step by step."""
    steps = []
    if data is None:
        from pipelines.classify.labelled import FILTER, ROBOT, RUNS_A_TERRAIN, SCENARIO

        data = out / "runs"
        steps = [
            f"terrain simulate --robot {ROBOT} --terrain all --scenario {SCENARIO} "
            f"--runs {runs_a_terrain or RUNS_A_TERRAIN} --vary --seed {seed} --out LOGS",
            f"terrain estimate --data LOGS --filter {FILTER} --out {data}",
        ]
    return [
        *steps,
        f"terrain crossval --data {data} --protocol grouped --seed {seed}",
        f"terrain train --data {data} --name {name} --seed {seed}",
        f"terrain predict --model {model_uri} --data {data}",
    ]


def _refuse_other_runs(runs: list[RunLog], data: Path | None, folder: Path) -> None:
    if folder.exists() and data_digest(load_runs(folder)) != data_digest(runs):
        raise DataError(f"{folder}: holds other runs than {data or 'this simulation'}; choose another --out")


def _write(runs: list[RunLog], data: Path | None, folder: Path, progress: Progress) -> dict[str, Any]:
    """Write run folders into ``folder``; earlier ones of the same data are used as they lie."""
    if folder.exists():
        progress("write runs", len(runs), len(runs))
        return {"out": str(folder), "n_runs": len(runs), "reused": True}
    done: list[str] = []

    def show(run_id: str) -> None:
        done.append(run_id)
        progress("write runs", len(done), len(runs))

    if data is not None:
        return {**import_logs(data, folder, progress=show), "reused": False}
    with atomic_folder(folder) as unfinished:
        for run in runs:
            write_run(run, unfinished)
            show(run.run_id)
    return {"out": str(folder), "n_runs": len(runs), "reused": False}
