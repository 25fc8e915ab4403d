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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from pipelines.models.lean import write_numbers
from pipelines.models.model_files import TRUSTED_TYPES, TerrainModel, read_model, write_info
from pipelines.models.recipes import WindowPipeline
from pipelines.models.results import ModelInfo, Registered
from terrain.errors import ModelError, TerrainError
from terrain.files.atomic import ensure_writable
from terrain.records import Windows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = "mlruns"
EXPERIMENT = "terrain"
CHAMPION = "champion"
SERVER_TIMEOUT_S = 5.0
REQUIREMENTS = ("terrain-slip", "scikit-learn", "numpy", "scipy", "numba", "skops")


class Standing(NamedTuple):
    """What the choice of the champion depends on."""

    version: str
    data_digest: str
    macro_f1: float


def champion_decision(champion: Standing | None, candidate: Standing) -> tuple[bool, str]:
    """Return whether a candidate becomes champion, and why.

    Examples
    --------
    >>> champion_decision(None, Standing("1", "aa", 0.9))
    (True, 'first version')
    >>> champion_decision(Standing("1", "aa", 0.9), Standing("2", "aa", 0.8))
    (False, 'macro F1 0.8000 is not better than 0.9000 of version 1 on the same data')
    >>> champion_decision(Standing("1", "aa", 0.9), Standing("2", "bb", 0.8))
    (True, 'new data: the digest differs from that of version 1')
    """
    if champion is None:
        return True, "first version"
    if champion.data_digest != candidate.data_digest:
        return True, f"new data: the digest differs from that of version {champion.version}"
    comparison = f"{champion.macro_f1:.4f} of version {champion.version} on the same data"
    if candidate.macro_f1 > champion.macro_f1:
        return True, f"macro F1 {candidate.macro_f1:.4f} is better than {comparison}"
    return False, f"macro F1 {candidate.macro_f1:.4f} is not better than {comparison}"


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


def _failures(mlflow: Any) -> tuple[type[Exception], ...]:
    """Return what MLflow raises when a server, a database or a folder fails."""
    from sqlalchemy.exc import SQLAlchemyError

    return (mlflow.exceptions.MlflowException, SQLAlchemyError, OSError)


def log_training(
    name: str,
    recipe: WindowPipeline,
    windows: Windows,
    info: ModelInfo,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    documents: Mapping[str, Any],
    figures: Mapping[str, Figure],
) -> Registered:
    """Log one training run with its model, register the model, and decide on the champion.

    Parameters
    ----------
    name : name of the registered model
    recipe : fitted recipe
    windows : the windows it was fitted on, for the signature
    info : content of ``terrain_model.json``; ``data_digest`` is compared with the champion's
    params, metrics : as MLflow holds them; ``macro_f1`` must be among the metrics
    documents : JSON documents by file name
    figures : figures by name, logged as PNG

    Raises
    ------
    TerrainError
        if the tracking folder cannot be written or the server cannot be reached.
    """
    with _quiet() as mlflow:
        _connect(mlflow, create=True)
        try:
            mlflow.set_experiment(EXPERIMENT)
            with mlflow.start_run(run_name=name) as run:
                tags = {key: getattr(info, key) for key in ("data_digest", "commit", "seed")}
                _log(mlflow, params, metrics, tags, documents, figures)
                logged = _log_model(mlflow, name, recipe, windows, info)
            return _promote(
                mlflow, name, str(logged.registered_model_version), run.info.run_id, info, metrics
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
    with _quiet() as mlflow:
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


def _log_model(mlflow: Any, name: str, recipe: WindowPipeline, windows: Windows, info: ModelInfo) -> Any:
    from mlflow.models import Model

    def save_model(path: str, mlflow_model: Any, **options: Any) -> None:
        mlflow.sklearn.save_model(recipe, path, mlflow_model=mlflow_model, **options)
        write_numbers(Path(path), recipe)
        write_info(Path(path), info)

    flavor = SimpleNamespace(save_model=save_model, __name__="mlflow.sklearn")
    with redirect_stderr(io.StringIO()):  # the caller reports what it prints
        return Model.log(
            artifact_path=None,
            name="model",
            flavor=flavor,
            registered_model_name=name,
            signature=_signature(recipe, windows),
            serialization_format="skops",
            skops_trusted_types=list(TRUSTED_TYPES),
            pip_requirements=[f"{package}=={version(package)}" for package in REQUIREMENTS],
        )


def _signature(recipe: WindowPipeline, windows: Windows) -> Any:
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    channels = recipe[0].layout_.channels
    inputs = [
        TensorSpec(np.dtype("float64"), (-1, len(names), windows.values[stream].shape[2]), stream)
        for stream, names in channels.items()
    ]
    return ModelSignature(Schema(inputs), Schema([TensorSpec(np.dtype("str"), (-1,))]))


def _promote(
    mlflow: Any, name: str, number: str, run_id: str, info: ModelInfo, metrics: Mapping[str, float]
) -> Registered:
    client = mlflow.MlflowClient()
    candidate = Standing(number, info.data_digest, float(metrics["macro_f1"]))
    client.set_model_version_tag(name, number, "data_digest", candidate.data_digest)
    client.set_model_version_tag(name, number, "macro_f1", repr(candidate.macro_f1))
    champion = None
    if (current := client.get_registered_model(name).aliases.get(CHAMPION)) is not None:
        tags = client.get_model_version(name, current).tags
        champion = Standing(str(current), tags.get("data_digest", ""), float(tags.get("macro_f1", "-inf")))
    moved, reason = champion_decision(champion, candidate)
    if moved:
        client.set_registered_model_alias(name, CHAMPION, number)
    return Registered(f"models:/{name}/{number}", number, run_id, moved, reason)


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
            return Path(mlflow.artifacts.download_artifacts(uri, dst_path=into))
        except failures as error:
            raise ModelError(f"{uri}: cannot be loaded ({' '.join(str(error).split())[:200]})") from error
