"""Settings of a pilot, their checks, the controllers that it can have, and the status of its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from terrain.control.path_tracking import SETTINGS as TRACKING
from terrain.control.path_tracking import TrackSettings
from terrain.control.pid import Gains
from terrain.control.slip_table import SlipTable
from terrain.control.stability import check_stable
from terrain.control.switching import SWITCHING, SwitchSettings, check_switching
from terrain.control.traction import SETTINGS, TractionSettings
from terrain.control.wheel_controllers import (
    RampController,
    ThesisController,
    TractionController,
    WheelController,
)
from terrain.errors import ConfigError
from terrain.robots import Robot, SwerveRobot, as_drive

CONTROLLERS = ("plain", "ramp", "thesis", "traction")
"""Commands of the kinematics; with a bounded rise of speed; the thesis' PID on each wheel; the controller of
:mod:`terrain.control.traction`."""

OPEN_LOOP = ("plain", "ramp")
"""Controllers that use no measurement."""

THESIS_GAINS = Gains(0.5, 0.5, 0.0, limit=2.0)
"""The thesis specifies none; these have a gain margin of 3 on the simulated robot (``check_stable``)."""


@dataclass(frozen=True, slots=True)
class PilotSettings:
    """Controller of a pilot and its settings.

    Parameters
    ----------
    controller : one of :data:`CONTROLLERS`
    ramp_mps2 : largest rise of the speed of the fastest wheel, of ``ramp``
    traction, switching : of ``traction``
    gains : of ``thesis``
    delay_s : from a sample to the wheel; the loops have to be stable with it
    track : with path tracking; not with ``plain`` and ``ramp``, which estimate no pose
    tracking : its settings
    follows : wheels and steering are driven by this pilot's commands, and are compared with them; not where a
        log is replayed
    """

    controller: str = "traction"
    ramp_mps2: float = 0.5
    traction: TractionSettings = SETTINGS
    switching: SwitchSettings = SWITCHING
    gains: Gains = THESIS_GAINS
    delay_s: float = 0.05
    track: bool = False
    tracking: TrackSettings = TRACKING
    follows: bool = True


DEFAULT_SETTINGS = PilotSettings()


class PilotStatus(NamedTuple):
    """Status of a step; its fields are the channels of the stream ``control``.

    Parameters
    ----------
    status_code : :class:`terrain.control.traction.TractionStatus`
    terrain_code : place of the current terrain in the pilot's table; -1 where it is unknown
    probability_ratio : of the current terrain
    target_ratio, aimed_ratio : target slip, and the target with its floor
    balance_ratio : slip of steady motion
    slip_ratio, slip_std_ratio : largest slip of a wheel, and largest standard deviation
    stale_s : time since the speed over ground was measured last
    drive_state_code : :class:`terrain.control.danzi_pid.DriveState`
    driven_mps, desired_mps : commanded and desired speed of the fastest wheel
    heading_error_rad, cross_track_m : of path tracking
    track_status_code : :class:`terrain.control.path_tracking.TrackStatus`
    sensor_code : place in :data:`terrain.estimation.health.SENSORS` of the least sound; -1 for none
    health_code : its :class:`terrain.estimation.health.Health`
    output_code : of the terrain source in this step, :class:`terrain.control.switching.OutputStatus`
    """

    status_code: float
    terrain_code: float
    probability_ratio: float
    target_ratio: float
    aimed_ratio: float
    balance_ratio: float
    slip_ratio: float
    slip_std_ratio: float
    stale_s: float
    drive_state_code: float
    driven_mps: float
    desired_mps: float
    heading_error_rad: float
    cross_track_m: float
    track_status_code: float
    sensor_code: float
    health_code: float
    output_code: float


def check_pilot(robot: Robot, table: SlipTable, settings: PilotSettings) -> SwerveRobot:
    """Return a robot that can be driven.

    Raises
    ------
    ConfigError
        as a pilot does, apart from the settings of traction and tracking.
    """
    if settings.controller not in CONTROLLERS:
        raise ConfigError(
            f"controller {settings.controller!r} is unknown: use one of {', '.join(CONTROLLERS)}"
        )
    swerve = as_drive(SwerveRobot, robot, "robot {name}: drive {drive!r} has no pilot, only 'swerve' has")
    if not (math.isfinite(settings.ramp_mps2) and settings.ramp_mps2 > 0):
        raise ConfigError(f"ramp_mps2 is {settings.ramp_mps2!r}, a number above zero is required")
    check_table(table, robot.name)
    check_switching(settings.switching)
    if settings.track and settings.controller in OPEN_LOOP:
        raise ConfigError(f"controller {settings.controller!r} estimates no pose: it has no path tracking")
    if settings.controller == "thesis":
        check_stable(swerve, settings.gains, settings.delay_s)
    return swerve


def check_table(table: SlipTable, robot: str) -> None:
    """Raise ``ConfigError`` where a table is another robot's; a robot without a name may have any."""
    if robot and table.robot and table.robot != robot:
        raise ConfigError(f"slip table {table.name}: is of the robot {table.robot!r}, not of {robot!r}")


def wheel_controller(robot: Robot, settings: PilotSettings) -> WheelController:
    """Return the controller of the wheels that the settings name."""
    traction = TractionController(robot, settings.traction)  # checks the settings for every controller
    if settings.controller == "traction":
        return traction
    if settings.controller == "thesis":
        return ThesisController(robot, settings.gains, settings.traction.stale_max_s)
    return RampController(
        robot.wheel_radius_m, settings.ramp_mps2 if settings.controller == "ramp" else math.inf
    )
