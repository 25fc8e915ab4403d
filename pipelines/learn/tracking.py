"""Trained models in MLflow: logged with their data, registered, and which of them is champion."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import redirect_stderr
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pipelines.data.tracking import log_run, mlflow_store
from pipelines.report.results import Result, as_json, described
from pipelines.report.tree import Report
from terrain.errors import ModelError

if TYPE_CHECKING:
    from pipelines.learn.training_data import TrainingData
    from pipelines.live.model import ModelInfo

CHAMPION = "champion"
METRICS = ("accuracy", "balanced_accuracy", "macro_f1", "vote_accuracy", "ece")
REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class Registered(Result):
    """A registered version of a model, and whether the alias ``champion`` moved to it.

    Of a model that was kept in a folder when the tracking server had stopped: it becomes champion where there is
    none, or where it is better on the same data; on other data the two cannot be compared any more.
    """

    model_uri: str = described("of the registered version")
    version: str = described("its number")
    run_id: str = described("of the run in MLflow")
    alias_moved: bool = described("whether it is the champion now")
    alias_reason: str = described("why, or why not")
    folder: Path | None = described("that it lay in, where it is registered without training", optional=True)

    @property
    def verdict(self) -> str:
        """Where the model is, and whether it is champion."""
        verdict = "champion" if self.alias_moved else "not champion"
        return f"{self.model_uri} is registered, {verdict}: {self.alias_reason}"


def report(result: Registered) -> Report:
    """Return where the model is, and whether it is champion."""
    next_step = f"terrain inspect {result.model_uri}"
    return Report(f"Model of {result.folder}", f"{result.verdict}.", next_step=next_step)


def log_training(
    name: str, folder: Path, data: TrainingData | None = None, pictures: Mapping[str, bytes] | None = None
) -> Registered:
    """Log one training run with its model, register the model, and decide on the champion.

    Parameters
    ----------
    name : name of the registered model
    folder : of the model, with the record of its training
    data : that it was trained on, and the champion is judged on; None where they are not at hand any more
    pictures : content of image files by name

    Raises
    ------
    ModelError
        if there is no model, or it was not trained by ``train``.
    TrackingError
        if the tracking folder cannot be written, the server cannot be reached or stops in the middle, or
        another process holds the database for too long.
    """
    import pandas as pd

    from pipelines.learn.card import read_training
    from pipelines.learn.champion import Champion, judge, tags_of
    from pipelines.learn.model_file import read_model

    info, record = read_training(folder)
    if record is None:
        raise ModelError(
            f"{folder}: holds a model that was not evaluated, which only terrain train registers"
        )
    evaluation = record.evaluation
    metrics = {figure: getattr(evaluation, figure) for figure in METRICS} | {
        f"{figure}/{terrain}": getattr(row, figure)
        for terrain, row in evaluation.per_class.items()
        for figure in ("precision", "recall", "f1")
    }
    files = {
        "crossval.json": as_json(evaluation),
        "importance.json": {"channels": as_json(record.importance)},
        **(pictures or {}),
    }
    params = record.params | {f"chosen_{key}": value for key, value in record.chosen.items()}
    tags = {key: str(getattr(info, key)) for key in ("data_digest", "commit", "seed")}
    with mlflow_store(create=True) as mlflow:
        from mlflow.entities import DatasetInput, InputTag

        client = mlflow.MlflowClient()
        run_id = log_run(mlflow, name, params, metrics, tags, files)
        rows, digest = pd.DataFrame(record.runs), info.data_digest[:36]
        dataset = mlflow.data.from_pandas(rows, name=info.dataset or "runs", digest=digest)
        context = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(dataset._to_mlflow_entity(), context)])
        number = str(_log_model(mlflow, name, folder, info, run_id).registered_model_version)
        for key, text in tags_of(info, evaluation).items():
            client.set_model_version_tag(name, number, key, text)
        champion = None
        if (current := client.get_registered_model(name).aliases.get(CHAMPION)) is not None:
            try:
                model = read_model(mlflow.artifacts.download_artifacts(f"models:/{name}/{current}"))
            except (mlflow.exceptions.MlflowException, OSError, ImportError, ModelError):
                model = None
            champion = Champion(str(current), client.get_model_version(name, current).tags, model)
        moved, reason = judge(champion, info, evaluation, data)
        if moved:
            client.set_registered_model_alias(name, CHAMPION, number)
        client.set_terminated(run_id)
        kept = folder if data is None else None
        return Registered(f"models:/{name}/{number}", number, run_id, moved, reason, kept)


def _log_model(mlflow: Any, name: str, folder: Path, info: ModelInfo, run_id: str) -> Any:
    """Log a model folder with its signature: the samples of each channel by name in, probabilities out."""
    from mlflow.models import Model, ModelSignature
    from mlflow.types import ColSpec, DataType, Schema
    from mlflow.types.schema import Array

    from pipelines.learn.model_file import FILES, MANIFEST_FILE

    def save_model(path: str, mlflow_model: Any, **options: Any) -> None:
        mlflow.pyfunc.save_model(
            path, loader_module="pipelines.learn.model_file", mlflow_model=mlflow_model, **options
        )
        for file in (*FILES, MANIFEST_FILE):
            if (folder / file).is_file():
                shutil.copyfile(folder / file, Path(path) / file)

    samples = [
        ColSpec(Array(DataType.double), f"{stream}.{channel}")
        for stream, channels in info.channels.items()
        for channel in channels
    ]
    probabilities = [ColSpec(DataType.double, terrain) for terrain in info.classes]
    with redirect_stderr(StringIO()):  # the caller reports what it prints
        return Model.log(
            artifact_path=None,
            name="model",
            flavor=SimpleNamespace(save_model=save_model, __name__="mlflow.pyfunc"),
            run_id=run_id,
            registered_model_name=name,
            signature=ModelSignature(Schema(samples), Schema(probabilities)),
            pip_requirements=[f"{package}=={version(package)}" for package in REQUIREMENTS],
        )
