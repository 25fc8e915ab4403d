"""Support of a prediction: how many training runs drove its terrain as the robot drives now.

A classifier that saw a terrain only at one speed, or only straight on, has not seen it in a curve.  The
motion of a window is its speed and its yaw rate; a training run supports a terrain there if it drove that
terrain within about 0.2 m/s and 0.4 rad/s of it.  Runs count, not windows: windows of a run are alike.

Two questions must be kept apart.  *By true terrain*, which needs a label: how often are windows right whose
terrain was driven like this in n training runs?  *Without a label*, which a robot can ask: the supported
probability ``p n / (1 + n)`` of the predicted terrain, whose probability is p and which n runs support, is
low where the classifier doubts or where its answer rests on few runs; below one half the prediction is
marked unsupported.  ``n / (1 + n)`` is the rule of succession with no observation for the contrary.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.records import Array

SPEED_STEP_MPS, YAW_STEP_RADPS = 0.05, 0.1
"""Cells of motion."""

REACH = 3
"""A run supports the cells around those it drove, up to so many: about 0.2 m/s and 0.4 rad/s.  Chosen, with
``SUPPORTED``, on held-out runs of BorealTC and Vulpi dealt by seed 101; between 0.15 and 0.2 m/s, and 0.25
and 0.4 rad/s, the figures differ little."""

MAX_SPEED_CELLS, MAX_YAW_CELLS = 400, 64
"""What is faster counts as 20 m/s, and as 6.4 rad/s, so that a table stays small."""

SUPPORTED = 0.5
"""A prediction of a smaller supported probability is unsupported: rather wrong or unseen than right."""

ENOUGH_RUNS = 4
"""Of so many training runs near its motion a terrain counts as well supported."""


class SupportLevel(StrEnum):
    """How many training runs drove a terrain with the motion of a window."""

    NEVER = "never seen in training"
    FEW = f"1 to {ENOUGH_RUNS - 1} runs"
    ENOUGH = f"{ENOUGH_RUNS} runs and more"


class WindowSupport(NamedTuple):
    """Support of the predictions of n windows.

    Parameters
    ----------
    n_runs : (n,) training runs of the predicted terrain near the motion of the window
    probability : (n,) supported probability
    supported : (n,) whether that reaches :data:`SUPPORTED`
    """

    n_runs: Array
    probability: Array
    supported: Array


@dataclass(frozen=True, slots=True, eq=False)
class SupportTable:
    """Number of training runs of each terrain near each cell of speed and yaw rate.

    Parameters
    ----------
    classes : terrains, in order
    n_runs : (classes, speed cells, yaw cells); beyond the last cells there are none
    """

    classes: tuple[str, ...]
    n_runs: Array

    def near_runs(self, speed_mps: Array, yaw_rate_radps: Array) -> Array:
        """Return the training runs (n, classes) of each terrain near the motion of n windows.

        Parameters
        ----------
        speed_mps, yaw_rate_radps : (n,) magnitudes; a yaw rate that is not known, NaN, counts as zero, as it
            did in training
        """
        speed, yaw = motion_cells(speed_mps, yaw_rate_radps)
        _, n_speed, n_yaw = self.n_runs.shape
        inside = (speed < n_speed) & (yaw < n_yaw)
        found = self.n_runs[:, np.minimum(speed, n_speed - 1), np.minimum(yaw, n_yaw - 1)].T
        return np.asarray(np.where(inside[:, None], found, 0))


def check_support(table: SupportTable, classes: Sequence[str]) -> None:
    """Refuse a table that is not one of these classes.

    Raises
    ------
    DataError
        if its classes are others, or its numbers of runs are none.
    """
    if table.classes != tuple(classes):
        raise DataError("the table of support is of other classes")
    counts = np.asarray(table.n_runs)
    if counts.ndim != 3 or len(counts) != len(classes) or counts.dtype.kind not in "iu" or not counts.size:
        raise DataError(f"the table of support has the shape {counts.shape}, in numbers of {counts.dtype}")
    if counts.min() < 0:
        raise DataError("the table of support holds negative numbers of runs")


def motion_cells(speed_mps: Array, yaw_rate_radps: Array) -> tuple[Array, Array]:
    """Return the speed cell and the yaw cell (n,) of each window.

    Examples
    --------
    >>> [cell.tolist() for cell in motion_cells(np.array([0.0, 0.26]), np.array([np.nan, 0.35]))]
    [[0, 5], [0, 3]]
    """
    speed = np.floor(np.nan_to_num(speed_mps) / SPEED_STEP_MPS).astype(int)
    yaw = np.floor(np.nan_to_num(yaw_rate_radps) / YAW_STEP_RADPS).astype(int)
    return np.clip(speed, 0, MAX_SPEED_CELLS - 1), np.clip(yaw, 0, MAX_YAW_CELLS - 1)


def learn_support(
    speed_mps: Array, yaw_rate_radps: Array, terrain: Array, run_id: Array, classes: Sequence[str]
) -> SupportTable:
    """Count the training runs of each terrain near each cell of motion.

    Parameters
    ----------
    speed_mps, yaw_rate_radps, terrain, run_id : (n,) of training windows
    classes : terrains of the table

    Examples
    --------
    >>> speed, yaw = np.array([0.5, 0.52, 1.5]), np.zeros(3)
    >>> table = learn_support(speed, yaw, np.array(["ice"] * 3), np.array(["a", "b", "b"]), ["ice", "mud"])
    >>> table.near_runs(np.array([0.6, 1.0, 1.6]), np.zeros(3)).tolist()
    [[2, 0], [0, 0], [1, 0]]
    """
    speed, yaw = motion_cells(speed_mps, yaw_rate_radps)
    shape = int(speed.max(initial=0)) + REACH + 1, int(yaw.max(initial=0)) + REACH + 1
    counts = np.zeros((len(classes), *shape), dtype=int)
    for number, name in enumerate(classes):
        of_class = terrain == name
        for run in np.unique(run_id[of_class]):
            rows = np.flatnonzero(of_class & (run_id == run))
            near = np.zeros(shape, dtype=bool)
            for i, j in set(zip(speed[rows].tolist(), yaw[rows].tolist(), strict=True)):
                near[max(i - REACH, 0) : i + REACH + 1, max(j - REACH, 0) : j + REACH + 1] = True
            counts[number] += near
    return SupportTable(tuple(str(name) for name in classes), counts)


def support_of(probability: Array, near_runs: Array) -> WindowSupport:
    """Return the support of the most probable terrain of each window.

    Parameters
    ----------
    probability, near_runs : (n, k) of the same classes

    Examples
    --------
    >>> found = support_of(np.array([[0.9, 0.1], [0.9, 0.1], [0.4, 0.6]]), np.array([[4, 4], [0, 9], [9, 2]]))
    >>> found.n_runs.tolist(), found.probability.round(2).tolist(), found.supported.tolist()
    ([4, 0, 2], [0.72, 0.0, 0.4], [True, False, False])
    """
    rows, best = np.arange(len(probability)), probability.argmax(axis=1)
    n_runs = near_runs[rows, best]
    supported = probability[rows, best] * n_runs / (1.0 + n_runs)
    return WindowSupport(n_runs, supported, supported >= SUPPORTED)


def support_levels(n_runs: Array) -> Array:
    """Return the :class:`SupportLevel` of numbers of training runs, as texts of the same shape.

    Examples
    --------
    >>> support_levels(np.array([0, 2, 7])).tolist()
    ['never seen in training', '1 to 3 runs', '4 runs and more']
    """
    names = np.array([level.value for level in SupportLevel])
    return names[np.digitize(n_runs, [1, ENOUGH_RUNS])]
