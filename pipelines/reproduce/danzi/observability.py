"""Observability of the states of a filter when a robot drives straight ahead."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.estimation.estimate import THESIS_SAMPLE_TIME_S
from terrain.estimation.filters.swerve import make_filter
from terrain.records import Array
from terrain.robots import Robot

SPEED_MPS, SLIP_RATIO = 0.875, 0.125
"""Speed over ground and slip at which the observability matrix is formed: wheels at 1 m/s."""


class ObservableStates(NamedTuple):
    """Number of independent states that are observable, and of all states but the position."""

    observable: int
    total: int


def straight_line_rank(name: str, robot: Robot, as_printed: bool = False) -> ObservableStates:
    """Return how many independent states of a filter are observable when driving straight ahead.

    It is the rank of the local observability matrix: the Jacobian H of the measurements times the
    product of the Jacobians F of the steps up to each of n samples, n being the number of states.

    Parameters
    ----------
    name : of a filter of a swerve robot
    robot : the robot
    as_printed : with rows 4 and 5 of (4.28), -w v_y and w v_x, in place of the accelerations

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> straight_line_rank("slip14", load_robot("agrimaro"), as_printed=True)
    ObservableStates(observable=9, total=12)
    """
    model = make_filter(name, robot)
    n = len(model.states)
    x, params = np.zeros(n), np.append(model.params, np.zeros(len(model.inputs)))
    x[model.states.index("speed_x_mps")] = SPEED_MPS
    x[[state.startswith("slip_") for state in model.states]] = SLIP_RATIO
    since_start, blocks = np.eye(n), []
    for _ in range(n):
        expected, h = np.zeros(len(model.rows)), np.zeros((len(model.rows), n))
        model.observe(x, params, expected, h)
        if as_printed:
            h[3:5] = _printed_acceleration_rows(model.states, x)
        blocks.append(h @ since_start)
        after, f = np.zeros(n), np.zeros((n, n))
        model.propagate(x, THESIS_SAMPLE_TIME_S, params, after, f)
        since_start, x = f @ since_start, after
    return ObservableStates(int(np.linalg.matrix_rank(np.vstack(blocks))), n - len(model.positions))


def _printed_acceleration_rows(states: tuple[str, ...], x: Array) -> Array:
    """Return the Jacobian (2, n) of -w v_y and w v_x."""
    speed_x, speed_y, yaw_rate = (
        states.index(name) for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    )
    h = np.zeros((2, len(states)))
    h[0, speed_y], h[0, yaw_rate] = -x[yaw_rate], -x[speed_y]
    h[1, speed_x], h[1, yaw_rate] = x[yaw_rate], x[speed_x]
    return h
