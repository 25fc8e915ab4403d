"""The planar plant: from wheels, steering and tilt to the motion of a body, in whole signals.

One body for all wheeled robots, fed either with what a simulated drive does to the wheels or with what a log
records of them; whatever is wrong about it is a parameter of :mod:`terrain.effects`, 0 where absent.

- **kinematics** without slip: of a swerve robot the least-squares twist of its wheels' velocities, of a
  skid-steer robot ``u = (v_r + v_l)/2``, ``w = (v_r - v_l)/B``;
- **force**: ``F = m (1 + p) (dv/dt + g sin th) + R``, with the resistance ``R`` of rolling, drag, slip and
  scrub against the motion, and ``f = F / (m g)``;
- **slip**: ``v = u - |u| s(f)``, ``s = c f`` and a shear curve, stepped exactly for inputs that run straight from
  sample to sample, so that the answer hardly depends on the step;
- **currents**: their sum is ``F r`` along the wheels' mean heading and the motors' friction over the torque that an
  ampere gives at the wheel.

A drive is a :class:`Drive`: the record of its numbers on a ground, and the kernel of its motion
(:mod:`~terrain.simulation.planar.skid`, :mod:`~terrain.simulation.planar.swerve`,
:mod:`~terrain.simulation.planar.omni`, :mod:`~terrain.simulation.planar.bicycle`); what all share of the motion is in
:mod:`~terrain.simulation.planar.motion`, sensors without noise, and both together over a log, in
:mod:`~terrain.simulation.planar.replay`.

Load transfer and roughness are left out: what they do to a log is noise here.  Sources stand with the effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.records import Array
from terrain.robots import Robot, SwerveRobot
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import equilibrium_slip, ground_record, wheel_ground

TRUTH = record(
    numbers(
        "speed_x_mps speed_y_mps yaw_rate_radps accel_x_mps2 force_n current_a turning_current_a slip_ratio"
    )
)
"""What the body does, before any sensor: speeds of the body's origin, specific force along x, traction, currents of
motors as described, and slip; traction and slip are those along x, of an omni robot the slip of the body along what
its wheels roll, and the sum of its currents' magnitudes."""

N_SLIPS = 101
_SLIPS = np.linspace(0.0, 1.0, N_SLIPS)

BODY = record(
    numbers(
        "track_m radius_m mass_kg rotating_kg yaw_inertia_kgm2 nm_per_a friction_nm lever_x_m lever_y_m latency_s "
        "imu_latency_s imu_lag_s encoder_lag_s com_x_m com_y_m grip_ratio rolling_ratio scrub_ratio load_ratio "
        "effective_ratio"
    )
    | {"soft_ratio": (float, N_SLIPS), "n_wheels": int, "seen_from_above": bool}
)
"""Numbers that every drive has: of the robot, of its sensors' latencies, and of its ground, with the slip over the
traction at slips evenly spaced from 0 to 1; whether a camera above the field measures its poses."""

# Lag of a swerve robot's IMU behind its latency: bandwidths of 47 and 62.5 Hz (Bosch BNO055 data sheet).
IMU_LAG_S = 0.003
# Resistance to turning over the ground's grip; assumed: wheels of a side skid sideways over half the distance.
SCRUB_SHARE = 0.4
# Width of a tyre, and length of its contact on firm ground, over the wheel's radius, where a description has no
# section ``body``; assumed: the described robots have 0.5 to 0.7, and 0.6.
WIDTH_RATIO, CONTACT_RATIO = 0.6, 0.6
_MORE = 1.01  # load for which growth with load is taken


class Ground(NamedTuple):
    """A terrain in the planar simulation."""

    # slip a traction of the robot's whole weight would take, were the thrust curve straight
    slip_ratio: float = 0.3
    grip_ratio: float = 0.5  # largest traction over weight, of the shear curve
    rolling_ratio: float = 0.05  # resistance over weight
    scrub_ratio: float = 0.2  # resistance to turning of a skid-steer robot, over weight
    # traction over weight at slips evenly spaced from 0 to 1, which takes the place of ``slip_ratio``; without any
    # the thrust curve is straight
    thrust_ratio: tuple[float, ...] = ()
    # by how much the traction at a slip grows with a load, as a share of the load's own share
    load_ratio: float = 0.0
    # share of the measured tilt that is a slope to drive up; the rest is a body that rides over bumps
    effective_ratio: float = 1.0
    # friction of the rollers of omni wheels over the load, at a speed across of the wheels' own
    roller_ratio: float = 0.0


def planar_ground(robot: Robot, soil: Soil) -> Ground:
    """Return what a soil is to a robot that carries its weight on all tyres alike.

    The thrust curve is that of one tyre with its share of the weight; ``slip_ratio`` is its chord through the slip at
    which the robot drives steadily on the level.  How thrust grows with load is taken there, too.  Rollers of omni
    wheels turn freely where the soil does not say what it does to them.

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
    return Ground(
        slip_ratio=max(slip, 1e-3) * normal_n / thrust_n,
        grip_ratio=max(thrusts),
        rolling_ratio=wheel_ground(ground, normal_n, slip, 0.0)[2] / normal_n,
        scrub_ratio=SCRUB_SHARE * max(thrusts),
        thrust_ratio=tuple(thrusts),
        load_ratio=(more_n / thrust_n - 1.0) / (_MORE - 1.0),
        roller_ratio=float(np.nan_to_num(soil.roller_friction_ratio)),
    )


Inputs = tuple[Array, Array, Array, Array, Array]
"""Wheel speeds and steering (n, wheels), grade and roll (n,), and the disturbance (n, 3) or (0, 3)."""


class Drive(NamedTuple):
    """What a drive is made of: all that is to be written for a new one."""

    record: np.dtype[Any]  # of its numbers, with the field ``body`` of :data:`BODY`
    # from a robot and a ground to its other fields by name
    numbers: Callable[[Robot, Ground], Mapping[str, Any]]
    # the kernel, from that record (1,), the vector of effects, the step in s and inputs to rows (n,) of :data:`TRUTH`
    move: Callable[[Array, Array, float, Inputs], Array]
    drifts: bool = True  # whether the body goes sideways by what the ground adds, and on a side hill


def body_numbers(robot: Robot, ground: Ground) -> Array:
    """Return what a robot and a ground are to every drive, (1,) of :data:`BODY`.

    What a description leaves out does not act: without motors a traction of 1 N counts as 1 A, without a camera the
    speed is that of the body's origin, without delay.
    """
    complete = robot.completed
    motors, camera, body, sensors = complete.motors, complete.camera, complete.body, complete.sensors
    n = len(robot.wheels)
    return filled(
        BODY,
        n_wheels=n,
        track_m=robot.track_m,
        radius_m=robot.wheel_radius_m,
        mass_kg=robot.mass_kg,
        rotating_kg=n * body.wheel_inertia_kgm2 / robot.wheel_radius_m**2,
        yaw_inertia_kgm2=body.yaw_inertia_kgm2,
        nm_per_a=motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio,
        friction_nm=n * motors.friction_nm,
        lever_x_m=camera.lever_x_m,
        lever_y_m=camera.lever_y_m,
        latency_s=camera.latency_s + camera.time_constant_s,
        imu_latency_s=sensors.imu_latency_s,
        imu_lag_s=IMU_LAG_S if isinstance(robot, SwerveRobot) else 0.0,
        encoder_lag_s=sensors.encoder_time_constant_s,
        com_x_m=body.com_x_m,
        com_y_m=body.com_y_m,
        soft_ratio=_slip_per_traction(ground),
        grip_ratio=ground.grip_ratio,
        rolling_ratio=ground.rolling_ratio,
        scrub_ratio=ground.scrub_ratio if robot.skids else 0.0,
        load_ratio=ground.load_ratio,
        effective_ratio=ground.effective_ratio,
        seen_from_above=robot.on_omni_wheels,
    )


def _slip_per_traction(ground: Ground) -> Array:
    """Return slip over traction at slips (N_SLIPS,) evenly spaced from 0 to 1."""
    thrust = np.array(ground.thrust_ratio)
    if thrust.size < 4:
        return np.full(N_SLIPS, ground.slip_ratio)
    slip = np.linspace(0.0, 1.0, thrust.size)
    ratio = np.empty(thrust.size)
    ratio[1:] = slip[1:] / thrust[1:]
    ratio[0] = 2.0 * ratio[1] - ratio[2]
    return ratio if thrust.size == N_SLIPS else np.interp(_SLIPS, slip, ratio)


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
    first = last = n
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
    for k in range(n):
        if k < first or k >= last:
            out[k] = _between(values, k - late - rate * k)
    return out


@inner
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


@inner
def steered(angle: Array, delay_s: float, backlash_rad: float, dt: float) -> Array:
    """Return the angle (n,) of a wheel behind the delay of its linkage and a play of half a width, from its middle."""
    if delay_s != 0.0:
        angle = delayed(angle, delay_s / dt, 0.0)
    if backlash_rad > 0.0:
        follower = angle[0]
        for k in range(angle.size):
            follower = min(max(follower, angle[k] - backlash_rad), angle[k] + backlash_rad)
            angle[k] = follower
    return angle


@inner
def decayed(half_trace: float, determinant: float, dt: float) -> tuple[float, float]:
    """Return ``a, b`` of ``exp(A dt) = a 1 + b A`` of a matrix (2, 2) that does not grow.

    Where roots are close to each other, two cosines are series: they take no more time than a square root.
    """
    x = (half_trace * half_trace - determinant) * dt * dt
    if x > 4.0:
        root = math.sqrt(x)
        quick = half_trace * dt - root
        slow = math.exp(determinant * dt * dt / quick)
        quick = math.exp(quick)
        both, b = 0.5 * (slow + quick), 0.5 * (slow - quick) / root * dt
    else:
        both = b = math.exp(half_trace * dt)
        if x < -4.0:
            root = math.sqrt(-x)
            both *= math.cos(root)
            b *= math.sin(root) / root * dt
        else:
            both *= 1.0 + x / 2.0 * (1.0 + x / 12.0 * (1.0 + x / 30.0 * (1.0 + x / 56.0 * (1.0 + x / 90.0))))
            b *= dt * (
                1.0 + x / 6.0 * (1.0 + x / 20.0 * (1.0 + x / 42.0 * (1.0 + x / 72.0 * (1.0 + x / 110.0))))
            )
    return both - half_trace * b, b
