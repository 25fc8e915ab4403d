"""One self-contained HTML page of a diagnosis: pictures first, then causes, gain, and what was not seen."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from matplotlib.figure import Figure

from pipelines.explain.figures import (
    CHANNEL_WORDS,
    STRETCH_S,
    Shown,
    dependence_figure,
    run_figure,
    share_figure,
    spectra_figure,
    telling,
    titled,
)
from pipelines.explain.ground import ground_words
from pipelines.reporting.drawing import NOT_KNOWN, png_bytes, sentence, styled, svg_text
from pipelines.reporting.numbers import format_number as said
from pipelines.reporting.page import page
from pipelines.reporting.pictures import MAX_SVG_BYTES
from pipelines.reporting.progress import Progress, silent
from pipelines.reporting.versions import versions
from terrain.effects import LIBRARY, PARAMETER
from terrain.files.atomic import atomic_write

if TYPE_CHECKING:
    from pipelines.explain.explain import Explained

Result = Mapping[str, Any]
NBSP = "\N{NO-BREAK SPACE}"
MAX_EMBEDDED = 12
"""Pictures of whole runs on the page itself; those of more runs lie beside it."""

RUN_DPI = 96
TINY = 1e-12
"""Of an interval's edge: what is left of two equal numbers."""

SI = {
    "ratio": "",
    "radps": "rad/s",
    "rad": "rad",
    "mps2": "m/s²",
    "m": "m",
    "s": "s",
    "nspm": "N s/m",
}
"""How pages write the last word of a parameter's name."""

SMALL = {"rad": "mrad", "radps": "mrad/s", "s": "ms", "m": "mm"}
"""Units of a thousandth."""

CAPTIONS = {
    "stretch": "Left: what was measured, and what the simulation makes of the logged wheels, steering and "
    "tilt. Right: the difference, over a band that 95 % of the noise stays in. Drawn are {span} s of a "
    "run with a larger squared residual over the noise than four in five, not the largest. All have passed "
    "the same low-pass.",
    "shares": "A full bar is the squared residual of a channel. Grey is what is left of it when every effect "
    "of the library is let go: noise, as far as anybody knows. What differs from run to run by itself, as "
    "tyre pressure does, counts as systematic.",
    "spectra": "Dashed: the noise. A line above it is more than noise. Dotted: the cut-off of the low-pass, "
    "beyond which nothing is compared.",
    "dependence": "A residual that is noise follows nothing: its means lie on the line. Intervals are over "
    "runs; those of single runs come from the noise, and what differs from run to run by itself lies beyond "
    "them. Turn: wheel speed right minus left, or last minus first wheel.",
}
DRAWN = {
    "stretch": "Measured against simulated",
    "shares": "How much of it is systematic",
    "spectra": "At which frequencies",
    "dependence": "What it follows",
}


class RunPicture(NamedTuple):
    """A whole run's picture: title, file beside the page, and the PNG where the page itself holds it."""

    title: str
    file: str
    content: bytes | None


def write_explain_page(out: Path, found: Explained, result: Result, progress: Progress = silent) -> None:
    """Write ``explain.html``, and all its pictures into ``pictures``.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    from pipelines.explain.explain import PAGE_FILE, PICTURES

    runs = shown_runs(found)
    figures = explain_figures(found, runs, result)
    drawn = {name: (svg_text(figure), png_bytes(figure)) for name, figure in figures.items()}
    for name, (svg, png) in drawn.items():
        atomic_write(out / PICTURES / f"{name}.png", png)
        atomic_write(out / PICTURES / f"{name}.svg", svg)
    pictures = []
    for done, run in enumerate(runs, start=1):
        stem = re.sub(r"[^\w.-]", "_", run.run_id)
        file = f"{PICTURES}/run_{done:03d}_{stem}.png"
        content = _small_png(run_figure(run, found.noise, titled(run, whole=True)))
        atomic_write(out / file, content)
        pictures.append(RunPicture(titled(run, whole=True), file, content if done <= MAX_EMBEDDED else None))
        progress("pictures", done, len(runs))
    atomic_write(out / PAGE_FILE, explain_page(result, drawn, pictures))


def _small_png(figure: Figure) -> bytes:
    """Return a picture for the screen: those of many runs lie on one page."""
    with styled():
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=RUN_DPI, metadata={"Software": None})
    return file.getvalue()


def shown_runs(found: Explained) -> list[Shown]:
    """Return all runs as they are drawn, those behind the diagnosis first; excluded ones are left out."""
    from pipelines.explain.explain import inputs_of, rows_before_after

    gone = {run.run_id for run in found.diagnosis.excluded_runs}
    runs = []
    for run in (*found.used, *found.held_out):
        if run.run_id in gone:
            continue
        before, after = rows_before_after(found, run)
        if len(before.time_s):
            runs.append(
                Shown(
                    before.run_id,
                    before.terrain,
                    run in found.held_out,
                    before.time_s,
                    before.pace_mps,
                    before.measured,
                    before.predicted,
                    None if after is None else after.predicted,
                    inputs_of(before),
                )
            )
    return runs


def explain_figures(found: Explained, runs: Sequence[Shown], result: Result) -> dict[str, Figure]:
    """Return the figures by name; all but the first are of the runs behind the diagnosis."""
    used = [run for run in runs if not run.held_out]
    example = telling(used, found.noise)
    extended = found.extended is not None
    return {
        "stretch": run_figure(example, found.noise, f"A telling stretch: {titled(example, whole=False)}"),
        "shares": share_figure(result["residual_before"], result["residual_after"], extended),
        "spectra": spectra_figure(used, found.noise, found.low_pass.cutoff_hz),
        "dependence": dependence_figure(used, found.noise),
    }


def explain_page(result: Result, figures: Mapping[str, tuple[str, bytes]], runs: Sequence[RunPicture]) -> str:
    """Return the page.

    Parameters
    ----------
    result : what :func:`pipelines.explain.explain.explain` returns
    figures : as SVG and as PNG, by the names of :data:`DRAWN`
    runs : pictures of whole runs
    """
    heading = f"What the simulation of {result['robot']} gets wrong"
    parts = [f"{result['n_runs']} runs compared"]
    if result.get("held_out"):
        parts.append(f"{len(result['held_out'])} kept for the gain")
    parts += [str(result[key]) for key in ("data", "terrain") if result.get(key)]
    sections = [
        _verdict(result),
        *(_drawn(name, *figure) for name, figure in figures.items()),
        _runs(runs),
        _causes(result),
        _ambiguous(result),
        _next_drive(result),
        _unexplained(result),
        _gain(result),
        _limits(result),
        _ruled_out(result),
        _health(result),
        _provenance(result),
    ]
    lead = " · ".join(map(escape, parts))
    return page("Measured runs against a simulation", heading, heading, lead, sections)


def words_of(effect: str) -> str:
    """Return what a page calls an effect.

    Examples
    --------
    >>> words_of("effective_track")
    'effective track'
    """
    return effect.replace("_", " ")


def quantity(parameter: str, value: float | None) -> str:
    r"""Return a value as people say it.

    Examples
    --------
    >>> quantity("gyro_bias_radps", 0.0031), quantity("wheel_radius_ratio", 0.004)
    ('3.1\xa0mrad/s', '0.4\xa0%')
    >>> quantity("scrub_ratio", 0.02)
    '0.02'
    >>> quantity("lever_x_m", None)
    '–'
    """
    if value is None or not math.isfinite(value):
        return NOT_KNOWN
    if parameter in PARAMETER and PARAMETER[parameter].as_percent:
        return f"{_two(100.0 * value)}{NBSP}%"
    unit = parameter.rpartition("_")[2]
    if unit in SMALL and abs(value) < 0.0995:
        return f"{_two(1000.0 * value)}{NBSP}{SMALL[unit]}"
    return f"{_two(value)}{NBSP}{SI.get(unit, unit)}".strip(NBSP)


def _two(value: float) -> str:
    return said(float(f"{value:.2g}"))


def verdict_words(result: Result) -> str:
    """Return the answer in a sentence or two, plain text."""
    causes = [
        f"{words_of(cause['name'])} "
        f"({', '.join(quantity(each['name'], each['value']) for each in cause['parameters'])})"
        for cause in result["causes"]
    ]
    sentences = []
    if causes:
        sentences.append(f"The simulation lacks {_listed(causes)}.")
    sentences += [
        f"One of {_listed(list(map(words_of, names)), 'or')} is there, and these runs do not tell which."
        for names in result["ambiguous_sets"]
    ]
    if result["unexplained"]:
        channels = dict.fromkeys(CHANNEL_WORDS[left["channel"]][0] for left in result["unexplained"])
        also = " more" if sentences else ""
        sentences.append(f"Something{also} without a name shows in {_listed(list(channels))}.")
    if not sentences:
        sentences.append("These runs show nothing that the simulation lacks.")
    if result["not_excited"]:
        n, of = len(result["not_excited"]), len(result["detection_limits"])
        sentences.append(f"Of {of} numbers that may be wrong, {n} could not have been seen.")
    return " ".join(sentences)


def _listed(names: Sequence[str], last: str = "and") -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def _verdict(result: Result) -> str:
    parts = [f'<p class="words">{escape(verdict_words(result))}</p>']
    gained = result["gain"]
    if gained["measured"]:
        parts.append(f"<p>{escape(gain_words(gained))}</p>")
    if result["excluded_runs"]:
        ids = ", ".join(str(run["run_id"]) for run in result["excluded_runs"])
        parts.append(f'<p class="warning">Runs that do not belong and were left out: {escape(ids)}.</p>')
    parts += [f'<p class="warning">{escape(note)}</p>' for note in result.get("notes", ())]
    return f'<section class="headline" aria-label="Verdict"><h2>Verdict</h2>{"".join(parts)}</section>'


def gain_words(gained: Result) -> str:
    """Return what an extension is worth in a sentence, plain text."""
    runs = f"{len(gained['runs'])} runs" if len(gained["runs"]) != 1 else "one run"
    interval = _between([_percent(edge) for edge in gained["ci"]])
    told = f"{_percent(gained['reduction'])} of the squared residual ({interval})"
    if gained["refused"]:
        return f"On {runs} that had no say in it no gain can be claimed: {told}, an interval that holds zero."
    return f"On {runs} that had no say in it, what was built in takes {told}."


def _percent(share: float | None) -> str:
    return NOT_KNOWN if share is None else f"{_two(100.0 * share)}{NBSP}%"


def _between(edges: Sequence[str]) -> str:
    return f"{edges[0]} to {edges[1]}"


def _drawn(name: str, svg: str, png: bytes) -> str:
    caption = escape(CAPTIONS[name].format(span=f"{STRETCH_S:g}") if name == "stretch" else CAPTIONS[name])
    content, kind = (svg.encode(), "svg+xml") if len(svg) <= MAX_SVG_BYTES else (png, "png")
    return (
        f'<section><h2>{DRAWN[name]}</h2><div class="figures"><figure class="wide">'
        f'<img src="data:image/{kind};base64,{base64.b64encode(content).decode()}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure></div></section>"
    )


def _runs(runs: Sequence[RunPicture]) -> str:
    if not runs:
        return ""
    parts, links = [], []
    for run in runs:
        if run.content is None:
            links.append(f'<a href="{escape(run.file, quote=True)}">{escape(run.title)}</a>')
            continue
        source = base64.b64encode(run.content).decode()
        parts.append(
            f"<details><summary>{escape(run.title)}</summary>"
            f'<img src="data:image/png;base64,{source}" alt="{escape(run.title, quote=True)}" '
            'style="width:100%;height:auto;background:#fff"></details>'
        )
    more = f'<p class="small">Beside the page: {" · ".join(links)}</p>' if links else ""
    return f"<section><h2>Every run</h2>{''.join(parts)}{more}</section>"


def _causes(result: Result) -> str:
    if not result["causes"]:
        return ""
    rows = []
    for cause in result["causes"]:
        aliases = ", ".join(words_of(name) for name in cause["aliases"])
        also = (
            f'<br><span class="small" style="font-weight:400">no log tells it from: {escape(aliases)}</span>'
            if aliases
            else ""
        )
        for number, each in enumerate(cause["parameters"]):
            first = number == 0
            rows.append(
                f"<tr><th scope=row>{escape(words_of(cause['name'])) + also if first else ''}</th>"
                f"<td class=text><code>{escape(each['name'])}</code></td>"
                f"<td>{said(each['value'])}</td><td class=text>{SI.get(each['unit'], each['unit'])}</td>"
                f"<td>{_interval(each['ci'])}</td>"
                f"<td>{_gained(cause['held_out_gain'], cause['gain_ci']) if first else ''}</td>"
                f"<td class=text>{escape(_channels(cause['channels'])) if first else ''}</td>"
                f"<td>{said(round(cause['z'], 1)) if first else ''}</td></tr>"
            )
    head = ["cause", "parameter", "value", "", "95 %", "held-out gain", "shows in", "z"]
    return f"""<section class="dense"><h2>Causes</h2>{_table(head, rows, (0, 1, 3, 6))}
<p class="small">Values are over what the description has already. The held-out gain is the share of the
whitened squared residual of all channels that a cause takes from runs left out of its fit, one after the
other, beside the other causes; z is its evidence in standard deviations.</p></section>"""


def _channels(names: Iterable[str]) -> str:
    return ", ".join(CHANNEL_WORDS[name][0] for name in names)


def _interval(edges: Sequence[float | None]) -> str:
    known = [edge for edge in edges if edge is not None]
    return (
        NOT_KNOWN if len(known) < 2 else _between([said(edge if abs(edge) > TINY else 0.0) for edge in known])
    )


def _gained(share: float | None, edges: Sequence[float | None]) -> str:
    return f"{_percent(share)}<br><span class=small>{_between([_percent(edge) for edge in edges])}</span>"


def _ambiguous(result: Result) -> str:
    if not result["ambiguous_sets"]:
        return ""
    needs = {effect.name: effect.needs for effect in LIBRARY}
    twins = {effect.name: dict(effect.twins) for effect in LIBRARY}
    parts = []
    for names in result["ambiguous_sets"]:
        rows = []
        for name in names:
            told = [
                f"{quantity(each['name'], each['value'])} "
                f"({_between([quantity(each['name'], edge) for edge in each['ci']])})"
                for each in result["ambiguous_values"].get(name, ())
            ]
            parted = [
                f"{CHANNEL_WORDS[channel][0]} parts it from {words_of(other)}"
                for other, channel in twins[name].items()
                if other in names
            ]
            rows.append(
                f"<tr><th scope=row>{escape(words_of(name))}</th>"
                f"<td class=text>{escape(', '.join(told))}</td>"
                f'<td class="text long">{escape("; ".join([needs[name], *parted]))}</td></tr>'
            )
        parts.append(_table(["one of", "its value, were it alone", "driving that shows it"], rows, (0, 1, 2)))
    return f"<section class=dense><h2>Not told apart</h2>{''.join(parts)}</section>"


def _next_drive(result: Result) -> str:
    coming = result["next_drive"]
    if coming is None:
        return ""
    drive = ", ".join(f"{words_of(key)} {value}" for key, value in coming.items() if key != "reason")
    return (
        f'<section><h2>What to drive next</h2><p class="words">{escape(drive)}</p>'
        f"<p>{escape(sentence(str(coming['reason'])))}</p></section>"
    )


def _unexplained(result: Result) -> str:
    rows = [
        f"<tr><th scope=row>{escape(CHANNEL_WORDS[left['channel']][0])}</th>"
        f"<td class=text>{escape(left['input'])}</td>"
        f"<td>{NOT_KNOWN if left['z'] is None else said(round(left['z'], 1))}</td>"
        f"<td>{_percent(left['share']) if left['share'] else NOT_KNOWN}</td></tr>"
        for left in result["unexplained"]
    ]
    if not rows:
        return ""
    return f"""<section class="dense"><h2>Without a name</h2>
{_table(["channel", "follows", "z", "share of its squared residual"], rows, (0, 1))}
<p class="small">The residual of the channel follows the input, beside all causes, and nothing in the library
says why. The input is the clearest of some thirty that were tried.</p></section>"""


def _gain(result: Result) -> str:
    gained = result["gain"]
    if not gained["measured"]:
        return (
            "<section><h2>Gain</h2><p>A gain on untouched runs was not measured: "
            f"{escape(gained['reason'])}.</p></section>"
        )
    rows = []
    for name, found in gained["channels"].items():
        words, unit = CHANNEL_WORDS[name]
        claim = _gained(found["reduction"], found["ci"])
        if found["refused"]:
            worse = found["ci"][1] is not None and found["ci"][1] < 0.0
            claim += f"<br><span class=small>{'worse than before' if worse else 'no gain to claim'}</span>"
        rows.append(
            f"<tr><th scope=row>{words}</th><td class=text>{unit}</td>"
            + "".join(f"<td>{_said(found[key])}</td>" for key in ("rms_before", "rms_after"))
            + "".join(f"<td>{_said(found[key])}</td>" for key in ("white_before", "white_after"))
            + f"<td>{claim}</td></tr>"
        )
    head = [
        "channel",
        "",
        "rms before",
        "after",
        "over the noise before",
        "after",
        "squared residual, less by",
    ]
    more = "".join(_compared(gained.get(key), words) for key, words in GAIN_WORDS.items())
    excluded = [str(run["run_id"]) for run in gained["excluded_runs"]]
    gone = f" Left out, since they do not belong: {escape(', '.join(excluded))}." if excluded else ""
    return f"""<section class="dense"><h2>Gain, on runs that had no say in it</h2>
<p>{escape(gain_words(gained))}</p>
{_table(head, rows, (0, 1))}
<p class="small">The sentence is of all channels whitened, with what scatters from run to run taken out; the
table of each channel behind the low-pass. Intervals: 95&nbsp;%, bootstrap over {escape(gained["clusters"])}.
Over the noise: root mean square behind the whitening filter, 1 for noise alone. Runs:
{escape(", ".join(gained["runs"]))}.{gone}</p>{more}</section>"""


GAIN_WORDS = {"filter": "Error of the filter {name}", "classifier": "Classifier {name}"}
ERROR_WORDS = {
    "speed_mps": ("speed, root mean square", "m/s"),
    "yaw_rate_radps": ("yaw rate, root mean square", "rad/s"),
    "slip_ratio": ("mean slip of a run, off by", ""),
    "accuracy": ("accuracy", ""),
}


def _compared(found: Mapping[str, Any] | None, words: str) -> str:
    """Return a table of figures before and after.

    ``found`` has a ``name``, ``errors`` by figure, each with ``before``, ``after`` and ``change_ci``, and a
    ``reason`` where there are none.
    """
    if not found or not (found["errors"] or found.get("reason")):
        return ""
    title = escape(words.format(name=found["name"]))
    if found.get("reason"):
        return f"<h3>{title}</h3><p>Not measured: {escape(str(found['reason']))}</p>"
    rows = []
    for key, each in found["errors"].items():
        word, unit = ERROR_WORDS.get(key, (words_of(key), ""))
        interval = each.get("change_ci")
        rows.append(
            f"<tr><th scope=row>{escape(word)}</th><td class=text>{unit}</td><td>{_said(each['before'])}</td>"
            f"<td>{_said(each['after'])}</td><td>{_interval(interval) if interval else NOT_KNOWN}</td></tr>"
        )
    return f"<h3>{title}</h3>{_table(['figure', '', 'before', 'after', 'change, 95 %'], rows, (0, 1))}"


def _said(value: float | None) -> str:
    return NOT_KNOWN if value is None else said(value)


def limit_words(limit: Mapping[str, Any], missed: bool) -> str:
    r"""Return a detection limit as a sentence, plain text.

    Examples
    --------
    >>> limit = {"name": "steering_offset_1_rad", "detection_limit": 0.003}
    >>> limit_words(limit, False)
    'A steering offset 1 under 3\xa0mrad would not have been seen.'
    >>> limit_words(limit | {"detection_limit": None}, True)
    'A steering offset 1 of any size would not have been seen.'
    """
    parameter = PARAMETER[limit["name"]]
    name = parameter.label
    article = "An" if name[0] in "aeiou" and not name.startswith("one") else "A"
    if limit["detection_limit"] is None:
        return f"{article} {name} of any size would not have been seen."
    off = "off by " if parameter.is_error else ""
    under = f"{off}under {quantity(limit['name'], limit['detection_limit'])}"
    most = max(-parameter.low, parameter.high)
    if missed and limit["detection_limit"] >= most:
        under = f"of any size that is likely (up to {quantity(limit['name'], most)})"
    return f"{article} {name} {under} would not have been seen."


def _limits(result: Result) -> str:
    missed = {limit["name"] for limit in result["not_excited"]}
    parts = []
    if missed:
        rows = [_limit_row(limit, True) for limit in result["detection_limits"] if limit["name"] in missed]
        parts.append(
            "<h3>Not excited: the driving would not have shown them</h3>"
            + _table(["", "driving that shows it"], rows, (0, 1))
        )
    rows = [_limit_row(limit, False) for limit in result["detection_limits"] if limit["name"] not in missed]
    if rows:
        parts.append(
            ("<h3>Detection limits</h3>" if missed else "")
            + _table(["", "driving that shows it"], rows, (0, 1))
        )
    return f"""<section class="dense"><h2>What would not have been seen</h2>{"".join(parts)}
<p class="small">Silent does not mean absent: at its limit an effect is found nine times in ten.</p>
</section>"""


def _limit_row(limit: Mapping[str, Any], missed: bool) -> str:
    return (
        f'<tr><td class="text long">{escape(limit_words(limit, missed))}</td>'
        f'<td class="text long">{escape(limit["needs"])}</td></tr>'
    )


def _ruled_out(result: Result) -> str:
    rows = [
        f"<tr><th scope=row>{escape(words_of(effect['name']))}</th>"
        f'<td class="text long">{escape(effect["reason"])}{_fitted(effect["parameters"])}</td>'
        f"<td>{NOT_KNOWN if effect['z'] is None else said(round(effect['z'], 1))}</td></tr>"
        for effect in result["ruled_out"]
    ]
    if not rows:
        return ""
    return (
        f'<section class="dense"><h2>Ruled out</h2>{_table(["effect", "why", "z"], rows, (0, 1))}</section>'
    )


def _fitted(parameters: Sequence[Mapping[str, Any]]) -> str:
    """Return the values that would fit, in words; nothing where none were fitted."""
    told = [
        f"{quantity(p['name'], p['value'])} ({quantity(p['name'], p['ci'][0])} to "
        f"{quantity(p['name'], p['ci'][1])})"
        for p in parameters
    ]
    return f"; it would be {' and '.join(told)}" if told else ""


def _health(result: Result) -> str:
    parts = []
    if result["excluded_runs"]:
        rows = [
            f"<tr><th scope=row>{escape(str(run['run_id']))}</th>"
            f'<td class="text long">{escape(run["reason"])}</td></tr>'
            for run in result["excluded_runs"]
        ]
        parts.append(f"<h3>Runs that do not belong</h3>{_table(['run', 'why'], rows, (0, 1))}")
    if result["clocks"]:
        rows = [
            f"<tr><th scope=row>{escape(str(clock['run_id']))}</th><td>{_ms(clock['offset_s'])}</td>"
            f"<td>{_ms(clock['std_s'])}</td></tr>"
            for clock in result["clocks"]
        ]
        head = ["run", "IMU and camera behind the wheels", "standard deviation"]
        parts.append(f"<h3>Clocks of the loggers</h3>{_table(head, rows, (0,))}")
    return f'<section class="dense"><h2>Health of the logs</h2>{"".join(parts)}</section>' if parts else ""


def _ms(seconds: float | None) -> str:
    return NOT_KNOWN if seconds is None else f"{said(round(1000.0 * seconds, 1))}{NBSP}ms"


def _provenance(result: Result) -> str:
    built_in = ", ".join(f"{name} {said(value)}" for name, value in result["built_in"].items())
    pairs = [
        ("data", f"{result['data']} ({result['data_digest'][:12]})"),
        ("description", result["model"] or result["description"]),
        ("effects built in already", built_in or "none"),
        ("ground it drives on", ground_words(result.get("grounds", ()))),
        ("effects that may be named", f"{len(result['effects'])}: {_listed(result['effects'])}"),
        ("runs behind the diagnosis", _listed(result["used"])),
    ]
    if result["held_out"]:
        pairs.append(("runs kept for the gain", f"{_listed(result['held_out'])}; drawn by the seed"))
    pairs.append(("seed", str(result["seed"])))
    if result["extended"]:
        pairs.append(("extended description", result["extended"]["file"]))
    pairs.append(("versions", ", ".join(f"{name} {number}" for name, number in versions().items())))
    body = "".join(f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>" for name, value in pairs)
    return f'<section><h2>Where these numbers come from</h2><dl class="pairs">{body}</dl></section>'


def _table(head: Sequence[str], rows: Iterable[str], text: Sequence[int] = ()) -> str:
    """Return a table; ``text`` are the columns that hold no numbers."""
    cells = "".join(
        f"<th scope=col{' class=text' if number in text else ''}>{escape(name)}</th>"
        for number, name in enumerate(head)
    )
    body = f"<thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="scroll"><table>{body}</table></div>'
