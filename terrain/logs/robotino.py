r"""Reader of the logs of a Robotino on four surfaces: three motors, and a camera above.

A data set is a folder with ``camera_params.json`` (millimetres a pixel) and folders of runs, each a
``<name>.csv.gz`` with three header rows, semicolons and a row about every 31 ms (repository
BrOleg5/research-wheel-slippage):

=========================================  ==================  ==============================================
folder                                     run                 label, session
=========================================  ==================  ==============================================
``one_surface/<surface>/exp129.csv.gz``    ``gray_129``        the surface
``two_surfaces/<surfaces>/exp07.csv.gz``   ``green_table_07``  none: the instant of the change is not logged;
\                                                              session ``green_table``
``weights/<surface>/exp07.csv.gz``         ``weights_gray_07`` the surface; session ``weights_gray``
``dc_motor/<name>.csv.gz``                 ``dc_motor_<name>`` none; some of these have no camera
=========================================  ==================  ==============================================

Stream ``wheels``: ``motor_1_radps`` ... of ``m1vel``, on the scale of ``m1pos``, and ``current_1_a`` ... of
``m1cur``; ``commands``: the twist ``xsetspeed ysetspeed setvel``; ``pose``: ``xpos ypos ang``.

What is assumed here was compared with the other columns:

- *Frames*: commanded motor speeds are those of wheels at 60, 180 and 300 degrees of the body that each turn
  the robot to the left, 16 turns of the motor to one of the wheel.  Pixels count to the right and down, so
  that ``y = -ypos``; ``ang`` is counter-clockwise, and the body's x axis is 90 degrees ahead of it: so the
  measured direction of travel is the commanded one within a few degrees in all runs.
- *Scale*: ``m?vel`` has steps of 2.83 rad/s and is 1.1 to 1.7 % above the rate of ``m?pos`` at all speeds, by
  a ratio that is each motor's own.  Encoder counts are right: rates are brought to their scale by the ratio
  of the run, or by :data:`USUAL_SCALE` where a motor hardly turns or its counts are not logged.
- *Held*: ``m?pos`` is sampled every 18.7 ms and held, so that its differences from row to row are wrong by up
  to a half; it is used for the scale alone.  A pose that repeats is no new one and is left out.
- *Magnitudes*: ``m?cur`` has steps of 0.0256 A and no sign.
- ``xcur ycur rotcur dx dy dang`` are made of the other columns and are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from terrain.errors import LogError
from terrain.files.documents import read_json
from terrain.files.names import normal_name, shown
from terrain.logs.samples import (
    check_log_file,
    checked_names,
    checked_stream,
    refuse_or_count,
    short_name,
    whole_run_label,
)
from terrain.logs.schema import POSE_CHANNELS, TWIST, WHEELS_CHANNELS
from terrain.logs.tables import TextLayout, header_of, read_groups, row_number
from terrain.records import Array, RunLog

CAMERA_FILE = "camera_params.json"

SCALED = "motor rates scaled to their encoders"
NO_SIGN = "currents without a sign"
HELD = "poses held from the row before"
BLIND = "runs in which the camera sees no motion"
"""Kinds of what is changed, left out and, the last, dropped by a repairing read."""

USUAL_SCALE = 1.0 / 1.0133
"""Of a reported rate that has no counts beside it: the mean over the motors of all runs."""

MIN_TICKS = 2000
"""Counts, one turn of a motor, that a ratio is taken from: the hold of 155 counts is then under 8 %, and over
a run of 10 s at 0.1 m/s under 0.5 %."""

MAX_SCALE_ERROR = 0.1
"""Of a ratio against the usual one; beyond, counts or rates are damaged and the usual one is taken."""

MIN_POSES = 10
"""Different poses of a run in which the wheels turn, from 0.3 s of a camera that sees the robot."""

MAX_COMMAND_ERROR_RADPS = 2.0
"""Of a commanded motor speed against the commanded twist: 5 % of the slowest drive."""

_GEAR, _TICKS_PER_TURN, _WHEEL_RADIUS_M, _WHEEL_DISTANCE_M = 16.0, 2000.0, 0.04, 0.125
"""Of the robot that drove the logs: what the commanded motor speeds follow from the commanded twist by."""

_LAYOUT = TextLayout(delimiter=";", skip_rows=2)
_RATES, _COUNTS, _CURRENTS, _SET_RATES = (
    [f"m{i}{name}" for i in (1, 2, 3)] for name in ("vel", "pos", "cur", "setvel")
)
_TWIST, _POSE = ["xsetspeed", "ysetspeed", "setvel"], ["xpos", "ypos", "ang"]
_MOTORS_ONLY = "dc_motor"
_MAX_DEPTH = 3  # folders from a run's file up to that of the camera


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run in ``folder``, a data set or a folder of it; call it with ``repair=``.

    The list is empty where there is no ``camera_params.json`` in the folder or above it, or no run.
    """
    whole = folder.resolve()
    places = (whole, *whole.parents[:_MAX_DEPTH])
    root = next((place for place in places if (place / CAMERA_FILE).is_file()), None)
    if root is None:
        return []
    files = sorted(
        path
        for path in whole.rglob("*.csv.gz")
        if not path.name.endswith("_load.csv.gz")
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
    )
    return [partial(read_run, path, root) for path in files]


def read_run(path: Path, root: Path, *, repair: bool = False) -> RunLog:
    """Return the run that a ``.csv.gz`` of the data set in ``root`` holds.

    Raises
    ------
    LogError
        if the file or that of the camera is broken, a column is missing, the times do not rise, a channel has
        nothing finite, commanded motor speeds are not those of the commanded twist, or the camera sees no
        motion while the wheels turn.
    """
    path = check_log_file(path, root)
    name, parts = short_name(path), path.relative_to(root).parts
    repairs = Counter[str]() if repair else None
    with_camera = parts[0] != _MOTORS_ONLY or _POSE[0] in header_of(path, _LAYOUT)
    groups = {"time": ["t"], "set_rates": _SET_RATES, "counts": _COUNTS, "rates": _RATES}
    groups |= {"currents": _CURRENTS} | ({"twist": _TWIST, "pose": _POSE} if with_camera else {})
    log = read_groups(path, groups, layout=_LAYOUT, repairs=repairs)
    row_of = partial(row_number, path, layout=_LAYOUT)
    checked = partial(checked_stream, name, row_of=row_of, repairs=repairs)
    time_s, rates, counts = log["time"][:, 0] * 1e-3, log["rates"], log["counts"]
    for rate, count in zip(rates.T, counts.T, strict=True):
        rate *= _scale(time_s, rate, count)
    converted = Counter({SCALED: len(_RATES), NO_SIGN: len(_CURRENTS)})
    motors = np.column_stack([rates, log["currents"]])
    streams = {"wheels": checked(time_s, motors, WHEELS_CHANNELS, columns=[*_RATES, *_CURRENTS])}
    if with_camera:
        twist, seen = log["twist"], log["pose"]
        # commanded motor speeds are those of terrain.kinematics.wheels.rolling_matrix
        direction = np.radians([150.0, 270.0, 390.0])
        rolling = np.stack([np.cos(direction), np.sin(direction), np.full(3, _WHEEL_DISTANCE_M)], axis=-1)
        expected = np.nan_to_num(twist) @ (rolling * (_GEAR / _WHEEL_RADIUS_M)).T
        apart = np.nanmax(np.abs(log["set_rates"] - expected), axis=1, initial=0.0)
        for row in np.flatnonzero(apart > MAX_COMMAND_ERROR_RADPS)[:1].tolist():
            raise LogError(
                f"{name}: at row {row_of(row)} the commanded motor speeds are {apart[row]:.3g} rad/s away from "
                f"those of the commanded twist; at most {MAX_COMMAND_ERROR_RADPS:g} rad/s are accepted (are they "
                "of another robot or session?)"
            )
        streams["commands"] = checked(time_s, twist, TWIST, columns=_TWIST)
        camera, metres = root / CAMERA_FILE, []  # a pixel, in x and y
        document = read_json(check_log_file(camera, root), short_name(camera), LogError)
        for key in ("pixel_resolution_x", "pixel_resolution_y"):
            value = document.get(key) if isinstance(document, dict) else None
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < np.inf:
                fault = f"{key} is {shown(value)}, millimetres a pixel are required"
                raise LogError(f"{short_name(camera)}: {fault}")
            metres.append(float(value) * 1e-3)
        new = np.asarray(np.isfinite(seen).all(axis=1))
        new[1:] &= (np.diff(seen, axis=0) != 0.0).any(axis=1)
        moves = any(np.ptp(count[np.isfinite(count)]) >= MIN_TICKS for count in counts.T)
        if moves and new.sum() < MIN_POSES:
            fault = f"the camera shows {int(new.sum())} different poses while the wheels turn"
            refuse_or_count(repairs, BLIND, f"{name}: {fault}; at least {MIN_POSES} are required")
        else:
            converted[HELD] += int((~new).sum())
            yaw = np.unwrap(np.radians(seen[new, 2])) + np.pi / 2
            pose = np.column_stack([seen[new, 0] * metres[0], -seen[new, 1] * metres[1], yaw])
            streams["pose"] = checked(time_s[new], pose, POSE_CHANNELS, columns=_POSE)
    run_id, terrain, session = _names(parts)
    labels = (whole_run_label({"wheels": streams["wheels"]}, terrain),) if terrain else ()
    source, dropped = f"{'/'.join(parts)}, Robotino layout", converted + (repairs or Counter())
    return checked_names(name, RunLog(run_id, "robotino", streams, labels, source, dropped, session))


def _scale(time_s: Array, rate_radps: Array, counts: Array) -> float:
    """Return the slope of encoder counts, as an angle, over the integral of the reported rate."""
    known = np.isfinite(time_s) & np.isfinite(rate_radps) & np.isfinite(counts)
    if known.sum() < 2 or np.ptp(counts[known]) < MIN_TICKS:
        return USUAL_SCALE
    time_s, rate_radps = time_s[known], rate_radps[known]
    angle = counts[known] * (2.0 * np.pi / _TICKS_PER_TURN)
    turned = np.concatenate([[0.0], np.cumsum(np.diff(time_s) * (rate_radps[1:] + rate_radps[:-1]) / 2.0)])
    turned -= turned.mean()
    slope = float(turned @ angle / (turned @ turned))
    return slope if abs(slope / USUAL_SCALE - 1.0) < MAX_SCALE_ERROR else USUAL_SCALE


def _names(parts: tuple[str, ...]) -> tuple[str, str, str]:
    """Return id, terrain and session of a run by the folders of its file."""
    parts = tuple(normal_name(part) for part in parts)
    number = parts[-1].removesuffix(".csv.gz").removeprefix("exp")
    if len(parts) == 3 and parts[0] == "one_surface":
        return f"{parts[1]}_{number}", parts[1], ""
    if len(parts) == 3 and parts[0] == "weights":
        return f"weights_{parts[1]}_{number}", parts[1], f"weights_{parts[1]}"
    folder = "_".join(parts[1:-1] or parts[:-1])
    return "_".join(filter(None, [folder, number])), "", "" if parts[0] == _MOTORS_ONLY else folder
