"""``terrain measure-slip``: slip of runs from wheel speeds and an outside measurement of motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pipelines.data.datasets import robot_of
from pipelines.measured_slip.predictions import cases_of, predictions
from pipelines.measured_slip.results import MeasuredSlipResult, NamedSurface
from pipelines.measured_slip.settings import MeasureSlipSettings
from pipelines.reporting.progress import Progress, silent
from terrain.errors import DataError, LogError
from terrain.files.atomic import ensure_writable
from terrain.logs.write import run_folder, write_run
from terrain.measured_slip.delay import Delay, DelayStatus, estimate_delay
from terrain.measured_slip.rollers import RollerFindings, roller_findings, surface_of_windows
from terrain.measured_slip.slips import MeasuredSlip, measured_slip
from terrain.measured_slip.surfaces import surface_slip
from terrain.measured_slip.wheel_distance import DistanceBound, distance_bound
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, as_drive, load_robot

SHORT_S, SHORT_STRIDE_S = 0.5, 0.1
"""Windows of the stream ``slip`` that runs are written with."""


class Measured(NamedTuple):
    """Runs beside their slip, the delays by session, and a sentence for each run without a slip."""

    runs: list[RunLog]
    slips: list[MeasuredSlip]
    delays: dict[str, Delay]
    failed: list[str]


def measure_slip(
    runs: Sequence[RunLog],
    settings: MeasureSlipSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> MeasuredSlipResult:
    """Measure the slip of runs, and on request predict it; write runs and page.

    Raises
    ------
    ConfigError
        if a robot is unknown, or the runs are of several robots.
    DataError
        if no run has a slip, or predictions are asked for and there is nothing to predict from.
    LogError
        if a run is in ``out`` already; nothing is written then.
    """
    robot = one_robot(runs, settings.robot)
    if settings.rollers:
        as_drive(OmniRobot, robot, "robot {name}: drive {drive!r} has no rollers, only 'omni' has")
    if settings.out is not None:
        _refuse_existing(runs, settings)
    if settings.figures is not None:
        ensure_writable(settings.figures)
    found = measure(runs, robot, settings, progress)
    if not found.slips:
        raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {found.failed[0]}")
    rng = np.random.default_rng(settings.seed)
    names = sorted({_terrain(run) for run in found.runs}, key=lambda name: (name == "", name))
    surfaces = tuple(
        surface_slip(
            name,
            [slip for run, slip in zip(found.runs, found.slips, strict=True) if _terrain(run) == name],
            rng,
        )
        for name in names
    )
    predicted = []
    if settings.predict:
        cases = cases_of(found.runs, found.slips, settings.window_s)
        predicted = predictions(cases, settings.hold_out, settings.seed, progress)
    rollers = _rollers(found, robot, settings) if settings.rollers else None
    result = MeasuredSlipResult(
        robot=robot.name,
        window_s=settings.window_s,
        stride_s=settings.stride_s,
        seed=settings.seed,
        sources=dict(sorted(Counter(slip.source for slip in found.slips).items())),
        delays=found.delays,
        surfaces=surfaces,
        predictions=tuple(predicted),
        rollers=rollers,
        named=() if rollers is None else _named(found, robot, rollers),
        distances=_distances(found, robot, settings) if settings.rollers else {},
        not_measured=tuple(found.failed),
        n_runs=len(runs),
        out=settings.out,
        figures=(),
        skipped=tuple(skipped),
    )
    if settings.out is not None:
        _write(found, robot, settings, progress)
    if settings.figures is not None:
        from pipelines.measured_slip.page import write_page

        result = replace(result, figures=tuple(write_page(result, found.runs, found.slips, settings.figures)))
    return result


def one_robot(runs: Sequence[RunLog], named: str | None) -> Robot:
    """Return the robot of runs.

    Raises
    ------
    DataError
        if they are of several.
    ConfigError
        if it is unknown.
    """
    names = sorted({run.robot for run in runs})
    if len(names) > 1:
        raise DataError(f"the runs are of the robots {', '.join(names)}: measure those of one at a time")
    return robot_of(runs[0], None if named is None else load_robot(named))


def measure(
    runs: Sequence[RunLog], robot: Robot, settings: MeasureSlipSettings, progress: Progress = silent
) -> Measured:
    """Return the slip of each run, with the delay of its session taken off."""
    delays: dict[str, Delay] = {}
    by_session: dict[str, list[RunLog]] = {}
    for run in runs:
        by_session.setdefault(run.session, []).append(run)
    for done, (session, members) in enumerate(sorted(by_session.items()), start=1):
        if settings.delay_s is None:
            delays[session] = estimate_delay(members, robot, settings.seed)
        else:
            delays[session] = Delay(settings.delay_s, 0.0, len(members), DelayStatus.ESTIMATED)
        progress("delay", done, len(by_session))
    kept, slips, failed = [], [], []
    for done, run in enumerate(runs, start=1):
        try:
            slips.append(
                measured_slip(
                    run,
                    robot,
                    window_s=settings.window_s,
                    stride_s=settings.stride_s,
                    delay_s=delays[run.session].applied_s,
                )
            )
            kept.append(run)
        except DataError as error:
            failed.append(str(error))
        progress("slip", done, len(runs))
    return Measured(kept, slips, delays, failed)


def _rollers(found: Measured, robot: Robot, settings: MeasureSlipSettings) -> RollerFindings:
    """Return what makes an omni robot slip; sessions are groups that are asked for their load."""
    known = [i for i, run in enumerate(found.runs) if _terrain(run)]
    groups = [found.runs[i].session or _terrain(found.runs[i]) for i in known]
    surfaces = sorted({_terrain(found.runs[i]) for i in known if not found.runs[i].session})
    return roller_findings([found.slips[i] for i in known], groups, robot, surfaces, settings.seed)


def _named(found: Measured, robot: Robot, rollers: RollerFindings) -> tuple[NamedSurface, ...]:
    """Return which surface rollers name in the windows of each group, runs without a label by session."""
    windows: dict[str, Counter[str]] = {}
    right: dict[str, list[bool]] = {}
    for run, slip in zip(found.runs, found.slips, strict=True):
        names = [name for name in surface_of_windows(slip, rollers, robot) if name]
        if not names:
            continue
        group = run.session or _terrain(run)
        windows.setdefault(group, Counter()).update(names)
        if _terrain(run) in rollers.roller_ratio:
            right.setdefault(group, []).append(Counter(names).most_common(1)[0][0] == _terrain(run))
    rows = []
    for group, counts in sorted(windows.items()):
        judged = right.get(group)
        n_right = sum(judged) if judged else None
        n_runs = len(judged) if judged else sum((run.session or _terrain(run)) == group for run in found.runs)
        rows.append(NamedSurface(group, n_runs, n_right, dict(sorted(counts.items()))))
    return tuple(rows)


def _distances(found: Measured, robot: Robot, settings: MeasureSlipSettings) -> dict[str, DistanceBound]:
    """Return the distance of the wheels by each surface on which the robot's turns follow them."""
    omni = as_drive(OmniRobot, robot, "robot {name}: drive {drive!r} has no rollers, only 'omni' has")
    bounds = {}
    for name in sorted({_terrain(run) for run in found.runs if not run.session} - {""}):
        slips = [
            slip
            for run, slip in zip(found.runs, found.slips, strict=True)
            if _terrain(run) == name and not run.session
        ]
        bound = distance_bound(slips, omni, np.random.default_rng(settings.seed))
        if bound is not None:
            bounds[name] = bound
    return bounds


def _terrain(run: RunLog) -> str:
    return run.terrains[0] if len(run.terrains) == 1 else ""


def _refuse_existing(runs: Sequence[RunLog], settings: MeasureSlipSettings) -> None:
    assert settings.out is not None
    ensure_writable(settings.out)
    for run in runs:
        if (folder := run_folder(run.run_id, settings.out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")


def _write(found: Measured, robot: Robot, settings: MeasureSlipSettings, progress: Progress) -> None:
    assert settings.out is not None
    for done, run in enumerate(found.runs, start=1):
        slip = measured_slip(
            run,
            robot,
            window_s=SHORT_S,
            stride_s=SHORT_STRIDE_S,
            delay_s=found.delays[run.session].applied_s,
            whole=True,
        )
        write_run(replace(run, streams={**run.streams, "slip": slip.track.as_stream()}), settings.out)
        progress("write runs", done, len(found.runs))
