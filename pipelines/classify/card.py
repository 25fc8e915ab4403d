"""The card of a model: what it was trained on, how good it is, what it is not for, its size and its time."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from features.motion import Motion
from pipelines.classify.card_support import RegimeRow, regime_rows
from pipelines.crossval.extras import MOVING_MPS
from pipelines.crossval.results import CrossvalReport
from pipelines.learn.model_file import ONNX_FILE, ModelInfo, drawn_window, read_model
from pipelines.learn.network_onnx import time_of_onnx
from pipelines.live.model import assess
from pipelines.models.champion import scope_of
from pipelines.reporting.json_file import as_json
from pipelines.reporting.markdown import render_markdown
from pipelines.reporting.numbers import NOT_KNOWN, percent, sentence
from pipelines.reporting.versions import versions
from pipelines.support.results import SupportReport
from terrain.classify.metrics import VOTE_SPAN_S
from terrain.records import Array, Windows

CARD_FILE, CARD_JSON = "model_card.md", "model_card.json"
N_TIMED = 50
"""Windows whose time is measured, one by one; the median is stated."""

WEAK_BELOW = 0.5
"""A terrain that is recognised less often is named among the limits."""

FIGURES: Mapping[str, str] = {
    "accuracy": "accuracy of single windows",
    "chance": "always the most frequent terrain",
    "balanced_accuracy": "balanced accuracy",
    "macro_f1": "macro F1",
    "vote_accuracy": f"accuracy of the vote over {VOTE_SPAN_S:g} s",
    "vote_windows": "windows in such a vote, mean",
    "filtered_accuracy": "accuracy behind the filter over time",
    "ece": "expected calibration error of the confidence",
    "confidence_auc": "area from confidence to correctness",
    "accuracy_at_coverage": "accuracy of the most certain windows",
    "auroc_unknown": "area for terrains that were not trained",
    "filter_delay_s": "delay of the filter in s",
}
"""Fields of a report and what they are called; those that a report lacks are passed over."""

PLAIN = ("vote_windows", "filter_delay_s", "confidence_auc", "auroc_unknown")
"""Figures that are no percentages."""


class TerrainRow(NamedTuple):
    """Training data of a terrain, and its figures on held-out runs."""

    terrain: str
    n_runs: int
    n_windows: int
    precision: float
    recall: float
    f1: float


class StreamRow(NamedTuple):
    """What a log must have of a stream."""

    stream: str
    rate: str
    channels: tuple[str, ...]


class FigureRow(NamedTuple):
    """A figure in words, its value and its interval as text."""

    name: str
    value: str
    interval: str


class FileRow(NamedTuple):
    """A file of the model and its size."""

    name: str
    n_bytes: int


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What is stated of a model; ``latency_ms`` is the median of one window, None where not measured.

    ``support`` has a row a regime of driving, empty where how the robot moved is not known.
    """

    name: str
    recipe: str
    chosen: str
    robots: tuple[str, ...]
    dataset: str
    data_digest: str
    n_runs: int
    n_windows: int
    window: str
    terrains: tuple[TerrainRow, ...]
    streams: tuple[StreamRow, ...]
    protocol: str
    figures: tuple[FigureRow, ...]
    limits: tuple[str, ...]
    notes: tuple[str, ...]
    commit: str
    licence: str
    versions: str
    support: tuple[RegimeRow, ...] = ()
    files: tuple[FileRow, ...] = ()
    latency_ms: float | None = None
    onnx_latency_ms: float | None = None
    n_timed: int = 0

    @property
    def latency_text(self) -> str:
        """The time of one window in words."""
        if self.latency_ms is None:
            return "not measured"
        beside = (
            "" if self.onnx_latency_ms is None else f"; its network by ONNX {self.onnx_latency_ms:.2f} ms"
        )
        return f"{self.latency_ms:.2f} ms (median of {self.n_timed}, on the machine that trained it){beside}"

    def texts(self) -> dict[str, str]:
        """Return the card as Markdown and as JSON, by file name."""
        document = {each.name: as_json(getattr(self, each.name)) for each in fields(self)}
        return {
            CARD_FILE: render_markdown("classify/model_card.md.j2", card=self),
            CARD_JSON: json.dumps(document, indent=2, allow_nan=False) + "\n",
        }


def model_card(
    name: str,
    info: ModelInfo,
    windows: Windows,
    motion: Motion | None,
    report: CrossvalReport,
    chosen: Mapping[str, Any],
) -> ModelCard:
    """Return the card of a model that is not written yet.

    Parameters
    ----------
    name : of the registered model
    info : content of ``terrain_model.json``
    windows : that it was trained on; they need no samples
    motion : how the robot moved in each window; None where that is not known
    report : its cross-validation, whatever figures it has
    chosen : hyper-parameters
    """
    scope = scope_of(info)
    return ModelCard(
        name=name,
        recipe=info.recipe,
        chosen=", ".join(f"{key} {_plain(value)}" for key, value in chosen.items()) or NOT_KNOWN,
        robots=scope.robots,
        dataset=info.dataset,
        data_digest=info.data_digest,
        n_runs=report.n_runs,
        n_windows=len(windows),
        window=scope.window,
        terrains=_terrain_rows(windows, report),
        streams=tuple(
            StreamRow(stream, f"{info.rate_hz[stream]:.4g} Hz", tuple(channels))
            for stream, channels in info.channels.items()
        ),
        protocol=(
            f"Protocol {report.protocol}: whole runs are held out; {report.repeats} fold assignments from "
            f"seed {report.seed}. Scaling, selection and calibration are fitted inside of each training part."
        ),
        figures=tuple(figure_rows(report)),
        limits=tuple(sentence(text) for text in _limits(info, windows, motion, report)),
        notes=tuple(sentence(text) for text in report.notes),
        commit=info.commit,
        licence=_licence(),
        versions=", ".join(f"{package} {number}" for package, number in versions().items()),
        support=regime_rows(report.support),
    )


def _terrain_rows(windows: Windows, report: CrossvalReport) -> tuple[TerrainRow, ...]:
    n_runs = Counter(run.terrain for run in report.per_run)
    n_windows = Counter(windows.terrain.astype(str).tolist())
    return tuple(
        TerrainRow(name, n_runs[name], n_windows[name], row.precision, row.recall, row.f1)
        for name, row in report.per_class.items()
    )


def figure_rows(report: CrossvalReport) -> list[FigureRow]:
    """Return the figures that a report has.

    A figure is a number, a record or mapping with ``value`` and an interval ``ci``, or several by key.  Its
    interval may be a field of its own: ``accuracy_ci`` of ``accuracy``.
    """
    rows: list[FigureRow] = []
    for field, text in FIGURES.items():
        value = getattr(report, field, None)
        if value is not None:
            rows += _rows(text, value, getattr(report, f"{field}_ci", None), plain=field in PLAIN)
    return rows


def _rows(text: str, value: Any, interval: Any, *, plain: bool) -> list[FigureRow]:
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        named = next((key for key in ("value", "mean", "estimate") if key in value), None)
        if named is not None:
            return _rows(text, value[named], value.get("ci", value.get("interval", interval)), plain=plain)
        intervals = interval if isinstance(interval, Mapping) else {}
        return [
            row
            for key, each in value.items()
            for row in _rows(f"{text} at {_plain(key)}", each, intervals.get(key), plain=plain)
        ]
    if not isinstance(value, int | float):
        return []
    form = (lambda each: f"{each:.3f}") if plain else percent
    known = isinstance(interval, Sequence) and len(interval) == 2 and None not in interval
    return [
        FigureRow(text, form(value), f"{form(interval[0])} to {form(interval[1])}" if known else NOT_KNOWN)
    ]


def _limits(info: ModelInfo, windows: Windows, motion: Motion | None, report: CrossvalReport) -> list[str]:
    """Return in sentences what the model is not for."""
    limits = [
        f"robots other than {', '.join(info.robots)}, and logs without its channels or with rates that "
        "differ by more than 5 %",
        f"terrains other than {', '.join(info.classes)}: unless it is refused as unknown, any ground is "
        "taken for one of them",
        "places, weather and sessions that the training runs do not cover: the figures are those of held-out "
        "runs of the same data set",
    ]
    if info.steady is not None:
        limits.append(
            f"standing, and speed changes above {info.steady.max_accel_mps2:g} m/s²: such windows are "
            "left out"
        )
    speeds = [] if motion is None else _run_speeds(windows.run_id.astype(str), motion.speed_mps)
    if speeds:
        limits.append(
            f"speeds outside of {min(speeds):.2f} to {max(speeds):.2f} m/s, the medians of the slowest and "
            "the fastest training run"
        )
    weak = [name for name, row in report.per_class.items() if row.recall < WEAK_BELOW]
    if weak:
        limits.append(f"decisions that rest on {', '.join(weak)}: recognised in under half of the windows")
    limits += _unsupported(report.support)
    return limits


def _run_speeds(run_id: Array, speed_mps: Array) -> list[float]:
    """Return the median speed of the windows of each run in which it moves, of runs that have such."""
    moving = speed_mps > MOVING_MPS
    return [float(np.median(speed_mps[moving & (run_id == run)])) for run in np.unique(run_id[moving])]


def _unsupported(support: SupportReport | None) -> list[str]:
    """Return the regimes without a window of a terrain, and how often unsupported predictions are right."""
    if support is None:
        return []
    missing = [f"{row.terrain} at {row.regime}" for row in support.rows if not row.windows]
    limits = [f"regimes without a training window: {', '.join(missing)}"] if missing else []
    marked = support.accuracy.unsupported
    if marked.accuracy is not None:
        limits.append(
            f"predictions that no training run supports, {marked.windows_ratio:.0%} of the windows: "
            f"{marked.accuracy:.0%} correct"
        )
    return limits


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _licence() -> str:
    found = metadata.metadata("terrain-slip")
    named = [found[key] for key in ("License-Expression", "License") if key in found]
    return str(named[0]) if named else NOT_KNOWN


def written(card: ModelCard, folder: Path) -> ModelCard:
    """Return the card with the sizes of the files in a folder, and with the time that one window takes.

    Parameters
    ----------
    card : of the model
    folder : of its files
    """
    model = read_model(folder)
    window = drawn_window(model.layout, model.info.window_s)
    assess(model, window)  # compiles and fills caches
    times_s = np.empty(N_TIMED)
    for number in range(N_TIMED):
        began_s = time.perf_counter()
        assess(model, window)
        times_s[number] = time.perf_counter() - began_s
    sizes = tuple(
        FileRow(path.relative_to(folder).as_posix(), path.stat().st_size)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix in (".skops", ".npz", ".onnx", ".data")
    )
    onnx = folder / ONNX_FILE
    onnx_times_s = time_of_onnx(onnx.read_bytes(), window, N_TIMED) if onnx.is_file() else None
    return replace(
        card,
        files=sizes,
        latency_ms=1e3 * float(np.median(times_s)),
        onnx_latency_ms=None if onnx_times_s is None else 1e3 * float(np.median(onnx_times_s)),
        n_timed=N_TIMED,
    )
