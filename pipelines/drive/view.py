"""View of a result for the page: its texts, numbers and pictures, computed; templates only place them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from pipelines.drive.bar_figure import Panel, bars_figure
from pipelines.drive.belief import belief_notes, is_hardly_believed
from pipelines.drive.controller_names import ADAPTING, BASELINES, THESIS_ADAPTING, base_name
from pipelines.drive.curve_figure import table_figure
from pipelines.drive.labels import (
    ABSOLUTE,
    ADAPTATION,
    SCENARIOS,
    WHERE_ANY,
    controller_text,
    metric_label,
    metrics_of_scenario,
    signed_difference,
)
from pipelines.drive.results import DriveResult
from pipelines.drive.run_figures import run_figures
from pipelines.reporting.numbers import NOT_KNOWN, format_number
from pipelines.reporting.pictures import Image, svg_or_png
from pipelines.reporting.versions import versions
from terrain.control.comparison import Difference, MeanInterval, paired_difference
from terrain.control.drive_metrics import PEAK_ABOVE_MPS
from terrain.control.situations import COURSE
from terrain.control.slip_table import SlipTable
from terrain.records import RunLog

_UNKNOWN = MeanInterval(None, None, 0)
_RUN = "run_"

CAPTIONS = {
    "bars": "A bar is the mean over seeds, the line its 95 % interval. All controllers drive the same seeds, "
    "so that bars whose lines overlap may still differ significantly, seed by seed.",
    _RUN: "Above: desired and commanded speed, and the speed over ground. Below: the true slip (blue, with "
    "the range of the wheels), its estimate, the target, and the target with its floor: at least the slip "
    "of steady motion and a margin. Yellow: speed rises; hatched: braking; a black bar on top: no "
    f"correction was made. Below {PEAK_ABOVE_MPS:g} m/s no slip is drawn.",
    "curves": "The law fitted to measured runs, and the targets on it; the thrust above the resistance is "
    "available to accelerate and to climb.",
}


class Named(NamedTuple):
    """A text under a name."""

    name: str
    text: str


class Cell(NamedTuple):
    """A cell of a table: its text, a smaller one below it, and whether it is bold."""

    text: str
    below: str = ""
    bold: bool = False


class Row(NamedTuple):
    """A row of a table: its heading, the metric's key or nothing, and its cells."""

    heading: str
    key: str
    cells: tuple[Cell, ...]


class Table(NamedTuple):
    """A table by its column headings and rows."""

    columns: tuple[str, ...]
    rows: tuple[Row, ...]


class FigureSection(NamedTuple):
    """A section of figures."""

    heading: str
    images: tuple[Image, ...]


@dataclass(frozen=True, slots=True)
class DriveView:
    """What the page shows.

    Parameters
    ----------
    heading, lead : on top of the page
    verdict : a sentence on the main comparison, or nothing
    notes : a sentence on each controller whose classifier was hardly believed
    scenario : what is driven, or nothing
    controllers : a sentence on each
    differences : of pairs of controllers; None where there are none
    bars, runs, curves : sections of figures; None where there are none
    metrics : of all controllers
    undefined : metrics that no controller has
    n_seeds : number of seeds
    partly_adapting : whether a controller that does not use the terrain is shown without its adaptation
    provenance : seeds, delay, table, ramp, grade, versions
    """

    heading: str
    lead: str
    verdict: str
    notes: tuple[str, ...]
    scenario: str
    controllers: tuple[Named, ...]
    differences: Table | None
    bars: FigureSection | None
    runs: FigureSection | None
    curves: FigureSection | None
    metrics: Table
    undefined: tuple[Named, ...]
    n_seeds: int
    partly_adapting: bool
    provenance: tuple[Named, ...]


def drive_figures(result: DriveResult, examples: Mapping[str, RunLog], table: SlipTable) -> dict[str, Figure]:
    """Return the figures by name: ``bars``, ``run_<controller>``, and ``curves`` where the table has any."""
    figures = {}
    panels = [
        Panel(metric_label(key).with_unit, {name: value_of(result, name, key) for name in result.controllers})
        for key in shown_metrics(result)
    ]
    if panels:
        figures["bars"] = bars_figure(panels, len(result.seeds))
    figures |= {f"{_RUN}{name}": figure for name, figure in run_figures(examples, table).items()}
    if table.curves:
        figures["curves"] = table_figure(table)
    return figures


def drive_view(result: DriveResult, figures: Mapping[str, Figure]) -> DriveView:
    """Return the view of a result.

    Parameters
    ----------
    result : of all controllers
    figures : as :func:`drive_figures`
    """
    names, metrics = list(result.controllers), shown_metrics(result)
    pairs = _pairs(names) if metrics else []
    table, undefined = _metrics_table(result, metrics)
    runs = [name for name in figures if name.startswith(_RUN)]
    return DriveView(
        heading=f"{result.scenario} on {_terrain_name(result)}",
        lead=_lead(result),
        verdict=_verdict(result, pairs, metrics),
        notes=belief_notes(result),
        scenario=SCENARIOS.get(result.scenario, ""),
        controllers=tuple(Named(name, controller_text(name, result.ramp_mps2)) for name in names),
        differences=_differences(result, pairs, metrics),
        bars=_figure_section("What it costs, and what it brings", figures, ["bars"]),
        runs=_figure_section("The first seed, run by run", figures, runs),
        curves=_figure_section("The curves behind the targets", figures, ["curves"]),
        metrics=table,
        undefined=undefined,
        n_seeds=len(result.seeds),
        partly_adapting=any(
            not _adapts(name) and values.get("adapt_s", _UNKNOWN).mean is not None
            for name, values in result.controllers.items()
        ),
        provenance=_provenance(result),
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


def _adapts(name: str) -> bool:
    return base_name(name) in ADAPTING


def _terrain_name(result: DriveResult) -> str:
    if result.terrain == COURSE:
        return "all terrains"
    return Path(result.terrain).stem if result.terrain.endswith("ml") else result.terrain


def _lead(result: DriveResult) -> str:
    n = len(result.seeds)
    parts = [result.robot, "1 seed" if n == 1 else f"{n} seeds"]
    if result.grade_deg:
        parts.append(f"{result.grade_deg:g}° uphill")
    parts += [f"delay {1000 * result.delay_s:g} ms", f"table {result.table}"]
    return " · ".join(parts)


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs to compare: all with plain, traction control with ramp and fallback, PID with PID."""
    traction = [name for name in names if base_name(name) not in (*BASELINES, *THESIS_ADAPTING)]
    pairs = [(name, "plain") for name in names if name != "plain" and "plain" in names]
    pairs += [(name, "ramp") for name in traction if "ramp" in names]
    pairs += [(name, "fallback") for name in traction if name in ADAPTING and "fallback" in names]
    pairs += [(name, "thesis") for name in names if name in THESIS_ADAPTING and "thesis" in names]
    if not pairs and len(names) > 1:
        pairs = [(name, names[0]) for name in names[1:]]
    return pairs


def _verdict(result: DriveResult, pairs: Sequence[tuple[str, str]], metrics: Sequence[str]) -> str:
    """Return a sentence on the significant differences of the main pair, and on the others."""
    if not pairs:
        return ""
    preferred = ("classified", "true_terrain", "fallback")
    credited = [pair for pair in pairs if not is_hardly_believed(result, pair[0])] or pairs
    name, other = next((pair for one in preferred for pair in credited if pair[0] == one), credited[0])
    significant, alike = [], []
    for key in metrics:
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


def _differences(
    result: DriveResult, pairs: Sequence[tuple[str, str]], metrics: Sequence[str]
) -> Table | None:
    found = {(pair, key): difference(result, *pair, key) for pair in pairs for key in metrics}
    keys = [key for key in metrics if any(found[pair, key] is not None for pair in pairs)]
    if not keys:
        return None
    rows = [
        Row(
            f"{name} compared with {other}",
            "",
            tuple(_difference_cell(found[(name, other), key], key) for key in keys),
        )
        for name, other in pairs
    ]
    return Table(("", *(metric_label(key).text for key in keys)), tuple(rows))


def _difference_cell(found: Difference | None, key: str) -> Cell:
    if found is None:
        return Cell(NOT_KNOWN)
    mean = signed_difference(found.mean, key)
    if math.isnan(found.low):
        return Cell(mean)
    interval = f"{signed_difference(found.low, key)} to {signed_difference(found.high, key)}"
    return Cell(mean, interval, found.is_significant)


def _metrics_table(result: DriveResult, shown: Sequence[str]) -> tuple[Table, tuple[Named, ...]]:
    """Return the table of all metrics, those in figures first, and those that no controller has."""
    known = list(dict.fromkeys(key for metrics in result.controllers.values() for key in metrics))
    rows, undefined = [], []
    for key in [*(key for key in shown if key in known), *(key for key in known if key not in shown)]:
        cells = tuple(_metric_cell(result, name, key) for name in result.controllers)
        if all(cell.text == NOT_KNOWN for cell in cells):
            undefined.append(Named(metric_label(key).text, key))
        else:
            rows.append(Row(metric_label(key).with_unit, key, cells))
    return Table(("metric", "key", *result.controllers), tuple(rows)), tuple(undefined)


def _metric_cell(result: DriveResult, name: str, key: str) -> Cell:
    mean, interval, n = value_of(result, name, key)
    if mean is None:
        return Cell(NOT_KNOWN)
    text = format_number(mean) + (f" ({n})" if n != len(result.seeds) else "")
    if interval is None or not interval[1] > interval[0]:
        return Cell(text)
    return Cell(text, " to ".join(map(format_number, interval)))


def _figure_section(
    heading: str, figures: Mapping[str, Figure], names: Sequence[str]
) -> FigureSection | None:
    images: list[Image] = []
    for name in names:
        if name not in figures:
            continue
        caption = CAPTIONS[_RUN if name.startswith(_RUN) else name]
        if name.startswith(_RUN) and images:
            caption = "As above, with the same axes."
        images.append(svg_or_png(figures[name], f"{name.removeprefix(_RUN)}: {caption}", caption))
    return FigureSection(heading, tuple(images)) if images else None


def _provenance(result: DriveResult) -> tuple[Named, ...]:
    seeds, ramp = list(result.seeds), result.ramp_mps2
    in_a_row = len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1))
    return (
        Named("seeds", f"{seeds[0]} to {seeds[-1]}" if in_a_row else ", ".join(map(str, seeds))),
        Named("delay", f"{result.delay_s:g} s from a sample to the wheel"),
        Named("table", result.table),
        Named("ramp", NOT_KNOWN if ramp is None else f"{format_number(ramp)} m/s²"),
        Named("grade", f"{result.grade_deg or 0.0:g}°"),
        Named("versions", ", ".join(f"{name} {number}" for name, number in versions().items())),
    )
