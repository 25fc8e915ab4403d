"""The value of an effect in quantities that the builder of a robot knows: a track in m, a lag of the wheels.

A value is added to what the description has already, and the description's number stands beside the sum:
where that number is assumed, only the sum was measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from terrain.discrepancy.verdict import Value
from terrain.effects import PARAMETER, Wording, effect_named
from terrain.extension import Basis, Origin, basis_of
from terrain.robots import BicycleRobot, OmniRobot, Robot, TrackedRobot, as_drive
from terrain.simulation.planar.motion import SLIDING_RADPS

EXAMPLE_RADPS, EXAMPLE_MPS = 0.5, 1.0
"""The turn and the speed at which losses that grow with them are stated."""

FAST_RADPS, FAST_MPS = 1.0, 2.0
"""The same of what fast turns do."""

UNITS = {
    "ratio": "",
    "radps": "rad/s",
    "mps": "m/s",
    "mps2": "m/s²",
    "s2": "s²",
    "s2pm": "s²/m",
    "s2pm2": "s²/m²",
    "npr": "N/rad",
    "a": "A",
    "n": "N",
    "nm": "Nm",
    "hz": "Hz",
    "nspm": "N s/m",
    "nmpa": "N m/A",
}
"""How sentences write the last word of a name, where that is not the unit itself."""

SMALL = {"rad": "mrad", "radps": "mrad/s", "s": "ms", "m": "mm"}
"""Units of a thousandth."""

Total = Mapping[str, float]


def in_robot_terms(effect: str, values: Sequence[Value], robot: Robot) -> str:
    """Return what an effect with its values makes of the robot, as the object of "with".

    Parameters
    ----------
    effect : name
    values : found, over what the robot has of the effect already
    robot : as it was tested

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> track = Value("effective_track_ratio", 1.5, "ratio", 1.47, 1.53)
    >>> in_robot_terms("effective_track", [track], load_robot("husky"))
    'an effective track of 1.43 m (described: 0.571 m)'
    >>> late = Value("clock_offset_s", -0.27, "s", -0.28, -0.26)
    >>> in_robot_terms("clock_offset", [late], load_robot("husky"))
    'the wheels logged 0.27 s late'
    >>> narrow = Value("track_narrowing_s2pm2", 0.04, "s2pm2", 0.03, 0.05)
    >>> in_robot_terms("track_narrowing", [narrow], load_robot("warthog"))
    'a track that acts 6.9 % narrower at 2 m/s and 1 rad/s'
    """
    total = {value.name: robot.effects.get(value.name, 0.0) + value.value for value in values}
    written = TERMS.get(effect_named(effect).wording)
    if written is not None:
        return written(values, total, robot)
    return " and ".join(_generic(value, total[value.name], robot) for value in values)


def value_in_robot_terms(parameter: str, value: float, low: float, high: float, robot: Robot) -> str:
    """Return a value and its interval by the number of the description that it changes, or as they are.

    Parameters
    ----------
    parameter : of an effect
    value, low, high : over what the robot has of it already
    robot : as it was tested

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> value_in_robot_terms("effective_track_ratio", 1.5, 1.47, 1.53, load_robot("husky"))
    '1.43 m (1.41 to 1.44)'
    >>> value_in_robot_terms("one_sided_radius_ratio", 0.025, 0.02, 0.03, load_robot("husky"))
    '0.025 (0.020 to 0.030)'
    """
    given = robot.effects.get(parameter, 0.0)
    numbers, unit = [given + each for each in (value, low, high)], PARAMETER[parameter].unit
    bases = [basis_of(robot, parameter, number)[:1] for number in numbers]
    if all(basis and basis[0].described and basis[0].origin is not Origin.LEFT_OUT for basis in bases):
        numbers = [basis[0].extended for basis in bases]
        unit = bases[0][0].field.rpartition("_")[2]
    at, *ends = (rounded(number, 0.5 * abs(numbers[2] - numbers[1])) for number in numbers)
    low_end, high_end = sorted(ends, key=float)
    return f"{f'{at} {UNITS.get(unit, unit)}'.strip()} ({low_end} to {high_end})"


def quantity(parameter: str, value: float) -> str:
    r"""Return the value of an effect's parameter with its unit, in two significant digits.

    Examples
    --------
    >>> quantity("gyro_bias_radps", 0.0031), quantity("wheel_radius_ratio", 0.004)
    ('3.1\xa0mrad/s', '0.4\xa0%')
    >>> quantity("scrub_ratio", 0.02), quantity("accel_bias_mps2", -0.046), quantity("lever_x_m", math.nan)
    ('0.02', '−0.046\xa0m/s²', '–')
    """
    if not math.isfinite(value):
        return "\N{EN DASH}"
    unit = parameter.rpartition("_")[2]
    if parameter in PARAMETER and PARAMETER[parameter].as_percent:
        value, written = 100.0 * value, "%"
    elif unit in SMALL and abs(value) < 0.0995:
        value, written = 1000.0 * value, SMALL[unit]
    else:
        written = UNITS.get(unit, unit)
    number = f"{float(f'{value:.2g}'):g}".replace("-", "\N{MINUS SIGN}")
    return f"{number}\N{NO-BREAK SPACE}{written}".rstrip("\N{NO-BREAK SPACE}")


def rounded(value: float, half: float) -> str:
    """Return a number with the digits that half its interval leaves it, three where that is not known.

    Examples
    --------
    >>> rounded(1.4271, 0.03), rounded(0.0961, 0.025), rounded(0.165, float("nan"))
    ('1.43', '0.10', '0.165')
    """
    if not (math.isfinite(half) and half > 0.0):
        return f"{value:.3g}"
    return f"{value:.{min(max(-math.floor(math.log10(half)), 0), 5)}f}"


def _half(value: Value) -> float:
    return (value.high - value.low) / 2.0


def described_as(basis: Basis) -> str:
    """Return the number of the description beside which a value stands, and whether it is assumed.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> described_as(basis_of(load_robot("husky"), "lever_x_m", -0.25)[0])
    '(described: 0.35 m, assumed)'
    """
    if basis.origin is Origin.LEFT_OUT:
        return "(not described)"
    unit = basis.field.rpartition("_")[2]
    number = f"{basis.described:.3g} {UNITS.get(unit, unit)}".strip()
    return f"(described: {number}{', assumed' if basis.origin is Origin.ASSUMED else ''})"


def _generic(value: Value, total: float, robot: Robot) -> str:
    """Return a value by the number of the description that it changes, or as it is."""
    parameter = PARAMETER[value.name]
    bases = basis_of(robot, value.name, total)
    if bases and bases[0].described and bases[0].origin is not Origin.LEFT_OUT:
        basis = bases[0]
        scale = abs((basis.extended - basis.described) / total) if total else 0.0
        name, _, unit = basis.written.rpartition("_")
        number = f"{rounded(basis.extended, scale * _half(value))} {UNITS.get(unit, unit)}".strip()
        name = name.replace("_", " ").removesuffix(" x").removesuffix(" z")
        return f"{_article(name)} {name} of {number} {described_as(basis)}"
    if parameter.as_percent:
        number = f"{rounded(100.0 * total, 100.0 * _half(value))} %"
    else:
        number = f"{rounded(total, _half(value))} {UNITS.get(parameter.unit, parameter.unit)}".strip()
    return (
        f"{_article(parameter.label)} {parameter.label} {'off by' if parameter.is_error else 'of'} {number}"
    )


def _article(name: str) -> str:
    return "an" if name[0] in "aeiou" and not name.startswith("one") else "a"


def _track(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    (basis,) = basis_of(robot, value.name, total[value.name])
    number = rounded(basis.extended, basis.described * _half(value))
    return f"an effective track of {number} m {described_as(basis)}"


def _lever(values: Sequence[Value], total: Total, robot: Robot) -> str:
    """Return where the measured point is: only the sum of the lever described and the one found is known."""
    parts: list[str] = []
    notes: list[str] = []
    for value, (ahead, behind) in zip(values, (("ahead", "behind"), ("left", "right")), strict=True):
        if parts and abs(value.value) <= _half(value):
            continue
        (basis,) = basis_of(robot, value.name, total[value.name])
        side = ahead if basis.extended >= 0.0 else behind
        parts.append(f"{rounded(abs(basis.extended), _half(value))} m {side}")
        notes.append(described_as(basis))
    joint = {"behind": " "}.get(parts[-1].rpartition(" ")[2], " of ")
    return f"the measured point {' and '.join(parts)}{joint}the centre {notes[0]}"


def _centre_of_mass(values: Sequence[Value], total: Total, robot: Robot) -> str:
    parts, notes = [], []
    for value, (ahead, behind) in zip(values, (("ahead", "behind"), ("left", "right")), strict=True):
        (basis,) = basis_of(robot, value.name, total[value.name])
        side = ahead if basis.extended >= 0.0 else behind
        parts.append(f"{rounded(1000.0 * abs(basis.extended), 1000.0 * _half(value))} mm {side}")
        notes.append(f"{1000.0 * basis.described:.3g}")
    return f"the centre of mass {' and '.join(parts)} of the middle (described: {', '.join(notes)} mm)"


def _wheel_distance(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    distance_m = as_drive(
        OmniRobot, robot, "robot {name}: drive {drive!r} has no distance of omni wheels"
    ).wheel_distance_m
    number = rounded(distance_m * (1.0 + total[value.name]), distance_m * _half(value))
    return f"wheels {number} m from the middle (described: {distance_m:.3g} m)"


def _late(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    homes = basis_of(robot, value.name, total[value.name])
    late_s = homes[0].extended if homes else total[value.name]
    who = effect_named(PARAMETER[value.name].label.replace(" ", "_")).late
    return f"{who[0 if late_s > 0 else 1]} {rounded(abs(late_s), _half(value))} s late"


def _turn_drag(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    lost = total[value.name] * EXAMPLE_RADPS**2
    percent = 100.0 * (lost / (1.0 + lost) if lost > 0 else lost)
    change = "loses" if percent > 0 else "gains"
    return f"a robot that {change} {abs(percent):.2g} % of its speed in a turn of {EXAMPLE_RADPS:g} rad/s"


def _fast_turns(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    radps = FAST_RADPS
    x = total[value.name] * (FAST_MPS * radps) ** 2 / (1.0 + (radps / SLIDING_RADPS) ** 2)
    gained = x / (1.0 + abs(x))
    percent = 100.0 * gained / (1.0 + gained)
    return f"a track that acts {percent:.2g} % narrower at {FAST_MPS:g} m/s and {radps:g} rad/s"


def _understeer(values: Sequence[Value], total: Total, robot: Robot) -> str:
    (value,) = values
    car = as_drive(BicycleRobot, robot, "robot {name}: drive {drive!r} has no understeer")
    own, added = car.understeer_s2pm, total[value.name]
    turned = [car.wheelbase_m / (car.wheelbase_m + each * FAST_MPS**2) for each in (own, own + added)]
    percent = 100.0 * abs(turned[1] / turned[0] - 1.0)
    number = f"{rounded(own + added, _half(value))} s²/m (described: {own:.2g} s²/m)"
    change = "less" if added > 0 else "more"
    return f"an understeer of {number}, which turns it {percent:.2g} % {change} at {FAST_MPS:g} m/s"


def _sided(
    scale: float, text: str, sides: tuple[str, str], values: Sequence[Value], total: Total, robot: Robot
) -> str:
    """Return the size of a value, and whether it is above or below zero."""
    (value,) = values
    number = rounded(scale * abs(total[value.name]), scale * _half(value))
    wheels = "sprockets" if isinstance(robot, TrackedRobot) else "wheels"
    return text.format(number=number, side=sides[0 if total[value.name] > 0 else 1], wheels=wheels)


_SLIDE = f"a slide of {{number}} m/s to the {{side}} at {EXAMPLE_MPS:g} m/s and {EXAMPLE_RADPS:g} rad/s"
_SIDES = "{wheels} that are {number} % {side} on the right than on the left"

TERMS: dict[Wording, Callable[[Sequence[Value], Total, Robot], str]] = {
    Wording.TRACK: _track,
    Wording.MEASURED_POINT: _lever,
    Wording.CENTRE_OF_MASS: _centre_of_mass,
    Wording.WHEEL_DISTANCE: _wheel_distance,
    Wording.LATE: _late,
    Wording.CAMERA_YAW: partial(
        _sided, math.degrees(1.0), "the camera turned {number}° to the {side}", ("right", "left")
    ),
    Wording.FAST_TURNS: _fast_turns,
    Wording.LOSS_IN_TURNS: _turn_drag,
    Wording.SIDE_SLIP: partial(_sided, EXAMPLE_MPS * EXAMPLE_RADPS, _SLIDE, ("outside", "inside")),
    Wording.GYRO_SCALE: partial(_sided, 100.0, "a gyro that reads {number} % too {side}", ("much", "little")),
    Wording.SIDES: partial(_sided, 100.0, _SIDES, ("larger", "smaller")),
    Wording.UNDERSTEER: _understeer,
}
"""How the effects are worded whose numbers do not speak for themselves; the others by their home."""
