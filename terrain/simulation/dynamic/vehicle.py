"""The body and its wheels: a planar robot with load transfer on three driven, steered wheels.

States are integrated with semi-implicit steps of :data:`STEP_S`.  What acts, in the order of one step:

- **load**: three contacts carry a rigid body, so their normal forces follow from balance alone:
  ``sum N = m g cos``, and the moments of gravity and inertia about the two body axes; tyres as springs over
  a rough ground add their own (:func:`_ride`).
- **steering**: a rate-limited, acceleration-limited motor turns the wheel through a play of half width
  ``dead_band``.
- **speed loop** of each driver: PI on its own estimate of the wheel's rate, torque limit with anti-windup,
  torque lag; the current follows the torque.
- **contact**: longitudinal and lateral deflections of the contact (Pacejka, Tyre and Vehicle Dynamics, 7.2.1,
  single contact point) with the larger absolute speed as in the SAE slip,
  ``du/dt = (w r - v_long) - max(|w r|, |v_long|) u / sigma``, so that ``u / sigma`` settles at the slip
  ratio and stays finite at rest; ``terrain.terramechanics`` turns deflection and load into thrust, side force
  and resistance.
- **leg**: the third wheel's leg swings about a hinge on the line of the other two, within
  :attr:`Plant.leg_backlash_rad`, to where the ground pushes its wheel; that turns the wheel's heading, which
  its steering encoder below the hinge does not see (thesis, conclusions: play of the third leg's opening
  system). What the swing moves the wheel's centre by, and its friction's own moment, are left out.
- **body**: ``m (dv/dt + w x v) = sum F - m g grad``, ``I dw/dt = sum (r_i - r_com) x F_i``.

Resistance acts at the axle, against the rolling of the wheel; hence in steady motion the thrust balances it
and the slip follows from the ground, not from the speed.

Effects of the robot (:mod:`terrain.effects.catalogue`) act where a real robot would have them:

- **wheel_radius, one_sided_radius**: true radii of the wheels, of which the commands know nothing;
- **steering_delay, steering_backlash, steering_offset_i**: between the encoder, which the steering motor
  obeys, and the wheel: ``wheel(t) = play(encoder(t - T)) + d0``;
- **force_slip, shear_slip**: a creep of the contact on top of the ground's own slip.  Its deflection follows
  ``du/dt = (w r - v) - max(|w r|, |v|) (u / sigma + c f)`` with ``f = 3 F_i / W``, so that it settles
  where slip is that of the ground plus ``c f``, and no equation has to be solved for a force;
  of a shear curve ``c f`` is bent as in :func:`~terrain.simulation.contact.shear_slip`, up to the
  wheel's own limit.  A negative creep leaves a tenth of the ground's slip: no contact is stiffer than ten
  times it;
- **side_hill_slip**: the ground goes by sideways: wheels roll without side force where they drift downhill by
  ``c ph |v|``;
- **rolling_resistance, slip_resistance, viscous_drag**: more resistance at each axle, by its load, its slip
  and its share of the speed; what is less than none is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import PlantPart, in_plant, parameters_of
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_slip
from terrain.terramechanics import traction
from terrain.terramechanics.traction import wheel_ground

STEP_S = 0.001
"""The contact's fastest mode is near 170 rad/s: a sixth of a radian a step."""

ROLLING_SPEED_MPS = 0.02
"""Speed over which a resistance takes its full size: it opposes rolling and pushes nobody at rest."""

LEG_RATE_RADPS = 0.5
"""How fast the third leg swings through its play; assumed, it crosses one degree in 35 ms."""

LEG_FRICTION_NM = 5.0
"""Moment about its hinge below which the third leg stays where it is; assumed, 7 N on the wheel: a start at
1 m/s^2 gives three times as much, steady rolling less."""

ROUGHNESS_WAVENUMBER = 0.1
"""Reference wave number of ISO 8608 in cycles/m."""

ROUGHNESS_CUTOFF = 0.01
"""Longest wave of the ground that counts as roughness, in cycles/m (ISO 8608's lower end)."""

FIELD_STEP_M = 0.1
"""Grid on which the ground varies along the way."""

WHEEL_STATES = (
    "rate_radps",
    "angle_rad",
    "steer_rad",
    "steer_motor_rad",
    "steer_motor_radps",
    "deflection_x_m",
    "deflection_y_m",
    "torque_nm",
    "integral_nm",
    "estimate_radps",
    "reported_radps",
    "hall_count",
    "ride_m",
    "ride_mps",
    "road_m",
    "contact_m",
)
BODY_STATES = (
    "position_x_m",
    "position_y_m",
    "yaw_rad",
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    "path_m",
    "accel_x_mps2",
    "accel_y_mps2",
    "leg_rad",
)
"""Position is that of the body's origin; speeds and accelerations (dv/dt + w x v, of the step before) are
those of its centre of mass in body axes; the third leg is at 0 in the middle of its play."""

SPEED_X, YAW_RATE, PATH, LEG = 3, 5, 6, 9
N_BODY = len(BODY_STATES)
N_WHEEL = len(WHEEL_STATES)
(
    RATE,
    ANGLE,
    STEER,
    MOTOR,
    MOTOR_RATE,
    DEFLECTION_X,
    DEFLECTION_Y,
    TORQUE,
    INTEGRAL,
    ESTIMATE,
    REPORTED,
    COUNT,
) = range(12)
RIDE, RIDE_RATE, ROAD, CONTACT = range(12, 16)

BODY_RECORD = (
    "position_x_m",
    "position_y_m",
    "yaw_rad",
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    "accel_x_mps2",
    "accel_y_mps2",
    "grade_x_ratio",
    "grade_y_ratio",
    "ride_z_mps2",
    "ride_roll_rad",
    "ride_pitch_rad",
    "ride_roll_radps2",
    "ride_pitch_radps2",
    "path_m",
    "leg_rad",
)
WHEEL_RECORD = (
    "wheel_radps",
    "steer_rad",
    "slip_ratio",
    "slip_angle_rad",
    "normal_n",
    "traction_n",
    "torque_nm",
    "sinkage_m",
    "reported_radps",
    "patch_ratio",
    "side_n",
)
"""What is recorded each step, at the body's origin and at each wheel.  Steering angles are true headings in
the body; traction and side force are those of the contact, along the wheel and to its left, so that it takes
up ``traction (w r - v_along) - side v_across``."""

EFFECT_STATES = (
    "steps_ratio",
    *(f"heading_{i}_rad" for i in (1, 2, 3)),
    *(f"creep_{i}_ratio" for i in (1, 2, 3)),
)
"""What effects remember, at the end of a state: steps so far, headings of the wheels in the play of their
linkage, and their creep over the slip of the ground; then the encoders' angles that have not reached the
wheels yet, three a step."""

STEPS, HEADING, CREEP, LATE = 0, 1, 4, len(EFFECT_STATES)
STIFFEST = -0.9
"""Least creep over the slip of the ground."""

N_BODY_RECORD = len(BODY_RECORD)
N_RECORD = N_BODY_RECORD + 3 * len(WHEEL_RECORD)


class Plant(NamedTuple):
    """All numbers of one simulated run that do not change while it is driven."""

    wheels_m: Array
    com_m: Array
    com_height_m: float
    mass_kg: float
    yaw_inertia_kgm2: float
    radius_m: Array
    wheel_inertia_kgm2: float
    relaxation_m: float
    contact_length_m: float
    ride_stiffness_npm: float
    ride_damping_nspm: float
    load_fraction: Array
    load_per_force_ratio: Array
    reduction_ratio: float
    torque_max_nm: float
    speed_max_radps: float
    torque_time_constant_s: float
    friction_nm: float
    speed_gain: float
    speed_integral: float
    estimate_time_constant_s: float
    hall_steps: float
    report_time_constant_s: float
    steer_rate_max_radps: float
    steer_accel_max_radps2: float
    backlash_rad: float
    leg_backlash_rad: float
    grade_ratio: Array
    undulation_ratio: float
    undulation_length_m: float
    grounds: Array
    roughness_m3: Array
    patch_start_m: Array
    field: Array
    linked: bool
    steer_offset_rad: Array
    steer_backlash_rad: float
    steer_delay_steps: int
    hidden: bool
    weight_n: float
    force_slip_ratio: float
    shear_slip_ratio: float
    slip_resistance_ratio: float
    rolling_ratio: float
    drag_nspm: float
    side_hill_ratio: float


def make_plant(
    robot: Robot,
    *,
    payload_kg: float,
    payload_m: tuple[float, float],
    radius_factors: Array,
    grade_ratio: tuple[float, float],
    undulation_ratio: float,
    undulation_length_m: float,
    leg_backlash_rad: float,
    grounds: Array,
    roughness_m3: Array,
    patch_start_m: Array,
    field: Array,
) -> Plant:
    """Return the plant of a robot with its load on its ground.

    Parameters
    ----------
    robot : with sections body, motors, steering and sensors; of its effects those act that are listed above,
        and a payload
    payload_kg, payload_m : load on top and where it lies from the empty robot's centre of mass, body axes
    radius_factors : (3,) true rolling radius of each wheel over the nominal one
    grade_ratio : (2,) mean gradient of the ground along world x and y, uphill positive
    undulation_ratio, undulation_length_m : amplitude of a gradient that changes along the way, and its wave
    length
    leg_backlash_rad : half the play of the third leg's hinge
    grounds : (patches, GROUND_SIZE) of ``terrain.terramechanics``
    roughness_m3 : (patches,) ISO 8608 roughness
    patch_start_m : (patches,) path length at which each begins, the first at 0
    field : (2, 3, cells) factors along the way on thrust and on resistance, for each wheel

    Raises
    ------
    ConfigError
        if the load takes the centre of mass out of the triangle of the wheels.
    """
    body, motors, steering, _, sensors = robot.equipment
    effects = dict.fromkeys(parameters_of(robot.drive), 0.0) | dict(robot.effects)
    mass_kg = robot.mass_kg * (1.0 + effects["payload_ratio"]) + payload_kg
    half = 0.5 * effects["one_sided_radius_ratio"]
    rolling = (1.0 + effects["wheel_radius_ratio"]) * np.array([1.0 - half, 1.0 - half, 1.0 + half])
    com_m = np.array([body.com_x_m, body.com_y_m]) + payload_kg / mass_kg * np.asarray(payload_m)
    # Rows: vertical force, moment about y (x arm), moment about x (y arm); columns: the three wheels.
    balance = np.vstack([np.ones(3), robot.wheel_positions_m.T])
    inverse = np.linalg.inv(balance)
    load_fraction = inverse @ np.array([1.0, com_m[0], com_m[1]])
    if load_fraction.min() <= 0.0:
        raise ConfigError(
            f"robot {robot.name}: a payload of {payload_kg:g} kg at ({payload_m[0]:g}, {payload_m[1]:g}) m "
            f"from the centre of mass tips it over: wheel {int(load_fraction.argmin()) + 1} would carry "
            "nothing"
        )
    return Plant(
        wheels_m=np.array(robot.wheel_positions_m),
        com_m=com_m,
        com_height_m=body.com_height_m,
        mass_kg=mass_kg,
        yaw_inertia_kgm2=body.yaw_inertia_kgm2 * mass_kg / robot.mass_kg,
        radius_m=robot.wheel_radius_m * np.asarray(radius_factors, dtype=float) * rolling,
        wheel_inertia_kgm2=body.wheel_inertia_kgm2,
        relaxation_m=body.relaxation_length_m,
        contact_length_m=body.contact_length_m,
        ride_stiffness_npm=body.tyre_stiffness_npm,
        ride_damping_nspm=body.tyre_damping_nspm,
        load_fraction=load_fraction,
        load_per_force_ratio=np.ascontiguousarray(-body.com_height_m * inverse[:, 1:]),
        reduction_ratio=motors.reduction_ratio,
        torque_max_nm=motors.torque_max_nm,
        speed_max_radps=motors.speed_max_radps,
        torque_time_constant_s=motors.torque_time_constant_s,
        friction_nm=motors.friction_nm,
        speed_gain=motors.speed_gain_nmspr,
        speed_integral=motors.speed_integral_nmpr,
        estimate_time_constant_s=motors.speed_estimate_time_constant_s,
        hall_steps=sensors.hall_steps_ratio * motors.reduction_ratio / (2 * math.pi),
        report_time_constant_s=sensors.encoder_time_constant_s,
        steer_rate_max_radps=steering.rate_max_radps,
        steer_accel_max_radps2=steering.accel_max_radps2,
        backlash_rad=steering.dead_band_rad,
        leg_backlash_rad=float(leg_backlash_rad),
        grade_ratio=np.array(grade_ratio, dtype=float),
        undulation_ratio=float(undulation_ratio),
        undulation_length_m=float(undulation_length_m),
        grounds=np.ascontiguousarray(grounds, dtype=float),
        roughness_m3=np.ascontiguousarray(roughness_m3, dtype=float),
        patch_start_m=np.ascontiguousarray(patch_start_m, dtype=float),
        field=np.ascontiguousarray(field, dtype=float),
        linked=any(effects[name] != 0.0 for name in in_plant(PlantPart.LINKAGE)),
        steer_offset_rad=np.array([effects[f"steering_offset_{i}_rad"] for i in (1, 2, 3)]),
        steer_backlash_rad=effects["steering_backlash_rad"],
        steer_delay_steps=round(effects["steering_delay_s"] / STEP_S),
        hidden=any(effects[name] != 0.0 for name in in_plant(PlantPart.CONTACT)),
        weight_n=robot.mass_kg * GRAVITY_MPS2,
        force_slip_ratio=effects["force_slip_ratio"],
        shear_slip_ratio=effects["shear_slip_ratio"],
        slip_resistance_ratio=effects["slip_resistance_ratio"],
        rolling_ratio=effects["rolling_resistance_ratio"],
        drag_nspm=effects["viscous_drag_nspm"],
        side_hill_ratio=effects["side_hill_slip_ratio"],
    )


def record_width(plant: Plant) -> int:
    """Return how many numbers are recorded a step: what the encoders see where a linkage hides the wheels."""
    return N_RECORD + 3 * plant.linked


def start_state(plant: Plant, steer_rad: Array) -> Array:
    """Return the state of a robot at rest at the origin, its steering motors at 0.

    Parameters
    ----------
    plant : of the robot
    steer_rad : (3,) where its wheels hang in their play
    """
    state = np.zeros(N_BODY + 3 * N_WHEEL + LATE + 3 * plant.steer_delay_steps)
    for i in range(3):
        wheel = state[N_BODY + i * N_WHEEL : N_BODY + (i + 1) * N_WHEEL]
        wheel[STEER] = steer_rad[i]
    tail = state[N_BODY + 3 * N_WHEEL :]
    tail[HEADING : HEADING + 3] = steer_rad
    tail[LATE:] = np.tile(steer_rad, plant.steer_delay_steps)
    return state


def settle(plant: Plant, state: Array) -> None:
    """Let a robot that was put on a slope come to rest; ``state`` is changed in place.

    Its wheels are told to stand; contacts and motors take up the load, which on the level changes nothing.
    For four of five seconds the speeds are taken away ten times a second, so that it does not swing; where it
    stands afterwards is the origin.  Ground too steep to stand on lets it slide.
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
    """
    dt = STEP_S
    tail = state[N_BODY + 3 * N_WHEEL :]
    accel = np.array([state[7], state[8], 0.0])  # of the last step; the third is dw/dt
    speeds = np.zeros((3, 2))
    ride = np.zeros(3)  # vertical acceleration of each corner
    for k in range(wheel_radps.shape[0] * substeps):
        command = k // substeps
        cos_yaw, sin_yaw = math.cos(state[2]), math.sin(state[2])
        grade_x, grade_y = _grade(plant, state, cos_yaw, sin_yaw)
        steepness = math.sqrt(1.0 + grade_x * grade_x + grade_y * grade_y)
        g_normal = GRAVITY_MPS2 / steepness
        row = record[k]
        force_x, force_y, moment, leg_nm = 0.0, 0.0, 0.0, 0.0
        # speeds of the wheel centres, and which way the body goes
        for i in range(3):
            speeds[i, 0] = state[3] - state[5] * (plant.wheels_m[i, 1] - plant.com_m[1])
            speeds[i, 1] = state[4] + state[5] * (plant.wheels_m[i, 0] - plant.com_m[0])
        speed = math.sqrt(state[3] * state[3] + state[4] * state[4]) + 1e-9
        for i in range(3):
            w = state[N_BODY + i * N_WHEEL : N_BODY + (i + 1) * N_WHEEL]
            _steer(plant, w, steer_rad[command, i], dt)
            heading = w[STEER]
            if plant.linked:
                heading = _linkage(plant, tail, w[STEER], i)
                row[N_RECORD + i] = w[STEER]
            if i == 2 and plant.leg_backlash_rad > 0.0:
                heading += state[LEG]
            cos_steer, sin_steer = math.cos(heading), math.sin(heading)
            along = cos_steer * speeds[i, 0] + sin_steer * speeds[i, 1]
            across = -sin_steer * speeds[i, 0] + cos_steer * speeds[i, 1]
            wheel_speed = w[RATE] * plant.radius_m[i]
            fastest = max(abs(wheel_speed), abs(along))
            ahead_m = (plant.wheels_m[i, 0] * state[3] + plant.wheels_m[i, 1] * state[4]) / speed
            patch = _patch(plant, state[6] + (ahead_m if speed > 0.05 else 0.0))
            ride_n = _ride(
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
            cell = min(max(int(state[6] / FIELD_STEP_M), 0), plant.field.shape[2] - 1)  # a NaN is no place
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
            _drive(plant, w, wheel_radps[command, i], thrust * plant.radius_m[i], dt)
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
        turn = state[5]
        vx, vy = state[3], state[4]
        state[3] = vx + dt * (accel[0] + turn * vy)
        state[4] = vy + dt * (accel[1] - turn * vx)
        state[5] = turn + dt * accel[2]
        origin_x = state[3] + state[5] * plant.com_m[1]
        origin_y = state[4] - state[5] * plant.com_m[0]
        state[0] += dt * (cos_yaw * origin_x - sin_yaw * origin_y)
        state[1] += dt * (sin_yaw * origin_x + cos_yaw * origin_y)
        state[2] += dt * state[5]
        state[6] += dt * math.sqrt(origin_x * origin_x + origin_y * origin_y)
        state[7], state[8] = accel[0], accel[1]
        if plant.leg_backlash_rad > 0.0:
            state[LEG] = _swing(plant, state[LEG], leg_nm, dt)


@njit(cache=True)
def _grade(plant: Plant, state: Array, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Gradient of the ground in body axes, uphill positive."""
    undulation = plant.undulation_ratio * math.sin(2 * math.pi * state[6] / plant.undulation_length_m)
    world_x, world_y = plant.grade_ratio[0] + undulation, plant.grade_ratio[1]
    return cos_yaw * world_x + sin_yaw * world_y, -sin_yaw * world_x + cos_yaw * world_y


@njit(cache=True)
def _patch(plant: Plant, path_m: float) -> int:
    patch = 0
    while patch + 1 < plant.patch_start_m.size and path_m >= plant.patch_start_m[patch + 1]:
        patch += 1
    return patch


@njit(cache=True)
def _steer(plant: Plant, w: Array, command_rad: float, dt: float) -> None:
    """Steering motor to its command with bounded rate and acceleration; the wheel hangs on it with play."""
    error = command_rad - w[MOTOR]
    # the rate from which the motor can still stop in time
    desired = math.copysign(
        min(math.sqrt(2 * plant.steer_accel_max_radps2 * abs(error)), plant.steer_rate_max_radps), error
    )
    if abs(error) < 1e-4:
        desired = error / dt
    change = plant.steer_accel_max_radps2 * dt
    w[MOTOR_RATE] += min(max(desired - w[MOTOR_RATE], -change), change)
    w[MOTOR] += dt * w[MOTOR_RATE]
    w[STEER] = min(max(w[STEER], w[MOTOR] - plant.backlash_rad), w[MOTOR] + plant.backlash_rad)


@njit(cache=True)
def _linkage(plant: Plant, tail: Array, encoder_rad: float, i: int) -> float:
    """Return the heading of a wheel behind delay, play and offset of its linkage."""
    late = encoder_rad
    if plant.steer_delay_steps > 0:
        place = LATE + 3 * (int(tail[STEPS]) % plant.steer_delay_steps) + i
        late, tail[place] = tail[place], encoder_rad
        tail[STEPS] += i == 2
    tail[HEADING + i] = min(
        max(tail[HEADING + i], late - plant.steer_backlash_rad), late + plant.steer_backlash_rad
    )
    return float(tail[HEADING + i] + plant.steer_offset_rad[i])


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
def _drive(plant: Plant, w: Array, command_radps: float, load_nm: float, dt: float) -> None:
    """Speed loop, motor and wheel; then what the driver reports of it."""
    command = min(max(command_radps, -plant.speed_max_radps), plant.speed_max_radps)
    error = command - w[ESTIMATE]
    desired = plant.speed_gain * error + w[INTEGRAL]
    torque = min(max(desired, -plant.torque_max_nm), plant.torque_max_nm)
    if torque == desired or desired * error < 0.0:
        w[INTEGRAL] += dt * plant.speed_integral * error
    w[TORQUE] += (torque - w[TORQUE]) * min(dt / max(plant.torque_time_constant_s, dt), 1.0)
    friction = plant.friction_nm * math.tanh(w[RATE] / 0.1)
    w[RATE] += dt * (w[TORQUE] - friction - load_nm) / plant.wheel_inertia_kgm2
    w[ANGLE] += dt * w[RATE]
    w[ESTIMATE] += (w[RATE] - w[ESTIMATE]) * min(dt / max(plant.estimate_time_constant_s, dt), 1.0)
    count = math.floor(w[ANGLE] * plant.hall_steps)
    seen = (count - w[COUNT]) / plant.hall_steps / dt
    w[COUNT] = count
    w[REPORTED] += (seen - w[REPORTED]) * min(dt / max(plant.report_time_constant_s, dt), 1.0)


@njit(cache=True)
def _ride(plant: Plant, w: Array, i: int, patch: int, speed: float, noise: float, dt: float) -> float:
    """Move the corner on its tyre over the rough ground; return what that adds to the load.

    Roughness of waviness 2 is white in slope: ``d(road)/dt = -2 pi n_c v road + 2 pi n_0 sqrt(G v) w`` with
    ``w`` white of one-sided density 1 (ISO 8608); the contact averages it over its length.
    """
    white = noise * math.sqrt(0.5 / dt)
    w[ROAD] += dt * (
        -2 * math.pi * ROUGHNESS_CUTOFF * speed * w[ROAD]
        + 2 * math.pi * ROUGHNESS_WAVENUMBER * math.sqrt(plant.roughness_m3[patch] * speed) * white
    )
    contact_rate = (w[ROAD] - w[CONTACT]) * min(2.0 * speed / plant.contact_length_m, 1.0 / dt)
    w[CONTACT] += dt * contact_rate
    mass_kg = plant.mass_kg * plant.load_fraction[i]
    force_n = plant.ride_stiffness_npm * (w[CONTACT] - w[RIDE]) + plant.ride_damping_nspm * (
        contact_rate - w[RIDE_RATE]
    )
    w[RIDE_RATE] += dt * force_n / mass_kg
    w[RIDE] += dt * w[RIDE_RATE]
    return float(force_n)


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
    row[3] = state[3] + turn * plant.com_m[1]
    row[4] = state[4] - turn * plant.com_m[0]
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
