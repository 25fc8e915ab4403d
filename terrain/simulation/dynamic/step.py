"""The body and its wheels: a planar robot with load transfer on three driven, steered wheels.

States are integrated with semi-implicit steps of :data:`STEP_S`.  What acts, in the order of one step:

- **load**: three contacts carry a rigid body, so their normal forces follow from balance alone:
  ``sum N = m g cos``, and the moments of gravity and inertia about the two body axes; tyres as springs over
  a rough ground add their own (:func:`ride_over`).
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
  ``leg_backlash_rad``, to where the ground pushes its wheel; that turns the wheel's heading, which
  its steering encoder below the hinge does not see (thesis, conclusions: backlash of the third leg's opening
  system). What the swing moves the wheel's centre by, and its friction's own moment, are left out.
- **body**: ``m (dv/dt + w x v) = sum F - m g grad``, ``I dw/dt = sum (r_i - r_com) x F_i``.

Resistance acts at the axle, against the rolling of the wheel; hence in steady motion the thrust balances it
and the slip follows from the ground, not from the speed.

Roughness of waviness 2 is white in slope: ``d(road)/dt = -2 pi n_c v road + 2 pi n_0 sqrt(G v) w`` with ``w``
white of one-sided density 1 (ISO 8608); the contact averages it over its length.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.kernels import inner, njit
from terrain.kinematics.wheels import point_velocity
from terrain.records import Array
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_slip
from terrain.simulation.dynamic.plant import FIELD_STEP_M, TerrainProfile
from terrain.simulation.sensors import BODY_ROW, STEP_S
from terrain.terramechanics.traction import wheel_ground

# Speed over which a resistance takes its full size: it opposes rolling and does not push a robot at rest.
ROLLING_SPEED_MPS = 0.02
LEG_RATE_RADPS = (
    0.5  # how fast the third leg swings through its play; assumed, it crosses one degree in 35 ms
)
# Moment about its hinge below which the third leg stays where it is; assumed, 7 N on the wheel: a start at 1 m/s^2
# gives three times as much, steady rolling less.
LEG_FRICTION_NM = 5.0
STIFFEST = -0.9  # least creep over the slip of the ground
ROUGHNESS_WAVENUMBER = 0.1  # reference wave number of ISO 8608 in cycles/m
ROUGHNESS_CUTOFF = (
    0.01  # longest wave of the ground that counts as roughness, in cycles/m (ISO 8608's lower end)
)


def settle(plant: Array, profile: TerrainProfile, state: Array) -> None:
    """Let a robot that was put on a slope come to rest; ``state`` is changed in place.

    Its wheels are commanded to stand; contacts and motors take up the load, which on the level changes
    nothing. For four of five seconds the speeds are taken away ten times a second, so that it does not swing;
    where it rests afterwards is the origin.  Terrain too steep to stand on lets it slide.
    """
    stand, rows = np.zeros((1, 3)), np.empty(100, BODY_ROW)
    for tenth in range(50):
        advance(plant, profile, state, stand, stand, 100, np.zeros((100, 3)), rows)
        if tenth < 40:
            state["speed_x_mps"] = state["speed_y_mps"] = state["yaw_rate_radps"] = 0.0
    for name in ("position_x_m", "position_y_m", "yaw_rad", "path_m"):
        state[name] = 0.0


@njit
def advance(
    plant: Array,
    profile: TerrainProfile,
    state: Array,
    wheel_radps: Array,
    steer_rad: Array,
    substeps: int,
    road_noise: Array,
    rows: Array,
) -> None:
    """Drive through commands that are held for ``substeps`` steps each; ``state`` is changed in place.

    Parameters
    ----------
    plant, profile, state : as :func:`~terrain.simulation.dynamic.plant.make_plant`, ``draw_profile`` and
        ``start_state`` give them; or a state as an earlier call left it
    wheel_radps, steer_rad : (n, 3) commands
    substeps : steps of :data:`STEP_S` a command
    road_noise : (n * substeps, 3) standard normal numbers, the roughness under each wheel
    rows : (n * substeps,) of :data:`~terrain.simulation.sensors.BODY_ROW`, is written
    """
    for k in range(wheel_radps.shape[0] * substeps):
        held = k // substeps
        step(plant[0], profile, state[0], wheel_radps[held], steer_rad[held], road_noise[k], rows[k], STEP_S)


@inner
def step(
    plant: Any,
    profile: TerrainProfile,
    state: Any,
    wheel_radps: Array,
    steer_rad: Array,
    noise: Array,
    row: Any,
    dt: float,
) -> None:
    """Step all wheels, then the body that they carry; the row is that of the start of the step."""
    cos_yaw, sin_yaw = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    grade_x, grade_y = terrain_gradient(plant, state.path_m, cos_yaw, sin_yaw)
    steepness = math.sqrt(1.0 + grade_x * grade_x + grade_y * grade_y)
    row.grade_x_ratio, row.grade_y_ratio = grade_x, grade_y
    force_x, force_y, moment, leg_nm = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        steer_wheel(plant, state.wheels[i], steer_rad[i], dt)
        fx, fy = _wheel_force(plant, profile, state, i, steepness, wheel_radps[i], noise[i], row, dt)
        if i == 2:
            leg_nm = -plant.wheels_m[i, 1] * fx
        force_x += fx
        force_y += fy
        moment += (plant.wheels_m[i, 0] - plant.com_m[0]) * fy - (plant.wheels_m[i, 1] - plant.com_m[1]) * fx
    state.n_steps += 1
    accel_x = force_x / plant.mass_kg - GRAVITY_MPS2 * grade_x / steepness
    accel_y = force_y / plant.mass_kg - GRAVITY_MPS2 * grade_y / steepness
    spin = moment / plant.yaw_inertia_kgm2
    _write_body(plant, state, accel_x, accel_y, spin, row)
    _step_body(plant, state, accel_x, accel_y, spin, cos_yaw, sin_yaw, dt)
    if plant.leg_backlash_rad > 0.0:
        state.leg_rad = _swing(plant, state.leg_rad, leg_nm, dt)


@inner
def _wheel_force(
    plant: Any,
    profile: TerrainProfile,
    state: Any,
    i: int,
    steepness: float,
    command_radps: float,
    noise: float,
    row: Any,
    dt: float,
) -> tuple[float, float]:
    """Step a steered wheel and its contact; return the force on the body along its axes."""
    w, out, radius_m = state.wheels[i], row.wheels[i], plant.radius_m[i]
    grade_x, grade_y = row.grade_x_ratio, row.grade_y_ratio
    heading = w.steer_rad
    row.encoder_rad[i] = w.steer_rad
    if plant.linked:
        heading = linkage_heading(plant, state, i, dt)
    if i == 2 and plant.leg_backlash_rad > 0.0:
        heading += state.leg_rad
    # speed of the wheel's centre, along the wheel and across it
    x_m, y_m = plant.wheels_m[i, 0] - plant.com_m[0], plant.wheels_m[i, 1] - plant.com_m[1]
    v_x, v_y = point_velocity(state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps, x_m, y_m)
    cos_steer, sin_steer = math.cos(heading), math.sin(heading)
    along = cos_steer * v_x + sin_steer * v_y
    across = -sin_steer * v_x + cos_steer * v_y
    wheel_speed = w.rate_radps * radius_m
    fastest = max(abs(wheel_speed), abs(along))
    # the patch that the wheel is on lies ahead of the body's by its place in the direction of motion
    speed = math.sqrt(state.speed_x_mps * state.speed_x_mps + state.speed_y_mps * state.speed_y_mps) + 1e-9
    ahead_m = (plant.wheels_m[i, 0] * state.speed_x_mps + plant.wheels_m[i, 1] * state.speed_y_mps) / speed
    patch = patch_index(profile.patches, state.path_m + (ahead_m if speed > 0.05 else 0.0))
    ground = profile.patches[patch].ground
    rolled = math.sqrt(along * along + across * across)
    ride_n = ride_over(plant, w, i, profile.patches[patch].roughness_m3, rolled, noise, dt)
    normal_n = plant.mass_kg * (
        GRAVITY_MPS2 / steepness * plant.load_fraction[i]
        + plant.load_per_force_ratio[i, 0] * (state.accel_x_mps2 + GRAVITY_MPS2 * grade_x / steepness)
        + plant.load_per_force_ratio[i, 1] * (state.accel_y_mps2 + GRAVITY_MPS2 * grade_y / steepness)
    )
    w.ride_mps2 = ride_n / (plant.mass_kg * plant.load_fraction[i])
    normal_n = max(normal_n + ride_n, 0.0)
    rate_x = wheel_speed - along - fastest / plant.relaxation_length_m * w.deflection_x_m
    rate_y = -across - fastest / plant.relaxation_length_m * w.deflection_y_m
    if plant.yields:
        rate_x -= w.creep_ratio * fastest / plant.relaxation_length_m * w.deflection_x_m
        rate_y -= plant.effects.side_hill_slip_ratio * math.atan(grade_y) * abs(along)
    slip_x = (w.deflection_x_m + DEFLECTION_DAMPING_S * rate_x) / plant.relaxation_length_m
    slip_y = (w.deflection_y_m + DEFLECTION_DAMPING_S * rate_y) / plant.relaxation_length_m
    thrust, side, resistance, sinkage = wheel_ground(ground, normal_n, min(max(slip_x, -1.0), 1.0), slip_y)
    cell = min(max(int(state.path_m / FIELD_STEP_M), 0), profile.field.shape[2] - 1)  # a NaN is no place
    thrust *= profile.field[0, i, cell]
    side *= profile.field[0, i, cell]
    resistance *= profile.field[1, i, cell]
    if plant.yields:
        w.creep_ratio = _creep(plant, ground, normal_n, slip_x, thrust)
        slip = abs(slip_x) * (1.0 + w.creep_ratio)
        resistance += (
            plant.effects.rolling_resistance_ratio + plant.effects.slip_resistance_ratio * slip
        ) * normal_n
        resistance = max(resistance + plant.effects.viscous_drag_nspm * abs(along) / 3.0, 0.0)
    pull = thrust - resistance * math.tanh(along / ROLLING_SPEED_MPS)
    drive_wheel(plant, w, command_radps, thrust * radius_m, dt)
    # the contact follows with the wheel's new rate: semi-implicit
    rate_x = w.rate_radps * radius_m - along - fastest / plant.relaxation_length_m * w.deflection_x_m
    limit = plant.relaxation_length_m
    deflection = w.deflection_x_m + dt * rate_x
    if plant.yields:  # implicit: a contact that creeps fast is stiff
        deflection /= 1.0 + dt * (w.creep_ratio * fastest / plant.relaxation_length_m)
    w.deflection_x_m = min(max(deflection, -limit), limit)
    w.deflection_y_m = min(max(w.deflection_y_m + dt * rate_y, -limit), limit)
    out.wheel_radps = wheel_speed / radius_m  # of this instant, as the slip is
    out.steer_rad = heading
    out.slip_ratio = (wheel_speed - along) / fastest if fastest >= 0.05 else np.nan
    out.slip_angle_rad = math.atan2(across, abs(along)) if math.hypot(along, across) >= 0.05 else np.nan
    out.normal_n, out.traction_n, out.side_n, out.torque_nm = normal_n, thrust, side, w.torque_nm
    out.sinkage_m, out.reported_radps, out.patch_ratio = sinkage, w.reported_radps, patch
    return cos_steer * pull - sin_steer * side, sin_steer * pull + cos_steer * side


@inner
def _step_body(
    plant: Any,
    state: Any,
    accel_x: float,
    accel_y: float,
    spin: float,
    cos_yaw: float,
    sin_yaw: float,
    dt: float,
) -> None:
    """Step the body with the acceleration of its centre of mass and of its yaw."""
    turn, vx, vy = state.yaw_rate_radps, state.speed_x_mps, state.speed_y_mps
    state.speed_x_mps = vx + dt * (accel_x + turn * vy)
    state.speed_y_mps = vy + dt * (accel_y - turn * vx)
    state.yaw_rate_radps = turn + dt * spin
    origin_x, origin_y = point_velocity(
        state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps, -plant.com_m[0], -plant.com_m[1]
    )
    state.position_x_m += dt * (cos_yaw * origin_x - sin_yaw * origin_y)
    state.position_y_m += dt * (sin_yaw * origin_x + cos_yaw * origin_y)
    state.yaw_rad += dt * state.yaw_rate_radps
    state.path_m += dt * math.sqrt(origin_x * origin_x + origin_y * origin_y)
    state.accel_x_mps2, state.accel_y_mps2 = accel_x, accel_y


@inner
def _write_body(plant: Any, state: Any, accel_x: float, accel_y: float, spin: float, row: Any) -> None:
    """Speeds and accelerations at the origin; the ride of the plane through the three corners."""
    base_m, track_m = plant.wheels_m[1, 0] - plant.wheels_m[0, 0], -plant.wheels_m[2, 1]
    one, two, three = state.wheels[0], state.wheels[1], state.wheels[2]
    turn, com_x, com_y = state.yaw_rate_radps, plant.com_m[0], plant.com_m[1]
    row.position_x_m, row.position_y_m, row.yaw_rad = state.position_x_m, state.position_y_m, state.yaw_rad
    row.speed_x_mps, row.speed_y_mps = point_velocity(
        state.speed_x_mps, state.speed_y_mps, turn, -com_x, -com_y
    )
    row.yaw_rate_radps = turn
    row.accel_x_mps2 = accel_x + spin * com_y + turn * turn * com_x
    row.accel_y_mps2 = accel_y - spin * com_x + turn * turn * com_y
    row.ride_z_mps2 = 0.5 * (one.ride_mps2 + two.ride_mps2)
    row.ride_roll_rad = (0.5 * (one.ride_m + two.ride_m) - three.ride_m) / track_m
    row.ride_pitch_rad = -(two.ride_m - one.ride_m) / base_m
    row.ride_roll_radps2 = (0.5 * (one.ride_mps2 + two.ride_mps2) - three.ride_mps2) / track_m
    row.ride_pitch_radps2 = -(two.ride_mps2 - one.ride_mps2) / base_m
    row.path_m, row.leg_rad = state.path_m, state.leg_rad


@inner
def _creep(plant: Any, ground: Any, normal_n: float, slip: float, thrust_n: float) -> float:
    """Return what a contact creeps by beside the slip of the ground, over that slip."""
    if abs(slip) < 1e-6 or normal_n <= 0.0:
        return 0.0
    force_ratio = 3.0 * thrust_n / plant.weight_n
    creep = plant.effects.force_slip_ratio * force_ratio
    if plant.effects.shear_slip_ratio != 0.0:
        grip_ratio = ground.peak_friction_ratio
        if not ground.hard:
            area_m2 = ground.contact_length_m * ground.tyre_width_m
            grip_ratio = ground.tan_friction + ground.cohesion_pa * area_m2 / normal_n
        creep += plant.effects.shear_slip_ratio * shear_slip(force_ratio, grip_ratio)
    return float(max(creep / slip, STIFFEST))


@inner
def _swing(plant: Any, leg_rad: float, moment_nm: float, dt: float) -> float:
    """Swing the third leg through its play to where its wheel is pushed, if that is hard enough."""
    if abs(moment_nm) <= LEG_FRICTION_NM:
        return leg_rad
    turned_rad = leg_rad + math.copysign(LEG_RATE_RADPS * dt, moment_nm)
    return float(min(max(turned_rad, -plant.leg_backlash_rad), plant.leg_backlash_rad))


@inner
def terrain_gradient(plant: Any, path_m: float, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Return the gradient of the ground in body axes, uphill positive."""
    undulation = plant.undulation_ratio * math.sin(2 * math.pi * path_m / plant.undulation_length_m)
    world_x, world_y = plant.grade_ratio[0] + undulation, plant.grade_ratio[1]
    return cos_yaw * world_x + sin_yaw * world_y, -sin_yaw * world_x + cos_yaw * world_y


@inner
def patch_index(patches: Array, path_m: float) -> int:
    """Return the number of the patch at a path length."""
    patch = 0
    while patch + 1 < patches.size and path_m >= patches[patch + 1].start_m:
        patch += 1
    return patch


@inner
def ride_over(
    plant: Any, w: Any, i: int, roughness_m3: float, speed: float, noise: float, dt: float
) -> float:
    """Move the corner on its tyre over the rough ground; return what that adds to the load."""
    white = noise * math.sqrt(0.5 / dt)
    w.road_m += dt * (
        -2 * math.pi * ROUGHNESS_CUTOFF * speed * w.road_m
        + 2 * math.pi * ROUGHNESS_WAVENUMBER * math.sqrt(roughness_m3 * speed) * white
    )
    contact_rate = (w.road_m - w.contact_m) * min(2.0 * speed / plant.contact_length_m, 1.0 / dt)
    w.contact_m += dt * contact_rate
    mass_kg = plant.mass_kg * plant.load_fraction[i]
    force_n = plant.tyre_stiffness_npm * (w.contact_m - w.ride_m) + plant.tyre_damping_nspm * (
        contact_rate - w.ride_mps
    )
    w.ride_mps += dt * force_n / mass_kg
    w.ride_m += dt * w.ride_mps
    return float(force_n)


@inner
def steer_wheel(plant: Any, w: Any, command_rad: float, dt: float) -> None:
    """Steering motor to its command with bounded rate and acceleration; the wheel hangs on it with play."""
    error = command_rad - w.steer_motor_rad
    # the rate from which the motor can still stop in time
    desired = math.copysign(
        min(math.sqrt(2 * plant.accel_max_radps2 * abs(error)), plant.rate_max_radps), error
    )
    if abs(error) < 1e-4:
        desired = error / dt
    change = plant.accel_max_radps2 * dt
    w.steer_motor_radps += min(max(desired - w.steer_motor_radps, -change), change)
    w.steer_motor_rad += dt * w.steer_motor_radps
    w.steer_rad = min(
        max(w.steer_rad, w.steer_motor_rad - plant.dead_band_rad), w.steer_motor_rad + plant.dead_band_rad
    )


@inner
def linkage_heading(plant: Any, state: Any, i: int, dt: float) -> float:
    """Return the heading of a wheel behind delay, play and offset of its linkage."""
    w = state.wheels[i]
    late = w.steer_rad
    delay_steps, backlash_rad = (
        round(plant.effects.steering_delay_s / dt),
        plant.effects.steering_backlash_rad,
    )
    if delay_steps > 0:
        place = state.n_steps % delay_steps
        late, state.late_rad[place, i] = state.late_rad[place, i], w.steer_rad
    w.heading_rad = min(max(w.heading_rad, late - backlash_rad), late + backlash_rad)
    return float(w.heading_rad + plant.steer_offset_rad[i])


@inner
def drive_wheel(plant: Any, w: Any, command_radps: float, load_nm: float, dt: float) -> None:
    """Speed loop, motor and wheel; then the rate that the motor driver reports."""
    command = min(max(command_radps, -plant.speed_max_radps), plant.speed_max_radps)
    error = command - w.estimate_radps
    desired = plant.speed_gain_nmspr * error + w.integral_nm
    torque = min(max(desired, -plant.torque_max_nm), plant.torque_max_nm)
    if torque == desired or desired * error < 0.0:
        w.integral_nm += dt * plant.speed_integral_nmpr * error
    w.torque_nm += (torque - w.torque_nm) * min(dt / max(plant.torque_time_constant_s, dt), 1.0)
    friction = plant.friction_nm * math.tanh(w.rate_radps / 0.1)
    w.rate_radps += dt * (w.torque_nm - friction - load_nm) / plant.wheel_inertia_kgm2
    w.angle_rad += dt * w.rate_radps
    lag = min(dt / max(plant.speed_estimate_time_constant_s, dt), 1.0)
    w.estimate_radps += (w.rate_radps - w.estimate_radps) * lag
    count = math.floor(w.angle_rad * plant.hall_steps)
    seen = (count - w.hall_count) / plant.hall_steps / dt
    w.hall_count = count
    w.reported_radps += (seen - w.reported_radps) * min(dt / max(plant.encoder_time_constant_s, dt), 1.0)
