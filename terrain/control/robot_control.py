"""Commands of a swerve robot from its desired twist, what is estimated of its motion, and the believed terrain.

::

    twist -> path tracking -> kinematics -> wheel controller, with the slips that the terrain's entry aims for
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.actuation import Actuation
from terrain.control.aims import Aims
from terrain.control.path_tracking import (
    PoseEstimate,
    TrackReport,
    TrackState,
    TrackStatus,
    check_tracking,
    track_step,
)
from terrain.control.pilot_settings import PilotSettings, PilotStatus, wheel_controller
from terrain.control.slip_table import SlipTable
from terrain.control.switching import OutputStatus, TerrainBelief, approach, drive_on
from terrain.control.traction import TractionStatus, TractionTarget
from terrain.control.wheel_controllers import (
    UNOBSERVED,
    WheelObserver,
    estimate_age,
    largest_forward,
    step_or_period,
)
from terrain.estimation.health import SENSORS, SLIP_SENSORS, SOUND, Health
from terrain.estimation.live import LiveEstimate
from terrain.kinematics.commands import FAR_RAD, wheel_command_step
from terrain.logs.schema import IMU_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Command, Reading
from terrain.robots import SwerveRobot
from terrain.slip import MIN_SPEED_MPS

_ROLL, _PITCH = IMU_CHANNELS.index("roll_rad"), IMU_CHANNELS.index("pitch_rad")
_OF_SLIP = tuple(SENSORS.index(name) for name in SLIP_SENSORS)
_of_slip = itemgetter(*_OF_SLIP)
# Order in which sensors are named, by health: one that steps or freezes takes others with it, which are lost.
_NAMED_FIRST = (0, 1, 2, 3, 4, 6, 7, 5)
# as plain numbers, which compare in a tenth of the time
_SOUND, _DISAGREES, _LOST = int(SOUND), int(Health.DISAGREES), int(Health.LOST)
_GYRO, _SEEN, _SEEN_YAW = (SENSORS.index(name) for name in ("gyro", "camera_speed", "camera_yaw"))
_NOT_ESTIMATED = UNOBSERVED._replace(stale_s=math.nan)
_NOT_TRACKED = TrackReport(math.nan, math.nan, 0.0, TrackStatus.NO_POSE)


class RobotControl:
    """Turns desired twists into commands of wheels and steering, step by step.

    Parameters
    ----------
    robot : corrected, with all sections
    table : target slips
    settings : accepted ones (:func:`~terrain.control.pilot_settings.check_pilot`)
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
        self,
        robot: SwerveRobot,
        table: SlipTable,
        settings: PilotSettings,
        states: Sequence[str],
    ) -> None:
        self._settings, self._estimates = settings, bool(states)
        self._radius_m, self._positions_m = robot.wheel_radius_m, np.array(robot.wheel_positions_m)
        motors, steering = robot.equipment.motors, robot.equipment.steering
        self._limits = robot.wheel_radius_m, motors.speed_max_radps, steering.rate_max_radps
        self._controller = wheel_controller(robot, settings)
        if states:
            self._steer_states = np.array([states.index(f"steer_{i}_rad") for i in robot.wheels])
            self._pose_states = [states.index(state) for state in ("position_x_m", "position_y_m", "yaw_rad")]
            self._observer = WheelObserver(robot, self._steer_states)
            if settings.track:
                self._tracking_settings = check_tracking(robot, settings.tracking, settings.delay_s)
        self._actuation = Actuation(robot.wheel_radius_m / motors.reduction_ratio)
        self.use(table)
        # what a step leaves to the next
        self.health = [0] * len(SENSORS)
        self.steer_rad = np.zeros(3)
        self.target_ratio, self._tilt_rad, self._tracking = math.nan, (0.0, 0.0), TrackState()

    def use(self, table: SlipTable) -> None:
        """Aim for the targets of a table from now on."""
        self._aims = Aims(table)
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
        off = self._actuation.off.tolist()[:3]
        if wheels is not None and True in off:
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
        observed = self._observer.observe(seen, time_s) if self._estimates else _NOT_ESTIMATED
        sound = health <= _SOUND
        slip_targets = self._aims[belief.terrain].slip_targets
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
            self.health = [_LOST] * len(SENSORS)
            return 0, _LOST
        self.health = health = seen.health.tolist()
        all_off = self._actuation.off.tolist()
        if True in all_off:
            for i, off in enumerate(all_off):
                if off and (health[i] == _LOST or health[i] < _DISAGREES):  # it was taken from the filter
                    health[i] = _DISAGREES
        worst = max(_of_slip(health))
        if worst <= _SOUND:
            return -1, worst
        place = max(_OF_SLIP, key=lambda i: _NAMED_FIRST[health[i]])
        return place, health[place]

    def _target(self, terrain: str, seen: LiveEstimate | None, dt_s: float) -> TractionTarget:
        """Return the slips to aim for; the target moves to that of the terrain at a bounded rate."""
        aim, rate_ratio = self._aims[terrain], self._settings.switching.rate_ratio
        self.target_ratio = approach(self.target_ratio, aim.level.traction_ratio, rate_ratio, dt_s)
        target = aim.level._replace(traction_ratio=self.target_ratio)
        if target.braking_mps2 == 0.0:
            return target
        return target._replace(
            braking_mps2=max(target.braking_mps2 + uphill_mps2(seen, *self._tilt_rad), 0.0)
        )

    def _track(
        self, twist: Array, seen: LiveEstimate | None, time_s: float, dt_s: float
    ) -> tuple[Array, TrackReport]:
        """Return the twist that keeps the path, and how far the robot is from it."""
        if not self._settings.track or seen is None:
            return twist, _NOT_TRACKED
        x, y, yaw = self._pose_states
        mean = seen.mean
        yaw_std_rad = float(seen.std[yaw]) if pose_is_sound(self.health) else math.inf
        pose = PoseEstimate(
            float(mean[x]), float(mean[y]), float(mean[yaw]), yaw_std_rad, estimate_age(seen, time_s)
        )
        ground_twist = np.array([seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps])
        twist, self._tracking, report = track_step(
            self._tracking_settings, self._tracking, twist, pose, ground_twist, dt_s
        )
        return twist, report


def pose_is_sound(health: list[int]) -> bool:
    """Say whether a pose can be built on: with a lost camera it is until it is stale."""
    turns, seen_yaw, seen = health[_GYRO], health[_SEEN_YAW], health[_SEEN]
    heading = turns <= _SOUND or seen_yaw <= _SOUND
    return heading and (seen <= _SOUND or seen == _LOST)


def uphill_mps2(seen: LiveEstimate | None, roll_rad: float, pitch_rad: float) -> float:
    """Return the deceleration by gravity along the motion: positive uphill, 0 at rest."""
    speed_mps = 0.0 if seen is None else math.hypot(seen.speed_x_mps, seen.speed_y_mps)
    if seen is None or not speed_mps > MIN_SPEED_MPS:
        return 0.0
    along, across = seen.speed_x_mps / speed_mps, seen.speed_y_mps / speed_mps
    return GRAVITY_MPS2 * (-math.sin(pitch_rad) * along + math.sin(roll_rad) * across)
