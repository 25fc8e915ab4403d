"""``terrain estimate --filter pose``: slip of runs from wheel speeds and an outside measurement of motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from features.response import ResponseExtractor
from features.windows import WindowRule, cut_windows, layout_of
from pipelines.report import (
    Bars,
    Figure,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Shown,
    Table,
    Text,
    described,
    enumerated,
    format_value,
    frame,
    interval,
    sections,
    silent,
    table,
)
from pipelines.slip.filtered import Keep
from terrain.errors import DataError
from terrain.logs.regimes import regime_of
from terrain.measured_slip.delay import Delay, DelayStatus
from terrain.measured_slip.measure import (
    NO_ROLLERS,
    Measured,
    NamedSurface,
    distances_of,
    measure,
    named_surfaces,
    one_robot,
    rollers_of,
    single_terrain,
)
from terrain.measured_slip.prediction_scores import Cases, PredictionFigures, predictions
from terrain.measured_slip.rollers import RollerFindings
from terrain.measured_slip.slips import MeasuredSlip, measured_slip
from terrain.measured_slip.surfaces import SurfaceSlip, surface_slip
from terrain.measured_slip.wheel_distance import DistanceBound
from terrain.records import Array, RunLog
from terrain.robots import OmniRobot, Robot, as_drive

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.slip.modes import PoseSettings

SHORT_S, SHORT_STRIDE_S = 0.5, 0.1
"""Windows of the stream ``slip`` that runs are written with."""

MIN_SIDEWAYS = 0.2
"""Ratio of the windows that drive to the side, from which slip is drawn over the direction of travel."""

UNLABELLED = "(no label)"
SLIP, FINE = ".3f", ".4f"


@dataclass(frozen=True)
class MeasuredSlipResult(Result):
    """Slip measured from outside."""

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
    out: Path | None = described("folder of the runs with their slip")
    figures: tuple[str, ...] = described("files")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a surface."""
        return frame(self.surfaces)


def measure_runs(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: PoseSettings,
    progress: Progress = silent,
    keep: Keep | None = None,
) -> MeasuredSlipResult:
    """Measure the slip of runs, and on request predict it.

    Parameters
    ----------
    runs : of one robot
    robot : whose they are; by default the one that they name
    options : windows, delay, predictions
    keep : gets each run with the stream ``slip``, over windows of :data:`SHORT_S`

    Raises
    ------
    ConfigError
        if a robot is unknown, or rollers are asked for of one that has none.
    DataError
        if the runs are of several robots, none has a slip, or predictions are asked for and there is nothing
        to predict from.
    """
    robot = one_robot(runs, robot)
    if options.rollers:
        as_drive(OmniRobot, robot, NO_ROLLERS)
    found = measure(
        runs,
        robot,
        window_s=options.window_s,
        stride_s=options.stride_s,
        delay_s=options.delay_s,
        seed=options.seed,
        progress=progress,
    )
    if not found.slips:
        raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {found.failed[0]}")
    rng = np.random.default_rng(options.seed)
    by_terrain: dict[str, list[MeasuredSlip]] = {}
    for run, slip in zip(found.runs, found.slips, strict=True):
        by_terrain.setdefault(single_terrain(run), []).append(slip)
    names = sorted(by_terrain, key=lambda name: (name == "", name))
    surfaces = tuple(surface_slip(name, by_terrain[name], rng) for name in names)
    predicted = []
    if options.predict:
        cases = cases_of(found.runs, found.slips, options.window_s)
        predicted = predictions(cases, options.hold_out, options.seed, progress)
    rollers = rollers_of(found, robot, options.seed) if options.rollers else None
    result = MeasuredSlipResult(
        robot=robot.name,
        window_s=options.window_s,
        stride_s=options.stride_s,
        seed=options.seed,
        sources=dict(sorted(Counter(slip.source for slip in found.slips).items())),
        delays=found.delays,
        surfaces=surfaces,
        predictions=tuple(predicted),
        rollers=rollers,
        named=() if rollers is None else named_surfaces(found, robot, rollers),
        distances=distances_of(found, robot, options.seed) if options.rollers else {},
        not_measured=tuple(found.failed),
        n_runs=len(runs),
        out=None,
        figures=(),
        skipped=(),
    )
    if keep is not None:
        _hand_over(found, robot, keep, progress)
    return replace(result, pictures=_figures(result, {name: by_terrain[name] for name in names}))


def _hand_over(found: Measured, robot: Robot, keep: Keep, progress: Progress) -> None:
    """Give runs on with their slip over short windows."""
    for done, run in enumerate(found.runs, start=1):
        slip = measured_slip(
            run,
            robot,
            window_s=SHORT_S,
            stride_s=SHORT_STRIDE_S,
            delay_s=found.delays[run.session].applied_s,
            whole=True,
        )
        keep(replace(run, streams={**run.streams, "slip": slip.track.as_stream()}), dict)
        progress("write runs", done, len(found.runs))


def cases_of(runs: Sequence[RunLog], measured: Sequence[MeasuredSlip], window_s: float) -> Cases:
    """Return the windows of runs whose slip was measured in steady motion.

    Raises
    ------
    DataError
        if the runs have no currents, or no window has a slip.
    """
    starts = {each.run_id: each.start_s[each.steady & np.isfinite(each.body_slip)] for each in measured}
    chosen = [run for run in runs if starts.get(run.run_id, np.empty(0)).size]
    if not chosen:
        raise DataError(
            f"no window of {window_s:g} s has a measured slip in steady motion that could be predicted; a "
            "shorter --window may"
        )
    rule = WindowRule(window_s, None, None)
    layout = layout_of(chosen, ("wheels", "currents"), speeds=True)
    windows = cut_windows(chosen, rule, layout=layout, starts_s=starts, skip_short=True).windows
    extractor = ResponseExtractor(("wheels", "currents")).fit(windows)
    slips = {
        (each.run_id, round(float(start_s), 6)): slip
        for each in measured
        for start_s, slip in zip(each.start_s, each.body_slip, strict=True)
    }
    slip = np.array(
        [slips[run_id, round(float(s), 6)] for run_id, s in zip(windows.run_id, windows.start_s, strict=True)]
    )
    about = {run.run_id: (run.terrains, run.session, regime_of(run)) for run in chosen}
    of_windows = [about[name] for name in windows.run_id]
    return Cases(
        extractor.transform(windows),
        extractor.columns_,
        slip,
        windows.run_id.astype(str),
        np.array([terrains[0] if len(terrains) == 1 else "" for terrains, _, _ in of_windows]),
        np.array([session for _, session, _ in of_windows]),
        np.array([regime for _, _, regime in of_windows]),
    )


SURFACES = (
    Shown("surface", lambda row: row.terrain or UNLABELLED),
    Shown("runs", "n_runs"),
    Shown("windows", "n_windows"),
    Shown("slip", "slip_ratio", SLIP),
    Shown("95 % over runs", "interval", SLIP),
    Shown("quartiles of windows", "spread", SLIP),
    Shown("std of a window", "std", SLIP),
    Shown("held-out difference", "held_out", SLIP),
    Shown("wheels", lambda row: " ".join(format_value(slip, "+.2f") for slip in row.wheel_slip)),
    Shown("yaw rate over wheels'", "turn_ratio", ".2f"),
)

PREDICTIONS = (
    Shown("held out", "held_out"),
    Shown("runs", "n_runs"),
    Shown("windows", "n_windows"),
    Shown("RMS error", "rms", FINE),
    Shown("95 %", "rms_interval", SLIP),
    Shown("bias", "bias", "+.4f"),
    Shown("inside 95 %", "coverage", ".1%"),
    Shown("width", "width", SLIP),
    Shown(
        "by terrain", lambda row: ", ".join(f"{k} {format_value(v, SLIP)}" for k, v in row.by_terrain.items())
    ),
)


def report(result: MeasuredSlipResult) -> Report:
    """Return slip by surface, delays, predictions, and which runs have no slip and why."""
    title = f"median slip over {result.window_s:g} s, by surface"
    parts: list[Part] = [table(result.surfaces, SURFACES, title)]
    parts += [Text(delay_sentence(*each)) for each in result.delays.items()]
    if result.predictions:
        parts.append(
            table(result.predictions, PREDICTIONS, "slip predicted from currents and wheel speeds alone")
        )
    if result.rollers is not None:
        parts.append(_roller_table(result.rollers))
        parts += [Text(sentence) for sentence in _roller_sentences(result, result.rollers)]
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
        "motion; standing robots have none. A run counts by its median; the held-out difference is the largest "
        "of a fifth of the runs against the others. An error of the wheels' radius or of the outside "
        "measurement's scale is not in the intervals: 1 % of it is 0.01 (1 - slip) of slip."
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
        f"terrain learn-slip --data DIR --robot {result.robot} --out table.yaml",
    )


def _answer(result: MeasuredSlipResult) -> str:
    sources = enumerated([f"the stream {name} in {n} runs" for name, n in result.sources.items()])
    known = [row for row in result.surfaces if np.isfinite(row.slip_ratio)]
    if known:
        slips = [f"{format_value(row.slip_ratio, SLIP)} on {row.terrain or UNLABELLED}" for row in known]
        return f"{result.robot} slips by {enumerated(slips)}, measured by {sources}."
    if any(row.n_windows for row in result.surfaces):
        return f"No slip is known in steady motion, measured by {sources}."
    return f"No window of {result.window_s:g} s is covered by {sources}; a shorter --window may be."


def delay_sentence(session: str, delay: Delay) -> str:
    """Return in a sentence by how much the outside measurement is late."""
    where = f"Session {session}: the" if session else "The"
    if delay.status is DelayStatus.UNDETERMINED:
        return f"{where} delay of the outside measurement was not found, and none is taken off."
    return (
        f"{where} outside measurement is {delay.delay_s:+.3f} s behind the wheels "
        f"(± {1.96 * delay.std_s:.3f}), which is taken off."
    )


def _roller_table(found: RollerFindings) -> Table:
    columns = (
        Shown("surface", str),
        Shown("roller friction", found.roller_ratio.get, SLIP),
        Shown("95 %", found.roller_interval.get, SLIP),
        Shown("RMS of slip left, held out", found.held_out_rms.get, FINE),
        Shown("about the mean", found.plain_rms.get, FINE),
    )
    note = (
        "Friction of the rollers over the stiffness of traction, both in proportion to the load of a wheel."
    )
    return table(found.roller_ratio, columns, "what makes it slip", note)


def _roller_sentences(result: MeasuredSlipResult, found: RollerFindings) -> list[str]:
    """Return what of the slip is the robot's own, which surfaces rollers name, and where the wheels are."""
    loads = ", ".join(
        f"{format_value(load, SLIP)} ({interval(*ends, SLIP)})"
        for load, ends in zip(found.load_ratio, found.load_interval, strict=True)
    )
    sentences = [
        f"Load of the wheels: {loads}.",
        f"Slip alike in all directions on all surfaces: {format_value(found.scale_error, SLIP)} "
        f"({interval(*found.scale_interval, SLIP)}); the wheels' radius or the scale of the outside "
        "measurement, which these runs do not distinguish.",
    ]
    for name, other in found.other_loads.items():
        before, after = (format_value(rms, FINE) for rms in found.other_rms[name])
        text = ", ".join(format_value(load, SLIP) for load in other)
        sentences.append(
            f"{name}: the surface is {found.other_surface[name]}, the load of the wheels {text}, by which "
            f"{before} of RMS falls to {after}."
        )
    for each in result.named:
        if each.n_right is not None:
            of = "fitted" if each.group in found.roller_ratio else "not fitted"
            sentences.append(
                f"{each.group}, {of}: {each.n_right} of {each.n_runs} runs are named by their slip."
            )
            continue
        counts = ", ".join(f"{name} {n}" for name, n in sorted(each.windows.items(), key=lambda x: -x[1]))
        sentences.append(f"{each.group or UNLABELLED}: windows of {each.n_runs} runs look like {counts}.")
    for name, bound in result.distances.items():
        sentences.append(
            f"{name}: turns are those of wheels {format_value(bound.distance_m, FINE, 'm')} from the middle "
            f"that turn without slip ({interval(*bound.interval_m, FINE)}, {bound.n_runs} runs)."
        )
    return sentences


def _figures(
    result: MeasuredSlipResult, by_terrain: Mapping[str, Sequence[MeasuredSlip]]
) -> dict[str, Figure]:
    """Return slip by surface, a run a point, and by the direction of travel or the turn, a window a point."""
    rows, rng = result.surfaces, np.random.default_rng(0)
    names = tuple(row.terrain or UNLABELLED for row in rows)
    low, high = np.array([row.interval for row in rows]).T
    bars = Bars("median, 95 % over runs", names, np.array([row.slip_ratio for row in rows]), low, high)
    points = []
    for place, (name, row) in enumerate(zip(names, rows, strict=True)):
        known = [
            slip.body_slip[slip.steady & np.isfinite(slip.body_slip)] for slip in by_terrain[row.terrain]
        ]
        medians = np.array([np.median(each) for each in known if each.size])
        if medians.size:
            points.append(Points(name, medians, place + rng.uniform(-0.22, 0.22, medians.size)))
    label = f"slip ratio of the body over {result.window_s:g} s"
    figures = {
        "slip_by_surface": Figure(
            f"Slip of {result.robot} by surface, measured from outside",
            (Panel((bars,)),),
            "The median over runs and its 95 % interval over runs.",
            x_label=label,
        ),
    }
    if points:
        figures["slip_by_run"] = Figure(
            f"Slip of {result.robot}, a run a point",
            (Panel(tuple(points), "surface"),),
            "The median of each run; surfaces one above another.",
            x_label=label,
        )
    return figures | {"slip_by_motion": _by_motion(result, by_terrain)}


def _by_motion(result: MeasuredSlipResult, by_terrain: Mapping[str, Sequence[MeasuredSlip]]) -> Figure:
    rolled = np.concatenate([slip.rolled_twist for slips in by_terrain.values() for slip in slips])
    with np.errstate(invalid="ignore"):
        sideways = np.nanmean(np.abs(rolled[:, 1]) > 0.1 * np.abs(rolled[:, 0])) > MIN_SIDEWAYS
    marks = []
    for terrain, slips in by_terrain.items():
        rows = [slip.steady & np.isfinite(slip.body_slip) for slip in slips]
        twist = np.concatenate([slip.rolled_twist[row] for slip, row in zip(slips, rows, strict=True)])
        ratio = np.concatenate([slip.body_slip[row] for slip, row in zip(slips, rows, strict=True)])
        if ratio.size:
            marks.append(Points(terrain or UNLABELLED, _motion(twist, sideways), ratio))
    return Figure(
        f"Slip of {result.robot} by how it was driven, a window a point",
        (
            Panel(
                tuple(marks),
                "slip ratio of the body",
                x_range=(-180.0, 180.0) if sideways else (-3.0, 3.0),
            ),
        ),
        "A window of steady motion a point.",
        x_label="direction of travel in the body's axes [degrees]"
        if sideways
        else "yaw rate of the wheels over their speed [rad/m]",
    )


def _motion(twist: Array, sideways: bool) -> Array:
    if sideways:
        return np.degrees(np.arctan2(twist[:, 1], twist[:, 0]))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(twist[:, 2] / np.abs(twist[:, 0]))
