"""Effects of the load and of the motors: mass, torque constant and its drift."""

from __future__ import annotations

from terrain.effects.types import (
    BOTH,
    CURRENT,
    OMNI,
    SPEED_X,
    TURNING_CURRENT,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    PlantPart,
)

LOAD_AND_MOTORS: tuple[Effect, ...] = (
    Effect(
        "payload",
        (
            Parameter(
                "payload_ratio",
                -0.5,
                1.5,
                0.02,
                homes=(
                    Home("", "mass_kg", Combine.TIMES),
                    Home("body", "yaw_inertia_kgm2", Combine.TIMES, optional=True),
                ),
                as_percent=True,
            ),
        ),
        "mass m (1 + p)",
        "Newton",
        (*BOTH, OMNI),  # of a car, whose currents are not logged, it looks like its tyres
        (CURRENT, SPEED_X),
        "accelerations and slopes",
        plant=PlantPart.BODY,
        twins=(("motor_constant", SPEED_X),),
        beside=((OMNI, "roller_friction"),),  # there it scales the currents as that does, and no motion
    ),
    Effect(
        "motor_constant",
        (
            Parameter(
                "motor_constant_ratio",
                -0.5,
                1.0,
                0.01,
                homes=(Home("motors", "torque_constant_nmpa", Combine.OVER),),
                inverse=Inverse(("wheels",), "current / (1 + q)", without_home=True),
                as_percent=True,
                is_error=True,
            ),
        ),
        "current (1 + q)",
        "DC motor: current is torque over its constant",
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "accelerations and slopes",
        sensed_only=True,
        plant=PlantPart.DESCRIPTION,
        twins=(("payload", SPEED_X),),
    ),
    Effect(
        "motor_drift",
        (
            Parameter(
                "motor_drift_ratio",
                -0.5,
                1.0,
                0.01,
                inverse=Inverse(
                    ("wheels",), "current / (1 + q t / 60 s), from the first stamp of the wheels"
                ),
                as_percent=True,
            ),
        ),
        "current (1 + q t / 60 s) from the start of a run",
        "remanence of a magnet that warms; linear over a run",
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "long runs",
        sensed_only=True,
        plant=PlantPart.SENSORS,
    ),
    Effect(
        "current_offset",
        (
            # zero of a Hall sensor: up to 2 % of a range of 50 to 200 A
            Parameter(
                "current_offset_a", -4.0, 4.0, 0.05, inverse=Inverse(("wheels",), "current of each motor - b")
            ),
        ),
        "current of each motor + b: n b in the sum of n motors, nothing in the difference of the sides",
        "zero error of a current sensor",
        BOTH,
        (CURRENT,),
        "standstill, and driving forward and backward",
        sensed_only=True,
        plant=PlantPart.SENSORS,
    ),
)
