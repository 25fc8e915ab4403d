"""Reader of the folder layout in which BorealTC and Vulpi are published: the mapping ``data/layouts/borealtc.yaml``."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from terrain.files.names import data_folder
from terrain.logs.mapping import load_mapping, read_run, run_files
from terrain.records import RunLog


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run of the layout under ``folder``; call it with ``repair=``.

    The list is empty when the folder does not have the layout.  A run of which one file is missing has
    a reader too: it raises :class:`~terrain.errors.LogError` with the name of that file.
    """
    mapping = load_mapping(data_folder("layouts") / "borealtc.yaml")
    files = {(each.words["terrain"], each.words["run"]): each for each in run_files(folder, mapping)}
    read = partial(read_run, folder, mapping, by="BorealTC layout", linked_folders=True)
    return [
        partial(read, files[terrain, run])
        for terrain, run in sorted(files)
        if re.fullmatch("[0-9]+", run) and not terrain.startswith(".")
    ]
