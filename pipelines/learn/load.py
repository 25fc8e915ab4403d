"""Where a model lies: a folder, or a registered one that is copied."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.learn.model_file import TerrainModel, read_model
from terrain.errors import ModelError

FETCH_TIMEOUT_S = 120.0


def load_model(uri: str) -> TerrainModel:
    """Return a model by its URI (``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/...``) or folder.

    Raises
    ------
    ModelError
        if there is no such model, or it is damaged or foreign.
    """
    with model_folder(uri) as folder:
        return read_model(folder)


@contextmanager
def model_folder(uri: str) -> Iterator[Path]:
    """Give the folder of a model; a copy, while the block lasts, of one that is registered.

    The tracking library takes longer to import than all of a live service, and a hundred megabytes: unless it
    is there already, the copy is made by a process of its own.
    """
    try:
        there = Path(uri).exists()
    except OSError as error:
        raise ModelError(f"{uri[:100]}: cannot be opened ({error.strerror})") from None
    if there:
        yield Path(uri)
        return
    if not uri.startswith(("models:/", "runs:/")):
        raise ModelError(f"{uri}: is neither a folder nor a model URI such as models:/NAME@champion")
    with TemporaryDirectory() as folder:
        if "mlflow" in sys.modules:
            from pipelines.learn.tracking import fetch_model

            yield fetch_model(uri, folder)
            return
        command = [sys.executable, "-m", "pipelines.learn.tracking", uri, folder]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=FETCH_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise ModelError(f"{uri}: was not loaded within {FETCH_TIMEOUT_S:g} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise ModelError(lines[-1] if lines else f"{uri}: cannot be loaded")
        yield Path(done.stdout.strip().splitlines()[-1])
