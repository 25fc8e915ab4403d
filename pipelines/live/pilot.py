"""The whole chain from samples to wheel commands; :meth:`LivePilot.step` runs when a sample arrives.

::

    sample -> motion -> terrain -> target slip -> path tracking -> kinematics -> wheel speeds

Neither a tracking library nor a web server is imported; the simulator and the service on the robot call the
same object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.live.terrain_source import NoTerrain, TerrainSource, readable
from terrain.constants import GRAVITY_MPS2
from terrain.control.path_tracking import (
    PoseEstimate,
    TrackReport,
    TrackStatus,
    initial_tracking,
    track_step,
)
from terrain.control.pid import Gains
from terrain.control.slick import braking_by_slip
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.stability import check_stable
from terrain.control.switching import (
    NO_BELIEF,
    SWITCHING,
    SwitchSettings,
    TerrainBelief,
    approach,
    check_switching,
    update,
)
from terrain.control.tracking_settings import SETTINGS as TRACKING
from terrain.control.tracking_settings import TrackSettings, check_tracking
from terrain.control.traction_settings import SETTINGS, TractionSettings, TractionTarget
from terrain.control.wheel_controllers import (
    PERIOD_S,
    UNOBSERVED,
    RampController,
    ThesisController,
    TractionController,
    WheelController,
    WheelObserver,
    WheelRequest,
    estimate_age,
    step_or_period,
)
from terrain.errors import ConfigError
from terrain.estimation.live.estimator import LiveEstimate, LiveEstimator
from terrain.extension import correct_live
from terrain.kinematics.swerve import FAR_RAD, wheel_command_step
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Command, Sample
from terrain.robots import Robot, SwerveRobot, as_swerve
from terrain.slip import MIN_SPEED_MPS

CONTROLLERS = ("plain", "ramp", "thesis", "traction")
"""Commands of the kinematics; with a bounded rise of speed; the thesis' PID on each wheel; the controller of
:mod:`terrain.control.traction`."""

OPEN_LOOP = ("plain", "ramp")
"""Controllers that use no measurement."""

THESIS_GAINS = Gains(0.5, 0.5, 0.0, limit=2.0)
"""The thesis specifies none; these have a gain margin of 3 on the simulated robot (``check_stable``)."""

MARGIN_MAX_RATIO = 0.06
"""The difference of a table's targets in traction and in steady motion is the slip above the balance that
gives the working pull; up to this much is added to the measured balance.  A larger difference is that of a
table that aims for a peak."""

_ROLL, _PITCH = IMU_CHANNELS.index("roll_rad"), IMU_CHANNELS.index("pitch_rad")
_NOT_ESTIMATED = UNOBSERVED._replace(stale_s=math.nan)
_NOT_TRACKED = TrackReport(math.nan, math.nan, 0.0, TrackStatus.NO_POSE)


@dataclass(frozen=True, slots=True)
class PilotSettings:
    """Controller of a pilot and its settings.

    Parameters
    ----------
    controller : one of :data:`CONTROLLERS`
    ramp_mps2 : largest rise of the speed of the fastest wheel, of ``ramp``
    traction, switching : of ``traction``
    gains, form : of ``thesis``
    delay_s : from a sample to the wheel; the loops have to be stable with it
    track : with path tracking; not with ``plain`` and ``ramp``, which estimate no pose
    tracking : its settings
    """

    controller: str = "traction"
    ramp_mps2: float = 0.5
    traction: TractionSettings = SETTINGS
    switching: SwitchSettings = SWITCHING
    gains: Gains = THESIS_GAINS
    form: str = "normalised"
    delay_s: float = 0.05
    track: bool = False
    tracking: TrackSettings = TRACKING


class PilotStatus(NamedTuple):
    """Status of a step; its fields are the channels of the stream ``control``.

    Parameters
    ----------
    status_code : :class:`terrain.control.traction.TractionStatus`
    terrain_code : place of the current terrain in :attr:`LivePilot.terrains`; -1 where it is unknown
    probability_ratio : of the current terrain
    target_ratio, aimed_ratio : target slip, and the target with its floor
    balance_ratio : slip of steady motion
    slip_ratio, slip_std_ratio : largest slip of a wheel, and largest standard deviation
    stale_s : time since the speed over ground was measured last
    drive_state_code : :class:`terrain.control.power_state.DriveState`
    driven_mps, desired_mps : commanded and desired speed of the fastest wheel
    heading_error_rad, cross_track_m : of path tracking
    track_status_code : :class:`terrain.control.path_tracking.TrackStatus`
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


@dataclass(slots=True)
class _Memory:
    """State of a pilot between two steps."""

    steer_rad: Array
    tracking: Array
    time_s: float = math.nan
    belief: TerrainBelief = NO_BELIEF
    target_ratio: float = math.nan
    estimate: LiveEstimate | None = None
    tilt_rad: tuple[float, float] = (0.0, 0.0)


class LivePilot:
    """Drive a robot along its desired twists.

    Parameters
    ----------
    robot : a swerve robot with all sections
    table : target slips
    source : of the current terrain; without one it stays unknown
    settings : controller and its settings
    steer_rad : (3,) last command of the steering

    Raises
    ------
    ConfigError
        if the controller is unknown, a setting is not accepted, the table is another robot's, or the gains
        make the loop unstable in the robot's range of operation.

    Examples
    --------
    >>> from terrain.control.traction import TractionStatus
    >>> from terrain.robots import load_robot
    >>> pilot = LivePilot(load_robot("agrimaro"), load_slip_table())
    >>> command = pilot.step(Sample(0.0, np.array([0.5, 0.0, 0.0]), {}))  # nothing is known yet
    >>> command.wheel_radps, command.status["status_code"] == TractionStatus.NO_SLIP
    (array([0.1, 0.1, 0.1]), True)
    """

    def __init__(
        self,
        robot: Robot,
        table: SlipTable | None = None,
        source: TerrainSource | None = None,
        settings: PilotSettings = PilotSettings(),
        steer_rad: Array | None = None,
    ) -> None:
        table = load_slip_table() if table is None else table
        driven, correction = correct_live(check_pilot(robot, table, settings))
        self._table, self._settings, self._radius_m = table, settings, driven.wheel_radius_m
        self._source = NoTerrain() if source is None else source
        self._terrains = {terrain: index for index, terrain in enumerate(table.targets)}
        self._braking = {name: braking_by_slip(curve) for name, curve in table.curves.items()}
        self._positions_m = np.array(driven.wheel_positions_m)
        self._limits = (
            driven.wheel_radius_m,
            driven.equipment.motors.speed_max_radps,
            driven.equipment.steering.rate_max_radps,
        )
        self._controller = _wheel_controller(driven, settings)
        self._estimator: LiveEstimator | None = None
        if settings.controller not in OPEN_LOOP:
            self._estimator = LiveEstimator(driven, correction=correction)
            states = self._estimator.states
            self._observer = WheelObserver(driven, [states.index(f"steer_{i}_rad") for i in driven.wheels])
            if settings.track:
                self._tracking = check_tracking(driven, settings.tracking, settings.delay_s)
            pose = ("position_x_m", "position_y_m", "yaw_rad")
            self._pose_states = [states.index(state) for state in pose]
        steer = np.zeros(3) if steer_rad is None else np.array(steer_rad, dtype=np.float64)
        self._now = _Memory(steer, initial_tracking())

    @property
    def terrains(self) -> tuple[str, ...]:
        """Entries of the table, in the order of the status ``terrain_code``."""
        return tuple(self._terrains)

    def step(self, sample: Sample) -> Command:
        """Return the wheels' commands for a sample; whatever arrives, it does not raise.

        Parameters
        ----------
        sample : readings since the step before, and the desired twist

        Returns
        -------
        Command
            its ``status`` has the fields of :class:`PilotStatus`
        """
        now = self._now
        first = math.isnan(now.time_s) and math.isfinite(sample.time_s)
        dt_s = PERIOD_S if first else sample.time_s - now.time_s
        if math.isfinite(sample.time_s):
            now.time_s = sample.time_s
        self._estimate(sample)
        target = self._target(step_or_period(dt_s))
        twist, tracked = self._track(_finite_twist(sample.twist), sample.time_s, dt_s)
        admitted, wheel_radps, now.steer_rad = wheel_command_step(
            self._positions_m, *self._limits, step_or_period(dt_s), FAR_RAD, twist, now.steer_rad
        )
        desired_mps = float(np.abs(wheel_radps).max()) * self._radius_m
        observed = (
            _NOT_ESTIMATED if self._estimator is None else self._observer.observe(now.estimate, sample.time_s)
        )
        entry = self._table.lookup(now.belief.terrain)
        command_radps, done = self._controller.step(
            WheelRequest(wheel_radps, desired_mps, target, entry, observed, dt_s)
        )
        status = PilotStatus(
            float(done.status),
            float(self._terrains.get(now.belief.terrain, -1)),
            now.belief.probability,
            now.target_ratio,
            done.aimed_ratio,
            done.balance_ratio,
            done.slip_ratio,
            float(observed.wheels.slip_std.max()),
            observed.stale_s,
            float(done.drive_state),
            done.driven_mps,
            desired_mps,
            tracked.heading_error_rad,
            tracked.cross_track_m,
            float(tracked.status),
        )
        scale = done.driven_mps / desired_mps if desired_mps > 0.0 else 0.0
        return Command(command_radps, now.steer_rad, admitted * scale, status._asdict())

    def _estimate(self, sample: Sample) -> None:
        """Update the motion, the tilt, and the current terrain."""
        if self._estimator is None:
            return
        now = self._now
        estimates = self._estimator.step(sample.readings)
        if estimates:
            now.estimate = estimates[-1]
        imu = readable(sample.readings.get("imu"), len(IMU_CHANNELS))
        if imu is not None:
            roll, pitch = float(imu.values[-1, _ROLL]), float(imu.values[-1, _PITCH])
            if math.isfinite(roll) and math.isfinite(pitch):
                now.tilt_rad = roll, pitch
        before = now.belief.terrain
        for found in self._source.update(sample, estimates):
            if self._source.certain:
                now.belief = TerrainBelief(
                    found.terrain, found.probability, found.terrain, found.time_s, found.time_s
                )
            else:
                now.belief = update(
                    now.belief, found.time_s, found.terrain, found.probability, self._settings.switching
                )
        if now.belief.terrain != before:
            self._controller.forget_terrain()

    def _target(self, dt_s: float) -> TractionTarget:
        """Return the slips to aim for; the target moves to that of the terrain at a bounded rate."""
        now = self._now
        entry = self._table.lookup(now.belief.terrain)
        now.target_ratio = approach(
            now.target_ratio, entry["traction"].slip_ratio, self._settings.switching.rate_ratio, dt_s
        )
        braking = self._braking.get(entry["traction"].terrain)
        margin = min(entry["traction"].slip_ratio - entry["steady"].slip_ratio, MARGIN_MAX_RATIO)
        if braking is None:
            return TractionTarget(now.target_ratio, margin_ratio=margin)
        mps2 = max(braking.mps2 + _uphill_mps2(now.estimate, *now.tilt_rad), 0.0)
        return TractionTarget(now.target_ratio, braking.slip_ratio, mps2, margin)

    def _track(self, twist: Array, time_s: float, dt_s: float) -> tuple[Array, TrackReport]:
        """Return the twist that keeps the path, and how far the robot is from it."""
        now, seen = self._now, self._now.estimate
        if not self._settings.track or seen is None:
            return twist, _NOT_TRACKED
        x, y, yaw = self._pose_states
        mean = seen.mean
        pose = PoseEstimate(
            float(mean[x]), float(mean[y]), float(mean[yaw]), float(seen.std[yaw]), estimate_age(seen, time_s)
        )
        ground_twist = np.array([seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps])
        twist, now.tracking, report = track_step(
            self._tracking, now.tracking, twist, pose, ground_twist, dt_s
        )
        return twist, report


def check_pilot(robot: Robot, table: SlipTable, settings: PilotSettings) -> SwerveRobot:
    """Return a robot that can be driven.

    Raises
    ------
    ConfigError
        as :class:`LivePilot` does, apart from the settings of traction and tracking.
    """
    if settings.controller not in CONTROLLERS:
        raise ConfigError(
            f"controller {settings.controller!r} is unknown: use one of {', '.join(CONTROLLERS)}"
        )
    swerve = as_swerve(robot, "robot {name}: drive {drive!r} has no pilot, only 'swerve' has")
    if not (math.isfinite(settings.ramp_mps2) and settings.ramp_mps2 > 0):
        raise ConfigError(f"ramp_mps2 is {settings.ramp_mps2!r}, a number above zero is required")
    if table.robot and table.robot != robot.name:
        raise ConfigError(f"slip table {table.name}: is of the robot {table.robot!r}, not of {robot.name!r}")
    check_switching(settings.switching)
    if settings.track and settings.controller in OPEN_LOOP:
        raise ConfigError(f"controller {settings.controller!r} estimates no pose: it has no path tracking")
    if settings.controller == "thesis":
        check_stable(swerve, settings.gains, settings.form, settings.delay_s)
    return swerve


def _wheel_controller(robot: Robot, settings: PilotSettings) -> WheelController:
    traction = TractionController(robot, settings.traction)  # checks the settings for every controller
    if settings.controller == "traction":
        return traction
    if settings.controller == "thesis":
        return ThesisController(robot, settings.gains, settings.form, settings.traction.stale_max_s)
    return RampController(settings.ramp_mps2 if settings.controller == "ramp" else math.inf)


def _finite_twist(twist: Array) -> Array:
    """Return a desired twist (3,); zeros where it is none."""
    twist = np.asarray(twist, dtype=np.float64)
    return twist if twist.shape == (3,) and np.isfinite(twist).all() else np.zeros(3)


def _uphill_mps2(estimate: LiveEstimate | None, roll_rad: float, pitch_rad: float) -> float:
    """Return the deceleration by gravity along the motion: positive uphill, 0 at rest."""
    speed_mps = 0.0 if estimate is None else math.hypot(estimate.speed_x_mps, estimate.speed_y_mps)
    if estimate is None or not speed_mps > MIN_SPEED_MPS:
        return 0.0
    along, across = estimate.speed_x_mps / speed_mps, estimate.speed_y_mps / speed_mps
    return GRAVITY_MPS2 * (-math.sin(pitch_rad) * along + math.sin(roll_rad) * across)
