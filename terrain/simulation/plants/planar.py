r"""The planar plant: from wheels, steering and tilt to the motion of a body, in whole signals; its sensors and runs.

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

Load transfer and roughness are left out: what they do to a log is noise here.  Sources stand with the effects.

A drive is a :class:`PlanarDrive`: the record of its numbers on a ground, and the kernel of its motion.

**Slip along the heading**, of skid-steer and of car-like robots.  With ``f = (m dv/dt + F) / (m g)`` and ``F`` what
slope and resistances ask for, ``v = u - |u| c f`` is a low-pass of ``u - |u| c F / (m g)`` with the time constant
``|u| c / g``, stepped exactly for what runs straight from sample to sample; of car-like robots, which are fast, the
time constant does, too.

**Skid-steer and tracked robots** turn by their two sides.  Turning slip takes of the difference of the sides by how
tight the turn is, turn drag of the mean by the yaw rate; in fast arcs the track acts narrower.  With friction against
lateral motion, ``m (dv_y/dt + w v) = -K v_y``, the robot slips to the outside of a turn: ``T dv_y/dt + v_y = -c v w``,
``c = T = m/K``; the two are parameters of their own.  The difference of the currents of the sides is that of yaw
inertia, of the moment that resists turning, and, where the sides turn against each other, of the rolling resistance
and friction of each.

**Car-like robots** are the linear single-track model, at rest and fast alike.  With the lateral speed ``c`` of the
centre of mass, ``a`` ahead of the rear axle and ``b`` behind the front one, ``L = a + b``, the yaw rate ``w``, the
speed ``v`` and the steering angle ``d``::

    m (dc/dt + v w) = F_f + F_r - m g sin(ph),      I dw/dt = b F_f - a F_r
    F_f = -C_f (c + b w - v tan d) / |v|,           F_r = -C_r (c - a w) / |v|

as Rajamani, Vehicle Dynamics and Control, has it, with ``tan d`` in place of ``d``, so that at low speed it is the
kinematic bicycle, and ``|v|``, so that it drives backward.  Where nothing changes::

    w = (v tan d - |v| K g sin ph) / (L + K v |v|),     K = m (a / C_f - b / C_r) / L
    v_y = -|v| m b / (L C_r) (v w + g sin ph)           at the rear axle

``x = (c, w)`` follows that, ``dx/dt = A (x - s)``, exactly for an ``s`` that runs straight from sample to sample and
an ``A`` of the step's mean speed.  Understeer is ``K`` more, by a front axle that yields; ``L + K v |v|`` is kept above
a tenth of ``L``: there, near the speed at which a car spins, the linear model ends, and a front axle that yields enough
takes its place.  There are no currents.  A tricycle is one whose front wheel drives, with the speed u: ``v = u cos d``.

**Omni and mecanum robots**: each wheel pulls along its drive direction, rollers resist as they turn.  Wheel i at
:math:`p_i` carries the share :math:`n_i` of the weight W, turns with the circumferential speed :math:`u_i`, and with
the twist V of the centre of mass has to turn with :math:`D_i V` for its roller to slip nowhere; its centre moves by
:math:`E_i V` across the roller's axis, which is at an angle :math:`g_i` to its drive direction, 0 of an omni wheel
(:mod:`terrain.kinematics.wheels`); the roller turns with :math:`E_i V + u_i \sin g_i`.
Over the root mean square speed U of the wheels or, where that is larger, of their centres, so that slip does not depend
on speed, the forces on it are

.. math::
    F_i = n_i W C \frac{u_i - D_i V}{U}, \qquad G_i = -r\, n_i W \frac{E_i V + u_i \sin g_i}{U} .

C is the traction over the load of the ground at the root mean square slip of the wheels, over that slip, and r the
friction of the rollers over the load; steady motion depends on :math:`\rho = r / C` alone, the force that it takes on
r and C.  Rolling resistance :math:`R_i` opposes the motion along each wheel.  With the masses M and gravity P of a
slope

.. math:: M \dot V = \sum_i D_i^T (F_i - R_i) + E_i^T G_i + P + M\,(w v_y, -w v_x, 0) .

A contact follows within :math:`U / (C g)`, some milliseconds: steps are implicit in V, which is stable at rest, too,
and without inertia, resistance and slope (:func:`terrain.slip_learning.rollers.steady_twist`) is linear in V,

.. math:: \sum_i n_i \left(D_i^T D_i + \rho\,E_i^T E_i\right) V
    = \sum_i n_i \left(D_i^T - \rho \sin g_i\,E_i^T\right) u_i .

Without roller friction the wheels drive what they roll; with ever more of it the body stands.  A common factor
:math:`1 - \kappa` on V stands for an effective radius, or a scale of what measures V, that is off: it slips alike in
all directions, and no log of both distinguishes the two.  What is assumed: loads of the wheels that follow from the
centre of mass (of more than three wheels those of least squares) and do not shift; one C and r for all wheels;
friction of the rollers that grows with the speed of their turning over U; in steady motion a contact that is linear in
its slip, and no other resistance.

**Swerve robots**: all wheels slip as one contact with the ground, by a twist of three parts: the speeds of the centre
of mass along and across, and the yaw rate times the root mean square distance ``r`` of the wheels from it.  Without
slip they would be ``u``; slip takes ``l`` of each::

    v = u - l,                  dl/dt = a - N f,          a = du/dt + g sin th + w x v + R v
    f = (z + d dz/dt) / s,      sigma dz/dt = l - |u| c z

with the traction ``f`` over the weight, ``N = (g, g, m g r^2 / I)``, the tilt ``th`` of each axis, a resistance ``R``
over the mass, the contact's relaxation length ``sigma``, its damping ``d``, the ground's slip ``s`` per traction, and
by how much a load and effects change it, ``c``; where nothing changes ``l = |u| c s f``.  The three parts meet in
``R``, ``s``, ``c`` and ``w x v`` alone, and each is stepped exactly for an ``a`` that runs straight from sample to
sample.

**Replay** leads from logged wheels, steering and tilt to what the other sensors of the log should show.  Lags, clocks
and offsets that stand between the inputs and their records are corrected first; from there on a replay is the motion
and the sensors of a simulated run.  Sensors without noise have bias, scale, mounting, latency and their logger's clock.

**A run** turns twists into the wheel speeds and steering angles that a controller would command with the described
geometry; the motors follow them with a lag and bounded rates; :func:`move` gives the motion, :func:`sense` the
measurements of sensors without noise; loggers add noise, bias and quantisation.  A hidden effect is a number in the
same vector that a replay has.  The hills are those along the path that the wheels would roll without slip.

The measurement models are those of :mod:`terrain.simulation.sensors`.  The loggers differ from those of the dynamic
plant in three respects, so that a replay of the log can undo them exactly: latency and clock errors are interpolated
delays on a fixed grid, the wheel encoders report the distance over a period, and the noise of a moving robot is
coloured and grows with speed.  Coloured noise is ``x_k = a x_(k-1) + sqrt(1 - a^2) std e_k`` with
``a = exp(-dt / tau)``; every second sample of it is again such a noise.  Its numbers travel with the package, in
``data/spread/planar.yaml``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.constants import GRAVITY_MPS2
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    EFFECTS,
    GYRO,
    GYRO_END,
    HEADING,
    INDEX,
    RESTING_MPS,
    SLIDING_RADPS,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    nuisances_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.files.documents import number, read_yaml
from terrain.files.names import data_folder
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.commands import wheel_motion
from terrain.kinematics.wheels import (
    STEEPEST_RAD,
    point_velocity,
    rolled_twist,
    rolling_matrix,
    velocity_matrix,
    wheel_frame_velocities,
)
from terrain.learned_term import LearnedTerm, add_terms
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS, TWIST
from terrain.records import Array, Label, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot
from terrain.simulation import sensors as sensing
from terrain.simulation.plants.dynamic import DEFLECTION_DAMPING_S, shear_slip
from terrain.simulation.scenario import RATE_HZ, Conditions, Scenario
from terrain.simulation.sensors import BODY
from terrain.slip import slip_angle, slip_ratio
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import equilibrium_slip, ground_record, wheel_ground


@njit
def softness(soft_ratio: Array, slip: float) -> float:
    """Return slip over traction of the ground at a slip.

    Examples
    --------
    >>> import numpy as np
    >>> round(softness(np.array([0.3, 0.4, 0.6]), 0.75), 3)
    0.5
    """
    last = soft_ratio.size - 1
    at = min(slip, 1.0) * last
    i = min(int(at), last - 1)
    return float(soft_ratio[i] + (at - i) * (soft_ratio[i + 1] - soft_ratio[i]))


@inner
def shear_softness(force_ratio: float, grip_ratio: float) -> float:
    """Return slip over traction of a shear curve that starts with 1."""
    return shear_slip(force_ratio, grip_ratio) / force_ratio if abs(force_ratio) > 1e-9 else 1.0


TRUTH = record(
    numbers(
        "speed_x_mps speed_y_mps yaw_rate_radps accel_x_mps2 force_n current_a turning_current_a slip_ratio "
        "gyro_error_radps"
    )
)
"""What the body does, before any sensor: speeds of the body's origin, specific force along x, traction, currents of
motors as described, slip, and what a gyro reads too much; traction and slip are those along x, of an omni robot the
slip of the body along what its wheels roll, and the sum of its currents' magnitudes."""

N_SLIPS = 101
_SLIPS = np.linspace(0.0, 1.0, N_SLIPS)

PLANAR_BODY = record(
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
# By how much less resists turning the larger its radius: 0.15 / 0.925 in Nikitin's formula, see ``turning_resistance``.
NIKITIN = 0.16
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


class PlanarDrive(NamedTuple):
    """What a drive is made of: all that is to be written for a new one."""

    record: np.dtype[Any]  # of its numbers, with the field ``body`` of :data:`PLANAR_BODY`
    # from a robot and a ground to its other fields by name
    numbers: Callable[[Robot, Ground], Mapping[str, Any]]
    # the kernel, from that record (1,), the vector of effects, the step in s and inputs to rows (n,) of :data:`TRUTH`
    move: Callable[[Array, Array, float, Inputs], Array]
    drifts: bool = True  # whether the body goes sideways by what the ground adds, and on a side hill


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
    for k in range(n):
        at = min(max(k - late - rate * k, 0.0), n - 1.0)
        i = min(int(at), n - 2)
        x = at - i
        if 1 <= i < n - 2:
            out[k] = (
                -x * (x - 1.0) * (x - 2.0) / 6.0 * values[i - 1]
                + (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0 * values[i]
                - (x + 1.0) * x * (x - 2.0) / 2.0 * values[i + 1]
                + (x + 1.0) * x * (x - 1.0) / 6.0 * values[i + 2]
            )
        else:
            out[k] = values[i] + x * (values[i + 1] - values[i])
    return out


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
def steered(angle: Array, p: Any, dt: float) -> Array:
    """Return the angle (n,) of a wheel behind lag, delay and play of its linkage, from the middle of the play."""
    angle, backlash_rad = lagged(angle, p.steering_lag_s, dt), p.steering_backlash_rad
    if p.steering_delay_s != 0.0:
        angle = delayed(angle, p.steering_delay_s / dt, 0.0)
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


# Slip that forces take at the most, of either sign; assumed: a straight thrust curve has no end of its own.
MAX_SLIP = 0.9
# Shorter time constants are none; one that falls faster than the second, in s/s, is taken as even.
SHORTEST_S, FALLS_MOST = 1e-6, -0.9
# Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground, and ``turning_slip_power`` does on
# tracks.
ENDO_POWER = 0.5

SIDES = record({"body": PLANAR_BODY, "tracked": bool})


@njit
def direction(speed_mps: float) -> float:
    """Return the direction of a motion, -1 to 1, and 0 at rest.

    Examples
    --------
    >>> round(direction(0.5), 3), direction(0.0)
    (0.995, 0.0)
    """
    return speed_mps / math.sqrt(speed_mps * speed_mps + RESTING_MPS * RESTING_MPS)


@inner
def turned_wheels(encoder_mps: Array, p: Any, radius_m: float, dt: float) -> Array:
    """Return wheel speeds (n, wheels) from those of encoders on the motors: a dead zone, then backlash of the gears.

    The wheel stays within the play about the motor, and moves by that part of the motor's steps before and after a
    sample that carries it along: of the last step alone it would lose half a step more at each reversal.
    """
    dead_mps, play_m = p.wheel_dead_zone_mps, p.drive_backlash_rad * radius_m
    if dead_mps == 0.0 and play_m <= 0.0:
        return encoder_mps
    out = encoder_mps.copy()
    for i in range(out.shape[1]):
        before, ahead = 0.0, 0.0
        for k in range(out.shape[0]):
            speed = out[k, i] + dead_mps * direction(out[k, i])
            out[k, i] = speed
            if play_m > 0.0:
                step, coming = 0.0, dt * speed
                if k > 0:  # as it goes on
                    step, coming = 0.5 * dt * (before + speed), 0.5 * dt * (3.0 * speed - before)
                now = min(max(ahead - step, -play_m), play_m)
                after = min(max(now - coming, -play_m), play_m)
                if coming != 0.0:
                    carried = 1.0 + (after - now) / coming
                    out[k, i] *= 0.5 * (carried + (1.0 + (now - ahead) / step if step != 0.0 else carried))
                ahead = now
            before = speed
    return out


@inner
def slip_along(
    body: Any, p: Any, dt: float, u: Array, scrub_n: Array, grade_rad: Array, disturbance: Array, fast: bool
) -> tuple[Array, Array, Array]:
    """Return speed over ground, resistance with the slope, and slip (n,)."""
    n = u.size
    weight = body.mass_kg * GRAVITY_MPS2
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    carried = weight * (1.0 + body.load_ratio * p.payload_ratio)
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    speed, rest, slips, ground = np.zeros(n), np.zeros(n), np.zeros(n), body.soft_ratio
    target_before, tau_before, force_ratio, slip = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + RESTING_MPS * RESTING_MPS)
        force = mass * GRAVITY_MPS2 * body.effective_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p.viscous_drag_nspm * v + p.slip_resistance_ratio * abs(slip) * weight * v / smooth
        force += scrub_n[k]
        rest[k] = force
        compliance = softness(ground, abs(slip)) + p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            compliance += p.shear_slip_ratio * shear_softness(force_ratio, body.grip_ratio)
        fastest = abs(u[k])
        target = u[k] - fastest * min(max(compliance * force / carried, -MAX_SLIP), MAX_SLIP)
        if disturbance.shape[0] > 0:
            target -= fastest * disturbance[k, 0]
        tau = fastest * compliance * mass / carried
        grows = (tau - tau_before) / dt
        if fast and min(tau, tau_before) > SHORTEST_S and grows > FALLS_MOST:
            slope = (target - target_before) / (dt * (1.0 + grows))
            off = speed[k - 1] - target_before + tau_before * slope
            # what a step leaves of an offset, v' = -v / tau, as tau runs straight
            change = math.log(tau / tau_before)
            if abs(change) < 1e-3:
                remaining = math.exp(-2.0 * dt / (tau_before + tau))
            else:
                remaining = math.exp(-dt * change / (tau - tau_before))
            speed[k] = target - tau * slope + remaining * off
        elif k > 0 and tau > SHORTEST_S:
            lead = tau * (target - target_before) / dt
            speed[k] = target - lead + math.exp(-dt / tau) * (speed[k - 1] - target_before + lead)
        else:
            speed[k] = target
        target_before, tau_before = target, tau
        rate = (speed[k] - speed[k - 1]) / dt if k > 0 else 0.0
        force_ratio = (mass * rate + force) / carried
        slip = min(max(compliance * force_ratio, -MAX_SLIP), MAX_SLIP)
        slips[k] = slip
    return speed, rest, slips


@inner
def _move_skid(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    wheel_speed_mps, _steer_rad, grade_rad, _roll_rad, disturbance = inputs
    body, p, n = params[0].body, vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros(n, TRUTH)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    weight = body.mass_kg * GRAVITY_MPS2
    scrub, turning = (
        (body.scrub_ratio + p.scrub_ratio) * weight,
        (body.scrub_ratio + p.turning_resistance_ratio) * weight,
    )
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    wheels = turned_wheels(wheel_speed_mps, p, body.radius_m, dt)
    scale = 1.0 + p.wheel_radius_ratio
    radius_m = body.radius_m * scale
    right, left = 1.0 + 0.5 * p.one_sided_radius_ratio, 1.0 - 0.5 * p.one_sided_radius_ratio
    # speed without slip, yaw rate, how tight the turn is, difference of the sides
    u, turn, tight, scrub_n = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    # what resists turning, and how the two sides differ in what resists each of them
    moment_n, apart = np.empty(n), np.empty(n)
    for k in range(n):
        v_l, v_r = wheels[k, 0] * scale * left, wheels[k, 1] * scale * right
        dv = v_r - v_l
        u[k] = 0.5 * (v_r + v_l)
        size = abs(dv) + 2.0 * abs(u[k])
        tight[k] = abs(dv) / size if size > 1e-6 else 0.0
        lost = p.turning_slip_ratio * tight[k] * dv
        if lost != 0.0:
            share = 1.0 - ENDO_POWER - (p.turning_slip_power_ratio if params[0].tracked else 0.0)
            a, b = abs(v_r) ** share, abs(v_l) ** share
            u[k] -= 0.5 * lost * (a - b) / (a + b)
        size = abs(dv) + NIKITIN * abs(u[k])
        moment_n[k] = turning * (abs(dv) / size if size > 1e-6 else 0.0) * direction(dv)
        moment_n[k] += 0.5 * p.viscous_drag_nspm * dv
        apart[k] = 0.5 * (direction(v_r) - direction(v_l))
        turn[k] = (dv - lost) / (body.track_m * (1.0 + p.effective_track_ratio))
        if p.track_narrowing_s2pm2 != 0.0 or p.track_narrowing_by_turn_ratio != 0.0:
            x = p.track_narrowing_s2pm2 * (u[k] * turn[k]) ** 2 / (1.0 + (turn[k] / SLIDING_RADPS) ** 2)
            x += p.track_narrowing_by_turn_ratio * abs(turn[k]) / (SLIDING_RADPS + abs(turn[k]))
            turn[k] *= 1.0 + x / (1.0 + abs(x))
    if p.yaw_delay_s != 0.0:
        turn = delayed(turn, p.yaw_delay_s / dt, 0.0)
    for k in range(n):
        drag = p.turn_drag_s2 * turn[k] * turn[k]
        u[k] *= 1.0 / (1.0 + drag) if drag > 0.0 else 1.0 - drag  # never turns the motion about
        u[k] *= 1.0 - p.ground_slip_ratio
        scrub_n[k] = scrub * tight[k] * direction(u[k])
    speed, rest, slip = slip_along(body, p, dt, u, scrub_n, grade_rad, disturbance, False)
    out["speed_x_mps"][:], out["yaw_rate_radps"][:], out["slip_ratio"][:] = speed, turn, slip
    accel, wheel, spin = slopes(speed, dt), slopes(u, dt), slopes(turn, dt)
    for k in range(n):
        row = out[k]
        row.force_n = mass * accel[k] + rest[k]
        torque = (row.force_n + body.rotating_kg * wheel[k]) * radius_m
        row.current_a = (torque + body.friction_nm * direction(u[k])) / body.nm_per_a
        moment = body.yaw_inertia_kgm2 * (1.0 + p.payload_ratio) * spin[k]
        resists = rolling + p.slip_resistance_ratio * abs(slip[k]) * weight
        force = 2.0 * moment / body.track_m + moment_n[k] + resists * apart[k]
        row.turning_current_a = (force * radius_m + body.friction_nm * apart[k]) / body.nm_per_a
    if p.turn_side_slip_s != 0.0:
        out["speed_y_mps"][:] = lagged(-p.turn_side_slip_s * speed * turn, p.side_slip_build_up_s, dt)
    return out


SKID = PlanarDrive(SIDES, lambda robot, ground: {"tracked": isinstance(robot, TrackedRobot)}, _move_skid)


SLOW_MPS = 0.01  # speed below which tyres damp a sideways motion as at it: in less than a millisecond
# The effective wheelbase over the wheelbase at the least, and what is left of an axle's compliance.
LEAST_RATIO = 0.1

_AXLES = "wheelbase_m com_ahead_m front_cornering_npr rear_cornering_npr yaw_inertia_kgm2"
AXLES = record({"body": PLANAR_BODY} | numbers(_AXLES) | {"front_driven": bool})


@inner
def _move_bicycle(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    """Return motion and traction: the last wheel is the rear one, the first, with its angle, the front one."""
    wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance = inputs
    body, p, n = params[0].body, vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros(n, TRUTH)
    angle = (1.0 + p.steering_gain_ratio) * steer_rad[:, 0]
    if p.steering_dead_zone_rad > 0.0:
        for k in range(n):
            angle[k] -= min(max(angle[k], -p.steering_dead_zone_rad), p.steering_dead_zone_rad)
    steer = steered(angle + p.steering_offset_front_rad, p, dt)
    wheels = turned_wheels(wheel_speed_mps, p, body.radius_m, dt)
    turned = np.cos(np.minimum(np.abs(steer), STEEPEST_RAD))
    driven = wheels[:, 0] * turned if params[0].front_driven else wheels[:, -1]
    u = driven * (1.0 + p.wheel_radius_ratio)
    speed, rest, slip = slip_along(body, p, dt, u, np.zeros(n), grade_rad, disturbance, True)
    accel = slopes(speed, dt)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    for k in range(n):
        out[k].force_n = mass * accel[k] + rest[k]
        out[k].speed_x_mps, out[k].slip_ratio = speed[k], slip[k]
    car, nominal = params[0], body.mass_kg
    inertia = car.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    wheelbase, a = car.wheelbase_m * (1.0 + p.wheelbase_ratio), car.com_ahead_m
    b = wheelbase - a
    soft = 1.0 / (1.0 + p.cornering_stiffness_ratio)
    front = soft / car.front_cornering_npr  # compliance of the axles
    rear = soft / car.rear_cornering_npr
    front = max(front + p.understeer_s2pm * wheelbase / (nominal * a), LEAST_RATIO * front)
    gravity = GRAVITY_MPS2 * body.effective_ratio
    c = w = c_before = w_before = 0.0  # of the body, and the steady ones of the sample before
    for k in range(out.shape[0]):
        v = out[k].speed_x_mps
        fast = abs(v)
        yields = _front(mass, wheelbase, a, front, rear, v)
        understeer = mass * (a * yields - b * rear) / wheelbase
        down = gravity * math.sin(roll_rad[k])
        angle = min(max(steer[k], -STEEPEST_RAD), STEEPEST_RAD)
        w_now = (v * math.tan(angle) - fast * understeer * down) / (wheelbase + understeer * v * fast)
        y_now = -fast * mass * b * rear / wheelbase * (v * w_now + down)
        c_now = y_now + a * w_now
        middle = 0.5 * (v + out[k - 1].speed_x_mps) if k > 0 else 0.0
        if middle == 0.0:  # at the start, and at rest
            c, w = c_now, w_now
        else:
            yields = _front(mass, wheelbase, a, front, rear, middle)
            by_speed = 1.0 / max(abs(middle), SLOW_MPS)
            c_f, c_r = by_speed / yields, by_speed / rear
            moment = b * c_f - a * c_r
            cc, cw = -(c_f + c_r) / mass, -moment / mass - middle
            wc, ww = -moment / inertia, -(b * b * c_f + a * a * c_r) / inertia
            determinant = cc * ww - cw * wc
            c_rate, w_rate = (c_now - c_before) / dt, (w_now - w_before) / dt
            c_lag = (ww * c_rate - cw * w_rate) / determinant
            w_lag = (cc * w_rate - wc * c_rate) / determinant
            one, by_a = decayed(0.5 * (cc + ww), determinant, dt)
            c_off, w_off = c - c_before - c_lag, w - w_before - w_lag
            c = c_now + c_lag + one * c_off + by_a * (cc * c_off + cw * w_off)
            w = w_now + w_lag + one * w_off + by_a * (wc * c_off + ww * w_off)
        c_before, w_before = c_now, w_now
        out[k].speed_y_mps, out[k].yaw_rate_radps = c - a * w, w
    return out


@inner
def _front(mass: float, wheelbase: float, a: float, front: float, rear: float, v: float) -> float:
    """Return the compliance of the front axle at a speed: one with which the body does not spin."""
    fast = v * abs(v)
    least = -(1.0 - LEAST_RATIO) * wheelbase / fast if fast != 0.0 else 0.0
    understeer = mass * (a * front - (wheelbase - a) * rear) / wheelbase
    if fast * understeer < fast * least:
        return (least * wheelbase / mass + (wheelbase - a) * rear) / a
    return front


BICYCLE = PlanarDrive(
    AXLES,
    lambda robot, ground: {name: getattr(robot, name) for name in (*_AXLES.split(), "front_driven")},
    _move_bicycle,
)


# Speed below which slip is no more over the speed itself, and over which a resistance takes its full size; assumed:
# a fifth of the slowest measured drive.
ROLLING_MPS = 0.02
# Speed of a wheel over which its motor's dry friction takes its full size: about a tick of an encoder in a sample, as a
# wheel that hardly turns, of a robot that drives nearly along its axle, draws what the others do.
TURNING_MPS = 0.004
# Slip per traction that an effect leaves of the ground's own at the least, and that of the stiffest.
STIFFEST, STIFFEST_GROUND = 0.1, 1e-6
# Implicit steps within one of the simulation, so that their lag, half of each, is about a millisecond.
SUBSTEPS = 4


def rollers_record(wheels: int) -> np.dtype[Any]:
    """Return the record of a robot on so many wheels with rollers.

    ``along`` and ``across`` (wheels, 3) give the speed of each wheel and that of its centre across its roller's axis
    for a twist of the centre of mass, ``sine`` (wheels,) that of the angle of the axis, ``to_rolled`` (3, wheels) the
    twist of the body without slip; ``place_m`` (wheels, 2) is in the body.
    """
    return record(
        {"body": PLANAR_BODY, **dict.fromkeys(("wheel_load_ratio", "sine"), (float, wheels))}
        | dict.fromkeys(("along", "across"), (float, (wheels, 3)))
        | {"to_rolled": (float, (3, wheels)), "place_m": (float, (wheels, 2))}
        | numbers("wheel_distance_m roller_ratio")
    )


def _omni_numbers(robot: Robot, ground: Ground) -> dict[str, Any]:
    body, place_m = robot.completed.body, robot.wheel_positions_m
    direction, roller = robot.wheel_directions_rad, robot.roller_angles_rad
    arm_m = place_m - np.array([body.com_x_m, body.com_y_m])
    moments, rolled = np.vstack([np.ones(len(arm_m)), arm_m.T]), rolling_matrix(place_m, direction, roller)
    return {
        "along": rolling_matrix(arm_m, direction, roller),
        "across": rolling_matrix(arm_m, direction + roller + np.pi / 2),
        "sine": np.sin(roller),
        "to_rolled": np.linalg.pinv(rolled),
        "place_m": place_m,
        "wheel_load_ratio": np.linalg.pinv(moments) @ np.array([1.0, 0.0, 0.0]),
        "wheel_distance_m": float(np.abs(rolled[0, 2])),
        "roller_ratio": ground.roller_ratio,
    }


@inner
def _move_omni(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    """Return motion and net traction along x; the current is the sum of the magnitudes of :func:`currents_of`."""
    wheel_speed_mps, _steer_rad, grade_rad, roll_rad, disturbance = inputs
    rollers, p, n = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    body, out = rollers.body, np.zeros(n, TRUTH)
    turned = turned_wheels(wheel_speed_mps, p, body.radius_m, dt)
    along, across, load = _placed(rollers, p)
    com_x, com_y = body.com_x_m + p.load_shift_x_m, body.com_y_m + p.load_shift_y_m
    friction = rollers.roller_ratio + p.roller_friction_ratio
    twist, before = np.zeros(3), np.zeros(3)
    matrix, pushed = np.empty((3, 3)), np.empty(3)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    inertia = mass, mass, body.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    weight, gravity = mass * GRAVITY_MPS2, GRAVITY_MPS2 * body.effective_ratio
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * weight
    step, size = dt / SUBSTEPS, 0.0
    for k in range(n):
        slope = (-mass * gravity * math.sin(grade_rad[k]), -mass * gravity * math.sin(roll_rad[k]), 0.0)
        u = turned[k] * (1.0 + p.wheel_radius_ratio)
        last = turned[max(k - 1, 0)] * (1.0 + p.wheel_radius_ratio)
        started_x, started_y = before[0], before[1]
        for part in range(SUBSTEPS):
            wheels = last + (u - last) * ((part + 1) / SUBSTEPS)
            speed = _fastest(along, wheels, before)
            stiff = _stiffness(body, p, size) * weight / speed
            resists = friction * weight / speed
            w = before[2]
            turning = (mass * w * before[1], -mass * w * before[0], 0.0)
            for a in range(3):
                pushed[a] = inertia[a] / step * before[a] + turning[a] + slope[a]
                for b in range(3):
                    matrix[a, b] = inertia[a] / step if a == b else 0.0
            for i in range(body.n_wheels):
                v = _dot(along[i], before)
                share = load[i]
                drag = share * (rolling / math.sqrt(v * v + ROLLING_MPS * ROLLING_MPS) + p.viscous_drag_nspm)
                spun = wheels[i] * rollers.sine[i]
                for a in range(3):
                    pushed[a] += share * (stiff * wheels[i] * along[i, a] - resists * spun * across[i, a])
                    for b in range(3):
                        matrix[a, b] += (share * stiff + drag) * along[i, a] * along[i, b]
                        matrix[a, b] += share * resists * across[i, a] * across[i, b]
            _solve(matrix, pushed, twist)
            slip = 0.0
            for i in range(body.n_wheels):
                slip += (wheels[i] - _dot(along[i], twist)) ** 2
            size = min(math.sqrt(slip / body.n_wheels) / speed, 1.0)
            before[:] = twist
        row = out[k]
        row.speed_x_mps, row.speed_y_mps = twist[0] + twist[2] * com_y, twist[1] - twist[2] * com_x
        row.yaw_rate_radps = twist[2]
        row.force_n = (
            mass * ((twist[0] - started_x) / dt - twist[2] * 0.5 * (twist[1] + started_y)) - slope[0]
        )
    currents_a = currents_of(params, vector, dt, wheel_speed_mps, out)
    for k in range(n):
        for i in range(body.n_wheels):
            out[k].current_a += abs(currents_a[k, i])
        # what the ground adds to the motion takes no force
        if disturbance.shape[0] > 0:
            out[k].speed_x_mps *= 1.0 - disturbance[k, 0]
            out[k].speed_y_mps *= 1.0 - disturbance[k, 0]
        x, y = (
            0.0,
            0.0,
        )  # what the wheels roll, along which the body slips; 0 where neither moves, and in place
        for i in range(body.n_wheels):
            u_i = turned[k, i] * (1.0 + p.wheel_radius_ratio)
            x += rollers.to_rolled[0, i] * u_i
            y += rollers.to_rolled[1, i] * u_i
        rolled = math.sqrt(x * x + y * y)
        if rolled >= ROLLING_MPS:
            ahead = (out[k].speed_x_mps * x + out[k].speed_y_mps * y) / rolled
            out[k].slip_ratio = (rolled - ahead) / max(rolled, abs(ahead))
    return out


@njit
def currents_of(params: Array, vector: Array, dt: float, wheel_speed_mps: Array, truth: Array) -> Array:
    """Return the current (n, wheels) of each motor along a motion: traction, its own inertia and friction.

    Parameters
    ----------
    params : (1,) of :func:`rollers_record`
    vector, dt, wheel_speed_mps : as :func:`~terrain.simulation.plants.planar.move` takes them
    truth : (n,) of the motion, without disturbance
    """
    rollers, p, (n, wheels) = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape
    body, out = rollers.body, np.empty((n, wheels))
    turned = turned_wheels(wheel_speed_mps, p, body.radius_m, dt)
    weight = body.mass_kg * (1.0 + p.payload_ratio) * GRAVITY_MPS2
    radius_m, twist = body.radius_m * (1.0 + p.wheel_radius_ratio), np.empty(3)
    along, across, load = _placed(rollers, p)
    friction = rollers.roller_ratio + p.roller_friction_ratio
    com_x, com_y = body.com_x_m + p.load_shift_x_m, body.com_y_m + p.load_shift_y_m
    spun = np.empty((n, wheels))
    for i in range(wheels):
        spun[:, i] = slopes(turned[:, i].copy(), dt)
    for k in range(n):
        u, w = turned[k] * (1.0 + p.wheel_radius_ratio), truth[k].yaw_rate_radps
        twist[0], twist[1] = truth[k].speed_x_mps - w * com_y, truth[k].speed_y_mps + w * com_x
        twist[2] = w
        speed, slip = _fastest(along, u, twist), 0.0
        for i in range(wheels):
            slip += (u[i] - _dot(along[i], twist)) ** 2
        size = min(math.sqrt(slip / wheels) / speed, 1.0)
        stiff = _stiffness(body, p, size) * weight / speed
        for i in range(wheels):
            pull = load[i] * stiff * (u[i] - _dot(along[i], twist))
            turns = _dot(across[i], twist) + u[i] * rollers.sine[i]
            pull += load[i] * friction * weight / speed * turns * rollers.sine[i]
            torque = (pull + body.rotating_kg / wheels * spun[k, i]) * radius_m
            direction = u[i] / math.sqrt(u[i] * u[i] + TURNING_MPS * TURNING_MPS)
            out[k, i] = (torque + body.friction_nm / wheels * direction) / body.nm_per_a
    return out


@inner
def _placed(rollers: Any, p: Any) -> tuple[Array, Array, Array]:
    """Return ``along`` and ``across`` (wheels, 3) and the loads (wheels,) with wheels and load as p has them.

    ``D_i`` and ``E_i`` end in their moments about the centre of mass c, and the loads are the smallest that balance
    about it; one that would be less than nothing is nothing, and the others then do not balance.
    """
    along, across, load = rollers.along.copy(), rollers.across.copy(), rollers.wheel_load_ratio.copy()
    shift_x, shift_y = p.load_shift_x_m, p.load_shift_y_m
    scale = 1.0 + p.wheel_distance_ratio
    if shift_x == 0.0 and shift_y == 0.0 and scale == 1.0:
        return along, across, load
    com_x, com_y, total = rollers.body.com_x_m + shift_x, rollers.body.com_y_m + shift_y, 0.0
    moments, ones, balance = np.zeros((3, 3)), np.array([1.0, 0.0, 0.0]), np.empty(3)
    arm = np.ones((rollers.body.n_wheels, 3))
    for i in range(rollers.body.n_wheels):
        x, y = scale * rollers.place_m[i, 0] - com_x, scale * rollers.place_m[i, 1] - com_y
        along[i, 2] = x * along[i, 1] - y * along[i, 0]
        across[i, 2] = x * across[i, 1] - y * across[i, 0]
        arm[i, 1], arm[i, 2] = x, y
        for a in range(3):
            for b in range(3):
                moments[a, b] += arm[i, a] * arm[i, b]
    _solve(moments, ones, balance)
    for i in range(rollers.body.n_wheels):
        load[i] = max(_dot(arm[i], balance), 0.0)
        total += load[i]
    return along, across, load / total


@inner
def _stiffness(body: Any, p: Any, slip_ratio: float) -> float:
    """Return traction over load and slip of the ground, with the effect that makes it softer."""
    soft = max(softness(body.soft_ratio, slip_ratio), STIFFEST_GROUND)
    return float(1.0 / max(soft + p.force_slip_ratio, STIFFEST * soft))


@inner
def _fastest(along: Array, wheel_speed_mps: Array, twist: Array) -> float:
    """Return the speed U that slip is over: of wheels (wheels,) or their centres, never below a minimum."""
    of_wheels, of_centres, n = 0.0, 0.0, wheel_speed_mps.shape[0]
    for i in range(n):
        of_wheels += wheel_speed_mps[i] ** 2
        of_centres += _dot(along[i], twist) ** 2
    return math.sqrt(max(of_wheels, of_centres) / n + ROLLING_MPS * ROLLING_MPS)


@inner
def _dot(row: Array, twist: Array) -> float:
    product: float = row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]
    return product


@inner
def _solve(matrix: Array, pushed: Array, out: Array) -> None:
    """Solve a symmetric positive system of three in place of ``out``, by Cramer's rule."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    p0, p1, p2 = d * f - e * e, c * e - b * f, b * e - c * d
    by = 1.0 / (a * p0 + b * p1 + c * p2)
    q1, q2, r2 = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = pushed[0], pushed[1], pushed[2]
    out[0] = (p0 * x + p1 * y + p2 * z) * by
    out[1] = (p1 * x + q1 * y + q2 * z) * by
    out[2] = (p2 * x + q2 * y + r2 * z) * by


OMNI = PlanarDrive(rollers_record(3), _omni_numbers, _move_omni, drifts=False)
MECANUM = PlanarDrive(rollers_record(4), _omni_numbers, _move_omni, drifts=False)


# Relaxation length of a contact that has none, and what a body without yaw inertia weighs at its wheels.
SHORTEST_M, LIGHTEST_KG = 1e-3, 1e-3

CONTACT = record(
    {
        "body": PLANAR_BODY,
        "to_twist": (float, (3, 6)),
        "arm_ratio": (float, (3, 2)),
        **numbers("spread_m relaxation_m"),
    }
)
"""``to_twist`` gives the twist of the wheels' velocities; ``spread_m`` is the distance r, and ``arm_ratio`` the wheels'
places about the centre of mass over it."""


def _swerve_numbers(robot: Robot, ground: Ground) -> dict[str, Any]:
    body = robot.completed.body
    arm_m = robot.wheel_positions_m - np.array([body.com_x_m, body.com_y_m])
    spread_m = float(np.sqrt((arm_m**2).sum(axis=1).mean()))
    return {
        "to_twist": np.linalg.pinv(velocity_matrix(robot.wheel_positions_m)),
        "arm_ratio": arm_m / spread_m,
        "spread_m": spread_m,
        "relaxation_m": body.relaxation_length_m,
    }


@inner
def _move_swerve(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance = inputs
    contact, p, n = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    body, out = contact.body, np.zeros(n, TRUTH)
    # the twist without slip (3, n), the wheel speeds' root mean square and mean (n,), and what a traction in each
    # direction of the twist pulls along the wheels (3, n)
    scale = 1.0 + p.wheel_radius_ratio
    right, left = 1.0 + 0.5 * p.one_sided_radius_ratio, 1.0 - 0.5 * p.one_sided_radius_ratio
    u, heading, angle = np.zeros((3, n)), np.zeros((3, n)), np.empty((3, n))
    pace, mean_wheel_speed = np.empty(n), np.empty(n)
    offsets = (p.steering_offset_1_rad, p.steering_offset_2_rad, p.steering_offset_3_rad)
    scales = (p.wheel_scale_1_ratio, p.wheel_scale_2_ratio, p.wheel_scale_3_ratio)
    for i in range(3):
        angle[i] = steered((1.0 + p.steering_gain_ratio) * steer_rad[:, i] + offsets[i], p, dt)
    for k in range(n):
        square, total = 0.0, 0.0
        for i in range(3):
            wheel_speed = wheel_speed_mps[k, i] * scale * (right if i == 2 else left) * (1.0 + scales[i])
            square += wheel_speed * wheel_speed
            total += wheel_speed
            cos, sin = math.cos(angle[i, k]), math.sin(angle[i, k])
            for j in range(3):
                gain = contact.to_twist[j, 2 * i] * cos + contact.to_twist[j, 2 * i + 1] * sin
                u[j, k] += wheel_speed * gain
            heading[0, k] += cos / 3.0
            heading[1, k] += sin / 3.0
            heading[2, k] += (contact.arm_ratio[i, 0] * sin - contact.arm_ratio[i, 1] * cos) / 3.0
        u[0, k] -= u[2, k] * body.com_y_m
        u[1, k] += u[2, k] * body.com_x_m
        u[2, k] *= contact.spread_m
        pace[k], mean_wheel_speed[k] = math.sqrt(square / 3.0), total / 3.0
    weight = body.mass_kg * GRAVITY_MPS2
    load = 1.0 + p.payload_ratio
    pressed = load / (1.0 + body.load_ratio * p.payload_ratio)
    mass = body.mass_kg * load
    spin_kg = max(body.yaw_inertia_kgm2 / contact.spread_m**2, LIGHTEST_KG) * load
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    gravity = GRAVITY_MPS2 * body.effective_ratio
    ground, sigma, damping = body.soft_ratio, max(contact.relaxation_m, SHORTEST_M), DEFLECTION_DAMPING_S
    by_sigma, by_dt, by_spread = 1.0 / sigma, 1.0 / dt, 1.0 / contact.spread_m
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
        resists = (rolling + p.slip_resistance_ratio * size * weight) / fast + p.viscous_drag_nspm
        w, resists_by_mass = v_w * by_spread, resists * by_mass
        pushed[0] = changing[0, k] + gravity * math.sin(grade_rad[k]) - w * v_y + resists_by_mass * v_x
        pushed[1] = changing[1, k] + gravity * math.sin(roll_rad[k]) + w * v_x + resists_by_mass * v_y
        pushed[2] = changing[2, k] + resists * by_spin * v_w
        soft = max(softness(ground, max(1.5 * size - 0.5 * size_before, 0.0)), STIFFEST_GROUND)
        more = p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            traction = load * math.sqrt(f[0] * f[0] + f[1] * f[1])
            more += p.shear_slip_ratio * shear_softness(traction, body.grip_ratio)
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
                    alpha, beta = decayed(-0.5 * (kappa * damping + creep) * by_sigma, kappa * by_sigma, dt)
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
        row = out[k]
        row.speed_x_mps = u[0, k] - lost[0] + w * body.com_y_m
        row.speed_y_mps = u[1, k] - lost[1] - w * body.com_x_m
        row.yaw_rate_radps = w
        row.force_n = load * weight * f[0]
        row.slip_ratio = (pressed * soft + load * more) * f[0]
        row.current_a = load * weight * (heading[0, k] * f[0] + heading[1, k] * f[1] + heading[2, k] * f[2])
    spun, radius_m = slopes(mean_wheel_speed, dt), body.radius_m
    for k in range(n):
        torque = (out[k].current_a + body.rotating_kg * spun[k]) * radius_m * (1.0 + p.wheel_radius_ratio)
        speed = mean_wheel_speed[k]
        direction = speed / math.sqrt(speed * speed + ROLLING_MPS * ROLLING_MPS)
        out[k].current_a = (torque + body.friction_nm * direction) / body.nm_per_a
    return out


SWERVE = PlanarDrive(CONTACT, _swerve_numbers, _move_swerve)


DRIVES: Mapping[str, PlanarDrive] = {
    "skid_steer": SKID,
    "tracked": SKID,
    "swerve": SWERVE,
    "omni": OMNI,
    "mecanum": MECANUM,
    "bicycle": BICYCLE,
    "tricycle": BICYCLE,
}
"""By the name of a robot's drive."""

UNDISTURBED = np.zeros((0, 3))  # not read-only: that were another type of array, and kernels compiled twice


class Planar(NamedTuple):
    """The planar plant of a robot on a ground: its drive, and ``params`` (1,) of the drive's record."""

    robot: Robot
    drive: PlanarDrive
    params: Array
    learned: tuple[LearnedTerm, ...] = ()  # added to the motion, and to what is read of it

    @property
    def body(self) -> Array:
        """Numbers that every drive has, (1,) of :data:`~terrain.simulation.plants.planar.PLANAR_BODY`."""
        return np.asarray(self.params["body"])


def make_planar(robot: Robot, ground: Ground) -> Planar:
    """Return the planar plant of a robot on a ground.

    What a description leaves out does not act: without motors a traction of 1 N counts as 1 A, without a camera the
    speed is that of the body's origin, without delay.
    """
    complete = robot.completed
    body, camera, sensors, motors = complete.body, complete.camera, complete.sensors, complete.motors
    parts = (robot, ground, camera, sensors, motors, body)  # yaw inertia is that of the section
    described = {n: getattr(part, n) for part in parts for n in PLANAR_BODY.names or () if hasattr(part, n)}
    n, thrust = len(robot.wheels), np.array(ground.thrust_ratio)
    soft = np.full(N_SLIPS, ground.slip_ratio)  # slip over traction at even slips
    if thrust.size >= 4:
        slip, ratio = np.linspace(0.0, 1.0, thrust.size), np.empty(thrust.size)
        ratio[1:] = slip[1:] / thrust[1:]
        ratio[0] = 2.0 * ratio[1] - ratio[2]
        soft = ratio if thrust.size == N_SLIPS else np.interp(_SLIPS, slip, ratio)
    described |= {
        "n_wheels": n,
        "radius_m": robot.wheel_radius_m,
        "rotating_kg": n * body.wheel_inertia_kgm2 / robot.wheel_radius_m**2,
        "friction_nm": n * motors.friction_nm,
        "latency_s": camera.latency_s + camera.time_constant_s,
        "imu_lag_s": IMU_LAG_S if isinstance(robot, SwerveRobot) else 0.0,
        "encoder_lag_s": sensors.encoder_time_constant_s,
        "soft_ratio": soft,
        "scrub_ratio": ground.scrub_ratio if robot.skids else 0.0,
        "seen_from_above": robot.on_omni_wheels,
    }
    drive, of_body = DRIVES[robot.drive], filled(PLANAR_BODY, **described)
    params = filled(drive.record, body=of_body, **drive.numbers(robot, ground))
    return Planar(robot, drive, params, robot.learned)


def move(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array = UNDISTURBED,
) -> Array:
    """Return what the body does, (n,) of :data:`~terrain.simulation.plants.planar.TRUTH`.

    Parameters
    ----------
    planar, vector : the plant, and its parameters in the order of ``effects.PARAMETERS``
    dt : step in s
    wheel_speed_mps : (n, wheels) wheel rates times the nominal radius
    steer_rad : (n, wheels) angles as encoders without error show them; not looked at without steering
    grade_rad, roll_rad : (n,) true tilt
    disturbance : (n, 3) what the ground adds to speeds (shares of ``|u|``, along and across) and yaw rate (rad/s), or
        none: (0, 3)
    """
    added = learned_motion(planar, dt, wheel_speed_mps, steer_rad, grade_rad, roll_rad)
    inputs = wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance
    return np.asarray(moved_by(planar.drive)(planar.params, vector, dt, inputs, added))


def learned_motion(
    planar: Planar, dt: float, wheel_speed_mps: Array, steer_rad: Array, grade_rad: Array, roll_rad: Array
) -> Array:
    """Return what learned terms add to each field (n,) of what the body does; (0,) without any."""
    added: Array = np.zeros(len(grade_rad) if planar.learned else 0, TRUTH)
    if planar.learned:
        rolled = rolled_twist(planar.robot, wheel_speed_mps, steer_rad)
        add_terms(planar.learned, np.column_stack([rolled, grade_rad, roll_rad]), dt, added)
    return added


@cache
def moved_by(drive: PlanarDrive) -> Any:
    """Return the kernel of all that a drive does: what its wheels, learned terms, side hill and ground make of it.

    It is called from compiled code, too, as ``moved(params, vector, dt, inputs, added)``; see :func:`move`.
    """
    by_wheels, drifts = drive.move, drive.drifts

    @njit
    def moved(params: Array, vector: Array, dt: float, inputs: Inputs, added: Array) -> Array:
        truth = by_wheels(params, vector, dt, inputs)
        _finish(params[0].body, vector, dt, inputs, drifts, added, truth)
        return truth

    return moved


@inner
def _finish(
    body: Any, vector: Array, dt: float, inputs: Inputs, drifts: bool, added: Array, truth: Array
) -> None:
    """Add learned terms, what side hill and ground do to the motion, and the specific force along x."""
    p = vector.view(EFFECTS)[0]
    _, _, grade_rad, roll_rad, disturbance = inputs
    for k in range(added.shape[0]):
        row = truth[k]
        row.speed_x_mps += added[k].speed_x_mps
        row.speed_y_mps += added[k].speed_y_mps
        row.yaw_rate_radps += added[k].yaw_rate_radps
        row.gyro_error_radps += added[k].gyro_error_radps
        row.current_a += added[k].current_a
        row.turning_current_a += added[k].turning_current_a
    for k in range(truth.shape[0]):
        row = truth[k]
        fast = math.sqrt(row.speed_x_mps * row.speed_x_mps + row.speed_y_mps * row.speed_y_mps)
        if drifts:
            row.speed_y_mps -= p.side_hill_slip_ratio * body.effective_ratio * roll_rad[k] * fast
        if disturbance.shape[0] > 0:
            row.speed_y_mps += fast * disturbance[k, 1]
            row.yaw_rate_radps += disturbance[k, 2]
    accel = slopes(truth["speed_x_mps"].copy(), dt)
    for k in range(truth.shape[0]):
        row = truth[k]
        row.accel_x_mps2 = accel[k] - row.yaw_rate_radps * row.speed_y_mps
        row.accel_x_mps2 += GRAVITY_MPS2 * math.sin(grade_rad[k])
        if added.shape[0] > 0:
            row.accel_x_mps2 += added[k].accel_x_mps2


def replay(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
) -> Array:
    """Return the channels (n, len(CHANNELS)) that follow from logged wheels, steering and tilt.

    Parameters
    ----------
    planar, vector, dt : as :func:`move` takes them
    wheel_speed_mps, steer_rad, grade_rad, roll_rad : (n, wheels), (n, wheels), (n,), (n,) as measured: the lag of the
        encoders, the clock and the offsets of the tilt are corrected here
    """
    inputs = corrected_inputs(planar.body, vector, dt, wheel_speed_mps, grade_rad, roll_rad)
    truth = move(planar, vector, dt, inputs[0], steer_rad, *inputs[1:])
    return np.asarray(sense(planar.body, vector, dt, truth))


@njit
def corrected_inputs(
    params: Array, vector: Array, dt: float, wheel_speed_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    """Return true wheel speeds, grade and roll from the measured ones; ``params`` is :attr:`Planar.body`."""
    body, p = params[0], vector.view(EFFECTS)[0]
    wheel_speed, grade, roll = wheel_speed_mps, grade_rad - p.pitch_offset_rad, roll_rad - p.roll_offset_rad
    lag = body.encoder_lag_s + p.encoder_lag_s
    if lag != 0.0:
        wheel_speed = wheel_speed_mps.copy()
        for i in range(wheel_speed.shape[1]):
            wheel_speed[:, i] += lag * slopes(wheel_speed_mps[:, i].copy(), dt)
    late = (p.clock_offset_s + body.imu_latency_s + p.imu_latency_s) / dt
    if late != 0.0 or p.clock_rate_ratio != 0.0:
        grade = delayed(grade, -late, -p.clock_rate_ratio)
        roll = delayed(roll, -late, -p.clock_rate_ratio)
    return wheel_speed, grade, roll


@njit
def sense(params: Array, vector: Array, dt: float, truth: Array) -> Array:
    """Return the channels (n, len(CHANNELS)) that sensors without noise measure.

    Parameters
    ----------
    params : :attr:`Planar.body`
    vector, dt : as :func:`move` takes them
    truth : (n,) that it returns
    """
    body, p, n = params[0], vector.view(EFFECTS)[0], truth.shape[0]
    out = np.empty((n, 7))
    lever_x, lever_y = body.lever_x_m + p.lever_x_m, body.lever_y_m + p.lever_y_m
    scale = 1.0 + p.camera_scale_ratio if body.seen_from_above else 1.0
    cos, sin = scale * math.cos(p.camera_yaw_rad), scale * math.sin(p.camera_yaw_rad)
    for k in range(n):
        row = truth[k]
        w = row.yaw_rate_radps
        v_x, v_y = point_velocity(row.speed_x_mps, row.speed_y_mps, w, lever_x, lever_y)
        bend = math.sqrt(max(1.0 + 2.0 * p.gyro_nonlinearity_s2 * w * w, GYRO_END))
        out[k, 0] = (1.0 + p.gyro_scale_ratio) * w / bend + p.gyro_bias_radps + row.gyro_error_radps
        out[k, 1] = cos * v_x - sin * v_y
        out[k, 2] = sin * v_x + cos * v_y
        out[k, 3] = row.accel_x_mps2 + p.accel_bias_mps2
        warm = (1.0 + p.motor_constant_ratio) * (1.0 + p.motor_drift_ratio * k * dt / 60.0)
        out[k, 4] = row.current_a * warm + body.n_wheels * p.current_offset_a
        out[k, 5] = row.turning_current_a * warm
        out[k, 6] = w
    late = lateness(params, vector, dt)
    for c in range(7):
        if late[c, 0] != 0.0 or late[c, 1] != 0.0:
            out[:, c] = delayed(out[:, c].copy(), late[c, 0], late[c, 1])
    return out


@njit
def lateness(params: Array, vector: Array, dt: float) -> Array:
    """Return by channel (len(CHANNELS), 2) how many samples late it is at the start, and what a sample adds.

    Currents are logged with the wheels; parameters are those of :func:`sense`.
    """
    body, p, late = params[0], vector.view(EFFECTS)[0], np.zeros((7, 2))
    camera = (body.latency_s + p.camera_latency_s) / dt
    imu = (body.imu_latency_s + p.imu_latency_s + body.imu_lag_s) / dt
    for c in (0, 1, 2, 3, 6):
        late[c, 0] = p.clock_offset_s / dt + (imu if c in (0, 3) else camera)
        late[c, 1] = p.clock_rate_ratio
    return late


@cache
def _spread() -> Any:
    return read_yaml(data_folder("spread") / "planar.yaml")


def spread_numbers(part: str) -> dict[str, float]:
    """Return a part of ``data/spread/planar.yaml``, which travels with the package and has all sources.

    Parameters
    ----------
    part : ``scatter``, standard deviations of what differs from run to run by itself; ``noise`` of a run, and ``*_s``
        the time over which it forgets itself: all but white noise is that of a robot fast enough, at the speed
        ``moving_mps`` it has half its size, and at rest none; ``model_error``, the value that each parameter seems to
        have where nothing is hidden on a soil of the package, ``varied_error`` and ``varied_scatter`` the same of the
        mean and of single runs whose conditions differ

    Examples
    --------
    >>> spread_numbers("noise")["along_s"]
    0.3
    """
    return {
        name: number(f"planar.yaml: {part}: {name}", entry, name.rpartition("_")[2], 0.0)
        for name, entry in _spread()[part].items()
    }


def probe_error() -> dict[tuple[str, str], float]:
    """Return what the residual of the simulation on a soil of the package depends on, by channel and input."""
    return {
        (channel, name): float(size)
        for channel, entry in _spread()["probe_error"].items()
        for name, size in entry["sizes"].items()
    }


def current_noise_a(noise: Mapping[str, float], robot: Robot) -> float:
    """Return the noise of the sum of a robot's currents; that of an omni robot is in its description."""
    if robot.on_omni_wheels:
        return 0.0
    return noise["current_skid_a"] if robot.skids else noise["current_swerve_a"]


def coloured(white: Array, std: Sequence[float] | Array, tau_s: Sequence[float] | Array, dt: float) -> Array:
    """Return noise (n, c) of sizes and memories (c,) from white noise (c, n) of size 1, sampled every ``dt`` s."""
    out = np.empty(white.shape[::-1])
    for i, row in enumerate(white):
        keep = math.exp(-dt / tau_s[i])
        push = math.sqrt(1.0 - keep * keep) * std[i] * row
        push[0] = std[i] * row[0]
        out[:, i] = lfilter([1.0], [1.0, -keep], push)
    return out


def activity(speed_mps: Any, noise: Mapping[str, float]) -> Any:
    """Return how much of the noise of a moving robot there is at a speed of its wheels, 0 to 1."""
    return np.abs(speed_mps) / (np.abs(speed_mps) + noise["moving_mps"])


WHEELS_HZ, IMU_HZ, CAMERA_HZ = 50.0, 100.0, 50.0  # rates of the loggers
# Each of the two lags in a row by which a wheel follows its command, and that of the steering; assumed.
DRIVE_S, STEER_S = 0.06, 0.08
DRIVE_MPS2 = 4.0  # the most that a wheel speeds up; assumed, 2 g of grip would be needed for more
STEP_S = 0.01  # from step to step: no sensor is sampled faster
# Causes that no effect of the library describes: wheel speed x (1 + e sin(wheel angle)), each wheel with its own
# phase, and spikes of the current at crawling speed.
OUTSIDE: tuple[str, ...] = ("wheel_eccentricity_ratio", "stick_slip_a")
# Speed below which stick-slip shows as spikes of the current, their mean rate, and the length of each.
CRAWL_MPS, SPIKE_HZ, SPIKE_S = 0.25, 5.0, 0.06
STANDSTILL_MPS = 1e-6  # speed below which an encoder counts nothing: its low-pass ends there
# Channel of the truth of an omni robot, whose body slips otherwise than any of its wheels.
BODY_SLIP = "slip_body_ratio"

_PURPOSES = ("scatter", "hills", "ground", "wheels", "steering", "imu", "camera", "outside", "lidar")


def run_planar(
    robot: Robot,
    drive: Scenario | Array,
    ground: Ground,
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    effects: Mapping[str, float],
    scatter: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    outside: Mapping[str, float] | None = None,
    heading: bool = False,
    fixes: bool = False,
    terrain: str = "",
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a drive, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Parameters
    ----------
    drive : a scenario on one terrain, or twists (n, 3) at 50 Hz, from rest
    conditions : load, and the lie of the land along the start's heading and to its left; of undulations, the
        standard deviation of what three waves that cross in drawn directions add to either
    effects : parameters of :mod:`terrain.effects`, beside or in place of the description's own
    scatter : of this run's own parameters, by name as :func:`spread_numbers` has it; by default they do not
    noise : by name, none by default; then encoders do not quantise
    outside : amplitudes of :data:`OUTSIDE`
    heading : add the stream lidar, with the rate of a heading that does not depend on the gyro
    fixes : add the streams gnss and compass
    terrain : label of a drive that is no scenario; without one it has none
    """
    outside, dt = outside or {}, STEP_S
    twist = drive.twist if isinstance(drive, Scenario) else np.asarray(drive)
    terrain = drive.patches[0].terrain if isinstance(drive, Scenario) else terrain
    if isinstance(robot, SwerveRobot):
        robot.require(*robot.sections)
    if twist.ndim != 2 or twist.shape[1] != 3 or len(twist) < 2 or not np.isfinite(twist).all():
        raise ConfigError(f"twist has shape {twist.shape}, (n, 3) finite numbers with two rows are required")
    if not robot.sideways and twist[:, 1].any():
        raise ConfigError(
            f"twist drives robot {robot.name} sideways, which needs steered wheels or omni wheels"
        )
    if robot.on_omni_wheels and outside.get("stick_slip_a"):
        raise ConfigError(f"outside: stick_slip_a is not simulated of robot {robot.name} on omni wheels")
    for name, value in outside.items():
        if name not in OUTSIDE or not math.isfinite(value):
            raise ConfigError(
                f"outside: {name} is {value!r}; finite numbers of {', '.join(OUTSIDE)} are required"
            )
    logs_currents = robot.describes("motors") and "motors" in robot.sections
    robot, rngs = with_silent_parts(robot), sensing.generators(seed, _PURPOSES)
    camera, sensors, motors, wheels = robot.camera, robot.sensors, robot.motors, len(robot.wheels)
    vector = vector_of({**robot.effects, **effects})
    vector[INDEX["payload_ratio"]] += conditions.payload_kg / robot.mass_kg
    if scatter is not None:
        for name in nuisances_of(robot.drive):
            vector[INDEX[name]] += scatter[name] * rngs["scatter"].standard_normal()
    p, planar = vector.view(EFFECTS)[0], make_planar(robot, ground)

    # the wheels follow their commands, and the body its wheels
    desired = wheel_motion(robot, twist, 1.0 / RATE_HZ)
    parts, rate_max = round(1.0 / (RATE_HZ * dt)), robot.steering_rate_max_radps
    speed, steer = follow_commands(desired.wheel_speed_mps, desired.steer_rad, parts, dt, rate_max)
    n = len(speed)
    loud, levels, turned = float(noise is not None), noise or spread_numbers("noise"), speed

    def white(purpose: str, *shape: int) -> Array:
        """Draw white noise of size 1; 0 without noise."""
        return np.asarray(loud * rngs[purpose].standard_normal(shape))

    def shaken(purpose: str, names: str, units: str, rate_hz: float) -> Array:
        """Draw coloured noise (k, c) of sizes and memories by their names in a row."""
        sizes = [levels[f"{name}_{unit}"] for name, unit in zip(names.split(), units.split(), strict=True)]
        tau_s = [levels[f"{name}_s"] for name in names.split()]
        k = -(-n // round(1.0 / (rate_hz * dt)))
        return coloured(white(purpose, len(sizes), k), sizes, tau_s, 1.0 / rate_hz)

    active = activity(np.abs(speed).mean(axis=1), levels)
    disturbance = shaken("ground", "along across yaw", "ratio ratio radps", 1.0 / dt)
    disturbance[:, 2] *= active
    if eccentric := outside.get("wheel_eccentricity_ratio", 0.0):
        phase = rngs["outside"].uniform(0.0, 2.0 * math.pi, wheels)
        angle = np.cumsum(speed, axis=0) * dt / robot.wheel_radius_m
        turned = speed * (1.0 + eccentric * np.sin(angle + phase))
    grade = roll = np.zeros(n)
    truth = move(planar, vector, dt, turned, steer, grade, roll, disturbance)
    pose = _path(truth, dt)
    grade, roll = _tilt_along(pose, conditions, rngs["hills"])
    if grade.any() or roll.any():
        truth = move(planar, vector, dt, turned, steer, grade, roll, disturbance)
        pose = _path(truth, dt)
    sides = np.full(wheels, 1.0 - 0.5 * p["one_sided_radius_ratio"])
    sides[-1] = 1.0 + 0.5 * p["one_sided_radius_ratio"]
    scales = [f"wheel_scale_{wheel}_ratio" for wheel in robot.wheels]
    counts = np.array([1.0 + p[name] if name in INDEX else 1.0 for name in scales])  # encoders may lose some
    true_speed = turned * (1.0 + p["wheel_radius_ratio"]) * sides * counts
    ideal = dict(zip(CHANNELS, sense(planar.body, vector, dt, truth).T, strict=True))
    v_x, v_y, turn = (truth[name] for name in TWIST)

    def samples(rate_hz: float) -> tuple[Array, Array]:
        """Return steps and stamps (k,) of a logger."""
        rows = np.arange(0, n, round(1.0 / (rate_hz * dt)))
        return rows, np.arange(len(rows)) / rate_hz

    def late(values: Array, latency_s: float) -> Array:
        """Return a signal (n,) as the logger of IMU and camera stamps it, behind a latency."""
        steps, rate = (p["clock_offset_s"] + latency_s) / dt, p["clock_rate_ratio"]
        return np.asarray(delayed(values, steps, rate)) if steps != 0.0 or rate != 0.0 else values

    # wheels: encoders count distance over a period, stamped in its middle; currents
    rows, time_s = samples(WHEELS_HZ)
    k, every, wheels_s, moving = len(rows), round(1.0 / (WHEELS_HZ * dt)), time_s, active[rows]
    total, turning = ideal[CURRENT][rows], ideal[TURNING_CURRENT][rows]
    if spike_a := outside.get("stick_slip_a", 0.0):
        mean = speed.mean(axis=1)
        crawls = (np.abs(mean) < CRAWL_MPS) & (np.abs(mean) > 0.02)
        starts = rngs["outside"].random(n) < SPIKE_HZ * dt
        lasting = np.convolve(starts & crawls, np.ones(max(1, round(SPIKE_S / dt))))[:n] > 0
        total = total + (spike_a * np.sign(mean) * lasting)[rows]
    if robot.on_omni_wheels:  # of the motion before the ground disturbs it
        driven = np.ascontiguousarray(true_speed / (1.0 + p["wheel_radius_ratio"]))
        undisturbed = move(planar, vector, dt, driven, steer, grade, roll)
        currents = np.asarray(currents_of(planar.params, vector, dt, driven, undisturbed))[rows]
    elif robot.skids:
        currents = np.column_stack([total - turning, total + turning]) / 2.0
    else:
        currents = np.repeat(total[:, None] / wheels, wheels, axis=1)
    at = np.arange(k + 1) * every - every // 2
    inside = np.clip(at, 0, n - 1)
    distance = np.vstack([np.zeros(wheels), np.cumsum(0.5 * dt * (speed[:-1] + speed[1:]), axis=0)])
    counted = distance[inside] + ((at - inside) * dt)[:, None] * speed[inside]
    jitter = white("wheels", k + 1, wheels) * levels["encoder_m"]
    counted = counted + jitter * np.append(moving, moving[-1])[:, None]
    if loud and sensors.hall_steps_ratio > 0.0:
        turns = sensors.hall_steps_ratio * motors.reduction_ratio
        step_m = 2.0 * math.pi * robot.wheel_radius_m / turns
        counted = np.floor(counted / step_m) * step_m
    white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
    rate_noise = white_mps * white("wheels", k, wheels)
    std_a, forget_s = current_noise_a(levels, robot) / math.sqrt(wheels), levels["current_s"]
    drawn = coloured(white("wheels", wheels, k), [std_a] * wheels, [forget_s] * wheels, dt * every)
    drawn *= moving[:, None]
    currents = currents + drawn + sensors.current_std_a * white("wheels", k, wheels)
    measured = np.diff(counted, axis=0) / (every * dt)
    lag_s = sensors.encoder_time_constant_s + p["encoder_lag_s"]
    measured = np.column_stack([lagged(column.copy(), lag_s, every * dt) for column in measured.T])
    measured[np.abs(measured) <= STANDSTILL_MPS] = 0.0
    values = robot.logged_rates(measured + rate_noise * (np.abs(measured) > STANDSTILL_MPS))
    channels = robot.rate_channels
    if logs_currents:
        currents = np.abs(currents) if robot.on_omni_wheels else currents  # as its logs have them
        values = np.hstack([values, currents])
        channels = (*channels, *sensing.wheel_channels("current_a", robot.wheels))
    streams = {"wheels": Stream(time_s, values, channels)}

    rows, time_s = samples(CAMERA_HZ)
    camera_s = planar.body["latency_s"][0] + p["camera_latency_s"]
    if robot.on_omni_wheels:  # poses by a camera above: the world's axes, its own noise
        x_m, y_m, yaw_rad = (late(column, camera_s)[rows] for column in pose.T)
        lever_m = complex(camera.lever_x_m + p["lever_x_m"], camera.lever_y_m + p["lever_y_m"])
        marker = (x_m + 1j * y_m + np.exp(1j * yaw_rad) * lever_m) * (1.0 + p["camera_scale_ratio"])
        seen = np.column_stack([marker.real, marker.imag, yaw_rad - p["camera_yaw_rad"]])
        std = np.array([camera.position_std_m, camera.position_std_m, camera.yaw_std_rad])
        seen = seen + std * white("camera", *seen.shape)
        streams["pose"] = Stream(time_s, seen, POSE_CHANNELS)
    else:
        rows, time_s = samples(IMU_HZ)
        k, imu_s, level = len(rows), sensors.imu_latency_s + p["imu_latency_s"], np.cos(grade)
        true, (scale, bias), drawn = np.empty((k, 9)), sensing.described_imu(sensors), np.zeros((k, 9))
        true[:, 6:8] = tilt = np.column_stack([late(angle, imu_s)[rows] for angle in (roll, -grade)])
        true[:, :2] = np.gradient(tilt, 1.0 / IMU_HZ, axis=0)
        true[:, 2], true[:, 3] = ideal[GYRO][rows], ideal[ACCEL][rows]  # with clock and latency already
        side = np.gradient(v_y, dt) + turn * v_x + GRAVITY_MPS2 * np.sin(roll) * level
        true[:, 4] = late(side, imu_s)[rows]
        true[:, 5] = late(GRAVITY_MPS2 * np.cos(roll) * level, imu_s)[rows]
        true[:, 8] = (np.cumsum(true[:, 2]) - true[0, 2]) / IMU_HZ
        units = "radps radps radps mps2 mps2 mps2"
        vibration = shaken("imu", "gyro gyro gyro accel accel accel", units, IMU_HZ)
        still = np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2], 3)
        drawn[:, :6] = vibration * late(active, imu_s)[rows, None] + still * white("imu", k, 6)
        drawn[:, 6:8] = levels["tilt_rad"] * white("imu", k, 2)
        drawn[:, 8] = sensors.yaw_std_rad * white("imu", k)
        biases = np.tile(bias, (k, 1))
        biases[:, 6:8] = p["roll_offset_rad"], -p["pitch_offset_rad"]
        yaw_rate = bias[2] + drawn[:, 2]  # the fused yaw sums the measured rate
        biases[:, 8] = (np.cumsum(yaw_rate) - yaw_rate[0]) / IMU_HZ
        streams["imu"] = Stream(time_s, sensing.imu_values(true, scale, biases, drawn), IMU_CHANNELS)

        rows, time_s = samples(CAMERA_HZ)
        k = len(rows)
        seen = np.column_stack([ideal[SPEED_X][rows], ideal[SPEED_Y][rows]])
        seen += shaken("camera", "camera camera", "mps mps", CAMERA_HZ) * late(active, camera_s)[rows, None]
        seen += camera.speed_std_mps * white("camera", k, 2)
        channels = ("speed_x_mps", "speed_y_mps")
        if isinstance(robot, SwerveRobot):  # a tracking camera integrates its own pose
            turned_rad = ideal[HEADING]
            yaw = ((np.cumsum(turned_rad) - 0.5 * (turned_rad + turned_rad[0])) * dt)[rows]
            yaw = yaw + camera.yaw_std_rad * white("camera", k)
            rate = turned_rad[rows] + camera.yaw_rate_std_radps * white("camera", k)
            position_noise = camera.position_std_m * white("camera", k, 2)
            ahead, left = point_velocity(seen[:, 0], seen[:, 1], rate, -camera.lever_x_m, -camera.lever_y_m)
            velocity = np.column_stack(
                [ahead * np.cos(yaw) - left * np.sin(yaw), ahead * np.sin(yaw) + left * np.cos(yaw)]
            )
            position = np.cumsum(velocity, axis=0) / CAMERA_HZ + position_noise
            angles = (late(angle, camera_s)[rows] for angle in (roll, -grade))
            lever = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
            seen = sensing.camera_values(
                position, np.column_stack([ahead, left, rate, *angles, yaw]), lever, 0.0
            )
            channels = CAMERA_CHANNELS
        streams["odometry"] = Stream(time_s, seen, channels)

    steered = len(robot.steer_rows)
    names = *TWIST, *sensing.wheel_channels("wheel_radps", robot.wheels), *robot.steer_rows
    commands = np.hstack([desired.twist, desired.wheel_radps, desired.steer_rad[:, :steered]])
    streams["commands"] = Stream(np.arange(len(twist)) / RATE_HZ, commands, names)
    rows, time_s = samples(IMU_HZ)
    body: Any = np.zeros(len(rows), BODY)
    moved: Any = truth[rows]
    tilt = grade[rows]
    for name in TWIST:
        body[name] = moved[name]
    body["position_x_m"], body["position_y_m"], body["yaw_rad"] = pose[rows].T
    body["roll_rad"], body["pitch_rad"] = roll[rows], -tilt
    body["accel_x_mps2"] = moved["accel_x_mps2"] - GRAVITY_MPS2 * np.sin(tilt)
    turning = moved["yaw_rate_radps"] * moved["speed_x_mps"]
    body["accel_y_mps2"] = np.gradient(moved["speed_y_mps"], 1.0 / IMU_HZ) + turning
    places_m = robot.wheel_positions_m * (1.0 + p["wheel_distance_ratio"])
    motion = np.column_stack([body[name] for name in TWIST])
    along, across = wheel_frame_velocities(motion, places_m, steer[rows] + robot.wheel_directions_rad)
    of_wheels = {
        "wheel_radps": speed[rows] * counts / robot.wheel_radius_m,
        "steer_rad": steer[rows],
        "slip_ratio": slip_ratio(true_speed[rows], along),
    }
    more: dict[str, Any] = {
        sensing.GYRO_BIAS: np.full(len(rows), p["gyro_bias_radps"] + sensors.gyro_bias_z_radps)
    }
    if isinstance(robot, BicycleRobot):
        more |= zip(
            sensing.wheel_channels("slip_rad", robot.wheels), slip_angle(along, across).T, strict=True
        )
    if robot.on_omni_wheels:
        more[BODY_SLIP] = moved["slip_ratio"]
    streams["truth"] = sensing.truth_stream(time_s, body, robot.wheels, of_wheels, more)
    if steered:
        shown, steps = steer[::every, :steered], sensors.steering_steps_ratio
        error = sensors.steering_std_rad * white("steering", *shown.shape)
        step_rad = 2.0 * math.pi / steps if loud and steps > 0.0 else 0.0
        shown = sensing.encoder_angle(shown, robot.steering_zeros_rad[:steered], error, step_rad)
        streams["steering"] = Stream(wheels_s, shown, robot.steer_channels)
    if heading:  # central differences of a heading that does not depend on the gyro
        rows, time_s = samples(CAMERA_HZ)
        headings = levels["heading_rad"] * white("lidar", len(rows))
        rate = ideal[HEADING][rows] + np.gradient(headings, 1.0 / CAMERA_HZ)
        streams["lidar"] = Stream(time_s, rate[:, None], ("yaw_rate_radps",))
    if fixes:
        at_s = np.arange(0.0, (len(body) - 1) / IMU_HZ + 1e-9, 1.0 / sensing.RAW_HZ)
        streams |= sensing.raw_fixes(
            at_s, body[:: round(IMU_HZ / sensing.RAW_HZ)], sensing.generators(seed, ("fixes",))["fixes"]
        )
    return streams, (Label(0.0, (len(twist) - 1) / RATE_HZ, terrain),) if terrain else ()


def with_silent_parts(robot: Robot) -> Robot:
    """Return the robot with parts that neither act nor are noisy for the sections that it lacks.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> with_silent_parts(load_robot("warthog")).sensors.gyro_std_radps
    0.0
    """
    parts: dict[str, Any] = {n: part for n, part in robot.completed.parts.items() if n not in robot.parts}
    for name, part in parts.items():
        unknown = [item.name for item in fields(part) if math.isnan(getattr(part, item.name))]
        parts[name] = replace(part, **dict.fromkeys(unknown, 0.0))
    return robot.with_parts(**parts)


@njit
def follow_commands(
    desired_mps: Array, desired_rad: Array, parts: int, dt: float, rate_max: float
) -> tuple[Array, Array]:
    """Return wheel speeds and steering (m, wheels) that follow desired (n, wheels), ``parts`` steps a row."""
    n, wheels = desired_mps.shape
    m = (n - 1) * parts + 1
    wheel_speed, steer = np.empty((m, wheels)), np.empty((m, wheels))
    quick, turn = 1.0 - math.exp(-dt / DRIVE_S), 1.0 - math.exp(-dt / STEER_S)
    fastest, furthest = DRIVE_MPS2 * dt, rate_max * dt
    for i in range(wheels):
        first, second, angle = 0.0, 0.0, desired_rad[0, i]
        for k in range(m):
            row = k // parts
            part = (k - row * parts) / parts
            after = min(row + 1, n - 1)
            goal = desired_mps[row, i] + part * (desired_mps[after, i] - desired_mps[row, i])
            first += min(max(quick * (goal - first), -fastest), fastest)
            second += quick * (first - second)
            wheel_speed[k, i] = second
            aim = desired_rad[row, i] + part * (desired_rad[after, i] - desired_rad[row, i])
            angle += min(max(turn * (aim - angle), -furthest), furthest)
            steer[k, i] = angle
    return wheel_speed, steer


def _path(truth: Array, dt: float) -> Array:
    """Return east, north and heading (n, 3) of the body's origin, from 0."""
    pose = np.zeros((len(truth), 3))
    x, y, w = (0.5 * (truth[name][:-1] + truth[name][1:]) for name in TWIST)
    pose[1:, 2] = np.cumsum(dt * w)
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    pose[1:, 0] = np.cumsum(dt * (x * np.cos(middle) - y * np.sin(middle)))
    pose[1:, 1] = np.cumsum(dt * (x * np.sin(middle) + y * np.cos(middle)))
    return pose


def _tilt_along(pose: Array, conditions: Conditions, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return grade (nose up positive) and roll (left side up positive) (n,) of a body along its path."""
    (east, north), (x, y, yaw) = conditions.grade_ratio, pose.T
    if conditions.undulation_ratio:
        directions, phases = rng.uniform(0.0, math.pi, 3), rng.uniform(0.0, 2.0 * math.pi, 3)
        size = conditions.undulation_ratio * math.sqrt(4.0 / 3.0)
        for share, direction, phase in zip((0.7, 1.0, 1.4), directions, phases, strict=True):
            cos, sin = math.cos(direction), math.sin(direction)
            wave_number = 2.0 * math.pi / (conditions.undulation_length_m * share)
            value = size * np.cos(wave_number * (x * cos + y * sin) + phase)
            east, north = east + value * cos, north + value * sin
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead, left = east * cos + north * sin, -east * sin + north * cos
    return np.arctan(ahead / np.hypot(1.0, left)), np.arctan(left)
