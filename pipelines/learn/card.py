"""The card of a model: what it was trained on, how good it is, what it is not for, its size and its time.

It is the report of a training: written beside the model as Markdown and as JSON, and shown by ``terrain
inspect MODEL``.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from pipelines.report import (
    NOT_KNOWN,
    Bars,
    Column,
    Figure,
    Pairs,
    Panel,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    enumerated,
    format_value,
    interval,
    plural,
    sentence,
)
from pipelines.report.versions import versions

if TYPE_CHECKING:
    import pandas as pd

    from features.motion import Motion
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.model_file import ModelInfo
    from terrain.records import Windows

N_TIMED = 50
"""Windows whose time is measured, one by one; the median is stated."""

WEAK_BELOW = 0.5
"""A terrain that is recognised less often is named among the limits."""

MOVING_MPS = 0.03
VOTE_SPAN_S = 5.0

PERCENT = ".1%"
Ends: TypeAlias = tuple[float | None, float | None]
FIGURES: Mapping[str, tuple[str, str]] = {
    "accuracy": ("accuracy of single windows", PERCENT),
    "chance": ("always the most frequent terrain", PERCENT),
    "balanced_accuracy": ("balanced accuracy", PERCENT),
    "macro_f1": ("macro F1", ".3f"),
    "vote_accuracy": (f"accuracy of the vote over {VOTE_SPAN_S:g} s", PERCENT),
    "vote_windows": ("windows in such a vote, mean", ".1f"),
    "filtered_accuracy": ("accuracy behind the filter over time", PERCENT),
    "ece": ("expected calibration error of the confidence", ".3f"),
    "confidence_auc": ("area from confidence to correctness", ".3f"),
    "auroc_unknown": ("area for terrains that were not trained", ".3f"),
}
"""Fields of an evaluation, what they are called and their format; those that it lacks are passed over."""


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
    rate_hz: float
    channels: tuple[str, ...]


class FigureRow(NamedTuple):
    """A figure in words, its value, its interval of 95 % over runs, and its format."""

    name: str
    value: float | None
    interval: Ends | None
    form: str


class SupportCell(NamedTuple):
    """Runs and windows of a terrain in a regime; ``accuracy`` when held out, None where not known."""

    terrain: str
    n_runs: int
    n_windows: int
    accuracy: float | None

    @property
    def text(self) -> str:
        r"""The cell in a table.

        Examples
        --------
        >>> SupportCell("ice", 3, 42, 0.931).text, SupportCell("ice", 0, 0, None).text
        ('3/42 93\xa0%', 'none')
        """
        return (
            f"{self.n_runs}/{self.n_windows} {format_value(self.accuracy, '.0%')}"
            if self.n_windows
            else "none"
        )


class RegimeRow(NamedTuple):
    """A regime of driving, and its cells in the order of the terrains."""

    regime: str
    cells: tuple[SupportCell, ...]


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


@dataclass(frozen=True, repr=False)
class ModelResult(Result):
    """What a model states of itself."""

    model: str = described("as it was asked for")
    recipe: str = described("what was trained")
    classes: tuple[str, ...] = described("terrains, in the order of the probabilities")
    window_s: float = described("length of a window", "s")
    channels: Mapping[str, tuple[str, ...]] = described("channels that a log must have, by stream")
    robots: tuple[str, ...] = described("robots whose runs it was trained on")
    filter: str = described("filter whose estimates it uses; empty where it uses none")
    n_training_runs: int = described("runs that it was trained on")
    finds_unknown: bool = described("whether a window may be called unknown")
    counts_support: bool = described("whether it counts training runs near a window's motion")
    names_sets: bool = described("whether it gives sets of terrains that hold the true one in 90 %")
    card: ModelCard | None = described("of its training; None of one that was not evaluated")

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a terrain."""
        import pandas as pd

        return pd.DataFrame([row._asdict() for row in (() if self.card is None else self.card.terrains)])


def model_result(uri: str | Path) -> ModelResult:
    """Return what a model states of itself.

    Parameters
    ----------
    uri : ``models:/NAME@champion``, ``models:/NAME/3``, or a folder

    Raises
    ------
    ModelError
        if there is no such model, or a file of it is damaged.
    """
    from pipelines.learn.load import model_folder

    with model_folder(str(uri)) as folder:
        return folder_result(folder, str(uri))


def folder_result(folder: Path, name: str) -> ModelResult:
    """Return what the model in a folder states of itself; errors as :func:`model_result`."""
    from pydantic import TypeAdapter

    from pipelines.learn.model_file import CARD_JSON, read_files, read_model
    from terrain.errors import LogError, ModelError
    from terrain.files.documents import parse_json

    model = read_model(folder)
    info, contents = read_files(folder)
    card = None
    if CARD_JSON in contents:
        try:
            parse_json(contents[CARD_JSON])
            card = TypeAdapter(ModelCard).validate_json(contents[CARD_JSON])
        except (LogError, ValueError) as error:
            text = " ".join(str(error).split())[:160]
            raise ModelError(f"{folder / CARD_JSON}: is no card of a model ({text})") from None
    return ModelResult(
        name,
        info.recipe,
        info.classes,
        info.window_s,
        info.channels,
        info.robots,
        info.filter,
        len(info.run_digests),
        model.novelty is not None,
        model.support is not None,
        info.conformal is not None,
        card,
    )


def write_card(folder: Path, card: ModelCard, info: ModelInfo) -> None:
    """Write a card beside its model, whose files and whose time it then states."""
    from pydantic import TypeAdapter

    from pipelines.learn.model_file import CARD_FILE, CARD_JSON, seal
    from pipelines.report.markdown import markdown_text
    from terrain.files.atomic import atomic_write

    measured = _measured(card, folder)
    content = TypeAdapter(ModelCard).dump_json(measured, indent=2)
    atomic_write(folder / CARD_JSON, content + b"\n")
    seal(folder, info)
    atomic_write(folder / CARD_FILE, markdown_text(report(folder_result(folder, card.name))))
    seal(folder, info)


def model_card(
    name: str,
    info: ModelInfo,
    windows: Windows,
    motion: Motion | None,
    evaluation: CrossvalResult,
    chosen: Mapping[str, Any],
) -> ModelCard:
    """Return the card of a model that is not written yet.

    Parameters
    ----------
    name : of the registered model
    info : how windows are cut, and where they came from
    windows : that it was trained on; they need no samples
    motion : how the robot moved in each window; None where that is not known
    evaluation : on held-out runs
    chosen : hyper-parameters
    """
    from pipelines.learn.champion import scope_of

    n_runs = Counter(run.terrain for run in evaluation.per_run)
    n_windows = Counter(windows.terrain.astype(str).tolist())
    cells: dict[str, list[SupportCell]] = {}
    for row in evaluation.support or ():
        cells.setdefault(row.regime, []).append(
            SupportCell(row.terrain, row.n_runs, row.windows, row.accuracy)
        )
    licence = metadata.metadata("terrain-slip")
    scope = scope_of(info)
    return ModelCard(
        name=name,
        recipe=info.recipe,
        chosen=", ".join(f"{key} {_plain(value)}" for key, value in chosen.items()) or NOT_KNOWN,
        robots=scope.robots,
        dataset=info.dataset,
        data_digest=info.data_digest,
        n_runs=evaluation.n_runs,
        n_windows=len(windows),
        window=scope.window,
        terrains=tuple(
            TerrainRow(key, n_runs[key], n_windows[key], row.precision, row.recall, row.f1)
            for key, row in evaluation.per_class.items()
        ),
        streams=tuple(
            StreamRow(stream, info.rate_hz[stream], tuple(channels))
            for stream, channels in info.channels.items()
        ),
        protocol=(
            f"Protocol {evaluation.protocol}: whole runs are held out; {evaluation.repeats} fold assignments "
            f"from seed {evaluation.seed}. Scaling, selection and calibration are fitted inside of each "
            "training part."
        ),
        figures=tuple(figure_rows(evaluation)),
        limits=tuple(sentence(text) for text in _limits(info, windows, motion, evaluation)),
        notes=tuple(sentence(text) for text in evaluation.notes),
        commit=info.commit,
        licence=next(
            (licence[key] for key in ("License-Expression", "License") if key in licence), NOT_KNOWN
        ),
        versions=versions(),
        support=tuple(RegimeRow(regime, tuple(row)) for regime, row in cells.items()),
    )


def figure_rows(evaluation: CrossvalResult) -> list[FigureRow]:
    """Return the figures that an evaluation has, with their intervals."""
    rows = []
    for name, (text, form) in FIGURES.items():
        value, ci = getattr(evaluation, name), getattr(evaluation, f"{name}_ci", None)
        if value is not None:
            rows.append(FigureRow(text, _known(value), _known_ends(ci), form))
    for part in evaluation.accuracy_at_coverage:
        text = f"accuracy of the most certain {part.coverage:.0%} of windows"
        rows.append(FigureRow(text, _known(part.accuracy), _known_ends(part.accuracy_ci), PERCENT))
    if (delay := evaluation.filter_delay_s) is not None:
        ends = _known_ends(delay.p50_ci)
        rows.append(FigureRow("delay of the filter in s, median", _known(delay.p50), ends, ".2f"))
    return rows


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _known_ends(ends: Sequence[float] | None) -> Ends | None:
    return None if ends is None else (_known(ends[0]), _known(ends[1]))


def _limits(
    info: ModelInfo, windows: Windows, motion: Motion | None, evaluation: CrossvalResult
) -> list[str]:
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
            f"standing, and speed changes above {info.steady.max_accel_mps2:g} m/s²: such windows are left out"
        )
    if speeds := [] if motion is None else _run_speeds(windows.run_id.astype(str), motion.speed_mps):
        limits.append(
            f"speeds outside of {min(speeds):.2f} to {max(speeds):.2f} m/s, the medians of the slowest and "
            "the fastest training run"
        )
    if weak := [name for name, row in evaluation.per_class.items() if row.recall < WEAK_BELOW]:
        limits.append(f"decisions that rest on {', '.join(weak)}: recognised in under half of the windows")
    if missing := [f"{row.terrain} at {row.regime}" for row in evaluation.support or () if not row.windows]:
        limits.append(f"regimes without a training window: {', '.join(missing)}")
    marked = evaluation.unsupported
    if marked is not None and marked.accuracy is not None:
        limits.append(
            f"predictions that no training run supports, {format_value(marked.windows_ratio, '.0%')} of the "
            f"windows: {format_value(marked.accuracy, '.0%')} correct"
        )
    return limits


def _run_speeds(run_id: Any, speed_mps: Any) -> list[float]:
    """Return the median speed of the windows of each run in which it moves, of runs that have such."""
    import numpy as np

    moving = speed_mps > MOVING_MPS
    return [float(np.median(speed_mps[moving & (run_id == run)])) for run in np.unique(run_id[moving])]


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _measured(card: ModelCard, folder: Path) -> ModelCard:
    """Return the card with the sizes of the files in a folder, and with the time that one window takes."""
    import numpy as np

    from pipelines.learn.model_file import MODEL_FILE, ONNX_FILE, drawn_window, read_model
    from pipelines.learn.network_onnx import time_of_onnx
    from pipelines.live.model import assess

    model = read_model(folder)
    window = drawn_window(model.layout, model.info.window_s)
    assess(model, window)  # compiles and fills caches
    times_s = np.empty(N_TIMED)
    for number in range(N_TIMED):
        began_s = time.perf_counter()
        assess(model, window)
        times_s[number] = time.perf_counter() - began_s
    files = [folder / name for name in (MODEL_FILE, ONNX_FILE) if (folder / name).is_file()]
    onnx = folder / ONNX_FILE
    onnx_times_s = time_of_onnx(onnx.read_bytes(), window, N_TIMED) if onnx.is_file() else None
    return replace(
        card,
        files=tuple(FileRow(path.name, path.stat().st_size) for path in files),
        latency_ms=1e3 * float(np.median(times_s)),
        onnx_latency_ms=None if onnx_times_s is None else 1e3 * float(np.median(onnx_times_s)),
        n_timed=N_TIMED,
    )


def report(result: ModelResult) -> Report:
    """Return what a model states of itself."""
    card = result.card
    answers = [
        name
        for name, there in (
            ("unknown terrain", result.finds_unknown),
            ("how far training runs support it", result.counts_support),
            ("sets of terrains", result.names_sets),
        )
        if there
    ]
    uses = Pairs(
        [
            ("terrains", ", ".join(result.classes)),
            ("robots", ", ".join(result.robots) or NOT_KNOWN),
            *((stream, ", ".join(channels)) for stream, channels in result.channels.items()),
            ("estimates of the filter", result.filter or "none"),
            ("also answers", ", ".join(answers) or "nothing beside the terrain"),
        ],
        "What it needs and gives",
    )
    lead = (
        f"recipe {result.recipe}, windows of {result.window_s:g} s, "
        f"{plural(result.n_training_runs, 'training run')}"
    )
    title, next_step = f"Model {result.model}", f"terrain predict --data runs/ --model {result.model}"
    if card is None:
        answer = f"A model for {enumerated(result.classes)} that was not evaluated when it was stored."
        return Report(title, answer, parts=[uses], lead=lead, next_step=next_step)
    accuracy = card.figures[0]
    answer = (
        f"Of windows of held-out runs {format_value(accuracy.value, accuracy.form)} are classified correctly"
    )
    if accuracy.interval is not None:
        answer += f" ({interval(*accuracy.interval, accuracy.form)}, 95 % over runs)"
    names = [row.terrain for row in card.terrains]
    recall = [row.recall for row in card.terrains]
    return Report(
        title=title,
        answer=f"{answer}.",
        lead=lead,
        picture=Figure(
            "Windows of each terrain that are recognised",
            [Panel([Bars("recall", names, recall)], x_label="recall", x_range=(0.0, 1.0))],
            caption="On runs that were held out of training.",
        ),
        parts=[
            Table(
                (
                    "terrain",
                    Column("runs"),
                    Column("windows"),
                    Column("precision", PERCENT),
                    Column("recall", PERCENT),
                    Column("F1", ".3f"),
                ),
                card.terrains,
            ),
            Section("Not for", [Text(text) for text in card.limits[:3]]),
        ],
        details=[
            Section("Not for, further", [Text(text) for text in card.limits[3:]]),
            Section("Figures", [_figures_table(card.figures), Text(card.protocol)]),
            Section("Support", _support_parts(card.support)),
            Section("Notes", [Text(text, "note") for text in card.notes]),
            Section("Needs", [uses]),
            Section("Made", [_made(card)]),
        ],
        next_step=next_step,
    )


def _figures_table(figures: Sequence[FigureRow]) -> Table:
    rows = [
        (
            row.name,
            format_value(row.value, row.form),
            NOT_KNOWN if row.interval is None else interval(*row.interval, row.form),
        )
        for row in figures
    ]
    return Table(("figure", "value", "95 % over runs"), rows)


def _support_parts(support: Sequence[RegimeRow]) -> list[Any]:
    if not support:
        return [Text("How the robot moved is not known.")]
    names = [cell.terrain for cell in support[0].cells]
    rows = [(row.regime, *(cell.text for cell in row.cells)) for row in support]
    return [Table(("driving", *names), rows, note="Runs/windows, and accuracy when held out.")]


def _made(card: ModelCard) -> Pairs:
    timed = "" if card.latency_ms is None else f"median of {card.n_timed}, on the machine that trained it"
    return Pairs(
        [
            ("chosen", card.chosen),
            ("data", f"{card.dataset} ({card.data_digest[:12]})"),
            ("windows", card.window),
            *((f"time of one window, {timed}", card.latency_ms, ".2f", "ms") for _ in [0] if timed),
            *(
                ("its network by ONNX", card.onnx_latency_ms, ".2f", "ms")
                for _ in [0]
                if card.onnx_latency_ms is not None
            ),
            *((f"size of {row.name}", row.n_bytes, ",", "bytes") for row in card.files),
            ("code", card.commit),
            ("licence", card.licence),
            ("versions", card.versions),
        ]
    )
