r"""Reader of the folder layout in which BorealTC and Vulpi are published.

``<DIR>/<CLASS>/imu_N.csv`` and ``pro_N.csv``: the class is the terrain, N the run.  Columns are read by
name, since their order differs between the two data sets:

=======================  =======================  ===================================================
file                     columns                  becomes stream and channels
=======================  =======================  ===================================================
``imu_N.csv``            ``time``                 ``imu``, seconds
\                        ``wx wy wz``             ``gyro_x_radps gyro_y_radps gyro_z_radps``
\                        ``ax ay az``             ``accel_x_mps2 accel_y_mps2 accel_z_mps2``
``pro_N.csv``            ``time``                 ``wheels``, seconds
\                        ``velL velR``            ``speed_left_mps speed_right_mps`` (wheel speed)
\                        ``curL curR``            ``current_left_a current_right_a``
=======================  =======================  ===================================================

A class is the word ``terrain`` and N the word ``run`` of a mapping of files (:mod:`terrain.logs.mapping`).
The run is called ``<CLASS>_<N>`` with the digits of the file name, the robot is ``husky``, and one label
covers the whole run.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from terrain.logs.mapping import Mapping, found_files, read_run
from terrain.records import RunLog

COLUMNS: dict[str, dict[str, tuple[str, str]]] = {
    "imu": {
        **{f"gyro_{axis}_radps": (f"w{axis}", "rad/s") for axis in "xyz"},
        **{f"accel_{axis}_mps2": (f"a{axis}", "m/s^2") for axis in "xyz"},
    },
    "wheels": {
        **{f"speed_{side}_mps": (f"vel{side[0].upper()}", "m/s") for side in ("left", "right")},
        **{f"current_{side}_a": (f"cur{side[0].upper()}", "A") for side in ("left", "right")},
    },
}
"""Column and unit of each channel of a stream."""

MAPPING = Mapping.model_validate(
    {
        "robot": "husky",
        "run_id": "{terrain}_{run}",
        "terrain": "{terrain}",
        "streams": {
            name: {
                "file": f"{{terrain}}/{prefix}_{{run}}.csv",
                "time": {"column": "time", "unit": "s"},
                "channels": {
                    channel: {"column": column, "unit": unit}
                    for channel, (column, unit) in COLUMNS[name].items()
                },
            }
            for name, prefix in (("imu", "imu"), ("wheels", "pro"))
        },
    }
)


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run of the layout under ``folder``; call it with ``repair=``.

    The list is empty when the folder does not have the layout.  A run of which one file is missing has
    a reader too: it raises :class:`LogError` with the name of that file.
    """
    found = [
        run
        for run in found_files(folder, MAPPING)
        if re.fullmatch("[0-9]+", run.words["run"]) and not run.words["terrain"].startswith(".")
    ]
    found.sort(key=lambda run: (run.words["terrain"], run.words["run"]))
    read = partial(read_run, folder, MAPPING, by="BorealTC layout", linked_folders=True)
    return [partial(read, run) for run in found]
