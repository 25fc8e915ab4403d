"""Motion and slip of runs, with their uncertainty: by a filter, an observer, or a pose from outside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.slip.modes import (
    EstimateOptions,
    Filter,
    NoiseSettings,
    PoseSettings,
    SlipModelSettings,
    refuse_existing,
    refuse_others,
)

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.report import Figure, Progress, Report, Result
    from pipelines.slip.filtered import EstimateResult, Keep
    from pipelines.slip.measured import MeasuredSlipResult
    from pipelines.slip.observed import ObservedResult
    from terrain.records import RunLog
    from terrain.robots import Robot

GROUPS: dict[str, type[BaseSettings]] = {
    "filters": NoiseSettings,
    "observers": SlipModelSettings,
    "--filter pose": PoseSettings,
}
"""Options of each mode, by what they are for."""

EXAMPLE = "terrain estimate --data raw/ --filter vio15 --out runs/"


class Settings(EstimateOptions, AlignedRunsSettings):
    """What is written."""

    robot: str | None = setting(None, "Robot or its YAML file, in place of the one that a run names.")
    out: Path | None = setting(None, "Folder of new run folders with state and slip.")
    figures: Path | None = setting(None, "Folder of pictures, those of every run.")


@dataclass(frozen=True, repr=False, eq=False)
class Estimates:
    """Runs with the streams of their estimates, and what these come to.

    Parameters
    ----------
    runs : with the stream ``slip`` and, of filters and observers, ``estimator`` and ``state``
    result : of ``terrain estimate``
    """

    runs: tuple[RunLog, ...]
    result: Result

    @property
    def report(self) -> Report:
        """What was estimated, as the command shows it."""
        return self.result.report

    def to_pandas(self) -> pd.DataFrame:
        """Return the figures of runs, or of surfaces, a row each."""
        return self.result.to_pandas()

    def __len__(self) -> int:
        return len(self.runs)

    def __repr__(self) -> str:
        return f"<Estimates of {len(self.runs)} runs: {self.report.answer}>"

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def estimate_runs(
    runs: Sequence[RunLog],
    robot: Robot | None = None,
    filter: Filter = "skid",
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Estimates:
    """Estimate motion and slip of runs; nothing is written.

    Parameters
    ----------
    runs : logs
    robot : whose they are; by default each that a run names
    filter : filter, observer or ``pose``
    progress : gets the runs that are done
    options : fields of :class:`EstimateOptions`, as ``tuning`` or ``window_s``

    Raises
    ------
    ConfigError
        if an option is not accepted, is one of another mode, or the filter does not fit a robot.
    DataError
        if a log lacks what the filter takes.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.simulation.run import simulate_run
    >>> run = simulate_run(load_robot("agrimaro"), "grass", "straight", 0, duration_s=4.0)
    >>> tracks = estimate_runs([run], filter="vio15")
    >>> sorted(set(tracks.runs[0].streams) - set(run.streams))
    ['estimator', 'slip', 'state']
    """
    from pipelines.report import silent

    kept: list[RunLog] = []
    asked = EstimateOptions(filter=filter, **options)
    result = _estimated(runs, robot, asked, progress or silent, lambda run, figures: kept.append(run))
    return Estimates(tuple(kept), result)


def run(settings: Settings, progress: Progress) -> Result:
    """Read runs, estimate, and write them with their tracks, and their pictures.

    Raises
    ------
    LogError
        if a run is in ``out`` already; nothing is written then.
    """
    from pipelines.data.settings import load
    from pipelines.slip.measured import MeasuredSlipResult
    from pipelines.slip.shown import write_figures
    from terrain.files.atomic import ensure_writable
    from terrain.logs.write import write_run
    from terrain.robots import load_robot

    runs, skipped = load(settings)
    if settings.out is not None:
        refuse_existing(runs, settings.out)
    if settings.figures is not None:
        ensure_writable(settings.figures)
    of_runs = None if settings.filter == "pose" else settings.figures  # pictures of a pose are of all runs

    def write(run: RunLog, figures: Callable[[], Mapping[str, Figure]]) -> None:
        if settings.out is not None:
            write_run(run, settings.out)
        if of_runs is not None:
            write_figures(figures(), of_runs, svg=False)

    robot = None if settings.robot is None else load_robot(settings.robot)
    keep = None if settings.out is None and of_runs is None else write
    result = _estimated(runs, robot, settings, progress, keep)
    found: dict[str, Any] = {"out": settings.out, "skipped": tuple(skipped)}
    if isinstance(result, MeasuredSlipResult) and settings.figures is not None:
        found["figures"] = write_figures(result.pictures, settings.figures)
    return replace(result, **found)


def _estimated(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> EstimateResult | ObservedResult | MeasuredSlipResult:
    """Estimate by the mode that the filter names."""
    from terrain.estimation.observers.choice import OBSERVERS

    observer, pose = options.filter in OBSERVERS, options.filter == "pose"
    used = "observers" if observer else "--filter pose" if pose else "filters"
    refuse_others(options, GROUPS, used, f"--filter {options.filter}")
    if pose:
        from pipelines.slip.measured import measure_runs

        return measure_runs(runs, robot, options, progress, keep)
    if observer:
        from pipelines.slip.observed import observe_runs

        return observe_runs(runs, robot, options, progress, keep)
    from pipelines.slip.filtered import filter_runs

    return filter_runs(runs, robot, options, progress, keep)
