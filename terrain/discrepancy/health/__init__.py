"""Health of logs, before causes are searched: faults of channels with their repair, and unfit runs."""

from terrain.discrepancy.health.channels import faults_of
from terrain.discrepancy.health.faults import Column, Fault, FaultKind, repaired
from terrain.discrepancy.health.unfit import clocks_of, common_fit_cost, unfit_runs

__all__ = [
    "Column",
    "Fault",
    "FaultKind",
    "clocks_of",
    "common_fit_cost",
    "faults_of",
    "repaired",
    "unfit_runs",
]
