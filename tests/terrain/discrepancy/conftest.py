import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.trial import hidden_runs, simulation_of

from terrain.discrepancy.runs import low_pass_of, signals_of
from terrain.discrepancy.search import Problem, search
from terrain.effects import effect_named
from terrain.robots import load_robot


def hidden_in(hidden, robot="husky", n=6, duration_s=30.0, seed=1, **options):
    """Return runs that excite all effects, in which values are hidden: a mapping for all runs, or one a run."""
    drives = rich_drives(np.random.default_rng(seed), n, duration_s)
    return hidden_runs(load_robot(robot), drives, np.random.SeedSequence(seed), hidden, **options)


def problem_of(runs, library=None, simulation=None):
    """Return the problem of runs: names of effects that may be named, all by default."""
    simulation = simulation or simulation_of(load_robot(runs[0].robot))
    signals = tuple(signals_of(run, simulation.robot) for run in runs)
    effects = simulation.library if library is None else tuple(map(effect_named, library))
    return Problem(signals, simulation, low_pass_of(signals), effects)


def searched(problem, seeds=None):
    """Return the causes that the search finds."""
    return search(problem, problem.at(problem.simulation.vector), seeds)


@pytest.fixture(scope="module")
def without_next_drive():
    """No next drive is designed, which takes a fourth of the time of a diagnosis."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("terrain.discrepancy.diagnose.next_drive", lambda *_: None)
        yield


@pytest.fixture(scope="session")
def hide():
    return hidden_in


@pytest.fixture(scope="session")
def pose():
    """Return a function that poses the problem of runs."""
    return problem_of


@pytest.fixture(scope="session")
def solve():
    """Return a function that searches a problem."""
    return searched
