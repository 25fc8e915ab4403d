"""What is estimated live at one tick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.estimation.ekf.model import FilterModel
from terrain.records import Array


class LiveEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep.

    Parameters
    ----------
    time_s : stamp of the wheels
    mean, std : (d,) states and their standard deviations, in the order of :attr:`LiveEstimator.states`
    slip_ratio, slip_std : (3,) NaN where unknown or where the wheel stands
    slip_stale : whether the speed over ground was not measured lately
    reference_age_s : time since it was; infinite before the first time
    rows : (29,) what was measured, in the order of ``ROWS_OF_DRIVE["swerve"]``; NaN where nothing was
    speed_x_mps, speed_y_mps, yaw_rate_radps, accel_x_mps2, accel_y_mps2 : of the states, by name
    motor_radps, current_a : (3,) of this sample of the wheels; NaN where it gave none
    wheel_speed_mps : (3,) circumferential speeds of that sample
    health : (13,) of the sensors, as :class:`~terrain.estimation.live.health.Health`, in the order of
        :data:`~terrain.estimation.live.health.SENSORS`
    """

    time_s: float
    mean: Array
    std: Array
    slip_ratio: Array
    slip_std: Array
    slip_stale: bool
    reference_age_s: float
    rows: Array
    speed_x_mps: float
    speed_y_mps: float
    yaw_rate_radps: float
    accel_x_mps2: float
    accel_y_mps2: float
    motor_radps: Array
    current_a: Array
    wheel_speed_mps: Array
    health: Array


def predicted(
    seen: LiveEstimate, model: FilterModel, motion: list[int], now_s: float, longest_s: float
) -> LiveEstimate:
    """Return an estimate whose means are those of a later time.

    Parameters
    ----------
    seen : estimate
    model : of its filter
    motion : places of speeds, yaw rate and accelerations among the states
    now_s : time; one that is not later, or by more than ``longest_s``, changes nothing
    """
    if not 1e-3 < now_s - seen.time_s < longest_s:
        return seen
    d = len(model.states)
    mean, params = np.empty(d), np.append(model.params, np.zeros(len(model.inputs)))
    model.propagate(seen.mean, now_s - seen.time_s, params, mean, np.zeros((d, d)))
    v_x, v_y, turn, a_x, a_y = mean[motion].tolist()
    return seen._replace(
        mean=mean, speed_x_mps=v_x, speed_y_mps=v_y, yaw_rate_radps=turn, accel_x_mps2=a_x, accel_y_mps2=a_y
    )
