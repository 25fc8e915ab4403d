"""The state of the dynamic plant: entries by name."""

from __future__ import annotations

import numpy as np

from terrain.records import Array
from terrain.simulation.dynamic.plant import Plant

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

YAW, SPEED_X, SPEED_Y, YAW_RATE, PATH, ACCEL_X, ACCEL_Y, LEG = range(2, 10)

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

EFFECT_STATES = (
    "steps_ratio",
    *(f"heading_{i}_rad" for i in (1, 2, 3)),
    *(f"creep_{i}_ratio" for i in (1, 2, 3)),
)
"""What effects remember, at the end of a state: steps so far, headings of the wheels in the play of their
linkage, and their creep over the slip of the ground; then the encoders' angles that have not reached the
wheels yet, three a step."""

STEPS, HEADING, CREEP, LATE = 0, 1, 4, len(EFFECT_STATES)


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
