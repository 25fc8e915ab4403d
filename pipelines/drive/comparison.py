"""Controllers side by side in the closed loop, in the same situations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipelines.drive.controller_names import KINDS, TRACK, Source, kind_of, uses_classifier
from pipelines.drive.controllers import (
    DEFAULT_RAMP_MPS2,
    Controller,
    DriveInputs,
    drive_once,
    make_controller,
    train_classifier,
)
from pipelines.drive.metrics import (
    ABSOLUTE,
    ADAPTATION,
    WHERE_ANY,
    metric_label,
    metrics_of_scenario,
    signed_difference,
)
from pipelines.drive.run_figures import run_figures
from pipelines.learn.parallel import parallel
from pipelines.live.pilot import LivePilot
from pipelines.report import (
    NOT_KNOWN,
    Bars,
    Column,
    Figure,
    Line,
    Mark,
    Pairs,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Section,
    Strip,
    Table,
    Text,
    described,
    format_value,
    interval,
    silent,
)
from pipelines.report.versions import versions
from terrain.control.comparison import Difference, MeanInterval, mean_interval, paired_difference
from terrain.control.drive_curves import DriveCurves, drive_curves
from terrain.control.drive_evaluation import (
    START_TIME_S,
    EnergyCurve,
    energy_at_equal_distance,
    energy_curve,
    evaluate_drive,
)
from terrain.control.drive_metrics import PEAK_ABOVE_MPS, drive_history
from terrain.control.situations import (
    COURSE,
    SLOPE,
    STARTS,
    Situation,
    SituationOptions,
    make_situation,
)
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import load_robot
from terrain.slip_learning.laws import LAW_PARAMETERS, traction_ratio

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

STEEPEST_DEG, SLOPE_STEPS = 25.0, 9
"""Range of the search for the steepest grade, and its bisections: to a tenth of a degree."""

CLIMBING_MPS = 0.05
"""A robot that is faster than this in the last second climbs."""

LEAST_RAMP_MPS2, MOST_RAMP_MPS2, RAMP_STEPS = 0.1, 10.0, 7
"""Range of the search for the matching ramp (up to twice the desired rise, where that is finite), and its
bisections."""

REFERENCES = ("true_terrain", "classified", "fallback")
"""Controllers whose distance the ramp matches: the first of them that is driven."""

HARDLY_BELIEVED_RATIO = 0.1
"""Below this ratio of the driving time with a known terrain, nine tenths of a drive are the fallback's."""

SCENARIOS = {
    "starts": "Stand, start, hold the speed, stop: three times. Metrics of a start are means of the second "
    "and third, when the slip of steady motion is known; those of the first are listed beside them in the "
    "table.",
    "brake": "Drive, and stop as fast as possible.",
    "slope": "Uphill; the steepest grade is searched for at each seed.",
    "course": "All terrains one after the other.",
    "mixed": "Terrains in any order, and no camera for three seconds.",
}

PICTURED = 3
"""Metrics of the first picture."""

Metrics = Mapping[str, float]
"""Metrics of one drive by name; NaN where one is undefined."""

_UNKNOWN = MeanInterval(None, None, 0)


@dataclass(frozen=True, eq=False, repr=False)
class DriveResult(Result):
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

    def to_pandas(self) -> pd.DataFrame:
        """Return the metrics, a row for each controller and seed."""
        import pandas as pd

        return pd.DataFrame(
            [
                {"controller": name, "seed": seed, **metrics}
                for name, rows in self.rows.items()
                for seed, metrics in zip(self.seeds, rows, strict=True)
            ]
        )


class Drive(NamedTuple):
    """Metrics of one drive by name, its energy over distance, and at the first seed its curves."""

    metrics: dict[str, float]
    energy: EnergyCurve
    curves: DriveCurves | None


def run(settings: Settings, progress: Progress) -> DriveResult:
    """Drive all controllers of the settings at the same seeds.

    Raises
    ------
    ConfigError
        if a controller does not exist on the robot or the table, or the situation does not.
    TerrainError
        if the robot, the table or the classifier cannot be read.
    """
    robot = load_robot(settings.robot)
    plant = None if settings.plant is None else load_robot(settings.plant)
    inputs = DriveInputs(robot, load_slip_table(settings.table, robot.name), plant=plant)
    check_drive(settings, inputs)
    if settings.needs_model and settings.model is None:
        inputs = replace(inputs, model=train_classifier(robot, settings.first_seed, progress))
    elif settings.model is not None:
        from pipelines.learn.load import load_model

        inputs = replace(inputs, model=load_model(settings.model))
    return compare(settings, inputs, progress)


def check_drive(settings: Settings, inputs: DriveInputs) -> None:
    """Refuse what cannot be driven, before anything is.

    Raises
    ------
    ConfigError
        if a controller does not exist on the robot or the table, or the situation does not.
    """
    for controller in _controllers(settings, inputs, settings.controllers):
        LivePilot(inputs.robot, controller.table, None, controller.pilot)
    _situation(settings, inputs, settings.first_seed)


def compare(settings: Settings, inputs: DriveInputs, progress: Progress = silent) -> DriveResult:
    """Drive all controllers at the same seeds, and evaluate them.

    Parameters
    ----------
    settings : what is driven
    inputs : robots, table, and the classifier where a controller needs one
    progress : of the drives

    Raises
    ------
    ConfigError
        if a setting is not accepted.
    """
    check_drive(settings, inputs)
    names = settings.controllers
    controllers = _controllers(settings, inputs, [name for name in names if name != "ramp"])
    for one in controllers:
        if one.source is Source.CLASSIFIER and inputs.model is None:
            raise ConfigError(f"controller {one.name!r} needs a classifier: give a model")
    count = _counter(progress, len(settings.all_seeds) * len(names))
    drives = _drive_all(settings, inputs, controllers, count)
    ramp_mps2 = None
    if "ramp" in names:
        ramp_mps2 = settings.ramp_mps2
        if ramp_mps2 is None:
            ramp_mps2 = _matching_ramp(settings, inputs, drives)
        drives |= _drive_all(settings, inputs, _controllers(settings, inputs, ["ramp"], ramp_mps2), count)
    for at_one_seed in zip(*drives.values(), strict=True):
        energies = energy_at_equal_distance([one.energy for one in at_one_seed])
        for one, energy in zip(at_one_seed, energies, strict=True):
            one.metrics["energy_j_per_m"] = energy
    rows = {name: tuple(one.metrics for one in drives[name]) for name in names}
    return DriveResult(
        scenario=settings.scenario,
        terrain=settings.terrain,
        robot=inputs.robot.name,
        table=inputs.table.name,
        seeds=tuple(settings.all_seeds),
        delay_s=settings.delay_s,
        grade_deg=settings.grade_deg,
        ramp_mps2=ramp_mps2,
        controllers={
            name: {key: mean_interval([row[key] for row in rows[name]]) for key in rows[name][0]}
            for name in names
        },
        rows=rows,
        examples={name: curves for name in names if (curves := drives[name][0].curves) is not None},
        slip_table=inputs.table,
    )


def _situation(
    settings: Settings, inputs: DriveInputs, seed: int, grade_deg: float | None = None
) -> Situation:
    options = SituationOptions(
        duration_s=settings.duration_s,
        speed_mps=1.0 if settings.speed_mps is None else settings.speed_mps,
        accel_mps2=settings.accel_mps2,
        grade_deg=settings.grade_deg if grade_deg is None else grade_deg,
        radius_factors=settings.radius_factors,
        leg_backlash_rad=settings.leg_backlash_rad,
    )
    return make_situation(settings.scenario, inputs.simulated, settings.terrain, seed, options)


def _controllers(
    settings: Settings, inputs: DriveInputs, names: Sequence[str], ramp_mps2: float | None = None
) -> list[Controller]:
    ramp_mps2 = settings.ramp_mps2 if ramp_mps2 is None else ramp_mps2
    ramp_mps2 = DEFAULT_RAMP_MPS2 if ramp_mps2 is None else ramp_mps2
    return [make_controller(name, inputs.table, settings.delay_s, ramp_mps2) for name in names]


def _counter(progress: Progress, total: int) -> Callable[[], None]:
    """Return a function that reports one drive more."""
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        progress("drive", done, total)

    return count


def _drive_all(
    settings: Settings, inputs: DriveInputs, controllers: Sequence[Controller], count: Callable[[], None]
) -> dict[str, list[Drive]]:
    """Return the drives of each controller, one a seed, in as many processes as the settings say."""
    drives: dict[str, list[Drive]] = {controller.name: [] for controller in controllers}
    without_model = replace(inputs, model=None)  # which is large to send to another process
    jobs = [
        (inputs if controller.source is Source.CLASSIFIER else without_model, controller, seed)
        for seed in settings.all_seeds
        for controller in controllers
    ]
    work = parallel(_drive_one, (settings,), jobs, min(settings.n_jobs, len(jobs)))
    for (_, controller, _), one in zip(jobs, work, strict=True):
        drives[controller.name].append(one)
        count()
    return drives


def _drive_one(settings: Settings, inputs: DriveInputs, controller: Controller, seed: int) -> Drive:
    situation = _situation(settings, inputs, seed)
    log = drive_once(inputs, controller, situation)
    history = drive_history(log, inputs.simulated, situation.conditions.radius_factors)
    adapting_to = controller.table if _adapts(controller.name) else None
    metrics = evaluate_drive(log, history, inputs.simulated, situation, adapting_to)
    if settings.scenario == SLOPE:
        metrics["steepest_deg"] = steepest(settings, inputs, controller, seed)
    curves = drive_curves(log, controller.table) if seed == settings.first_seed else None
    return Drive(metrics, energy_curve(history, situation.scenario), curves)


def steepest(settings: Settings, inputs: DriveInputs, controller: Controller, seed: int) -> float:
    """Return the steepest grade in degrees that a controller climbs, by bisection."""
    low, high = -STEEPEST_DEG, STEEPEST_DEG
    for _ in range(SLOPE_STEPS):
        middle = (low + high) / 2
        truth = drive_once(inputs, controller, _situation(settings, inputs, seed, middle)).streams["truth"]
        last = truth.time_s > truth.time_s[-1] - 1.0
        climbs = truth.channel("speed_x_mps")[last].mean() > CLIMBING_MPS
        low, high = (middle, high) if climbs else (low, middle)
    return low


def _matching_ramp(settings: Settings, inputs: DriveInputs, drives: Mapping[str, Sequence[Drive]]) -> float:
    """Return the ramp that travels as far as the first reference among the controllers, at the same seeds."""
    references = [name for kind in REFERENCES for name in drives if name in (kind, f"{kind}{TRACK}")]
    references += [name for name in drives if name.startswith(("known:", "target:"))]
    if not references:
        return DEFAULT_RAMP_MPS2
    key = f"distance_{START_TIME_S:g}s_m" if settings.scenario == STARTS else "distance_m"

    def distance_m(found: Sequence[Drive]) -> float:
        return float(np.mean([one.metrics[key] for one in found]))

    desired_m = distance_m(drives[references[0]])
    low = LEAST_RAMP_MPS2
    high = 2.0 * settings.accel_mps2 if math.isfinite(settings.accel_mps2) else MOST_RAMP_MPS2
    for _ in range(RAMP_STEPS):
        middle = math.sqrt(low * high)
        ramp = _controllers(settings, inputs, ["ramp"], middle)
        short = distance_m(_drive_all(settings, inputs, ramp, lambda: None)["ramp"]) < desired_m
        low, high = (middle, high) if short else (low, middle)
    return math.sqrt(low * high)


def report(result: DriveResult) -> Report:
    """Return the main difference, what each controller costs and brings, and behind it every figure."""
    names, shown = list(result.controllers), shown_metrics(result)
    pairs = _pairs(names) if shown else []
    grade = f", {result.grade_deg:g}° uphill" if result.grade_deg else ""
    n = len(result.seeds)
    details = (
        Section("Who differs, and by how much", list(_difference_parts(result, pairs, shown))),
        Section("Controllers", [Pairs([(name, _text(name, result.ramp_mps2)) for name in names])]),
        Section("All figures", list(_metric_parts(result, shown))),
        Section("The first seed, run by run", list(_run_parts(result))),
        Section("The curves behind the targets", list(_curve_parts(result.slip_table))),
        Section("Where these numbers come from", list(_provenance(result))),
    )
    return Report(
        title=f"{result.scenario} on {_terrain_name(result)}{grade}",
        answer=verdict(result, pairs, shown),
        lead=(
            f"{result.robot} · {n} seed{'s' * (n != 1)} · delay {1000 * result.delay_s:g} ms · "
            f"table {result.table}"
        ),
        picture=_picture(result, shown),
        parts=[*map(Text, belief_notes(result)), _means_table(result, shown)],
        details=[section for section in details if section.parts],
        next_step=f"terrain drive --faults all --robot {result.robot}",
    )


def shown_metrics(result: DriveResult) -> list[str]:
    """Return which metrics are drawn and compared: those of the scenario that a controller has."""
    found = []
    for key in metrics_of_scenario(result.scenario):
        means = [value_of(result, name, key).mean for name in result.controllers]
        if any(means) if key in WHERE_ANY else any(mean is not None for mean in means):
            found.append(key)
    return found


def value_of(result: DriveResult, name: str, key: str) -> MeanInterval:
    """Return a metric of a controller; unknown where it has none, or only by chance."""
    if key in ADAPTATION and not _adapts(name):
        return _UNKNOWN
    return result.controllers[name].get(key, _UNKNOWN)


def difference(result: DriveResult, name: str, other: str, key: str) -> Difference | None:
    """Return the difference of a metric between two controllers, seed by seed; None where one has none."""
    if value_of(result, name, key).mean is None or value_of(result, other, key).mean is None:
        return None
    values, base = ([row.get(key) for row in result.rows[one]] for one in (name, other))
    return paired_difference(values, base, relative=key not in ABSOLUTE)


def is_hardly_believed(result: DriveResult, name: str) -> bool:
    """Return whether a controller uses a classifier that was never or hardly believed.

    What such a controller shows is not the classifier's effect.
    """
    believed = result.controllers[name].get("believed_ratio", _UNKNOWN).mean
    return uses_classifier(name) and believed is not None and believed < HARDLY_BELIEVED_RATIO


def belief_notes(result: DriveResult) -> tuple[str, ...]:
    """Return a sentence on each controller whose classifier was never or hardly believed."""
    notes = []
    for name, metrics in result.controllers.items():
        if not is_hardly_believed(result, name):
            continue
        believed = metrics["believed_ratio"].mean or 0.0
        how = f"in {100.0 * believed:.1f} % of the driving time only" if believed else "at no time"
        outputs = ", ".join(
            f"{format_value(mean)} {text}"
            for key, text in (
                ("n_accepted", "accepted"),
                ("n_below_threshold", "below the threshold"),
                ("n_refused", "refused"),
            )
            if (mean := metrics.get(key, _UNKNOWN).mean) is not None
        )
        notes.append(
            f"{name} knew the terrain {how} (outputs of its classifier in a drive: {outputs or 'unknown'}): "
            "it drove on the targets of the table's fallback, and no difference to another controller is a "
            "gain of the classifier."
        )
    return tuple(notes)


def verdict(result: DriveResult, pairs: Sequence[tuple[str, str]], shown: Sequence[str]) -> str:
    """Return a sentence on the significant differences of the main pair, and on the others."""
    if not pairs:
        name = next(iter(result.controllers))
        values = [
            f"{metric_label(key).text} {format_value(mean, unit=metric_label(key).unit)}"
            for key in shown
            if (mean := value_of(result, name, key).mean) is not None
        ]
        return f"{name}: {', '.join(values) or 'no metric is defined'}."
    preferred = ("classified", "true_terrain", "fallback")
    credited = [pair for pair in pairs if not is_hardly_believed(result, pair[0])] or pairs
    name, other = next((pair for one in preferred for pair in credited if pair[0] == one), credited[0])
    significant, alike = [], []
    for key in shown:
        found = difference(result, name, other, key)
        if found is None:
            continue
        if math.isnan(found.low) or found.is_significant:
            significant.append(f"{metric_label(key).text} {signed_difference(found.mean, key)}")
        else:
            alike.append(metric_label(key).text)
    parts = [", ".join(significant)] if significant else []
    if alike:
        parts.append(f"no significant difference: {', '.join(alike)}")
    if len(result.seeds) == 1:
        parts.append("one seed, which gives no interval")
    return f"{name} compared with {other}: {'; '.join(parts) or 'no metric that both have'}."


def _adapts(name: str) -> bool:
    kind = kind_of(name)
    return kind is not None and kind.adapts


def _text(name: str, ramp_mps2: float | None) -> str:
    """Return a sentence on a controller."""
    kind = kind_of(name)
    text = "" if kind is None else kind.text.replace("{ramp}", format_value(ramp_mps2, unit="m/s²"))
    return f"{text} With path tracking." if TRACK in name else text


def _terrain_name(result: DriveResult) -> str:
    if result.terrain == COURSE:
        return "all terrains"
    return Path(result.terrain).stem if result.terrain.endswith("ml") else result.terrain


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs to compare: all with plain, traction control with ramp and fallback, PID with PID."""
    pilots = {name: kind.pilot for name in names if (kind := kind_of(name)) is not None}
    traction = [name for name in names if pilots.get(name) == "traction"]
    thesis = [name for name in names if pilots.get(name) == "thesis"]
    pairs = [(name, "plain") for name in names if name != "plain" and "plain" in names]
    pairs += [(name, "ramp") for name in traction if "ramp" in names]
    pairs += [
        (name, "fallback") for name in traction if name in KINDS and _adapts(name) and "fallback" in names
    ]
    pairs += [(name, "thesis") for name in thesis if name in KINDS and _adapts(name) and "thesis" in names]
    if not pairs and len(names) > 1:
        pairs = [(name, names[0]) for name in names[1:]]
    return pairs


def _picture(result: DriveResult, shown: Sequence[str]) -> Figure | None:
    """Return the first metrics of all controllers as bars."""
    names, panels = list(result.controllers), []
    for key in shown[:PICTURED]:
        values = [value_of(result, name, key) for name in names]
        means = [math.nan if value.mean is None else value.mean for value in values]
        low, high = zip(*(value.ci or (math.nan, math.nan) for value in values), strict=True)
        panels.append(Panel([Bars(metric_label(key).with_unit, names, means, low, high)]))
    n = len(result.seeds)
    caption = "One seed, which gives no interval."
    if n > 1:
        caption = (
            f"Means over {n} seeds and their 95 % intervals. All controllers drive the same seeds, so that bars "
            "whose intervals overlap may still differ significantly, seed by seed."
        )
    return Figure("What it costs, and what it brings", panels, caption) if panels else None


def _means_table(result: DriveResult, shown: Sequence[str]) -> Table:
    labels = [metric_label(key) for key in shown]
    rows = [(name, *(value_of(result, name, key).mean for key in shown)) for name in result.controllers]
    return Table(("mean over seeds", *(Column(label.text, unit=label.unit) for label in labels)), rows)


def _difference_parts(
    result: DriveResult, pairs: Sequence[tuple[str, str]], shown: Sequence[str]
) -> Iterator[Part]:
    found = {(pair, key): difference(result, *pair, key) for pair in pairs for key in shown}
    keys = [key for key in shown if any(found[pair, key] is not None for pair in pairs)]
    if not keys:
        return
    rows = [
        (f"{name} compared with {other}", *(_difference_text(found[(name, other), key], key) for key in keys))
        for name, other in pairs
    ]
    note = (
        "Differences are means over seeds of the difference at each seed, with their 95 % interval; a star: the "
        "interval excludes zero, which happens by chance in one of twenty. The energy per metre is over the "
        "distance that all travelled who travelled at least half of the longest."
    )
    yield Table(("", *(metric_label(key).text for key in keys)), rows, note=note)


def _difference_text(found: Difference | None, key: str) -> str:
    if found is None:
        return NOT_KNOWN
    mean = signed_difference(found.mean, key)
    if math.isnan(found.low):
        return mean
    star = " *" if found.is_significant else ""
    return f"{mean} ({signed_difference(found.low, key)} to {signed_difference(found.high, key)}){star}"


def _metric_parts(result: DriveResult, shown: Sequence[str]) -> Iterator[Part]:
    """Yield all metrics, those that are compared first, and the names of those that no controller has."""
    if text := SCENARIOS.get(result.scenario):
        yield Text(text)
    known = list(dict.fromkeys(key for metrics in result.controllers.values() for key in metrics))
    rows, undefined = [], []
    for key in [*(key for key in shown if key in known), *(key for key in known if key not in shown)]:
        values = [value_of(result, name, key) for name in result.controllers]
        if any(value.mean is not None for value in values):
            cells = (_metric_text(value, len(result.seeds)) for value in values)
            rows.append((metric_label(key).with_unit, key, *cells))
        else:
            undefined.append(f"{metric_label(key).text} ({key})")
    note = (
        "Means over seeds, with their 95 % intervals. Each seed draws load, soil, tyres, roughness and noise, the "
        "same for all controllers. n: the number of seeds at which a metric was defined, where it was not at all."
    )
    if any(not _adapts(name) and "adapt_s" in metrics for name, metrics in result.controllers.items()):
        note += " Controllers that do not use the terrain have no time to its target."
    if undefined:
        note += f" Not defined here: {', '.join(undefined)}."
    yield Table(("metric", "key", *result.controllers), rows, note=note)


def _metric_text(value: MeanInterval, n_seeds: int) -> str:
    if value.mean is None:
        return NOT_KNOWN
    text = format_value(value.mean) + (f", n {value.n}" if value.n != n_seeds else "")
    if value.ci is None or not value.ci[1] > value.ci[0]:
        return text
    return f"{text} ({interval(*value.ci)})"


def _run_parts(result: DriveResult) -> Iterator[Part]:
    if result.examples:
        yield Text(
            "Above: desired and commanded speed, and the speed over ground. Below: the true slip, with the range "
            "of the wheels, its estimate, the target, and the target with its floor: at least the slip of steady "
            f"motion and a margin. Below {PEAK_ABOVE_MPS:g} m/s no slip is drawn. All drives have the same axes."
        )
        yield from run_figures(result.examples)


def _curve_parts(table: SlipTable | None) -> Iterator[Part]:
    """Yield the slip curves of a table, without measurements, which it does not hold."""
    if table is None or not table.curves:
        return
    panels = []
    for terrain, curve in table.curves.items():
        parameters = [curve.parameters[name] for name in LAW_PARAMETERS[curve.law]]

        def thrust(slips: Array, law: str = curve.law, given: Sequence[float] = parameters) -> Array:
            return traction_ratio(law, given, np.atleast_1d(slips))

        measured = np.linspace(*curve.slip_range_ratio, 60)
        beyond = np.linspace(curve.slip_range_ratio[1], 1.0, 30)
        targets = np.array([table.targets[terrain][state].slip_ratio for state in ("traction", "steady")])
        marks: list[Mark] = [
            Strip([(*curve.peak_interval_ratio, "peak slip, 90 %")]),
            Line("law, in the slips measured", measured, thrust(measured), 0),
            Line("beyond", beyond, thrust(beyond), 0, dashed=True),
            Line("resistance", [0.0, 1.0], [curve.resistance_ratio] * 2, 6, dashed=True),
            Points("targets of traction and steady motion", targets, thrust(targets), colour=2),
        ]
        panels.append(Panel(marks, "thrust over load", f"{terrain}: {curve.law}, {curve.n_runs} runs"))
    caption = (
        "The law fitted to measured runs, and the targets on it; the thrust above the resistance is available to "
        "accelerate and to climb."
    )
    yield Figure(f"Slip curves of the table {table.name}", panels, caption, x_label="slip ratio")


def _provenance(result: DriveResult) -> Iterator[Part]:
    yield Text(
        "Robot and terrain are models: controllers are compared on them, and what a robot in a field would do is "
        "not predicted."
    )
    first, last = result.seeds[0], result.seeds[-1]
    yield Pairs(
        [
            ("seeds", f"{first} to {last}" if last > first else first),
            ("delay from a sample to the wheel", result.delay_s, "", "s"),
            ("table", result.table),
            ("ramp", result.ramp_mps2, "", "m/s²"),
            ("grade", result.grade_deg, "", "°"),
            ("versions", ", ".join(f"{name} {number}" for name, number in versions().items())),
        ]
    )
