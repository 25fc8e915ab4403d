"""Curves of a drive in the closed loop: speeds, slip and terrains over time, of so many points as can be seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.control.danzi_pid import DriveState
from terrain.control.drive_metrics import PEAK_ABOVE_MPS, low_passed_slip
from terrain.control.slip_table import SlipTable
from terrain.kinematics.logged_wheels import true_slip
from terrain.records import Array, RunLog

MAX_POINTS = 2500
NO_CODE = -99.0
"""In the place of a code that is not known."""

Span = tuple[float, float, str]
"""Start, end and name of an interval."""


class DriveCurves(NamedTuple):
    """Curves of a drive: true speed and slip (n,), least and largest of the wheels, and the control stream.

    Parameters
    ----------
    true_s, true_mps, slip, slip_least, slip_largest : (n,) of the truth
    control_s, control : (m,) times, and channels by name of what the pilot reports
    aimed : (m,) target slip with its floor, negative in braking
    is_open_loop : whether no slip was estimated
    terrains : true and, where there is one, classified terrain over time, by ``true`` and ``classified``;
        empty on one terrain
    """

    true_s: Array
    true_mps: Array
    slip: Array
    slip_least: Array
    slip_largest: Array
    control_s: Array
    control: Mapping[str, Array]
    aimed: Array
    is_open_loop: bool
    terrains: Mapping[str, Sequence[Span]]


def drive_curves(run: RunLog, table: SlipTable) -> DriveCurves:
    """Return the curves of a drive, of so many points as can be seen.

    True slip is low-pass filtered as its estimate, and NaN where the robot is slower than
    :data:`terrain.control.drive_metrics.PEAK_ABOVE_MPS`.  A wheel that turns against the motion is drawn as a
    locked one.

    Parameters
    ----------
    run : with the streams ``truth`` and ``control``
    table : whose entries the pilot numbers the terrains by
    """
    truth, control = run.streams["truth"], run.streams["control"]
    step_s = float(np.median(np.diff(truth.time_s)))
    speed = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    wheels = [name.split("_")[1] for name in truth.channels if name.startswith("wheel_")]
    slips = low_passed_slip(np.clip(true_slip(truth, wheels), -1.0, 1.0), step_s)
    slips[speed < PEAK_ABOVE_MPS] = np.nan
    seen, ticks = _every(truth.time_s), _every(control.time_s)
    channels = {name: control.channel(name)[ticks] for name in control.channels}
    aimed = channels["aimed_ratio"]
    if not np.isfinite(channels["balance_ratio"]).any():  # the thesis reports the magnitude of its target
        aimed = np.where(channels["drive_state_code"] == DriveState.BRAKING, -aimed, aimed)
    slips = slips[seen]
    return DriveCurves(
        true_s=truth.time_s[seen],
        true_mps=speed[seen],
        slip=slips.mean(axis=1),
        slip_least=slips.min(axis=1),
        slip_largest=slips.max(axis=1),
        control_s=control.time_s[ticks],
        control=channels,
        aimed=aimed,
        is_open_loop=not np.isfinite(channels["slip_ratio"]).any(),
        terrains=_terrains(run, control.time_s[ticks], channels["terrain_code"], table),
    )


def _every(time_s: Array) -> slice:
    return slice(None, None, max(1, math.ceil(len(time_s) / MAX_POINTS)))


def _terrains(run: RunLog, time_s: Array, codes: Array, table: SlipTable) -> dict[str, list[Span]]:
    """Return the true and the classified terrain over time; nothing on one terrain."""
    if len(run.terrains) < 2:
        return {}
    strips = {"true": [(label.start_s, label.end_s, label.terrain) for label in run.labels]}
    names = dict(enumerate(table.targets))
    if (codes >= 0).any():
        strips["classified"] = spans(
            time_s, codes, {int(code): names[int(code)] for code in codes if code >= 0}
        )
    return strips


def spans(time_s: Array, codes: Array, names: Mapping[int, str]) -> list[Span]:
    """Return the intervals in which a code (n,) has a name, from its first sample to that of the next code.

    Examples
    --------
    >>> spans(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0, 1, 1, 0]), {1: "braking"})
    [(1.0, 3.0, 'braking')]
    """
    codes = np.nan_to_num(codes, nan=NO_CODE)
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    ends = [*time_s[first[1:]].tolist(), float(time_s[-1])]
    return [
        (float(time_s[i]), end, names[int(codes[i])])
        for i, end in zip(first, ends, strict=True)
        if int(codes[i]) in names
    ]
