"""``terrain quickstart``: import, cross-validate, train, predict, and a report, in one go."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.crossval import CrossvalSettings, crossval
from pipelines.datasets import data_digest, load_runs
from pipelines.evaluation import Progress, silent
from pipelines.import_logs import import_logs
from terrain.atomic import atomic_write, ensure_writable
from terrain.errors import DataError
from terrain.records import RunLog

REPORT_FILE = "report.html"


def quickstart(
    data: Path, out: Path, settings: CrossvalSettings, name: str, progress: Progress = silent
) -> dict[str, Any]:
    """Do the whole main job on a folder of labelled runs.

    Parameters
    ----------
    data : any readable layout
    out : folder for the imported runs (``out/runs``) and the report (``out/report.html``)
    settings : recipe, windows and seed
    name : name of the registered model

    Returns
    -------
    dict that JSON can hold
        ``dataset, crossval, train, predict, report, imported`` and where they come from.
    """
    from pipelines.figures import all_figures
    from pipelines.predict import predict
    from pipelines.report import html_report
    from pipelines.tracking import ensure_tracking, load_model
    from pipelines.train import train
    from terrain.control.slip_table import load_slip_table

    began_s = time.monotonic()
    ensure_writable(out)
    ensure_tracking()
    runs = load_runs(data)
    _refuse_other_runs(runs, data, out / "runs")
    dataset = data.resolve().name
    report = {"dataset": dataset, "data_digest": data_digest(runs), **crossval(runs, settings, progress)}
    imported = _import(runs, data, out / "runs", progress)
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
        "commands": [
            f"terrain crossval --data {data} --protocol grouped --seed {settings.seed}",
            f"terrain train --data {data} --name {name} --seed {settings.seed}",
            f"terrain predict --model {trained['model_uri']} --data {data}",
        ],
        "report": str(out / REPORT_FILE),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "elapsed_s": time.monotonic() - began_s,
    }
    progress("report", 0, 1)
    figures = all_figures(report, trained["importance"])
    atomic_write(out / REPORT_FILE, html_report(result, figures))
    progress("report", 1, 1)
    return result


def _refuse_other_runs(runs: list[RunLog], data: Path, folder: Path) -> None:
    if folder.exists() and data_digest(load_runs(folder)) != data_digest(runs):
        raise DataError(f"{folder}: holds other runs than {data}; choose another --out")


def _import(runs: list[RunLog], data: Path, folder: Path, progress: Progress) -> dict[str, Any]:
    """Import into ``folder``; an earlier import of the same data is used as it lies."""
    if folder.exists():
        progress("import", len(runs), len(runs))
        return {"out": str(folder), "n_runs": len(runs), "reused": True}
    done: list[str] = []

    def show(run_id: str) -> None:
        done.append(run_id)
        progress("import", len(done), len(runs))

    return {**import_logs(data, folder, progress=show), "reused": False}
