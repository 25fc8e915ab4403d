"""MLflow: the one module that imports it.

Without ``MLFLOW_TRACKING_URI`` everything lies under ``./mlruns``: an SQLite database and the artifacts.
"""

from __future__ import annotations

import io
import logging
import os
import socket
import subprocess
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stderr
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from pipelines.learn.recipes import WindowPipeline
from pipelines.models.lean import write_numbers
from pipelines.models.model_files import TRUSTED_TYPES, TerrainModel, read_model, write_info
from pipelines.models.onnx_file import write_onnx
from pipelines.models.results import ModelInfo, Registered
from terrain.errors import ModelError, TerrainError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.files.lock import file_lock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = "mlruns"
EXPERIMENT = "terrain"
CHAMPION = "champion"
SERVER_TIMEOUT_S = 5.0
LOCK_TIMEOUT_S = 300.0
"""Logging a training takes some seconds, the first time ten; several may wait for one another."""
REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class TrainingRecord(NamedTuple):
    """What is logged of a training besides its model.

    Parameters
    ----------
    params, metrics, tags : as MLflow holds them; the tags also of the registered version
    documents : JSON documents by file name
    figures : by name, logged as PNG
    files : that lie beside the model, by name
    """

    params: Mapping[str, Any]
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    documents: Mapping[str, Any]
    figures: Mapping[str, Figure]
    files: Mapping[str, bytes] = MappingProxyType({})


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

CardWriter = Callable[[Path], Mapping[str, str]]
"""Returns texts by file name that lie beside a model, whose files are in the folder that is given."""


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
            raise TerrainError(f"MLFLOW_TRACKING_URI={uri}: cannot be reached ({error})") from error


@contextmanager
def _quiet() -> Iterator[Any]:
    """Import MLflow and keep its migrations, hints and third-party warnings off the user's screen."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import mlflow

        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.ERROR)
        yield mlflow


def _connect(mlflow: Any, *, create: bool) -> None:
    """Point MLflow at the server that is named, or at the embedded database."""
    if uri := os.environ.get("MLFLOW_TRACKING_URI"):
        mlflow.set_tracking_uri(uri)
        mlflow.set_registry_uri(uri)
        return
    folder = Path(FOLDER).resolve()
    if not create and not (folder / "mlflow.db").is_file():
        raise ModelError(
            f"{folder / 'mlflow.db'} does not exist: train a model here first, or set MLFLOW_TRACKING_URI"
        )
    if create:
        ensure_writable(folder)
        folder.mkdir(exist_ok=True)
    uri = f"sqlite:///{folder / 'mlflow.db'}"
    mlflow.set_tracking_uri(uri)
    mlflow.set_registry_uri(uri)
    os.environ.pop("MLFLOW_TRACKING_URI", None)  # MLflow sets it itself; only the user may set it


def _database() -> Path | None:
    """Return the file of the database, None where a server keeps it."""
    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if not uri:
        return Path(FOLDER).resolve() / "mlflow.db"
    _, scheme, file = uri.partition("sqlite:///")
    return Path(file) if scheme else None


@contextmanager
def _alone(*, create: bool) -> Iterator[None]:
    """Keep other processes of this package away from the database.

    MLflow makes its tables when it first opens a database; of two processes that do so at once one fails.
    A database that can only be read is opened without.
    """
    database = _database()
    if database is None or (not create and not (database.is_file() and os.access(database.parent, os.W_OK))):
        waiting: Any = nullcontext()
    else:
        lock = database.with_name(f"{database.name}.lock")
        waiting = file_lock(lock, LOCK_TIMEOUT_S, "writes to the tracking database")
    with waiting:
        yield


def _open_store(mlflow: Any) -> None:
    """Have MLflow open the database, which makes or checks its tables."""
    mlflow.search_experiments(max_results=1)
    mlflow.MlflowClient().search_registered_models(max_results=1)


def _failures(mlflow: Any) -> tuple[type[Exception], ...]:
    """Return what MLflow raises when a server, a database or a folder fails."""
    from sqlalchemy.exc import SQLAlchemyError

    return (mlflow.exceptions.MlflowException, SQLAlchemyError, OSError)


def log_training(
    name: str,
    recipe: WindowPipeline,
    info: ModelInfo,
    record: TrainingRecord,
    judge: Judge,
    card: CardWriter | None = None,
) -> Registered:
    """Log one training run with its model, register the model, and have the champion decided on.

    Other processes wait meanwhile, so that the champion that is judged against is the present one.

    Parameters
    ----------
    name : name of the registered model
    recipe : fitted recipe
    info : content of ``terrain_model.json``
    record : what else is logged
    judge : decides whether the alias moves
    card : texts that lie beside the model

    Raises
    ------
    TerrainError
        if the tracking folder cannot be written, the server cannot be reached, or another process holds the
        database for too long.
    """
    with _quiet() as mlflow, _alone(create=True):
        _connect(mlflow, create=True)
        try:
            mlflow.set_experiment(EXPERIMENT)
            with mlflow.start_run(run_name=name) as run:
                tags = {key: getattr(info, key) for key in ("data_digest", "commit", "seed")}
                _log(mlflow, record.params, record.metrics, tags, record.documents, record.figures)
                logged = _log_model(mlflow, name, recipe, info, card, record.files)
            return _promote(
                mlflow, name, str(logged.registered_model_version), run.info.run_id, record.tags, judge
            )
        except _failures(mlflow) as error:
            raise TerrainError(f"MLflow: {' '.join(str(error).split())[:300]}") from error


def log_learning(
    name: str,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    tags: Mapping[str, str],
    texts: Mapping[str, str],
    documents: Mapping[str, Any],
    figures: Mapping[str, Figure],
) -> str:
    """Log a run in which something other than a model was learned; return its id.

    Parameters
    ----------
    name : of the run
    params, metrics, tags : as MLflow holds them
    texts, documents : text files and JSON documents by file name
    figures : figures by name, logged as PNG

    Raises
    ------
    TerrainError
        if the tracking folder cannot be written or the server cannot be reached.
    """
    with _quiet() as mlflow, _alone(create=True):
        _connect(mlflow, create=True)
        try:
            mlflow.set_experiment(EXPERIMENT)
            with mlflow.start_run(run_name=name) as run:
                _log(mlflow, params, metrics, tags, documents, figures)
                for file, text in texts.items():
                    mlflow.log_text(text, file)
            return str(run.info.run_id)
        except _failures(mlflow) as error:
            raise TerrainError(f"MLflow: {' '.join(str(error).split())[:300]}") from error


def _log(
    mlflow: Any,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    tags: Mapping[str, Any],
    documents: Mapping[str, Any],
    figures: Mapping[str, Figure],
) -> None:
    """Log what every run has into the one that is open."""
    mlflow.log_params(dict(params))
    mlflow.log_metrics(dict(metrics))
    mlflow.set_tags(dict(tags))
    for file, document in documents.items():
        mlflow.log_dict(document, file)
    for name, figure in figures.items():
        mlflow.log_figure(figure, f"figures/{name}.png")


def _log_model(
    mlflow: Any,
    name: str,
    recipe: WindowPipeline,
    info: ModelInfo,
    card: CardWriter | None,
    files: Mapping[str, bytes],
) -> Any:
    from mlflow.models import Model

    def save_model(path: str, mlflow_model: Any, **options: Any) -> None:
        mlflow.sklearn.save_model(recipe, path, mlflow_model=mlflow_model, **options)
        if hasattr(recipe[-1], "numbers"):
            write_numbers(Path(path), recipe)
            write_onnx(Path(path), recipe)
        for file, content in files.items():
            (Path(path) / file).write_bytes(content)
        write_info(Path(path), info)
        if card is not None:
            for file, text in card(Path(path)).items():
                atomic_write(Path(path) / file, text)
                mlflow.log_text(text, file)
            write_info(Path(path), info)

    flavor = SimpleNamespace(save_model=save_model, __name__="mlflow.sklearn")
    with redirect_stderr(io.StringIO()):  # the caller reports what it prints
        return Model.log(
            artifact_path=None,
            name="model",
            flavor=flavor,
            registered_model_name=name,
            signature=_signature(recipe),
            serialization_format="skops",
            skops_trusted_types=list(TRUSTED_TYPES),
            pip_requirements=[f"{package}=={version(package)}" for package in REQUIREMENTS],
        )


def _signature(recipe: WindowPipeline) -> Any:
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    inputs = [
        TensorSpec(np.dtype("float64"), (-1, len(names), recipe.matrix.n_samples[stream]), stream)
        for stream, names in recipe.matrix.layout.channels.items()
    ]
    return ModelSignature(Schema(inputs), Schema([TensorSpec(np.dtype("str"), (-1,))]))


def _promote(
    mlflow: Any, name: str, number: str, run_id: str, tags: Mapping[str, str], judge: Judge
) -> Registered:
    client = mlflow.MlflowClient()
    for key, text in tags.items():
        client.set_model_version_tag(name, number, key, text)
    champion = None
    if (current := client.get_registered_model(name).aliases.get(CHAMPION)) is not None:
        found = client.get_model_version(name, current)
        champion = Champion(str(current), found.tags, _model_or_none(mlflow, f"models:/{name}/{current}"))
    moved, reason = judge(champion, number)
    if moved:
        client.set_registered_model_alias(name, CHAMPION, number)
    return Registered(f"models:/{name}/{number}", number, run_id, moved, reason)


def _model_or_none(mlflow: Any, uri: str) -> TerrainModel | None:
    failures: tuple[type[Exception], ...] = (*_failures(mlflow), ImportError, ModelError)
    try:
        return read_model(Path(mlflow.artifacts.download_artifacts(uri)))
    except failures:
        return None


def load_model(uri: str) -> TerrainModel:
    """Load a model by its URI (``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/...``) or folder.

    Raises
    ------
    ModelError
        if there is no such model, or it is damaged or foreign.
    """
    return read_model(Path(uri) if Path(uri).exists() else fetch_model(uri))


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
    if not uri.startswith(("models:/", "runs:/")):
        raise ModelError(f"{uri}: is neither a folder nor a model URI such as models:/NAME@champion")
    if os.environ.get("MLFLOW_TRACKING_URI"):
        ensure_tracking()
    with _quiet() as mlflow:
        _connect(mlflow, create=False)
        # some storages need a package of their own
        failures: tuple[type[Exception], ...] = (*_failures(mlflow), ImportError)
        try:
            with _alone(create=False):
                _open_store(mlflow)
            return Path(mlflow.artifacts.download_artifacts(uri, dst_path=into))
        except failures as error:
            raise ModelError(f"{uri}: cannot be loaded ({' '.join(str(error).split())[:200]})") from error
