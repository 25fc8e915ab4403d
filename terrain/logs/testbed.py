"""Reader of the wheel testbed of Pavlov and Johnson: one rigid wheel in dry sand, slip and slip angle set.

``<DIR>/smooth.csv`` and ``grouser.csv`` (repository robomechanics/3d-terramechanics, MIT) hold a trial a row:
means and standard deviations over the steady part of a travel at 10 mm/s.  The wheel has a radius of 58 mm
and a width of 50 mm, the grousers stand out by 5 mm.  A row becomes a run, ``smooth_trial_001`` for the first
row of data, so that splits by run hold trials out.

The only stream is ``testbed``.  The files do not state how long a trial lasted: it is a steady state, and its
means stand in two equal samples, at 0 s and at 1 s, since a stream has at least two.

Columns and channels are those of :data:`MEANS` and :data:`SPREADS`.  ``trial_num`` is the attempt at this setting: it
repeats, and names no row.  A ``beta`` of 90 degrees: the wheel is dragged along its axle.  ``Vry`` is the wheel
circumferential speed, rounded by the authors; ``avg_Vx`` that of the carriage, along the direction of travel.  Forces
are traction, positive ahead, side force, positive to the left, and load, the ground's push upwards; sinkage is the
depth of the lowest point, downwards: the signs of ``avg_Fy``, ``avg_Fz`` and ``avg_Z`` are turned.

``slip = (speed_wheel - speed_travel) / max(|speed_wheel|, |speed_travel|)`` of ``avg_Vry`` and ``avg_Vx``: the speed
is that of the travel, not its part along the wheel.  ``slip_commanded_ratio`` is the same of the commanded speeds; the
smallest positive slip was commanded as 12 mm/s (0.17) and driven as 13 mm/s (0.23).

Signs.  A locked wheel (slip -1) that moves straight ahead is pushed back: ``avg_Fy`` is +39 N there, so that
traction is its negative.  ``avg_Fz`` is -13 to -30 N under a wheel that the ground carries.  Side force grows
with the slip angle: a positive angle is travel towards the right of the wheel, and the ground pushes it left,
as ``slip_y`` of :func:`~terrain.terramechanics.traction.wheel_ground` has it.

What the numbers do not say.  The zero of ``avg_Z`` is the authors' (31.5 mm at the wheel's start, less the
deflection of the testbed): a wheel that rolls straight stands 14 mm deep.  The load is not constant: it
falls from 25 N for the rolling wheel to 13 N for the one dragged along its axle, with one dead weight.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from terrain.errors import LogError
from terrain.files.names import shown
from terrain.logs.samples import check_log_file, checked_names, checked_stream, refuse_or_count, short_name
from terrain.logs.tables import number_in, text_rows
from terrain.records import Label, RunLog

WHEELS = ("smooth", "grouser")
"""Names of the files; each is a wheel, a session, and the end of the robot's name."""

STREAM = "testbed"
HELD_S = 1.0
"""Time from the first of the two equal samples of a trial to the other; it stands for no duration."""

TRAVEL_SPEED_MPS = 0.010  #: Commanded speed of every trial

_DEG, _MM = math.pi / 180.0, 1e-3
MEANS: dict[str, tuple[str, float]] = {
    "trial_attempt_code": ("trial_num", 1.0),
    "slip_angle_commanded_rad": ("beta", _DEG),
    "speed_wheel_commanded_mps": ("Vry", _MM),
    "slip_measured_ratio": ("slip", 1.0),
    "slip_angle_measured_rad": ("avg_angle", _DEG),
    "speed_travel_mps": ("avg_Vx", _MM),
    "speed_wheel_mps": ("avg_Vry", _MM),
    "force_x_n": ("avg_Fy", -1.0),
    "force_y_n": ("avg_Fx", 1.0),
    "force_z_n": ("avg_Fz", -1.0),
    "sinkage_wheel_m": ("avg_Z", -_MM),
}
SPREADS: dict[str, tuple[str, float]] = {
    "speed_travel_std_mps": ("std_Vx", _MM),
    "speed_wheel_std_mps": ("std_Vry", _MM),
    "force_x_std_n": ("std_Fy", 1.0),
    "force_y_std_n": ("std_Fx", 1.0),
    "force_z_std_n": ("std_Fz", 1.0),
    "sinkage_wheel_std_m": ("std_Z", _MM),
}
"""Column and factor of each channel; a mean has to be there, a spread may be missing."""

MAX_SLIP_MISFIT = 0.01
"""By how much ``slip`` may differ from the slip of the mean speeds; 0.002 is the most that was measured."""

BAD_SPREAD = "spreads that are negative or no number"


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per trial of ``smooth.csv`` and ``grouser.csv`` in ``folder``; call it with ``repair=``.

    The list is empty when neither file is there; ``LogError`` where one is no text, lacks a column or has no row of
    data.  A row that cannot be read has a reader, too: it raises ``LogError``, and who repairs skips it by name.
    """
    readers: list[Callable[..., RunLog]] = []
    for wheel in WHEELS:
        path = folder / f"{wheel}.csv"
        if not path.is_file():
            continue
        columns = [column for column, _ in (MEANS | SPREADS).values()]
        rows = text_rows(check_log_file(path, folder), columns)
        if not rows:
            raise LogError(f"{short_name(path)}: has no rows of data, a trial a row is needed")
        first: dict[tuple[str, ...], int] = {}
        for index, (row, cells) in enumerate(rows, start=1):
            fault = "has missing or extra cells"
            if cells is not None and (same := first.setdefault(cells, row)):
                fault = "" if same == row else f"repeats the trial of row {same}, number for number"
            trial = dict(zip(columns, cells or (), strict=False))
            readers.append(partial(read_trial, short_name(path), wheel, index, row, trial, fault))
    return readers


def read_trial(
    name: str, wheel: str, index: int, row: int, cells: dict[str, str], fault: str, *, repair: bool = False
) -> RunLog:
    """Return a trial as a run, the ``index``-th of its file, of its texts by column.

    ``LogError`` where the row has a fault, a cell is no number, a mean is missing or not finite, or the numbers
    contradict each other; a repairing read makes a spread that is not accepted NaN, and counts it.
    """
    at = f"{name}: row {row}"
    if fault:
        raise LogError(f"{at} {fault}")
    dropped: Counter[str] = Counter()
    column = {}
    for source, cell in cells.items():
        place, number = f"{name}: {source} at row {row} is {shown(cell)}", number_in(cell)
        if source.startswith("std"):
            if number is None or not (math.isnan(number) or 0.0 <= number < math.inf):
                fault = f"{place}, a standard deviation is a number from 0 up"
                refuse_or_count(dropped if repair else None, BAD_SPREAD, fault)
                number = math.nan
        elif number is None:
            raise LogError(f"{place}, which is no number")
        elif not math.isfinite(number):
            raise LogError(f"{place}, a finite mean is required")
        column[source] = number
    attempt, beta, travel = column["trial_num"], column["beta"], column["avg_Vx"]
    slip = _slip(column["avg_Vry"], travel)
    if attempt < 1 or attempt != int(attempt):
        raise LogError(f"{at}: trial_num is {attempt:g}, a whole number from 1 up is required")
    if not -90.0 <= beta <= 90.0:
        raise LogError(f"{at}: beta is {beta:g} degrees, -90 to 90 is accepted")
    if travel <= 0.0:
        raise LogError(f"{at}: avg_Vx is {travel:g} mm/s, a speed of travel above 0 is required")
    if abs(slip - column["slip"]) > MAX_SLIP_MISFIT:
        raise LogError(f"{at}: slip is {column['slip']:g}, that of its mean speeds is {slip:.3f}")
    if column["avg_Fz"] >= 0.0:
        raise LogError(f"{at}: avg_Fz is {column['avg_Fz']:g} N, that of a wheel with a load is below 0")
    values = {channel: column[source] * factor for channel, (source, factor) in (MEANS | SPREADS).items()}
    values["slip_commanded_ratio"] = _slip(values["speed_wheel_commanded_mps"], TRAVEL_SPEED_MPS)
    twice = np.tile([*values.values()], (2, 1))
    stream = checked_stream(name, np.array([0.0, HELD_S]), twice, [*values], unknown_is_a_value=True)
    labels = (Label(0.0, 2.0 * HELD_S, "dry_sand"),)
    about = (labels, f"{name}, row {row}, layout of the wheel testbed", dropped, wheel)
    run = RunLog(f"{wheel}_trial_{index:03d}", f"testbed_{wheel}", {STREAM: stream}, *about)
    return checked_names(name, run)


def _slip(wheel_mps: float, travel_mps: float) -> float:
    fastest_mps = max(abs(wheel_mps), abs(travel_mps))
    return (wheel_mps - travel_mps) / fastest_mps if fastest_mps else math.nan
