"""Effects of omni robots: rollers that resist, the place of wheels and load, the scale of a camera above."""

from __future__ import annotations

from terrain.effects.types import (
    CURRENT,
    GYRO,
    HEADING,
    OMNI,
    SPEED_X,
    SPEED_Y,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    Wording,
)
from terrain.effects.wheels import KINEMATICS

LAW = "this project's; docs/measured_slip.md has how it holds on measured runs"

OMNI_WHEELS: tuple[Effect, ...] = (
    Effect(
        "roller_friction",
        (Parameter("roller_friction_ratio", 0.0, 1.5, 0.01),),
        "across each wheel G = -r n W v_across / U, beside F = C n W (u - v_along) / U along it",
        LAW,
        (OMNI,),
        (SPEED_X, SPEED_Y, HEADING, GYRO, CURRENT),
        "straight drives in several directions",
    ),
    Effect(
        "load_shift",
        # measured: 16 mm ahead by weights (Robotino)
        tuple(
            Parameter(
                f"load_shift_{axis}_m",
                -0.05,
                0.05,
                0.001,
                homes=(Home("body", f"com_{axis}_m", Combine.ADDED),),
            )
            for axis in ("x", "y")
        ),
        "n_i = (1 + 2 c . p_i / d^2) / 3 of wheels at p_i, d from the middle, with the centre of mass c",
        "balance of moments",
        (OMNI,),
        (SPEED_X, SPEED_Y, HEADING, GYRO),
        "straight drives in several directions over ground on which the rollers resist",
        wording=Wording.CENTRE_OF_MASS,
    ),
    Effect(
        "wheel_distance",
        (
            # a tape measures it to a few per cent; measured turns: 0.120 to 0.128 m of 0.125 m (Robotino)
            Parameter(
                "wheel_distance_ratio",
                -0.1,
                0.1,
                0.005,
                homes=(Home("", "track_m", Combine.TIMES), Home("", "wheelbase_m", Combine.TIMES)),
                as_percent=True,
                is_error=True,
            ),
        ),
        "w = mean wheel speed / (d (1 + e))",
        KINEMATICS,
        (OMNI,),
        (HEADING, GYRO),
        "turns",
        wording=Wording.WHEEL_DISTANCE,
    ),
    Effect(
        "camera_scale",
        (
            Parameter(
                "camera_scale_ratio",
                -0.3,
                0.3,
                0.01,
                inverse=Inverse(("pose",), "positions / (1 + s)"),
                as_percent=True,
                is_error=True,
            ),
        ),
        "positions, and speeds over ground, (1 + s) x what they are",
        "a camera above measures in pixels",
        (OMNI,),
        (SPEED_X, SPEED_Y),
        "straight drives, and turns to part it from the radius of the wheels",
        sensed_only=True,
    ),
)
"""What makes omni robots slip, and what looks like it."""
