"""Effects: named groups of parameters of the simulation that are 0 where the effect is absent.

An entry of the catalogue holds all about an effect: bounds, formula, source, robots, channels, where a
description has it, how it is taken off samples, and how it is shown.

Examples
--------
>>> effect = effect_named("gyro_scale")
>>> effect.formula, effect.parameters[0].inverse.formula
('gyro = (1 + k) w', '(gyro - bias) / (1 + k) + bias; fused yaw / (1 + k)')
"""

from terrain.effects.catalogue import (
    BOUNDS,
    DEPRECATED,
    LIBRARY,
    NUISANCES,
    ONE_SIDED,
    PARAMETER,
    SENSED_ONLY,
    STEPS,
    TILT_OFFSETS,
    chosen_effects,
    effect_named,
    in_plant,
    library_of,
    nuisances_of,
    parameters_of,
    read_effects_of,
    showing,
)
from terrain.effects.described import SCHEMA, checked_covariance, checked_effects, read_effects
from terrain.effects.sensors import OTHER_LOGGER
from terrain.effects.types import (
    ACCEL,
    BICYCLE,
    BOTH,
    CHANNELS,
    CURRENT,
    EVERY,
    GYRO,
    HEADING,
    MOTION,
    OMNI,
    SKID,
    SKIDDING,
    SPEED_X,
    SPEED_Y,
    SWERVE,
    TRACKED,
    TURNING_CURRENT,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    PlantPart,
    Wording,
)
from terrain.effects.vector import EFFECTS, INDEX, PARAMETERS, vector_of

__all__ = [
    "ACCEL",
    "BICYCLE",
    "BOTH",
    "BOUNDS",
    "CHANNELS",
    "CURRENT",
    "DEPRECATED",
    "EFFECTS",
    "EVERY",
    "GYRO",
    "HEADING",
    "INDEX",
    "LIBRARY",
    "MOTION",
    "NUISANCES",
    "OMNI",
    "ONE_SIDED",
    "OTHER_LOGGER",
    "PARAMETER",
    "PARAMETERS",
    "SCHEMA",
    "SENSED_ONLY",
    "SKID",
    "SKIDDING",
    "SPEED_X",
    "SPEED_Y",
    "STEPS",
    "SWERVE",
    "TILT_OFFSETS",
    "TRACKED",
    "TURNING_CURRENT",
    "Combine",
    "Effect",
    "Home",
    "Inverse",
    "Parameter",
    "PlantPart",
    "Wording",
    "checked_covariance",
    "checked_effects",
    "chosen_effects",
    "effect_named",
    "in_plant",
    "library_of",
    "nuisances_of",
    "parameters_of",
    "read_effects",
    "read_effects_of",
    "showing",
    "vector_of",
]
