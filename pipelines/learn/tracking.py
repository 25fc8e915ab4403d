"""MLflow: the one module that imports it.

Without ``MLFLOW_TRACKING_URI`` everything lies under ``./mlruns``: an SQLite database and the artifacts.  Calls
go through a client and never through the library's active run: a server that stops in the middle is then asked
no more, and costs seconds.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import socket
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from pipelines.learn.model_file import FILES, MANIFEST_FILE, ModelInfo, TerrainModel, read_files, read_model
from terrain.errors import ModelError, TerrainError
from terrain.files.atomic import ensure_writable
from terrain.files.lock import file_lock

FOLDER = "mlruns"
EXPERIMENT = "terrain"
CHAMPION = "champion"
SERVER_TIMEOUT_S = 5.0
LOCK_TIMEOUT_S = 300.0
"""Logging a training takes some seconds, the first time ten; several may wait for one another."""

PATIENCE = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
"""How long a server is waited for, where the user's environment does not say it: by default, 12 minutes."""

REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class TrackingError(TerrainError):
    """MLflow's server, database or folder failed."""


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


def code_commit() -> str:
    """Return the commit of the code, with ``+`` when files were changed since.

    An installed package is no checkout, whatever repository it happens to lie in: its version is returned.
    """
    file = Path(__file__).resolve()

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=file.parent, capture_output=True, text=True, check=True, timeout=10
        )
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)
        return git("describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+")
    except (OSError, subprocess.SubprocessError):
        return f"version {version('terrain-slip')}"


def ensure_tracking() -> None:
    """Raise ``TerrainError`` early where the server cannot be reached or the folder cannot be written."""
    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if not uri:
        ensure_writable(FOLDER)
        return
    server = urlsplit(uri)
    if server.scheme in ("http", "https") and server.hostname:
        try:
            port = server.port or (443 if server.scheme == "https" else 80)
            socket.create_connection((server.hostname, port), timeout=SERVER_TIMEOUT_S).close()
        except (OSError, ValueError) as error:
            raise TrackingError(f"MLFLOW_TRACKING_URI={uri}: cannot be reached ({error})") from error


def store_uri() -> str:
    """Return where MLflow keeps what is logged: the server that is named, or the embedded database."""
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path(FOLDER).resolve() / 'mlflow.db'}"


def ui_line() -> str:
    """Return the command line that shows the store, or the address of the server that does."""
    uri = store_uri()
    return uri if uri.startswith("http") else f"mlflow ui --backend-store-uri {uri}"


@contextmanager
def _mlflow(*, create: bool) -> Iterator[Any]:
    """Give MLflow, pointed at its store, with its migrations, hints and warnings off the user's screen.

    Other processes of this package wait meanwhile: of two that make the tables of a database at once one
    fails, and the champion that is judged against is to be the present one.
    """
    for name, value in PATIENCE.items():
        os.environ.setdefault(name, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import mlflow
        from sqlalchemy.exc import SQLAlchemyError

        for name in ("mlflow", "alembic", "urllib3"):
            logging.getLogger(name).setLevel(logging.ERROR)
        named = os.environ.get("MLFLOW_TRACKING_URI")
        uri = store_uri()
        database = Path(uri.removeprefix("sqlite:///")) if uri.startswith("sqlite:///") else None
        if database is not None and not named:
            if create:
                ensure_writable(database.parent)
                database.parent.mkdir(exist_ok=True)
            elif not database.is_file():
                raise ModelError(
                    f"{database} does not exist: train a model here first, or set MLFLOW_TRACKING_URI"
                )
        waiting: Any = nullcontext()
        if database is not None and (
            create or (database.is_file() and os.access(database.parent, os.W_OK))
        ):  # a database that can only be read is opened without
            lock = database.with_name(f"{database.name}.lock")
            waiting = file_lock(lock, LOCK_TIMEOUT_S, "writes to the tracking database")
        failures = (mlflow.exceptions.MlflowException, SQLAlchemyError, OSError, ImportError)
        try:
            with waiting:
                mlflow.set_tracking_uri(uri)
                mlflow.set_registry_uri(uri)
                if not named:
                    os.environ.pop("MLFLOW_TRACKING_URI", None)  # MLflow sets it; only the user may
                yield mlflow
        except TerrainError:
            raise
        except failures as error:
            raise TrackingError(f"MLflow: {' '.join(str(error).split())[:300]}") from error


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
    with _mlflow(create=True) as mlflow:
        client = mlflow.MlflowClient()
        run_id = _log_run(mlflow, client, name, record, tags, info)
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


def log_learning(
    name: str,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    tags: Mapping[str, str],
    texts: Mapping[str, str],
    documents: Mapping[str, Any],
    figures: Mapping[str, Any],
) -> str:
    """Log a run in which something other than a model was learned; return its id.

    Parameters
    ----------
    name : of the run
    params, metrics, tags : as MLflow holds them
    texts, documents : text files and JSON documents by file name
    figures : by name, logged as PNG: figures of matplotlib, or the content of image files

    Raises
    ------
    TrackingError
        if the tracking folder cannot be written or the server cannot be reached.
    """
    pictures = {f"figures/{key}.png": _png(figure) for key, figure in figures.items()}
    record = TrainingRecord(params, metrics, {}, (), {**documents, **texts}, pictures)
    with _mlflow(create=True) as mlflow:
        client = mlflow.MlflowClient()
        run_id = _log_run(mlflow, client, name, record, tags, None)
        client.set_terminated(run_id)
        return run_id


def _png(figure: Any) -> bytes:
    if isinstance(figure, bytes):
        return figure
    from io import BytesIO

    stream = BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _log_run(
    mlflow: Any,
    client: Any,
    name: str,
    record: TrainingRecord,
    tags: Mapping[str, str],
    info: ModelInfo | None,
) -> str:
    """Log what every run has, in few calls, and return the id of the run, which is not ended yet."""
    from mlflow.entities import Metric, Param, RunTag
    from mlflow.utils.time import get_current_time_millis

    found = client.get_experiment_by_name(EXPERIMENT)
    experiment = client.create_experiment(EXPERIMENT) if found is None else found.experiment_id
    run_id = str(client.create_run(experiment, run_name=name).info.run_id)
    now_ms = get_current_time_millis()
    client.log_batch(
        run_id,
        [Metric(_plain(key), float(value), now_ms, 0) for key, value in record.metrics.items()],
        [Param(key, str(value)[:500]) for key, value in record.params.items()],
        [RunTag(key, str(value)) for key, value in tags.items()],
    )
    if record.runs and info is not None:
        import pandas as pd
        from mlflow.entities import DatasetInput, InputTag

        dataset = mlflow.data.from_pandas(
            pd.DataFrame(record.runs), name=info.dataset or "runs", digest=info.data_digest[:36]
        )
        context = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(dataset._to_mlflow_entity(), context)])
    with TemporaryDirectory() as folder:
        for file, document in record.documents.items():
            text = document if isinstance(document, str) else json.dumps(document, indent=2)
            _place(folder, file).write_text(text, encoding="utf-8")
        for file, content in record.pictures.items():
            _place(folder, file).write_bytes(content)
        if any(Path(folder).iterdir()):
            client.log_artifacts(run_id, folder)
    return run_id


def _place(folder: str, file: str) -> Path:
    path = Path(folder) / file
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _plain(name: str) -> str:
    """Return a name of the characters that a metric's may have."""
    return re.sub(r"[^\w\-. /]", "_", name)


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
        with _mlflow(create=False) as mlflow:
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
