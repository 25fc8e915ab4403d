"""All effects in one tuple, and what is derived from it.

Signals of the formulas are those of :mod:`terrain.simulation.planar.model`: ``u`` the speed that the wheels
would roll without slip, ``v`` the speed over ground, ``d`` a steering angle, ``w`` the yaw rate, ``F`` the
traction, ``W = m g`` the nominal weight, ``f = F / W``, ``th`` the grade (uphill positive), ``ph`` the roll
(left side up positive), ``B`` the track, ``dv`` right minus left wheel speed and
``q = |dv| / (|dv| + 2 |u|)`` how tight a turn is.

To add an effect, write its entry into the module of its kind, and its formula into the kernels of
:mod:`terrain.simulation.planar`.  Everything else reads the entry.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable

from terrain.effects.car import CAR
from terrain.effects.ground import SIDEWAYS, SLIP_AND_RESISTANCE
from terrain.effects.motors import LOAD_AND_MOTORS
from terrain.effects.omni import OMNI_WHEELS
from terrain.effects.sensors import SENSORS
from terrain.effects.types import Effect, Parameter, PlantPart
from terrain.effects.wheels import WHEELS_AND_STEERING
from terrain.errors import ConfigError

LIBRARY: tuple[Effect, ...] = (
    *WHEELS_AND_STEERING,
    *SENSORS,
    *SLIP_AND_RESISTANCE,
    *LOAD_AND_MOTORS,
    *SIDEWAYS,
    *OMNI_WHEELS,
    *CAR,
)
"""Every known effect.  The order is no ranking, but results list effects in it."""

TILT_OFFSETS: tuple[Parameter, ...] = (
    Parameter("pitch_offset_rad", -math.inf, math.inf, 0.005, scatter_rank=3),
    Parameter("roll_offset_rad", -math.inf, math.inf, 0.005, scatter_rank=4),
)
"""Errors of the measured tilt.  They belong to no effect, and are only ever estimated run by run."""

PARAMETER: dict[str, Parameter] = {p.name: p for effect in LIBRARY for p in effect.parameters}
"""Parameters of the library by name."""

BOUNDS: dict[str, tuple[float, float]] = {name: (p.low, p.high) for name, p in PARAMETER.items()}
"""Physical limits of each parameter of the library."""

STEPS: dict[str, float] = {p.name: p.step for p in (*PARAMETER.values(), *TILT_OFFSETS)}
"""Change of a parameter over which its sensitivity is taken."""

NUISANCES: tuple[str, ...] = tuple(
    p.name
    for p in sorted((*PARAMETER.values(), *TILT_OFFSETS), key=lambda p: p.scatter_rank)
    if p.scatter_rank
)
"""Parameters that scatter from run to run, in the order in which they are drawn."""

SENSED_ONLY: tuple[str, ...] = tuple(
    p.name for effect in LIBRARY if effect.sensed_only for p in effect.parameters
)
"""Parameters that change what sensors measure, and not the motion of the body."""

ONE_SIDED: tuple[str, ...] = tuple(name for name, p in PARAMETER.items() if p.one_sided)
"""Parameters whose sensitivity is taken towards the positive side only."""

DEPRECATED: dict[str, str] = {old: p.name for p in PARAMETER.values() for old in p.deprecated}
"""Former names of parameters, and the present ones."""


def effect_named(name: str) -> Effect:
    """Return the effect of a name, an alias or a former name.

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
        if name in (effect.name, *effect.aliases, *effect.deprecated):
            return effect
    raise ConfigError(f"effect {name!r} is unknown: use one of {', '.join(e.name for e in LIBRARY)}")


def library_of(drive: str) -> tuple[Effect, ...]:
    """Return the effects that apply to robots of a drive."""
    return tuple(effect for effect in LIBRARY if drive in effect.drives)


def chosen_effects(drive: str, names: Collection[str]) -> tuple[Effect, ...]:
    """Return effects by their names, in the order of the catalogue.

    Raises
    ------
    ConfigError
        if one is unknown, or does not apply to robots of a drive.
    """
    chosen = [effect_named(name) for name in names]
    for effect in chosen:
        if drive not in effect.drives:
            raise ConfigError(f"effect {effect.name} does not apply to a robot with the drive {drive!r}")
    return tuple(effect for effect in LIBRARY if effect in chosen)


def showing(drive: str, known: Collection[str] = ()) -> tuple[Effect, ...]:
    """Return those effects of a drive that runs may show, with the parameters that are known already.

    Examples
    --------
    >>> {e.name for e in library_of("omni")} - {e.name for e in showing("omni")}
    {'payload'}
    >>> showing("omni", ["roller_friction_ratio"]) == library_of("omni")
    True
    """

    def shows(effect: Effect) -> bool:
        others = [effect_named(name) for of, name in effect.beside if of == drive]
        return all(any(p.name in known for p in other.parameters) for other in others)

    return tuple(effect for effect in library_of(drive) if shows(effect))


def parameters_of(drive: str) -> dict[str, Parameter]:
    """Return the parameters, by name, of all effects that apply to robots of a drive.

    Examples
    --------
    >>> parameters_of("skid_steer")["effective_track_ratio"].high
    4.0
    """
    return {parameter.name: parameter for effect in library_of(drive) for parameter in effect.parameters}


def nuisances_of(drive: str) -> tuple[str, ...]:
    """Return the parameters that scatter from run to run on robots of a drive, in the order of drawing.

    Examples
    --------
    >>> set(NUISANCES) - set(nuisances_of("swerve"))
    {'effective_track_ratio'}
    """
    own = {*parameters_of(drive), *(p.name for p in TILT_OFFSETS)}
    return tuple(name for name in NUISANCES if name in own)


def in_plant(*parts: PlantPart) -> tuple[str, ...]:
    """Return the parameters that act in some parts of the dynamic simulation.

    Examples
    --------
    >>> in_plant(PlantPart.BODY)
    ('wheel_radius_ratio', 'one_sided_radius_ratio', 'payload_ratio')
    """
    return tuple(p.name for effect in LIBRARY if effect.plant in parts for p in effect.parameters)


def read_effects_of(texts: Iterable[str], drive: str) -> dict[str, float]:
    """Return the parameters that all ``NAME=VALUE`` set together; several values are separated by commas.

    Raises
    ------
    ConfigError
        for an unknown name, an effect that does not apply to the robot or is given twice, a value that is no
        number, too few or too many of them, or one out of bounds.

    Examples
    --------
    >>> read_effects_of(["wheel_radius=0.03", "lever_arm=0.1,-0.05"], "skid_steer")
    {'wheel_radius_ratio': 0.03, 'lever_x_m': 0.1, 'lever_y_m': -0.05}
    """
    acting: dict[str, float] = {}
    for text in texts:
        name, _, given = text.partition("=")
        effect = effect_named(name.strip())
        if drive not in effect.drives:
            raise ConfigError(f"effect {effect.name} does not apply to a robot with the drive {drive!r}")
        try:
            values = [float(part) for part in given.split(",")]
        except ValueError:
            values = []
        required = ",".join(p.name for p in effect.parameters)
        if len(values) != len(effect.parameters):
            raise ConfigError(f"--effect is {text!r}; {effect.name}=VALUE with {required} is required")
        for parameter, value in zip(effect.parameters, values, strict=True):
            if not parameter.low <= value <= parameter.high:
                raise ConfigError(
                    f"effect {effect.name}: {parameter.name} is {value:g}, "
                    f"{parameter.low:g} to {parameter.high:g} is accepted"
                )
            if parameter.name in acting:
                raise ConfigError(f"effect {name!r} is given twice")
            acting[parameter.name] = value
    return acting
