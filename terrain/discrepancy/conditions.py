"""Conditions that differ from run to run, as the load or the moisture of the soil: what they may explain.

A quantity that is never below none, as a load, has a mean of ``sqrt(3)`` times its standard deviation where
it is spread evenly from none.  So where the values of single runs scatter by ``s``, a mean over runs of up to
``sqrt(3) s`` is what conditions explain, up to what they are known to make; the rest is news.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.fitting import Problem
from terrain.discrepancy.search import Found
from terrain.discrepancy.varying import run_scatter

MEAN_PER_SCATTER = math.sqrt(3.0)
"""Mean over standard deviation of what is spread evenly from none."""


def with_conditions(problem: Problem, info: Evidence) -> Problem:
    """Return the problem with the error that conditions make which differ between its runs.

    Parameters
    ----------
    problem : whose simulation has what conditions may make at the most
    info : of its runs
    """
    simulation = problem.simulation
    if not simulation.varied_error:
        return problem
    found = Found((), info, (), np.zeros(0), np.zeros((0, 0)), {}, {}, simulation.scatter)
    error = dict(simulation.model_error)
    for effect in problem.library:
        name = effect.parameters[0].name
        if name in simulation.varied_error:
            mean = min(MEAN_PER_SCATTER * run_scatter(found, name), simulation.varied_error[name])
            error[name] = math.hypot(error.get(name, 0.0), mean)
    return problem._replace(simulation=replace(simulation, model_error=error))
