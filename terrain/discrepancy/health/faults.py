"""Faults of channels, found before any cause is searched.

A fault is a linear map of columns: a sign that is turned, columns that are exchanged, another unit, an offset.  The
right reading of logs is one under which every channel follows what the wheels predict, with a gain above zero, of a
size that robots and effects reach, without an offset that no bias has.  The simulation may be wrong: a fault is what
no effect of the catalogue does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from terrain.discrepancy.clocks import Latencies
from terrain.discrepancy.health.agreement import Agreement, agreement_of, on_own_clocks
from terrain.discrepancy.health.fault import (
    KINDS,
    Change,
    Column,
    Fault,
    FaultKind,
    FaultStatus,
    fault_of,
    session_of,
)
from terrain.discrepancy.health.offsets import drift_faults, drifting_zeros, offset_faults, scale_faults
from terrain.discrepancy.health.readings import Reading, reading_of, turned_fault
from terrain.discrepancy.health.samples import lost_samples
from terrain.discrepancy.health.units import unit_faults
from terrain.discrepancy.runs import LowPass, Rows, Signals, Simulation, rows_of
from terrain.robots import Robot

#: Signs and exchanges that are searched one after the other; logs with more are no logs of this robot.
MAX_FAULTS = 4
LOST = (FaultKind.DROPOUT, FaultKind.SATURATION)  #: Kinds of which samples are left out
SAME_END = 0.01  #: Relative difference of the two ends of a sensor's range.


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    latencies: Latencies,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets, scales.

    ``rows`` are those of the runs by the simulation, ``latencies`` the lags of their channels.
    """
    logs, robot = list(rows), simulation.robot
    runs = [
        run if math.isfinite(run.place) else replace(run, place=float(k)) for k, run in enumerate(signals)
    ]
    ids, faults = [run.run_id for run in rows], []
    sessions = [run.session or session_of(run.run_id) for run in signals]

    def without(change: Change, i: int) -> Rows:
        """Return the rows of a run after a change; one of the wheels is simulated again."""
        if not change.of_wheels and not change.of_samples:
            return logs[i]._replace(measured=change.measured(logs[i].measured))
        run = change.applied(runs[i])
        return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass)

    def repair(fault: Fault) -> None:
        is_changed = fault.status is not FaultStatus.NOT_CONFIRMED
        for i in (i for i, run_id in enumerate(ids) if run_id in fault.run_ids and is_changed):
            logs[i] = without(fault.change, i)
            runs[i] = fault.change.applied(runs[i])
        faults.append(fault)

    def responses() -> tuple[Rows, ...]:
        return on_own_clocks(logs, latencies)

    for fault in _lost_samples(runs, logs, ids, robot):
        repair(fault)
    for _ in range(MAX_FAULTS):
        before = agreement_of(aligned := responses(), robot.sideways)

        def tried(change: Change, places: Sequence[int], before: Agreement = before) -> Reading:
            """Return what a change makes of the runs at some places."""
            after = Agreement(*(each.copy() for each in before))
            own = agreement_of(on_own_clocks([without(change, i) for i in places], latencies), robot.sideways)
            for whole, part in zip(after, own, strict=True):
                whole[list(places)] = part
            return reading_of(change, before, after)

        turned = turned_fault(before, tried, aligned, sessions, robot)
        if turned is None:
            break
        repair(turned)
        if turned.status is FaultStatus.NOT_CONFIRMED:
            break
    for fault in unit_faults(responses(), sessions, robot):
        repair(fault)
    for fault in drifting_zeros(responses(), robot):
        repair(fault)
    for fault in offset_faults(responses(), sessions, robot):
        repair(fault)
    lost = {fault.change.column for fault in faults if fault.change.kind in LOST}
    # what is left of a gyro at the end of its range are its small rates, in part
    for fault in () if lost & {Column.GYRO, Column.HEADING} else scale_faults(responses(), sessions, robot):
        repair(fault)
    return (*faults, *drift_faults(responses(), sessions, robot))


def _lost_samples(
    signals: Sequence[Signals], rows: Sequence[Rows], ids: Sequence[str], robot: Robot
) -> tuple[Fault, ...]:
    """Return the columns that hold a value, or are clipped, in some runs: these samples are left out."""
    seconds: dict[Change, dict[int, float]] = {}
    ends: dict[Change, list[float]] = {}
    columns = {c: column for column, kind in KINDS.items() for c in kind.channels}
    for i, (run, beside) in enumerate(zip(signals, rows, strict=True)):
        for lost in lost_samples(run, beside):
            kind = FaultKind.SATURATION if lost.is_clipped else FaultKind.DROPOUT
            change = Change(kind, columns[lost.channel], math.nan)
            of_runs = seconds.setdefault(change, {})
            of_runs[i] = max(of_runs.get(i, 0.0), lost.seconds)
            ends.setdefault(change, []).append(abs(lost.value))
    for change in [each for each in seconds if each.kind is FaultKind.SATURATION]:
        held = change._replace(kind=FaultKind.DROPOUT)
        n_runs, is_one_end = len(seconds[change]), np.ptp(ends[change]) <= SAME_END * max(ends[change])
        if not is_one_end or (
            n_runs == 1 < len(seconds.get(held, {}))
        ):  # a sensor's range has one end in all runs
            of_runs = seconds.pop(change)
            seconds[held] = of_runs | seconds.get(held, {})
    return tuple(
        fault_of(change, [*of], ids, f": for {np.median([*of.values()]):.1f} s of a run", robot)
        for change, of in seconds.items()
    )
