"""A car-like robot that follows a path: steering law, observer of sideslip, and preview as a controller in the loop.

At a tick the observer takes what was measured, the path gives the deviations of the estimated pose, and the
law the steering.  With the deviations y and theta~ from a path of curvature c, slip angles b of the axles, and a
desired lateral offset y_d::

    g = theta~ + b_R      a = 1 - c y      A = -K_p (y - y_d) - K_d a tan g + c a tan^2 g
    d = atan(tan b_R + L / cos b_R (c cos g / a + A cos^3 g / a^2)) - b_F                     (17)
    d = d_traj + d_dev,   d_traj = atan(L c cos g / a)                                        (18)

The part d_dev comes from what is measured, and is passed on.  The part d_traj follows the path, whose future
is known: it is commanded ahead, so that what the actuator makes of it (dead time T_d, then a lag tau) is
where d_traj will be after the horizon H::

    d_command = (d_traj(s + v (T_d + H)) - exp(-H / tau) m) / (1 - exp(-H / tau))

with m the actuator's model driven by the commands of this part.  In steady cornering d_command = d_traj.

Deremetz et al., ICRA 2017, (17), (18); Cariou et al. 2009.  K_p and K_d are per metre: (17) makes y converge
over distance, y'' + K_d y' + K_p y = 0, alike at every speed up to the one from which the actuator's delays
would matter.

Without an observer of sideslip the slip is 0, and the pose is that of the extended kinematic model without slip.
The robot stops where it does not know where it is: no fix for three seconds, or further from the path than its
search reaches; at the end the drive is finished.

The preview gives speed and steering ahead of bends, by the grip that the estimated cornering stiffness
shows.  An axle under the load N carries |F| = f N.  With the cornering stiffness C_0 that the tyre has at small
slip, the force that saturates at the grip mu is, as in :mod:`terrain.simulation.plants.car`::

    f = mu (1 - exp(-q / mu)),   q = C_0 |b| / N

The secant stiffness -F/b falls below C_0 the more of the grip is used.  f is known from speed, yaw rate and
roll, b from an observer of sideslip: a scalar Kalman filter on mu weighs each tick by how much it shows,
df/dmu = 1 - exp(-q/mu) (1 + q/mu), which is nothing at small slip.  What is used is the mean less one
standard deviation.  Ahead, the side force of a speed v in curvature c on a roll a is m (v^2 c + g sin a)::

    v(s)^2 <= (part mu g cos a - g sin a sgn c) / |c|          v^2 <= v(s)^2 + 2 b (s - s_0)

with the braking b.  The sideslip expected ahead, b = -F / C with the adapted C, is steered before it comes.

Future work of Deremetz et al., ICRA 2017, section VII: "parts of the adapted dynamic parameters" in the
prediction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.path_following import ACROSS_RAD, LEAST_BESIDE, LOST_STOP_S, curvature_to_path
from terrain.control.paths import GRID_M, PathStatus, Place, ReferencePath
from terrain.control.pid import LONGEST_STEP_S, checked
from terrain.estimation.models.observer import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.models.sideslip import RATE, ROLL, SETTINGS, SPEED, Sideslip, X
from terrain.records import Array, RunLog
from terrain.robots import BicycleRobot
from terrain.simulation.plants.car import CarCommand, CarSample
from terrain.status import StatusCode


class SteerStatus(StatusCode):
    """What a steering angle is worth."""

    OK = 0
    CLAMPED = 1  #: At the limit of the steering.
    SINGULAR = 2  #: 1 - c y close to 0 or below, or across the path: bounded.
    HELD = 3  #: Deviations are not known: the curvature of the path is steered, nothing is corrected.
    BAD_INPUT = 4  #: Speed or time are not numbers that can be: the steering is as it was.


class SteeringSettings(NamedTuple):
    """Gains and what is known of the actuator."""

    position_pm2: float = 0.16  #: K_p and K_d; the default is critically damped
    angle_pm: float = 0.8
    fastest_ps: float = 1.5  #: bandwidth above which both fall with the speed, as delays are in seconds
    offset_m: float = 0.0  #: desired distance to the left of the path
    delay_s: float = 0.05  #: dead time of the steering
    #: H over the actuator's time constant, 3 for its response time (95 %); 0 passes the curvature on as it is
    horizon_time_constants: float = 3.0
    #: time constant of a low-pass of the slip angles. The front one has -d in it, at once: fed back without a lag it
    #: closes a fast loop of gain 1 around actuator and tyres, which swings near the limit of the grip
    slip_lag_s: float = 0.4


class SteerState(NamedTuple):
    """The actuator's model m, the last command, and slip angles behind their low-pass."""

    model_rad: float = 0.0
    command_rad: float = 0.0
    front_rad: float = 0.0
    rear_rad: float = 0.0


def check_steering(settings: SteeringSettings) -> SteeringSettings:
    """Return settings that :func:`steer` accepts: gains above zero, bounded delays; else ``ConfigError``."""
    gains = "position_pm2", "angle_pm", "fastest_ps"
    most = {"delay_s": 2.0, "slip_lag_s": 10.0, "horizon_time_constants": 20.0}
    checked("steering: ", settings._replace(offset_m=abs(settings.offset_m)), gains, most=most)
    return settings


def law_17(
    settings: SteeringSettings,
    base_m: float,
    lateral: float,
    angle: float,
    curvature: float,
    front: float,
    rear: float,
) -> float:
    """Return the steering angle of (17), not limited.

    Examples
    --------
    >>> round(law_17(SteeringSettings(), 1.2, 0.0, 0.0, 0.1, 0.0, 0.0), 4)  # atan(L c)
    0.1194
    """
    gains = settings.position_pm2, settings.angle_pm
    bend = curvature_to_path(*gains, lateral - settings.offset_m, lateral, angle + rear, curvature)
    return math.atan(math.tan(rear) + base_m / math.cos(rear) * bend) - front


def steer(
    robot: BicycleRobot,
    settings: SteeringSettings,
    state: SteerState,
    path: ReferencePath,
    place: Place,
    slips: Array,
    speed_mps: float,
    dt_s: float,
) -> tuple[float, SteerState, SteerStatus]:
    """Return the steering to command, the next state and the status.

    ``SteerState()`` at first; slips (2,) of front and rear, of which NaN is taken as no slip.
    """
    if not (0.0 <= dt_s <= LONGEST_STEP_S and abs(speed_mps) < 100.0 and abs(place.distance_m) < 1e9):
        return state.command_rad, state, SteerStatus.BAD_INPUT
    part = 1.0 - math.exp(-dt_s / max(settings.slip_lag_s, 1e-9))
    front, rear = (
        before + part * ((slip if abs(slip) < 1.0 else 0.0) - before)
        for before, slip in zip(state[2:], slips.tolist(), strict=True)
    )
    status, lateral, angle = SteerStatus.OK, place.lateral_m, place.angle_rad
    curvature = place.curvature_pm if abs(place.curvature_pm) < 1e3 else 0.0
    if not (abs(lateral) < 1e6 and abs(angle) < 1e6):
        status, lateral, angle = SteerStatus.HELD, settings.offset_m, -rear
    elif 1.0 - curvature * lateral < LEAST_BESIDE or abs(angle + rear) > ACROSS_RAD:
        status = SteerStatus.SINGULAR
    gamma = min(max(angle + rear, -ACROSS_RAD), ACROSS_RAD)
    beside = max(1.0 - curvature * lateral, LEAST_BESIDE)
    along = robot.wheelbase_m * math.cos(gamma) / beside
    followed = math.atan(along * curvature)
    slower = min(1.0, settings.fastest_ps / max(abs(speed_mps) * math.sqrt(settings.position_pm2), 1e-9))
    gains = settings._replace(
        position_pm2=settings.position_pm2 * (slower * slower), angle_pm=settings.angle_pm * slower
    )
    deviation = law_17(gains, robot.wheelbase_m, lateral, angle, curvature, front, rear) - followed
    ahead, tau_s, most = followed, robot.steering_time_constant_s, robot.steering_max_rad
    horizon_s = settings.horizon_time_constants * tau_s
    if horizon_s > 0.0:
        reach = abs(speed_mps) * (settings.delay_s + horizon_s)
        at = min(max((place.distance_m + reach) / GRID_M, 0.0), len(path.curvature_pm) - 1.001)
        before, after = path.curvature_pm[int(at) : int(at) + 2].tolist()
        target = math.atan(along * (before + (at - int(at)) * (after - before)))
        keep = math.exp(-horizon_s / tau_s)
        ahead = (target - keep * state.model_rad) / (1.0 - keep)
    ahead = min(max(ahead, -most), most)
    lag = -math.expm1(-dt_s / tau_s) if tau_s > 0.0 else 1.0
    command = ahead + deviation
    if abs(command) > most:
        command, status = math.copysign(most, command), max(status, SteerStatus.CLAMPED)
    return (
        command,
        SteerState(state.model_rad + lag * (ahead - state.model_rad), command, front, rear),
        status,
    )


#: Of the steering, by which the sideslip expected ahead is steered before it comes, beside the dead time.
REACH_TIME_CONSTANTS = 1.0


class SlipSource(StrEnum):
    """Where a controller has its sideslip from."""

    NONE = "none"
    DYNAMIC = "dynamic"
    KINEMATIC = "kinematic"
    MULTI = "multi"
    GRIP = "multi-grip"  #: The multi-model observer, and the preview by its cornering stiffness.


#: Of the grip, what the side force ahead may take; and the braking before a bend, below the drive's acceleration.
USED_PART, BRAKING_MPS2 = 0.75, 1.0
#: Standard deviations of the grip's change within a second and of the nominal stiffness C_0, and the time for which
#: errors of an estimated slip last; all assumed.
GRIP_WALK, STIFFNESS_STD_RATIO, CORRELATION_S = 0.02, 0.2, 0.3
_LEAST_GRIP, _MOST_GRIP = 0.05, 1.5
_SHOWS = 0.1  #: Part of the load below which a side force shows nothing of the grip.
_LOOK_M = 0.5


class Grip(NamedTuple):
    """Largest side force over load, and its variance; as assumed at first."""

    ratio: float = 0.6
    variance: float = 0.15**2


def grip_step(
    robot: BicycleRobot, grip: Grip, force_mps2: float, slips: Array, slip_std: Array, dt_s: float
) -> Grip:
    """Return the next grip, by the lateral specific force u r + g sin a and estimated slips (2,).

    NaN shows nothing.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot, grip = load_robot("adap2e"), Grip()
    >>> slips, std = np.array([-0.3, -0.3]), np.full(2, 0.01)
    >>> for _ in range(200):  # half of g although the slip is large: that is all the grip there is
    ...     grip = grip_step(robot, grip, 4.9, slips, std, 0.02)
    >>> round(grip.ratio, 2)
    0.51
    """
    if not (0.0 < dt_s < 1.0 and abs(force_mps2) < 50.0):
        return grip
    mu, variance = grip.ratio, min(grip.variance + GRIP_WALK * GRIP_WALK * dt_s, 0.25)
    used = abs(force_mps2) / GRAVITY_MPS2
    if used < _SHOWS:
        return Grip(mu, variance)
    stiffness = robot.front_cornering_npr, robot.rear_cornering_npr
    loads = GRAVITY_MPS2 * _axle_masses(robot)
    for slip, std, load, c_0 in zip(
        slips.tolist(), slip_std.tolist(), loads.tolist(), stiffness, strict=True
    ):
        if not (abs(slip) < 1.5 and std < 1.0) or slip * force_mps2 > 0.0:
            continue
        slope = c_0 / load
        q = slope * abs(slip)
        left = math.exp(-q / mu)
        shown = 1.0 - left * (1.0 + q / mu)
        by_slip, by_stiffness = slope * std, STIFFNESS_STD_RATIO * q
        noise = 0.02 * 0.02 + left * left * (by_slip * by_slip + by_stiffness * by_stiffness)
        noise *= max(1.0, 2.0 * CORRELATION_S / dt_s)
        gain = variance * shown / (shown * shown * variance + noise)
        mu = min(max(mu + gain * (used - mu * (1.0 - left)), _LEAST_GRIP), _MOST_GRIP)
        variance *= 1.0 - gain * shown
    return Grip(mu, variance)


def preview_speed(grip: Grip, path: ReferencePath, distance_m: float, roll_rad: float) -> float:
    """Return the fastest speed at a distance along a path; infinite where nothing limits it.

    Examples
    --------
    >>> from terrain.control.paths import path_from_curvature
    >>> bend = path_from_curvature(np.array([0.0, 20.0, 20.1, 40.0]), np.array([0.0, 0.0, 0.1, 0.1]))
    >>> [round(preview_speed(Grip(0.5, 0.0), bend, s, 0.0), 2) for s in (10.0, 20.0, 25.0)]
    [7.6, 6.15, 6.06]
    """
    known = max(grip.ratio - math.sqrt(grip.variance), _LEAST_GRIP)
    first, least = path.row_at(distance_m), math.inf
    for i in range(first, len(path.x_m), int(_LOOK_M / GRID_M)):
        ahead = (i - first) * GRID_M
        if 2.0 * BRAKING_MPS2 * ahead > least:
            break
        curvature, roll = float(path.curvature_pm[i]), path.roll_at(i, roll_rad)
        pull = GRAVITY_MPS2 * math.sin(roll) * (1.0 if curvature > 0.0 else -1.0)
        room = USED_PART * known * GRAVITY_MPS2 * math.cos(roll) - max(pull, 0.0)
        square = max(room, 0.25) / max(abs(curvature), 1e-6)
        least = min(least, square + 2.0 * BRAKING_MPS2 * ahead)
    return math.sqrt(least)


def _axle_masses(robot: BicycleRobot) -> Array:
    """Return the mass (2,) in kg that front and rear axle carry."""
    arms = np.array([robot.com_ahead_m, robot.com_behind_front_m])
    return np.asarray(robot.mass_kg * arms / arms.sum())


class FollowedTick(NamedTuple):
    """What a controller knew and did at a tick."""

    time_s: float
    place: Place  #: on the path, by the estimated pose
    estimate: ObserverOutput
    steer_status: SteerStatus
    grip: Grip  #: as estimated; NaN without the preview


_NO_GRIP = Grip(math.nan, math.nan)


class CarFollower:
    """Controller of a drive along a path, for :func:`terrain.simulation.plants.car.run_car`.

    The sideslip is from the observer of a source, of ``none`` one whose slip stays 0, or from another observer;
    ``ticks`` are what was known and done, in the order of time.
    """

    def __init__(
        self,
        robot: BicycleRobot,
        path: ReferencePath,
        source: SlipSource = SlipSource.MULTI,
        steering: SteeringSettings = SteeringSettings(),  # noqa: B008
        observer: Observer | None = None,
    ) -> None:
        self._robot, self._path, self._source = robot, path, SlipSource(source)
        if observer is None:
            kinds = {SlipSource.NONE: "kinematic", SlipSource.GRIP: "multi"}
            name = f"sideslip-{kinds.get(self._source, self._source.value)}"
            without = SETTINGS[name]._replace(by_fixes=False) if self._source is SlipSource.NONE else None
            observer = Sideslip(robot, name, without)
        self._observer = observer
        self._steered, self._speed_mps, self._roll_rad, self._without_fix_s = SteerState(), 0.0, 0.0, 0.0
        self._steering, self._grip = check_steering(steering), Grip()
        self._reach_s = steering.delay_s + REACH_TIME_CONSTANTS * robot.steering_time_constant_s
        self._before_m, self._time_s = math.nan, math.nan
        self.ticks: list[FollowedTick] = []

    def __call__(self, sample: CarSample) -> CarCommand:
        """Return the command of a tick."""
        dt_s = 0.0 if math.isnan(self._time_s) else sample.time_s - self._time_s
        self._time_s = sample.time_s
        known, measured = self._observer.step(sample.measured, dt_s), sample.measured
        if math.isfinite(measured[SPEED]):
            self._speed_mps = float(measured[SPEED])
        if math.isfinite(measured[ROLL]):
            self._roll_rad = float(measured[ROLL])
        is_fixed = math.isfinite(measured[X]) and known.status != ObserverStatus.REJECTED
        self._without_fix_s = 0.0 if is_fixed else self._without_fix_s + dt_s
        speed = self._speed_mps
        x_m, y_m, yaw_rad = known.mean[:3].tolist()
        place = self._path.locate(x_m, y_m, yaw_rad, self._before_m)
        is_first = math.isnan(self._before_m)
        lost = PathStatus.NO_POSE, *(() if is_first else (PathStatus.FAR,))
        if place.status not in lost:
            self._before_m = place.distance_m
        slips = np.zeros(2) if self._source is SlipSource.NONE else known.slip
        desired, grip = sample.speed_desired_mps, _NO_GRIP
        if (
            self._source is SlipSource.GRIP
        ):  # what is expected of the path ahead, and the speed that the grip allows
            robot, path, roll = self._robot, self._path, self._roll_rad
            expected = []
            force = float(measured[SPEED] * measured[RATE]) + GRAVITY_MPS2 * math.sin(roll)
            grip = self._grip = grip_step(robot, self._grip, force, known.slip, known.slip_std, dt_s)
            desired = min(desired, preview_speed(grip, path, place.distance_m, roll))
            for ahead_m in (0.0, abs(speed) * self._reach_s):  # of steady cornering there
                row = path.row_at(place.distance_m + ahead_m)
                force = speed * speed * float(path.curvature_pm[row])
                force += GRAVITY_MPS2 * math.sin(path.roll_at(row, roll))
                expected.append(np.clip(-_axle_masses(robot) * force / known.mean[5:7], -0.2, 0.2))
            slips = known.slip + expected[1] - expected[0]
        steer_rad, self._steered, status = steer(
            self._robot, self._steering, self._steered, self._path, place, slips, speed, dt_s
        )
        stops = self._without_fix_s > LOST_STOP_S or place.status is PathStatus.FAR
        finished = place.status is PathStatus.END
        self.ticks.append(FollowedTick(sample.time_s, place, known, status, grip))
        return CarCommand(steer_rad, 0.0 if stops or finished else desired, finished)


#: Lateral specific force and slip angles from which a cornering stiffness can be compared with its secant.
EXCITED_MPS2, EXCITED_RAD = 1.5, 0.02


class FollowedDrive(NamedTuple):
    """Truth and estimates at the ticks of a drive: rows (n,) or, front and rear, (n, 2)."""

    time_s: Array
    distance_m: Array  #: of the true pose beside the path
    lateral_m: Array
    position_m: Array  #: (n, 2) true
    speed_mps: Array  #: true
    slip_rad: Array  #: (n, 2) as estimated; NaN where unknown, or at rest
    slip_true_rad: Array
    slip_std_rad: Array
    stiffness_npr: Array  #: (n, 2) as estimated
    secant_npr: Array  #: (n, 2) -F/b of the truth where it is excited; else NaN
    steer_rad: Array  #: true
    grip_ratio: Array  #: as estimated; NaN without the preview
    grip_std: Array
    reached_end: bool  #: the drive came to the end of the path

    def between(self, start_m: float, end_m: float) -> Array:
        """Return which ticks (n,) lie between two distances."""
        return (self.distance_m >= start_m) & (self.distance_m < end_m)

    def lateral_max_m(self, start_m: float = 0.0, end_m: float = math.inf) -> float:
        """Return the largest lateral error between two distances; NaN where the robot never was."""
        part = np.abs(self.lateral_m[self.between(start_m, end_m)])
        return float(part.max()) if part.size else math.nan

    @property
    def stiffness_error_ratio(self) -> Array:
        """Errors (k,) of the estimated stiffness over its secant, of both axles, where it is excited."""
        error = (self.stiffness_npr / self.secant_npr - 1.0).ravel()
        return error[np.isfinite(error)]

    @property
    def slip_error_rad(self) -> Array:
        """Errors (n, 2) of the slip angles; NaN where one is not known."""
        return self.slip_rad - self.slip_true_rad


def followed_drive(run: RunLog, path: ReferencePath, ticks: Sequence[FollowedTick]) -> FollowedDrive:
    """Return the drive of a simulated car, and what its controller knew at each tick of the wheels."""
    truth, n = run.streams["truth"], len(ticks)
    step = round(len(truth) / n)
    columns = {name: truth.channel(name)[::step][:n] for name in truth.channels}
    before, places = math.nan, np.empty((n, 2))
    for k in range(n):
        x_m, y_m, yaw_rad = (float(columns[name][k]) for name in ("position_x_m", "position_y_m", "yaw_rad"))
        place = path.locate(x_m, y_m, yaw_rad, before)
        before, places[k] = place.distance_m, place[:2]
    true_slips = np.column_stack([columns["slip_front_rad"], columns["slip_rear_rad"]])
    forces = np.column_stack([columns["side_front_n"], columns["side_rear_n"]])
    shown = (np.abs(true_slips) > EXCITED_RAD) & (np.abs(columns["accel_y_mps2"]) > EXCITED_MPS2)[:, None]
    shown &= forces * true_slips < 0.0
    secant = np.full((n, 2), math.nan)
    np.divide(-forces, true_slips, out=secant, where=shown)
    means = [tick.estimate.mean for tick in ticks]
    stiffness = [mean[5:7] if len(mean) == 7 else np.full(2, math.nan) for mean in means]
    return FollowedDrive(
        time_s=truth.time_s[::step][:n],
        distance_m=places[:, 0],
        lateral_m=places[:, 1],
        position_m=np.column_stack([columns["position_x_m"], columns["position_y_m"]]),
        speed_mps=columns["speed_x_mps"],
        slip_rad=np.array([tick.estimate.slip for tick in ticks]),
        slip_true_rad=true_slips,
        slip_std_rad=np.array([tick.estimate.slip_std for tick in ticks]),
        stiffness_npr=np.array(stiffness),
        secant_npr=secant,
        steer_rad=columns["steer_front_rad"],
        grip_ratio=np.array([tick.grip.ratio for tick in ticks]),
        grip_std=np.sqrt([tick.grip.variance for tick in ticks]),
        reached_end=ticks[-1].place.status == PathStatus.END,
    )
