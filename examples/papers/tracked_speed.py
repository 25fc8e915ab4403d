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

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import TrackedRobot
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
    status : whether the speeds are held
    """

    left_mps: float
    right_mps: float
    eta: Array
    status: TrackSpeedStatus


_FASTEST = 1e6  # in m/s and rad/s, of what can be desired
_LONGEST_S = 0.5  # a longer step changes the efficiency by no more than this one


def check_track_speed(settings: TrackSpeedSettings) -> TrackSpeedSettings:
    """Return settings that can be used.

    Raises
    ------
    ConfigError
        if a limit is not above zero and finite, or the floor above 1.
    """
    for name, value in asdict(settings).items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name} is {value:g}, a finite number above zero is required")
    if settings.eta_floor_ratio > 1:
        raise ConfigError(f"eta_floor_ratio is {settings.eta_floor_ratio:g}, at most 1 is accepted")
    return settings


def track_speed_step(
    robot: TrackedRobot,
    settings: TrackSpeedSettings,
    eta_used: Array,
    desired: tuple[float, float],
    eta: Array,
    std: Array,
    dt_s: float,
) -> TrackSpeedCommand:
    """Return the speeds of the tracks that give the desired motion.

    Parameters
    ----------
    robot, settings : whose tracks; accepted ones
    eta_used : (2,) what was compensated in the step before; ones at first
    desired : V in m/s and Omega in rad/s
    eta, std : (2,) estimated efficiencies of the left and the right track, and their standard deviations; NaN
        where there is no estimate
    dt_s : since the step before

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot, eta = load_robot("orchard_ugv"), np.array([1.1, 0.8])
    >>> command = track_speed_step(robot, TrackSpeedSettings(), eta, (0.5, 0.1), eta, np.zeros(2), 0.02)
    >>> round(command.left_mps, 4), round(command.right_mps, 4), command.status.name
    (0.4091, 0.6875, 'OK')
    """
    forward, turn = desired
    used = eta_used.tolist()
    if not (abs(forward) <= _FASTEST and abs(turn) <= _FASTEST and 0.0 <= dt_s < math.inf):
        return TrackSpeedCommand(0.0, 0.0, np.array(used), TrackSpeedStatus.BAD_INPUT)
    change = settings.eta_rate_ps * min(dt_s, _LONGEST_S)
    status = TrackSpeedStatus.OK
    for j, (known, uncertain) in enumerate(zip(eta.tolist(), std.tolist(), strict=True)):
        aim = 1.0
        if math.isfinite(known) and 0.0 <= uncertain < math.inf:
            share = uncertain / settings.eta_spread_ratio
            aim += (known - 1.0) / (1.0 + share * share)
            if aim < settings.eta_floor_ratio and status is not TrackSpeedStatus.UNESTIMATED:
                status = TrackSpeedStatus.FLOORED
        else:
            status = TrackSpeedStatus.UNESTIMATED
        if not settings.eta_floor_ratio <= used[j] < math.inf:
            used[j] = 1.0
        used[j] += min(max(max(aim, settings.eta_floor_ratio) - used[j], -change), change)
    left = (forward - robot.half_track_m * turn) / used[0]
    right = (forward + robot.half_track_m * turn) / used[1]
    fastest, most = max(abs(left), abs(right)), settings.track_speed_max_mps
    if fastest > most:
        left, right, status = left * (most / fastest), right * (most / fastest), TrackSpeedStatus.SATURATED
    return TrackSpeedCommand(left, right, np.array(used), status)
