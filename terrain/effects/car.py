"""Effects of car-like robots: a front axle that yields, tyres as a whole, the zero of the steering."""

from __future__ import annotations

from terrain.effects.types import (
    BICYCLE,
    GYRO,
    HEADING,
    SPEED_Y,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    Wording,
)
from terrain.effects.wheels import KINEMATICS

SINGLE_TRACK = "linear single-track model: Rajamani, Vehicle Dynamics and Control"

CAR: tuple[Effect, ...] = (
    Effect(
        "steering_offset_front",
        (
            Parameter(
                "steering_offset_front_rad", -0.3, 0.3, 0.005, inverse=Inverse(("steering",), "angle + d0")
            ),
        ),
        "d = measured angle + d0",
        KINEMATICS,
        (BICYCLE,),
        (GYRO, HEADING),
        "several speeds and standstill",
    ),
    Effect(
        "understeer",
        # cars have 0.001 to 0.006 s^2/m (1 to 5 deg per g over 9.8 m/s^2); soft tyres on soil more.  Below
        # the lower bound the front axle of a light robot would be stiffer than rigid
        (Parameter("understeer_s2pm", -0.01, 0.1, 0.001),),
        "w = v tan d / (L + K v |v|): the front axle yields by K L / (m a) rad/N more, a the distance of the "
        "centre of mass from the rear axle",
        "understeer gradient, Gillespie, Fundamentals of Vehicle Dynamics: tyres and compliance of the "
        "steering alike",
        (BICYCLE,),
        (GYRO, HEADING),
        "arcs of several speeds, to both sides",
        wording=Wording.UNDERSTEER,
    ),
    Effect(
        "cornering_stiffness",
        # load, pressure and ground: a third on loose soil of what it is on firm ground (Wong, Theory of
        # Ground Vehicles)
        (
            Parameter(
                "cornering_stiffness_ratio",
                -0.7,
                2.0,
                0.02,
                homes=(
                    Home("", "front_cornering_npr", Combine.TIMES),
                    Home("", "rear_cornering_npr", Combine.TIMES),
                ),
                as_percent=True,
                is_error=True,
            ),
        ),
        "stiffness of both axles x (1 + e); so does a load of 1 / (1 + e) - 1, with nothing else to show it",
        SINGLE_TRACK,
        (BICYCLE,),
        (SPEED_Y, GYRO),
        "fast arcs to both sides, side slopes and steps of the steering",
    ),
)
"""What makes a car-like robot turn otherwise than its wheels point."""
