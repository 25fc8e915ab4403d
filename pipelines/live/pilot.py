"""The chain of a robot that is driven, from samples to wheel commands.

::

    sample -> motion -> terrain -> target slip -> path tracking -> kinematics -> wheel speeds

Neither a tracking library nor a web server is imported; the simulator and the service on the robot call the
same object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import itemgetter

import numpy as np

from pipelines.live.chain import Chain, CommandStatus, Step
from pipelines.live.terrain_source import TerrainSource
from terrain.constants import GRAVITY_MPS2
from terrain.control.actuation import Actuation
from terrain.control.aims import Aims
from terrain.control.path_tracking import (
    PoseEstimate,
    TrackReport,
    TrackStatus,
    initial_tracking,
    track_step,
)
from terrain.control.pilot_settings import (
    DEFAULT_SETTINGS,
    OPEN_LOOP,
    PilotSettings,
    PilotStatus,
    check_pilot,
    wheel_controller,
)
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import OutputStatus, approach, drive_on
from terrain.control.tracking_settings import check_tracking
from terrain.control.traction import TractionStatus
from terrain.control.traction_settings import TractionTarget
from terrain.control.wheel_controllers import (
    PERIOD_S,
    UNOBSERVED,
    WheelObserver,
    WheelRequest,
    estimate_age,
    step_or_period,
)
from terrain.entry_point import entry_point
from terrain.estimation.live.clocks import Clocks, numbers
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.estimator import CHANNELS, LiveEstimator
from terrain.estimation.live.health import SENSORS, SLIP_SENSORS, SOUND, Health
from terrain.extension import correct_live
from terrain.kinematics.swerve import FAR_RAD, wheel_command_step
from terrain.logs.schema import IMU_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot
from terrain.slip import MIN_SPEED_MPS

_ROLL, _PITCH = IMU_CHANNELS.index("roll_rad"), IMU_CHANNELS.index("pitch_rad")
_OF_SLIP = tuple(SENSORS.index(name) for name in SLIP_SENSORS)
_of_slip = itemgetter(*_OF_SLIP)
# Order in which sensors are named, by health: one that steps or freezes takes others with it, which are lost.
_BLAMED = (0, 1, 2, 3, 4, 6, 7, 5)
# as plain numbers, which compare in a tenth of the time
_SOUND, _DISAGREES, _LOST = int(SOUND), int(Health.DISAGREES), int(Health.LOST)
_GYRO, _SEEN, _SEEN_YAW = (SENSORS.index(name) for name in ("gyro", "camera_speed", "camera_yaw"))
_wheel_command_step = entry_point(wheel_command_step)
_FIGURES = PilotStatus._fields
_NOT_ESTIMATED = UNOBSERVED._replace(stale_s=math.nan)
_NOT_TRACKED = TrackReport(math.nan, math.nan, 0.0, TrackStatus.NO_POSE)


class LivePilot(Chain):
    """Drive a robot along its desired twists.

    Parameters
    ----------
    robot : a swerve robot with all sections
    table : target slips
    source : of the current terrain; without one it stays unknown
    settings : controller and its settings
    steer_rad : (3,) last command of the steering
    channels : of each stream, in the order of the columns of the samples that :meth:`take` is given; what is
        not among them is unknown.  Where the steering is measured, :meth:`take` begins with it where it stands

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
    >>> command.wheel_radps, command.status["status_code"] == TractionStatus.UNSOUND
    (array([0.1, 0.1, 0.1]), True)
    """

    name = "pilot"
    estimate: LiveEstimate | None
    _filter: LiveEstimator | None
    _clocks: Clocks

    def __init__(
        self,
        robot: Robot,
        table: SlipTable | None = None,
        source: TerrainSource | None = None,
        settings: PilotSettings = DEFAULT_SETTINGS,
        steer_rad: Array | None = None,
        channels: Mapping[str, Sequence[str]] = CHANNELS,
    ) -> None:
        table = load_slip_table() if table is None else table
        driven, correction = correct_live(check_pilot(robot, table, settings))
        super().__init__(robot.name, table, settings.switching, Clocks())
        self.source = TerrainSource() if source is None else source
        self._settings, self._radius_m = settings, driven.wheel_radius_m
        self._steering_zeros_rad = np.array(driven.steering_zeros_rad)
        self._positions_m = np.array(driven.wheel_positions_m)
        self._limits = (
            driven.wheel_radius_m,
            driven.equipment.motors.speed_max_radps,
            driven.equipment.steering.rate_max_radps,
        )
        self._controller = wheel_controller(driven, settings)
        if settings.controller not in OPEN_LOOP:
            self._filter = LiveEstimator(driven, correction=correction)
            states = self._filter.states
            self._steer_states = np.array([states.index(f"steer_{i}_rad") for i in driven.wheels])
            self._observer = WheelObserver(driven, self._steer_states)
            if settings.track:
                self._tracking_settings = check_tracking(driven, settings.tracking, settings.delay_s)
            pose = ("position_x_m", "position_y_m", "yaw_rad")
            self._pose_states = [states.index(state) for state in pose]
        self._actuation = Actuation(driven.wheel_radius_m / driven.equipment.motors.reduction_ratio)
        self._health = [0] * len(SENSORS)
        self._columns = schema_columns(channels)
        self._awaits_steering = "steering" in channels
        # what a step leaves to the next
        self._steer_rad = np.zeros(3) if steer_rad is None else np.array(steer_rad, dtype=np.float64)
        self._standing_rad = self._steer_rad  # of the last command that was finite
        self._time_s, self._tilt_rad, self._tracking = math.nan, (0.0, 0.0), initial_tracking()

    def _take_table(self, table: SlipTable) -> None:
        super()._take_table(table)
        self._aims = Aims(table)
        self._terrains = {terrain: index for index, terrain in enumerate(table.targets)}

    @property
    def terrains(self) -> tuple[str, ...]:
        """Entries of the table, in the order of the status ``terrain_code``."""
        return tuple(self._terrains)

    @property
    def target_ratio(self) -> float:
        """Target slip in traction that is aimed for; NaN before the first step."""
        return self._target_ratio

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last step, by name, as those of ``Health`` in small letters."""
        return {name: Health(status).name.lower() for name, status in zip(SENSORS, self._health, strict=True)}

    def start_steering(self, measured_rad: Array) -> Array:
        """Take measured angles (3,), zeros not subtracted, for the last command, before a step; return it."""
        self._steer_rad = measured_rad - self._steering_zeros_rad
        return self._steer_rad

    def take(self, sample: Sample) -> Step:
        """Return the command for a sample: to stand, where nothing is known yet or the step fails."""
        if math.isnan(sample.time_s) or not self._is_steered(sample.readings):
            return Step((), self._standing(), CommandStatus.NO_SAMPLES)
        readings = {
            name: reading._replace(values=ordered(reading.values, *self._columns[name]))
            for name, reading in sample.readings.items()
            if name in self._columns
        }
        try:
            command = self.step(sample._replace(readings=readings))
        except Exception as error:  # a robot without a command would go on with its last one
            failure = f"a step failed: {type(error).__name__}: {error}"
            return Step((), self._standing(), CommandStatus.FAILED, failure)
        windows, status = self.source.outputs, CommandStatus.OK
        numbers = (*command.wheel_radps.tolist(), *command.steer_rad.tolist(), *command.twist.tolist())
        if not all(map(math.isfinite, numbers)):
            command, status = self._standing()._replace(status=command.status), CommandStatus.NOT_FINITE
        self._standing_rad = command.steer_rad
        return Step(windows, command, status)

    def _is_steered(self, readings: Mapping[str, Reading]) -> bool:
        """Begin with the steering where it stands; return whether that is known, where it is measured."""
        if not self._awaits_steering:
            return True
        reading = readings.get("steering")
        if reading is None or not len(reading.values):
            return False
        measured_rad = ordered(reading.values, *self._columns["steering"])[-1]
        if not np.isfinite(measured_rad).all():
            return False
        self._standing_rad = self.start_steering(measured_rad)
        self._awaits_steering = False
        return True

    def _standing(self) -> Command:
        """Return the command to stand, steered as before."""
        status = {"status_code": float(TractionStatus.UNSOUND)}
        return Command(np.zeros(3), self._standing_rad, np.zeros(3), status)

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
        time_s, readings = self._clocks.step(
            getattr(sample, "time_s", None), getattr(sample, "readings", None)
        )
        dt_s = PERIOD_S if math.isnan(self._time_s) else time_s - self._time_s
        self._time_s = time_s
        step_s = step_or_period(dt_s)
        terrain = getattr(sample, "terrain", "")
        desired = finite_twist(getattr(sample, "twist", None))
        if self._filter is not None and self._settings.follows:
            self._compare(time_s, step_s, readings)
        output = self._estimate(
            Sample(time_s, desired, readings, terrain if isinstance(terrain, str) else "")
        )
        sensor, health = self._judge()
        target = self._target(step_s)
        twist, tracked = self._track(desired, time_s, dt_s)
        admitted, wheel_radps, self._steer_rad = _wheel_command_step(
            self._positions_m, *self._limits, step_s, FAR_RAD, twist, self._steer_rad
        )
        desired_mps = max(map(abs, wheel_radps.tolist())) * self._radius_m
        if not self.source.certain:
            self.belief = drive_on(self.belief, desired_mps, step_s, self.switching)
        observed = _NOT_ESTIMATED if self._filter is None else self._observer.observe(self.estimate, time_s)
        sound = health <= _SOUND
        request = WheelRequest(
            wheel_radps,
            desired_mps,
            target,
            self._aims[self.belief.terrain].entry,
            observed if sound else UNOBSERVED,
            dt_s,
        )
        command_radps, done = self._controller.step(request)
        status = done.status
        if not sound and status != TractionStatus.BAD_TIME:
            status = TractionStatus.UNSOUND
        self._actuation.commanded(command_radps * self._radius_m, self._steer_rad)
        figures = (
            float(status),
            float(self._terrains.get(self.belief.terrain, -1)),
            self.belief.probability,
            self._target_ratio,
            done.aimed_ratio,
            done.balance_ratio,
            done.slip_ratio if sound else largest_slip(observed.wheels.slip_ratio, wheel_radps),
            largest(observed.wheels.slip_std.tolist()),
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
        return Command(
            command_radps, self._steer_rad, admitted * scale, dict(zip(_FIGURES, figures, strict=True))
        )

    def _estimate(self, sample: Sample) -> OutputStatus:
        """Update the motion, the tilt, and the current terrain; return what the output of its source was."""
        if self._filter is None:
            return OutputStatus.NONE
        estimates = self._filter.step(sample.readings, sample.time_s)
        self.estimate = self._filter.at(sample.time_s)
        imu = sample.readings.get("imu")
        if imu is not None and imu.values.shape[1] == len(IMU_CHANNELS) and len(imu.values):
            roll, pitch = float(imu.values[-1, _ROLL]), float(imu.values[-1, _PITCH])
            if math.isfinite(roll) and math.isfinite(pitch):
                self._tilt_rad = roll, pitch
        before = self.belief.terrain
        output = self._believe(sample, estimates)
        if self.belief.terrain != before:
            self._controller.forget_terrain()
        return output

    def _compare(self, time_s: float, step_s: float, readings: dict[str, Reading]) -> None:
        """Compare wheels and steering with their commands; take away rates that are not to be believed."""
        wheels, seen = readings.get("wheels"), self.estimate
        if wheels is not None and (not len(wheels.values) or wheels.values.shape[1] != len(WHEELS_CHANNELS)):
            wheels = None
        steer_rad = None if seen is None else seen.mean[self._steer_states]
        self._actuation.measured(time_s, step_s, wheels, steer_rad)
        off = self._actuation.off.tolist()[:3]
        if wheels is not None and True in off:
            values = wheels.values.copy()
            values[:, np.flatnonzero(off)] = math.nan
            readings["wheels"] = Reading(wheels.time_s, values)

    def _judge(self) -> tuple[int, int]:
        """Update the health of the sensors; return the place of the least sound, or -1, and its health."""
        seen = self.estimate
        if self._filter is None:
            return -1, Health.FRESH
        if seen is None:
            self._health = [_LOST] * len(SENSORS)
            return 0, _LOST
        self._health = health = seen.health.tolist()
        all_off = self._actuation.off.tolist()
        if True in all_off:
            for i, off in enumerate(all_off):
                if off and (health[i] == _LOST or health[i] < _DISAGREES):  # it was taken from the filter
                    health[i] = _DISAGREES
        worst = max(_of_slip(health))
        if worst <= _SOUND:
            return -1, worst
        blamed = max(_OF_SLIP, key=lambda i: _BLAMED[health[i]])
        return blamed, health[blamed]

    def _target(self, dt_s: float) -> TractionTarget:
        """Return the slips to aim for; the target moves to that of the terrain at a bounded rate."""
        aim = self._aims[self.belief.terrain]
        self._target_ratio = approach(self._target_ratio, aim.slip_ratio, self.switching.rate_ratio, dt_s)
        braking = aim.braking
        if braking is None:
            return TractionTarget(self._target_ratio, margin_ratio=aim.margin_ratio)
        mps2 = max(braking.mps2 + uphill_mps2(self.estimate, *self._tilt_rad), 0.0)
        return TractionTarget(self._target_ratio, braking.slip_ratio, mps2, aim.margin_ratio)

    def _track(self, twist: Array, time_s: float, dt_s: float) -> tuple[Array, TrackReport]:
        """Return the twist that keeps the path, and how far the robot is from it."""
        seen = self.estimate
        if not self._settings.track or seen is None:
            return twist, _NOT_TRACKED
        x, y, yaw = self._pose_states
        mean = seen.mean
        yaw_std_rad = float(seen.std[yaw]) if pose_is_sound(self._health) else math.inf
        pose = PoseEstimate(
            float(mean[x]), float(mean[y]), float(mean[yaw]), yaw_std_rad, estimate_age(seen, time_s)
        )
        ground_twist = np.array([seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps])
        twist, self._tracking, report = track_step(
            self._tracking_settings, self._tracking, twist, pose, ground_twist, dt_s
        )
        return twist, report


def schema_columns(channels: Mapping[str, Sequence[str]]) -> dict[str, tuple[list[int], list[int], int]]:
    """Return which columns of each stream go where in the order of the schema, and how many that has."""
    found = {}
    for stream, names in CHANNELS.items():
        if stream in channels:
            places = [names.index(name) for name in channels[stream] if name in names]
            kept = [i for i, name in enumerate(channels[stream]) if name in names]
            found[stream] = kept, places, len(names)
    return found


def ordered(values: Array, kept: list[int], places: list[int], n_columns: int) -> Array:
    """Return columns in the order of the schema, NaN where a channel is not sent.

    Examples
    --------
    >>> ordered(np.array([[1.0, 2.0]]), [1], [0], 2).tolist()
    [[2.0, nan]]
    """
    if places == list(range(n_columns)) and kept == places and values.shape[1] == n_columns:
        return values
    found = np.full((len(values), n_columns), math.nan)
    found[:, places] = values[:, kept]
    return found


def pose_is_sound(health: list[int]) -> bool:
    """Say whether a pose can be built on: with a lost camera it is until it is stale."""
    turns, seen_yaw, seen = health[_GYRO], health[_SEEN_YAW], health[_SEEN]
    heading = turns <= _SOUND or seen_yaw <= _SOUND
    return heading and (seen <= _SOUND or seen == _LOST)


def finite_twist(given: object) -> Array:
    """Return a desired twist (3,); zeros where it is none."""
    twist = numbers(given)
    if twist is None or twist.shape != (3,) or not math.isfinite(sum(twist.tolist())):
        return np.zeros(3)
    return twist


def largest(values: list[float]) -> float:
    """Return the largest of some values; NaN where one is."""
    return math.nan if math.isnan(sum(values)) else max(values)


def largest_slip(slip_ratio: Array, wheel_radps: Array) -> float:
    """Return the largest slip of a wheel, positive in traction; NaN where it is not known."""
    return float(np.where(wheel_radps < 0.0, -slip_ratio, slip_ratio).max())


def uphill_mps2(estimate: LiveEstimate | None, roll_rad: float, pitch_rad: float) -> float:
    """Return the deceleration by gravity along the motion: positive uphill, 0 at rest."""
    speed_mps = 0.0 if estimate is None else math.hypot(estimate.speed_x_mps, estimate.speed_y_mps)
    if estimate is None or not speed_mps > MIN_SPEED_MPS:
        return 0.0
    along, across = estimate.speed_x_mps / speed_mps, estimate.speed_y_mps / speed_mps
    return GRAVITY_MPS2 * (-math.sin(pitch_rad) * along + math.sin(roll_rad) * across)
