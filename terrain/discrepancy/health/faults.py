"""Faults of channels, found before any cause is searched.

A fault is a linear map of columns: a sign that is turned, columns that are exchanged, another unit, an offset.  The
right reading of logs is one under which every channel follows what the wheels predict, with a gain above zero, of a
size that robots and effects reach, without an offset that no bias has.  The simulation may be wrong: a fault is what
no effect of the catalogue does.
"""

from __future__ import annotations

from collections.abc import Sequence

from terrain.discrepancy.clocks import Latencies
from terrain.discrepancy.health.agreement import Agreement, agreement_of, on_own_clocks
from terrain.discrepancy.health.fault import Change, Fault
from terrain.discrepancy.health.offsets import offset_faults
from terrain.discrepancy.health.readings import Reading, reading_of, turned_fault
from terrain.discrepancy.health.units import unit_faults
from terrain.discrepancy.runs import LowPass, Rows, Signals, Simulation, rows_of

#: Signs and exchanges that are searched one after the other; logs with more are no logs of this robot.
MAX_FAULTS = 4


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    latencies: Latencies,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets.

    ``rows`` are those of the runs by the simulation, ``latencies`` the lags of their channels.
    """
    runs, logs, robot = list(signals), list(rows), simulation.robot
    ids, faults = [run.run_id for run in rows], []

    def without(change: Change, i: int) -> Rows:
        """Return the rows of a run after a change; one of the wheels is simulated again."""
        if not change.of_wheels:
            return logs[i]._replace(measured=change.measured(logs[i].measured))
        run = change.applied(runs[i])
        return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass)

    def repair(fault: Fault) -> None:
        for i in (i for i, run_id in enumerate(ids) if run_id in fault.run_ids):
            logs[i] = without(fault.change, i)
            runs[i] = fault.change.applied(runs[i])
        faults.append(fault)

    def responses() -> tuple[Rows, ...]:
        return on_own_clocks(logs, latencies)

    while len(faults) < MAX_FAULTS:
        before = agreement_of(responses())

        def tried(change: Change, places: Sequence[int], before: Agreement = before) -> Reading:
            """Return what a change makes of the runs at some places."""
            after = Agreement(*(each.copy() for each in before))
            own = agreement_of(on_own_clocks([without(change, i) for i in places], latencies))
            for whole, part in zip(after, own, strict=True):
                whole[list(places)] = part
            return reading_of(change, before, after)

        turned = turned_fault(before, tried, ids, robot)
        if turned is None:
            break
        repair(turned)
    for fault in unit_faults(responses(), robot):
        repair(fault)
    return (*faults, *offset_faults(responses(), robot))
