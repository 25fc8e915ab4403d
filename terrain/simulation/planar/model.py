"""The planar simulation: from wheels, steering and tilt to motion, currents and what sensors show of them.

One body for all wheeled robots, fed either with what a simulated drive does to the wheels or with what a log
records of them; whatever is wrong about it is a parameter of :mod:`terrain.effects`, 0 where
absent.

- **kinematics** without slip: of a swerve robot the least-squares twist of its wheels' velocities, of a
  skid-steer robot ``u = (v_r + v_l)/2``, ``w = (v_r - v_l)/B``;
- **force**: ``F = m (1 + p) (dv/dt + g sin th) + R``, with the resistance ``R`` of rolling, drag, slip and
  scrub against the motion, and ``f = F / (m g)``;
- **slip**: ``v = u - |u| s(f)``, ``s = c f`` and a shear curve.  Of a skid-steer robot it acts along x, and
  with the inertia in ``F`` that is a low-pass of time constant ``|u| c m (1 + p) / (m g)``; of a swerve robot
  it is a twist of three parts, along, across with what the roll asks for, and turning, of a contact that
  springs.  Both are stepped exactly for inputs that run straight from sample to sample, so that the answer
  hardly depends on the step;
- **omni robots**: each wheel pulls along its direction by its own load and slip, its rollers resist across
  it (:mod:`~terrain.simulation.planar.omni`), and each motor's current is that of its wheel;
- **currents**: their sum is ``F r`` along the wheels' mean heading and the motors' friction over the torque
  that an ampere gives at the wheel; of a skid-steer robot also the difference of the sides, from yaw inertia
  and scrub;
- **turning** of a skid-steer robot: its wheels' yaw rate and speed are reduced by turning slip and turn drag,
  lateral acceleration makes its track act narrower, and it slips sideways by ``T dv_y/dt + v_y = -c v w``;
- **car-like robots** turn by the linear single-track model
  (:mod:`~terrain.simulation.planar.motion`), and have no currents;
- **sensors**: gyro, accelerometer and camera with bias, scale, mounting, latency and their logger's clock.

Load transfer and roughness are left out: what they do to a log is noise here.  Sources stand with the
effects.

This module holds what all of it shares: the terrain, the robot's numbers on it, the columns of a motion, and
signals (n,) at even steps with their rates, delays and play.  Motion is in
:mod:`~terrain.simulation.planar.motion` and :mod:`~terrain.simulation.planar.omni`, sensors without noise,
and both together over a log, in :mod:`~terrain.simulation.planar.replay`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.kernels import njit
from terrain.kinematics.wheels import rolling_matrix, velocity_matrix
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import equilibrium_slip, ground_record, wheel_ground

TRUTH: tuple[str, ...] = (
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    "accel_x_mps2",
    "force_n",
    "current_a",
    "turning_current_a",
    "slip_ratio",
)
"""What the body does, before any sensor: speeds of the body's origin, specific force along x, traction,
currents of motors as described, and slip; traction and slip are those along x, of an omni robot the slip of
the body along what its wheels roll, and the sum of its currents' magnitudes."""

N_TRUTH = len(TRUTH)
VX, VY, W, AX, FORCE, AMPS, TURNING_AMPS, SLIP = range(N_TRUTH)
"""Their columns."""

SWERVE_WHEELS = 3

IMU_LAG_S = 0.003
"""Lag of a swerve robot's IMU behind its latency: bandwidths of 47 and 62.5 Hz (Bosch BNO055 data sheet)."""

SCRUB_SHARE = 0.4
"""Resistance to turning over the ground's grip; assumed: wheels of a side skid sideways over half the
distance."""

WIDTH_RATIO, CONTACT_RATIO = 0.6, 0.6
"""Width of a tyre, and length of its contact on firm ground, over the wheel's radius, where a description has
no section ``body``; assumed: the described robots have 0.5 to 0.7, and 0.6."""

_SLIPS = np.linspace(0.0, 1.0, 101)

_MORE = 1.01
"""Load for which growth with load is taken."""


class Ground(NamedTuple):
    """A terrain in the planar simulation.

    Parameters
    ----------
    slip_ratio : slip a traction of the robot's whole weight would take, were the thrust curve straight
    grip_ratio : largest traction over weight, of the shear curve
    rolling_ratio : resistance over weight
    scrub_ratio : resistance to turning of a skid-steer robot, over weight
    thrust_ratio : traction over weight at slips evenly spaced from 0 to 1, which takes the place of
        ``slip_ratio``; without any the thrust curve is straight
    load_ratio : by how much the traction at a slip grows with a load, as a share of the load's own share
    roller_ratio : friction of the rollers of omni wheels over the load, at a speed across of the wheels' own
    effective_ratio : share of the measured tilt that is a slope to drive up; the rest is a body that rides
        over bumps
    """

    slip_ratio: float = 0.3
    grip_ratio: float = 0.5
    rolling_ratio: float = 0.05
    scrub_ratio: float = 0.2
    thrust_ratio: tuple[float, ...] = ()
    load_ratio: float = 0.0
    effective_ratio: float = 1.0
    roller_ratio: float = 0.0


def planar_ground(robot: Robot, soil: Soil) -> Ground:
    """Return what a soil is to a robot that carries its weight on all tyres alike.

    The thrust curve is that of one tyre with its share of the weight; ``slip_ratio`` is its chord through the
    slip at which the robot drives steadily on the level.  How thrust grows with load is taken there, too.
    Rollers of omni wheels turn freely where the soil does not say what it does to them.

    Parameters
    ----------
    robot : a tyre that it does not describe has :data:`WIDTH_RATIO` and :data:`CONTACT_RATIO`
    soil : the ground

    Raises
    ------
    ConfigError
        if the robot is stuck on that soil.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> ground = planar_ground(load_robot("agrimaro"), load_soil("grass"))
    >>> [round(number, 3) for number in ground[:4]], round(ground.load_ratio, 2)
    ([1.569, 0.347, 0.08, 0.139], 0.76)
    """
    width_m, contact_m = WIDTH_RATIO * robot.wheel_radius_m, CONTACT_RATIO * robot.wheel_radius_m
    if robot.describes("body"):
        width_m, contact_m = robot.body.tyre_width_m, robot.body.contact_length_m
    wheel = robot.wheel_radius_m, width_m, contact_m
    normal_n = robot.mass_kg * GRAVITY_MPS2 / robot.n_tyres
    slip = equilibrium_slip(soil, normal_n, 0.0, *wheel)
    if math.isnan(slip):
        raise ConfigError(f"robot {robot.name}: it gets stuck on terrain {soil.name!r}")
    ground = ground_record(soil, *wheel)[0]
    thrust_n = wheel_ground(ground, normal_n, max(slip, 1e-3), 0.0)[0]
    more_n = wheel_ground(ground, _MORE * normal_n, max(slip, 1e-3), 0.0)[0]
    thrusts = [wheel_ground(ground, normal_n, float(s), 0.0)[0] / normal_n for s in _SLIPS]
    grip = max(thrusts)
    return Ground(
        slip_ratio=max(slip, 1e-3) * normal_n / thrust_n,
        grip_ratio=grip,
        rolling_ratio=wheel_ground(ground, normal_n, slip, 0.0)[2] / normal_n,
        scrub_ratio=SCRUB_SHARE * grip,
        thrust_ratio=tuple(thrusts),
        load_ratio=(more_n / thrust_n - 1.0) / (_MORE - 1.0),
        roller_ratio=float(np.nan_to_num(soil.roller_friction_ratio)),
    )


class Planar(NamedTuple):
    """Numbers of a robot on a ground, as the kernels take them."""

    n_wheels: int
    to_twist: Array
    track_m: float
    radius_m: float
    mass_kg: float
    rotating_kg: float
    yaw_inertia_kgm2: float
    nm_per_a: float
    friction_nm: float
    lever_x_m: float
    lever_y_m: float
    latency_s: float
    imu_latency_s: float
    imu_lag_s: float
    encoder_lag_s: float
    slip_ratio: float
    soft_ratio: Array
    grip_ratio: float
    rolling_ratio: float
    scrub_ratio: float
    load_ratio: float
    effective_ratio: float
    com_x_m: float
    com_y_m: float
    arm_ratio: Array
    spread_m: float
    relaxation_m: float
    omni: bool
    along: Array
    across: Array
    to_rolled: Array
    wheel_load_ratio: Array
    wheel_distance_m: float
    roller_ratio: float
    tracked: bool
    bicycle: bool
    wheelbase_m: float
    com_ahead_m: float
    front_cornering_npr: float
    rear_cornering_npr: float


def make_planar(robot: Robot, ground: Ground) -> Planar:
    """Return the planar simulation of a robot on a ground.

    What a description leaves out does not act: without motors a traction of 1 N counts as 1 A, without a
    camera the speed is that of the body's origin, without delay.
    """
    complete = robot.completed
    motors, camera, body, sensors = complete.motors, complete.camera, complete.body, complete.sensors
    n_motors = len(robot.wheels)
    car = robot if isinstance(robot, BicycleRobot) else None
    com_m = np.array([body.com_x_m, body.com_y_m])
    arm_m = robot.wheel_positions_m - com_m
    spread_m = float(np.sqrt((arm_m**2).sum(axis=1).mean()))
    return Planar(
        n_wheels=len(robot.wheels),
        to_twist=np.ascontiguousarray(np.linalg.pinv(velocity_matrix(robot.wheel_positions_m))),
        track_m=robot.track_m,
        radius_m=robot.wheel_radius_m,
        mass_kg=robot.mass_kg,
        rotating_kg=n_motors * body.wheel_inertia_kgm2 / robot.wheel_radius_m**2,
        yaw_inertia_kgm2=car.yaw_inertia_kgm2 if car else body.yaw_inertia_kgm2,
        nm_per_a=motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio,
        friction_nm=n_motors * motors.friction_nm,
        lever_x_m=camera.lever_x_m,
        lever_y_m=camera.lever_y_m,
        latency_s=camera.latency_s + camera.time_constant_s,
        imu_latency_s=sensors.imu_latency_s,
        imu_lag_s=IMU_LAG_S if isinstance(robot, SwerveRobot) else 0.0,
        encoder_lag_s=sensors.encoder_time_constant_s,
        slip_ratio=ground.slip_ratio,
        soft_ratio=_slip_per_traction(ground),
        grip_ratio=ground.grip_ratio,
        rolling_ratio=ground.rolling_ratio,
        scrub_ratio=ground.scrub_ratio if robot.skids else 0.0,
        load_ratio=ground.load_ratio,
        effective_ratio=ground.effective_ratio,
        com_x_m=float(com_m[0]),
        com_y_m=float(com_m[1]),
        arm_ratio=np.ascontiguousarray(arm_m / spread_m),
        spread_m=spread_m,
        relaxation_m=body.relaxation_length_m,
        **_omni_wheels(robot, arm_m, ground),
        tracked=isinstance(robot, TrackedRobot),
        bicycle=car is not None,
        wheelbase_m=robot.wheelbase_m,
        com_ahead_m=car.com_ahead_m if car else 0.0,
        front_cornering_npr=car.front_cornering_npr if car else 0.0,
        rear_cornering_npr=car.rear_cornering_npr if car else 0.0,
    )


def _omni_wheels(robot: Robot, arm_m: Array, ground: Ground) -> dict[str, Any]:
    """Return what omni wheels at arms (wheels, 2) from the centre of mass do; zeros of other robots.

    ``along`` and ``across`` (wheels, 3) give the speed of each wheel's centre along and across its direction
    for a twist of the centre of mass, ``to_rolled`` (3, wheels) the twist of the body without slip.
    """
    if not robot.on_omni_wheels:
        n, none = len(robot.wheels), np.zeros((len(robot.wheels), 3))
        return {
            "omni": False,
            "along": none,
            "across": none,
            "to_rolled": np.zeros((3, n)),
            "wheel_load_ratio": np.zeros(n),
            "wheel_distance_m": 0.0,
            "roller_ratio": 0.0,
        }
    direction = robot.wheel_directions_rad
    moments = np.vstack([np.ones(len(arm_m)), arm_m.T])
    return {
        "omni": True,
        "along": np.ascontiguousarray(rolling_matrix(arm_m, direction)),
        "across": np.ascontiguousarray(rolling_matrix(arm_m, direction + np.pi / 2)),
        "to_rolled": np.ascontiguousarray(np.linalg.pinv(rolling_matrix(robot.wheel_positions_m, direction))),
        "wheel_load_ratio": np.linalg.pinv(moments) @ np.array([1.0, 0.0, 0.0]),
        "wheel_distance_m": float(np.hypot(*robot.wheel_positions_m[0])),
        "roller_ratio": ground.roller_ratio,
    }


def _slip_per_traction(ground: Ground) -> Array:
    """Return slip over traction at slips evenly spaced from 0 to 1."""
    thrust = np.array(ground.thrust_ratio)
    if thrust.size < 4:
        return np.full(2, ground.slip_ratio)
    slip = np.linspace(0.0, 1.0, thrust.size)
    ratio = np.empty(thrust.size)
    ratio[1:] = slip[1:] / thrust[1:]
    ratio[0] = 2.0 * ratio[1] - ratio[2]
    return ratio


@njit
def slopes(values: Array, dt: float) -> Array:
    """Return the rate (n,) of a signal, right to the fourth order where two neighbours are there.

    Examples
    --------
    >>> round(float(slopes(np.sin(np.arange(9) * 0.2), 0.2)[4]) - math.cos(0.8), 5)
    -4e-05
    """
    n = values.size
    out = np.zeros(n)
    for k in range(2, n - 2):
        out[k] = (8.0 * (values[k + 1] - values[k - 1]) - (values[k + 2] - values[k - 2])) / (12.0 * dt)
    for k in (0, 1, n - 2, n - 1):
        before, after = max(k - 1, 0), min(k + 1, n - 1)
        if after > before:
            out[k] = (values[after] - values[before]) / ((after - before) * dt)
    return out


@njit
def delayed(values: Array, late: float, rate: float) -> Array:
    """Return a signal (n,) that shows at sample k what was at ``k - late - rate k``; its ends are held.

    Between samples it runs along the cubic through the four nearest: straight lines would smooth it.

    Examples
    --------
    >>> delayed(np.array([0.0, 1.0, 2.0, 3.0]), 0.5, 0.0)
    array([0. , 0.5, 1.5, 2.5])
    """
    n = values.size
    out = np.empty(n)
    if rate == 0.0:  # the same weights everywhere but at the ends
        whole = math.floor(-late)
        x = -late - whole
        first, last = min(max(1 - whole, 0), n), max(min(n - 2 - whole, n), 0)
        if first < last:
            a, b = -x * (x - 1.0) * (x - 2.0) / 6.0, (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0
            c, d = -(x + 1.0) * x * (x - 2.0) / 2.0, (x + 1.0) * x * (x - 1.0) / 6.0
            i = first + whole
            m = last - first
            out[first:last] = a * values[i - 1 : i - 1 + m] + b * values[i : i + m]
            out[first:last] += c * values[i + 1 : i + 1 + m] + d * values[i + 2 : i + 2 + m]
        else:
            first = last = n
        for k in range(first):
            out[k] = _between(values, k - late)
        for k in range(last, n):
            out[k] = _between(values, k - late)
        return out
    for k in range(n):
        out[k] = _between(values, k - late - rate * k)
    return out


@njit
def _between(values: Array, at: float) -> float:
    """Return a signal between its samples; its ends are held."""
    n = values.size
    at = min(max(at, 0.0), n - 1.0)
    i = min(int(at), n - 2)
    x = at - i
    if 1 <= i < n - 2:
        return float(
            -x * (x - 1.0) * (x - 2.0) / 6.0 * values[i - 1]
            + (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0 * values[i]
            - (x + 1.0) * x * (x - 2.0) / 2.0 * values[i + 1]
            + (x + 1.0) * x * (x - 1.0) / 6.0 * values[i + 2]
        )
    return float(values[i] + x * (values[i + 1] - values[i]))


@njit
def lagged(values: Array, tau_s: float, dt: float) -> Array:
    """Return a signal (n,) behind a first-order lag, exact for what runs straight from sample to sample.

    It starts at rest at its first value; without a time constant it is returned as it is.

    Examples
    --------
    >>> lagged(np.array([0.0, 1.0, 2.0, 3.0]), 1e-3, 1.0).round(3)
    array([0.   , 0.999, 1.999, 2.999])
    """
    if tau_s <= 0.0:
        return values
    out = np.empty(values.size)
    keep = math.exp(-dt / tau_s)
    out[0] = values[0]
    for k in range(1, values.size):
        lead = tau_s * (values[k] - values[k - 1]) / dt
        out[k] = values[k] - lead + keep * (out[k - 1] - values[k - 1] + lead)
    return out


@njit
def play(angle: Array, half: float) -> None:
    """Let an angle follow itself through a play of half width ``half``, from the middle; in place."""
    follower = angle[0]
    for k in range(angle.size):
        follower = min(max(follower, angle[k] - half), angle[k] + half)
        angle[k] = follower
