"""Values of named causes that one simulation has for all runs.

While causes are searched, a parameter that differs from run to run has a deviation of its own in each, and
the fit is the mean over runs.  A simulation has one value, and the best one is that which leaves the least
square over all of them: runs count by how much they show of it.  The two agree where runs are alike.

With the information ``A_i`` of each run without such deviations, and their variances ``D``, the covariance of
that fit is ``A^-1 B A^-1``, ``A = sum A_i``, ``B = sum (A_i + A_i D A_i)``.
"""

from __future__ import annotations

import numpy as np

from terrain.discrepancy.evidence import Statistics, recentre
from terrain.discrepancy.fitting import Problem
from terrain.discrepancy.search import Found
from terrain.discrepancy.selection import fit_change
from terrain.effects import INDEX

SCATTERS_RATIO = 1.5
"""A parameter whose scatter is estimated to be so many times what was assumed is fitted anew."""

N_STEPS = 4
"""Gauss-Newton steps from the mean over runs: more than linear problems need, and these are nearly so."""


def pooled(problem: Problem, found: Found) -> Found:
    """Return what was found with the values that leave the least square over all runs."""
    scatter = dict(found.info.statistics.scatter)
    assumed = problem.simulation.scatter
    scatter = {name: std for name, std in scatter.items() if name in assumed}
    own = [n for n in found.names if n in scatter and scatter[n] > SCATTERS_RATIO * assumed[n]]
    if not own and not problem.varying:
        return found
    problem = problem._replace(varying={})
    statistics = Statistics(found.info.noise, scatter | {name: assumed[name] for name in own})
    base = problem.simulation.vector
    point, change = found.info.origin, found.change
    for _ in range(N_STEPS):
        info = recentre(problem.at(point, found.names, statistics), base)
        change = fit_change(info, found.names)[0]
        point = base.copy()
        for name, value in zip(found.names, change, strict=True):
            point[INDEX[name]] += value
    at, mine = info.places(found.names), [found.names.index(name) for name in own]
    a = info.a[:, at][:, :, at]
    more = np.diag([scatter[name] ** 2 - assumed[name] ** 2 for name in own])
    b = a.sum(axis=0) + np.einsum("nip,pq,njq->ij", a[:, :, mine], more, a[:, :, mine])
    inverse = np.linalg.pinv(a.sum(axis=0), hermitian=True)
    return found._replace(change=change, cov=inverse @ b @ inverse)
