"""Trained models in MLflow: logged with their data, registered, fetched, and which of them is champion."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

from pipelines.data.tracking import TrackingError, ensure_tracking, log_run, mlflow_store
from pipelines.learn.model_file import FILES, MANIFEST_FILE, ModelInfo, TerrainModel, read_files, read_model
from pipelines.report.json_file import as_json
from terrain.errors import LogError, ModelError, TerrainError
from terrain.files.documents import parse_json
from terrain.files.names import printable

CHAMPION = "champion"
REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class Registered(NamedTuple):
    """A registered version of a model, and whether the alias ``champion`` moved to it."""

    model_uri: str
    version: str
    run_id: str
    alias_moved: bool
    alias_reason: str


class RunRow(NamedTuple):
    """A run of a data set, as the tracking library lists it."""

    run_id: str
    robot: str
    terrain: str
    n_windows: int
    digest: str


class TrainingRecord(NamedTuple):
    """What is logged of a training besides its model.

    Parameters
    ----------
    params, metrics, tags : as MLflow holds them; the tags also of the registered version
    runs : of the data set
    documents : JSON documents by file name
    pictures : content of image files by file name
    """

    params: Mapping[str, Any]
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    runs: Sequence[RunRow] = ()
    documents: Mapping[str, Any] = {}
    pictures: Mapping[str, bytes] = {}

    def as_text(self) -> str:
        """Return the record as JSON, without its pictures: it lies beside the model."""
        kept = {name: getattr(self, name) for name in ("params", "metrics", "tags", "runs", "documents")}
        return json.dumps(as_json(kept), indent=1) + "\n"

    @classmethod
    def of_text(cls, content: bytes, place: Path) -> Self:
        """Return the record that a file holds; ``ModelError`` where it is none."""
        try:
            found = parse_json(content)
            rows = tuple(RunRow(**row) for row in found.pop("runs"))
            record = cls(**{**found, "runs": rows})
            return record._replace(metrics={key: float(value) for key, value in record.metrics.items()})
        except (LogError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ModelError(f"{place}: is no record of a training ({printable(str(error))[:160]})") from None


class Champion(NamedTuple):
    """The present champion; ``model`` is None where it cannot be loaded."""

    version: str
    tags: Mapping[str, str]
    model: TerrainModel | None


class Verdict(NamedTuple):
    """Whether a new version becomes champion, and why."""

    moved: bool
    reason: str


Judge = Callable[[Champion | None, str], Verdict]
"""Judges a new version, whose number is given, against the present champion."""


def log_training(name: str, folder: Path, record: TrainingRecord, judge: Judge) -> Registered:
    """Log one training run with its model, register the model, and have the champion decided on.

    Parameters
    ----------
    name : name of the registered model
    folder : of the model, as :func:`pipelines.learn.model_file.write_model` writes it
    record : what else is logged
    judge : decides whether the alias moves

    Raises
    ------
    TrackingError
        if the tracking folder cannot be written, the server cannot be reached or stops in the middle, or
        another process holds the database for too long.
    """
    info, _ = read_files(folder)
    tags = {key: str(getattr(info, key)) for key in ("data_digest", "commit", "seed")}
    with mlflow_store(create=True) as mlflow:
        client = mlflow.MlflowClient()
        run_id = log_run(mlflow, name, record.params, record.metrics, tags, record.documents, record.pictures)
        _log_data(mlflow, run_id, record, info)
        logged = _log_model(mlflow, name, folder, info, run_id)
        number = str(logged.registered_model_version)
        for key, text in record.tags.items():
            client.set_model_version_tag(name, number, key, text)
        champion = None
        if (current := client.get_registered_model(name).aliases.get(CHAMPION)) is not None:
            found = client.get_model_version(name, current)
            model = _model_or_none(mlflow, f"models:/{name}/{current}")
            champion = Champion(str(current), found.tags, model)
        moved, reason = judge(champion, number)
        if moved:
            client.set_registered_model_alias(name, CHAMPION, number)
        client.set_terminated(run_id)
        return Registered(f"models:/{name}/{number}", number, run_id, moved, reason)


def _log_data(mlflow: Any, run_id: str, record: TrainingRecord, info: ModelInfo) -> None:
    """Log the data set of a training as the input of its run: a row a run."""
    import pandas as pd
    from mlflow.entities import DatasetInput, InputTag

    if not record.runs:
        return
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
