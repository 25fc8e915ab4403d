"""A path to desired twists, for the pilot of a robot of any drive: a speed, and the yaw rate that leads to the path.

With the deviations y and theta~ from a path of curvature c, a desired offset y_d and ``a = 1 - c y``, the curvature to
drive is that of the law for car-like robots without sideslip (Deremetz et al., ICRA 2017, (17))::

    A = -K_p (y - y_d) - K_d a tan theta~ + c a tan^2 theta~
    k = c cos theta~ / a + A cos^3 theta~ / a^2

so that y converges over distance, ``y'' + K_d y' + K_p y = 0``.  The twist is ``(v, 0, v k)``.  What drives it is the
kinematics of the drive; that slip keeps a robot from neither is the pilot's part.  The speed is bounded by the yaw rate
of a bend, and by a deceleration before a stop and the end.  The robot stands where it does not know where it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.control.paths import PathStatus, Place, ReferencePath
from terrain.control.pid import LONGEST_STEP_S
from terrain.records import Array

ACROSS_RAD = 1.3  #: Angle beyond which a robot counts as driving across its path.
LEAST_BESIDE = 0.2  #: Least a.
LOST_STOP_S = 3.0  #: Longer without a pose the robot stops.


class FollowSettings(NamedTuple):
    """Gains and limits; the loop is critically damped, and at 1 m/s three times slower than that of the yaw rate."""

    position_pm2: float = 0.49  #: K_p
    angle_pm: float = 1.4  #: K_d
    fastest_ps: float = 0.7  #: bandwidth above which both fall with the speed
    yaw_rate_radps: float = 1.0  #: largest in bends
    accel_mps2: float = 0.5  #: of the desired speed, up and down
    stand_s: float = 3.0  #: length of a stop


SETTINGS = FollowSettings()
_CREEP_MPS, _NEAR_M = 0.1, 0.05  # towards a stop; distance at which it is reached


def curvature_to_path(
    position_pm2: float, angle_pm: float, off_m: float, lateral_m: float, angle_rad: float, curvature: float
) -> float:
    """Return the curvature to drive, ``off_m`` from the desired offset.

    Examples
    --------
    >>> curvature_to_path(0.49, 1.4, 0.0, 0.0, 0.0, 0.1), curvature_to_path(0.49, 1.4, 0.1, 0.1, 0.0, 0.0)
    (0.1, -0.049)
    """
    gamma = min(max(angle_rad, -ACROSS_RAD), ACROSS_RAD)
    beside = max(1.0 - curvature * lateral_m, LEAST_BESIDE)
    tangent, cos = math.tan(gamma), math.cos(gamma)
    pull = -position_pm2 * off_m - angle_pm * beside * tangent
    pull += curvature * beside * tangent * tangent
    return curvature * cos / beside + pull * (cos * cos * cos) / (beside * beside)


class PathFollower:
    """Twists along a path, from pose to pose.

    Parameters
    ----------
    path : in the frame of the poses
    speed_mps : desired
    offset_m : desired distance to the left of the path
    stops_m : rising distances at which to stop

    Attributes
    ----------
    places : where the robot was on the path, one a step
    """

    def __init__(
        self,
        path: ReferencePath,
        speed_mps: float,
        offset_m: float = 0.0,
        stops_m: Sequence[float] = (),
        settings: FollowSettings = SETTINGS,
    ) -> None:
        self._path, self._fastest_mps, self._offset_m, self._settings = path, speed_mps, offset_m, settings
        self._stops_m = [*stops_m, path.length_m]
        self._before_m, self._time_s, self._stood_s, self._lost_s = math.nan, math.nan, 0.0, 0.0
        self._speed_mps = self._curvature = 0.0
        self.places: list[Place] = []

    @property
    def finished(self) -> bool:
        """Whether the end was reached."""
        return not self._stops_m or bool(self.places and self.places[-1].status is PathStatus.END)

    def step(self, time_s: float, pose: Array) -> Array:
        """Return the twist (3,) to desire at a pose (3,), NaN where it is unknown."""
        settings, dt_s = self._settings, time_s - self._time_s
        dt_s = dt_s if 0.0 < dt_s <= LONGEST_STEP_S else 0.0
        self._time_s = time_s
        x_m, y_m, yaw_rad = pose.tolist()
        place = self._path.locate(x_m, y_m, yaw_rad, self._before_m)
        self.places.append(place)
        is_known = place.status not in (PathStatus.NO_POSE, PathStatus.FAR)
        self._lost_s = 0.0 if is_known else self._lost_s + dt_s
        if is_known:
            self._before_m = place.distance_m
            slower = settings.fastest_ps / max(self._speed_mps * math.sqrt(settings.position_pm2), 1e-9)
            slower, off_m = min(1.0, slower), place.lateral_m - self._offset_m
            gains = settings.position_pm2 * slower * slower, settings.angle_pm * slower
            self._curvature = curvature_to_path(
                *gains, off_m, place.lateral_m, place.angle_rad, place.curvature_pm
            )
        if self._lost_s > LOST_STOP_S or place.status is PathStatus.FAR or self.finished:
            self._speed_mps = 0.0
            return np.zeros(3)
        left_m = self._stops_m[0] - self._before_m
        if left_m < _NEAR_M and len(self._stops_m) > 1:
            self._stood_s, self._speed_mps = self._stood_s + dt_s, 0.0
            if self._stood_s >= settings.stand_s:
                self._stops_m.pop(0)
                self._stood_s = 0.0
            return np.zeros(3)
        bend_mps = settings.yaw_rate_radps / max(abs(self._curvature), 1e-9)
        brakes_mps = max(math.sqrt(2.0 * settings.accel_mps2 * max(left_m, 0.0)), _CREEP_MPS)
        rises_mps = self._speed_mps + settings.accel_mps2 * dt_s
        self._speed_mps = min(self._fastest_mps, bend_mps, brakes_mps, rises_mps)
        return np.array([self._speed_mps, 0.0, self._speed_mps * self._curvature])
