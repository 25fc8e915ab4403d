"""Motion and slip of runs, with their uncertainty: by a filter, an observer, or a pose from outside."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.report.figure import Figure
    from pipelines.report.results import Progress
    from pipelines.report.tree import Report
    from pipelines.slip.tracks import Keep, TracksResult
    from terrain.records import RunLog
    from terrain.robots import Robot

EXAMPLE = "terrain estimate --data raw/ --filter vio15 --out runs/"
RESULTS = ("pipelines.slip.filtered", "pipelines.slip.measured")
"""Modules of the modes, with their results."""

ByFilter = Literal["encoder12", "vio12", "vio15"]
"""Filters of swerve robots, the numbers being those of their states."""

ByObserver = Literal[
    "slip",
    "tracked",
    "slip-odometry",
    "slip-learning",
    "encoder-odometry",
    "gyrodometry",
    "endo",
    "sideslip-kinematic",
    "sideslip-dynamic",
    "sideslip-multi",
]
"""Slip of any robot by what measures its motion over ground; observers of tracked robots, and of car-like ones."""

Filter = Literal[ByFilter, ByObserver, "pose"]
"""One of them; or ``pose``, slip against an outside measurement of motion."""

Tuning = Literal["physical", "thesis", "likelihood"]  #: Sources of a filter's noise


class NoiseSettings(BaseSettings):
    """Noise of filters."""

    tuning: Tuning | None = setting(None, "Noise; the thesis' own for vio12, else physical.")
    tune_on: Names | None = setting(None, "Runs, by commas, for the tuning 'likelihood'; the first three.")


class SlipModelSettings(BaseSettings):
    """Slip model of observers."""

    slip_model: Path | None = setting(None)
    """Slip model of a tracked robot on its ground, for slip-odometry and endo (terrain calibrate --what odometry)."""


class PoseSettings(BaseSettings):
    """Slip against a pose from outside (--filter pose)."""

    window_s: float = setting(2.0, "Window length in s.", "--window", gt=0.0)
    stride_s: float = setting(1.0, "From window to window in s.", "--stride", gt=0.0)
    delay_s: float | None = setting(None, option="--delay", ge=-5.0, le=5.0)
    """Delay of the outside measurement in s; by default it is found, a session at a time."""
    predict: bool = setting(False, "Predict slip from currents and wheel speeds, on held-out runs.")
    hold_out: Names = setting(())
    """Sessions that predictions never train on, by commas; runs without a label never are."""
    rollers: bool = setting(False, "Of omni robots: rollers' friction by surface, load of the wheels.")
    seed: int = setting(0, "Deals and draws runs.", ge=0)


class EstimateOptions(PoseSettings, SlipModelSettings, NoiseSettings):
    """How slip is found."""

    filter: Filter | None = setting(None)
    """Filter or observer, by default the one that suits robot and logs; 'pose' is slip against a pose from outside."""


GROUPS: dict[str, type[BaseSettings]] = {
    "filters": NoiseSettings,
    "observers": SlipModelSettings,
    "--filter pose": PoseSettings,
}
"""Options of each of these modes, by what they are for."""


class Settings(EstimateOptions, AlignedRunsSettings):
    """What is written."""

    robot: str | None = setting(None, "Robot or its YAML file, in place of the one that a run names.")
    out: Path | None = setting(None, "Folder of new run folders with state and slip.")
    figures: Path | None = setting(None, "Folder of pictures, those of every run.")


@dataclass(frozen=True, repr=False, eq=False)
class Estimates:
    """Runs with the streams of their estimates, and what these come to."""

    #: with the stream ``slip`` and, of filters and observers, ``estimator`` and ``state``
    runs: tuple[RunLog, ...]
    result: TracksResult  #: of ``terrain estimate``

    @property
    def report(self) -> Report:
        """What was estimated, as the command shows it."""
        return self.result.report

    def to_pandas(self) -> pd.DataFrame:
        """Return the figures of runs, or of surfaces, a row each."""
        return self.result.to_pandas()

    def __len__(self) -> int:
        return len(self.runs)

    def __iter__(self) -> Iterator[RunLog]:
        return iter(self.runs)

    def __repr__(self) -> str:
        return f"<Estimates of {len(self.runs)} runs: {self.report.answer}>"

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def estimate_runs(
    runs: Iterable[RunLog],
    robot: Robot | None = None,
    filter: Filter | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Estimates:
    """Estimate motion and slip of runs; nothing is written.

    Parameters
    ----------
    runs : logs
    robot : whose they are; by default each that a run names
    filter : filter, observer or ``pose``; by default the one that suits the robot and what all logs measure
        (:func:`terrain.estimation.models.choice.suitable_filter`)
    progress : gets the runs that are done
    options : fields of :class:`EstimateOptions`, as ``tuning`` or ``window_s``

    Raises
    ------
    ConfigError
        if an option is not accepted, is one of another mode, or the filter does not fit a robot.
    DataError
        if a log lacks what the filter takes, or there is no run of a name to tune or to predict on.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.simulation.run import simulate_run
    >>> run = simulate_run(load_robot("agrimaro"), "grass", "straight", 0, duration_s=4.0)
    >>> tracks = estimate_runs([run])
    >>> tracks.result.filter, sorted(set(tracks.runs[0].streams) - set(run.streams))
    ('vio15', ['estimator', 'slip', 'state'])
    """
    from pipelines.data.datasets import verdicts_of, warn_of
    from pipelines.report.results import silent
    from terrain.logs.plausibility import doubts_of

    runs = list(runs)
    kept: list[RunLog] = []
    warn_of(doubts_of(verdicts_of(runs, robot)))
    asked = EstimateOptions(filter=filter, **options)
    result = _estimated(runs, robot, asked, progress or silent, lambda run, figures: kept.append(run))
    return Estimates(tuple(kept), result)


def run(settings: Settings, progress: Progress) -> TracksResult:
    """Read runs, estimate, and write them with their tracks, and their pictures."""
    from pipelines.data.datasets import load
    from pipelines.slip.shown import write_figures
    from terrain.errors import LogError
    from terrain.files.atomic import ensure_writable
    from terrain.logs.run_folders import run_folder, write_run
    from terrain.robots import load_robot

    runs, skipped, doubts = load(settings)
    out, figures = settings.out, settings.figures
    for folder in (out, figures):
        if folder is not None:
            ensure_writable(folder)
    for each in runs:
        if out is not None and (taken := run_folder(each.run_id, out)).exists():
            raise LogError(f"{taken}: is there already, and is left as it is; choose another --out")
    of_runs = None if settings.filter == "pose" else figures  # pictures of a pose are of all runs

    def write(run: RunLog, pictures: Callable[[], Mapping[str, Figure]]) -> None:
        if out is not None:
            write_run(run, out)
        if of_runs is not None:
            write_figures(pictures(), of_runs, svg=False)

    robot = None if settings.robot is None else load_robot(settings.robot)
    result = _estimated(runs, robot, settings, progress, write if out or of_runs else None)
    found: dict[str, Any] = {"out": out, "skipped": tuple(skipped)}
    if figures is not None and of_runs is None:
        found["figures"] = write_figures(result.pictures, figures)
    return replace(result, **found).with_doubts(doubts)


def _estimated(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> TracksResult:
    """Estimate by the mode that the filter names, or that suits the runs."""
    if options.filter is None:
        from terrain.errors import DataError
        from terrain.estimation.models.choice import suitable_filter
        from terrain.robots import robot_named

        measured = [{name for name, stream in run.streams.items() if len(stream)} for run in runs]
        names = {
            suitable_filter(robot or robot_named(run.robot), set.intersection(*measured)) for run in runs
        }
        if len(names) != 1:
            found = f"runs of robots that need {', '.join(sorted(names))}" if names else "no runs"
            raise DataError(f"a filter (--filter) is needed for {found}")
        options = options.model_copy(update={"filter": names.pop()})
    number = 2 if options.filter == "pose" else int(options.filter in get_args(ByObserver))
    options.refuse_others([*GROUPS][number], GROUPS, f"is for {{of}}, not for --filter {options.filter}")
    module = import_module(RESULTS[number // 2])
    result: TracksResult = module.estimate_all(runs, robot, options, progress, keep)
    return result
