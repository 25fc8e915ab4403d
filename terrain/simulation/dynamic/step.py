"""The body and its wheels: a planar robot with load transfer on three driven, steered wheels.

States are integrated with semi-implicit steps of :data:`STEP_S`.  What acts, in the order of one step:

- **load**: three contacts carry a rigid body, so their normal forces follow from balance alone:
  ``sum N = m g cos``, and the moments of gravity and inertia about the two body axes; tyres as springs over
  a rough ground add their own (:func:`_ride`).
- **steering**: a rate-limited, acceleration-limited motor turns the wheel through a backlash of half width
  ``dead_band``.
- **speed loop** of each motor driver: PI on its own estimate of the wheel's rate, torque limit with
  anti-windup, torque lag; the current follows the torque.
- **contact**: longitudinal and lateral deflections of the contact (Pacejka, Tyre and Vehicle Dynamics, 7.2.1,
  single contact point) with the larger absolute speed as in the SAE slip,
  ``du/dt = (w r - v_long) - max(|w r|, |v_long|) u / sigma``, so that ``u / sigma`` settles at the slip
  ratio and stays finite at rest; ``terrain.terramechanics`` turns deflection and load into thrust, side force
  and resistance.
- **leg**: the third wheel's leg swings about a hinge on the line of the other two, within
  :attr:`Plant.leg_backlash_rad`, to where the ground pushes its wheel; that turns the wheel's heading, which
  its steering encoder below the hinge does not see (thesis, conclusions: backlash of the third leg's opening
  system). What the swing moves the wheel's centre by, and its friction's own moment, are left out.
- **body**: ``m (dv/dt + w x v) = sum F - m g grad``, ``I dw/dt = sum (r_i - r_com) x F_i``.

Resistance acts at the axle, against the rolling of the wheel; hence in steady motion the thrust balances it
and the slip follows from the ground, not from the speed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.kinematics.wheel_velocity import point_velocity
from terrain.records import Array
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_slip
from terrain.simulation.dynamic.actuators import drive_wheel, linkage_heading, steer_wheel
from terrain.simulation.dynamic.plant import Plant, record_width
from terrain.simulation.dynamic.profile import FIELD_STEP_M
from terrain.simulation.dynamic.ride import patch_index, ride_over, terrain_gradient
from terrain.simulation.dynamic.states import (
    ACCEL_X,
    ACCEL_Y,
    CREEP,
    DEFLECTION_X,
    DEFLECTION_Y,
    LEG,
    N_BODY,
    N_WHEEL,
    PATH,
    RATE,
    REPORTED,
    RIDE,
    SPEED_X,
    SPEED_Y,
    STEER,
    TORQUE,
    YAW,
    YAW_RATE,
)
from terrain.simulation.sensors.motion import N_BODY_RECORD, N_RECORD, STEP_S, WHEEL_RECORD
from terrain.terramechanics import traction
from terrain.terramechanics.traction import wheel_ground

ROLLING_SPEED_MPS = 0.02
"""Speed over which a resistance takes its full size: it opposes rolling and does not push a robot at rest."""

LEG_RATE_RADPS = 0.5
"""How fast the third leg swings through its play; assumed, it crosses one degree in 35 ms."""

LEG_FRICTION_NM = 5.0
"""Moment about its hinge below which the third leg stays where it is; assumed, 7 N on the wheel: a start at
1 m/s^2 gives three times as much, steady rolling less."""

STIFFEST = -0.9
"""Least creep over the slip of the ground."""


def settle(plant: Plant, state: Array) -> None:
    """Let a robot that was put on a slope come to rest; ``state`` is changed in place.

    Its wheels are commanded to stand; contacts and motors take up the load, which on the level changes
    nothing. For four of five seconds the speeds are taken away ten times a second, so that it does not swing;
    where it rests afterwards is the origin.  Terrain too steep to stand on lets it slide.
    """
    stand, record = np.zeros((1, 3)), np.empty((100, record_width(plant)))
    for tenth in range(50):
        advance(plant, state, stand, stand, 100, np.zeros((100, 3)), record)
        if tenth < 40:
            state[SPEED_X : YAW_RATE + 1] = 0.0
    state[:SPEED_X] = 0.0
    state[PATH] = 0.0


@njit(cache=True)
def advance(
    plant: Plant,
    state: Array,
    wheel_radps: Array,
    steer_rad: Array,
    substeps: int,
    road_noise: Array,
    record: Array,
) -> None:
    """Drive through commands that are held for ``substeps`` steps each; ``state`` is changed in place.

    Parameters
    ----------
    plant, state : as :func:`make_plant` and :func:`start_state` give them, or as an earlier call left it
    wheel_radps, steer_rad : (n, 3) commands
    substeps : steps of :data:`STEP_S` a command
    road_noise : (n * substeps, 3) standard normal numbers, the roughness under each wheel
    record : (n * substeps, record_width) is written: :data:`BODY_RECORD`, then :data:`WHEEL_RECORD` a wheel,
        then the encoders' angles where a linkage hides the wheels

    Notes
    -----
    The step of a wheel is not a function of its own: reference counts of the plant's arrays, which each call
    that takes them costs, would double the time of a run.
    """
    dt = STEP_S
    tail = state[N_BODY + 3 * N_WHEEL :]
    accel = np.array([state[ACCEL_X], state[ACCEL_Y], 0.0])  # of the last step; the third is dw/dt
    speeds = np.zeros((3, 2))
    ride = np.zeros(3)  # vertical acceleration of each corner
    for k in range(wheel_radps.shape[0] * substeps):
        command = k // substeps
        cos_yaw, sin_yaw = math.cos(state[YAW]), math.sin(state[YAW])
        grade_x, grade_y = terrain_gradient(plant, state, cos_yaw, sin_yaw)
        steepness = math.sqrt(1.0 + grade_x * grade_x + grade_y * grade_y)
        g_normal = GRAVITY_MPS2 / steepness
        row = record[k]
        force_x, force_y, moment, leg_nm = 0.0, 0.0, 0.0, 0.0
        # speeds of the wheel centres, and the direction of motion
        for i in range(3):
            x_m, y_m = plant.wheels_m[i, 0] - plant.com_m[0], plant.wheels_m[i, 1] - plant.com_m[1]
            speeds[i, 0], speeds[i, 1] = point_velocity(
                state[SPEED_X], state[SPEED_Y], state[YAW_RATE], x_m, y_m
            )
        speed = math.sqrt(state[SPEED_X] * state[SPEED_X] + state[SPEED_Y] * state[SPEED_Y]) + 1e-9
        for i in range(3):
            w = state[N_BODY + i * N_WHEEL : N_BODY + (i + 1) * N_WHEEL]
            steer_wheel(plant, w, steer_rad[command, i], dt)
            heading = w[STEER]
            if plant.linked:
                heading = linkage_heading(plant, tail, w[STEER], i)
                row[N_RECORD + i] = w[STEER]
            if i == 2 and plant.leg_backlash_rad > 0.0:
                heading += state[LEG]
            cos_steer, sin_steer = math.cos(heading), math.sin(heading)
            along = cos_steer * speeds[i, 0] + sin_steer * speeds[i, 1]
            across = -sin_steer * speeds[i, 0] + cos_steer * speeds[i, 1]
            wheel_speed = w[RATE] * plant.radius_m[i]
            fastest = max(abs(wheel_speed), abs(along))
            ahead_m = (plant.wheels_m[i, 0] * state[SPEED_X] + plant.wheels_m[i, 1] * state[SPEED_Y]) / speed
            patch = patch_index(plant, state[PATH] + (ahead_m if speed > 0.05 else 0.0))
            ride_n = ride_over(
                plant, w, i, patch, math.sqrt(along * along + across * across), road_noise[k, i], dt
            )
            normal_n = plant.mass_kg * (
                g_normal * plant.load_fraction[i]
                + plant.load_per_force_ratio[i, 0] * (accel[0] + GRAVITY_MPS2 * grade_x / steepness)
                + plant.load_per_force_ratio[i, 1] * (accel[1] + GRAVITY_MPS2 * grade_y / steepness)
            )
            ride[i] = ride_n / (plant.mass_kg * plant.load_fraction[i])
            normal_n = max(normal_n + ride_n, 0.0)
            rate_x = wheel_speed - along - fastest / plant.relaxation_m * w[DEFLECTION_X]
            rate_y = -across - fastest / plant.relaxation_m * w[DEFLECTION_Y]
            if plant.hidden:
                rate_x -= tail[CREEP + i] * fastest / plant.relaxation_m * w[DEFLECTION_X]
                rate_y -= plant.side_hill_ratio * math.atan(grade_y) * abs(along)
            slip_x = (w[DEFLECTION_X] + DEFLECTION_DAMPING_S * rate_x) / plant.relaxation_m
            slip_y = (w[DEFLECTION_Y] + DEFLECTION_DAMPING_S * rate_y) / plant.relaxation_m
            thrust, side, resistance, sinkage = wheel_ground(
                plant.grounds[patch], normal_n, min(max(slip_x, -1.0), 1.0), slip_y
            )
            cell = min(max(int(state[PATH] / FIELD_STEP_M), 0), plant.field.shape[2] - 1)  # a NaN is no place
            thrust *= plant.field[0, i, cell]
            side *= plant.field[0, i, cell]
            resistance *= plant.field[1, i, cell]
            if plant.hidden:
                tail[CREEP + i] = _creep(plant, patch, normal_n, slip_x, thrust)
                slip = abs(slip_x) * (1.0 + tail[CREEP + i])
                resistance += (plant.rolling_ratio + plant.slip_resistance_ratio * slip) * normal_n
                resistance = max(resistance + plant.drag_nspm * abs(along) / 3.0, 0.0)
            pull = thrust - resistance * math.tanh(along / ROLLING_SPEED_MPS)
            fx = cos_steer * pull - sin_steer * side
            fy = sin_steer * pull + cos_steer * side
            if i == 2:
                leg_nm = -plant.wheels_m[i, 1] * fx
            force_x += fx
            force_y += fy
            moment += (plant.wheels_m[i, 0] - plant.com_m[0]) * fy - (
                plant.wheels_m[i, 1] - plant.com_m[1]
            ) * fx
            drive_wheel(plant, w, wheel_radps[command, i], thrust * plant.radius_m[i], dt)
            # the contact follows with the wheel's new rate: semi-implicit
            rate_x = w[RATE] * plant.radius_m[i] - along - fastest / plant.relaxation_m * w[DEFLECTION_X]
            limit = plant.relaxation_m
            deflection = w[DEFLECTION_X] + dt * rate_x
            if plant.hidden:  # implicit: a contact that creeps fast is stiff
                creep = tail[CREEP + i] * fastest / plant.relaxation_m
                deflection /= 1.0 + dt * creep
            w[DEFLECTION_X] = min(max(deflection, -limit), limit)
            w[DEFLECTION_Y] = min(max(w[DEFLECTION_Y] + dt * rate_y, -limit), limit)
            at = N_BODY_RECORD + i * len(WHEEL_RECORD)
            row[at] = wheel_speed / plant.radius_m[i]  # of this instant, as the slip is
            row[at + 1] = heading
            row[at + 2] = (wheel_speed - along) / fastest if fastest >= 0.05 else np.nan
            row[at + 3] = math.atan2(across, abs(along)) if math.hypot(along, across) >= 0.05 else np.nan
            row[at + 4] = normal_n
            row[at + 5] = thrust
            row[at + 6] = w[TORQUE]
            row[at + 7] = sinkage
            row[at + 8] = w[REPORTED]
            row[at + 9] = patch
            row[at + 10] = side
        accel[0] = force_x / plant.mass_kg - GRAVITY_MPS2 * grade_x / steepness
        accel[1] = force_y / plant.mass_kg - GRAVITY_MPS2 * grade_y / steepness
        accel[2] = moment / plant.yaw_inertia_kgm2
        _record_body(plant, state, accel, ride, grade_x, grade_y, row)
        _advance_body(state, accel, plant.com_m[0], plant.com_m[1], cos_yaw, sin_yaw)
        if plant.leg_backlash_rad > 0.0:
            state[LEG] = _swing(plant, state[LEG], leg_nm, dt)


@njit(cache=True)
def _advance_body(
    state: Array, accel: Array, com_x_m: float, com_y_m: float, cos_yaw: float, sin_yaw: float
) -> None:
    """Step the body with the acceleration (3,) of its centre of mass and of its yaw."""
    dt, turn, vx, vy = STEP_S, state[YAW_RATE], state[SPEED_X], state[SPEED_Y]
    state[SPEED_X] = vx + dt * (accel[0] + turn * vy)
    state[SPEED_Y] = vy + dt * (accel[1] - turn * vx)
    state[YAW_RATE] = turn + dt * accel[2]
    origin_x, origin_y = point_velocity(state[SPEED_X], state[SPEED_Y], state[YAW_RATE], -com_x_m, -com_y_m)
    state[0] += dt * (cos_yaw * origin_x - sin_yaw * origin_y)
    state[1] += dt * (sin_yaw * origin_x + cos_yaw * origin_y)
    state[YAW] += dt * state[YAW_RATE]
    state[PATH] += dt * math.sqrt(origin_x * origin_x + origin_y * origin_y)
    state[ACCEL_X], state[ACCEL_Y] = accel[0], accel[1]


@njit(cache=True)
def _creep(plant: Plant, patch: int, normal_n: float, slip: float, thrust_n: float) -> float:
    """Return what a contact creeps by beside the slip of the ground, over that slip."""
    if abs(slip) < 1e-6 or normal_n <= 0.0:
        return 0.0
    ground, force_ratio = plant.grounds[patch], 3.0 * thrust_n / plant.weight_n
    creep = plant.force_slip_ratio * force_ratio
    if plant.shear_slip_ratio != 0.0:
        grip_ratio = ground[traction.PEAK]
        if ground[traction.HARD] == 0.0:
            area_m2 = ground[traction.CONTACT] * ground[traction.WIDTH]
            grip_ratio = ground[traction.TAN_FRICTION] + ground[traction.COHESION] * area_m2 / normal_n
        creep += plant.shear_slip_ratio * shear_slip(force_ratio, grip_ratio)
    return max(creep / slip, STIFFEST)


@njit(cache=True)
def _swing(plant: Plant, leg_rad: float, moment_nm: float, dt: float) -> float:
    """Swing the third leg through its play to where its wheel is pushed, if that is hard enough."""
    if abs(moment_nm) <= LEG_FRICTION_NM:
        return leg_rad
    turned_rad = leg_rad + math.copysign(LEG_RATE_RADPS * dt, moment_nm)
    return min(max(turned_rad, -plant.leg_backlash_rad), plant.leg_backlash_rad)


@njit(cache=True)
def _record_body(
    plant: Plant, state: Array, accel: Array, a: Array, grade_x: float, grade_y: float, row: Array
) -> None:
    """Speeds and accelerations at the origin; the ride of the plane through the three corners."""
    base_m = plant.wheels_m[1, 0] - plant.wheels_m[0, 0]
    track_m = -plant.wheels_m[2, 1]
    one, two, three = N_BODY, N_BODY + N_WHEEL, N_BODY + 2 * N_WHEEL
    turn = state[5]
    row[0], row[1], row[2] = state[0], state[1], state[2]
    row[3], row[4] = point_velocity(state[3], state[4], turn, -plant.com_m[0], -plant.com_m[1])
    row[5] = turn
    row[6] = accel[0] + accel[2] * plant.com_m[1] + turn * turn * plant.com_m[0]
    row[7] = accel[1] - accel[2] * plant.com_m[0] + turn * turn * plant.com_m[1]
    row[8], row[9] = grade_x, grade_y
    row[10] = 0.5 * (a[0] + a[1])
    row[11] = (0.5 * (state[one + RIDE] + state[two + RIDE]) - state[three + RIDE]) / track_m
    row[12] = -(state[two + RIDE] - state[one + RIDE]) / base_m
    row[13] = (0.5 * (a[0] + a[1]) - a[2]) / track_m
    row[14] = -(a[1] - a[0]) / base_m
    row[15] = state[6]
    row[16] = state[LEG]
