"""Faults of channels of all runs: signs, exchanged columns and units, before any cause is searched."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from terrain.discrepancy.clocks import Shift
from terrain.discrepancy.health.faults import Change, Fault, repaired
from terrain.discrepancy.health.offsets import offset_faults
from terrain.discrepancy.health.response import Response, responses_of
from terrain.discrepancy.health.signs import (
    Reading,
    best_reading,
    candidate_changes,
    is_suspect,
    reading_of,
    runs_with,
    sign_fault,
)
from terrain.discrepancy.health.units import unit_faults
from terrain.discrepancy.latencies import Latencies, latencies_of
from terrain.discrepancy.residuals import LowPass, Rows, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation

MAX_FAULTS = 4
"""Signs and exchanges that are searched one after the other; logs with more are no logs of this robot."""


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    shift: Shift | None = None,
    latencies: Latencies | None = None,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets.

    The simulation may be wrong: a fault is what no effect of the catalogue does.

    Parameters
    ----------
    signals, rows : of all runs, in the same order; the rows with the prediction of the simulation
    simulation, low_pass : of the rows
    shift, latencies : clocks of the runs where they are known already; from the runs otherwise
    """
    if latencies is None:
        latencies = latencies_of(signals, simulation)
    found: list[Fault] = []
    runs, now = tuple(signals), tuple(rows)
    responses = responses_of(now, latencies, shift)
    while len(found) < MAX_FAULTS:
        fault = _turned(runs, now, simulation, low_pass, shift, latencies, responses)
        if fault is None:
            break
        found.append(fault)
        now = _with_rows(runs, now, fault, simulation, low_pass)
        runs = repaired(runs, [fault])
        responses = responses_of(now, latencies, shift)
    units = unit_faults(responses, simulation.robot)
    for fault in units:
        now = _with_rows(runs, now, fault, simulation, low_pass)
        runs = repaired(runs, [fault])
    return (*found, *units, *offset_faults(responses_of(now, latencies, shift)))


def _turned(
    runs: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    shift: Shift | None,
    latencies: Latencies,
    responses: Sequence[Response],
) -> Fault | None:
    """Return the sign or exchange that mends most, or None if there is none."""
    suspects = [i for i, run in enumerate(responses) if is_suspect(run)]
    if not suspects:
        return None
    robot = simulation.robot

    def tried(change: Change, places: Iterable[int]) -> Reading:
        after = list(responses)
        for i in places:
            if change.of_wheels:
                changed = _simulated(change.applied(runs[i]), simulation, low_pass)
            else:
                changed = rows[i]._replace(measured=change.measured(rows[i].measured))
            own = None if shift is None else _of_run(shift, i)
            after[i] = responses_of([changed], latencies, own)[0]
        return reading_of(change, responses, after)

    found = best_reading([tried(change, suspects) for change in candidate_changes(robot)])
    if found is None:
        return None
    best = tried(found[0].change, range(len(runs)))
    has = runs_with(best, [run.run_id for run in runs], responses)
    return sign_fault(best, found[1], has, responses, robot)


def _of_run(shift: Shift, i: int) -> Shift:
    one = slice(i, i + 1)
    return Shift(shift.lag_s[one], shift.std_s[one], shift.rate, shift.lost[one])


def _simulated(run: Signals, simulation: Simulation, low_pass: LowPass) -> Rows:
    return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass)


def _with_rows(
    runs: Sequence[Signals],
    rows: Sequence[Rows],
    fault: Fault,
    simulation: Simulation,
    low_pass: LowPass,
) -> tuple[Rows, ...]:
    """Return the rows of repaired runs."""
    ids = set(fault.run_ids)
    return tuple(
        each
        if each.run_id not in ids
        else _simulated(fault.change.applied(run), simulation, low_pass)
        if fault.change.of_wheels
        else each._replace(measured=fault.measured(each.measured))
        for run, each in zip(runs, rows, strict=True)
    )
