"""One self-contained HTML page that sets controllers side by side: what they cost, and what they did."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import t as student

from pipelines.drive.drives import COURSE
from pipelines.drive.figures import Panel, bars_figure, run_figures, table_figure
from pipelines.reporting.drawing import NOT_KNOWN, png_bytes, svg_text
from pipelines.reporting.numbers import format_number as said
from pipelines.reporting.page import page
from pipelines.reporting.pictures import MAX_SVG_BYTES
from pipelines.reporting.versions import versions
from terrain.control.drive_metrics import PEAK_ABOVE_MPS
from terrain.control.slip_table import SlipTable
from terrain.files.atomic import atomic_write
from terrain.records import RunLog

Result = Mapping[str, Any]
NBSP = "\N{NO-BREAK SPACE}"

WORDS = {
    "energy_j_per_m": ("energy a metre", "J/m"),
    "distance_m": ("way made", "m"),
    "mean_speed_mps": ("mean speed", "m/s"),
    "final_speed_mps": ("final speed", "m/s"),
    "slip_peak": ("largest slip", ""),
    "lock_s": ("longest lock of a wheel", "s"),
    "scrub_j": ("lost between wheels and ground", "J"),
    "scrub_along_j": ("of it along the wheels", "J"),
    "immobilised": ("times stuck", ""),
    "adapt_s": ("time to the new ground's target", "s"),
    "adapted_ratio": ("changes of ground followed, share", ""),
    "slip_error_ratio": ("slip off the aim while held back", ""),
    "sinkage_m": ("sinkage of the deepest wheel", "m"),
    "command_mps2": ("change of the wheels' commands, rms", "m/s²"),
    "yaw_drift_rad": ("heading at the end off the start", "rad"),
    "stop_m": ("stopping distance", "m"),
    "steepest_deg": ("steepest grade climbed", "°"),
}
UNITS = {
    "mps2": "m/s²",
    "mps": "m/s",
    "rad": "rad",
    "deg": "°",
    "m": "m",
    "s": "s",
    "j": "J",
    "n": "N",
    "ratio": "",
}
"""By the last word of a name that :data:`WORDS` does not hold."""

SHOWN = ("slip_peak", "energy_j_per_m", "distance_m", "final_speed_mps")
SHOWN_ON = {
    "starts": ("slip_peak", "energy_j_per_m", "distance_5s_m", "energy_4m_j", "final_speed_mps"),
    "brake": ("stop_m", "lock_s", "slip_peak", "energy_j_per_m"),
    "slope": ("steepest_deg", *SHOWN),
    "circle": ("scrub_j", *SHOWN),
    "crab": ("scrub_j", *SHOWN),
    "course": (*SHOWN, "adapt_s", "adapted_ratio"),
    "mixed": (*SHOWN, "adapt_s", "adapted_ratio"),
}
"""What is drawn and compared, the most telling first; ``immobilised`` too, where anybody was."""

DIFFERENCES = ("steepest_deg", "lock_s", "immobilised", "adapt_s", "adapted_ratio")
"""Compared as they are; all else as shares, since days differ in size."""

OF_THE_GROUND = ("adapt_s", "adapted_ratio")
HEAR = ("learned", "oracle")
"""Controllers that hear of a new ground; another one's target never changes, and may be near by chance."""

ABOUT = {
    "plain": "Wheels are told what the kinematics gives; nobody looks at slip.",
    "ramp": "As plain, with a speed that rises by no more than {ramp}.",
    "thesis": "The thesis' PID of slip on each wheel, aiming for the table's fallback.",
    "fixed": "Ours: one speed for all wheels, held back while it rises; aims for the table's fallback.",
    "learned": "Ours, aiming for the target of the ground that a classifier recognises while driving.",
    "oracle": "Ours, always told the true ground: what a classifier without error would bring.",
}
SCENES = {
    "starts": "Stand, start, hold the speed, stop: three times. Figures of a start are means of the second "
    "and third, when the robot has seen the ground; those of the first stand beside them in the table.",
    "brake": "Drive, and be told to stand at once.",
    "slope": "Uphill; the steepest grade is searched for on each day.",
    "course": "All grounds one after the other.",
    "mixed": "Grounds in any order, and the camera lost for three seconds.",
}


class Difference(NamedTuple):
    """What one controller has over another, and its 95 % interval; NaN where one day gives none."""

    mean: float
    low: float
    high: float

    @property
    def told_apart(self) -> bool:
        """Whether the interval leaves zero out."""
        return self.low > 0.0 or self.high < 0.0


def drive_page(result: Result, examples: Mapping[str, RunLog], table: SlipTable) -> str:
    """Return the page.

    Parameters
    ----------
    result : what :func:`pipelines.drive.drive.drive` returns; where it has ``rows`` (by controller, a mapping
    of
        figures a seed), controllers are compared day by day, else by their intervals
    examples : a run of each controller on the first day, with the streams ``truth`` and ``control``
    table : that was driven by
    """
    return _page(result, drive_figures(result, examples, table))


def write_drive_page(out: Path, result: Result, examples: Mapping[str, RunLog], table: SlipTable) -> Path:
    """Write ``drive.html`` and ``figures/*.png`` and ``.svg``, each whole or not at all; return the page.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    figures = drive_figures(result, examples, table)
    for name, figure in figures.items():
        stem = re.sub(r"[^\w.-]", "_", name)
        atomic_write(out / "figures" / f"{stem}.png", png_bytes(figure))
        atomic_write(out / "figures" / f"{stem}.svg", svg_text(figure))
    atomic_write(out / "drive.html", _page(result, figures))
    return out / "drive.html"


def drive_figures(result: Result, examples: Mapping[str, RunLog], table: SlipTable) -> dict[str, Figure]:
    """Return the figures by name: ``bars``, ``run_<controller>``, and ``curves`` where the table has any."""
    figures = {}
    panels = [
        Panel(_named(key), {name: _value(result, name, key) for name in result["controllers"]})
        for key in shown_keys(result)
    ]
    if panels:
        figures["bars"] = bars_figure(panels, len(result["seeds"]))
    figures |= {f"run_{name}": figure for name, figure in run_figures(examples, table).items()}
    if table.curves:
        figures["curves"] = table_figure(table)
    return figures


def _page(result: Result, figures: Mapping[str, Figure]) -> str:
    heading = f"{result['scenario']} on {_ground(result)}"
    sections = [
        _verdict(result),
        _drawn("What it costs, and what it brings", figures, ("bars",)),
        _numbers(result),
        _drawn("The first day, run by run", figures, [name for name in figures if name.startswith("run_")]),
        _drawn("The curves behind the targets", figures, ("curves",)),
        _provenance(result),
    ]
    return page("Controllers side by side, simulated", heading, f"Drive: {heading}", _lead(result), sections)


def _ground(result: Result) -> str:
    terrain = str(result["terrain"])
    return "all grounds" if terrain == COURSE else Path(terrain).stem if terrain.endswith("ml") else terrain


def _lead(result: Result) -> str:
    n = len(result["seeds"])
    parts = [str(result["robot"]), "1 day" if n == 1 else f"{n} days"]
    if result.get("grade_deg"):
        parts.append(f"{result['grade_deg']:g}° uphill")
    parts += [f"delay {1000 * result['delay_s']:g} ms", f"table {result['table']}"]
    return " · ".join(map(escape, parts))


def shown_keys(result: Result) -> list[str]:
    """Return which figures are drawn and compared: those of the scenario that anybody has."""
    keys = (*SHOWN_ON.get(str(result["scenario"]), SHOWN), "immobilised")
    means = {key: [_value(result, name, key)[0] for name in result["controllers"]] for key in keys}
    return [
        key
        for key, found in means.items()
        if any(mean is not None for mean in found)
        and (key not in ("immobilised", "lock_s") or any(mean for mean in found))
    ]


def _value(result: Result, name: str, key: str) -> tuple[float | None, Sequence[float] | None]:
    """Return a controller's mean and interval; None where it has none, or only by chance."""
    figure = result["controllers"][name].get(key)
    if figure is None or not _known(figure["mean"]) or (key in OF_THE_GROUND and name not in HEAR):
        return None, None
    interval = figure["ci"]
    return figure["mean"], interval if interval is not None and all(map(_known, interval)) else None


def _known(number: Any) -> bool:
    return number is not None and math.isfinite(number)


def difference(result: Result, name: str, other: str, key: str) -> Difference | None:
    """Return what a controller has over another, day by day where ``rows`` are known; None without figures.

    Without rows the intervals are added as if the days had nothing in common, which is too cautious.
    """
    (mean, interval), (base, base_interval) = _value(result, name, key), _value(result, other, key)
    if mean is None or base is None:
        return None
    half = math.nan
    gained = mean - base
    if result.get("rows"):
        days = [
            (row.get(key), before.get(key))
            for row, before in zip(result["rows"][name], result["rows"][other], strict=True)
        ]
        both = np.array([pair for pair in days if all(map(_known, pair))], dtype=float).reshape(-1, 2)
        if not len(both):
            return None
        each = both[:, 0] - both[:, 1]
        gained, base = float(each.mean()), float(both[:, 1].mean())
        if len(each) > 1:
            half = float(student.ppf(0.975, len(each) - 1) * each.std(ddof=1) / math.sqrt(len(each)))
    elif interval is not None and base_interval is not None:
        half = math.hypot(interval[1] - interval[0], base_interval[1] - base_interval[0]) / 2
    if key not in DIFFERENCES:
        if base <= 0.0:
            return None
        gained, half = gained / base, half / base
    return Difference(gained, gained - half, gained + half)


def _pairs_to_compare(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return who is set against whom: all against plain, ours against the ramp and the fixed target."""
    ours = [name for name in names if name not in ("plain", "ramp", "thesis")]
    pairs = [(name, "plain") for name in names if name != "plain" and "plain" in names]
    pairs += [(name, "ramp") for name in ours if "ramp" in names]
    pairs += [(name, "fixed") for name in ours if name in HEAR and "fixed" in names]
    if not pairs and len(names) > 1:
        pairs = [(name, names[0]) for name in names[1:]]
    return pairs


def _verdict(result: Result) -> str:
    names, keys = list(result["controllers"]), shown_keys(result)
    about = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(_about(name, result['ramp_mps2']))}</dd>" for name in names
    )
    scene = escape(SCENES.get(str(result["scenario"]), ""))
    parts = [f"<p>{scene}</p>" if scene else "", f'<dl class="pairs">{about}</dl>']
    pairs = _pairs_to_compare(names)
    if pairs and keys:
        main = next(
            (pair for one in ("learned", "oracle", "fixed") for pair in pairs if pair[0] == one), pairs[0]
        )
        parts = [
            f'<p class="words">{escape(_sentence(result, *main, keys))}</p>',
            *parts,
            _compared(result, pairs, keys),
        ]
    return f'<section class="headline" aria-label="Verdict"><h2>Verdict</h2>{"".join(parts)}</section>'


def _about(name: str, ramp_mps2: float | None) -> str:
    bare, track, _ = name.partition("+track")
    if track:
        return f"{_about(bare, ramp_mps2)} Held to its way."
    kind, _, what = name.partition(":")
    if kind == "told" and what:
        return f"Ours, always told that the ground is {what}."
    if kind == "target" and what:
        return f"Ours, always aiming for a slip of {what}."
    ramp = "a bound" if ramp_mps2 is None else f"{said(ramp_mps2)} m/s²"
    return ABOUT.get(name, NOT_KNOWN).format(ramp=ramp)


def _sentence(result: Result, name: str, other: str, keys: Sequence[str]) -> str:
    """Say what is told apart between two controllers, and what is not."""
    found, alike = [], []
    for key in keys:
        gained = difference(result, name, other, key)
        if gained is None:
            continue
        if math.isnan(gained.low) or gained.told_apart:
            found.append(f"{_words(key)[0]} {_gained(gained.mean, key)}")
        else:
            alike.append(_words(key)[0])
    parts = [", ".join(found)] if found else []
    if alike:
        parts.append(f"not told apart: {', '.join(alike)}")
    if len(result["seeds"]) == 1:
        parts.append("one day, which shows no spread")
    return f"{name} against {other}: {'; '.join(parts) or 'no figure that both have'}."


def _gained(number: float, key: str) -> str:
    """Write a difference with its sign: as a share, or in its unit."""
    if key in DIFFERENCES:
        unit = _words(key)[1]
        text = said(abs(number)) + (unit if unit == "°" else f"{NBSP}{unit}" if unit else "")
    else:
        share = abs(100.0 * number)
        text = f"{share:.0f}{NBSP}%" if share >= 9.95 else f"{share:.1f}{NBSP}%"
    return text if not re.search("[1-9]", text) else ("+" if number > 0.0 else "\N{MINUS SIGN}") + text


def _compared(result: Result, pairs: Sequence[tuple[str, str]], keys: Sequence[str]) -> str:
    found = {(pair, key): difference(result, *pair, key) for pair in pairs for key in keys}
    keys = [key for key in keys if any(found[pair, key] is not None for pair in pairs)]
    rows = [
        f"<tr><th scope=row>{escape(name)} against {escape(other)}</th>"
        + "".join(f"<td>{_gain_cell(found[(name, other), key], key)}</td>" for key in keys)
        + "</tr>"
        for name, other in pairs
    ]
    way = (
        "Differences are taken day by day."
        if result.get("rows")
        else "Differences are taken between means, as if each had days of its own, which is cautious."
    )
    return f"""<h3>Who differs, and by how much</h3>
{_table(["", *(_words(key)[0] for key in keys)], rows)}
<p class="small">Below a number stands its 95&nbsp;% interval; bold: it leaves zero out, as one in
twenty does by chance. {way} The energy a metre is over the way that all made who got half as far as
the furthest.</p>"""


def _gain_cell(gained: Difference | None, key: str) -> str:
    if gained is None:
        return NOT_KNOWN
    mean = escape(_gained(gained.mean, key))
    if math.isnan(gained.low):
        return mean
    between = f"{escape(_gained(gained.low, key))} to {escape(_gained(gained.high, key))}"
    return f'{f"<b>{mean}</b>" if gained.told_apart else mean}<br><span class="small">{between}</span>'


def _numbers(result: Result) -> str:
    controllers, n_seeds = result["controllers"], len(result["seeds"])
    known = list(dict.fromkeys(key for figures in controllers.values() for key in figures))
    rows, bare = [], []
    for key in sorted(
        known, key=lambda key: key not in (shown := shown_keys(result)) or -len(shown) + shown.index(key)
    ):
        words, unit = _words(key)
        cells = [_cell(result, name, key, n_seeds) for name in controllers]
        if all(cell == NOT_KNOWN for cell in cells):
            bare.append(f"{escape(words)} (<code>{escape(key)}</code>)")
            continue
        rows.append(
            f"<tr><th scope=row>{escape(words)}{f' [{escape(unit)}]' if unit else ''}</th>"
            f"<td class=text><code>{escape(key)}</code></td>"
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + "</tr>"
        )
    none = f" Not defined here: {', '.join(bare)}." if bare else ""
    deaf = any(
        name not in HEAR and _known(controllers[name].get("adapt_s", {}).get("mean")) for name in controllers
    )
    why = " Who hears nothing of the ground has no time to its target." if deaf else ""
    days = (
        "One day. Days"
        if n_seeds == 1
        else f"Means over {n_seeds} days, with their 95&nbsp;% intervals. Days"
    )
    return f"""<section class="dense"><h2>All figures</h2>
{_table(["figure", "key", *controllers], rows, text=2)}
<p class="small">{days} are draws of load, soil, tyres, roughness and noise, the same for all controllers.
A number in brackets is of days: it was defined on those alone. {NOT_KNOWN}: on none.{why}{none}</p>
</section>"""


def _cell(result: Result, name: str, key: str, n_seeds: int) -> str:
    mean, interval = _value(result, name, key)
    if mean is None:
        return NOT_KNOWN
    text = said(mean)
    n = result["controllers"][name][key].get("n", n_seeds)
    if n != n_seeds:
        text += f" ({n})"
    if interval is not None and interval[1] > interval[0]:
        text += f'<br><span class="small">{said(interval[0])} to {said(interval[1])}</span>'
    return text


def _words(key: str) -> tuple[str, str]:
    """Return what a figure is called, and its unit.

    Examples
    --------
    >>> _words("first_distance_5s_m"), _words("energy_4m_j"), _words("odd_mps")
    (('way 5 s after a start, first start', 'm'), ('energy of the first 4 m', 'J'), ('odd', 'm/s'))
    """
    if key.startswith("first_"):
        words, unit = _words(key.removeprefix("first_"))
        return f"{words}, first start", unit
    if key in WORDS:
        return WORDS[key]
    if found := re.fullmatch(r"distance_(.+)s_m", key):
        return f"way {found[1]} s after a start", "m"
    if found := re.fullmatch(r"energy_(.+)m_j", key):
        return f"energy of the first {found[1]} m", "J"
    words, _, last = key.rpartition("_")
    return (words.replace("_", " "), UNITS[last]) if words and last in UNITS else (key.replace("_", " "), "")


def _named(key: str) -> str:
    words, unit = _words(key)
    return f"{words} [{unit}]" if unit else words


CAPTIONS = {
    "bars": "A bar is the mean over days, the line its 95 % interval. A day is the same for all, so that "
    "bars whose lines overlap may still be told apart, day by day.",
    "run": "Above: what is required and driven, and the speed over ground. Below: the slip that was (blue, "
    "with the spread of the wheels), as the pilot saw it, the target, and what was aimed for: no less than "
    "what steady motion balances, and a margin. Yellow: speed rises; hatched: braking; a black bar on top: "
    "no correction was made. Below {speed} no slip is drawn.",
    "curves": "The law through what runs showed, and where the targets lie on it; what grip is left over the "
    "resistance is there to accelerate and to climb with.",
}


def _drawn(heading: str, figures: Mapping[str, Figure], names: Iterable[str]) -> str:
    parts: list[str] = []
    for name in names:
        if name not in figures:
            continue
        caption = escape(
            CAPTIONS["run" if name.startswith("run_") else name].format(speed=f"{PEAK_ABOVE_MPS:g} m/s")
        )
        if name.startswith("run_") and parts:
            caption = "As above, with the same axes."
        content, kind = svg_text(figures[name]).encode(), "svg+xml"
        if len(content) > MAX_SVG_BYTES:
            content, kind = png_bytes(figures[name]), "png"
        source = base64.b64encode(content).decode()
        parts.append(
            f'<figure class="wide"><img src="data:image/{kind};base64,{source}" '
            f'alt="{escape(name.removeprefix("run_"))}: {caption}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    if not parts:
        return ""
    return f'<section><h2>{heading}</h2><div class="figures">{"".join(parts)}</div></section>'


def _provenance(result: Result) -> str:
    seeds = list(result["seeds"])
    row = len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1))
    ramp = result["ramp_mps2"]
    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    pairs = [
        ("seeds", f"{seeds[0]} to {seeds[-1]}" if row else ", ".join(map(str, seeds))),
        ("delay", f"{result['delay_s']:g} s from a sample to the wheel"),
        ("table", str(result["table"])),
        ("ramp", NOT_KNOWN if ramp is None else f"{said(ramp)} m/s²"),
        ("grade", f"{result.get('grade_deg') or 0.0:g}°"),
        ("versions", packages),
    ]
    body = "".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in pairs)
    return f"""<section><h2>Where these numbers come from</h2>
<p>Robot and ground are models: the page compares controllers on them, and does not say what a robot in a
field would do.</p><dl class="pairs">{body}</dl></section>"""


def _table(head: Sequence[str], rows: Iterable[str], text: int = 1) -> str:
    """Return a table whose first columns hold text, and the others numbers."""
    cells = "".join(
        f"<th scope=col{' class=text' if number < text else ''}>{escape(name)}</th>"
        for number, name in enumerate(head)
    )
    body = f"<thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="scroll"><table>{body}</table></div>'
