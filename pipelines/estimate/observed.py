"""``terrain estimate`` with an observer of slip in place of a filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.estimate.settings import EstimateSettings
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError, LogError
from terrain.estimation.observers.choice import BY_MODEL
from terrain.estimation.observers.estimate import observe_run, with_estimates
from terrain.estimation.observers.slip_model_file import read_slip_model
from terrain.estimation.observers.summary import ObserverSummary, summarize_observer
from terrain.files.atomic import ensure_writable
from terrain.logs.write import run_folder, write_run
from terrain.records import RunLog
from terrain.robots import load_robot, packaged_robot


@dataclass(frozen=True, slots=True)
class ObservedResult:
    """Estimates of runs by an observer.

    Parameters
    ----------
    filter : which observer
    slip_model : file of the slip model that it has, or None
    out : folder that the runs were written to, or None
    runs : figures of each run
    skipped : a sentence for each run that a repairing read left out
    """

    filter: str
    slip_model: Path | None
    out: Path | None
    runs: tuple[ObserverSummary, ...]
    skipped: tuple[str, ...] = ()


def estimate_observed(
    runs: Sequence[RunLog],
    settings: EstimateSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> ObservedResult:
    """Run an observer over runs; write them with their estimates, and their pictures.

    Parameters
    ----------
    runs : logs
    settings : observer and slip model; nothing is written without ``out``
    skipped : a sentence for each run that was not read

    Raises
    ------
    ConfigError
        if the observer does not fit a robot, needs a slip model and has none, or a tuning is given.
    DataError
        if a log has no wheels.
    LogError
        if a run is in ``out`` already; nothing is written then.
    """
    if settings.tuning is not None or settings.tune_on is not None:
        raise ConfigError(f"filter {settings.filter!r} is an observer, which has gains and no tuning")
    if settings.slip_model is not None and settings.filter not in (*BY_MODEL, "encoder-odometry"):
        raise ConfigError(f"filter {settings.filter!r} takes no slip model: leave --slip-model out")
    if settings.out is not None:
        refuse_existing(runs, settings.out)
    given = None if settings.robot is None else load_robot(settings.robot)
    summaries = []
    for done, run in enumerate(runs):
        robot = given or packaged_robot(run.robot)
        model = None if settings.slip_model is None else read_slip_model(settings.slip_model, robot.name)
        found = observe_run(run, robot, settings.filter, model)
        summaries.append(summarize_observer(found))
        if settings.out is not None:
            write_run(with_estimates(found), settings.out)
            if settings.figures:
                from pipelines.estimate.observed_figures import write_observed_figures

                write_observed_figures(found, settings.out / "figures")
        progress(f"estimate {settings.filter}", done + 1, len(runs))
    return ObservedResult(
        settings.filter, settings.slip_model, settings.out, tuple(summaries), tuple(skipped)
    )


def refuse_existing(runs: Sequence[RunLog], out: Path) -> None:
    """Refuse a folder that cannot be written, or that holds a run of the same name.

    Raises
    ------
    LogError
        if it does.
    """
    ensure_writable(out)
    for run in runs:
        if (folder := run_folder(run.run_id, out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
