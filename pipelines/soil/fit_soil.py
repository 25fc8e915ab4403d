"""``terrain fit-soil``: which law of a wheel in sand holds on trials that its fit did not have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pipelines.data.datasets import data_digest, load_runs
from pipelines.reporting.progress import Progress, silent
from pipelines.soil.results import BAR_RATIO, Drawn, FitSoilResult, WheelResult
from pipelines.soil.settings import FitSoilSettings
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog
from terrain.soil_identification.trials import WHEELS, trials_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_FILE = "soil.html"
SOIL_NAME = "testbed_sand_{wheel}"


def fit_soil(
    runs: Sequence[RunLog],
    settings: FitSoilSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> FitSoilResult:
    """Compare laws on held-out slips and angles, wheel by wheel, and write page, pictures and soils.

    Parameters
    ----------
    runs : trials of the wheel testbed
    settings : of the command
    skipped : a sentence for each trial that could not be read
    progress : gets the fits that are done

    Raises
    ------
    ConfigError
        if ``out`` is a file.
    LogError
        if a trial of ``check`` cannot be read.
    DataError
        if no run is a trial of the testbed, or a wheel has too few settings.
    TerrainError
        if ``out`` cannot be written.
    """
    from pipelines.soil.figures import wheel_figures
    from pipelines.soil.page import soil_page

    if settings.out.is_file():
        raise ConfigError(f"{settings.out}: is a file; --out names a folder")
    ensure_writable(settings.out)
    further = _further(settings)
    by_wheel = {robot: [run for run in runs if run.robot == robot] for robot in WHEELS}
    if not any(by_wheel.values()):
        raise DataError(
            f"none of {len(runs)} runs is a trial of a wheel testbed (robots {', '.join(WHEELS)}): "
            "give a folder with smooth.csv or grouser.csv"
        )
    found: list[tuple[WheelResult, Drawn]] = []
    files: list[str] = []
    for robot, own in by_wheel.items():
        if own:
            others = [run for run in further if run.robot == robot]
            found.append(_one_wheel(robot, own, others, settings, progress))
            files.append(str(found[-1][0].soil.file))
    results = tuple(result for result, _ in found)
    figures: dict[str, Figure] = {}
    for result, drawn in found:
        figures |= wheel_figures(result, drawn)
    files += _write_figures(figures, settings)
    page = settings.out / PAGE_FILE
    atomic_write(page, soil_page(results, figures, settings.dataset))
    return FitSoilResult(
        out=settings.out,
        dataset=settings.dataset,
        data_digest=data_digest(runs),
        seed=settings.seed,
        draws=settings.draws,
        bar_ratio=BAR_RATIO,
        wheels=results,
        files=(*files, str(page)),
        skipped=tuple(skipped),
    )


def _one_wheel(
    robot: str, own: Sequence[RunLog], others: Sequence[RunLog], settings: FitSoilSettings, progress: Progress
) -> tuple[WheelResult, Drawn]:
    """Fit one wheel's trials and write its soil."""
    from pipelines.soil.soil_file import soil_yaml
    from pipelines.soil.wheel import wheel_result

    wheel = WHEELS[robot]
    name = SOIL_NAME.format(wheel=wheel.name)
    path = settings.out / f"{name}.yaml"
    further = trials_of(others, wheel) if others else None
    result, drawn = wheel_result(trials_of(own, wheel), further, wheel, path, settings, progress)
    friction = result.parameters["tan_friction"]
    atomic_write(path, soil_yaml(name, wheel.name, settings.dataset, result.soil.fit, friction, result.law))
    return result, drawn


def _further(settings: FitSoilSettings) -> list[RunLog]:
    """Return the runs of ``--check``; none without it."""
    if settings.check is None:
        return []
    runs = load_runs(settings.check, layout=settings.layout, repair=settings.repair)
    if not any(run.robot in WHEELS for run in runs):
        raise DataError(f"--check {settings.check}: none of {len(runs)} runs is a trial of a wheel testbed")
    return runs


def _write_figures(figures: Mapping[str, Figure], settings: FitSoilSettings) -> list[str]:
    from pipelines.reporting.drawing import png_bytes, svg_text

    files = []
    for name, figure in figures.items():
        for ending, content in ((".png", png_bytes(figure)), (".svg", svg_text(figure))):
            path = settings.out / f"{name.replace(', ', '_').replace(' ', '_')}{ending}"
            atomic_write(path, content)
            files.append(str(path))
    return files
