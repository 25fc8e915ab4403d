"""Forward and turning speed of a tracked vehicle are held by compensating the estimated slip of its tracks.

Tazzari et al. leave it as future work to use their observer with a controller, in indirect adaptive control.
Of (5), with efficiencies n of the tracks and the desired speeds V and Omega::

    v_R = (V + d Omega) / n_R        v_L = (V - d Omega) / n_L

An estimate is used as far as it is known: with its standard deviation s and the spread p of efficiencies
about 1, the efficiency used is ``1 + (n^ - 1) p^2 / (p^2 + s^2)``, the weighted mean.  It stays above
a floor and changes at a limited rate, so that an estimate that jumps does not jerk the tracks.  Both tracks
are slowed by one factor where either would be too fast: the curvature ``Omega / V`` is kept.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, types

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots.tracked import TrackedRobot
from terrain.status import StatusCode


class TrackSpeedStatus(StatusCode):
    """Whether the desired speeds are held: yes, up to a limit, or not, and why."""

    OK = 0
    SATURATED = 1
    """Both tracks are slowed: the desired speeds are faster than a track can be."""
    FLOORED = 2
    """An efficiency is below the floor: the desired speeds are not reached."""
    UNESTIMATED = 3
    """An estimate is absent: its efficiency goes back to 1."""
    BAD_INPUT = 4
    """Desired speeds or time are not numbers that can be: the tracks are stopped."""


@dataclass(frozen=True)
class TrackSpeedSettings:
    """Limits of the compensation.

    Parameters
    ----------
    track_speed_max_mps : of a track's circumference
    eta_floor_ratio : least efficiency that is compensated
    eta_spread_ratio : standard deviation of efficiencies about 1 before anything is known
    eta_rate_ps : largest change of a compensated efficiency in a second
    """

    track_speed_max_mps: float = 1.5
    eta_floor_ratio: float = 0.3
    eta_spread_ratio: float = 0.2
    eta_rate_ps: float = 0.2


class TrackSpeedCommand(NamedTuple):
    """Speeds of the tracks, the efficiencies that were compensated, and why.

    Parameters
    ----------
    left_mps, right_mps : circumferential speeds
    eta : (2,) of the left and the right track; the next step takes it
    status : number of a :class:`TrackSpeedStatus`
    """

    left_mps: float
    right_mps: float
    eta: Array
    status: int


_FASTEST = 1e6  # in m/s and rad/s, of what can be desired
_LONGEST_S = 0.5  # a longer step changes the efficiency by no more than this one
_F8, _ROW = types.float64, types.Array(types.float64, 1, "A", readonly=True)
_COMMAND = types.NamedTuple((_F8, _F8, _F8[::1], types.int64), TrackSpeedCommand)

DEFAULT_SETTINGS = TrackSpeedSettings()


def track_speed_params(robot: TrackedRobot, settings: TrackSpeedSettings = DEFAULT_SETTINGS) -> Array:
    """Return the parameters (5,) of :func:`track_speed_step`.

    Raises
    ------
    ConfigError
        if a limit is not above zero and finite, or the floor above 1.
    """
    limits = asdict(settings)
    for name, value in limits.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name} is {value:g}, a finite number above zero is required")
    if settings.eta_floor_ratio > 1:
        raise ConfigError(f"eta_floor_ratio is {settings.eta_floor_ratio:g}, at most 1 is accepted")
    return np.array([*limits.values(), robot.half_track_m])


@njit(_COMMAND(_ROW, _ROW, _F8, _F8, _ROW, _ROW, _F8), cache=True)
def track_speed_step(
    params: Array, eta_used: Array, forward_mps: float, turn_radps: float, eta: Array, std: Array, dt_s: float
) -> TrackSpeedCommand:
    """Return the speeds of the tracks that give the desired motion; compiled, its arguments are not changed.

    Parameters
    ----------
    params : of :func:`track_speed_params`
    eta_used : (2,) what was compensated in the step before; ones at first
    forward_mps, turn_radps : desired V and Omega
    eta, std : (2,) estimated efficiencies of the left and the right track, and their standard deviations; NaN
        where there is no estimate
    dt_s : since the step before

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> params, eta = track_speed_params(load_robot("orchard_ugv")), np.array([1.1, 0.8])
    >>> command = track_speed_step(params, eta, 0.5, 0.1, eta, np.array([0.0, 0.0]), 0.02)
    >>> round(command.left_mps, 4), round(command.right_mps, 4), TrackSpeedStatus(command.status).name
    (0.4091, 0.6875, 'OK')
    """
    used = np.empty(2)
    used[0], used[1] = eta_used[0], eta_used[1]
    desired = abs(forward_mps) <= _FASTEST and abs(turn_radps) <= _FASTEST
    if not (desired and 0.0 <= dt_s < math.inf):
        return TrackSpeedCommand(0.0, 0.0, used, TrackSpeedStatus.BAD_INPUT.value)
    most, floor, spread, half_track = params[0], params[1], params[2], params[4]
    change = params[3] * min(dt_s, _LONGEST_S)
    status = TrackSpeedStatus.OK.value
    for j in range(2):
        aim = 1.0
        if math.isfinite(eta[j]) and 0.0 <= std[j] < math.inf:
            aim += (eta[j] - 1.0) / (1.0 + (std[j] / spread) ** 2)
            if aim < floor and status != TrackSpeedStatus.UNESTIMATED.value:
                status = TrackSpeedStatus.FLOORED.value
        else:
            status = TrackSpeedStatus.UNESTIMATED.value
        if not floor <= used[j] < math.inf:
            used[j] = 1.0
        used[j] += min(max(max(aim, floor) - used[j], -change), change)
    left = (forward_mps - half_track * turn_radps) / used[0]
    right = (forward_mps + half_track * turn_radps) / used[1]
    fastest = max(abs(left), abs(right))
    if fastest > most:
        left, right, status = (
            left * (most / fastest),
            right * (most / fastest),
            TrackSpeedStatus.SATURATED.value,
        )
    return TrackSpeedCommand(left, right, used, status)
