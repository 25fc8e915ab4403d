"""The card of a model: what it was trained on, how good it is, what it is not for, its size and its time.

It is made of the manifest and of ``training.json``, which is written beside a model that was evaluated; ``terrain
inspect MODEL`` shows it, and it lies beside the model as Markdown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from timeit import repeat
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipelines.learn.evaluation import PERCENT, CrossvalResult
from pipelines.learn.model_file import (
    CARD_FILE,
    MODEL_FILE,
    ONNX_FILE,
    TRAINING_FILE,
    drawn_window,
    read_files,
    read_model,
    seal,
)
from pipelines.learn.rates import accepted
from pipelines.learn.training_data import TrainedRun
from pipelines.live.assess import assess
from pipelines.live.model import ModelInfo
from pipelines.report.numbers import NOT_KNOWN, enumerated, format_value, sentence
from pipelines.report.results import Result, described
from pipelines.report.tree import Column, Pairs, Report, Section, Table, Text
from terrain.classify.held_out import ChannelImportance, run_speeds
from terrain.classify.limits import Motion
from terrain.errors import ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import parse_document
from terrain.files.names import printable
from terrain.records import Windows

N_TIMED = 50  #: Windows whose time is measured, one by one; the median is stated
WEAK_BELOW = 0.5  #: A terrain that is recognised less often is named among the limits


class TrainingRecord(BaseModel):
    """What is known of a training beside its model: what MLflow is given, and what the card says.

    Parameters
    ----------
    params : as MLflow holds them
    runs : of the data set
    evaluation, importance : on held-out runs
    chosen : hyper-parameters that inner folds chose
    limits : in sentences, what the model is not for
    versions : of the packages that it was trained with
    latency_ms, onnx_latency_ms : median time of one window, and of its network alone; None where not measured
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    params: dict[str, Any]
    runs: tuple[TrainedRun, ...]
    evaluation: CrossvalResult
    importance: tuple[ChannelImportance, ...]
    chosen: dict[str, Any]
    limits: tuple[str, ...]
    versions: str
    latency_ms: float | None = None
    onnx_latency_ms: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all fields by name."""
        return dict(self)


class ModelResult(Result, ModelInfo, kw_only=True):
    """What a model states of itself."""

    model: str = described("as it was asked for")
    windows: str = described("how they are cut")
    n_training_runs: int = described("runs that it was trained on")
    finds_unknown: bool = described("whether a window may be called unknown")
    counts_support: bool = described("whether it counts training runs near a window's motion")
    names_sets: bool = described("whether it gives sets of terrains that hold the true one in 90 %")
    files: Mapping[str, int] = described("size of each file in bytes")
    training: TrainingRecord | None = described("how it was trained; None of one that was not evaluated")

    def records(self) -> Iterable[Any]:
        """Return a row a terrain."""
        return () if self.training is None else self.training.evaluation.records()


def model_result(folder: Path, name: str) -> ModelResult:
    """Return what the model in a folder states of itself, as it was asked for by name; errors as :func:`read_model`."""
    model = read_model(folder)
    info, record = read_training(folder)
    files = [file for file in (folder / MODEL_FILE, folder / ONNX_FILE) if file.is_file()]
    return ModelResult(
        **vars(info),
        model=name,
        windows=info.cut_words,
        n_training_runs=len(info.run_digests),
        finds_unknown=model.novelty is not None or model.answers is not None,
        counts_support=model.support is not None,
        names_sets=info.conformal is not None,
        files={file.name: file.stat().st_size for file in files},
        training=record,
    )


def read_training(folder: Path) -> tuple[ModelInfo, TrainingRecord | None]:
    """Return what a model is and how it was trained, None of one not evaluated; errors as :func:`read_files`."""
    info, contents = read_files(folder)
    if TRAINING_FILE not in contents:
        return info, None
    try:
        return info, parse_document(contents[TRAINING_FILE], TrainingRecord)
    except ValueError as error:
        text = printable(" ".join(str(error).split()))[:160]
        raise ModelError(f"{folder / TRAINING_FILE}: is no record of a training ({text})") from None


def write_training(folder: Path, name: str, record: TrainingRecord) -> ModelResult:
    """Write how a model was trained, and its card, beside the model; the time of one window is measured here."""
    from pipelines.report.pages import markdown_text
    from terrain.classify.network import time_of_onnx

    model = read_model(folder)
    window = drawn_window(model.info)
    assess(model, window)  # compiles and fills caches
    times_s = repeat(lambda: assess(model, window), number=1, repeat=N_TIMED)
    timed: dict[str, Any] = {"latency_ms": 1e3 * float(np.median(times_s))}
    if (folder / ONNX_FILE).is_file():
        onnx_times_s = time_of_onnx((folder / ONNX_FILE).read_bytes(), window, N_TIMED)
        timed["onnx_latency_ms"] = 1e3 * float(np.median(onnx_times_s))
    record = record.model_copy(update=timed)
    atomic_write(folder / TRAINING_FILE, record.model_dump_json(indent=1) + "\n")
    seal(folder, model.info)
    result = model_result(folder, name)
    atomic_write(folder / CARD_FILE, markdown_text(result.report))
    seal(folder, model.info)
    return result


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
        f"robots other than {', '.join(info.robots)}, and logs without its channels or with lower rates "
        f"({accepted(info.rate_hz, info.least_rate_hz)})",
        f"terrains other than {', '.join(info.classes)}: unless it is refused as unknown, any ground is "
        "taken for one of them",
        "places, weather and sessions that the training runs do not cover: the figures are those of held-out "
        "runs of the same data set",
    ]
    if info.steady is not None:
        limits.append(
            f"standing, and speed changes above {info.steady.max_accel_mps2:g} m/s²: such windows are left out"
        )
    by_run = {} if motion is None else run_speeds(motion.speed_mps[:, None], windows.run_id.astype(str))
    if speeds := [speed for speed in by_run.values() if not math.isnan(speed)]:
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


def report(result: ModelResult) -> Report:
    """Return what a model states of itself: its evaluation first, and what it is not for."""
    answers = {
        "unknown terrain": result.finds_unknown,
        "how far training runs support it": result.counts_support,
        "sets of terrains": result.names_sets,
    }
    also = ", ".join(name for name, there in answers.items() if there)
    uses = Pairs(
        [
            ("terrains", ", ".join(result.classes)),
            ("robots", ", ".join(result.robots) or NOT_KNOWN),
            *((stream, ", ".join(channels)) for stream, channels in result.channels.items()),
            ("estimates of the filter", result.filter or "none"),
            ("code of your own", ", ".join(result.own_code) or "none"),
            ("also answers", also or "nothing beside the terrain"),
        ],
        "What it needs and gives",
    )
    title, next_step = f"Model {result.model}", f"terrain predict --data runs/ --model {result.model}"
    training = result.training
    if training is None:
        lead = f"recipe {result.recipe}, windows of {result.window_s:g} s"
        answer = f"A model for {enumerated(result.classes)} that was not evaluated when it was stored."
        return Report(title, answer, parts=[uses], lead=lead, next_step=next_step)
    evaluated, limits = training.evaluation.report, [Text(text) for text in training.limits]
    chosen = ", ".join(f"{name} {format_value(value)}" for name, value in training.chosen.items())
    worth = Table(
        ("channel", Column("drop", PERCENT), Column("std over folds", PERCENT)),
        training.importance,
        note="By how much balanced accuracy on held-out runs drops when it is shuffled.",
    )
    timed = f"median of {N_TIMED}, on the machine that trained it"
    made = Pairs(
        [
            ("chosen", chosen or NOT_KNOWN),
            ("data", f"{result.dataset} ({result.data_digest[:12]})"),
            ("windows", result.windows),
            (f"time of one window, {timed}", training.latency_ms, ".2f", "ms"),
            ("its network by ONNX", training.onnx_latency_ms, ".2f", "ms"),
            *((f"size of {name}", n_bytes, ",", "bytes") for name, n_bytes in result.files.items()),
            ("code", result.commit),
            ("licence", metadata.metadata("terrain-slip")["License-Expression"]),
            ("versions", training.versions),
            ("scaling, selection and calibration", "fitted inside of each training part of the evaluation"),
        ]
    )
    return replace(
        evaluated,
        title=title,
        parts=[*evaluated.parts[:1], Section("Not for", limits[:3])],
        details=[
            Section("Not for, further", limits[3:]),
            Section("Notes", evaluated.parts[1:]),
            Section("Needs", [uses]),
            Section("Made", [made]),
            Section("Channels", [worth]),
            *evaluated.details,
        ],
        next_step=next_step,
    )
