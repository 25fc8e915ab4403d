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

The run is called ``<CLASS>_<N>`` with the digits of the file name, the robot is ``husky``, and one label
covers the whole run.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from terrain.files.names import normal_name, shown
from terrain.logs.csv_table import data_row, read_columns
from terrain.logs.log_files import check_log_file, checked_names, short_name
from terrain.logs.samples import checked_stream, refuse_apart
from terrain.records import Label, RunLog, Stream

TABLES: dict[str, tuple[str, dict[str, str]]] = {
    "imu": (
        "imu",
        {
            "gyro_x_radps": "wx",
            "gyro_y_radps": "wy",
            "gyro_z_radps": "wz",
            "accel_x_mps2": "ax",
            "accel_y_mps2": "ay",
            "accel_z_mps2": "az",
        },
    ),
    "pro": (
        "wheels",
        {
            "speed_left_mps": "velL",
            "speed_right_mps": "velR",
            "current_left_a": "curL",
            "current_right_a": "curR",
        },
    ),
}
"""Prefix of a file: the stream it becomes, and the column of each channel."""

_FILE_NAME = re.compile(r"(imu|pro)_([0-9]+)\.csv")


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run of the layout under ``folder``; call it with ``repair=``.

    The list is empty when the folder does not have the layout.  A run of which one file is missing has
    a reader too: it raises :class:`LogError` with the name of that file.
    """
    found = set()
    for path in folder.glob("*/*.csv"):
        match = _FILE_NAME.fullmatch(path.name)
        if match and not path.parent.name.startswith("."):
            found.add((path.parent, match[2]))
    return [partial(read_run, class_folder, number) for class_folder, number in sorted(found)]


def read_run(class_folder: Path, number: str, *, repair: bool = False) -> RunLog:
    """Return run ``number`` of the terrain that ``class_folder`` is named after.

    Parameters
    ----------
    class_folder : folder of ``imu_<number>.csv`` and ``pro_<number>.csv``
    number : digits as in the file names
    repair : drop and count what a strict read refuses

    Raises
    ------
    LogError
        if a file is missing, empty or broken, or the two do not overlap in time.
    """
    dropped: Counter[str] = Counter()
    streams = {}
    for prefix, (stream, columns) in TABLES.items():
        path = check_log_file(class_folder / f"{prefix}_{number}.csv", class_folder)
        table = read_columns(path, ["time", *columns.values()], repair=repair, dropped=dropped)
        streams[stream] = checked_stream(
            short_name(path),
            table[:, 0],
            table[:, 1:],
            list(columns),
            row_of=partial(data_row, path),
            columns=list(columns.values()),
            repairs=dropped if repair else None,
        )
    terrain = normal_name(class_folder.name)
    run_id = f"{terrain}_{number}"
    refuse_apart(run_id, streams)
    run = RunLog(
        run_id,
        "husky",
        streams,
        (whole_run_label(streams, terrain),),
        source=f"{class_folder.name}/imu_{number}.csv and pro_{number}.csv, BorealTC layout",
        dropped=dropped,
    )
    return checked_names(f"run {shown(run_id)}", run)


def whole_run_label(streams: Mapping[str, Stream], terrain: str) -> Label:
    """Return the label that covers every sample of a run, the last one with its sampling period.

    Examples
    --------
    >>> whole_run_label({"imu": Stream([0.0, 0.5, 1.0], [[0.0]] * 3, ("gyro_z_radps",))}, "SNOW")
    Label(start_s=0.0, end_s=1.5, terrain='SNOW')
    """
    last = max(streams.values(), key=lambda stream: float(stream.time_s[-1]))
    period_s = float(np.median(np.diff(last.time_s)))
    start_s = min(float(stream.time_s[0]) for stream in streams.values())
    return Label(start_s, float(last.time_s[-1]) + period_s, terrain)
