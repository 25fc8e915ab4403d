"""One self-contained HTML page that says how good a classifier is, and what stands behind the numbers."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import metadata
from platform import python_version
from typing import Any

from matplotlib.figure import Figure

from pipelines.classify.extras import MIN_CLASSES
from pipelines.classify.metrics import VOTE_SPAN_S
from pipelines.reporting.drawing import NOT_KNOWN, percent, sentence, svg_text
from pipelines.reporting.page import page
from terrain.control.slip_table import DRIVE_STATES

Result = Mapping[str, Any]

PACKAGES = (
    "terrain-slip",
    "numpy",
    "scipy",
    "scikit-learn",
    "numba",
    "pandas",
    "pyarrow",
    "mlflow",
    "matplotlib",
)
"""Packages whose versions decide what numbers come out."""

WEAK_BELOW = 0.5
WIDE = ("per_run", "motion", "slip")
"""Figures that take the whole width; they come after those that stand side by side."""

HEADLINES = {
    "grouped": "of windows classified correctly, whole runs held out",
    "leave-one-run-out": "of windows classified correctly, each run held out in turn",
    "published": (
        "of windows classified correctly under the published protocol, for comparison with papers only"
    ),
}
CAPTIONS = {
    "confusion": (
        "Each row is a true terrain and adds up to 100%; dark cells off the diagonal show what it is "
        "taken for."
    ),
    "per_run": (
        "Each bar is one run, the dashed line the accuracy over all windows of its terrain; one long bad run "
        "weighs more than several short ones."
    ),
    "reliability": (
        "Each point is a bin of equally many windows; below the dashed line the stated probability promises "
        "more than it keeps, above it less."
    ),
    "learning_curve": (
        "The curve shows what each further run brought; where it is still rising at its right end, more runs "
        "help."
    ),
    "motion": (
        "One run on grass: the filter (band: two standard deviations) beside what each sensor says of speed "
        "and yaw rate, and its innovations, which should fill the grey band and no more."
    ),
    "slip": (
        "The same run: wheel speeds beside the speed over ground, and the slip of each wheel, with "
        "two standard deviations."
    ),
    "importance": (
        "A long bar is an input that the model needs; related inputs share their weight, so that each "
        "alone looks small."
    ),
}


def html_report(result: Result, figures: Mapping[str, Figure]) -> str:
    """Return the report as one HTML page.

    Parameters
    ----------
    result : dict
        ``dataset``, ``crossval`` (what :func:`pipelines.classify.crossval.crossval` returns), and where there
        are any ``train``, ``predict``, ``data_digest``, ``commit``, ``seed``, ``created``, ``elapsed_s``,
        ``commands`` and ``versions`` (as :func:`versions`, which is asked where they are missing)
    figures : figures by name, as :func:`pipelines.classify.figures.all_figures` makes them
    """
    crossval = result["crossval"]
    sections = [
        _headline(crossval),
        _notes(crossval),
        _slip_found(result.get("slip")),
        _figures(figures),
        _per_class(crossval),
        _extras(crossval),
        _training(result.get("train")),
        _predictions(result),
        _target_slip(result.get("predict")),
        _provenance(result),
    ]
    name = str(result.get("dataset") or "unnamed data set")
    title = f"Terrain classification: {name}"
    return page("Terrain classification", name, title, _lead(crossval, result), sections)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide what numbers come out."""
    found = {"python": python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _lead(crossval: Result, result: Result) -> str:
    parts = [
        f"{crossval['n_runs']} runs",
        f"{len(crossval['classes'])} terrains",
        f"{crossval['n_windows']} windows of {crossval['window_s']:g} s",
        f"recipe {crossval['recipe']}",
    ]
    if result.get("created"):
        parts.append(f"made {result['created']}")
    return " · ".join(escape(str(part)) for part in parts)


def _headline(crossval: Result) -> str:
    low, high = crossval["accuracy_ci"]
    spread = crossval.get("accuracy_spread")
    sayings = [f"95% interval over runs: <b>{percent(low)} to {percent(high)}</b>."]
    if spread is not None:
        sayings.append(
            f"Over {crossval['repeats']} fold assignments it spreads by <b>±{100 * spread:.1f}</b> points "
            "(1 standard deviation)."
        )
    alone = _single_runs(crossval)
    if alone:
        sayings.append(
            f"The interval is too narrow: {escape(_listed(alone))} {'has' if len(alone) == 1 else 'have'} "
            "one run only, and one run shows no spread."
        )
    cards = [
        ("balanced accuracy", crossval["balanced_accuracy"], "every terrain counts the same"),
        ("macro F1", crossval["macro_f1"], "mean of F1 over terrains"),
        ("vote accuracy", crossval["vote_accuracy"], f"majority of the last {VOTE_SPAN_S:g} s"),
        ("calibration error", crossval["ece"], "stated probability against accuracy (ECE)"),
    ]
    small = "".join(
        f'<div class="card"><dt>{name}</dt><dd>{percent(value)}</dd><p>{meaning}</p></div>'
        for name, value, meaning in cards
    )
    words = HEADLINES.get(
        crossval["protocol"], f"of windows classified correctly, protocol {crossval['protocol']}"
    )
    if alone and crossval["protocol"] != "published":
        words += f", except {_listed(alone)}"
    return f"""<section class="headline" aria-label="Headline">
<div class="big"><p class="number">{percent(crossval["accuracy"])}</p>
<div><p class="words">{escape(words)}</p><p>{" ".join(sayings)}</p></div></div>
{_scale(crossval)}
<dl class="cards">{small}</dl>
</section>"""


def _scale(crossval: Result) -> str:
    """Draw accuracy, its interval and what it must beat on one line from 0 to 100 %."""
    low, high = crossval["accuracy_ci"]
    marks = [("guess", _largest_share(crossval), "always the most frequent terrain")]
    if crossval.get("speed_only_accuracy") is not None:
        marks.append(("speed", crossval["speed_only_accuracy"], "speed alone"))
    drawn = "".join(f'<i class="{kind}" style="left:{100 * value:.2f}%"></i>' for kind, value, _ in marks)
    keys = "".join(
        f'<span><i class="key {kind}"></i>{words} {percent(value)}</span>' for kind, value, words in marks
    )
    return f"""<div class="scale" aria-hidden="true"><div class="line">
<i class="band" style="left:{100 * low:.2f}%;width:{100 * (high - low):.2f}%"></i>{drawn}
<i class="dot" style="left:{100 * crossval["accuracy"]:.2f}%"></i></div>
<div class="ends"><span>0%</span><span>50%</span><span>100%</span></div>
<p class="legend"><span><i class="key dot"></i>accuracy</span>
<span><i class="key band"></i>95% interval</span>{keys}</p></div>"""


def _notes(crossval: Result) -> str:
    notes = crossval.get("notes") or []
    if not notes:
        return ""
    items = "".join(f"<li>{escape(sentence(str(note)))}</li>" for note in notes)
    return f'<section class="notes"><h2>Read this first</h2><ul>{items}</ul></section>'


def _figures(figures: Mapping[str, Figure]) -> str:
    if not figures:
        return ""
    drawn = []
    for number, (name, figure) in enumerate(sorted(figures.items(), key=lambda item: item[0] in WIDE), 1):
        caption = escape(CAPTIONS.get(name, name.replace("_", " ")))
        source = base64.b64encode(svg_text(figure).encode()).decode()
        wide = " wide" if name in WIDE else ""
        drawn.append(
            f'<figure class="{escape(name)}{wide}">'
            f'<img src="data:image/svg+xml;base64,{source}" alt="{caption}">'
            f"<figcaption><b>Figure {number}.</b> {caption}</figcaption></figure>"
        )
    return f'<section><h2>Figures</h2><div class="figures">{"".join(drawn)}</div></section>'


def _slip_found(rows: Sequence[Result] | None) -> str:
    if not rows:
        return ""
    cells = [
        f"<tr><th scope=row>{escape(str(row['terrain']))}</th><td>{row['n_runs']}</td>"
        + "".join(
            f"<td>{NOT_KNOWN if row[key] is None else format(row[key], form)}</td>"
            for key, form in (
                ("slip_mean", ".3f"),
                ("slip_true_mean", ".3f"),
                ("slip_rmse", ".4f"),
                ("nees", ".2f"),
            )
        )
        + "</tr>"
        for row in rows
    ]
    head = ["terrain", "runs", "slip", "true slip", "RMSE of a run's mean", "NEES a state"]
    return f"""<section><h2>From logs to slip</h2>{_table(head, cells, text=(0,))}
<p class="small">The runs are simulated, with soil, slope, load, tyres and driving drawn anew for each; their
steady slip is estimated from what the sensors say and set beside the truth. NEES: squared error over the
variance that the filter states, 1 where it is honest.</p></section>"""


def _per_class(crossval: Result) -> str:
    repeats = crossval.get("repeats") or 1
    runs = Counter(str(run["terrain"]) for run in crossval.get("per_run") or [])
    rows = []
    for name, counts in zip(crossval["classes"], crossval["confusion"], strict=True):
        figures = crossval["per_class"][name]
        others = [
            (n, other) for n, other in zip(counts, crossval["classes"], strict=True) if other != name and n
        ]
        n_most, most = max(others, default=(0, None), key=lambda pair: pair[0])
        taken = f"{escape(str(most))} ({percent(n_most / sum(counts))})" if most is not None else NOT_KNOWN
        weak = ' class="weak"' if figures["recall"] < WEAK_BELOW else ""
        rows.append(
            f"<tr{weak}><th scope=row>{escape(str(name))}</th><td>{runs[str(name)] or NOT_KNOWN}</td>"
            f"<td>{figures['n_windows'] / repeats:.0f}</td><td>{percent(figures['recall'])}</td>"
            f"<td>{percent(figures['precision'])}</td><td>{percent(figures['f1'])}</td>"
            f"<td class=text>{taken}</td></tr>"
        )
    head = ["terrain", "runs", "windows", "recall", "precision", "F1", "most often taken for"]
    return f"""<section><h2>Each terrain</h2>{_table(head, rows, text=(0, 6))}
<p class="small">Recall: of the windows on this terrain, the share that is classified correctly.
Precision: of the windows called this terrain, the share that is. Counted over all repeats.
{_weak_words(crossval)}</p></section>"""


def _weak_words(crossval: Result) -> str:
    weak = [str(name) for name in crossval["classes"] if crossval["per_class"][name]["recall"] < WEAK_BELOW]
    if not weak:
        return ""
    return f"<b>Wrong more often than right: {escape(_listed(weak))}.</b>"


def _extras(crossval: Result) -> str:
    items = []
    guess = _largest_share(crossval)
    speed = crossval.get("speed_only_accuracy")
    if speed is not None:
        items.append(
            (
                "Is it only the way of driving?",
                f"From wheel speeds alone: <b>{percent(speed)}</b>. Always naming the most frequent terrain: "
                f"{percent(guess)}. With all signals: {percent(crossval['accuracy'])}.",
            )
        )
    if crossval.get("slow_fast"):
        items.append(("Does it carry over to another speed?", _slow_fast(crossval["slow_fast"])))
    curve = crossval.get("learning_curve")
    if curve:
        items.append(("How many runs would be enough?", escape(sentence(curve["statement"]))))
    if not items:
        return ""
    body = "".join(f"<dt>{question}</dt><dd>{answer}</dd>" for question, answer in items)
    return f'<section><h2>What the headline does not say</h2><dl class="questions">{body}</dl></section>'


def _slow_fast(split: Result) -> str:
    left_out = ", ".join(f"{name} ({reason})" for name, reason in (split.get("left_out") or {}).items())
    left = f" Left out: {escape(left_out)}." if left_out else ""
    if split["status"] != "applicable":
        kept = _plural(len(split.get("classes") or {}), "terrain")
        return f"Not applicable: {kept} with enough slow and fast runs, {MIN_CLASSES} are needed.{left}"
    speeds = "; ".join(
        f"{name} {side['slow_mps']:.2f} and {side['fast_mps']:.2f} m/s"
        for name, side in split["classes"].items()
    )
    return (
        "Learned on the slow runs of each terrain, tested on the fast ones: "
        f"<b>{percent(split['slow_to_fast'])}</b>; the other way: <b>{percent(split['fast_to_slow'])}</b>. "
        f"Median speeds, slow and fast: {escape(speeds)}.{left}"
    )


def _training(train: Result | None) -> str:
    if not train:
        return ""
    rows = [
        ("model", _code(train.get("model_uri"))),
        ("version", escape(_said(train.get("version")))),
        ("champion", _champion(train)),
        ("tracking run", _code(train.get("run_id"))),
    ]
    return f"<section><h2>The model</h2>{_pairs(rows)}</section>"


def _champion(train: Result) -> str:
    moved = train.get("alias_moved")
    if moved is None:
        return NOT_KNOWN
    verdict = "this version is now champion" if moved else "the champion stays what it was"
    reason = train.get("alias_reason")
    return escape(f"{verdict}: {reason}" if reason else verdict)


def _predictions(result: Result) -> str:
    predict = result.get("predict")
    if not predict:
        return ""
    crossval = result["crossval"]
    held_out = {str(run["run_id"]): run for run in crossval.get("per_run") or []}
    classes = [str(name) for name in predict.get("classes") or crossval["classes"]]
    by_run: dict[str, list[Result]] = {}
    for window in predict.get("windows") or []:
        by_run.setdefault(str(window["run_id"]), []).append(window)
    rows = [_run_row(run_id, windows, held_out.get(run_id), classes) for run_id, windows in by_run.items()]
    accuracy = predict.get("accuracy")
    said = [f"{predict.get('n_windows', 0)} windows of {len(by_run)} runs."]
    if accuracy is not None:
        said.append(f"Accuracy against their labels: {percent(accuracy)}.")
    if predict.get("n_unknown_labels"):
        said.append(
            f"{predict['n_unknown_labels']} windows carry a label that the model never saw; "
            "they are predicted and kept out of the accuracy."
        )
    warning = ""
    if result.get("train") and accuracy is not None:
        warning = (
            '<p class="warning">If the model learned from these same runs, this accuracy says how well it '
            "remembers them. What to expect of new runs is the held-out figure: "
            f"{percent(crossval['accuracy'])}.</p>"
        )
    head = [
        "run", "true terrain", "windows", "most often predicted", "accuracy", "held out",
        "slip, traction", "slip, braking", "slip, steady", "status",
    ]  # fmt: skip
    return f"""<section class="dense"><h2>Predictions of the model</h2><p>{" ".join(said)}</p>{warning}
{_table(head, rows, text=(0, 1, 3, 9))}
<p class="small">Most often predicted: in brackets its share of the windows of the run. Held out: accuracy
of the run in cross-validation. Slip and its status: target slip of the terrain that is predicted most often.
</p></section>"""


def _run_row(run_id: str, windows: Sequence[Result], held_out: Result | None, classes: Sequence[str]) -> str:
    terrain, count = Counter(str(window["terrain"]) for window in windows).most_common(1)[0]
    named = next(window for window in windows if str(window["terrain"]) == terrain)
    usual = str(held_out["terrain"]) if held_out else None
    labels = [str(window["label"]) if window.get("label") else usual for window in windows]
    true_terrain = Counter(label for label in labels if label).most_common(1)
    truth = true_terrain[0][0] if true_terrain else None
    hits = [str(w["terrain"]) == label for w, label in zip(windows, labels, strict=True) if label in classes]
    slip = named.get("target_slip") or {}
    wrong = ' class="weak"' if truth and terrain != truth else ""
    return (
        f"<tr{wrong}><th scope=row>{escape(run_id)}</th><td class=text>{escape(truth or NOT_KNOWN)}</td>"
        f"<td>{len(windows)}</td><td class=text>{escape(terrain)} ({percent(count / len(windows), 0)})</td>"
        f"<td>{percent(sum(hits) / len(hits)) if hits else NOT_KNOWN}</td>"
        f"<td>{percent(held_out['accuracy']) if held_out else NOT_KNOWN}</td>"
        + "".join(f"<td>{_slip(slip.get(state))}</td>" for state in DRIVE_STATES)
        + f"<td class=text>{escape(_status(named.get('status')))}</td></tr>"
    )


def _target_slip(predict: Result | None) -> str:
    table = (predict or {}).get("table")
    if not table:
        return ""
    rows = [
        f"<tr><th scope=row>{escape(str(terrain))}</th>"
        + "".join(f"<td>{_slip(entry.get(state))}</td>" for state in DRIVE_STATES)
        + f"<td class=text>{escape(_status(entry.get('status')))}</td>"
        + f'<td class="text long">{escape(_source(str(terrain), entry))}</td></tr>'
        for terrain, entry in table.items()
    ]
    bare = [name for name, entry in table.items() if "unestimated" in _status(entry.get("status"))]
    warning = ""
    if bare:
        warning = (
            f'<p class="warning">{len(bare)} of {len(table)} entries have no measured runs behind them '
            "(status unestimated): try them with care before a robot is driven by them.</p>"
        )
    return f"""<section><h2>Target slip</h2>{warning}
{_table(["terrain", *DRIVE_STATES, "status", "source"], rows, text=(0, 4, 5))}
<p class="small">Slip ratio: wheel speed less ground speed, over the faster of the two; positive in traction.
</p></section>"""


def _source(terrain: str, entry: Result) -> str:
    borrowed = entry.get("entry")
    said = _said(entry.get("source"))
    return said if borrowed in (None, terrain) else f"no entry of its own, fallback {borrowed!r}: {said}"


def _status(status: Any) -> str:
    """Say a status once, whether it is one for all drive states or one for each."""
    if isinstance(status, Mapping):
        return ", ".join(dict.fromkeys(_said(part) for part in status.values())) or NOT_KNOWN
    return _said(status)


def _provenance(result: Result) -> str:
    crossval = result["crossval"]
    seed = result.get("seed")
    dropped = ", ".join(f"{n} {reason}" for reason, n in (crossval.get("dropped") or {}).items())
    packages = result.get("versions")
    elapsed_s = result.get("elapsed_s")
    rows = [
        ("data digest", _code(result.get("data_digest"))),
        ("commit", _code(result.get("commit"))),
        ("seed", escape(_said(crossval.get("seed") if seed is None else seed))),
        ("protocol", escape(f"{crossval['protocol']}, {_plural(crossval.get('repeats') or 1, 'repeat')}")),
        ("recipe", escape(_said(crossval.get("recipe")))),
        ("windows", escape(f"{crossval['window_s']:g} s; left out: {dropped or 'none'}")),
        ("signal sets", escape(_said(crossval.get("signal_sets")))),
        ("features", escape(_said(crossval.get("n_features")))),
        ("made", escape(_said(result.get("created")))),
        ("took", NOT_KNOWN if elapsed_s is None else _duration(elapsed_s)),
        ("versions", escape(_said(versions() if packages is None else packages))),
    ]
    commands = "\n".join(str(command) for command in result.get("commands") or [])
    again = f"<h3>To reproduce</h3><pre>{escape(commands)}</pre>" if commands else ""
    return f"<section><h2>Where these numbers come from</h2>{_pairs(rows)}{again}</section>"


def _table(head: Sequence[str], rows: Iterable[str], text: Sequence[int]) -> str:
    cells = "".join(
        f"<th scope=col{' class=text' if number in text else ''}>{escape(name)}</th>"
        for number, name in enumerate(head)
    )
    body = f"<thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="scroll"><table>{body}</table></div>'


def _pairs(rows: Iterable[tuple[str, str]]) -> str:
    return (
        '<dl class="pairs">' + "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows) + "</dl>"
    )


def _code(value: Any) -> str:
    return NOT_KNOWN if value is None else f"<code>{escape(str(value))}</code>"


def _said(value: Any) -> str:
    """Say a value in words: nothing is a dash, a mapping or a sequence is listed."""
    if value is None or value == "":
        return NOT_KNOWN
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_said(part)}" for name, part in value.items()) or NOT_KNOWN
    if isinstance(value, (list, tuple)):
        return ", ".join(_said(part) for part in value) or NOT_KNOWN
    return str(value)


def _slip(value: float | None) -> str:
    return NOT_KNOWN if value is None else f"{value:.3f}".replace("-", "\N{MINUS SIGN}")


def _duration(elapsed_s: float) -> str:
    minutes, seconds = divmod(round(elapsed_s), 60)
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def _largest_share(crossval: Result) -> float:
    """Return the accuracy of always naming the class with the most windows."""
    counts = [figures["n_windows"] for figures in crossval["per_class"].values()]
    return float(max(counts) / sum(counts))


def _single_runs(crossval: Result) -> list[str]:
    runs = Counter(str(run["terrain"]) for run in crossval.get("per_run") or [])
    return sorted(name for name, count in runs.items() if count == 1)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
