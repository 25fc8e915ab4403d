"""Estimates of motion and slip, and target slips learned from them, in Python."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipelines.slip.estimate import Estimates, estimate_runs
from pipelines.slip.learn_slip import learn_slip_table
from pipelines.slip.table import LearnedSlipTable
from terrain.records import RunLog
from terrain.robots import Robot

__all__ = ["estimate", "learn_slip"]


def estimate(
    runs: Iterable[RunLog], robot: Robot | None = None, filter: Any = "skid", **options: Any
) -> Estimates:
    """Estimate motion and slip of runs by a filter, an observer or a pose from outside.

    Parameters
    ----------
    runs, robot, filter, options : as :func:`pipelines.slip.estimate.estimate_runs`

    Returns
    -------
    Estimates
        with ``runs`` (the logs and what was estimated of them), ``report`` and ``to_pandas()``
    """
    return estimate_runs(list(runs), robot, filter, **options)


def learn_slip(tracks: Estimates | Iterable[RunLog], robot: Robot, **options: Any) -> LearnedSlipTable:
    """Learn target slips by terrain from estimated runs.

    Parameters
    ----------
    tracks : what :func:`estimate` returned, or runs
    robot : whose they are
    options : as :func:`pipelines.slip.learn_slip.learn_slip_table`
    """
    runs = tracks.runs if isinstance(tracks, Estimates) else tracks
    return learn_slip_table(list(runs), robot, **options)
