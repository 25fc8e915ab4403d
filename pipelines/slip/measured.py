"""``terrain estimate --filter pose``: slip of runs from wheel speeds and an outside measurement of motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from features.response import slip_cases
from pipelines.report.figure import Bars, Figure, Panel, Points
from pipelines.report.numbers import enumerated, format_value, sentence
from pipelines.report.results import Progress, described
from pipelines.report.tree import Column, Part, Report, Table, Text, sections
from pipelines.slip.estimate import EstimateOptions
from pipelines.slip.shown import within_one_session
from pipelines.slip.tracks import Keep, TracksResult
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import OmniRobot, Robot, SwerveRobot, as_drive, robot_argument
from terrain.signals import Delay
from terrain.slip_learning.currents import PredictionFigures, predictions
from terrain.slip_learning.measured import (
    Measured,
    SurfaceSlip,
    delay_sentence,
    measure,
    measured_slip,
    one_robot,
    surface_slips,
)
from terrain.slip_learning.rollers import (
    NO_ROLLERS,
    DistanceBound,
    NamedSurface,
    RollerFindings,
    distances_of,
    named_surfaces,
    rollers_of,
)
from terrain.slip_learning.sessions import IntervalOf

SHORT_S, SHORT_STRIDE_S = 0.5, 0.1  #: Windows of the stream ``slip`` that runs are written with

UNLABELLED = "(no label)"
SLIP, FINE = ".3f", ".4f"


class MeasuredSlipResult(TracksResult, kw_only=True):
    """Slip measured from outside."""

    rows: ClassVar[str] = "surfaces"

    robot: str = described("by name")
    window_s: float = described("length of windows", "s")
    stride_s: float = described("from window to window", "s")
    seed: int = described("of what is drawn")
    sources: Mapping[str, int] = described("runs by the stream that measured their motion from outside")
    delays: Mapping[str, Delay] = described("of the outside measurement behind the wheels, by session")
    surfaces: tuple[SurfaceSlip, ...] = described("by terrain, runs without a label last")
    predictions: tuple[PredictionFigures, ...] = described("of slip from currents and wheel speeds")
    rollers: RollerFindings | None = described("what makes an omni robot slip; none unless asked for")
    named: tuple[NamedSurface, ...] = described("surfaces that rollers name window by window, by group")
    distances: Mapping[str, DistanceBound] = described(
        "of the wheels of an omni robot from its middle, by surface, where its turns follow the wheels"
    )
    not_measured: tuple[str, ...] = described("a sentence for each run without a slip")
    n_runs: int = described("that were read")
    figures: tuple[str, ...] = described("files", default=())


def estimate_all(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> MeasuredSlipResult:
    """Measure the slip of runs of one robot, as :func:`pipelines.slip.estimate.estimate_runs`.

    ``keep`` gets each run with the stream ``slip``, over windows of :data:`SHORT_S`.
    """
    robot, seed = one_robot(runs, robot), options.seed
    if options.rollers:
        as_drive(OmniRobot, robot, NO_ROLLERS)
    asked: dict[str, Any] = {"window_s": options.window_s, "stride_s": options.stride_s, "seed": seed}
    found = measure(runs, robot, **asked, delay_s=options.delay_s, progress=progress)
    if not found.slips:
        raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {found.failed[0]}")
    by_terrain = found.by_terrain()
    surfaces = tuple(surface_slips(found, np.random.default_rng(seed)).values())
    predicted = []
    if options.predict:
        cases = slip_cases(found.runs, found.slips, options.window_s)
        predicted = predictions(cases, options.hold_out, seed, progress)
    findings = rollers_of(found, robot) if options.rollers else None
    if keep is not None:
        for done, run in enumerate(found.runs, start=1):
            late_s = found.delays[run.session].applied_s
            over = {"window_s": SHORT_S, "stride_s": SHORT_STRIDE_S, "delay_s": late_s}
            slip = measured_slip(run, robot, **over, whole=True).stream
            keep(replace(run, streams={**run.streams, "slip": slip}, filter="pose"), dict)
            progress("write runs", done, len(found.runs))
    return MeasuredSlipResult.of(
        options,
        found,
        robot=robot.name,
        sources=dict(sorted(Counter(slip.source for slip in found.slips).items())),
        surfaces=surfaces,
        predictions=tuple(predicted),
        rollers=findings,
        named=() if findings is None else named_surfaces(found, robot, findings),
        distances=distances_of(found, robot, seed) if options.rollers else {},
        not_measured=tuple(found.failed),
        n_runs=len(runs),
        pictures=_pictures(robot, options.window_s, surfaces, by_terrain),
    )


SURFACES = (
    Column("surface", of=lambda row: row.terrain or UNLABELLED),
    Column("sessions", of="n_sessions"),
    Column("runs", of="n_runs"),
    Column("windows", of="n_windows"),
    Column("slip", SLIP, of="slip_ratio"),
    Column("interval", SLIP, of="interval"),
    Column("of", of="interval_of"),
    Column("quartiles of windows", SLIP, of="spread"),
    Column("std of a window", SLIP, of="std"),
    Column("held-out difference", SLIP, of="held_out"),
    Column("wheels", of=lambda row: " ".join(format_value(slip, "+.2f") for slip in row.wheel_slip)),
    Column("yaw rate over wheels'", ".2f", of="turn_ratio"),
)

PREDICTIONS = (
    Column("held out", of="held_out"),
    Column("runs", of="n_runs"),
    Column("windows", of="n_windows"),
    Column("RMS error", FINE, of="rms"),
    Column("95 %", SLIP, of="rms_interval"),
    Column("bias", "+.4f", of="bias"),
    Column("inside 95 %", ".1%", of="coverage"),
    Column("width", SLIP, of="width"),
    Column(
        "by terrain",
        of=lambda row: ", ".join(f"{k} {format_value(v, SLIP)}" for k, v in row.by_terrain.items()),
    ),
)


def report(result: MeasuredSlipResult) -> Report:
    """Return slip by surface, delays, predictions, and which runs have no slip and why."""
    title = f"median slip over {result.window_s:g} s, by surface"
    parts: list[Part] = [Table(SURFACES, result.surfaces, title)]
    parts += [
        Text(f"Session {session}: {delay_sentence(delay)}" if session else sentence(delay_sentence(delay)))
        for session, delay in result.delays.items()
    ]
    if result.predictions:
        about = "slip predicted from currents and wheel speeds alone"
        parts.append(Table(PREDICTIONS, result.predictions, about))
    if result.rollers is not None:
        found = (
            result.rollers
        )  # what of the slip is the robot's own, which surfaces it names, and where wheels are
        columns = (
            Column("surface", of=str),
            Column("roller friction", SLIP, of=found.roller_ratio.get),
            Column("95 %", SLIP, of=found.roller_interval.get),
            Column("RMS of slip left, held out", FINE, of=found.held_out_rms.get),
            Column("about the mean", FINE, of=found.plain_rms.get),
        )
        note = (
            "Friction of the rollers over the stiffness of traction, both in proportion to a wheel's load; intervals "
            "are within one session."
        )
        parts.append(Table(columns, list(found.roller_ratio), "what makes it slip", note))
        sentences = list(found.sentences)
        for each in result.named:
            fitted = ", fitted" if each.group in found.roller_ratio else ", not fitted"
            shown = fitted if each.n_right is not None else ""
            sentences.append(f"{each.group or UNLABELLED}{shown}: {each.text}.")
        sentences += [f"{name}: {bound.sentence}" for name, bound in result.distances.items()]
        parts += map(Text, sentences)
    spinning = [name for row in result.surfaces for name in row.spinning]
    if spinning:
        names = ", ".join(spinning[:8])
        parts.append(Text(f"A wheel spins or lifts in {len(spinning)} runs: {names}.", "warning"))
    if result.not_measured:
        n, first = len(result.not_measured), result.not_measured[0]
        parts.append(Text(f"{n} of {result.n_runs} runs have no slip, the first: {first}", "note"))
    if result.out is not None:
        parts.append(Text(f"Runs with the stream slip are in {result.out}."))
    reading = (
        "Slip of the body along the direction in which wheels without slip would drive it, in windows of steady "
        "motion; standing robots have none. A session counts by the median of its runs' medians; the held-out "
        "difference is the largest of a session or, of one session, of a fifth of its runs against the others. "
        "Intervals are, with 95 %, of a new session (pooled: sessions taken to differ alike on all surfaces), the "
        "range of two sessions, which contains a third in one case of three, or over the runs of one. An error of "
        "the wheels' radius or of the outside measurement's scale is not in the intervals: 1 % of it is 0.01 "
        "(1 - slip) of slip."
    )
    return Report(
        f"Slip of {result.robot}, measured from outside",
        _answer(result),
        result.pictures.get("slip_by_surface"),
        parts,
        sections(
            ("Pictures", [each for name, each in result.pictures.items() if name != "slip_by_surface"]),
            ("How to read this", [reading]),
            ("Without a slip", result.not_measured),
            ("Not read", result.skipped),
        ),
        f"terrain learn-slip --data DIR --robot {robot_argument(result.robot)} --out table.yaml",
    )


def _answer(result: MeasuredSlipResult) -> str:
    sources = enumerated([f"the stream {name} in {n} runs" for name, n in result.sources.items()])
    known = [row for row in result.surfaces if np.isfinite(row.slip_ratio)]
    if known:
        slips = [f"{format_value(row.slip_ratio, SLIP)} on {row.terrain or UNLABELLED}" for row in known]
        apart = within_one_session(
            {row.terrain or UNLABELLED: row.interval_of is IntervalOf.ONE_SESSION for row in known}
        )
        return f"{apart}{result.robot} slips by {enumerated(slips)}, measured by {sources}."
    if any(row.n_windows for row in result.surfaces):
        return f"No slip is known in steady motion, measured by {sources}."
    return f"No window of {result.window_s:g} s is covered by {sources}; a shorter --window may be."


def _pictures(
    robot: Robot, window_s: float, surfaces: Sequence[SurfaceSlip], by_terrain: Mapping[str, Measured]
) -> dict[str, Figure]:
    """Return slip by surface, by run, and by the direction of travel or, of robots that only drive ahead, the turn."""
    names = [terrain or UNLABELLED for terrain in by_terrain]
    low, high = np.array([row.interval for row in surfaces]).T
    bars = Bars("mean of sessions and interval", names, [row.slip_ratio for row in surfaces], low, high)
    sideways = isinstance(robot, OmniRobot | SwerveRobot)
    by_run, by_window, rng = [], [], np.random.default_rng(0)
    for place, (name, own) in enumerate(zip(names, by_terrain.values(), strict=True)):
        slips = [each.body_slip[each.known] for each in own.slips]
        of_runs = np.array([np.median(each) for each in slips if each.size])
        by_run.append(Points(name, of_runs, place + rng.uniform(-0.22, 0.22, of_runs.size)))
        ahead, left, turn = np.concatenate([slip.rolled_twist[slip.known] for slip in own.slips]).T
        with np.errstate(invalid="ignore", divide="ignore"):
            at = np.degrees(np.arctan2(left, ahead)) if sideways else turn / np.abs(ahead)
        by_window.append(Points(name, at, np.concatenate(slips)))
    label, title = (
        f"slip ratio of the body over {window_s:g} s",
        f"Slip of {robot.name}, measured from outside",
    )
    reach, motion = 3.0, "yaw rate of the wheels over their speed [rad/m]"
    if sideways:
        reach, motion = 180.0, "direction of travel in the body's axes [degrees]"
    windows = Panel(by_window, "slip ratio of the body", x_range=(-reach, reach))

    def figure(how: str, panel: Panel, caption: str, x_label: str = label) -> Figure:
        return Figure(f"{title}, {how}", [panel], caption, x_label=x_label)

    every_run, every_window = "The median of each run.", "A window of steady motion a point."
    return {
        "slip_by_surface": figure(
            "by surface", Panel([bars]), "The mean over sessions of the median over runs, and its interval."
        ),
        "slip_by_run": figure("a run a point", Panel(by_run, "surface"), every_run),
        "slip_by_motion": figure("by how it was driven", windows, every_window, motion),
    }
