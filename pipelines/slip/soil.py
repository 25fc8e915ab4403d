"""``terrain calibrate --what soil``: which law of a wheel in sand holds on trials that its fit did not have."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.data.datasets import load
from pipelines.report.figure import Figure, Line, Mark, Panel, Points
from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Column, Part, Report, Section, Table, Text, sections
from pipelines.slip.calibrate import Settings
from pipelines.slip.shown import write_figures
from terrain.errors import DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.logs.run_folders import data_digest
from terrain.records import RunLog
from terrain.slip_learning.soil import (
    BAR_RATIO,
    GIVEN,
    HELD_OUT,
    WHEELS,
    Misfit,
    Prediction,
    Trials,
    WheelResult,
    compare_laws,
    soil_yaml,
    trials_of,
)

ERROR = ".1%"

LEFT_OUT = {"slip": "slips left out", "angle": "slip angles left out"}

PANELS = (("pull_n", "traction [N]"), ("side_n", "side force [N]"), ("sinkage_m", "sinkage [mm]"))


class SoilResult(Result):
    """Laws of a wheel in sand, compared on what their fits did not have."""

    out: Path | None = described("folder of the soils")
    dataset: str = described("name of the data")
    data_digest: str = described("of the trials")
    seed: int = described("of the bootstrap")
    draws: int = described("bootstrap samples behind the intervals")
    bar_ratio: float = described("error of each force over the load that is aimed at", "1")
    wheels: tuple[WheelResult, ...] = described("one each")
    files: tuple[str, ...] = described("that were written")
    skipped: tuple[str, ...] = described("a sentence for each trial that was skipped")
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def records(self) -> Iterable[Any]:
        """Return the errors of each law on what was left out, a row each; slip and load given."""
        return (
            {"wheel": wheel.wheel, "law": row.name, "held_out": held, **getattr(row, held).load._asdict()}
            for wheel in self.wheels
            for row in wheel.laws
            for held in HELD_OUT
        )


def calibrate(settings: Settings, progress: Progress) -> SoilResult:
    """Compare laws on held-out slips and angles, wheel by wheel, and write soils and pictures.

    Raises
    ------
    LogError
        if a trial, also of ``check``, cannot be read.
    DataError
        if no run is a trial of the testbed, or a wheel has too few settings.
    TerrainError
        if a folder cannot be written.
    """
    runs, skipped, doubts = load(settings)
    out = settings.out
    for folder in (out, settings.figures):
        if folder is not None:
            ensure_writable(folder)
    further: Sequence[RunLog] = ()
    if (check := settings.check) is not None:
        further, _, more = load(settings.model_copy(update={"data": check, "robot": None, "mapping": None}))
        doubts += more
    for folder, given in ((settings.data, runs), (check, further)):
        if given and not any(run.robot in WHEELS for run in given):
            raise DataError(
                f"{folder}: none of {len(given)} runs is a trial of a wheel testbed (robots {', '.join(WHEELS)}): "
                "give a folder with smooth.csv or grouser.csv"
            )
    results: list[WheelResult] = []
    pictures: dict[str, Figure] = {}
    for robot, wheel in WHEELS.items():
        own, others = ([run for run in each if run.robot == robot] for each in (runs, further))
        if not own:
            continue
        checked = trials_of(others, wheel) if others else None
        law = settings.laws, settings.draws, settings.seed
        result, shown, predictions = compare_laws(trials_of(own, wheel), checked, wheel, *law, progress)
        if out is not None:
            name, soil = f"testbed_sand_{result.wheel}", result.soil
            file, friction = out / f"{name}.yaml", result.parameters["tan_friction"]
            atomic_write(
                file, soil_yaml(name, result.wheel, settings.dataset, soil.fit, friction, result.law)
            )
            result = replace(result, soil=soil._replace(file=file))
        results.append(result)
        for held, text in LEFT_OUT.items():
            pictures[f"{wheel.name}_{text}"] = held_out_figure(result, shown, predictions[held], held)
    files = [str(result.soil.file) for result in results if result.soil.file is not None]
    if settings.figures is not None:
        files += write_figures(pictures, settings.figures)
    return SoilResult.of(
        settings,
        data_digest=data_digest(runs),
        bar_ratio=BAR_RATIO,
        wheels=tuple(results),
        files=tuple(files),
        skipped=tuple(skipped),
        pictures=pictures,
    ).with_doubts(doubts)


def report(result: SoilResult) -> Report:
    """Return the laws of each wheel with their errors on what was left out, the parameters and the limits."""
    parts: list[Part] = []
    details: list[Section] = []
    for wheel in result.wheels:
        figures = [each for name, each in result.pictures.items() if name.startswith(f"{wheel.wheel}_")]
        rows: list[dict[str, Any]] = [
            law._asdict() | {"given": given} | {out: getattr(getattr(law, out), given) for out in HELD_OUT}
            for law in wheel.laws
            for given in GIVEN
            if math.isfinite(getattr(law.slip, given).pull_ratio)
        ]
        polynomial = {"slip": wheel.surrogate_slip, "angle": wheel.surrogate_angle}
        rows.append({"name": "(polynomial of slip and angle)", "given": "load", **polynomial})
        title = f"{wheel.wheel} wheel, {wheel.n_trials} trials: errors over the load"
        note = "Root mean squares over the measured load, with slip and angle given."
        parts += [Table(LAWS, rows, title, note), Text(wheel.verdict)]
        details += sections((f"{wheel.wheel} wheel", [*_wheel_details(wheel), *figures]))
    answers = " and ".join(f"{each.laws[-1].slip.load.forces} ({each.wheel} wheel)" for each in result.wheels)
    soil = next((wheel.soil.file for wheel in result.wheels if wheel.soil.file is not None), "FILE")
    return Report(
        f"Wheel in sand, {result.dataset}",
        f"On slips left out, {result.wheels[0].law} predicts traction and side force within {answers} of the load.",
        parts=parts,
        details=[*details, *sections(("Not read", result.skipped))],
        next_step=f"terrain simulate --robot husky --terrain {soil} --scenario straight --out runs/",
    )


def _errors(place: str, out: str = "") -> tuple[Column, ...]:
    """Return columns of the errors that records have at a place, headed by what was left out."""
    return (
        Column(f"{out}traction", ERROR, of=f"{place}.pull_ratio"),
        Column(f"{out}side force", ERROR, of=f"{place}.side_ratio"),
        Column(f"{out}sinkage", ".4f", "m", of=f"{place}.sinkage_m"),
    )


LAWS = (
    *(Column("law", of="name"), Column("parameters", of="n_parameters"), Column("given", of="given")),
    *(column for out in HELD_OUT for column in _errors(out, f"{out} out: ")),
)

PARAMETERS = (
    *(Column("parameter", of="name"), Column("value", of="value"), Column("95 %", of="interval")),
    *(Column("of the prior", ".2f", of="informed_ratio"), Column("identified", of="identified")),
)

MISFITS = (Column("", of="name"), Column("trials", of="misfit.n_trials"), *_errors("misfit"))


def _wheel_details(wheel: WheelResult) -> list[Part]:
    misfits: dict[str, Mapping[Any, Misfit]] = {
        "by regime, slips left out": wheel.regimes,
        "by the wheel speed left out [mm/s]": wheel.by_slip,
        "by the slip angle left out [degrees]": wheel.by_angle,
    }
    soil, (low_m, high_m) = wheel.soil.misfit, wheel.sinkage_range_m
    prior = (
        '"Of the prior": standard deviation with the trials over that without; below 0.5 one is identified.'
    )
    return [
        Text(
            f"{wheel.n_trials} trials at {wheel.n_settings} settings, load "
            f"{format_value(wheel.load_range_n, '.1f', 'N')}, sinkage {1e3 * low_m:.0f} to {1e3 * high_m:.0f} mm, "
            f"{wheel.deeper_than_axle} trials deeper than the axle; {wheel.coupling.text}."
        ),
        Table(PARAMETERS, [*wheel.parameters.values()], f"parameters of {wheel.law}", prior),
        *(
            Table(MISFITS, [{"name": name, "misfit": each} for name, each in rows.items()], title)
            for title, rows in misfits.items()
        ),
        *map(Text, wheel.not_identified),
        Text(
            f"On trials that roll nearly straight the simulator's law is off by {soil.forces} (traction and side "
            f"force) and {format_value(1e3 * soil.sinkage_m, '.1f', 'mm')}."
        ),
    ]


def held_out_figure(wheel: WheelResult, trials: Trials, prediction: Prediction, held_out: str) -> Figure:
    """Show traction, side force and sinkage of single trials over slip, as measured and by the last law."""
    panels = []
    for name, y_label in PANELS:
        scale = 1e3 if name.endswith("_m") else 1.0
        measured, predicted = scale * getattr(trials, name), scale * getattr(prediction, name)
        marks: list[Mark] = []
        for number, angle in enumerate(np.unique(trials.angle_setting)):
            rows, colour = np.flatnonzero(trials.angle_setting == angle), number % 7
            own = [rows[trials.slip_setting[rows] == speed] for speed in np.unique(trials.slip_setting[rows])]
            slips, means = ([float(of[each].mean()) for each in own] for of in (trials.slip_ratio, predicted))
            label = f"{angle:g} degrees"
            marks.append(Points(f"{label}, measured", trials.slip_ratio[rows], measured[rows], colour=colour))
            marks.append(Line(label, slips, means, colour))
        panels.append(Panel(marks, y_label))
    title = f"{wheel.wheel} wheel, law {wheel.law}, {LEFT_OUT[held_out]}"
    caption = "Points are measured, lines predicted; a colour a slip angle."
    return Figure(title, panels, caption, x_label="slip ratio")
