"""Slip of one tick: :func:`terrain.estimation.wheel_slip.wheel_slip`, live."""

from __future__ import annotations

import math

import numpy as np

from terrain.entry_point import entry_point
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.wheel_slip import STALE_AFTER_S, instant_slip, wheel_speed_scatter_mps
from terrain.records import Array
from terrain.robots import Robot

_instant_slip = entry_point(instant_slip)


class LiveSlip:
    """Slip by the state of a resident filter.

    Parameters
    ----------
    robot : swerve robot
    states : of the filter
    """

    def __init__(self, robot: Robot, states: tuple[str, ...]) -> None:
        named = [f"slip_speed_{i}_mps" for i in robot.wheels]
        steered = [f"steer_{i}_rad" for i in robot.wheels]
        named_states = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", *steered, *named)
        self._in_state = named[0] in states
        self._places = np.array([states.index(state) if state in states else -1 for state in named_states])
        self._positions_m = np.array(robot.wheel_positions_m)
        self._variance = wheel_speed_scatter_mps(robot) ** 2

    def at(self, resident: ResidentFilter, age_s: float, wheel_speed_mps: Array, unmeasured: Array) -> Array:
        """Return ratio and standard deviation (2, wheels); NaN where unknown.

        Parameters
        ----------
        resident : the filter, after the tick
        age_s : of the speed over ground
        wheel_speed_mps : (wheels,) measured
        unmeasured : (wheels,) of which rate or angle was not measured for too long
        """
        slip = np.empty((2, len(self._positions_m)))
        if math.isinf(age_s) or (age_s > STALE_AFTER_S and not self._in_state):
            slip[:] = np.nan
            return slip
        _instant_slip(
            resident.mean,
            resident.cov,
            self._positions_m,
            self._places,
            wheel_speed_mps,
            self._variance,
            slip,
        )
        if True in unmeasured.tolist():
            slip[:, unmeasured] = np.nan
        return slip
