"""Commands of a robot of any drive from its desired twist, what is estimated of its motion, and the believed terrain.

::

    twist -> path tracking -> turn -> kinematics -> wheel controller, with the slips that the terrain's entry aims for

Slip is controlled at each driven wheel: of a robot that skids at each side, of a car-like one at its driven axle.
A robot that turns by the speeds of its wheels keeps its yaw rate (:mod:`terrain.control.turning`).

Braking by controlled slip is aimed for where it stops a robot sooner than locked wheels.  On terrain that
shears, thrust rises with slip up to the locked wheel: nothing stops sooner.  On hard terrain it falls again
beyond a peak.  Slip is controlled in braking where it falls by more than the controller loses while slip
builds up, and where friction is so small that wheels lock at all.

Commands of the wheels: ``plain`` and ``ramp`` use no measurement; ``thesis`` is the PID on each wheel of
:mod:`terrain.control.pid`; ``traction`` is the controller of :mod:`terrain.control.traction`.

Wheels and steering are compared with their commands; else a sensor lies, or a motor does not follow.  A motor's
rate follows its command within 0.4 s.  So it lies between the least and the largest command of
that time, and what is outside by more than a tolerance for a while either measures something else or does not
follow; and the same with steering angles.  A rate that repeats itself to the last bit, as that of a motor
that stands, has less than half of that time; one that approaches its command, as that of a motor under
load, has more.  Of three measured values the middle one counts, not a spike.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.path_tracking import (
    TrackReport,
    TrackState,
    TrackStatus,
    check_tracking,
    track_step,
    tracking_of,
)
from terrain.control.pid import LONGEST_STEP_S, DriveState, Gains, WheelPid, wheel_step
from terrain.control.slip_table import DRIVE_STATES, CurveEntry, SlipTable
from terrain.control.stability import check_stable, gain_margin
from terrain.control.switching import SWITCHING, OutputStatus, TerrainBelief, approach, drive_on
from terrain.control.traction import (
    TractionState,
    TractionStatus,
    TractionTarget,
    WheelMotion,
    WheelReport,
    settings_of,
    traction_step,
)
from terrain.control.turning import SETTINGS as TURN
from terrain.control.turning import first_state, open_loop, turn_step, turning_of
from terrain.errors import ConfigError
from terrain.estimation.clocks import check_channels
from terrain.estimation.health import NOT_OF_SLIP, SOUND, Health, HealthMonitor, sensors_of
from terrain.estimation.live import CHANNELS, LiveEstimate
from terrain.estimation.stream_evidence import StreamEvidence
from terrain.kinematics.commands import wheel_motion
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import Array, Command, Reading
from terrain.robots import BicycleRobot, Robot
from terrain.slip import MIN_SPEED_MPS, slip_ratio

#: Commands of the kinematics; with a bounded rise of speed; the thesis' PID on each wheel; the controller of
#: :mod:`terrain.control.traction`.
CONTROLLERS = ("plain", "ramp", "thesis", "traction")
OPEN_LOOP = ("plain", "ramp")  #: Controllers that use no measurement.
#: The thesis specifies none; these have a gain margin of 3 on the simulated robot (``check_stable``). On a robot where
#: it would be less than the last, they are reduced to 3.
THESIS_GAINS, LEAST_MARGIN = Gains(0.5, 0.5, limit=2.0), 2.5


def thesis_gains(robot: Robot) -> Gains:
    """Return the gains of the thesis' controller on a robot.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> [round(thesis_gains(load_robot(name)).kp, 2) for name in ("agrimaro", "husky")]
    [0.5, 0.12]
    """
    margin = gain_margin(robot, THESIS_GAINS)
    factor = 1.0 if margin > LEAST_MARGIN else margin / 3.0
    return THESIS_GAINS._replace(kp=factor * THESIS_GAINS.kp, ki=factor * THESIS_GAINS.ki)


@dataclass(frozen=True, slots=True)
class PilotSettings:
    """Controller of a pilot and its settings."""

    controller: str = "traction"  # one of :data:`CONTROLLERS`
    ramp_mps2: float = 0.5  #: largest rise of the speed of the fastest wheel, of ``ramp``
    delay_s: float = 0.05  #: from a sample to the wheel; the loops have to be stable with it
    track: bool = False  #: with path tracking; not with ``plain`` and ``ramp``, which estimate no pose
    #: motors follow this pilot's commands, and are compared; not where a log is replayed
    follows: bool = True


DEFAULT_SETTINGS = PilotSettings()


def check_pilot(robot: Robot, table: SlipTable, settings: PilotSettings) -> None:
    """Raise ``ConfigError`` as a pilot, but for path tracking."""
    if settings.controller not in CONTROLLERS:
        raise ConfigError(
            f"controller {settings.controller!r} is unknown: use one of {', '.join(CONTROLLERS)}"
        )
    if not 0.0 < settings.ramp_mps2 < math.inf:
        raise ConfigError(f"ramp_mps2 is {settings.ramp_mps2!r}, a number above zero is required")
    check_table(table, robot.name)
    if settings.track and settings.controller in OPEN_LOOP:
        raise ConfigError(f"controller {settings.controller!r} estimates no pose: it has no path tracking")
    if settings.controller == "thesis":
        check_stable(robot, thesis_gains(robot), settings.delay_s)


def check_table(table: SlipTable, robot: str) -> None:
    """Raise ``ConfigError`` where a table is another robot's; a robot without a name may have any."""
    if robot and table.robot and table.robot != robot:
        raise ConfigError(f"slip table {table.name}: is of the robot {table.robot!r}, not of {robot!r}")


PERIOD_S = 0.02  #: Time step of the control loop; assumed where the clock is not valid.


def step_or_period(dt_s: float) -> float:
    """Return a time step, or :data:`PERIOD_S` where it is none of a control loop."""
    return dt_s if 0.0 < dt_s <= LONGEST_STEP_S else PERIOD_S


def unobserved(n: int) -> WheelMotion:
    """Return the motion of n wheels before the first estimate."""
    unknown = np.full(n, math.nan)
    return WheelMotion(unknown, unknown, unknown, unknown, unknown, unknown, math.nan, math.inf)


def observe_wheels(
    robot: Robot, steer_rad: Array, estimate: LiveEstimate | None, time_s: float, track_ratio: float = 1.0
) -> WheelMotion:
    """Return the motion along each driven wheel from an estimate of the robot's motion; NaN before the first one.

    ``steer_rad`` (wheels,) are the angles of the steering, 0 without.  Of a robot that skids, ``track_ratio`` is its
    effective track over its track: its slip is counted beyond what turning takes.
    """
    if estimate is None:
        return unobserved(len(robot.logged_wheels))
    stale_s, rollers = estimate_age(estimate, time_s), robot.roller_angles_rad
    x_m, y_m = np.transpose(robot.wheel_positions_m)
    angle = steer_rad + robot.wheel_directions_rad + rollers
    along = np.cos(angle) / np.cos(rollers), np.sin(angle) / np.cos(rollers)
    ahead, left, turn = estimate.speed_x_mps, estimate.speed_y_mps, track_ratio * estimate.yaw_rate_radps
    left = left if robot.sideways else 0.0  # sideways it goes as it is pushed
    if isinstance(robot, BicycleRobot) and math.isnan(turn):
        turn = ahead * math.tan(steer_rad[0]) / robot.wheelbase_m
    speed, _ = in_wheel_frame(*point_velocity(ahead, left, turn, x_m, y_m), *along)
    wheel, slip = np.abs(estimate.wheel_speed_mps), estimate.slip_ratio
    if robot.skids:
        beyond = slip_ratio(estimate.wheel_speed_mps, speed)
        slip = np.where(np.isnan(slip), slip, beyond)
    fastest = np.where(wheel <= np.abs(speed), np.abs(speed), wheel)  # NaN too
    # a wheel stands by the filter's rate, which differs a little from the measured one
    standing = fastest < np.where(np.isnan(slip), 2.0, 1.0) * MIN_SPEED_MPS
    accel = (np.nan_to_num(one) for one in (estimate.accel_x_mps2, estimate.accel_y_mps2))
    accel_x, accel_y = (float(one) for one in accel)
    rows = (
        speed,
        accel_x * along[0] + accel_y * along[1],
        np.where(standing & (stale_s < math.inf), 0.0, slip),
        np.where(standing, 0.0, estimate.slip_std),
        estimate.current_a * (robot.motors.nm_per_a if robot.describes("motors") else math.nan),
        estimate.wheel_speed_mps / robot.wheel_radius_m,
    )
    driven = np.isin(robot.wheels, robot.logged_wheels)
    speeds = (one for one in (estimate.speed_x_mps, estimate.speed_y_mps) if math.isfinite(one))
    one, two, three, four, five, six = (row[driven] for row in rows)
    return WheelMotion(one, two, three, four, five, six, math.hypot(*speeds), stale_s)


def largest_forward(wheel_radps: Array, slip_ratio: Array) -> float:
    """Return the largest slip of the wheels, positive in traction in the desired direction; NaN where one is."""
    return float(np.where(wheel_radps < 0.0, -slip_ratio, slip_ratio).max())


def estimate_age(estimate: LiveEstimate, time_s: float) -> float:
    """Return the time since the speed over ground was measured last."""
    return estimate.reference_age_s + max(time_s - estimate.time_s, 0.0)


#: Thrust over load at the peak, up to which terrain counts as slick: with more, a robot stops from 1 m/s in less than
#: two tenths of a second, which is the response time of a slip controller.
SLICK_RATIO = 0.5
#: Thrust of a locked wheel over that at the peak, up to which slip is controlled: with 0.92 a controlled stop came out
#: longer in simulation, with 0.79 it was 7 to 22 % shorter.
LOCKED_RATIO = 0.88
#: Planned deceleration over that at the peak; with more, the slip would diverge from the peak.
DECELERATION_RATIO = 0.9


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


#: The difference of a table's targets in traction and in steady motion is the slip above the balance that gives the
#: working pull; up to this much is added to the measured balance. A larger difference is that of a table that aims for
#: a peak.
MARGIN_MAX_RATIO = 0.06


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


N_COMMANDS = 32  #: Of the last steps, which are compared.
#: Time within which a command is followed; for which a deviation has to last; for which there must be none for it to
#: be over; low-pass of what is measured, against the ripple of the Hall steps.
WINDOW_S, PERSISTS_S, SETTLED_S, SMOOTH_S = 0.4, 0.06, 0.1, 0.04
#: Time within which a motor changes its rate where the command has; a loaded one takes 0.12 s to start.
STILL_S = 0.16
#: A second low-pass, and how far the first is ahead of it, in m/s or rad, where a command is approached.
SLOW_S, APPROACH = 0.2, 0.02
#: No motor changes the speed of a wheel by so much from sample to sample while its command stays: it is off at once.
JUMP_MPS = 0.15
#: Tolerances: of a wheel's speed, a constant and a part of the command, and of a steering angle.
SPEED_MPS, SPEED_RATIO, STEER_RAD = 0.05, 0.06, 0.06


class Actuation:
    """Wheels and steering of a robot against their commands, step by step: which (wheels + angles,) are ``off``.

    ``spikes`` are wheels whose last value alone is none: a second one like it makes them off.

    ``mps_per_rate`` is the speed of a wheel by what its channel holds, the rate of its motor or the speed itself.  The
    ground drives the sides of a robot that skids against each other, beyond what their motors can hold: one that moves
    is compared with the commands of both, and 0.
    """

    def __init__(
        self, mps_per_rate: float, n_wheels: int = 3, n_angles: int = 3, skids: bool = False
    ) -> None:
        self._mps_per_rate, self._n, n, self._skids = mps_per_rate, n_wheels, (n_wheels, n_angles), skids
        self._tolerance, self._ratio = np.repeat([SPEED_MPS, STEER_RAD], n), np.repeat([SPEED_RATIO, 0.0], n)
        self._still_s = np.repeat([STILL_S, math.inf], n)  # a steering angle may repeat itself
        size = sum(n)
        self._command = np.full(size, math.nan)
        self._commands: deque[tuple[float, Array]] = deque(maxlen=N_COMMANDS)
        self._last = self._before = self._middle = self._smooth = self._slow = np.full(size, math.nan)
        self._repeated_s, self._off_s, self._on_s = np.zeros(size), np.zeros(size), np.full(size, SETTLED_S)
        self.off = self.spikes = np.zeros(size, dtype=np.bool_)

    def commanded(self, wheel_mps: Array, steer_rad: Array) -> None:
        """Take the commands (wheels,), (angles,) that are in force from now on."""
        self._command = np.concatenate([wheel_mps, steer_rad])

    def measured(self, now_s: float, step_s: float, wheels: Reading | None, steer_rad: Array | None) -> None:
        """Compare the rates, first columns of the wheels, and steering angles (angles,) with the commands."""
        value, n = np.full(len(self._command), math.nan), self._n
        if wheels is not None:
            value[:n] = wheels.values[-1, :n] * self._mps_per_rate
        if steer_rad is not None:
            value[n:] = steer_rad
        passed_s = now_s - self._commands[-1][0] if self._commands else math.inf
        if not passed_s <= STILL_S:  # so long ago that it shows no jump
            self._last = self._before = self._middle = np.full(len(value), math.nan)
        last_three = np.array([value, self._last, self._before])
        middle = np.where(np.isnan(last_three).any(axis=0), value, np.sort(last_three, axis=0)[1])
        change, self._middle = np.abs(middle - self._middle), middle
        self._repeated_s = np.where(value == self._last, self._repeated_s + step_s, 0.0)
        self._last, self._before = value, self._last
        self._smooth, self._slow = smooth, slow = [
            np.where(np.isnan(passed), middle, passed)  # an unknown value leaves nothing there
            for before, time_s in ((self._smooth, SMOOTH_S), (self._slow, SLOW_S))
            for passed in [before - (middle - before) * math.expm1(-step_s / time_s)]
        ]
        self._commands.append((now_s, self._command))
        commands = np.array([command for _, command in self._commands])
        since_s = now_s - np.where(self._repeated_s >= self._still_s, STILL_S, WINDOW_S)
        counts = (np.array([[time_s] for time_s, _ in self._commands]) >= since_s) & ~np.isnan(commands)
        known = counts.any(axis=0)
        low = np.where(known, np.where(counts, commands, math.inf).min(axis=0), 0.0)
        high = np.where(known, np.where(counts, commands, -math.inf).max(axis=0), 0.0)
        limit = JUMP_MPS * max(passed_s / PERIOD_S, 1.0) + np.where(
            np.arange(len(value)) < n, high - low, math.inf
        )
        jumped, self.spikes = change > limit, np.abs(value - middle) > limit
        if self._skids:
            moves, sides = (self._repeated_s < STILL_S) & ~self.off, slice(0, self._n)
            low = np.where(moves, np.minimum(low[sides].min(), 0.0), low)
            high = np.where(moves, np.maximum(high[sides].max(), 0.0), high)
        slack = self._tolerance + self._ratio * np.maximum(np.abs(low), np.abs(high))
        below, above = known & (smooth < low - slack), known & (smooth > high + slack)
        goes = ~((below & (smooth > slow + APPROACH)) | (above & (smooth < slow - APPROACH)))
        deviates = below | above
        self._off_s = np.where(goes, np.where(deviates, self._off_s + step_s, 0.0), self._off_s)
        self._on_s = np.where(goes, np.where(deviates, 0.0, self._on_s + step_s), self._on_s)
        now_off = (self._off_s >= PERSISTS_S) | (self.off & (self._on_s < SETTLED_S))
        self.off = np.where(goes, now_off, self.off) | jumped
        self._on_s[jumped] = 0.0


# Order in which sensors are named, by health: one that steps or freezes takes others with it, which are lost.
_NAMED_FIRST = (0, 1, 2, 3, 4, 6, 7, 5)
#: The turn is corrected again once all sensors have been sound for this time: one that is noisy comes and goes.
TRUSTED_S = 0.5
FRESH_S = 0.5  #: Age of a measured speed over ground up to which a robot counts as slow.
POSE_STATES = ("position_x_m", "position_y_m", "yaw_rad")  #: Of a filter that path tracking is built on.
_NOT_TRACKED = TrackReport(math.nan, math.nan, 0.0, TrackStatus.NO_POSE)


class RobotControl:
    """Turns desired twists into commands of wheels and steering, step by step.

    Parameters
    ----------
    robot : corrected; a swerve robot with all sections
    table : target slips
    settings : as :func:`check_pilot` accepts them
    states : of the filter that estimates the motion; none for a controller that uses no measurement
    channels : of each stream that is measured, in the order of the columns; those of a swerve robot by default

    Attributes
    ----------
    sensors, health : names of the sensors that are judged, and the health of each at the last step
    target_ratio : target slip in traction that is aimed for; NaN before the first step

    Raises
    ------
    ConfigError
        if path tracking is unstable on the robot, with its delay, or the wheels' channels are not among those given.
    """

    def __init__(
        self,
        robot: Robot,
        table: SlipTable,
        settings: PilotSettings,
        states: Sequence[str],
        channels: Mapping[str, Sequence[str]] = CHANNELS,
    ) -> None:
        self._robot, self._settings, self._estimates = robot, settings, bool(states)
        self._radius_m, self._driven = robot.wheel_radius_m, np.isin(robot.wheels, robot.logged_wheels)
        self._traction, self._track_settings = settings_of(robot), tracking_of(robot)
        # angles that the filter estimates; those of others are where they are commanded
        self._angles = [f"steer_{i}_rad" for i in robot.steered_wheels]
        self._angles = self._angles if set(self._angles) <= set(states) else []
        self._steer_states = np.array([states.index(angle) for angle in self._angles], int)
        self._pose_states = [states.index(state) for state in POSE_STATES if state in states]
        if states and settings.track:
            if len(self._pose_states) < len(POSE_STATES):
                raise ConfigError(
                    f"robot {robot.name}: its filter estimates no pose: leave path tracking out"
                )
            check_tracking(robot, self._track_settings, settings.delay_s)
        n, mps_per_rate = len(robot.logged_wheels), 1.0
        if robot.by_motor:
            mps_per_rate = robot.wheel_radius_m / robot.reduction_ratio
        self._actuation = Actuation(mps_per_rate, n, len(self._angles), robot.skids)
        wheels, imu = (list(channels.get(name, ())) for name in ("wheels", "imu"))
        if states:
            check_channels("wheels", robot.rate_channels, wheels)
        self._n_columns = len(wheels), len(imu)
        sensors = sensors_of(robot, channels) if states else ()
        # a filter that estimates the angles of wheels judges by its feed; of others what never comes is not judged
        self._monitor = HealthMonitor(sensors, Health.LOST if self._angles else Health.FRESH)
        self.sensors = self._monitor.names
        self._of_slip = [i for i, name in enumerate(self.sensors) if name not in NOT_OF_SLIP]
        self._evidence = None
        if states and not self._angles:
            self._evidence = StreamEvidence(robot, channels, sensors, states)
        self._rates = [wheels.index(channel) for channel in robot.rate_channels if states]
        self._tilt = [imu.index(angle) for angle in ("roll_rad", "pitch_rad") if angle in imu]
        self._gains = thesis_gains(robot) if settings.controller == "thesis" else THESIS_GAINS
        self._turning = None
        if settings.controller == "traction" and not (robot.steered and robot.sideways):
            self._turning = turning_of(robot)
        self.use(table)
        # what a step leaves to the next
        self.health = [0] * len(self.sensors)
        self.steer_rad = np.zeros(len(robot.wheels))
        self.target_ratio, self._tilt_rad, self._tracking = math.nan, (0.0, 0.0), TrackState()
        self._state, self._pids, self._turn = TractionState(), [WheelPid()] * n, first_state(robot)
        self._wheel_radps, self._driven_mps, self._driven_part = np.zeros(n), 0.0, 1.0
        self._sound_s = math.inf  # for how long all sensors have been

    def use(self, table: SlipTable) -> None:
        """Aim for the targets of a table from now on."""
        self._table = table
        self._targets = {terrain: traction_target(table, terrain) for terrain in table.targets}
        self.terrains = {terrain: index for index, terrain in enumerate(table.targets)}

    def reset_terrain(self) -> None:
        """Drop what was learned of the terrain, balance and floor of the target, as another one is believed."""
        self._state = self._state._replace(balance_ratio=math.nan, floor_ratio=0.0)

    @property
    def not_followed(self) -> bool:
        """Whether wheels or steering do not do what is commanded, so that their readings are left out."""
        return bool(self._actuation.off.any())

    def measured(
        self, time_s: float, dt_s: float, readings: dict[str, Reading], seen: LiveEstimate | None
    ) -> None:
        """Take what was measured, in the order of the schema, and the estimate before it.

        Rates of motors that do not follow their commands are not to be believed, nor sensors that are frozen or have
        jumped: they are replaced by NaN.
        """
        if self._evidence is not None:
            known = self._evidence.at(time_s, step_or_period(dt_s), readings, seen)
            self._evidence.mask(readings, self._monitor.judge(known))
        wheels, imu = (
            reading
            if reading is not None and len(values := reading.values) and values.shape[1] == n
            else None
            for reading, n in zip(map(readings.get, ("wheels", "imu")), self._n_columns, strict=True)
        )
        if imu is not None and len(self._tilt) == 2:
            roll, pitch = imu.values[-1, self._tilt].tolist()
            if math.isfinite(roll) and math.isfinite(pitch):
                self._tilt_rad = roll, pitch
        if not self._settings.follows:
            return
        rates = None if wheels is None else Reading(wheels.time_s, wheels.values[:, self._rates])
        steer_rad = None if seen is None else seen.mean[self._steer_states]
        self._actuation.measured(time_s, step_or_period(dt_s), rates, steer_rad)
        off = (self._actuation.off | self._actuation.spikes)[: len(self._rates)]
        if wheels is not None and off.any():
            values = wheels.values.copy()
            values[:, np.array(self._rates)[off]] = math.nan
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

        The command's ``status`` are the channels of the stream ``control``.

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
        sound = health <= SOUND
        self._sound_s = self._sound_s + step_s if sound else 0.0
        twist = self._keep_turn(twist, seen, sound=self._sound_s >= TRUSTED_S, dt_s=dt_s)
        admitted, all_radps = self._to_wheels(twist, step_s)
        wheel_radps = all_radps[self._driven]
        desired_mps = max(map(abs, wheel_radps.tolist())) * self._radius_m
        if not holds:
            belief = drive_on(belief, desired_mps, step_s)
        observed = unobserved(len(wheel_radps))
        if self._estimates:
            steer_rad = self.steer_rad
            if self._angles and seen is not None:
                steer_rad = seen.mean[self._steer_states]
            ratio = self._turn.track_ratio if self._turning is not None else 1.0
            observed = observe_wheels(self._robot, steer_rad, seen, time_s, ratio)
        else:
            observed = observed._replace(stale_s=math.nan)
        seen_wheels = observed if sound else unobserved(len(wheel_radps))
        command_radps, done = self._command(
            wheel_radps, desired_mps, seen_wheels, target, belief.terrain, dt_s
        )
        status, slip_ratio = done.status, done.slip_ratio
        if not sound:
            status = status if status == TractionStatus.BAD_TIME else TractionStatus.UNSOUND
            slip_ratio = largest_forward(wheel_radps, observed.slip_ratio)
        self._actuation.commanded(command_radps * self._radius_m, self.steer_rad[: len(self._angles)])
        figures = {
            "status_code": float(status),  # of traction.TractionStatus
            "terrain_code": float(self.terrains.get(belief.terrain, -1)),  # in the table; -1 where unknown
            "probability_ratio": belief.probability,
            "target_ratio": self.target_ratio,
            "aimed_ratio": done.aimed_ratio,  # the target with its floor
            "balance_ratio": done.balance_ratio,  # slip of steady motion
            "slip_ratio": slip_ratio,  # largest of a wheel
            "slip_std_ratio": float(observed.slip_std.max()),
            "stale_s": observed.stale_s,  # since the speed over ground was measured last
            "drive_state_code": float(done.drive_state),  # of pid.DriveState
            "driven_mps": done.driven_mps,  # commanded speed of the fastest wheel, and the desired one
            "desired_mps": desired_mps,
            "heading_error_rad": tracked.heading_error_rad,
            "cross_track_m": tracked.cross_track_m,
            "track_status_code": float(tracked.status),  # of path_tracking.TrackStatus
            "sensor_code": float(sensor),  # place of the least sound among those that are judged; -1 for none
            "health_code": float(health),  # its health.Health
            "output_code": float(output),  # of the terrain source, switching.OutputStatus
        }
        scale = done.driven_mps / desired_mps if desired_mps > 0.0 else 0.0
        self._driven_part = min(scale, 1.0) if desired_mps > 0.0 else 1.0
        all_radps = all_radps * scale  # wheels that are not driven roll along
        all_radps[self._driven] = command_radps
        return Command(all_radps, self.steer_rad, admitted * scale, figures), belief

    def _keep_turn(self, twist: Array, seen: LiveEstimate | None, *, sound: bool, dt_s: float) -> Array:
        """Return the twist for the kinematics with which a robot that turns by its wheels' speeds turns as desired."""
        if self._turning is None:
            return twist
        unknown = np.full(len(self._robot.wheels), math.nan)
        given = twist, self._driven_part, math.nan, unknown, math.nan, dt_s
        if seen is not None and sound:
            speed_mps = seen.speed_x_mps if seen.reference_age_s < FRESH_S else math.nan
            given = *given[:2], seen.yaw_rate_radps, seen.wheel_speed_mps, speed_mps, dt_s
        twist, turn = turn_step(TURN, self._turning, self._turn, *given)
        self._turn = turn if self._settings.follows else open_loop(turn)
        return twist

    def _to_wheels(self, twist: Array, dt_s: float) -> tuple[Array, Array]:
        """Steer; return the twist that the wheels can drive, and their rates (wheels,)."""
        found = wheel_motion(self._robot, twist[None], dt_s, self.steer_rad)
        # a car-like robot that stops rolls on as it is steered
        if twist.any() or not isinstance(self._robot, BicycleRobot):
            self.steer_rad = found.steer_rad[0]
        return found.twist[0], found.wheel_radps[0]

    def _command(
        self,
        wheel_radps: Array,
        desired_mps: float,
        seen: WheelMotion,
        target: TractionTarget,
        terrain: str,
        dt_s: float,
    ) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) for desired ones, and what was decided."""
        settings, radius_m = self._settings, self._radius_m
        if settings.controller == "traction":
            command, self._state, report = traction_step(
                self._traction, self._state, target, radius_m, wheel_radps, seen, dt_s
            )
            return command, report
        if settings.controller in OPEN_LOOP:
            before_mps = self._driven_mps if float(wheel_radps @ self._wheel_radps) >= 0.0 else 0.0
            ramp_mps2 = settings.ramp_mps2 if settings.controller == "ramp" else math.inf
            driven_mps = min(desired_mps, before_mps + ramp_mps2 * step_or_period(dt_s))
            self._wheel_radps, self._driven_mps = wheel_radps, driven_mps
            command = wheel_radps * (driven_mps / desired_mps) if desired_mps > 0.0 else wheel_radps
            unknown = math.nan, math.nan, math.nan
            return command, WheelReport(driven_mps, *unknown, DriveState.STEADY, TractionStatus.OK)
        by_state, stale = self._table.lookup(terrain), seen.stale_s > self._traction.stale_max_s
        targets = [by_state[state].slip_ratio for state in DRIVE_STATES]
        columns = (
            wheel_radps,
            seen.wheel_radps,
            seen.speed_mps * (math.nan if stale else 1.0),
            seen.accel_mps2,
        )
        rows, chassis_mps, wheels = (column.tolist() for column in columns), seen.chassis_mps, []
        for i, (rate, measured, speed, accel) in enumerate(zip(*rows, strict=True)):
            given = rate, measured, speed, accel, chassis_mps, targets, dt_s
            wheel, self._pids[i] = wheel_step(self._gains, radius_m, self._pids[i], *given)
            wheels.append(wheel)
        desired = np.array([one.desired_ratio for one in wheels])
        status = TractionStatus.OK if np.isfinite(desired).all() else TractionStatus.NO_SLIP
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            status = TractionStatus.BAD_TIME
        command = wheel_radps + np.array([one.correction_radps for one in wheels])
        aimed, largest = (largest_forward(wheel_radps, slips) for slips in (desired, seen.slip_ratio))
        driven_mps = float(np.abs(command).max()) * radius_m
        return command, WheelReport(driven_mps, aimed, math.nan, largest, wheels[0].drive_state, status)

    def _judge(self, seen: LiveEstimate | None) -> tuple[int, int]:
        """Update the health of the sensors; return the place of the least sound, or -1, and its health."""
        if not self._estimates:
            return -1, Health.FRESH
        health = list(self._monitor.health)
        if seen is not None and self._evidence is None:
            health = seen.health.tolist()
        self.health = health
        for i in np.flatnonzero(self._actuation.off).tolist():
            if health[i] == Health.LOST or health[i] < Health.DISAGREES:  # it was taken from the filter
                health[i] = int(Health.DISAGREES)
        worst = max(health[i] for i in self._of_slip)
        if worst <= SOUND:
            return -1, worst
        place = max(self._of_slip, key=lambda i: _NAMED_FIRST[health[i]])
        return place, health[place]

    def _target(self, terrain: str, seen: LiveEstimate | None, dt_s: float) -> TractionTarget:
        """Return the slips to aim for; the target moves to that of the terrain at a bounded rate."""
        level = self._targets.get(terrain) or self._targets[self._table.fallback]
        self.target_ratio = approach(self.target_ratio, level.traction_ratio, SWITCHING.rate_ratio, dt_s)
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
        is_sound = True
        if self._evidence is None:
            by_name = dict(zip(self.sensors, self.health, strict=True))
            turns, seen_yaw, camera = (
                by_name.get(name, Health.LOST) for name in ("gyro", "camera_yaw", "camera_speed")
            )
            is_sound = min(turns, seen_yaw) <= SOUND and (camera <= SOUND or camera == Health.LOST)
        ahead, left, yaw = seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps
        left = left if self._robot.sideways else 0.0
        twist, self._tracking, report = track_step(
            self._track_settings,
            self._tracking,
            twist,
            seen.mean[self._pose_states],
            np.array([ahead, left, yaw]),
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
