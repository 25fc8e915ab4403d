"""The card of a model: what it was trained on, how good it is, what it is not for, its size and its time.

It is made of the manifest and of ``training.json``, which is written beside a model that was evaluated; ``terrain
inspect MODEL`` shows it, and it lies beside the model as Markdown.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, field_validator

from pipelines.learn.model_file import (
    CARD_FILE,
    MODEL_FILE,
    ONNX_FILE,
    TRAINING_FILE,
    ModelInfo,
    drawn_window,
    read_files,
    read_model,
    seal,
    window_words,
)
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
from terrain.classify.confidence import CoverageFigures
from terrain.classify.metrics import ClassFigures
from terrain.errors import ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import parse_document
from terrain.files.names import printable

if TYPE_CHECKING:
    import pandas as pd

    from features.motion import Motion
    from pipelines.learn.evaluation import CrossvalResult
    from terrain.records import Array, Windows

N_TIMED = 50
"""Windows whose time is measured, one by one; the median is stated."""

WEAK_BELOW = 0.5
"""A terrain that is recognised less often is named among the limits."""

MOVING_MPS = 0.03

PERCENT = ".1%"


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run that a model was trained on, as the tracking library lists it."""

    run_id: str
    robot: str
    terrain: str
    n_windows: int
    digest: str


class Evaluated(BaseModel):
    """What the card and the choice of the champion need of an evaluation's JSON; it may hold other figures."""

    model_config = ConfigDict(frozen=True, extra="allow")

    accuracy: float
    accuracy_ci: tuple[float, float]
    macro_f1: float
    per_class: dict[str, ClassFigures]
    per_run: tuple[dict[str, Any], ...]
    protocol: str
    repeats: int
    seed: int
    notes: tuple[str, ...]
    accuracy_at_coverage: tuple[CoverageFigures, ...] = ()
    support: tuple[dict[str, Any], ...] = ()

    @property
    def chance(self) -> float:
        """Accuracy of always predicting the class with the most windows."""
        counts = [figures.n_windows for figures in self.per_class.values()]
        return max(counts) / sum(counts)


class TrainingRecord(BaseModel):
    """What is known of a training beside its model: what MLflow is given, and what the card says.

    Parameters
    ----------
    params : as MLflow holds them
    runs : of the data set
    evaluation, importance : on held-out runs, as ``train --json`` has them
    chosen : hyper-parameters that inner folds chose
    limits : in sentences, what the model is not for
    versions : of the packages that it was trained with
    latency_ms, onnx_latency_ms : median time of one window, and of its network alone; None where not measured
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    params: dict[str, Any]
    runs: tuple[RunRow, ...]
    evaluation: dict[str, Any]
    importance: tuple[dict[str, Any], ...]
    chosen: dict[str, Any]
    limits: tuple[str, ...]
    versions: str
    latency_ms: float | None = None
    onnx_latency_ms: float | None = None

    @field_validator("evaluation")
    @classmethod
    def _check_evaluation(cls, document: dict[str, Any]) -> dict[str, Any]:
        Evaluated.model_validate(document)
        return document

    @property
    def evaluated(self) -> Evaluated:
        """The evaluation, checked."""
        return Evaluated.model_validate(self.evaluation)

    def as_json(self) -> dict[str, Any]:
        """Return all fields by name."""
        return self.model_dump(mode="json")


@dataclass(frozen=True, repr=False)
class ModelResult(Result):
    """What a model states of itself."""

    model: str = described("as it was asked for")
    recipe: str = described("what was trained")
    classes: tuple[str, ...] = described("terrains, in the order of the probabilities")
    window_s: float = described("length of a window", "s")
    windows: str = described("how they are cut")
    channels: Mapping[str, tuple[str, ...]] = described("channels that a log must have, by stream")
    rate_hz: Mapping[str, float] = described("their rates", "Hz")
    robots: tuple[str, ...] = described("robots whose runs it was trained on")
    filter: str = described("filter whose estimates it uses; empty where it uses none")
    dataset: str = described("name of the training data")
    data_digest: str = described("digest of the training runs")
    commit: str = described("of the code")
    n_training_runs: int = described("runs that it was trained on")
    finds_unknown: bool = described("whether a window may be called unknown")
    counts_support: bool = described("whether it counts training runs near a window's motion")
    names_sets: bool = described("whether it gives sets of terrains that hold the true one in 90 %")
    files: Mapping[str, int] = described("size of each file in bytes")
    training: TrainingRecord | None = described("how it was trained; None of one that was not evaluated")

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a terrain."""
        import pandas as pd

        figures = {} if self.training is None else self.training.evaluated.per_class
        return pd.DataFrame([{"terrain": name, **row._asdict()} for name, row in figures.items()])


def model_result(folder: Path, name: str) -> ModelResult:
    """Return what the model in a folder states of itself, as it was asked for by name.

    Raises
    ------
    ModelError
        if there is no model, or a file of it is damaged.
    """
    model = read_model(folder)
    info, record = read_training(folder)
    fields = "recipe classes window_s channels rate_hz robots filter dataset data_digest commit"
    return ModelResult(
        model=name,
        **{field: getattr(info, field) for field in fields.split()},
        windows=window_words(info),
        n_training_runs=len(info.run_digests),
        finds_unknown=model.novelty is not None,
        counts_support=model.support is not None,
        names_sets=info.conformal is not None,
        files={
            file: (folder / file).stat().st_size
            for file in (MODEL_FILE, ONNX_FILE)
            if (folder / file).is_file()
        },
        training=record,
    )


def read_training(folder: Path) -> tuple[ModelInfo, TrainingRecord | None]:
    """Return what a model is and how it was trained; None of one that was not evaluated.

    Raises
    ------
    ModelError
        if there is no model, or a file of it is damaged.
    """
    info, contents = read_files(folder)
    if TRAINING_FILE not in contents:
        return info, None
    try:
        return info, parse_document(contents[TRAINING_FILE], TrainingRecord)
    except ValueError as error:
        text = printable(" ".join(str(error).split()))[:160]
        raise ModelError(f"{folder / TRAINING_FILE}: is no record of a training ({text})") from None


def write_training(folder: Path, name: str, info: ModelInfo, record: TrainingRecord) -> None:
    """Write how a model was trained, and its card, beside the model, whose time is then measured."""
    from pipelines.report.markdown import markdown_text

    timed = record.model_copy(update=_measured(folder))
    atomic_write(folder / TRAINING_FILE, timed.model_dump_json(indent=1) + "\n")
    seal(folder, info)
    atomic_write(folder / CARD_FILE, markdown_text(report(model_result(folder, name))))
    seal(folder, info)


def _measured(folder: Path) -> dict[str, float | None]:
    """Return the time that one window takes the model in a folder, and its network by ONNX."""
    import numpy as np

    from pipelines.live.model import assess
    from terrain.classify.network_onnx import time_of_onnx

    model = read_model(folder)
    window = drawn_window(model.layout, model.info.window_s)
    assess(model, window)  # compiles and fills caches
    times_s = np.empty(N_TIMED)
    for number in range(N_TIMED):
        began_s = time.perf_counter()
        assess(model, window)
        times_s[number] = time.perf_counter() - began_s
    onnx = folder / ONNX_FILE
    onnx_times_s = time_of_onnx(onnx.read_bytes(), window, N_TIMED) if onnx.is_file() else None
    return {
        "latency_ms": 1e3 * float(np.median(times_s)),
        "onnx_latency_ms": None if onnx_times_s is None else 1e3 * float(np.median(onnx_times_s)),
    }


def limits_of(
    info: ModelInfo, windows: Windows, motion: Motion | None, evaluation: CrossvalResult
) -> tuple[str, ...]:
    """Return in sentences what a model is not for.

    Parameters
    ----------
    info : how windows are cut, and where they came from
    windows : that it was trained on; they need no samples
    motion : how the robot moved in each window; None where that is not known
    evaluation : on held-out runs
    """
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
    return tuple(sentence(text) for text in limits)


def _run_speeds(run_id: Array, speed_mps: Array) -> list[float]:
    """Return the median speed of the windows of each run in which it moves, of runs that have such."""
    import numpy as np

    moving = speed_mps > MOVING_MPS
    return [float(np.median(speed_mps[moving & (run_id == run)])) for run in np.unique(run_id[moving])]


def report(result: ModelResult) -> Report:
    """Return what a model states of itself."""
    title, next_step = f"Model {result.model}", f"terrain predict --data runs/ --model {result.model}"
    lead = (
        f"recipe {result.recipe}, windows of {result.window_s:g} s, "
        f"{plural(result.n_training_runs, 'training run')}"
    )
    uses = _uses(result)
    if result.training is None:
        answer = f"A model for {enumerated(result.classes)} that was not evaluated when it was stored."
        return Report(title, answer, parts=[uses], lead=lead, next_step=next_step)
    limits, evaluated = result.training.limits, result.training.evaluated
    n_runs = Counter(str(row["terrain"]) for row in evaluated.per_run)
    recall = [row.recall for row in evaluated.per_class.values()]
    columns = (
        *("terrain", "runs"),
        *(Column("precision", PERCENT), Column("recall", PERCENT), Column("F1", ".3f")),
        "windows",
    )
    accuracy, ends = format_value(evaluated.accuracy, PERCENT), interval(*evaluated.accuracy_ci, PERCENT)
    return Report(
        title=title,
        answer=(f"Of windows of held-out runs {accuracy} are classified correctly ({ends}, 95 % over runs)."),
        lead=lead,
        picture=Figure(
            "Windows of each terrain that are recognised",
            [
                Panel(
                    [Bars("recall", list(evaluated.per_class), recall)], x_label="recall", x_range=(0.0, 1.0)
                )
            ],
            caption="On runs that were held out of training.",
        ),
        parts=[
            Table(columns, [(name, n_runs[name], *row) for name, row in evaluated.per_class.items()]),
            Section("Not for", [Text(text) for text in limits[:3]]),
        ],
        details=[
            Section("Not for, further", [Text(text) for text in limits[3:]]),
            _figures(evaluated),
            _support(evaluated),
            Section("Notes", [Text(sentence(text), "note") for text in evaluated.notes]),
            Section("Needs", [uses]),
            Section("Made", [_made(result, result.training)]),
        ],
        next_step=next_step,
    )


def _uses(result: ModelResult) -> Pairs:
    answers = {
        "unknown terrain": result.finds_unknown,
        "how far training runs support it": result.counts_support,
        "sets of terrains": result.names_sets,
    }
    also = ", ".join(name for name, there in answers.items() if there)
    return Pairs(
        [
            ("terrains", ", ".join(result.classes)),
            ("robots", ", ".join(result.robots) or NOT_KNOWN),
            *((stream, ", ".join(channels)) for stream, channels in result.channels.items()),
            ("estimates of the filter", result.filter or "none"),
            ("also answers", also or "nothing beside the terrain"),
        ],
        "What it needs and gives",
    )


def _figures(evaluated: Evaluated) -> Section:
    from pipelines.learn.evaluation import CrossvalResult

    rows = [("always the most frequent terrain", format_value(evaluated.chance, PERCENT), NOT_KNOWN)]
    for each in fields(CrossvalResult):
        value, ends = getattr(evaluated, each.name, None), getattr(evaluated, f"{each.name}_ci", None)
        if isinstance(value, float) and each.metadata["unit"] != "s":
            form = each.metadata["form"]
            shown = NOT_KNOWN if ends is None else interval(ends[0], ends[1], form)
            rows.append((each.metadata["description"], format_value(value, form), shown))
    for part in evaluated.accuracy_at_coverage:
        text = f"accuracy of the most confident {part.coverage:.0%} of windows"
        rows.append((text, format_value(part.accuracy, PERCENT), interval(*part.accuracy_ci, PERCENT)))
    protocol = (
        f"Protocol {evaluated.protocol}: whole runs are held out; {evaluated.repeats} fold assignments "
        f"from seed {evaluated.seed}. Scaling, selection and calibration are fitted inside of each "
        "training part."
    )
    return Section("Figures", [Table(("figure", "value", "95 % over runs"), rows), Text(protocol)])


def _support(evaluated: Evaluated) -> Section:
    """Return runs, windows and accuracy of each terrain by regime of driving."""
    if not evaluated.support:
        return Section("Support", [Text("How the robot moved is not known.")])
    cells: dict[str, list[str]] = {}
    for row in evaluated.support:
        accuracy = format_value(row.get("accuracy"), ".0%")
        shown = f"{row.get('n_runs')}/{row['windows']} {accuracy}" if row.get("windows") else "none"
        cells.setdefault(str(row.get("regime")), []).append(shown)
    table = Table(
        ("driving", *evaluated.per_class),
        [(regime, *row) for regime, row in cells.items()],
        note="Runs/windows, and accuracy when held out.",
    )
    return Section("Support", [table])


def _made(result: ModelResult, training: TrainingRecord) -> Pairs:
    chosen = ", ".join(f"{name} {format_value(value)}" for name, value in training.chosen.items())
    timed = f"median of {N_TIMED}, on the machine that trained it"
    times_ms = {
        f"time of one window, {timed}": training.latency_ms,
        "its network by ONNX": training.onnx_latency_ms,
    }
    return Pairs(
        [
            ("chosen", chosen or NOT_KNOWN),
            ("data", f"{result.dataset} ({result.data_digest[:12]})"),
            ("windows", result.windows),
            *((text, value, ".2f", "ms") for text, value in times_ms.items() if value is not None),
            *((f"size of {name}", n_bytes, ",", "bytes") for name, n_bytes in result.files.items()),
            ("code", result.commit),
            ("licence", metadata.metadata("terrain-slip")["License-Expression"]),
            ("versions", training.versions),
        ]
    )
