"""Faults of channels: what is wrong with a column of the logs, in words, with its repair."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.health.response import AMPS, A, G, H, T, X, Y
from terrain.discrepancy.signals import Signals
from terrain.records import Array


class FaultKind(StrEnum):
    """What is wrong with a column."""

    SIGN = "sign"
    UNIT = "unit"
    SWAPPED = "swapped"
    OFFSET = "offset"


class Column(StrEnum):
    """Columns of a log that have faults of their own, as sentences name them."""

    GYRO = "gyro"
    HEADING = "heading rate"
    SPEED = "speed over ground"
    ACCEL = "accelerometer"
    CURRENTS = "currents"
    WHEELS = "wheel speeds"
    SIDES = "wheel speeds and currents"


CHANNELS_OF: dict[Column, tuple[int, ...]] = {
    Column.GYRO: (G,),
    Column.HEADING: (H,),
    Column.SPEED: (X, Y),
    Column.ACCEL: (A,),
    Column.CURRENTS: (AMPS, T),
    Column.WHEELS: (),
    Column.SIDES: (),
}
"""Measured channels of each; those of wheels are the inputs of the simulation."""

LOGGED: dict[Column, str] = {
    Column.GYRO: "gyro_z_radps",
    Column.HEADING: "yaw_rate_radps",
    Column.SPEED: "speed_x_mps and speed_y_mps",
    Column.ACCEL: "accel_x_mps2",
    Column.CURRENTS: "the currents",
    Column.WHEELS: "the wheel speeds",
    Column.SIDES: "the wheel speeds and currents",
}
"""Names as logs have them."""


class Change(NamedTuple):
    """What makes a log right again.

    Parameters
    ----------
    kind, column : what is changed, and how
    factor : by which samples are multiplied; 1 for columns that are exchanged
    wheel : which wheel alone; -1 for all
    offset : that is added
    pair : wheels that are exchanged
    """

    kind: FaultKind
    column: Column
    factor: float = 1.0
    wheel: int = -1
    offset: float = 0.0
    pair: tuple[int, int] = (0, 1)

    @property
    def of_wheels(self) -> bool:
        """Whether it changes what drives the simulation."""
        return self.column in (Column.WHEELS, Column.SIDES)

    def measured(self, values: Array) -> Array:
        """Return measured channels (n, channels) as they are without the fault."""
        changed = values.copy()
        if self.kind is FaultKind.SWAPPED:
            if self.column is Column.SPEED:
                changed[:, [X, Y]] = values[:, [Y, X]]
            elif self.column in (Column.CURRENTS, Column.SIDES):
                changed[:, T] = -values[:, T]
        elif self.kind is FaultKind.OFFSET:
            c = CHANNELS_OF[self.column][0]
            changed[:, c] = values[:, c] + self.offset
        else:
            for c in CHANNELS_OF[self.column]:
                changed[:, c] = values[:, c] * self.factor
        return changed

    def applied(self, run: Signals) -> Signals:
        """Return a run without the fault."""
        measured = self.measured(run.measured)
        if not self.of_wheels:
            return replace(run, measured=measured)
        wheel_speed = run.wheel_speed_mps.copy()
        if self.kind is FaultKind.SWAPPED:
            wheel_speed[:, self.pair] = wheel_speed[:, self.pair[::-1]]
        elif self.wheel >= 0:
            wheel_speed[:, self.wheel] *= self.factor
        else:
            wheel_speed *= self.factor
        return replace(run, measured=measured, wheel_speed_mps=wheel_speed)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a column in some runs.

    Parameters
    ----------
    kind : what is wrong
    column : with what
    run_ids : of the runs that have it
    factor : by which its samples are to be multiplied, 1 for an exchange and an offset; NaN where it is left
        out, since readings of it cannot be distinguished
    sentence : what is wrong, how that is seen, and what to do
    repair : what to do alone
    change : that makes the log right
    """

    kind: FaultKind
    column: Column
    run_ids: tuple[str, ...]
    factor: float
    sentence: str
    repair: str
    change: Change

    def measured(self, values: Array) -> Array:
        """Return measured channels (n, channels) without the fault, NaN in those that are left out."""
        if not np.isnan(self.factor):
            return self.change.measured(values)
        left = values.copy()
        left[:, list(CHANNELS_OF[self.column])] = np.nan
        return left


def repaired(signals: Sequence[Signals], faults: Sequence[Fault]) -> tuple[Signals, ...]:
    """Return runs without faults, in the same order: changed, or left out where it is not clear how."""
    fixed = list(signals)
    for fault in faults:
        ids = set(fault.run_ids)
        fixed = [without(fault, run) if run.run_id in ids else run for run in fixed]
    return tuple(fixed)


def without(fault: Fault, run: Signals) -> Signals:
    """Return a run without a fault, or without its channel where it is not clear how it should be."""
    if np.isnan(fault.factor):
        return replace(run, measured=fault.measured(run.measured))
    return fault.change.applied(run)


def session_of(run_id: str) -> str:
    """Return the session of a run: its id without the number at its end.

    Examples
    --------
    >>> session_of("gravel_1_step_012"), session_of("SNOW_07"), session_of("step_012")
    ('gravel_1', 'SNOW', '')
    """
    return re.sub(r"[\W_]*(?:step|run)?[\W_]*\d+$", "", run_id)


def in_runs(ids: Sequence[str], every: Sequence[str]) -> str:
    """Return which runs in words: all, those of a session, or by name.

    Examples
    --------
    >>> in_runs(["a_1", "a_2"], ["a_1", "a_2", "b_1"])
    'in all 2 runs of a'
    >>> in_runs(["a_1", "b_1"], ["a_1", "b_1"]), in_runs(["a_1"], ["a_1", "a_2"])
    ('in all 2 runs', 'in 1 of 2 runs (a_1)')
    """
    sessions = list(dict.fromkeys(session_of(run_id) for run_id in ids))
    whole = [run_id for run_id in every if session_of(run_id) in sessions]
    if len(ids) == len(every):
        named = f" of {sessions[0]}" if len(sessions) == 1 and sessions[0] else ""
        return f"in all {len(ids)} runs{named}"
    if len(whole) == len(ids) and all(sessions) and len(sessions) <= 3:
        return f"in all {len(ids)} runs of {' and '.join(sessions)}"
    shown = ", ".join(ids[:5]) + (", ..." if len(ids) > 5 else "")
    return f"in {len(ids)} of {len(every)} runs ({shown})"
