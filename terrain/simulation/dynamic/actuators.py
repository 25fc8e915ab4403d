"""Actuators of one wheel: steering motor, linkage and speed loop."""

from __future__ import annotations

import math

from numba import njit

from terrain.records import Array
from terrain.simulation.dynamic.plant import Plant
from terrain.simulation.dynamic.states import (
    ANGLE,
    COUNT,
    ESTIMATE,
    HEADING,
    INTEGRAL,
    LATE,
    MOTOR,
    MOTOR_RATE,
    RATE,
    REPORTED,
    STEER,
    STEPS,
    TORQUE,
)


@njit(cache=True)
def steer_wheel(plant: Plant, w: Array, command_rad: float, dt: float) -> None:
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
def linkage_heading(plant: Plant, tail: Array, encoder_rad: float, i: int) -> float:
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
def drive_wheel(plant: Plant, w: Array, command_radps: float, load_nm: float, dt: float) -> None:
    """Speed loop, motor and wheel; then the rate that the motor driver reports."""
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
