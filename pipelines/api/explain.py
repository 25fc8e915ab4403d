"""What a simulation gets wrong about measured runs, in Python."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pipelines.explain.explain import explain_runs
from terrain.records import RunLog
from terrain.robots import Robot

if TYPE_CHECKING:
    from pipelines.explain.explanation import ExplainResult

__all__ = ["explain"]


def explain(runs: Iterable[RunLog], robot: Robot | str, **options: Any) -> ExplainResult:
    """Return what the simulation of a robot gets wrong about its runs, and the extended robot.

    Parameters
    ----------
    runs, robot, options : as :func:`pipelines.explain.explain.explain_runs`

    Returns
    -------
    ExplainResult
        with ``report``, ``extended`` (the robot with the named causes built in; as it was where none was named)
        and ``to_pandas()``
    """
    found = explain_runs(list(runs), robot, **options)
    return replace(found, extended=found.extended or found.robot)
