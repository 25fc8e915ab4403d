"""``terrain learn-slip`` of robots whose slip was measured from outside: steady targets by surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipelines.data.datasets import data_digest
from pipelines.measured_slip.measure import Measured, measure
from pipelines.measured_slip.settings import MeasureSlipSettings
from pipelines.reporting.progress import Progress, silent
from pipelines.slip.measured_rows import MeasuredTargets, SurfaceTargets
from pipelines.slip.results import target_row
from pipelines.slip.settings import LearnSlipSettings
from pipelines.slip.transfer import transfers
from terrain.control.measured_table import measured_table, reason_of
from terrain.control.slip_table import DRIVE_STATES, write_slip_table
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import ensure_writable
from terrain.measured_slip.operating import operating_points
from terrain.measured_slip.surfaces import surface_slip
from terrain.records import Array, RunLog
from terrain.robots import Robot

WINDOW_S, SHORT_WINDOW_S = 2.0, 0.5
"""Windows; short ones where the outside measurement does not cover longer ones, as a lidar's twist."""


def learn_measured(
    runs: Sequence[RunLog],
    robot: Robot,
    settings: LearnSlipSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> MeasuredTargets:
    """Learn the table of steady targets, write it, and draw it on request.

    Raises
    ------
    ConfigError
        if ``out`` is a folder.
    DataError
        if no run has a label, a run is another robot's, or none has a slip that was measured from outside.
    """
    if settings.out.is_dir():
        raise ConfigError(f"{settings.out}: is a folder; --out names the file of the table")
    ensure_writable(settings.out.parent)
    if settings.figures is not None:
        ensure_writable(settings.figures)
    labelled = [run for run in runs if len(run.terrains) == 1]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: target slips are learned by terrain")
    others = sorted({run.robot for run in labelled} - {robot.name})
    if others:
        raise DataError(f"runs are of the robot {others[0]!r}: a table is learned for one, {robot.name!r}")
    window_s, found = _measured(labelled, robot, settings, progress)
    rng = np.random.default_rng(settings.seed)
    places: dict[str, list[int]] = {}
    for i, run in enumerate(found.runs):
        places.setdefault(run.terrains[0], []).append(i)
    slips = {name: surface_slip(name, [found.slips[i] for i in places[name]], rng) for name in sorted(places)}
    table = measured_table(list(slips.values()), robot, settings.out.stem)
    points = {
        name: operating_points([found.runs[i] for i in here], [found.slips[i] for i in here], robot)
        for name, here in sorted(places.items())
    }
    surfaces = {}
    for name, slip in slips.items():
        surfaces[name] = SurfaceTargets(
            slip,
            _quartiles(points[name].current_a),
            _quartiles(points[name].thrust_ratio),
            {state: target_row(table.targets[name][state]) for state in DRIVE_STATES},
            reason_of(slip),
        )
    write_slip_table(table, settings.out)
    result = MeasuredTargets(
        table=settings.out,
        robot=robot.name,
        dataset=settings.dataset,
        data_digest=data_digest(found.runs),
        seed=settings.seed,
        window_s=window_s,
        n_runs=len(found.runs),
        surfaces=surfaces,
        transfers=tuple(transfers(found.runs, found.slips, rng)),
        figures=(),
        skipped=(*skipped, *_not_labelled(runs), *found.failed),
    )
    if settings.figures is not None:
        from pipelines.slip.measured_page import write_measured_page

        result = replace(result, figures=write_measured_page(result, points, settings.figures))
    return result


def _not_labelled(runs: Sequence[RunLog]) -> list[str]:
    """Return a sentence for each run that is not on one terrain by its labels."""
    return [
        f"run {run.run_id}: is on {len(run.terrains)} terrains: {', '.join(run.terrains)}"
        if run.terrains
        else f"run {run.run_id}: has no label"
        for run in runs
        if len(run.terrains) != 1
    ]


def _measured(
    runs: Sequence[RunLog], robot: Robot, settings: LearnSlipSettings, progress: Progress
) -> tuple[float, Measured]:
    """Return slips over the longer windows, or over short ones where no longer one is covered."""
    first = ""
    for window_s in (WINDOW_S, SHORT_WINDOW_S):
        of_windows = MeasureSlipSettings(
            data=settings.data, window_s=window_s, stride_s=window_s / 2, seed=settings.seed
        )
        found = measure(runs, robot, of_windows, progress)
        if any(np.isfinite(slip.body_slip[slip.steady]).any() for slip in found.slips):
            return window_s, found
        first = first or (found.failed[0] if found.failed else "no window is driven steadily")
    raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {first}")


def _quartiles(values: Array) -> tuple[float, float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan"), float("nan")
    low, middle, high = np.quantile(known, [0.25, 0.5, 0.75])
    return float(middle), float(low), float(high)
