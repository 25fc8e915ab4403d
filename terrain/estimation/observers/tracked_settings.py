"""Settings of the adaptive observer of tracked vehicles, and their places in its parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import TrackedRobot

(
    HALF_TRACK,
    GAIN_X,
    GAIN_Y,
    GAIN_YAW,
    ADAPT_LEFT,
    ADAPT_RIGHT,
    NORMALISED,
    LEAST_SPEED,
    POSITION_STD,
    YAW_STD,
    ETA_STD,
    ETA_WALK,
    ETA_MAX,
    STANDING,
    SPEED_MAX,
    GATE,
    N_RESET,
    PREDICTED_AFTER,
    LONGEST_INTERVAL,
    LONGEST_STEP,
    WINDOW,
    GYRO,
) = range(22)
"""Places in the parameters (N_PARAMS,) of the observer's step."""

N_PARAMS = 22


@dataclass(frozen=True)
class TrackedSettings:
    """Gains, noise and limits; the defaults are the gains of the paper, both matrices the identity.

    Parameters
    ----------
    observation_gain_ps : l_1, l_2 and l_3 of (8), of position and heading
    adaptation_gain : lambda of (8), of the left and of the right track; not used where ``normalised``
    normalised : adaptation gain ``((M' L^-2 M) + regularisation)^-1 / 4``, critically damped at every speed
    least_speed_mps : of the regularisation: below about this speed of a track a normalised gain vanishes
    position_std_m, yaw_std_rad : of a fix, one axis
    eta_std_ratio : of a track's efficiency before anything is known, about 1
    eta_walk_ratio : random walk of an efficiency while the robot moves, per square root of a second
    eta_max_ratio : largest efficiency; the least is 0, see (4)
    standing_mps : a slower track stands
    speed_max_mps : a faster track is a wrong measurement
    gate_std : deviation of a fix, in standard deviations of two fixes' difference, that noise may explain
    n_reset : fixes rejected one after another after which the pose begins anew
    predicted_after_s : time without a fix after which the status says so
    longest_interval_s : between two fixes, for the later one to be compared with the earlier
    longest_step_s : between two ticks, for the travel between them to be known
    window_s : T of (14), the time constant with which excitation is forgotten
    gyro_std_radps : error of the gyro's rate that stays the same between two fixes
    """

    observation_gain_ps: tuple[float, float, float] = (1.0, 1.0, 1.0)
    adaptation_gain: tuple[float, float] = (1.0, 1.0)
    normalised: bool = False
    least_speed_mps: float = 0.05
    position_std_m: float = 0.02
    yaw_std_rad: float = math.radians(0.5)
    eta_std_ratio: float = 0.3
    eta_walk_ratio: float = 0.002
    eta_max_ratio: float = 2.0
    standing_mps: float = 0.02
    speed_max_mps: float = 10.0
    gate_std: float = 5.0
    n_reset: int = 10
    predicted_after_s: float = 0.5
    longest_interval_s: float = 2.0
    longest_step_s: float = 0.5
    window_s: float = 5.0
    gyro_std_radps: float = 0.002


def tracked_params(robot: TrackedRobot, settings: TrackedSettings) -> Array:
    """Return the parameters (N_PARAMS,) of the observer's step.

    Raises
    ------
    ConfigError
        if a setting is not above zero and finite; the walk may be 0.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.robots import as_drive, TrackedRobot
    >>> robot = as_drive(TrackedRobot, load_robot("orchard_ugv"), "{name} is {drive}")
    >>> tracked_params(robot, TrackedSettings())[:4]
    array([0.5, 1. , 1. , 1. ])
    >>> tracked_params(robot, TrackedSettings(standing_mps=0.0))
    Traceback (most recent call last):
    terrain.errors.ConfigError: standing_mps is 0, a finite number above zero is required
    """
    params = np.empty(N_PARAMS)
    params[HALF_TRACK] = robot.half_track_m
    params[NORMALISED] = settings.normalised
    for places, name in _PLACES:
        values = getattr(settings, name)
        values = values if isinstance(values, tuple) else (values,)
        if len(values) != len(places):
            raise ConfigError(f"{name} has {len(values)} numbers, {len(places)} are required")
        for place, value in zip(places, values, strict=True):
            if not 0 < value < math.inf and not (name == "eta_walk_ratio" and value == 0):
                raise ConfigError(f"{name} is {value:g}, a finite number above zero is required")
            params[place] = value
    return params


_PLACES: tuple[tuple[tuple[int, ...], str], ...] = (
    ((GAIN_X, GAIN_Y, GAIN_YAW), "observation_gain_ps"),
    ((ADAPT_LEFT, ADAPT_RIGHT), "adaptation_gain"),
    ((LEAST_SPEED,), "least_speed_mps"),
    ((POSITION_STD,), "position_std_m"),
    ((YAW_STD,), "yaw_std_rad"),
    ((ETA_STD,), "eta_std_ratio"),
    ((ETA_WALK,), "eta_walk_ratio"),
    ((ETA_MAX,), "eta_max_ratio"),
    ((STANDING,), "standing_mps"),
    ((SPEED_MAX,), "speed_max_mps"),
    ((GATE,), "gate_std"),
    ((N_RESET,), "n_reset"),
    ((PREDICTED_AFTER,), "predicted_after_s"),
    ((LONGEST_INTERVAL,), "longest_interval_s"),
    ((LONGEST_STEP,), "longest_step_s"),
    ((WINDOW,), "window_s"),
    ((GYRO,), "gyro_std_radps"),
)
