"""Reader of the wheel testbed of Pavlov and Johnson: one rigid wheel in dry sand, slip and slip angle set.

``<DIR>/smooth.csv`` and ``grouser.csv`` (repository robomechanics/3d-terramechanics, MIT) hold a trial a row:
means and standard deviations over the steady part of a travel at 10 mm/s.  The wheel has a radius of 58 mm
and a width of 50 mm, the grousers stand out by 5 mm.  A row becomes a run, ``smooth_trial_001`` for the first
row of data, so that splits by run hold trials out.

The only stream is ``testbed``.  The files do not state how long a trial lasted: it is a steady state, and its
means stand in two equal samples, at 0 s and at 1 s, since a stream has at least two.

==============  =========================================  ==================================================
column          channel                                    note
==============  =========================================  ==================================================
``trial_num``   ``trial_attempt_code``                     attempt at this setting; repeats, names no row
``beta``        ``slip_angle_commanded_rad``               90 degrees: the wheel is dragged along its axle
``Vry``         ``speed_wheel_commanded_mps``              wheel circumferential speed, rounded by the authors
``slip``        ``slip_measured_ratio``                    ``avg_Vry`` and ``avg_Vx`` by (1)
``avg_angle``   ``slip_angle_measured_rad``
``avg_Vx``      ``speed_travel_mps``, ``..._std_mps``      of the carriage, along the direction of travel
``avg_Vry``     ``speed_wheel_mps``, ``..._std_mps``
``avg_Fy``      ``force_x_n``, ``force_x_std_n``           sign turned: traction, positive ahead
``avg_Fx``      ``force_y_n``, ``force_y_std_n``           side force, positive to the left
``avg_Fz``      ``force_z_n``, ``force_z_std_n``           sign turned: load, the ground's push upwards
``avg_Z``       ``sinkage_wheel_m``, ``..._std_m``         sign turned: depth of the lowest point, downwards
==============  =========================================  ==================================================

(1) ``slip = (speed_wheel - speed_travel) / max(|speed_wheel|, |speed_travel|)``: the speed is that of the
travel, not its part along the wheel.  ``slip_commanded_ratio`` is the same of the commanded speeds; the
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
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.files.names import shown
from terrain.logs.samples import check_log_file, checked_names, checked_stream, short_name
from terrain.logs.tables import number_in, text_rows
from terrain.records import Label, RunLog

WHEELS = ("smooth", "grouser")
"""Names of the files; each is a wheel, a session, and the end of the robot's name."""

ROBOT = "testbed_{wheel}"
SOIL = "dry_sand"
STREAM = "testbed"
HELD_S = 1.0
"""Time from the first of the two equal samples of a trial to the other; it stands for no duration."""

TRAVEL_SPEED_MPS = 0.010
"""Commanded speed of every trial."""

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

COLUMNS = tuple(column for column, _ in (*MEANS.values(), *SPREADS.values()))
MAX_SLIP_MISFIT = 0.01
"""By how much ``slip`` may differ from the slip of the mean speeds; 0.002 is the most that was found."""

BAD_SPREAD = "spreads that are negative or no number"


class _Row(NamedTuple):
    """A row of a file: its number as an editor shows it, its texts, and the row that it repeats, or 0."""

    number: int
    cells: tuple[str, ...] | None
    repeats: int


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per trial of the files in ``folder``; call it with ``repair=``.

    The list is empty when neither file is there.  A row that cannot be read has a reader, too: it raises
    :class:`LogError`, and who repairs skips it by name.

    Parameters
    ----------
    folder : with ``smooth.csv``, ``grouser.csv`` or both

    Raises
    ------
    LogError
        if a file is no text, lacks a column or has no row of data.
    """
    readers: list[Callable[..., RunLog]] = []
    for wheel in WHEELS:
        path = folder / f"{wheel}.csv"
        if not path.is_file():
            continue
        rows = text_rows(check_log_file(path, folder), COLUMNS)
        if not rows:
            raise LogError(f"{short_name(path)}: has no rows of data, a trial a row is needed")
        first: dict[tuple[str, ...], int] = {}
        for index, (number, cells) in enumerate(rows, start=1):
            repeats = first.setdefault(cells, number) if cells is not None else number
            row = _Row(number, cells, 0 if repeats == number else repeats)
            readers.append(partial(read_trial, short_name(path), wheel, index, row))
    return readers


def read_trial(name: str, wheel: str, index: int, row: _Row, *, repair: bool = False) -> RunLog:
    """Return a trial as a run.

    Parameters
    ----------
    name : what messages call the file
    wheel : one of :data:`WHEELS`
    index : of the row among those of data, from 1
    row : its texts
    repair : a spread that is not accepted becomes NaN and is counted

    Raises
    ------
    LogError
        if the row is too short or too long or repeats another, a cell is no number, a mean is missing or not
        finite, or the numbers contradict each other.
    """
    dropped: Counter[str] = Counter()
    column = dict(zip(COLUMNS, _numbers(name, row, repair, dropped), strict=True))
    _refuse_contradictions(f"{name}: row {row.number}", column)
    channels = MEANS | SPREADS
    values = {channel: column[source] * factor for channel, (source, factor) in channels.items()}
    values["slip_commanded_ratio"] = slip_of(values["speed_wheel_commanded_mps"], TRAVEL_SPEED_MPS)
    stream = checked_stream(
        name,
        np.array([0.0, HELD_S]),
        np.tile(list(values.values()), (2, 1)),
        list(values),
        row_of=lambda _: row.number,
        unknown_is_a_value=True,
    )
    run = RunLog(
        f"{wheel}_trial_{index:03d}",
        ROBOT.format(wheel=wheel),
        {STREAM: stream},
        (Label(0.0, 2.0 * HELD_S, SOIL),),
        source=f"{name}, row {row.number}, layout of the wheel testbed",
        dropped=dropped,
        session=wheel,
    )
    return checked_names(name, run)


def slip_of(wheel_mps: float, travel_mps: float) -> float:
    """Return the slip ratio of two speeds of which one at least is not 0.

    Examples
    --------
    >>> slip_of(0.02, 0.01), slip_of(0.0, 0.01)
    (0.5, -1.0)
    """
    return (wheel_mps - travel_mps) / max(abs(wheel_mps), abs(travel_mps))


def _numbers(name: str, row: _Row, repair: bool, dropped: Counter[str]) -> Sequence[float]:
    if row.cells is None:
        raise LogError(f"{name}: row {row.number} has missing or extra cells")
    if row.repeats:
        raise LogError(f"{name}: row {row.number} repeats the trial of row {row.repeats}, number for number")
    spreads = {column for column, _ in SPREADS.values()}
    numbers = []
    for column, cell in zip(COLUMNS, row.cells, strict=True):
        place = f"{name}: {column} at row {row.number} is {shown(cell)}"
        number = number_in(cell)
        if column in spreads and (number is None or not (math.isnan(number) or 0.0 <= number < math.inf)):
            if not repair:
                raise LogError(f"{place}, a standard deviation is a number from 0 up")
            number = math.nan
            dropped[BAD_SPREAD] += 1
        if number is None:
            raise LogError(f"{place}, which is no number")
        if column not in spreads and not math.isfinite(number):
            raise LogError(
                f"{name}: {column} at row {row.number} is {shown(cell)}, a finite mean is required"
            )
        numbers.append(number)
    return numbers


def _refuse_contradictions(place: str, column: dict[str, float]) -> None:
    attempt, beta = column["trial_num"], column["beta"]
    if attempt < 1 or attempt != int(attempt):
        raise LogError(f"{place}: trial_num is {attempt:g}, a whole number from 1 up is required")
    if not -90.0 <= beta <= 90.0:
        raise LogError(f"{place}: beta is {beta:g} degrees, -90 to 90 is accepted")
    if column["avg_Vx"] <= 0.0:
        raise LogError(f"{place}: avg_Vx is {column['avg_Vx']:g} mm/s, a speed of travel above 0 is required")
    slip = slip_of(column["avg_Vry"], column["avg_Vx"])
    if abs(slip - column["slip"]) > MAX_SLIP_MISFIT:
        raise LogError(f"{place}: slip is {column['slip']:g}, that of its mean speeds is {slip:.3f}")
    if column["avg_Fz"] >= 0.0:
        raise LogError(f"{place}: avg_Fz is {column['avg_Fz']:g} N, that of a wheel with a load is below 0")
