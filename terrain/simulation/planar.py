"""The planar simulation: from wheels, steering and tilt to motion, currents and what sensors show of them.

One body for all wheeled robots, fed either with what a simulated drive does to the wheels or with what a log
says they did; whatever is wrong about it is a parameter of :mod:`terrain.simulation.effects`, 0 where absent.

- **kinematics** without slip: of a swerve robot the least-squares twist of its wheels' velocities, of a
  skid-steer robot ``u = (v_r + v_l)/2``, ``w = (v_r - v_l)/B``;
- **force**: ``F = m (1 + p) (dv/dt + g sin th) + R``, with the resistance ``R`` of rolling, drag, slip and
  scrub against the motion, and ``f = F / (m g)``;
- **slip**: ``v = u - |u| s(f)``, ``s = c f`` and a shear curve; of a swerve robot, along both of its axes
  alike, with what the roll asks for in ``F`` across.  With the inertia in ``F`` that is a low-pass
  of time constant ``|u| c m (1 + p) / (m g)``, which is stepped exactly for inputs that run straight from
  sample to sample, so that the answer hardly depends on the step;
- **currents**: their sum is ``F r`` along the wheels' mean heading and the motors' friction over the torque
  that an ampere gives at the wheel; of a skid-steer robot also the difference of the sides, from yaw inertia
  and scrub;
- **sensors**: gyro, accelerometer and camera with bias, scale, mounting, latency and their logger's clock.

Load transfer, roughness and, of a skid-steer robot, lateral slip beside that on a side hill are left out:
what they do to a log is noise here.  Sources stand with the effects.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.effects import INDEX

STANDSTILL_MPS = 0.05
"""Speed over which a resistance takes its full size: it opposes motion and pushes nobody at rest."""

ROLLING_MPS = 0.02
"""The same of wheels that roll on contacts of their own; as in the dynamic simulation."""

ENDO_POWER = 0.5
"""Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground."""

SENSED_ONLY: tuple[str, ...] = (
    *("gyro_bias_radps", "gyro_scale_ratio", "accel_bias_mps2", "camera_latency_s", "camera_yaw_rad"),
    *("lever_x_m", "lever_y_m", "motor_constant_ratio", "motor_drift_ratio"),
)
"""Parameters that change what sensors show, and not what the body does."""

MAX_SLIP = 0.9

IMU_LAG_S = 0.003
"""Lag of a swerve robot's IMU behind its latency: bandwidths of 47 and 62.5 Hz (Bosch BNO055 data sheet)."""

STIFFEST, STIFFEST_GROUND = 0.1, 1e-6
"""Slip per traction that an effect leaves of the ground's own at the least, and that of the stiffest."""

SHORTEST_M, LIGHTEST_KG = 1e-3, 1e-3
"""Relaxation length of a contact that has none, and what a body without yaw inertia weighs at its wheels."""

DEFLECTION_DAMPING_S = 0.005
"""Damping of the contact as a lead on its deflection; it vanishes in steady rolling and so moves no slip."""

(
    _RADIUS,
    _ONE_SIDED,
    _OFFSET_1,
    _PLAY,
    _STEER_DELAY,
    _YAW_DELAY,
    _GYRO_BIAS,
    _GYRO_SCALE,
    _ACCEL_BIAS,
    _LATENCY,
    _CAMERA_YAW,
    _LEVER_X,
    _LEVER_Y,
    _CLOCK_OFFSET,
    _CLOCK_RATE,
    _LAG,
    _TRACK,
    _TURN_SLIP,
    _FORCE_SLIP,
    _SHEAR_SLIP,
    _SLIP_RESISTANCE,
    _ROLLING,
    _DRAG,
    _PAYLOAD,
    _MOTOR,
    _DRIFT,
    _SCRUB,
    _SIDE_HILL,
    _PITCH_OFFSET,
    _ROLL_OFFSET,
) = (
    INDEX[name]
    for name in (
        "wheel_radius_ratio",
        "one_sided_radius_ratio",
        "steering_offset_1_rad",
        "steering_play_rad",
        "steering_delay_s",
        "yaw_delay_s",
        "gyro_bias_radps",
        "gyro_scale_ratio",
        "accel_bias_mps2",
        "camera_latency_s",
        "camera_yaw_rad",
        "lever_x_m",
        "lever_y_m",
        "clock_offset_s",
        "clock_rate_ratio",
        "encoder_lag_s",
        "effective_track_ratio",
        "turning_slip_ratio",
        "force_slip_ratio",
        "shear_slip_ratio",
        "slip_resistance_ratio",
        "rolling_resistance_ratio",
        "viscous_drag_nspm",
        "payload_ratio",
        "motor_constant_ratio",
        "motor_drift_ratio",
        "scrub_ratio",
        "side_hill_slip_ratio",
        "pitch_offset_rad",
        "roll_offset_rad",
    )
)

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
currents of motors as described, and slip; traction and slip are those along x."""

_VX, _VY, _W, _AX, _F, _I, _TURN_I, _S = range(len(TRUTH))
SKID_WHEELS, SWERVE_WHEELS = 2, 3


class Ground(NamedTuple):
    """A ground as the planar simulation knows it.

    Parameters
    ----------
    slip_ratio : slip a traction of the robot's whole weight would take, were the thrust curve straight
    grip_ratio : largest traction over weight, of the shear curve
    rolling_ratio : resistance over weight
    scrub_ratio : resistance to turning of a skid-steer robot, over weight
    thrust_ratio : traction over weight at slips evenly spaced from 0 to 1, which takes the place of
        ``slip_ratio``; without any the thrust curve is straight
    load_ratio : by how much the traction at a slip grows with a load, as a share of the load's own share
    felt_ratio : share of the measured tilt that is a slope to drive up; the rest is a body that rides over
        bumps
    """

    slip_ratio: float = 0.3
    grip_ratio: float = 0.5
    rolling_ratio: float = 0.05
    scrub_ratio: float = 0.2
    thrust_ratio: tuple[float, ...] = ()
    load_ratio: float = 0.0
    felt_ratio: float = 1.0


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
    felt_ratio: float
    com_x_m: float
    com_y_m: float
    arm_ratio: Array
    spread_m: float
    relaxation_m: float


def make_planar(robot: Robot, ground: Ground) -> Planar:
    """Return the planar simulation of a robot on a ground.

    What a description leaves out does not act: without motors a traction of 1 N counts as 1 A, without a
    camera the speed is that of the body's origin, without delay.
    """
    swerve = robot.drive == "swerve"
    x, y = robot.wheel_positions_m.T
    rows = np.zeros((2 * len(x), 3))
    rows[0::2, 0], rows[0::2, 2] = 1.0, -y
    rows[1::2, 1], rows[1::2, 2] = 1.0, x
    motors, camera, body = robot.motors, robot.camera, robot.body
    n_motors = len(robot.wheels)
    com_m = robot.wheel_positions_m.mean(axis=0) if body is None else np.array([body.com_x_m, body.com_y_m])
    arm_m = robot.wheel_positions_m - com_m
    spread_m = float(np.sqrt((arm_m**2).sum(axis=1).mean()))
    return Planar(
        n_wheels=SWERVE_WHEELS if swerve else SKID_WHEELS,
        to_twist=np.ascontiguousarray(np.linalg.pinv(rows)),
        track_m=robot.track_m,
        radius_m=robot.wheel_radius_m,
        mass_kg=robot.mass_kg,
        rotating_kg=0.0 if body is None else n_motors * body.wheel_inertia_kgm2 / robot.wheel_radius_m**2,
        yaw_inertia_kgm2=0.0 if body is None else body.yaw_inertia_kgm2,
        nm_per_a=robot.wheel_radius_m
        if motors is None
        else motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio,
        friction_nm=0.0 if motors is None else n_motors * motors.friction_nm,
        lever_x_m=0.0 if camera is None else camera.lever_x_m,
        lever_y_m=0.0 if camera is None else camera.lever_y_m,
        latency_s=0.0 if camera is None else camera.latency_s + camera.time_constant_s,
        imu_latency_s=0.0 if robot.sensors is None else robot.sensors.imu_latency_s,
        imu_lag_s=IMU_LAG_S if swerve else 0.0,
        encoder_lag_s=0.0 if robot.sensors is None else robot.sensors.encoder_time_constant_s,
        slip_ratio=ground.slip_ratio,
        soft_ratio=_slip_per_traction(ground),
        grip_ratio=ground.grip_ratio,
        rolling_ratio=ground.rolling_ratio,
        scrub_ratio=ground.scrub_ratio if not swerve else 0.0,
        load_ratio=ground.load_ratio,
        felt_ratio=ground.felt_ratio,
        com_x_m=float(com_m[0]),
        com_y_m=float(com_m[1]),
        arm_ratio=np.ascontiguousarray(arm_m / spread_m),
        spread_m=spread_m,
        relaxation_m=0.0 if body is None else body.relaxation_length_m,
    )


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


@njit(cache=True)
def direction(speed_mps: float) -> float:
    """Return which way something moves, -1 to 1, and 0 at rest.

    Examples
    --------
    >>> round(direction(0.5), 3), direction(0.0)
    (0.995, 0.0)
    """
    return speed_mps / math.sqrt(speed_mps * speed_mps + STANDSTILL_MPS * STANDSTILL_MPS)


@njit(cache=True)
def shear_slip(force_ratio: float, grip_ratio: float) -> float:
    """Return the slip of a shear curve whose slip per force is 1 at the start; its end at 95 % of the grip.

    ``f/f_max = 1 - (1 - exp(-x))/x`` is solved for ``x``, and ``s = x f_max / 2``: ``x = 2 f/f_max`` for
    small forces.

    Examples
    --------
    >>> round(shear_slip(0.001, 0.5), 5), round(shear_slip(0.25, 0.5), 3)
    (0.001, 0.398)
    """
    part = min(abs(force_ratio) / grip_ratio, 0.95)
    if part < 1e-9:
        return force_ratio
    # start from the two ends' forms, then Newton
    x = 2.0 * part + part * part * part / (1.0 - part)
    for _ in range(6):
        e = math.exp(-x)
        value = 1.0 - (1.0 - e) / x - part if x > 1e-4 else 0.5 * x - x * x / 6.0 - part
        slope = (1.0 - e - x * e) / (x * x) if x > 1e-4 else 0.5 - x / 3.0
        x = max(x - value / slope, 1e-9)
    return math.copysign(0.5 * grip_ratio * x, force_ratio)


@njit(cache=True)
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


@njit(cache=True)
def move(
    planar: Planar,
    p: Array,
    dt: float,
    rim_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return what the body does, (n, len(TRUTH)).

    Parameters
    ----------
    planar, p : the simulation, and its parameters in the order of ``effects.PARAMETERS``
    dt : step in s
    rim_mps : (n, wheels) wheel rates times the nominal radius
    steer_rad : (n, wheels) angles as encoders without error show them; not looked at for a skid-steer robot
    grade_rad, roll_rad : (n,) true tilt
    disturbance : (n, 3) what the ground adds to speeds (shares of ``|u|``, along and across) and yaw rate
        (rad/s), or none: (0, 3)
    """
    out = np.zeros((rim_mps.shape[0], 8))
    if planar.n_wheels == SWERVE_WHEELS:
        _move_swerve(planar, p, dt, rim_mps, steer_rad, grade_rad, roll_rad, disturbance, out)
    else:
        _move_skid(planar, p, dt, rim_mps, grade_rad, disturbance, out)
    for k in range(out.shape[0]):
        fast = math.sqrt(out[k, _VX] * out[k, _VX] + out[k, _VY] * out[k, _VY])
        out[k, _VY] -= p[_SIDE_HILL] * planar.felt_ratio * roll_rad[k] * fast
        if disturbance.shape[0] > 0:
            out[k, _VY] += fast * disturbance[k, 1]
            out[k, _W] += disturbance[k, 2]
    accel = slopes(out[:, _VX].copy(), dt)
    for k in range(out.shape[0]):
        out[k, _AX] = accel[k] - out[k, _W] * out[k, _VY] + GRAVITY_MPS2 * math.sin(grade_rad[k])
    return out


@njit(cache=True)
def _slip_at(soft_ratio: Array, slip: float) -> float:
    """Return slip over traction of the ground at a slip."""
    last = soft_ratio.size - 1
    at = min(slip, 1.0) * last
    i = min(int(at), last - 1)
    return float(soft_ratio[i] + (at - i) * (soft_ratio[i + 1] - soft_ratio[i]))


@njit(cache=True)
def _sheared(force_ratio: float, grip_ratio: float) -> float:
    """Return slip over traction of a shear curve that starts with 1."""
    return shear_slip(force_ratio, grip_ratio) / force_ratio if abs(force_ratio) > 1e-9 else 1.0


@njit(cache=True)
def _move_swerve(
    planar: Planar,
    p: Array,
    dt: float,
    rim_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
    out: Array,
) -> None:
    """Write motion, traction and current; slip and traction are twists, see the head of the module."""
    n = out.shape[0]
    u, pace, mean_rim, heading = _rolled(planar, p, dt, rim_mps, steer_rad)
    weight = planar.mass_kg * GRAVITY_MPS2
    load = 1.0 + p[_PAYLOAD]
    pressed = load / (1.0 + planar.load_ratio * p[_PAYLOAD])
    mass = planar.mass_kg * load
    spin_kg = max(planar.yaw_inertia_kgm2 / planar.spread_m**2, LIGHTEST_KG) * load
    rolling = (planar.rolling_ratio + p[_ROLLING]) * (1.0 + p[_PAYLOAD]) * weight
    gravity = GRAVITY_MPS2 * planar.felt_ratio
    ground, sigma, damping = planar.soft_ratio, max(planar.relaxation_m, SHORTEST_M), DEFLECTION_DAMPING_S
    by_sigma, by_dt, by_spread = 1.0 / sigma, 1.0 / dt, 1.0 / planar.spread_m
    # the contact springs as much whatever it carries
    resisting = load * weight / mass, load * weight / mass, load * weight / spin_kg
    yielding = 1.0 / resisting[0], 1.0 / resisting[1], 1.0 / resisting[2]
    by_mass, by_spin = 1.0 / mass, 1.0 / spin_kg
    if disturbance.shape[0] > 0:
        u[0] -= pace * disturbance[:, 0]
    changing = np.empty((3, n))
    for i in range(3):
        rate = slopes(u[i], dt)
        changing[i] = rate
        for k in range(1, n - 1):  # straight lines between what comes out run on average where it goes
            changing[i, k] -= (rate[k - 1] - 2.0 * rate[k] + rate[k + 1]) / 12.0
    lost, z, f = np.zeros(3), np.zeros(3), np.zeros(3)  # speed lost by slip, slip, traction over weight
    pushed, pushed_before, lost_before = np.zeros(3), np.zeros(3), np.zeros(3)
    size, size_before, alpha, beta, kappa = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v_x = u[0, k] - 2.0 * lost[0] + lost_before[0]  # as slip goes on
        v_y = u[1, k] - 2.0 * lost[1] + lost_before[1]
        v_w = u[2, k] - 2.0 * lost[2] + lost_before[2]
        fast = math.sqrt(v_x * v_x + v_y * v_y + v_w * v_w + ROLLING_MPS * ROLLING_MPS)
        resists = (rolling + p[_SLIP_RESISTANCE] * size * weight) / fast + p[_DRAG]
        w, resists_by_mass = v_w * by_spread, resists * by_mass
        pushed[0] = changing[0, k] + gravity * math.sin(grade_rad[k]) - w * v_y + resists_by_mass * v_x
        pushed[1] = changing[1, k] + gravity * math.sin(roll_rad[k]) + w * v_x + resists_by_mass * v_y
        pushed[2] = changing[2, k] + resists * by_spin * v_w
        soft = max(_slip_at(ground, max(1.5 * size - 0.5 * size_before, 0.0)), STIFFEST_GROUND)
        more = p[_FORCE_SLIP]
        if p[_SHEAR_SLIP] != 0.0:
            more += p[_SHEAR_SLIP] * _sheared(load * math.sqrt(f[0] * f[0] + f[1] * f[1]), planar.grip_ratio)
        roll = 0.5 * (pace[k] + pace[k - 1]) if k > 0 else pace[0]
        by_soft = 1.0 / soft
        creep_now = max(pressed + load * more * by_soft, STIFFEST)
        creep, creep_now = roll * creep_now, pace[k] * creep_now
        size_before, size = size, 0.0
        for i in range(3):
            yields = soft * yielding[i]
            if k == 0:
                z[i], lost[i] = yields * pushed[i], creep * yields * pushed[i]
                lost_before[i] = lost[i]
                f[i] = z[i] * by_soft
            else:
                if i != 1:  # the two axes of the ground are alike
                    kappa = by_soft * resisting[i]
                    alpha, beta = _decayed(-0.5 * (kappa * damping + creep) * by_sigma, kappa * by_sigma, dt)
                # what lasts, of a push that grows evenly, and what of the rest is left after the step
                z_grows = yields * (pushed[i] - pushed_before[i]) * by_dt
                z_lasts = yields * (pushed_before[i] - creep * z_grows) - damping * z_grows
                lost_before[i] = lost[i]
                off = lost[i] - (creep * z_lasts + sigma * z_grows)
                z_off = z[i] - z_lasts
                z_rate = (off - creep * z_off) * by_sigma
                z[i] = z_lasts + z_grows * dt + alpha * z_off + beta * z_rate
                lost[i] = creep * (z_lasts + z_grows * dt) + sigma * z_grows
                lost[i] += alpha * off - beta * kappa * (z_off + damping * z_rate)
                f[i] = (z[i] + damping * by_sigma * (lost[i] - creep_now * z[i])) * by_soft
            pushed_before[i] = pushed[i]
            size += z[i] * z[i]
        size = pressed * math.sqrt(size)
        w = (u[2, k] - lost[2]) * by_spread
        out[k, _VX] = u[0, k] - lost[0] + w * planar.com_y_m
        out[k, _VY] = u[1, k] - lost[1] - w * planar.com_x_m
        out[k, _W] = w
        out[k, _F] = load * weight * f[0]
        out[k, _S] = (pressed * soft + load * more) * f[0]
        out[k, _I] = load * weight * (heading[0, k] * f[0] + heading[1, k] * f[1] + heading[2, k] * f[2])
    spun = slopes(mean_rim, dt)
    for k in range(n):
        torque = (out[k, _I] + planar.rotating_kg * spun[k]) * planar.radius_m
        way = mean_rim[k] / math.sqrt(mean_rim[k] * mean_rim[k] + ROLLING_MPS * ROLLING_MPS)
        out[k, _I] = (torque + planar.friction_nm * way) / planar.nm_per_a


_COSH = tuple(1.0 / math.factorial(2 * i) for i in range(1, 6))
_SINH = tuple(1.0 / math.factorial(2 * i + 1) for i in range(1, 6))


@njit(cache=True)
def _decayed(half_trace: float, determinant: float, dt: float) -> tuple[float, float]:
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


@njit(cache=True)
def _rolled(
    planar: Planar, p: Array, dt: float, rim_mps: Array, steer_rad: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the twist without slip, the rims' root mean square and mean, and what tractions pull.

    (3, n), (n,), (n,), and (3, n): what a traction in each direction of the twist pulls along the wheels.
    """
    n = rim_mps.shape[0]
    scale = 1.0 + p[_RADIUS]
    right, left = 1.0 + 0.5 * p[_ONE_SIDED], 1.0 - 0.5 * p[_ONE_SIDED]
    u, heading, angle = np.zeros((3, n)), np.zeros((3, n)), np.empty((3, n))
    pace, mean_rim = np.empty(n), np.empty(n)
    for i in range(3):
        angle[i] = steer_rad[:, i] + p[_OFFSET_1 + i]
        if p[_STEER_DELAY] != 0.0:
            angle[i] = delayed(angle[i], p[_STEER_DELAY] / dt, 0.0)
        if p[_PLAY] > 0.0:
            _play(angle[i], p[_PLAY])
    for k in range(n):
        square, total = 0.0, 0.0
        for i in range(3):
            rim = rim_mps[k, i] * scale * (right if i == 2 else left)
            square += rim * rim
            total += rim
            cos, sin = math.cos(angle[i, k]), math.sin(angle[i, k])
            for j in range(3):
                told = planar.to_twist[j, 2 * i] * cos + planar.to_twist[j, 2 * i + 1] * sin
                u[j, k] += rim * told
            heading[0, k] += cos / 3.0
            heading[1, k] += sin / 3.0
            heading[2, k] += (planar.arm_ratio[i, 0] * sin - planar.arm_ratio[i, 1] * cos) / 3.0
        u[0, k] -= u[2, k] * planar.com_y_m
        u[1, k] += u[2, k] * planar.com_x_m
        u[2, k] *= planar.spread_m
        pace[k], mean_rim[k] = math.sqrt(square / 3.0), total / 3.0
    return u, pace, mean_rim, heading


@njit(cache=True)
def _move_skid(
    planar: Planar, p: Array, dt: float, rim_mps: Array, grade_rad: Array, disturbance: Array, out: Array
) -> None:
    """Write motion, traction and currents of a robot whose sides turn alone."""
    n = out.shape[0]
    weight = planar.mass_kg * GRAVITY_MPS2
    mass = planar.mass_kg * (1.0 + p[_PAYLOAD])
    carried = weight * (1.0 + planar.load_ratio * p[_PAYLOAD])
    rolling = (planar.rolling_ratio + p[_ROLLING]) * (1.0 + p[_PAYLOAD]) * weight
    scrub = (planar.scrub_ratio + p[_SCRUB]) * weight
    u, turn, tight, difference = _differed(planar, p, dt, rim_mps)
    speed, rest, ground = np.zeros(n), np.zeros(n), planar.soft_ratio
    target_before, force_ratio, slip = 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS)
        force = mass * GRAVITY_MPS2 * planar.felt_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p[_DRAG] * v + p[_SLIP_RESISTANCE] * abs(slip) * weight * v / smooth
        force += scrub * tight[k] * direction(u[k])
        rest[k] = force
        compliance = _slip_at(ground, abs(slip)) + p[_FORCE_SLIP]
        if p[_SHEAR_SLIP] != 0.0:
            compliance += p[_SHEAR_SLIP] * _sheared(force_ratio, planar.grip_ratio)
        fastest = abs(u[k])
        target = u[k] - fastest * min(max(compliance * force / carried, -MAX_SLIP), MAX_SLIP)
        if disturbance.shape[0] > 0:
            target -= fastest * disturbance[k, 0]
        tau = fastest * compliance * mass / carried
        if k > 0 and tau > 1e-6:
            lead = tau * (target - target_before) / dt
            speed[k] = target - lead + math.exp(-dt / tau) * (speed[k - 1] - target_before + lead)
        else:
            speed[k] = target
        target_before = target
        rate = (speed[k] - speed[k - 1]) / dt if k > 0 else 0.0
        force_ratio = (mass * rate + force) / carried
        slip = min(max(compliance * force_ratio, -MAX_SLIP), MAX_SLIP)
        out[k, _VX], out[k, _W], out[k, _S] = speed[k], turn[k], slip
    accel, wheel, spin = slopes(speed, dt), slopes(u, dt), slopes(turn, dt)
    for k in range(n):
        out[k, _F] = mass * accel[k] + rest[k]
        torque = (out[k, _F] + planar.rotating_kg * wheel[k]) * planar.radius_m
        out[k, _I] = (torque + planar.friction_nm * direction(u[k])) / planar.nm_per_a
        moment = planar.yaw_inertia_kgm2 * (1.0 + p[_PAYLOAD]) * spin[k]
        force = 2.0 * moment / planar.track_m + scrub * tight[k] * direction(difference[k])
        out[k, _TURN_I] = force * planar.radius_m / planar.nm_per_a


@njit(cache=True)
def _differed(planar: Planar, p: Array, dt: float, rim_mps: Array) -> tuple[Array, Array, Array, Array]:
    """Return speed without slip, yaw rate, how tight the turn is and the difference of the sides (n,)."""
    n = rim_mps.shape[0]
    u, turn, tight, difference = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    scale = 1.0 + p[_RADIUS]
    right, left = 1.0 + 0.5 * p[_ONE_SIDED], 1.0 - 0.5 * p[_ONE_SIDED]
    for k in range(n):
        v_l, v_r = rim_mps[k, 0] * scale * left, rim_mps[k, 1] * scale * right
        dv = v_r - v_l
        u[k] = 0.5 * (v_r + v_l)
        size = abs(dv) + 2.0 * abs(u[k])
        tight[k] = abs(dv) / size if size > 1e-6 else 0.0
        lost = p[_TURN_SLIP] * tight[k] * dv
        if lost != 0.0:
            a, b = abs(v_r) ** (1.0 - ENDO_POWER), abs(v_l) ** (1.0 - ENDO_POWER)
            u[k] -= 0.5 * lost * (a - b) / (a + b)
        difference[k] = dv
        turn[k] = (dv - lost) / (planar.track_m * (1.0 + p[_TRACK]))
    if p[_YAW_DELAY] != 0.0:
        turn = delayed(turn, p[_YAW_DELAY] / dt, 0.0)
    return u, turn, tight, difference


@njit(cache=True)
def sense(planar: Planar, p: Array, dt: float, truth: Array) -> Array:
    """Return the channels (n, len(CHANNELS)) that sensors without noise would show.

    Parameters
    ----------
    planar, p, dt : as :func:`move` takes them
    truth : (n, len(TRUTH)) of :func:`move`
    """
    n = truth.shape[0]
    out = np.empty((n, 7))
    lever_x, lever_y = planar.lever_x_m + p[_LEVER_X], planar.lever_y_m + p[_LEVER_Y]
    cos, sin = math.cos(p[_CAMERA_YAW]), math.sin(p[_CAMERA_YAW])
    for k in range(n):
        w = truth[k, _W]
        v_x, v_y = truth[k, _VX] - lever_y * w, truth[k, _VY] + lever_x * w
        out[k, 0] = (1.0 + p[_GYRO_SCALE]) * w + p[_GYRO_BIAS]
        out[k, 1] = cos * v_x - sin * v_y
        out[k, 2] = sin * v_x + cos * v_y
        out[k, 3] = truth[k, _AX] + p[_ACCEL_BIAS]
        warm = (1.0 + p[_MOTOR]) * (1.0 + p[_DRIFT] * k * dt / 60.0)
        out[k, 4] = truth[k, _I] * warm
        out[k, 5] = truth[k, _TURN_I] * warm
        out[k, 6] = w
    offset, rate = p[_CLOCK_OFFSET] / dt, p[_CLOCK_RATE]
    camera, imu = (planar.latency_s + p[_LATENCY]) / dt, (planar.imu_latency_s + planar.imu_lag_s) / dt
    for c in (0, 1, 2, 3, 6):
        late = offset + (imu if c in (0, 3) else camera)
        if late != 0.0 or rate != 0.0:
            out[:, c] = delayed(out[:, c].copy(), late, rate)
    return out


@njit(cache=True)
def replay(
    planar: Planar,
    p: Array,
    dt: float,
    rim_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
) -> Array:
    """Return the channels (n, len(CHANNELS)) that follow from what a log says of wheels, steering and tilt.

    Parameters
    ----------
    planar, p, dt : as :func:`move` takes them
    rim_mps, steer_rad, grade_rad, roll_rad : (n, wheels), (n, wheels), (n,), (n,) as measured: the lag of the
        encoders, the clock and the offsets of the tilt are undone here
    """
    rim, grade, roll = undone(planar, p, dt, rim_mps, grade_rad, roll_rad)
    truth = move(planar, p, dt, rim, steer_rad, grade, roll, np.zeros((0, 3)))
    shown: Array = sense(planar, p, dt, truth)
    return shown


@njit(cache=True)
def undone(
    planar: Planar, p: Array, dt: float, rim_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    """Return rims, grade and roll as they are, of what is measured of them; see :func:`replay`."""
    rim, grade, roll = rim_mps, grade_rad - p[_PITCH_OFFSET], roll_rad - p[_ROLL_OFFSET]
    lag = planar.encoder_lag_s + p[_LAG]
    if lag != 0.0:
        rim = rim_mps.copy()
        for i in range(rim.shape[1]):
            rim[:, i] += lag * slopes(rim_mps[:, i].copy(), dt)
    late = (p[_CLOCK_OFFSET] + planar.imu_latency_s) / dt
    if late != 0.0 or p[_CLOCK_RATE] != 0.0:
        grade = delayed(grade, -late, -p[_CLOCK_RATE])
        roll = delayed(roll, -late, -p[_CLOCK_RATE])
    return rim, grade, roll


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
def _play(angle: Array, half: float) -> None:
    """Let an angle follow itself through a play of half width ``half``, from the middle; in place."""
    follower = angle[0]
    for k in range(angle.size):
        follower = min(max(follower, angle[k] - half), angle[k] + half)
        angle[k] = follower
