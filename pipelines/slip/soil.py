"""``terrain calibrate --what soil``: which law of a wheel in sand holds on trials that its fit did not have."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.data.datasets import load_runs
from pipelines.data.settings import load
from pipelines.report import (
    Figure,
    Line,
    Mark,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Section,
    Shown,
    Table,
    Text,
    described,
    format_value,
    frame,
    sections,
    table,
)
from pipelines.report.tree import value_at
from pipelines.slip.shown import write_figures
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.logs.digest import data_digest
from terrain.records import RunLog
from terrain.soil_identification.comparison import BAR_RATIO, WheelResult, compare_laws
from terrain.soil_identification.held_out import GIVEN, HELD_OUT, Misfit
from terrain.soil_identification.laws import Prediction
from terrain.soil_identification.soil_file import soil_yaml
from terrain.soil_identification.trials import WHEELS, Trials, trials_of

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.slip.calibrate import Settings

ERROR = ".1%"

LEFT_OUT = {"slip": "slips left out", "angle": "slip angles left out"}

PANELS = (("pull_n", "traction [N]"), ("side_n", "side force [N]"), ("sinkage_m", "sinkage [mm]"))


@dataclass(frozen=True)
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

    def to_pandas(self) -> pd.DataFrame:
        """Return the errors of each law on what was left out, a row each; slip and load given."""
        return frame(
            {"wheel": wheel.wheel, "law": row.name, "held_out": held, **getattr(row, held).load._asdict()}
            for wheel in self.wheels
            for row in wheel.laws
            for held in HELD_OUT
        )


def calibrate(settings: Settings, progress: Progress) -> SoilResult:
    """Compare laws on held-out slips and angles, wheel by wheel, and write soils and pictures.

    Parameters
    ----------
    settings : of ``terrain calibrate``: trials of the wheel testbed
    progress : gets the fits that are done

    Raises
    ------
    ConfigError
        if ``out`` is a file.
    LogError
        if a trial, also of ``check``, cannot be read.
    DataError
        if no run is a trial of the testbed, or a wheel has too few settings.
    TerrainError
        if a folder cannot be written.
    """
    runs, skipped = load(settings)
    out = settings.out
    if out is not None and out.is_file():
        raise ConfigError(f"{out}: is a file; --out names a folder of soils")
    for folder in (out, settings.figures):
        if folder is not None:
            ensure_writable(folder)
    further: list[RunLog] = []
    if (check := settings.check) is not None:
        further = load_runs(check, layout=settings.layout, repair=settings.repair)
        if not any(run.robot in WHEELS for run in further):
            raise DataError(f"--check {check}: none of {len(further)} runs is a trial of a wheel testbed")
    if not any(run.robot in WHEELS for run in runs):
        raise DataError(
            f"none of {len(runs)} runs is a trial of a wheel testbed (robots {', '.join(WHEELS)}): "
            "give a folder with smooth.csv or grouser.csv"
        )
    results: list[WheelResult] = []
    pictures: dict[str, Figure] = {}
    for robot, wheel in WHEELS.items():
        own, others = ([run for run in each if run.robot == robot] for each in (runs, further))
        if not own:
            continue
        result, shown, predictions = compare_laws(
            trials_of(own, wheel),
            trials_of(others, wheel) if others else None,
            wheel,
            settings.laws,
            settings.draws,
            settings.seed,
            progress,
        )
        if out is not None:
            result = _written(result, out, settings.dataset)
        results.append(result)
        for held, text in LEFT_OUT.items():
            figure = held_out_figure(result, shown, predictions[held], held)
            pictures[f"{wheel.name}, {text}"] = figure
    files = [str(result.soil.file) for result in results if result.soil.file is not None]
    if settings.figures is not None:
        named = {name.replace(", ", "_"): figure for name, figure in pictures.items()}
        files += write_figures(named, settings.figures)
    return SoilResult(
        out=out,
        dataset=settings.dataset,
        data_digest=data_digest(runs),
        seed=settings.seed,
        draws=settings.draws,
        bar_ratio=BAR_RATIO,
        wheels=tuple(results),
        files=tuple(files),
        skipped=tuple(skipped),
        pictures=pictures,
    )


def _written(result: WheelResult, out: Path, dataset: str) -> WheelResult:
    """Write the soil of a wheel, and name the file in its result."""
    name, soil = f"testbed_sand_{result.wheel}", result.soil
    text = soil_yaml(name, result.wheel, dataset, soil.fit, result.parameters["tan_friction"], result.law)
    file = out / f"{name}.yaml"
    atomic_write(file, text)
    return replace(result, soil=soil._replace(file=file))


def report(result: SoilResult) -> Report:
    """Return the laws of each wheel with their errors on what was left out, the parameters and the limits."""
    parts: list[Part] = []
    details: list[Section] = []
    for wheel in result.wheels:
        figures = [each for name, each in result.pictures.items() if name.startswith(f"{wheel.wheel},")]
        parts += [_laws_table(wheel), Text(wheel.verdict)]
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


def _errors(of: str, *titles: str) -> list[Shown]:
    """Return columns of the errors of traction, side force and sinkage that a row has at a place."""
    return [
        Shown(titles[0], f"{of}.pull_ratio", ERROR),
        Shown(titles[1], f"{of}.side_ratio", ERROR),
        Shown(titles[2], lambda row: 1e3 * value_at(row, f"{of}.sinkage_m"), ".1f", "mm"),
    ]


def _laws_table(wheel: WheelResult) -> Table:
    columns = (
        Shown("law", "law"),
        Shown("parameters", "n_parameters"),
        Shown("given", "given"),
        *_errors("slip", "slip out: traction", "side", "sinkage"),
        *_errors("angle", "angle out: traction", "side", "sinkage"),
    )
    rows = [
        {
            "law": row.name,
            "n_parameters": row.n_parameters,
            "given": given,
            "slip": getattr(row.slip, given),
            "angle": getattr(row.angle, given),
        }
        for row in wheel.laws
        for given in GIVEN
        if math.isfinite(getattr(row.slip, given).pull_ratio)
    ]
    surrogate = {"slip": wheel.surrogate_slip, "angle": wheel.surrogate_angle}
    rows.append({"law": "(polynomial)", "n_parameters": None, "given": "load", **surrogate})
    title = f"{wheel.wheel} wheel, {wheel.n_trials} trials: errors over the load"
    return table(rows, columns, title, "Root mean squares over the measured load, with slip and angle given.")


PARAMETERS = (
    Shown("parameter", "name"),
    Shown("value", "value"),
    Shown("95 %", "interval"),
    Shown("of the prior", "informed_ratio", ".2f"),
    Shown("identified", "identified"),
)
PRIOR = '"Of the prior": standard deviation with the trials over that without; below 0.5 one is identified.'


def _wheel_details(wheel: WheelResult) -> list[Part]:
    misfits: dict[str, Mapping[Any, Misfit]] = {
        "by regime, slips left out": wheel.regimes,
        "by the wheel speed left out [mm/s]": wheel.by_slip,
        "by the slip angle left out [degrees]": wheel.by_angle,
        "polynomial of slip and angle, no mechanics": {
            "slips left out": wheel.surrogate_slip,
            "angles left out": wheel.surrogate_angle,
        },
    }
    columns = (
        Shown("", "name"),
        Shown("trials", "misfit.n_trials"),
        *_errors("misfit", "traction", "side force", "sinkage"),
    )
    soil, (low_m, high_m) = wheel.soil.misfit, wheel.sinkage_range_m
    return [
        Text(
            f"{wheel.n_trials} trials at {wheel.n_settings} settings, load "
            f"{format_value(wheel.load_range_n, '.1f', 'N')}, sinkage {1e3 * low_m:.0f} to {1e3 * high_m:.0f} mm, "
            f"{wheel.deeper_than_axle} trials deeper than the axle; {wheel.coupling.text}."
        ),
        table(wheel.parameters.values(), PARAMETERS, f"parameters of {wheel.law}", PRIOR),
        *(
            table([{"name": name, "misfit": each} for name, each in rows.items()], columns, title)
            for title, rows in misfits.items()
        ),
        *(Text(sentence) for sentence in wheel.not_identified),
        Text(
            f"On trials that roll nearly straight the simulator's law is off by {soil.forces} (traction and side "
            f"force) and {format_value(1e3 * soil.sinkage_m, '.1f', 'mm')}."
        ),
    ]


def held_out_figure(wheel: WheelResult, trials: Trials, prediction: Prediction, held_out: str) -> Figure:
    """Show traction, side force and sinkage over slip, a colour an angle: points measured, lines predicted.

    Parameters
    ----------
    wheel : whose last law predicts
    trials : single ones
    prediction : of the trials
    held_out : ``slip`` or ``angle``
    """
    errors = getattr(wheel.laws[-1], held_out).load
    panels = []
    for name, label in PANELS:
        scale = 1e3 if name.endswith("_m") else 1.0
        measured, predicted = scale * getattr(trials, name), scale * getattr(prediction, name)
        marks: list[Mark] = []
        for number, angle in enumerate(np.unique(trials.angle_setting)):
            rows = np.flatnonzero(trials.angle_setting == angle)
            speeds = np.unique(trials.slip_setting[rows])
            own = [rows[trials.slip_setting[rows] == speed] for speed in speeds]
            slips = [float(trials.slip_ratio[each].mean()) for each in own]
            means = [float(predicted[each].mean()) for each in own]
            marks.append(
                Points(
                    f"{angle:g} degrees, measured", trials.slip_ratio[rows], measured[rows], colour=number % 7
                )
            )
            marks.append(Line(f"{angle:g} degrees", slips, means, number % 7))
        panels.append(Panel(tuple(marks), label))
    title = (
        f"{wheel.wheel} wheel, law {wheel.law}, {LEFT_OUT[held_out]}: traction off by "
        f"{format_value(errors.pull_ratio, ERROR)} and side force by {format_value(errors.side_ratio, ERROR)} of the "
        f"load (at most {format_value(BAR_RATIO, '.0%')} is aimed at), sinkage by "
        f"{format_value(1e3 * errors.sinkage_m, '.1f', 'mm')}"
    )
    return Figure(
        title,
        tuple(panels),
        "Points are measured, lines predicted; a colour a slip angle.",
        x_label="slip ratio",
    )
