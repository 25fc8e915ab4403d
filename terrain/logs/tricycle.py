r"""Reader of logs of a tricycle in ticks: steering and driven wheel by encoders, and poses of a sensor on the body.

A file ``<name>.txt`` or ``.txt.gz`` (repository gg-dema/calibration_tricyle-like_robot) begins with comments that state
nominal parameters, of which two are read, and has a line a sample::

    #parameters: [ Ksteer Ktraction axis_length steer_offset ]
    #parameter_values: 0.1 0.0106141 1.4 0
    #joints_max_enc: [ steering traction_wheel ]
    #joints_max_enc_values: 8192 5000
    time: 1668091584.8 ticks: 290 4294859756 model_pose: 0 0 0 tracker_pose: 6.5e-05 -0.0035 0.00094

- *Steering*: an absolute encoder, of which ``joints_max_enc_values`` are a turn; it is read as an angle from -pi to pi.
  ``Ksteer`` is left out: the gain of that angle is to be found (:mod:`terrain.calibration.poses`).
- *Driven wheel*: an incremental encoder in a counter of 32 bits that wraps; ``Ktraction`` is the distance of a turn of
  that encoder.  Speeds are rates of the unwrapped counts (:mod:`terrain.logs.counters`).
- ``tracker_pose`` is the pose of the sensor, stream ``pose``; ``model_pose``, the authors' odometry, is left out.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from terrain.angles import wrapped
from terrain.errors import LogError
from terrain.files.names import shown
from terrain.logs.counters import count_rates, unwrapped_counts
from terrain.logs.samples import (
    BAD_CELL,
    check_log_file,
    checked_names,
    checked_stream,
    refuse_or_count,
    short_name,
)
from terrain.logs.schema import POSE_CHANNELS
from terrain.logs.tables import number_in, read_bytes
from terrain.records import RunLog

ROBOT = "pallet_truck"
HEAD = "#kinematic_model:"  #: What a file of this layout begins with.
COUNTER = 2.0**32  #: Counts after which that of the driven wheel begins anew.
MAX_SPEED_MPS = 30.0  #: Of counts that a robot can have driven from a line to the next.
_SUFFIXES = (".txt", ".txt.gz")
_KEYS = {"time": 1, "ticks": 2, "model_pose": 3, "tracker_pose": 3}  # and how many numbers follow each


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per file of the layout in ``folder``; call it with ``repair=``."""
    files = sorted(path for path in folder.iterdir() if path.name.endswith(_SUFFIXES) and path.is_file())
    return [partial(read_run, path, folder) for path in files if _head_of(path).startswith(HEAD)]


def read_run(path: Path, folder: Path, *, repair: bool = False) -> RunLog:
    """Return the run of a file.

    Raises
    ------
    LogError
        if the head lacks a number, a line is not as described, the times do not rise, or the driven wheel is faster
        than any robot.
    """
    path, name, repairs = check_log_file(path, folder), short_name(path), Counter[str]() if repair else None
    lines = _text(path).splitlines()
    values = _head_numbers(name, lines)
    rows, numbers = [], []
    for row, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        sample = _sample(line)
        if sample is None:
            form = "time: s ticks: a b model_pose: x y yaw tracker_pose: x y yaw"
            fault = f"{name}: row {row} is {shown(line[:60])}, '{form}' is required"
            refuse_or_count(repairs, BAD_CELL, fault)
            continue
        rows.append(row)
        numbers.append(sample)
    table = np.array(numbers, dtype=np.float64).reshape(len(rows), sum(_KEYS.values()))
    if len(table) < 2:
        raise LogError(f"{name}: has {len(table)} usable rows of data, at least 2 are needed")
    time_s, (steer, driven) = table[:, 0], table[:, 1:3].T
    steer_rad = wrapped(steer * (2.0 * math.pi / values["steering"]))
    distance_m = unwrapped_counts(driven, COUNTER) * (values["Ktraction"] / values["traction_wheel"])
    speed_mps = count_rates(time_s, distance_m)
    with np.errstate(invalid="ignore"):
        if np.nanmax(np.abs(speed_mps), initial=0.0) > MAX_SPEED_MPS:
            row = rows[int(np.nanargmax(np.abs(speed_mps)))]
            raise LogError(
                f"{name}: near row {row} the counter of the driven wheel changes by {np.nanmax(np.abs(speed_mps)):.3g} "
                f"m/s, at most {MAX_SPEED_MPS:g} m/s is accepted (was it begun anew?)"
            )
    start_s = time_s[0]
    checked = partial(checked_stream, name, row_of=lambda sample: rows[sample], repairs=repairs)
    streams = {
        "wheels": checked(time_s - start_s, speed_mps[:, None], ["speed_front_mps"]),
        "steering": checked(time_s - start_s, steer_rad[:, None], ["angle_front_rad"]),
        "pose": checked(time_s - start_s, table[:, -3:], list(POSE_CHANNELS)),
    }
    run_id = re.sub(r"\.txt(\.gz)?$", "", path.name)
    run = RunLog(run_id, ROBOT, streams, (), f"{path.name}, tricycle layout", repairs or Counter())
    return checked_names(name, run)


def _sample(line: str) -> list[float] | None:
    """Return the numbers of a line, in the order of its keys; None where it is not as described."""
    words, numbers = line.split(), list[float]()
    for key, n in _KEYS.items():
        if not words or words.pop(0) != f"{key}:":
            return None
        found = [number_in(word) for word in words[:n]]
        del words[:n]
        finite = [number for number in found if number is not None and math.isfinite(number)]
        if len(finite) < n:
            return None
        numbers += finite
    return numbers if not words else None


def _head_numbers(name: str, lines: list[str]) -> dict[str, float]:
    """Return what the head states, by the names of its lists."""
    values: dict[str, float] = {}
    head = [line.lstrip("#").strip() for line in lines if line.startswith("#")]
    for names, numbers in pairwise(head):
        if re.fullmatch(r"\w+: \[.*\]", names) and "_values:" in numbers:
            found = [number_in(word) for word in numbers.partition(":")[2].split()]
            words = names.partition("[")[2].rstrip("]").split()
            values |= {word: each for word, each in zip(words, found, strict=False) if each is not None}
    for key in ("Ktraction", "steering", "traction_wheel"):
        if not values.get(key, 0.0) > 0.0:
            raise LogError(f"{name}: its head does not state {key!r} as a number above zero")
    return values


def _text(path: Path) -> str:
    return read_bytes(path).decode("utf-8", errors="replace")


def _head_of(path: Path) -> str:
    try:
        return _text(path)[: len(HEAD)]
    except LogError:
        return ""
