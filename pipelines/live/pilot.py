"""The whole chain from samples to wheel commands: estimate, recognise, look up, correct.

One :meth:`LivePilot.step` takes what the sensors wrote since the last one and returns what the wheels are
told, with its reasons.  It imports neither a tracking library nor a web server; the simulator and the
service on the robot call the same object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pipelines.live.watch import Nobody, Watch, readable
from terrain.constants import GRAVITY_MPS2
from terrain.control.danzi_pid import new_state, thesis_settings, thesis_step
from terrain.control.path_tracking import (
    NO_POSE,
    TrackSettings,
    check_tracking,
    initial_tracking,
    track_step,
)
from terrain.control.path_tracking import SETTINGS as TRACKING
from terrain.control.pid import Gains
from terrain.control.slick import braking_by_slip
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.stability import check_stable
from terrain.control.switching import (
    NOTHING,
    SWITCHING,
    Belief,
    SwitchSettings,
    approach,
    check_switching,
    hear,
)
from terrain.control.traction import (
    BAD_TIME,
    MAX_STEP_S,
    NO_SLIP,
    OK,
    SETTINGS,
    STEADY,
    Ground,
    TractionSettings,
    check_settings,
    forget_ground,
    initial_state,
    traction_step,
    with_driver,
)
from terrain.errors import ConfigError
from terrain.estimation.live.estimator import LiveEstimate, LiveEstimator
from terrain.extension import correct_live
from terrain.kinematics.swerve import FAR_RAD, wheel_command_step
from terrain.kinematics.wheel_velocity import in_wheel_frame, point_velocity
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Command, Sample
from terrain.robots import Robot, as_swerve
from terrain.slip import MIN_SPEED_MPS

CONTROLLERS = ("plain", "ramp", "thesis", "traction")
"""As the kinematics commands; with a bounded rise of speed; the thesis' PID on each wheel; ours."""

THESIS_GAINS = Gains(0.5, 0.5, 0.0, limit=2.0)
"""The thesis prints none; these are stable threefold on the simulated robot (``check_stable``)."""

MARGIN_MAX_RATIO = 0.06
"""A table says by its targets of traction and of steady motion how much slip over the balance gives the pull
that is worked with; up to this much is added to the balance that is measured.  More is a table that aims for
a peak."""

PERIOD_S = 0.02
"""Of the loop; what is counted with where the clock gives no sense."""

_ROLL, _PITCH = IMU_CHANNELS.index("roll_rad"), IMU_CHANNELS.index("pitch_rad")


@dataclass(frozen=True, slots=True)
class PilotSettings:
    """How a pilot drives.

    Parameters
    ----------
    controller : one of :data:`CONTROLLERS`
    ramp_mps2 : rise of the speed of the fastest wheel, of ``ramp``
    traction, switching : of ``traction``
    gains, form : of ``thesis``
    delay_s : from a sample to the wheel; what gains have to be stable with
    track : hold heading and place to what the wanted twists add up to; not with ``plain`` and ``ramp``, which
        know neither
    tracking : of that
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


@dataclass(slots=True)
class _Memory:
    """All that a pilot carries from step to step."""

    steer: Array
    traction: Array
    thesis: Array
    tracking: Array
    time_s: float = math.nan
    driven_mps: float = 0.0
    wheel: Array = field(default_factory=lambda: np.zeros(3))
    belief: Belief = NOTHING
    target_ratio: float = math.nan
    estimate: LiveEstimate | None = None
    tilt_rad: tuple[float, float] = (0.0, 0.0)


class LivePilot:
    """Drive a robot through its wanted twists.

    Parameters
    ----------
    robot : a swerve robot with all sections
    table : target slips
    watch : who says what the ground is; nobody by default
    settings : how to drive
    steer_rad : (3,) where the steering was told to be last

    Raises
    ------
    ConfigError
        if the controller is unknown, a setting is none, the table is another robot's, or the gains make the
        loop unstable at the robot's limits.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> pilot = LivePilot(load_robot("agrimaro"), load_slip_table())
    >>> command = pilot.step(Sample(0.0, np.array([0.5, 0.0, 0.0]), {}))  # nothing is known yet
    >>> command.wheel_radps, command.status["status_code"] == NO_SLIP
    (array([0.1, 0.1, 0.1]), True)
    """

    def __init__(
        self,
        robot: Robot,
        table: SlipTable | None = None,
        watch: Watch | None = None,
        settings: PilotSettings = PilotSettings(),
        steer_rad: Array | None = None,
    ) -> None:
        if settings.controller not in CONTROLLERS:
            raise ConfigError(
                f"controller {settings.controller!r} is unknown: use one of {', '.join(CONTROLLERS)}"
            )
        robot = as_swerve(robot, "robot {name}: drive {drive!r} has no pilot, only 'swerve' has")
        if not (math.isfinite(settings.ramp_mps2) and settings.ramp_mps2 > 0):
            raise ConfigError(f"ramp_mps2 is {settings.ramp_mps2!r}, a number above zero is required")
        table = load_slip_table() if table is None else table
        if table.robot and table.robot != robot.name:
            raise ConfigError(
                f"slip table {table.name}: is of the robot {table.robot!r}, not of {robot.name!r}"
            )
        check_switching(settings.switching)
        if settings.track and settings.controller in ("plain", "ramp"):
            raise ConfigError(
                f"controller {settings.controller!r} knows no place: it cannot be held to a way"
            )
        if settings.controller == "thesis":
            check_stable(robot, settings.gains, settings.form, settings.delay_s)
        robot, correction = correct_live(robot)
        self._robot, self._table, self._settings = robot, table, settings
        self._watch = Nobody() if watch is None else watch
        self._terrains = {terrain: index for index, terrain in enumerate(table.targets)}
        self._braking = {name: braking_by_slip(curve) for name, curve in table.curves.items()}
        self._traction = with_driver(check_settings(settings.traction), robot)
        self._thesis = thesis_settings(robot.wheel_radius_m, settings.gains, settings.form)
        motors = robot.equipment.motors
        self._per_amp_nm = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
        self._positions_m = np.array(robot.wheel_positions_m)
        self._limits = (
            robot.wheel_radius_m,
            motors.speed_max_radps,
            robot.equipment.steering.rate_max_radps,
        )
        self._blind = settings.controller in ("plain", "ramp")
        self._estimator = None if self._blind else LiveEstimator(robot, correction=correction)
        if self._estimator is not None:
            if settings.track:
                self._tracking = check_tracking(robot, settings.tracking, settings.delay_s)
            pose = ("position_x_m", "position_y_m", "yaw_rad")
            self._place_states = [self._estimator.states.index(state) for state in pose]
            self._steer_states = [self._estimator.states.index(f"steer_{i}_rad") for i in robot.wheels]
        steer = np.zeros(3) if steer_rad is None else np.array(steer_rad, dtype=np.float64)
        self._now = _Memory(steer, initial_state(), new_state(), initial_tracking())

    @property
    def terrains(self) -> tuple[str, ...]:
        """Entries of the table, by the number that the status ``terrain_ratio`` gives; -1 is unknown."""
        return tuple(self._terrains)

    def step(self, sample: Sample) -> Command:
        """Take what arrived, and return what the wheels are told; nothing that arrives makes it raise.

        The ``status`` holds ``status_code`` (:data:`terrain.control.traction.STATUS_NAMES`),
        ``terrain_ratio`` and ``probability_ratio`` of the ground believed, ``target_ratio``, ``aimed_ratio``
        (the target with its floor), ``balance_ratio``, ``slip_ratio``, ``slip_std_ratio``, ``stale_s``,
        ``drive_state_ratio`` (place in ``slip_table.DRIVE_STATES``; -1 for not known), ``driven_mps`` and
        ``desired_mps``; and, with ``track``, ``off_heading_rad`` and ``cross_track_m`` of the reference, and
        ``track_ratio`` (:data:`terrain.control.path_tracking.STATUS_NAMES`).
        """
        now, robot = self._now, self._robot
        dt_s = sample.time_s - now.time_s
        first = math.isnan(now.time_s) and math.isfinite(sample.time_s)
        sound = first or 0.0 < dt_s <= MAX_STEP_S
        if math.isfinite(sample.time_s):
            now.time_s = sample.time_s
        known_dt_s = dt_s if sound and not first else PERIOD_S
        twist = np.asarray(sample.twist, dtype=np.float64)
        if twist.shape != (3,) or not np.isfinite(twist).all():
            twist = np.zeros(3)
        self._perceive(sample)
        target = self._target(known_dt_s)
        twist, off = self._hold(twist, sample.time_s, dt_s if not first else PERIOD_S)
        admitted, wheel, steer = wheel_command_step(
            self._positions_m, *self._limits, known_dt_s, FAR_RAD, twist, now.steer
        )
        now.steer = steer
        desired_mps = float(np.abs(wheel).max()) * robot.wheel_radius_m
        if self._blind:
            told, said = self._ramp(wheel, desired_mps, known_dt_s)
        else:
            told, said = self._correct(sample.time_s, wheel, target, dt_s if not first else PERIOD_S)
        status = {
            "status_code": said[5],
            "terrain_ratio": float(self._terrains.get(now.belief.terrain, -1)),
            "probability_ratio": now.belief.probability,
            "target_ratio": now.target_ratio,
            "aimed_ratio": said[1],
            "balance_ratio": said[2],
            "slip_ratio": said[3],
            "slip_std_ratio": said[6],
            "stale_s": said[7],
            "drive_state_ratio": said[4],
            "driven_mps": said[0],
            "desired_mps": desired_mps,
            "off_heading_rad": off[0],
            "cross_track_m": off[1],
            "track_ratio": off[2],
        }
        scale = said[0] / desired_mps if desired_mps > 0.0 else 0.0
        return Command(told, steer, admitted * scale, status)

    def _hold(self, twist: Array, time_s: float, dt_s: float) -> tuple[Array, tuple[float, float, float]]:
        """Return the twist that holds the way, and how far off it the robot is, and why nothing is held."""
        now, seen = self._now, self._now.estimate
        if not self._settings.track or self._estimator is None or seen is None:
            return twist, (math.nan, math.nan, float(NO_POSE))
        place, yaw = self._place_states[:2], self._place_states[2]
        held, now.tracking, said = track_step(
            self._tracking,
            now.tracking,
            twist,
            seen.mean[place],
            seen.mean[yaw],
            np.array([seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps]),
            seen.std[yaw],
            seen.reference_age_s + max(time_s - seen.time_s, 0.0),
            dt_s,
        )
        return held, (float(said[0]), float(said[1]), float(said[3]))

    def _perceive(self, sample: Sample) -> None:
        """Estimate, and hear what the ground is."""
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
        believed = now.belief.terrain
        for word in self._watch.hear(sample, estimates):
            if self._watch.sure:
                now.belief = Belief(word.terrain, word.probability, word.terrain, word.time_s, word.time_s)
            else:
                now.belief = hear(
                    now.belief, word.time_s, word.terrain, word.probability, self._settings.switching
                )
        if now.belief.terrain != believed:
            now.traction = forget_ground(now.traction)

    def _target(self, dt_s: float) -> Ground:
        """Return what is aimed for, on its way from what was aimed for on the ground before."""
        now = self._now
        entry = self._table.lookup(now.belief.terrain)
        now.target_ratio = approach(
            now.target_ratio, entry["traction"].slip_ratio, self._settings.switching.rate_ratio, dt_s
        )
        braking = self._braking.get(entry["traction"].terrain)
        margin = min(entry["traction"].slip_ratio - entry["steady"].slip_ratio, MARGIN_MAX_RATIO)
        if braking is None:
            return Ground(now.target_ratio, margin_ratio=margin)
        roll, pitch = now.tilt_rad
        way = now.estimate
        speed_mps = math.hypot(way.speed_x_mps, way.speed_y_mps) if way is not None else 0.0
        uphill_mps2 = 0.0
        if way is not None and speed_mps > MIN_SPEED_MPS:
            along, across = way.speed_x_mps / speed_mps, way.speed_y_mps / speed_mps
            uphill_mps2 = GRAVITY_MPS2 * (-math.sin(pitch) * along + math.sin(roll) * across)
        mps2 = max(braking.mps2 + uphill_mps2, 0.0)
        return Ground(now.target_ratio, braking.slip_ratio, mps2, margin)

    def _ramp(self, wheel: Array, desired_mps: float, dt_s: float) -> tuple[Array, tuple[float, ...]]:
        now = self._now
        rise = self._settings.ramp_mps2 * dt_s if self._settings.controller == "ramp" else math.inf
        before_mps = now.driven_mps if float(wheel @ now.wheel) >= 0.0 else 0.0
        now.wheel, now.driven_mps = wheel, min(desired_mps, before_mps + rise)
        nan = math.nan
        told = wheel * (now.driven_mps / desired_mps) if desired_mps > 0.0 else wheel
        return told, (now.driven_mps, nan, nan, nan, float(STEADY), float(OK), nan, nan)

    def _correct(
        self, time_s: float, wheel: Array, ground: Ground, dt_s: float
    ) -> tuple[Array, tuple[float, ...]]:
        now, robot = self._now, self._robot
        seen = now.estimate
        speed, gain, slip, std, torque = np.full((5, 3), math.nan)
        stale_s = math.inf
        if seen is not None:
            stale_s = seen.reference_age_s + max(time_s - seen.time_s, 0.0)
            steer = seen.mean[self._steer_states]
            cos, sin = np.cos(steer), np.sin(steer)
            x, y = self._positions_m.T
            forward, left = point_velocity(seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps, x, y)
            speed, _ = in_wheel_frame(forward, left, cos, sin)
            gain = seen.accel_x_mps2 * cos + seen.accel_y_mps2 * sin
            fastest = np.maximum(np.abs(seen.wheel_speed_mps), np.abs(speed))
            # a wheel stands by the filter's rate, which is not quite the reported one
            standing = fastest < np.where(np.isnan(seen.slip_ratio), 2.0, 1.0) * MIN_SPEED_MPS
            slip = np.where(standing & ~math.isinf(stale_s), 0.0, seen.slip_ratio)
            std = np.where(standing, 0.0, seen.slip_std)
            torque = seen.current_a * self._per_amp_nm
        if self._settings.controller == "thesis":
            return self._thesis_correct(wheel, speed, gain, slip, std, stale_s, dt_s)
        told, now.traction, said = traction_step(
            self._traction,
            now.traction,
            ground,
            robot.wheel_radius_m,
            wheel,
            speed,
            gain,
            slip,
            std,
            stale_s,
            torque,
            dt_s,
        )
        return told, (*said.tolist(), float(std.max()), stale_s)

    def _thesis_correct(
        self, wheel: Array, speed: Array, gain: Array, slip: Array, std: Array, stale_s: float, dt_s: float
    ) -> tuple[Array, tuple[float, ...]]:
        now, settings = self._now, self._settings
        entry = self._table.lookup(now.belief.terrain)
        targets = np.array([entry[state].slip_ratio for state in ("traction", "braking", "steady")])
        seen = now.estimate
        if seen is None or stale_s > settings.traction.stale_max_s:
            speed = np.full(3, math.nan)
        rate = np.full(3, math.nan) if seen is None else seen.wheel_speed_mps / self._robot.wheel_radius_m
        chassis_mps = math.nan if seen is None else math.hypot(seen.speed_x_mps, seen.speed_y_mps)
        added, desired, drive, _, now.thesis = thesis_step(
            self._thesis, now.thesis, wheel, rate, speed, gain, chassis_mps, targets, dt_s
        )
        why = BAD_TIME if not 0.0 < dt_s <= MAX_STEP_S else OK if np.isfinite(desired).all() else NO_SLIP
        driven_mps = float(np.abs(wheel + added).max()) * self._robot.wheel_radius_m
        aimed, largest = (float(np.where(wheel < 0.0, -s, s).max()) for s in (desired, slip))
        return wheel + added, (
            driven_mps,
            aimed,
            math.nan,
            largest,
            float(drive[0]),
            float(why),
            float(std.max()),
            stale_s,
        )
