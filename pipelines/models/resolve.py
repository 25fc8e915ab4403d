"""Find a model's folder by its URI, without the tracking library in the process that serves.

The library takes longer to import than all of the service, and a hundred megabytes.  It runs in a process of
its own, which ends once the model is copied.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.models.model_files import TerrainModel, read_lean_model
from terrain.errors import ModelError

TIMEOUT_S = 120.0


def load_model(uri: str) -> TerrainModel:
    """Return a model by its URI or folder.

    Raises
    ------
    ModelError
        if there is no such model, or it is damaged or foreign.
    """
    if not uri.startswith(("models:/", "runs:/")) or Path(uri).exists():
        return _read(Path(uri), uri)
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pipelines.models.fetch", uri, folder]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired:
            raise ModelError(f"{uri}: was not loaded within {TIMEOUT_S:g} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise ModelError(lines[-1] if lines else f"{uri}: cannot be loaded")
        return read_lean_model(Path(done.stdout.strip().splitlines()[-1]))


def _read(folder: Path, uri: str) -> TerrainModel:
    try:
        there = folder.exists()
    except OSError as error:
        raise ModelError(f"{uri[:100]}: cannot be opened ({error.strerror})") from None
    if not there:
        raise ModelError(f"{uri}: is neither a folder nor a model URI such as models:/NAME@champion")
    return read_lean_model(folder)
