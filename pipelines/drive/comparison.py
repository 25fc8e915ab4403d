"""Controllers side by side in the closed loop, in the same situations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.drive.drive import Settings
from pipelines.drive.run_figures import DriveCurves, drive_curves, run_figures
from pipelines.learn.parallel import parallel
from pipelines.live.model import TerrainModel
from pipelines.live.pilot import LivePilot, pilot_classifier
from pipelines.report.figure import Bars, Figure, Panel, Points
from pipelines.report.numbers import NOT_KNOWN, format_value, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import Column, Pairs, Part, Report, Table, Text, sections
from pipelines.report.versions import versions
from pipelines.slip.table import law_marks
from terrain.control.controllers import (
    TRACK,
    Controller,
    Source,
    adapts,
    kind_of,
    make_controller,
    pairs_to_compare,
)
from terrain.control.drive_metrics import (
    ABSOLUTE,
    LABELS,
    Comparison,
    Drive,
    MeanInterval,
    Metrics,
    add_energies,
    drive_history,
    energy_curve,
    evaluate_drive,
    matching_ramp,
    steepest_grade,
)
from terrain.control.situations import (
    COURSE,
    SITUATIONS,
    SLOPE,
    Situation,
    SituationOptions,
    make_situation,
    simulate_situation,
)
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import KnownTerrain, TerrainSource
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import Robot, load_robot, robot_argument
from terrain.simulation.assumed import with_assumed
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

PICTURED = 3  #: Metrics of the first picture


@dataclass(frozen=True, slots=True, eq=False)
class DriveInputs:
    """Robots and models of a comparison."""

    robot: Robot  # as the controllers assume it
    table: SlipTable
    model: TerrainModel | None = None  # classifier of ``classified`` and ``thesis:classified``
    plant: Robot | None = None  # that is simulated, where it is another one

    @property
    def simulated(self) -> Robot:
        """The robot that is simulated."""
        return self.plant or self.robot

    def of(self, controller: Controller) -> DriveInputs:
        """Return what a controller needs: a model is large to send to another process."""
        return self if controller.source is Source.CLASSIFIER else replace(self, model=None)


def drive_once(inputs: DriveInputs, controller: Controller, situation: Situation) -> RunLog:
    """Return the log of one drive, the pilot's status in its stream ``control``."""
    source = _terrain_source(controller, inputs.model, inputs.robot)
    pilot = LivePilot(inputs.robot, controller.table, source, controller.pilot)
    return simulate_situation(inputs.simulated, situation, pilot.step, controller.pilot.delay_s)


def _terrain_source(controller: Controller, model: TerrainModel | None, robot: Robot) -> TerrainSource:
    if controller.source is Source.NONE:
        return TerrainSource()
    if controller.source is Source.TRUTH:
        return KnownTerrain()
    if controller.source is Source.KNOWN:
        return KnownTerrain(lambda _: controller.known_terrain)
    if model is None:
        raise ConfigError(f"controller {controller.name!r} needs a classifier: give a model")
    return pilot_classifier(model, robot)


def train_classifier(robot: Robot, seed: int, progress: Progress = silent) -> TerrainModel:
    """Return a classifier that was trained on simulated labelled runs of a robot, as many as of quickstart.

    The runs differ from the drives of ``terrain drive`` at any seed.
    """
    from pipelines.learn.settings import RecipeSettings
    from pipelines.learn.training_data import fitted_model
    from pipelines.slip.labelled import RUNS_A_TERRAIN, SCENARIO, labelled_runs

    if robot.drive == "swerve":
        runs, _, _ = labelled_runs(seed, RUNS_A_TERRAIN, progress, robot)
    else:  # of what is measured
        runs, numbers = [], range(1, RUNS_A_TERRAIN + 1)
        of_runs = [(terrain, number) for terrain in soil_names() for number in numbers]
        for done, (terrain, number) in enumerate(of_runs, start=1):
            runs.append(simulate_run(robot, terrain, SCENARIO, seed, number, vary=True))
            progress("simulate", done, len(of_runs))
    progress("train", 0, 1)
    model = fitted_model(runs, RecipeSettings(seed=seed), "simulated")
    progress("train", 1, 1)
    return model


class DriveResult(Result, eq=False):
    """Controllers side by side, over the same seeds."""

    scenario: str = described("what was driven")
    terrain: str = described("soil, or course for all")
    robot: str = described("name")
    table: str = described("name of the table of target slips")
    seeds: tuple[int, ...] = described("of the drives")
    delay_s: float = described("from a sample to the wheel", "s")
    grade_deg: float = described("of the slope, uphill > 0", "deg")
    ramp_mps2: float | None = described(
        "rise of speed of the controller ramp; null where not driven", "m/s^2"
    )
    controllers: Mapping[str, Mapping[str, MeanInterval]] = described(
        "by controller and metric, its mean over seeds with its 95 % interval"
    )
    rows: Mapping[str, tuple[Metrics, ...]] = described("by controller, the metrics of each seed")
    examples: Mapping[str, DriveCurves] = field(default_factory=dict)
    slip_table: SlipTable | None = None

    def records(self) -> Iterable[Any]:
        """Return the metrics, a row for each controller and seed."""
        return (
            {"controller": name, "seed": seed, **metrics}
            for name, rows in self.rows.items()
            for seed, metrics in zip(self.seeds, rows, strict=True)
        )

    @cached_property
    def compared(self) -> Comparison:
        """The metrics, to be compared."""
        return Comparison(self.scenario, self.rows)


def run(settings: Settings, progress: Progress) -> DriveResult:
    """Drive all controllers of the settings at the same seeds, with their robots and table."""
    robot = with_assumed(load_robot(settings.robot))
    plant = None if settings.plant is None else with_assumed(load_robot(settings.plant))
    table = load_slip_table(settings.table, robot.name)
    return compare(settings, DriveInputs(robot, table, plant=plant), progress)


def compare(settings: Settings, inputs: DriveInputs, progress: Progress = silent) -> DriveResult:
    """Drive all controllers at the same seeds, and evaluate them.

    A classifier that a controller needs and the inputs lack is read or trained; before, ``ConfigError`` is raised
    if a controller does not exist on the robot or the table, or the situation does not.
    """
    names, table = settings.controllers, inputs.table
    controllers = [make_controller(name, table, settings.delay_s, settings.ramp_mps2) for name in names]
    for controller in controllers:
        LivePilot(inputs.robot, controller.table, None, controller.pilot)
    _situation(settings, inputs, settings.first_seed)
    if settings.needs_model and inputs.model is None:
        given, seed = settings.model, settings.first_seed
        model = settings.read_model(given) if given else train_classifier(inputs.robot, seed, progress)
        inputs = replace(inputs, model=model)

    def drive_all(
        task: str, controllers: Sequence[Controller], progress: Progress = progress
    ) -> dict[str, list[Drive]]:
        """Return the drives of each controller, one a seed, in as many processes as the settings say."""
        jobs = [(inputs.of(each), each, seed) for each in controllers for seed in settings.all_seeds]
        found = parallel(_drive_one, (settings,), jobs, settings.jobs, task, progress)
        drives, n = list(found), len(settings.all_seeds)
        return {each.name: drives[n * place : n * place + n] for place, each in enumerate(controllers)}

    def ramp(rise_mps2: float | None) -> Controller:
        return make_controller("ramp", table, settings.delay_s, rise_mps2)

    def try_ramp(rise_mps2: float) -> list[Drive]:
        return drive_all("", [ramp(rise_mps2)], silent)["ramp"]

    others = [each for each in controllers if each.name != "ramp"]
    drives = drive_all("drive", others) if others else {}
    ramp_mps2 = None
    if "ramp" in names:
        ramp_mps2 = settings.ramp_mps2
        if ramp_mps2 is None:
            ramp_mps2 = matching_ramp(drives, try_ramp, settings.scenario, settings.accel_mps2)
        drives |= drive_all("drive ramp", [ramp(ramp_mps2)])
        ramp_mps2 = ramp(ramp_mps2).pilot.ramp_mps2
    add_energies(drives)
    rows = {name: tuple(one.metrics for one in drives[name]) for name in names}
    return DriveResult.of(
        settings,
        robot=inputs.robot.name,
        table=table.name,
        seeds=tuple(settings.all_seeds),
        ramp_mps2=ramp_mps2,
        controllers=Comparison(settings.scenario, rows).means,
        rows=rows,
        examples={name: curves for name in names if (curves := drives[name][0].curves) is not None},
        slip_table=table,
    )


def _situation(settings: Settings, inputs: DriveInputs, seed: int) -> Situation:
    chosen = {each.name: getattr(settings, each.name) for each in fields(SituationOptions)}
    options = SituationOptions(**{name: value for name, value in chosen.items() if value is not None})
    return make_situation(settings.scenario, inputs.simulated, settings.terrain, seed, options)


def _drive_one(settings: Settings, inputs: DriveInputs, controller: Controller, seed: int) -> Drive:
    situation, robot = _situation(settings, inputs, seed), inputs.simulated
    log = drive_once(inputs, controller, situation)
    history = drive_history(log, robot, situation.conditions.radius_factors)
    adapting_to = controller.table if adapts(controller.name) else None
    metrics = evaluate_drive(log, history, robot, situation, adapting_to)
    curves = drive_curves(log, controller.table) if seed == settings.first_seed else None
    drive = Drive(metrics, energy_curve(history, situation.scenario), curves)

    def climb(grade_deg: float) -> RunLog:
        steeper = settings.model_copy(update={"grade_deg": grade_deg})
        return drive_once(inputs, controller, _situation(steeper, inputs, seed))

    if settings.scenario == SLOPE:
        drive.metrics["steepest_deg"] = steepest_grade(climb)
    return drive


def report(result: DriveResult) -> Report:
    """Return the main difference, what each controller costs and brings, and behind it every figure."""
    names, shown, compared = list(result.controllers), result.compared.shown, result.compared
    pairs = pairs_to_compare(names) if shown else []
    grade = f", {result.grade_deg:g}° uphill" if result.grade_deg else ""
    named = Path(result.terrain).stem if result.terrain.endswith("ml") else result.terrain
    means = [(name, *(compared.value(name, key).mean for key in shown)) for name in names]
    labels = [metric_label(key) for key in shown]
    columns = [Column("mean over seeds"), *(Column(text, unit=unit) for text, unit, _ in labels)]
    return Report(
        title=f"{result.scenario} on {'all terrains' if named == COURSE else named}{grade}",
        answer=verdict(result, pairs),
        lead=(
            f"{result.robot} · {plural(len(result.seeds), 'seed')} · delay {1000 * result.delay_s:g} ms · "
            f"table {result.table}"
        ),
        picture=_picture(result),
        parts=[*map(Text, belief_notes(compared)), Table(columns, means)],
        details=sections(
            ("Who differs, and by how much", _difference_parts(compared, pairs)),
            ("Controllers", [Pairs([(name, _text(name, result.ramp_mps2)) for name in names])]),
            ("All figures", _metric_parts(result)),
            ("The first seed, run by run", run_figures(result.examples)),
            ("The curves behind the targets", _curve_parts(result.slip_table)),
            ("Where these numbers come from", _provenance(result)),
        ),
        next_step=f"terrain drive --faults all --robot {robot_argument(result.robot)}",
    )


def metric_label(key: str) -> tuple[str, str, str]:
    """Return the name of a metric, its unit or nothing, and the name with the unit in brackets.

    Examples
    --------
    >>> metric_label("first_distance_5s_m")[0], metric_label("energy_4m_j")[2]
    ('distance within 5 s of a start, first start', 'energy of the first 4 m [J]')
    """
    text, unit = LABELS[key.removeprefix("first_")]
    text = f"{text}, first start" if key.startswith("first_") else text
    return text, unit, f"{text} [{unit}]" if unit else text


def belief_notes(compared: Comparison) -> tuple[str, ...]:
    """Return a sentence on each controller whose classifier was never or hardly believed."""
    notes = []
    for name in filter(compared.is_hardly_believed, compared.rows):
        believed = compared.value(name, "believed_ratio").mean or 0.0
        how = f"in {100.0 * believed:.1f} % of the driving time only" if believed else "at no time"
        kinds = ("accepted", "below_threshold", "refused")
        outputs = [f"{format_value(compared.value(name, f'n_{kind}').mean)} {kind}" for kind in kinds]
        notes.append(
            f"{name} knew the terrain {how} (outputs of its classifier in a drive: "
            f"{', '.join(outputs).replace('_', ' the ')}): it drove on the targets of the table's fallback, "
            "and no difference to another controller is a "
            "gain of the classifier."
        )
    return tuple(notes)


def verdict(result: DriveResult, pairs: Sequence[tuple[str, str]]) -> str:
    """Return a sentence on the significant differences of the main pair, and on the others."""
    compared = result.compared
    if not pairs:
        name = next(iter(result.controllers))
        values = [
            f"{metric_label(key)[0]} {format_value(mean, unit=metric_label(key)[1])}"
            for key in compared.shown
            if (mean := compared.value(name, key).mean) is not None
        ]
        return f"{name}: {', '.join(values) or 'no metric is defined'}."
    preferred = ("classified", "true_terrain", "fallback")
    credited = [pair for pair in pairs if not compared.is_hardly_believed(pair[0])] or pairs
    name, other = next((pair for one in preferred for pair in credited if pair[0] == one), credited[0])
    significant, alike = [], []
    for key in compared.shown:
        found = compared.difference(name, other, key)
        if found is None:
            continue
        if found.ci is None or found.is_significant:
            significant.append(f"{metric_label(key)[0]} {format_value(found.mean, *_signed(key))}")
        else:
            alike.append(metric_label(key)[0])
    parts = [", ".join(significant)] if significant else []
    if alike:
        parts.append(f"no significant difference: {', '.join(alike)}")
    if len(result.seeds) == 1:
        parts.append("one seed, which gives no interval")
    text = f"{name} compared with {other}: {'; '.join(parts) or 'no metric that both have'}."
    if other != "ramp" and (name, "ramp") in pairs:  # which travels as far
        key = compared.shown[0]
        shown = _difference_text(compared.difference(name, "ramp", key), key)
        text += f" Compared with ramp: {metric_label(key)[0]} {shown}."
    return text


def _text(name: str, ramp_mps2: float | None) -> str:
    """Return a sentence on a controller."""
    kind = kind_of(name)
    text = "" if kind is None else kind.text.replace("{ramp}", format_value(ramp_mps2, unit="m/s²"))
    return f"{text} With path tracking." if TRACK in name else text


def _picture(result: DriveResult) -> Figure | None:
    """Return the first metrics of all controllers as bars."""
    names, panels = list(result.controllers), []
    for key in result.compared.shown[:PICTURED]:
        values = [result.compared.value(name, key) for name in names]
        means = [math.nan if value.mean is None else value.mean for value in values]
        low, high = zip(*(value.ci or (math.nan, math.nan) for value in values), strict=True)
        panels.append(Panel([Bars(metric_label(key)[2], names, means, low, high)]))
    n = len(result.seeds)
    caption = "One seed, which gives no interval."
    if n > 1:
        caption = (
            f"Means over {n} seeds and their 95 % intervals. All controllers drive the same seeds, so that bars "
            "whose intervals overlap may still differ significantly, seed by seed."
        )
    return Figure("What it costs, and what it brings", panels, caption) if panels else None


def _difference_parts(compared: Comparison, pairs: Sequence[tuple[str, str]]) -> list[Part]:
    found = {(pair, key): compared.difference(*pair, key) for pair in pairs for key in compared.shown}
    keys = [key for key in compared.shown if any(found[pair, key] is not None for pair in pairs)]
    rows = [
        (f"{name} compared with {other}", *(_difference_text(found[(name, other), key], key) for key in keys))
        for name, other in pairs
    ]
    note = (
        "Differences are means over seeds of the difference at each seed, with their 95 % interval; a star: the "
        "interval excludes zero, which happens by chance in one of twenty. The energy per metre is over the "
        "distance that all travelled who travelled at least half of the longest."
    )
    return [Table(("", *(metric_label(key)[0] for key in keys)), rows, note=note)] if keys else []


def _difference_text(found: MeanInterval | None, key: str) -> str:
    if found is None:
        return NOT_KNOWN
    mean = format_value(found.mean, *_signed(key))
    if found.ci is None:
        return mean
    return f"{mean} ({format_value(found.ci, *_signed(key))}){' *' if found.is_significant else ''}"


def _signed(key: str) -> tuple[str, str]:
    """Return format and unit of a difference: a percentage, or in the metric's unit."""
    return ("+.3g", metric_label(key)[1]) if key in ABSOLUTE else ("+.1%", "")


def _metric_parts(result: DriveResult) -> list[Part | str]:
    """Return all metrics, those that are compared first, and the names of those that no controller has."""
    compared, rows, undefined = result.compared, [], []
    known = [key for metrics in result.controllers.values() for key in metrics]
    for key in dict.fromkeys([*compared.shown, *known]):
        values = [compared.value(name, key) for name in result.controllers]
        if any(value.mean is not None for value in values):
            cells = (_metric_text(value, len(result.seeds)) for value in values)
            rows.append((metric_label(key)[2], key, *cells))
        else:
            undefined.append(f"{metric_label(key)[0]} ({key})")
    note = (
        "Means over seeds, with their 95 % intervals. Each seed draws load, soil, tyres, roughness and noise, the "
        "same for all controllers. n: the number of seeds at which a metric was defined, where it was not at all."
    )
    if any(not adapts(name) and "adapt_s" in metrics for name, metrics in result.controllers.items()):
        note += " Controllers that do not use the terrain have no time to its target."
    if undefined:
        note += f" Not defined here: {', '.join(undefined)}."
    return [
        SITUATIONS.get(result.scenario, ""),
        Table(("metric", "key", *result.controllers), rows, note=note),
    ]


def _metric_text(value: MeanInterval, n_seeds: int) -> str:
    if value.mean is None:
        return NOT_KNOWN
    text = format_value(value.mean) + (f", n {value.n}" if value.n != n_seeds else "")
    if value.ci is None or not value.ci[1] > value.ci[0]:
        return text
    return f"{text} ({format_value(value.ci)})"


def _curve_parts(table: SlipTable | None) -> list[Part]:
    """Return the slip curves of a table, without measurements, which it does not hold."""
    if table is None or not table.curves:
        return []
    panels = []
    for terrain, curve in table.curves.items():
        law, ranges = curve.thrust_ratio, (curve.slip_range_ratio, curve.peak_interval_ratio)
        targets = np.array([table.targets[terrain][state].slip_ratio for state in ("traction", "steady")])
        points = Points("targets of traction and steady motion", targets, law(targets), colour=2)
        marks = [*law_marks(law, *ranges, curve.resistance_ratio), points]
        panels.append(Panel(marks, "thrust over load", f"{terrain}: {curve.law}, {curve.n_runs} runs"))
    caption = (
        "The law fitted to measured runs, and the targets on it; the thrust above the resistance is available to "
        "accelerate and to climb."
    )
    return [Figure(f"Slip curves of the table {table.name}", panels, caption, x_label="slip ratio")]


def _provenance(result: DriveResult) -> list[Part | str]:
    described_by = result.pairs("terrain", "table", "delay_s", "grade_deg", "ramp_mps2")
    return [
        "Robot and terrain are models: controllers are compared on them, and what a robot in a field would do is "
        "not predicted.",
        Pairs([("seeds", (result.seeds[0], result.seeds[-1])), *described_by, ("versions", versions())]),
    ]
