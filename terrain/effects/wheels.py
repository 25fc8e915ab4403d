"""Effects of wheels and steering: radii, zero angles, backlash and delays."""

from __future__ import annotations

from terrain.effects.types import (
    BICYCLE,
    BOTH,
    CURRENT,
    EVERY,
    GYRO,
    HEADING,
    MOTION,
    SKIDDING,
    SPEED_Y,
    SWERVE,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    PlantPart,
    Wording,
)

KINEMATICS = "kinematics of a planar robot"


def _steering_offset(wheel: int) -> Effect:
    name = f"steering_offset_{wheel}"
    return Effect(
        name,
        (
            Parameter(
                f"{name}_rad",
                -0.3,
                0.3,
                0.005,
                homes=(Home("steering", f"zero_{wheel}_rad", Combine.SUBTRACTED),),
            ),
        ),
        f"d_{wheel} = measured angle + d0",
        KINEMATICS,
        (SWERVE,),
        (*MOTION, HEADING) if wheel < 3 else MOTION,  # wheel 3 is beside the middle, and hardly turns it
        "several speeds and standstill",
        plant=PlantPart.LINKAGE,
    )


def _wheel_scale(wheel: int) -> Effect:
    """Return the scale of one encoder.

    All three together span wheel_radius and one_sided_radius, so that of the five three logs
    determine three; one alone looks like neither.
    """
    name = f"wheel_scale_{wheel}"
    return Effect(
        name,
        (
            # an encoder that loses counts, or a tyre of another wear: a fifth is more than either
            Parameter(
                f"{name}_ratio",
                -0.2,
                0.2,
                0.01,
                inverse=Inverse(("wheels",), f"rate and speed of wheel {wheel} x (1 + e)"),
                as_percent=True,
                is_error=True,
            ),
        ),
        f"wheel speed {wheel} = (1 + e) x measured",
        KINEMATICS,
        (SWERVE,),
        (*MOTION, HEADING),
        "straight drives in several directions",
        plant=PlantPart.SENSORS,
    )


WHEELS_AND_STEERING: tuple[Effect, ...] = (
    Effect(
        "wheel_radius",
        (
            Parameter(
                "wheel_radius_ratio",
                -0.3,
                0.3,
                0.01,
                homes=(Home("", "wheel_radius_m", Combine.TIMES),),
                inverse=Inverse(("wheels",), "wheel speed in m/s x (1 + e), where a log has it"),
                scatter_rank=5,
                as_percent=True,
                is_error=True,
            ),
        ),
        "wheel speed = (1 + e) r x wheel rate, torque = (1 + e) r F",
        KINEMATICS,
        EVERY,
        (*MOTION, CURRENT, HEADING),
        "any speed; slopes and accelerations to part it from slip",
        plant=PlantPart.BODY,
        aliases=("encoder_scale",),
    ),
    Effect(
        "one_sided_radius",
        (
            # pressure and wear of tyres differ by a few percent from side to side
            Parameter(
                "one_sided_radius_ratio",
                -0.1,
                0.1,
                0.008,
                inverse=Inverse(
                    ("wheels", "truth"), "rates and speeds of the right side x (1 + e/2), left x (1 - e/2)"
                ),
                scatter_rank=6,
                as_percent=True,
                is_error=True,
            ),
        ),
        "wheel speeds of the right side x (1 + e/2), of the left x (1 - e/2)",
        KINEMATICS,
        BOTH,
        (*MOTION, HEADING),
        "fast and straight",
        plant=PlantPart.BODY,
        wording=Wording.SIDES,
    ),
    *(_wheel_scale(wheel) for wheel in (1, 2, 3)),
    *(_steering_offset(wheel) for wheel in (1, 2, 3)),
    Effect(
        "steering_backlash",
        (
            Parameter(
                "steering_backlash_rad",
                0.0,
                0.2,
                0.003,
                inverse=Inverse(("steering",), "angles pass through a play of half width b"),
                one_sided=True,
                deprecated=("steering_play_rad",),
            ),
        ),
        "d follows the measured angle through a play of half width b",
        "play operator; Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989",
        (SWERVE, BICYCLE),
        (*MOTION, HEADING),
        "reversals of the steering",
        plant=PlantPart.LINKAGE,
        deprecated=("steering_play",),
    ),
    Effect(
        "steering_delay",
        (Parameter("steering_delay_s", 0.0, 0.5, 0.01, inverse=Inverse(("steering",), "stamp t + T")),),
        "d(t) = measured angle at t - T",
        KINEMATICS,
        (SWERVE, BICYCLE),
        (*MOTION, HEADING),
        "steps of the steering",
        plant=PlantPart.LINKAGE,
    ),
    Effect(
        "yaw_delay",
        (
            Parameter(
                "yaw_delay_s",
                0.0,
                0.5,
                0.01,
                inverse=Inverse(("wheels",), "right minus left wheel speed of t - T; of whole runs only"),
            ),
        ),
        "w(t) = what the wheels ask for at t - T",
        "pure delay",
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "steps of the yaw rate",
        wording=Wording.LATE,
        late=("the robot turning", "the robot turning"),
    ),
)
