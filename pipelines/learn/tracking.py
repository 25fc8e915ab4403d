"""Trained models in MLflow: logged with their data, registered, fetched, and which of them is champion."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from pipelines.data.tracking import TrackingError, ensure_tracking, log_run, mlflow_store
from pipelines.learn.model_file import FILES, MANIFEST_FILE, ModelInfo, TerrainModel, read_model
from terrain.errors import ModelError, TerrainError

if TYPE_CHECKING:
    from pipelines.learn.card import TrainingRecord
    from pipelines.learn.champion import Bench

CHAMPION = "champion"
REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class Registered(NamedTuple):
    """A registered version of a model, and whether the alias ``champion`` moved to it."""

    model_uri: str
    version: str
    run_id: str
    alias_moved: bool
    alias_reason: str


def log_training(
    name: str, folder: Path, bench: Bench | None = None, pictures: Mapping[str, bytes] | None = None
) -> Registered:
    """Log one training run with its model, register the model, and decide on the champion.

    Parameters
    ----------
    name : name of the registered model
    folder : of the model, with the record of its training
    bench : what the champion and the new version are judged on; None where that is not at hand any more
    pictures : content of image files by name

    Raises
    ------
    ModelError
        if there is no model, or it was not trained by ``train``.
    TrackingError
        if the tracking folder cannot be written, the server cannot be reached or stops in the middle, or
        another process holds the database for too long.
    """
    from pipelines.learn.card import read_training
    from pipelines.learn.champion import Champion, judge, tags_of

    info, record = read_training(folder)
    if record is None:
        raise ModelError(
            f"{folder}: holds a model that was not evaluated, which only terrain train registers"
        )
    evaluated = record.evaluated
    metrics = dict(info.evaluation) | {
        f"{figure}/{terrain}": getattr(row, figure)
        for terrain, row in evaluated.per_class.items()
        for figure in ("precision", "recall", "f1")
    }
    documents = {"crossval.json": record.evaluation, "importance.json": {"channels": record.importance}}
    chosen = {f"chosen_{key}": value for key, value in record.chosen.items()}
    tags = {key: str(getattr(info, key)) for key in ("data_digest", "commit", "seed")}
    with mlflow_store(create=True) as mlflow:
        client = mlflow.MlflowClient()
        run_id = log_run(mlflow, name, {**record.params, **chosen}, metrics, tags, documents, pictures or {})
        _log_data(mlflow, run_id, record, info)
        number = str(_log_model(mlflow, name, folder, info, run_id).registered_model_version)
        for key, text in tags_of(info, evaluated).items():
            client.set_model_version_tag(name, number, key, text)
        champion = None
        if (current := client.get_registered_model(name).aliases.get(CHAMPION)) is not None:
            found = client.get_model_version(name, current)
            champion = Champion(str(current), found.tags, _model_or_none(mlflow, f"models:/{name}/{current}"))
        moved, reason = judge(champion, info, evaluated, bench)
        if moved:
            client.set_registered_model_alias(name, CHAMPION, number)
        client.set_terminated(run_id)
        return Registered(f"models:/{name}/{number}", number, run_id, moved, reason)


def _log_data(mlflow: Any, run_id: str, record: TrainingRecord, info: ModelInfo) -> None:
    """Log the data set of a training as the input of its run: a row a run."""
    import pandas as pd
    from mlflow.entities import DatasetInput, InputTag

    digest = info.data_digest[:36]
    dataset = mlflow.data.from_pandas(pd.DataFrame(record.runs), name=info.dataset or "runs", digest=digest)
    context = [InputTag("mlflow.data.context", "training")]
    mlflow.MlflowClient().log_inputs(run_id, [DatasetInput(dataset._to_mlflow_entity(), context)])


def _log_model(mlflow: Any, name: str, folder: Path, info: ModelInfo, run_id: str) -> Any:
    from mlflow.models import Model

    def save_model(path: str, mlflow_model: Any, **options: Any) -> None:
        mlflow.pyfunc.save_model(
            path, loader_module="pipelines.learn.model_file", mlflow_model=mlflow_model, **options
        )
        for file in (*FILES, MANIFEST_FILE):
            if (folder / file).is_file():
                shutil.copyfile(folder / file, Path(path) / file)

    flavor = SimpleNamespace(save_model=save_model, __name__="mlflow.pyfunc")
    with redirect_stderr(StringIO()):  # the caller reports what it prints
        return Model.log(
            artifact_path=None,
            name="model",
            flavor=flavor,
            run_id=run_id,
            registered_model_name=name,
            signature=_signature(info),
            pip_requirements=[f"{package}=={version(package)}" for package in REQUIREMENTS],
        )


def _signature(info: ModelInfo) -> Any:
    """Return the signature: the samples of each channel by its name, and the probability of each terrain."""
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, DataType, Schema
    from mlflow.types.schema import Array

    inputs = [
        ColSpec(Array(DataType.double), f"{stream}.{channel}")
        for stream, channels in info.channels.items()
        for channel in channels
    ]
    return ModelSignature(Schema(inputs), Schema([ColSpec(DataType.double, name) for name in info.classes]))


def _model_or_none(mlflow: Any, uri: str) -> TerrainModel | None:
    try:
        return read_model(Path(mlflow.artifacts.download_artifacts(uri)))
    except (mlflow.exceptions.MlflowException, OSError, ImportError, ModelError):
        return None


def fetch_model(uri: str, into: str | None = None) -> Path:
    """Return the folder of a registered model, copied to where a store is not of this machine.

    Parameters
    ----------
    uri : ``models:/...`` or ``runs:/...``
    into : folder of the copy; one of the tracking library by default

    Raises
    ------
    ModelError
        if there is no such model.
    """
    if os.environ.get("MLFLOW_TRACKING_URI"):
        ensure_tracking()
    try:
        with mlflow_store(create=False) as mlflow:
            return Path(mlflow.artifacts.download_artifacts(uri, dst_path=into))
    except TrackingError as error:
        reason = str(error).removeprefix("MLflow: ")[:200]
        raise ModelError(f"{uri}: cannot be loaded ({reason})") from error


def main(uri: str, folder: str) -> int:
    """Copy a model and print its folder; a failure is one sentence on stderr and exit code 2."""
    try:
        print(fetch_model(uri, folder))
    except TerrainError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:3]))
