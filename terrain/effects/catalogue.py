"""What a simulation may lack: effects, each a named group of parameters whose neutral value 0 means absent.

Signals are those of :mod:`terrain.simulation.planar.model`: ``u`` the speed that the wheels would roll
without slip, ``v`` the speed over ground, ``d`` a steering angle, ``w`` the yaw rate, ``F`` the traction, ``W
= m g`` the nominal weight, ``f = F / W``, ``th`` the grade (uphill positive), ``ph`` the roll (left side up
positive), ``B`` the track, ``dv`` right minus left wheel speed and ``q = |dv| / (|dv| + 2 |u|)`` how tight a
turn is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array

GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING = (
    "yaw_rate_radps",
    "speed_x_mps",
    "speed_y_mps",
    "accel_x_mps2",
    "current_a",
    "turning_current_a",
    "heading_rate_radps",
)
CHANNELS: tuple[str, ...] = (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
"""What is compared: gyro, speed of the camera's point over ground, accelerometer, sum of the motor currents,
right minus left current, and the rate of a heading that no gyro has told (lidar, two antennas)."""

SKID, SWERVE = "skid_steer", "swerve"
BOTH = (SKID, SWERVE)


class Parameter(NamedTuple):
    """A number of the simulation that is 0 where its effect is absent.

    Parameters
    ----------
    name : ends in its unit
    low, high : bounds of what is searched
    step : a change that is small, yet shows: over which sensitivities are taken
    """

    name: str
    low: float
    high: float
    step: float

    @property
    def unit(self) -> str:
        """Last word of the name."""
        return self.name.rpartition("_")[2]


class Effect(NamedTuple):
    """One way in which the simulation may be wrong.

    Parameters
    ----------
    name : as ``--effect`` and answers have it
    parameters : its numbers
    formula : in the signals of this module
    source : of the formula
    drives : kinds of robots that it can befall
    channels : of :data:`CHANNELS`, where it shows: a tenth as clearly over the noise as in the clearest
    needs : the driving that shows it
    aliases : other names of the same effect, which no log tells apart from it
    twins : names of effects that show the same way, and what has to be in the log to part them
    """

    name: str
    parameters: tuple[Parameter, ...]
    formula: str
    source: str
    drives: tuple[str, ...]
    channels: tuple[str, ...]
    needs: str
    aliases: tuple[str, ...] = ()
    twins: tuple[tuple[str, str], ...] = ()


def _one(name: str, low: float, high: float, step: float) -> tuple[Parameter, ...]:
    return (Parameter(name, low, high, step),)


_KINEMATICS = "kinematics of a planar robot"
_MOTION = (GYRO, SPEED_X, SPEED_Y)

LIBRARY: tuple[Effect, ...] = (
    Effect(
        "wheel_radius",
        _one("wheel_radius_ratio", -0.3, 0.3, 0.01),
        "wheel speed = (1 + e) r x wheel rate",
        _KINEMATICS,
        BOTH,
        (*_MOTION, HEADING),
        "any speed; slopes and accelerations to part it from slip",
        aliases=("encoder_scale",),
    ),
    Effect(
        "one_sided_radius",
        _one("one_sided_radius_ratio", -0.3, 0.3, 0.01),
        "wheel speeds of the right side x (1 + e/2), of the left x (1 - e/2)",
        _KINEMATICS,
        BOTH,
        (*_MOTION, HEADING),
        "fast and straight",
    ),
    *(
        Effect(
            f"steering_offset_{i}",
            _one(f"steering_offset_{i}_rad", -0.3, 0.3, 0.005),
            f"d_{i} = measured angle + d0",
            _KINEMATICS,
            (SWERVE,),
            (*_MOTION, HEADING) if i < 3 else _MOTION,  # wheel 3 is beside the middle, and hardly turns it
            "several speeds and standstill",
        )
        for i in (1, 2, 3)
    ),
    Effect(
        "steering_backlash",
        _one("steering_backlash_rad", 0.0, 0.2, 0.003),
        "d follows the measured angle through a play of half width b",
        "play operator; Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989",
        (SWERVE,),
        (*_MOTION, HEADING),
        "reversals of the steering",
    ),
    Effect(
        "steering_delay",
        _one("steering_delay_s", 0.0, 0.5, 0.01),
        "d(t) = measured angle at t - T",
        _KINEMATICS,
        (SWERVE,),
        (*_MOTION, HEADING),
        "steps of the steering",
    ),
    Effect(
        "yaw_delay",
        _one("yaw_delay_s", 0.0, 0.5, 0.01),
        "w(t) = what the wheels ask for at t - T",
        "pure delay",
        (SKID,),
        (GYRO, SPEED_Y, HEADING),
        "steps of the yaw rate",
    ),
    Effect(
        "gyro_bias",
        _one("gyro_bias_radps", -0.2, 0.2, 0.001),
        "gyro = w + b",
        "IEEE Std 952",
        BOTH,
        (GYRO,),
        "standstill; several runs, since every power-on has a bias of its own",
    ),
    Effect(
        "gyro_scale",
        _one("gyro_scale_ratio", -0.3, 0.3, 0.01),
        "gyro = (1 + k) w",
        "IEEE Std 952",
        BOTH,
        (GYRO,),
        "turns, and an absolute heading on a skid-steer robot",
        twins=(("effective_track", HEADING),),
    ),
    Effect(
        "accel_bias",
        _one("accel_bias_mps2", -2.0, 2.0, 0.02),
        "accelerometer = a_x + g sin th + b",
        "IEEE Std 1293",
        BOTH,
        (ACCEL,),
        "several runs, since every power-on has a bias of its own",
        aliases=("accelerometer_mounting_pitch",),
    ),
    Effect(
        "camera_latency",
        _one("camera_latency_s", 0.0, 0.5, 0.005),
        "camera(t) = what it sees at t - T",
        "pure delay",
        BOTH,
        (SPEED_X, SPEED_Y, HEADING),
        "accelerations at two frequencies",
    ),
    Effect(
        "camera_yaw",
        _one("camera_yaw_rad", -0.3, 0.3, 0.005),
        "camera = R(-a) (v_x, v_y): mounted turned to the left by -a, v_y grows by a v",
        _KINEMATICS,
        BOTH,
        (SPEED_X, SPEED_Y),
        "straight, on more than one side slope",
    ),
    Effect(
        "lever_arm",
        (Parameter("lever_x_m", -1.0, 1.0, 0.02), Parameter("lever_y_m", -1.0, 1.0, 0.02)),
        "v_x - l_y w, v_y + l_x w at the camera",
        _KINEMATICS,
        BOTH,
        (SPEED_X, SPEED_Y),
        "turns to both sides",
    ),
    Effect(
        "clock_offset",
        _one("clock_offset_s", 0.0, 0.5, 0.005),
        "IMU and camera stamp t' = t + T; wheels, currents and steering t",
        "two loggers without a common clock",
        BOTH,
        (*_MOTION, HEADING),
        "switching manoeuvres",
    ),
    Effect(
        "clock_rate",
        _one("clock_rate_ratio", -0.02, 0.02, 0.0005),
        "IMU and camera stamp t' = (1 + r) t",
        "two loggers without a common clock",
        BOTH,
        (*_MOTION, HEADING),
        "switching manoeuvres from the start of a run to its end",
    ),
    Effect(
        "encoder_lag",
        _one("encoder_lag_s", 0.0, 0.5, 0.005),
        "T d(measured)/dt + measured = wheel rate",
        "first-order low-pass",
        BOTH,
        (*_MOTION, CURRENT, TURNING_CURRENT, HEADING),
        "accelerations",
    ),
    Effect(
        "effective_track",
        _one("effective_track_ratio", -0.5, 4.0, 0.02),
        "w = dv / (B (1 + e))",
        "Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007",
        (SKID,),
        (GYRO, SPEED_Y, HEADING),
        "turns in place and in arcs, and an absolute heading",
        twins=(("gyro_scale", HEADING),),
    ),
    Effect(
        "turning_slip",
        _one("turning_slip_ratio", -0.5, 0.9, 0.02),
        "dv loses D = k q dv, shared as u_r = D a/(a+b), u_l = -D b/(a+b), a = |v_r|^(1-n), b = |v_l|^(1-n), "
        "n = 0.5",
        "Endo et al., IROS 2007, as in Yamauchi et al., (27) written without its singular points; the size "
        "of D is ours",
        (SKID,),
        (*_MOTION, HEADING),
        "arcs of several radii and turns in place",
    ),
    Effect(
        "force_slip",
        _one("force_slip_ratio", -0.3, 3.0, 0.02),
        "v = u - |u| c f",
        "linear part of any thrust curve; Wong, Theory of Ground Vehicles",
        BOTH,
        (SPEED_X, SPEED_Y),
        "slopes and accelerations",
    ),
    Effect(
        "shear_slip",
        _one("shear_slip_ratio", 0.0, 3.0, 0.02),
        "f = f_max (1 - K/(s l) (1 - exp(-s l/K))), with K/l = c f_max / 2 so that c is its slip per force "
        "at the start",
        "Janosi and Hanamoto 1961, as integrated along the contact (Yamauchi et al., (17), corrected)",
        BOTH,
        (SPEED_X, SPEED_Y),
        "tractions over half of f_max, of both small and large size",
    ),
    Effect(
        "slip_resistance",
        _one("slip_resistance_ratio", 0.0, 5.0, 0.05),
        "resistance grows by b |s| W",
        "Lyasko, Slip sinkage effect in soil-vehicle mechanics, J. Terramechanics 2010: linear in slip",
        BOTH,
        (CURRENT, SPEED_X),
        "a range of slip",
    ),
    Effect(
        "rolling_resistance",
        _one("rolling_resistance_ratio", -0.05, 0.5, 0.005),
        "resistance grows by c W",
        "Wong, Theory of Ground Vehicles",
        BOTH,
        (CURRENT, SPEED_X),
        "several speeds, both ways",
    ),
    Effect(
        "viscous_drag",
        _one("viscous_drag_nspm", 0.0, 500.0, 3.0),
        "resistance grows by c v",
        "viscous friction of bearings and gears",
        BOTH,
        (CURRENT, SPEED_X),
        "three speeds",
    ),
    Effect(
        "payload",
        _one("payload_ratio", -0.5, 1.5, 0.02),
        "mass m (1 + p)",
        "Newton",
        BOTH,
        (CURRENT, SPEED_X),
        "accelerations and slopes",
        twins=(("motor_constant", SPEED_X),),
    ),
    Effect(
        "motor_constant",
        _one("motor_constant_ratio", -0.5, 1.0, 0.01),
        "current (1 + q)",
        "DC motor: current is torque over its constant",
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "accelerations and slopes",
        twins=(("payload", SPEED_X),),
    ),
    Effect(
        "motor_drift",
        _one("motor_drift_ratio", -0.5, 1.0, 0.01),
        "current (1 + q t / 60 s) from the start of a run",
        "remanence of a magnet that warms; linear over a run",
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "long runs",
    ),
    Effect(
        "scrub",
        _one("scrub_ratio", -0.2, 1.0, 0.005),
        "resistance to rolling and to turning grow by k q W",
        "scrub of skidding wheels; the form in q as EKF practice has it",
        (SKID,),
        (CURRENT, TURNING_CURRENT, SPEED_X),
        "turns",
    ),
    Effect(
        "side_hill_slip",
        _one("side_hill_slip_ratio", 0.0, 5.0, 0.05),
        "v_y = -c ph |v|",
        "Yamauchi et al., (2), with the sign that gravity sets",
        BOTH,
        (SPEED_Y,),
        "both signs of roll",
    ),
)
"""Every effect that is known, in no order of rank."""

NUISANCES: tuple[str, ...] = (
    "gyro_bias_radps",
    "accel_bias_mps2",
    "pitch_offset_rad",
    "roll_offset_rad",
    "wheel_radius_ratio",
    "one_sided_radius_ratio",
    "rolling_resistance_ratio",
    "force_slip_ratio",
    "effective_track_ratio",
)
"""Parameters that scatter from run to run by themselves; the two offsets are those of the tilt that is
measured, and no effect."""

PARAMETERS: tuple[str, ...] = tuple(
    dict.fromkeys([*(p.name for effect in LIBRARY for p in effect.parameters), *NUISANCES])
)
"""Order of the numbers in a vector of the simulation."""

INDEX: dict[str, int] = {name: i for i, name in enumerate(PARAMETERS)}

BOUNDS: dict[str, tuple[float, float]] = {
    p.name: (p.low, p.high) for effect in LIBRARY for p in effect.parameters
}
"""Of each parameter of the library: what it may physically be."""


def effect_named(name: str) -> Effect:
    """Return the effect of a name or an alias.

    Raises
    ------
    ConfigError
        for an unknown name.

    Examples
    --------
    >>> effect_named("encoder_scale").name, effect_named("lever_arm").parameters[1].name
    ('wheel_radius', 'lever_y_m')
    """
    for effect in LIBRARY:
        if name == effect.name or name in effect.aliases:
            return effect
    raise ConfigError(f"effect {name!r} is unknown: use one of {', '.join(e.name for e in LIBRARY)}")


def library_of(drive: str) -> tuple[Effect, ...]:
    """Return the effects that can befall robots of a drive."""
    return tuple(effect for effect in LIBRARY if drive in effect.drives)


def read_effect(text: str, drive: str) -> dict[str, float]:
    """Return the parameters that ``NAME=VALUE`` sets; several values are parted by commas.

    Raises
    ------
    ConfigError
        for an unknown name, a robot that the effect cannot befall, a value that is no number, too few or too
        many of them, or one out of bounds.

    Examples
    --------
    >>> read_effect("wheel_radius=0.03", "swerve"), read_effect("lever_arm=0.1,-0.05", "skid_steer")
    ({'wheel_radius_ratio': 0.03}, {'lever_x_m': 0.1, 'lever_y_m': -0.05})
    """
    name, _, given = text.partition("=")
    effect = effect_named(name.strip())
    if drive not in effect.drives:
        raise ConfigError(f"effect {effect.name} cannot befall a robot with the drive {drive!r}")
    try:
        values = [float(part) for part in given.split(",")]
    except ValueError:
        values = []
    desired = ",".join(p.name for p in effect.parameters)
    if len(values) != len(effect.parameters):
        raise ConfigError(f"--effect is {text!r}; {effect.name}=VALUE with {desired} is required")
    for parameter, value in zip(effect.parameters, values, strict=True):
        if not parameter.low <= value <= parameter.high:
            raise ConfigError(
                f"effect {effect.name}: {parameter.name} is {value:g}, "
                f"{parameter.low:g} to {parameter.high:g} is accepted"
            )
    return {p.name: value for p, value in zip(effect.parameters, values, strict=True)}


def vector_of(values: Mapping[str, float]) -> Array:
    """Return the numbers (len(PARAMETERS),) of a simulation, 0 where none is given.

    Raises
    ------
    ConfigError
        for an unknown parameter, or a value that is not finite.
    """
    vector = np.zeros(len(PARAMETERS))
    for name, value in values.items():
        if name not in INDEX or not math.isfinite(value):
            raise ConfigError(
                f"effects: {name} is {value!r}; a finite number of a known parameter is required"
            )
        vector[INDEX[name]] = value
    return vector
