"""The file of a run: a row a window: start, terrain, motion, and its features as a list of equal length."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from features.motion import Motion
from pipelines.feature_store.manifest import WINDOWS_FOLDER, StoredRun
from terrain.errors import LogError
from terrain.files.atomic import atomic_file
from terrain.logs.write import run_folder
from terrain.records import Array

KEY = b"terrain"


class RunWindows(NamedTuple):
    """The rows of a run.

    Parameters
    ----------
    start_s, terrain : (n,) start and label of each window, the label empty without one
    features : (n, f)
    motion : how the robot moved in each window; NaN where that is not known
    """

    start_s: Array
    terrain: Array
    features: Array
    motion: Motion


def file_of(store: Path, run_id: str) -> Path:
    """Return the file of a run; ``LogError`` where its id cannot name one."""
    return run_folder(run_id, store / WINDOWS_FOLDER).with_name(f"{run_id}.parquet")


def write_run_windows(store: Path, entry: StoredRun, identity: str, rows: RunWindows) -> None:
    """Write the file of a run, whole or not at all; the same rows give the same bytes.

    Parameters
    ----------
    store : folder
    entry : what is known of the run; it is kept in the file
    identity : of the manifest
    rows : what is written, in 64 bits
    """
    import pyarrow
    from pyarrow import parquet

    width = rows.features.shape[1]
    flat = pyarrow.array(np.ascontiguousarray(rows.features, dtype=np.float64).ravel())
    table = pyarrow.table(
        {
            "start_s": pyarrow.array(rows.start_s, pyarrow.float64()),
            "terrain": pyarrow.array([str(name) for name in rows.terrain], pyarrow.string()),
            **{name: pyarrow.array(each, pyarrow.float64()) for name, each in rows.motion._asdict().items()},
            "features": pyarrow.FixedSizeListArray.from_arrays(flat, width),
        }
    )
    document = {"manifest": identity, "run": entry._asdict()}
    document["sha256"] = _checksum(document, rows)
    table = table.replace_schema_metadata({KEY: json.dumps(document, sort_keys=True)})
    with atomic_file(file_of(store, entry.run_id)) as file:
        parquet.write_table(table, file, compression="zstd")


def read_run_windows(
    store: Path, run_id: str, identity: str, n_features: int
) -> tuple[StoredRun, RunWindows]:
    """Return what the file of a run holds; checksums are compared.

    Raises
    ------
    LogError
        if the file is missing, damaged, or was written for another manifest.
    """
    import pyarrow
    from pyarrow import parquet

    path = file_of(store, run_id)
    try:
        with path.open("rb") as file:
            table = parquet.read_table(file, use_threads=False)
        document: dict[str, Any] = json.loads(table.schema.metadata[KEY])
        entry = StoredRun(**document["run"])
        flat = table.column("features").combine_chunks().flatten().to_numpy(zero_copy_only=False)
        rows = RunWindows(
            table.column("start_s").to_numpy(),
            np.array(table.column("terrain").to_pylist(), dtype=object),
            flat.reshape(table.num_rows, n_features),
            Motion(*(table.column(name).to_numpy() for name in Motion._fields)),
        )
        if document.pop("sha256") != _checksum(document, rows):
            raise ValueError("its checksum differs")
    except (pyarrow.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise LogError(
            f"{path}: is no whole file of a store of features ({' '.join(str(error).split())[:160]}); "
            "terrain features makes it again"
        ) from error
    if document["manifest"] != identity or entry.run_id != run_id or entry.n_windows != len(rows.start_s):
        raise LogError(f"{path}: is of another store of features; terrain features makes it again")
    return entry, rows


def _checksum(document: Mapping[str, Any], rows: RunWindows) -> str:
    """Return a SHA-256 over all that a file holds; page checksums of Parquet leave its headers out."""
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    digest.update("\n".join(str(name) for name in rows.terrain).encode())
    for values in (rows.start_s, rows.features, *rows.motion):
        digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    return digest.hexdigest()
