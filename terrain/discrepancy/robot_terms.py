"""The value of an effect in quantities that the builder of a robot knows: a track in m, a lag of the wheels.

A value is added to what the description has already, and the description's number stands beside the sum:
where that number is assumed, only the sum was measured.  What an effect makes of the robot stands in its entry
(:mod:`terrain.effects`), or by the number of the description that it changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from terrain.discrepancy.verdict import Limit, Value
from terrain.effects import PARAMETER, Term, effect_named, rounded
from terrain.extension import Basis, Origin, basis_of
from terrain.robots import Robot

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

MINUS, NBSP = "\N{MINUS SIGN}", "\N{NO-BREAK SPACE}"

SMALL = {"rad": "mrad", "radps": "mrad/s", "s": "ms", "m": "mm"}
"""Units of a thousandth."""


def in_robot_terms(effect: str, values: Sequence[Value], robot: Robot) -> str:
    """Return what an effect, with values over what the robot has of it already, makes of the robot, after "with".

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
    >>> by_turn = Value("track_narrowing_by_turn_ratio", 0.0, "ratio", -0.01, 0.01)
    >>> in_robot_terms("track_narrowing", [narrow, by_turn], load_robot("warthog"))
    'a track that acts 6.9 % narrower at 2 m/s and 1 rad/s'
    """
    words, terms, plain = effect_named(effect).words, [], []
    for value in values:
        total, half = robot.effects.get(value.name, 0.0) + value.value, (value.high - value.low) / 2.0
        about, basis = (0.0, total, ""), next(iter(basis_of(robot, value.name, total)), None)
        if basis is not None:
            # the number of the description beside which the value stands, and whether it is assumed
            unit, note = basis.field.rpartition("_")[2], "(not described)"
            if basis.origin is not Origin.LEFT_OUT:
                number = f"{basis.described:.3g} {UNITS.get(unit, unit)}".strip()
                note = f"(described: {number}{', assumed' if basis.origin is Origin.ASSUMED else ''})"
            about = basis.described, basis.extended, note
        terms.append(Term(value.value, half, total, *about, robot))
        plain.append(_plain_words(value.name, terms[-1], basis))
    return " and ".join(plain) if words is None else words(terms)


def value_in_robot_terms(parameter: str, value: float, low: float, high: float, robot: Robot) -> str:
    r"""Return a value and its interval by the number of the description that it changes, or as they are.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> value_in_robot_terms("effective_track_ratio", 1.5, 1.47, 1.53, load_robot("husky"))
    '1.43 m (1.41 to 1.44)'
    >>> value_in_robot_terms("one_sided_radius_ratio", 0.025, 0.02, 0.03, load_robot("husky"))
    '2.5\xa0% (2 to 3\xa0%)'
    """
    found = _numbers(parameter, (value, low, high), robot)
    if found is None:
        given = robot.effects.get(parameter, 0.0)
        return values_with_intervals([Value(parameter, given + value, "", given + low, given + high)])
    numbers, unit = found
    at, *ends = (rounded(number, 0.5 * abs(numbers[2] - numbers[1])) for number in numbers)
    low_end, high_end = sorted(ends, key=float)
    return f"{f'{at} {UNITS.get(unit, unit)}'.strip()} ({low_end} to {high_end})"


def quantity_in_robot_terms(parameter: str, value: float, scatter: float, robot: Robot) -> tuple[str, str]:
    r"""Return a value, and a scatter about it, by the number of the description that it changes, or as they are.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> quantity_in_robot_terms("effective_track_ratio", 1.5, 0.17, load_robot("husky"))
    ('1.43\xa0m', '97\xa0mm')
    >>> quantity_in_robot_terms("one_sided_radius_ratio", 0.025, 0.01, load_robot("husky"))
    ('2.5\xa0%', '1\xa0%')
    """
    found = _numbers(parameter, (value, value - scatter, value + scatter), robot)
    if found is None:
        return quantity(parameter, robot.effects.get(parameter, 0.0) + value), quantity(parameter, scatter)
    (at, low, high), unit = found
    half = 0.5 * abs(high - low)
    return f"{rounded(at, half)}{NBSP}{UNITS.get(unit, unit)}".rstrip(NBSP), quantity(f"_{unit}", half)


def _numbers(parameter: str, values: Sequence[float], robot: Robot) -> tuple[list[float], str] | None:
    """Return numbers of the description with values added, and their unit; None where no number is described."""
    given = robot.effects.get(parameter, 0.0)
    bases = [basis_of(robot, parameter, given + value)[:1] for value in values]
    if not all(basis and basis[0].is_described for basis in bases):
        return None
    unit = bases[0][0].field.rpartition("_")[2]
    return [basis[0].extended for basis in bases], unit


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
    number = f"{float(f'{value:.2g}'):g}".replace("-", MINUS)
    return f"{number}{NBSP}{written}".rstrip(NBSP)


def quantity_interval(value: Value) -> str:
    r"""Return the 95 % interval of a value; a unit that both ends have stands once.

    Examples
    --------
    >>> quantity_interval(Value("payload_ratio", 0.2, "ratio", 0.1, 0.3)).replace("\xa0", " ")
    '10 to 30 %'
    """
    low, high = quantity(value.name, value.low), quantity(value.name, value.high)
    number, _, unit = low.partition(NBSP)
    return f"{number if unit == high.partition(NBSP)[2] else low} to {high}"


def values_with_intervals(values: Sequence[Value], last: str = " and ") -> str:
    """Return values and their intervals."""
    return last.join(f"{quantity(value.name, value.value)} ({quantity_interval(value)})" for value in values)


def limit_text(limit: Limit, missed: bool) -> str:
    r"""Return a detection limit as a sentence; the runs that ``missed`` it did not excite the effect.

    Examples
    --------
    >>> limit = Limit("steering_offset_1_rad", 0.003, "rad", "several speeds")
    >>> limit_text(limit, False)
    'A steering offset 1 under 3\xa0mrad would not have been detected.'
    >>> limit_text(limit._replace(detection_limit=math.inf), True)
    'A steering offset 1 of any size would not have been detected.'
    """
    parameter, value = PARAMETER[limit.name], limit.detection_limit
    name = parameter.label
    article = "An" if name[0] in "aeiou" and not name.startswith("one") else "A"
    most = max(-parameter.low, parameter.high)
    if not math.isfinite(value):
        size = "of any size"
    elif missed and value >= most:
        size = f"of any size that is likely (up to {quantity(limit.name, most)})"
    else:
        size = f"{'off by ' if parameter.is_error else ''}under {quantity(limit.name, value)}"
    return f"{article} {name} {size} would not have been detected."


def listed(words: Sequence[str], last: str = "and") -> str:
    """Return words as a sentence lists them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _plain_words(name: str, term: Term, basis: Basis | None) -> str:
    """Return a value by the number of the description that it changes, or as it is."""
    parameter = PARAMETER[name]
    if basis is not None and basis.is_described:
        scale = abs((term.extended - term.described) / term.total) if term.total else 0.0
        label, _, unit = basis.written.rpartition("_")
        number, joint = rounded(term.extended, scale * term.half), "of"
        label, note = label.replace("_", " ").removesuffix(" x").removesuffix(" z"), f" {term.note}"
    else:
        percent = 100.0 if parameter.as_percent else 1.0
        label, unit, note = parameter.label, "%" if parameter.as_percent else parameter.unit, ""
        number, joint = (
            rounded(percent * term.total, percent * term.half),
            "off by" if parameter.is_error else "of",
        )
    article = "an" if label[0] in "aeiou" and not label.startswith("one") else "a"
    return f"{article} {label} {joint} {f'{number} {UNITS.get(unit, unit)}'.strip()}{note}"
