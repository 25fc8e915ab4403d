"""Logs of stalled runs: the wheels turn as in any run, the body hardly moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from terrain.discrepancy.trials.drives import Drives
from terrain.discrepancy.trials.hidden_effects import hidden_runs
from terrain.records import RunLog
from terrain.robots import Robot

STALLED_RATIO = (0.05, 0.15)
"""Range of the ratio of runs that are stalled; one at the least."""

CREEP_RATIO = (0.0, 0.03)
"""Range of the ratio of the wheels' motion that a stalled body follows."""

DRIVEN = ("wheels", "steering")
"""Streams that a stalled run has as if it were driven."""


def draw_stalled(rng: np.random.Generator, n_runs: int) -> tuple[int, ...]:
    """Return which runs are stalled, in order."""
    n = max(1, round(rng.uniform(*STALLED_RATIO) * n_runs))
    return tuple(sorted(rng.choice(n_runs, n, replace=False).tolist()))


def with_stalled(
    runs: Sequence[RunLog],
    stalled: Sequence[int],
    rng: np.random.Generator,
    robot: Robot,
    drives: Drives,
    seed: np.random.SeedSequence,
    effects: Mapping[str, float] | Sequence[Mapping[str, float]],
    *,
    heading: bool = False,
) -> tuple[RunLog, ...]:
    """Return runs of which some are stalled: all but the wheels' logger sees a body that creeps.

    Parameters
    ----------
    runs : as :func:`~terrain.discrepancy.trials.hidden_effects.hidden_runs` returns them
    stalled : places of the runs to be stalled
    rng : draws how far each body creeps
    robot, drives, seed, effects, heading : as the runs were simulated with
    """
    creep = np.ones(len(runs))
    creep[list(stalled)] = rng.uniform(*CREEP_RATIO, len(stalled))
    slow = drives._replace(twists=tuple(t * c for t, c in zip(drives.twists, creep, strict=True)))
    out = list(runs)
    seen = hidden_runs(robot, slow, seed, effects, heading=heading)
    for i in stalled:
        kept = {name: stream for name, stream in runs[i].streams.items() if name in DRIVEN}
        out[i] = replace(runs[i], streams={**seen[i].streams, **kept})
    return tuple(out)
