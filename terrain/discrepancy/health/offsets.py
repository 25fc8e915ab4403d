"""Constant offsets of sensors that no bias of the catalogue reaches: sensors not zeroed, or turned."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.agreement import LEAST
from terrain.discrepancy.health.fault import KINDS, MIN_FAULTY_RATIO, Change, Fault, FaultKind, fault_of
from terrain.discrepancy.runs import Rows
from terrain.robots import Robot

OFFSET_SIGMAS = 4.0  #: An offset is over the largest by so many standard deviations.
MIN_ROWS = 10


def offset_faults(runs: Sequence[Rows], robot: Robot) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, in all runs or in some of them.

    It is what a channel measures where nothing is predicted; of one motion throughout, a gain looks the same.
    """
    faults = []
    for column, kind in KINDS.items():
        if not math.isfinite(kind.largest):
            continue
        c, value, std = kind.channels[0], *np.full((2, len(runs)), np.nan)
        for i, run in enumerate(runs):
            known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
            measured, predicted = run.measured[known, c], run.predicted[known, c]
            if known.sum() < MIN_ROWS:
                continue
            varies = np.std(predicted) > LEAST[c]
            if varies or not np.sqrt(np.mean(predicted**2)) > LEAST[c]:
                basis = np.column_stack([np.ones(measured.size), *([predicted] if varies else [])])
                fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
                n_independent = max(
                    measured.size * min(run.period_s, 1.0), 1.0
                )  # what is left changes within seconds
                spread = np.linalg.inv(basis.T @ basis / measured.size)[0, 0] / n_independent
                value[i], std[i] = fit[0], np.std(measured - basis @ fit) * np.sqrt(spread)
        has = np.flatnonzero(np.abs(value) > kind.largest + OFFSET_SIGMAS * std)
        if has.size >= max(MIN_FAULTY_RATIO * np.isfinite(value).sum(), 1):
            change = Change(FaultKind.OFFSET, column, offset=-float(np.median(value[has])))
            below = f", where a sensor's is below {kind.largest:g}"
            faults.append(fault_of(change, has.tolist(), [run.run_id for run in runs], below, robot))
    return tuple(faults)
