"""MLflow's store, of runs in which something was learned: a server, or a database under ``./mlruns``.

Without ``MLFLOW_TRACKING_URI`` everything lies under ``./mlruns``: an SQLite database and the artifacts.  Calls
go through a client and never through the library's active run: a server that stops in the middle is then asked
no more, and costs seconds.
"""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from terrain.errors import ModelError, TerrainError
from terrain.files.atomic import ensure_writable, file_lock

FOLDER = "mlruns"
EXPERIMENT = "terrain"
SERVER_TIMEOUT_S = 5.0
LOCK_TIMEOUT_S = 300.0
"""Logging a training takes some seconds, the first time ten; several may wait for one another."""

PATIENCE = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
"""How long a server is waited for, where the user's environment does not say it: by default, 12 minutes."""


class TrackingError(TerrainError):
    """MLflow's server, database or folder failed."""


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
def mlflow_store(*, create: bool) -> Iterator[Any]:
    """Give MLflow, pointed at its store, with its migrations, hints and warnings off the user's screen.

    Other processes of this package wait meanwhile: of two that make the tables of a database at once one
    fails, and the champion that is judged against is to be the present one.
    """
    for name, value in (*PATIENCE.items(), ("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")):
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


def fetch_model(uri: str, into: str) -> Path:
    """Return the folder of a registered model, copied to where a store is not of this machine.

    Parameters
    ----------
    uri : ``models:/...`` or ``runs:/...``
    into : folder of the copy

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


def log_run(
    mlflow: Any,
    name: str,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    tags: Mapping[str, str],
    files: Mapping[str, Any],
) -> str:
    """Log what every run has, in few calls, and return the id of the run, which is not ended yet.

    Parameters
    ----------
    mlflow : as :func:`mlflow_store` gives it
    name : of the run
    params, metrics, tags : as MLflow holds them
    files : bytes, texts and JSON documents by file name
    """
    from mlflow.entities import Metric, Param, RunTag
    from mlflow.utils.time import get_current_time_millis

    client = mlflow.MlflowClient()
    experiment = mlflow.set_experiment(EXPERIMENT).experiment_id
    run_id = str(client.create_run(experiment, run_name=name).info.run_id)
    now_ms = get_current_time_millis()
    client.log_batch(
        run_id,
        [  # of the characters that a name may have there
            Metric(re.sub(r"[^\w\-. /]", "_", key), float(value), now_ms, 0) for key, value in metrics.items()
        ],
        [Param(key, str(value)[:500]) for key, value in params.items()],
        [RunTag(key, str(value)) for key, value in tags.items()],
    )
    with TemporaryDirectory() as folder:
        for file, content in files.items():
            path = Path(folder) / file
            path.parent.mkdir(parents=True, exist_ok=True)
            if not isinstance(content, bytes):
                content = (content if isinstance(content, str) else json.dumps(content, indent=2)).encode()
            path.write_bytes(content)
        if files:
            client.log_artifacts(run_id, folder)
    return run_id


if __name__ == "__main__":
    try:
        print(fetch_model(*sys.argv[1:3]))
    except TerrainError as error:
        sys.exit(str(error))
