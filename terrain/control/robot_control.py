"""Commands of a swerve robot from its desired twist, what is estimated of its motion, and the believed terrain.

::

    twist -> path tracking -> kinematics -> wheel controller, with the slips that the terrain's entry aims for

Braking by controlled slip is aimed for where it stops a robot sooner than locked wheels.  On terrain that
shears, thrust rises with slip up to the locked wheel: nothing stops sooner.  On hard terrain it falls again
beyond a peak.  Slip is controlled in braking where it falls by more than the controller loses while slip
builds up, and where friction is so small that wheels lock at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.actuation import Actuation
from terrain.control.path_tracking import SETTINGS as TRACKING
from terrain.control.path_tracking import (
    TrackReport,
    TrackSettings,
    TrackState,
    TrackStatus,
    check_tracking,
    track_step,
)
from terrain.control.pid import Gains
from terrain.control.slip_table import CurveEntry, SlipTable
from terrain.control.stability import check_stable
from terrain.control.switching import (
    SWITCHING,
    OutputStatus,
    SwitchSettings,
    TerrainBelief,
    approach,
    check_switching,
    drive_on,
)
from terrain.control.traction import SETTINGS as TRACTION
from terrain.control.traction import TractionSettings, TractionStatus, TractionTarget
from terrain.control.wheel_controllers import (
    UNOBSERVED,
    WheelController,
    estimate_age,
    largest_forward,
    observe_wheels,
    step_or_period,
)
from terrain.errors import ConfigError
from terrain.estimation.health import SENSORS, SLIP_SENSORS, SOUND, Health
from terrain.estimation.live import LiveEstimate
from terrain.kinematics.commands import FAR_RAD, wheel_command_step
from terrain.logs.schema import IMU_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Command, Reading
from terrain.robots import Robot, SwerveRobot, as_drive
from terrain.slip import MIN_SPEED_MPS

CONTROLLERS = ("plain", "ramp", "thesis", "traction")
"""Commands of the kinematics; with a bounded rise of speed; the thesis' PID on each wheel; the controller of
:mod:`terrain.control.traction`."""

OPEN_LOOP = ("plain", "ramp")
"""Controllers that use no measurement."""

THESIS_GAINS = Gains(0.5, 0.5, 0.0, limit=2.0)
"""The thesis specifies none; these have a gain margin of 3 on the simulated robot (``check_stable``)."""


@dataclass(frozen=True, slots=True)
class PilotSettings:
    """Controller of a pilot and its settings."""

    controller: str = "traction"  # one of :data:`CONTROLLERS`
    ramp_mps2: float = 0.5  # largest rise of the speed of the fastest wheel, of ``ramp``
    traction: TractionSettings = TRACTION
    switching: SwitchSettings = SWITCHING
    gains: Gains = THESIS_GAINS  # of ``thesis``
    delay_s: float = 0.05  # from a sample to the wheel; the loops have to be stable with it
    track: bool = False  # with path tracking; not with ``plain`` and ``ramp``, which estimate no pose
    tracking: TrackSettings = TRACKING
    follows: bool = True  # motors follow this pilot's commands, and are compared; not where a log is replayed


DEFAULT_SETTINGS = PilotSettings()


class PilotStatus(NamedTuple):
    """Status of a step; its fields are the channels of the stream ``control``."""

    status_code: float  # :class:`terrain.control.traction.TractionStatus`
    terrain_code: float  # place of the current terrain in the pilot's table; -1 where it is unknown
    probability_ratio: float  # of the current terrain
    target_ratio: float
    aimed_ratio: float  # the target with its floor
    balance_ratio: float  # slip of steady motion
    slip_ratio: float  # largest of a wheel
    slip_std_ratio: float  # largest standard deviation
    stale_s: float  # since the speed over ground was measured last
    drive_state_code: float  # :class:`terrain.control.pid.DriveState`
    driven_mps: float  # commanded speed of the fastest wheel
    desired_mps: float
    heading_error_rad: float  # of path tracking
    cross_track_m: float
    track_status_code: float  # :class:`terrain.control.path_tracking.TrackStatus`
    sensor_code: float  # place in :data:`terrain.estimation.health.SENSORS` of the least sound; -1 for none
    health_code: float  # its :class:`terrain.estimation.health.Health`
    output_code: float  # of the terrain source, :class:`terrain.control.switching.OutputStatus`


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
    if not 0.0 < settings.ramp_mps2 < math.inf:
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


SLICK_RATIO = 0.5
"""Thrust over load at the peak, up to which terrain counts as slick: with more, a robot stops from 1 m/s in
less than two tenths of a second, which is the response time of a slip controller."""

LOCKED_RATIO = 0.88
"""Thrust of a locked wheel over that at the peak, up to which slip is controlled: with 0.92 a controlled
stop came out longer in simulation, with 0.79 it was 7 to 22 % shorter."""

DECELERATION_RATIO = 0.9
"""Planned deceleration over that at the peak; with more, the slip would diverge from the peak."""


def braking_by_slip(curve: CurveEntry | None) -> tuple[float, float] | None:
    """Return slip of the peak and planned deceleration on level terrain; None where locked wheels stop as soon.

    Examples
    --------
    >>> braking_by_slip(None) is None
    True
    """
    if curve is None:
        return None
    slip = np.linspace(0.0, 1.0, 501)
    thrust = curve.thrust_ratio(slip)
    peak = int(thrust.argmax())
    if peak == len(slip) - 1 or thrust[peak] > SLICK_RATIO or thrust[-1] > LOCKED_RATIO * thrust[peak]:
        return None
    deceleration_mps2 = DECELERATION_RATIO * float(thrust[peak] + curve.resistance_ratio) * GRAVITY_MPS2
    return float(slip[peak]), deceleration_mps2


MARGIN_MAX_RATIO = 0.06
"""The difference of a table's targets in traction and in steady motion is the slip above the balance that
gives the working pull; up to this much is added to the measured balance.  A larger difference is that of a
table that aims for a peak."""


def traction_target(table: SlipTable, terrain: str) -> TractionTarget:
    """Return what a table aims for on a terrain, level, or its fallback where it has no entry.

    Examples
    --------
    >>> from terrain.control.slip_table import load_slip_table
    >>> table = load_slip_table()
    >>> traction_target(table, "mud") == traction_target(table, "")
    True
    """
    targets = table.lookup(terrain)
    traction = targets["traction"]
    margin = min(traction.slip_ratio - targets["steady"].slip_ratio, MARGIN_MAX_RATIO)
    braking = braking_by_slip(table.curves.get(traction.terrain)) or (0.0, 0.0)
    return TractionTarget(traction.slip_ratio, *braking, margin)


_ROLL, _PITCH = IMU_CHANNELS.index("roll_rad"), IMU_CHANNELS.index("pitch_rad")
_OF_SLIP = tuple(SENSORS.index(name) for name in SLIP_SENSORS)
# Order in which sensors are named, by health: one that steps or freezes takes others with it, which are lost.
_NAMED_FIRST = (0, 1, 2, 3, 4, 6, 7, 5)
_GYRO, _SEEN, _SEEN_YAW = (SENSORS.index(name) for name in ("gyro", "camera_speed", "camera_yaw"))
_NOT_ESTIMATED = UNOBSERVED._replace(stale_s=math.nan)
_NOT_TRACKED = TrackReport(math.nan, math.nan, 0.0, TrackStatus.NO_POSE)


class RobotControl:
    """Turns desired twists into commands of wheels and steering, step by step.

    Parameters
    ----------
    robot : corrected, with all sections
    table : target slips
    settings : as :func:`check_pilot` accepts them
    states : of the filter that estimates the motion; none for a controller that uses no measurement

    Attributes
    ----------
    health : of each sensor at the last step
    target_ratio : target slip in traction that is aimed for; NaN before the first step

    Raises
    ------
    ConfigError
        if a setting of traction or tracking is not accepted.
    """

    def __init__(
        self, robot: SwerveRobot, table: SlipTable, settings: PilotSettings, states: Sequence[str]
    ) -> None:
        self._robot, self._settings, self._estimates = robot, settings, bool(states)
        self._radius_m, self._positions_m = robot.wheel_radius_m, np.array(robot.wheel_positions_m)
        motors, steering = robot.equipment.motors, robot.equipment.steering
        self._limits = robot.wheel_radius_m, motors.speed_max_radps, steering.rate_max_radps
        self._controller = WheelController(
            settings.controller, robot, settings.ramp_mps2, settings.traction, settings.gains
        )
        if states:
            self._steer_states = np.array([states.index(f"steer_{i}_rad") for i in robot.wheels])
            self._pose_states = [states.index(state) for state in ("position_x_m", "position_y_m", "yaw_rad")]
            if settings.track:
                self._track_settings = check_tracking(robot, settings.tracking, settings.delay_s)
        self._actuation = Actuation(robot.wheel_radius_m / motors.reduction_ratio)
        self.use(table)
        # what a step leaves to the next
        self.health = [0] * len(SENSORS)
        self.steer_rad = np.zeros(3)
        self.target_ratio, self._tilt_rad, self._tracking = math.nan, (0.0, 0.0), TrackState()

    def use(self, table: SlipTable) -> None:
        """Aim for the targets of a table from now on."""
        self._table = table
        self._targets = {terrain: traction_target(table, terrain) for terrain in table.targets}
        self.terrains = {terrain: index for index, terrain in enumerate(table.targets)}

    def reset_terrain(self) -> None:
        """Drop what was learned of the terrain, as another one is believed."""
        self._controller.reset_terrain()

    def measured(
        self, time_s: float, dt_s: float, readings: dict[str, Reading], seen: LiveEstimate | None
    ) -> None:
        """Take what was measured, in the order of the schema, and the estimate before it.

        Rates of motors that do not follow their commands are not to be believed: they are replaced by NaN.
        """
        imu = readings.get("imu")
        if imu is not None and imu.values.shape[1] == len(IMU_CHANNELS) and len(imu.values):
            roll, pitch = float(imu.values[-1, _ROLL]), float(imu.values[-1, _PITCH])
            if math.isfinite(roll) and math.isfinite(pitch):
                self._tilt_rad = roll, pitch
        if not self._settings.follows:
            return
        wheels = readings.get("wheels")
        if wheels is not None and (not len(wheels.values) or wheels.values.shape[1] != len(WHEELS_CHANNELS)):
            wheels = None
        steer_rad = None if seen is None else seen.mean[self._steer_states]
        self._actuation.measured(time_s, step_or_period(dt_s), wheels, steer_rad)
        off = self._actuation.off[:3]
        if wheels is not None and off.any():
            values = wheels.values.copy()
            values[:, np.flatnonzero(off)] = math.nan
            readings["wheels"] = Reading(wheels.time_s, values)

    def step(
        self,
        time_s: float,
        dt_s: float,
        desired: Array,
        seen: LiveEstimate | None,
        belief: TerrainBelief,
        output: OutputStatus,
        *,
        holds: bool = False,
    ) -> tuple[Command, TerrainBelief]:
        """Return the command, and the belief after the time that is driven.

        Parameters
        ----------
        time_s, dt_s : of the step, and since the one before
        desired : (3,) twist
        seen : the estimate at this time; None before the first
        belief : in the terrain
        output : of its source in this step
        holds : the belief does not age
        """
        step_s = step_or_period(dt_s)
        sensor, health = self._judge(seen)
        target = self._target(belief.terrain, seen, step_s)
        twist, tracked = self._track(desired, seen, time_s, dt_s)
        admitted, wheel_radps, self.steer_rad = wheel_command_step(
            self._positions_m, *self._limits, step_s, FAR_RAD, twist, self.steer_rad
        )
        desired_mps = max(map(abs, wheel_radps.tolist())) * self._radius_m
        if not holds:
            belief = drive_on(belief, desired_mps, step_s, self._settings.switching)
        observed = _NOT_ESTIMATED
        if self._estimates:
            observed = observe_wheels(self._robot, self._steer_states, seen, time_s)
        sound = health <= SOUND
        slip_targets = self._table.lookup(belief.terrain)
        command_radps, done = self._controller.step(
            wheel_radps, observed if sound else UNOBSERVED, target, slip_targets, dt_s
        )
        status, slip_ratio = done.status, done.slip_ratio
        if not sound:
            status = status if status == TractionStatus.BAD_TIME else TractionStatus.UNSOUND
            slip_ratio = largest_forward(wheel_radps, observed.slip_ratio)
        self._actuation.commanded(command_radps * self._radius_m, self.steer_rad)
        figures = PilotStatus(
            float(status),
            float(self.terrains.get(belief.terrain, -1)),
            belief.probability,
            self.target_ratio,
            done.aimed_ratio,
            done.balance_ratio,
            slip_ratio,
            float(observed.slip_std.max()),
            observed.stale_s,
            float(done.drive_state),
            done.driven_mps,
            desired_mps,
            tracked.heading_error_rad,
            tracked.cross_track_m,
            float(tracked.status),
            float(sensor),
            float(health),
            float(output),
        )
        scale = done.driven_mps / desired_mps if desired_mps > 0.0 else 0.0
        return Command(command_radps, self.steer_rad, admitted * scale, figures._asdict()), belief

    def _judge(self, seen: LiveEstimate | None) -> tuple[int, int]:
        """Update the health of the sensors; return the place of the least sound, or -1, and its health."""
        if not self._estimates:
            return -1, Health.FRESH
        if seen is None:
            self.health = [int(Health.LOST)] * len(SENSORS)
            return 0, Health.LOST
        self.health = health = seen.health.tolist()
        for i in np.flatnonzero(self._actuation.off).tolist():
            if health[i] == Health.LOST or health[i] < Health.DISAGREES:  # it was taken from the filter
                health[i] = int(Health.DISAGREES)
        worst = max(health[i] for i in _OF_SLIP)
        if worst <= SOUND:
            return -1, worst
        place = max(_OF_SLIP, key=lambda i: _NAMED_FIRST[health[i]])
        return place, health[place]

    def _target(self, terrain: str, seen: LiveEstimate | None, dt_s: float) -> TractionTarget:
        """Return the slips to aim for; the target moves to that of the terrain at a bounded rate."""
        level = self._targets.get(terrain) or self._targets[self._table.fallback]
        rate_ratio = self._settings.switching.rate_ratio
        self.target_ratio = approach(self.target_ratio, level.traction_ratio, rate_ratio, dt_s)
        target = level._replace(traction_ratio=self.target_ratio)
        if target.braking_mps2 == 0.0:
            return target
        uphill = uphill_mps2(seen, *self._tilt_rad)
        return target._replace(braking_mps2=max(target.braking_mps2 + uphill, 0.0))

    def _track(
        self, twist: Array, seen: LiveEstimate | None, time_s: float, dt_s: float
    ) -> tuple[Array, TrackReport]:
        """Return the twist that keeps the path, and how far the robot is from it.

        A pose is built on where the heading is: with a lost camera it is until it is stale.
        """
        if not self._settings.track or seen is None:
            return twist, _NOT_TRACKED
        turns, seen_yaw, camera = (self.health[i] for i in (_GYRO, _SEEN_YAW, _SEEN))
        is_sound = min(turns, seen_yaw) <= SOUND and (camera <= SOUND or camera == Health.LOST)
        twist, self._tracking, report = track_step(
            self._track_settings,
            self._tracking,
            twist,
            seen.mean[self._pose_states],
            np.array([seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps]),
            float(seen.std[self._pose_states[2]]) if is_sound else math.inf,
            estimate_age(seen, time_s),
            dt_s,
        )
        return twist, report


def uphill_mps2(seen: LiveEstimate | None, roll_rad: float, pitch_rad: float) -> float:
    """Return the deceleration by gravity along the motion: positive uphill, 0 at rest."""
    speed_mps = 0.0 if seen is None else math.hypot(seen.speed_x_mps, seen.speed_y_mps)
    if seen is None or not speed_mps > MIN_SPEED_MPS:
        return 0.0
    along, across = seen.speed_x_mps / speed_mps, seen.speed_y_mps / speed_mps
    return GRAVITY_MPS2 * (-math.sin(pitch_rad) * along + math.sin(roll_rad) * across)
