"""Quantities of effects and ratios as pages and screens show them: with units, in two or three digits."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipelines.reporting.numbers import NBSP, NOT_KNOWN, format_number
from terrain.effects import PARAMETER

SI = {
    "ratio": "",
    "radps": "rad/s",
    "rad": "rad",
    "mps2": "m/s²",
    "m": "m",
    "s": "s",
    "s2": "s²",
    "s2pm": "s²/m",
    "s2pm2": "s²/m²",
    "a": "A",
    "nspm": "N s/m",
}
"""How pages write the last word of a parameter's name."""

SMALL = {"rad": "mrad", "radps": "mrad/s", "s": "ms", "m": "mm"}
"""Units of a thousandth."""

TINY = 1e-12
"""Ends of an interval below this are shown as 0: rounding of two equal numbers."""


def unit_label(unit: str) -> str:
    """Return how a page writes a unit.

    Examples
    --------
    >>> unit_label("radps"), unit_label("ratio")
    ('rad/s', '')
    """
    return SI.get(unit, unit)


def quantity(parameter: str, value: float) -> str:
    r"""Return a value with its unit, two digits.

    Examples
    --------
    >>> quantity("gyro_bias_radps", 0.0031), quantity("wheel_radius_ratio", 0.004)
    ('3.1\xa0mrad/s', '0.4\xa0%')
    >>> quantity("scrub_ratio", 0.02)
    '0.02'
    >>> quantity("lever_x_m", math.nan)
    '–'
    """
    if not math.isfinite(value):
        return NOT_KNOWN
    if parameter in PARAMETER and PARAMETER[parameter].as_percent:
        return f"{two_digits(100.0 * value)}{NBSP}%"
    unit = parameter.rpartition("_")[2]
    if unit in SMALL and abs(value) < 0.0995:
        return f"{two_digits(1000.0 * value)}{NBSP}{SMALL[unit]}"
    return f"{two_digits(value)}{NBSP}{SI.get(unit, unit)}".strip(NBSP)


def two_digits(value: float) -> str:
    """Return a number with two digits."""
    return format_number(float(f"{value:.2g}"))


def number(value: float | None) -> str:
    """Return a number with three digits, or a mark where it is not known."""
    return NOT_KNOWN if value is None or not math.isfinite(value) else format_number(value)


def percentage(ratio: float) -> str:
    """Return a ratio as a percentage with two digits, or a mark where it is not known."""
    return NOT_KNOWN if not math.isfinite(ratio) else f"{two_digits(100.0 * ratio)}{NBSP}%"


def percentage_interval(low: float, high: float) -> str:
    """Return an interval of ratios."""
    return f"{percentage(low)} to {percentage(high)}"


def interval(low: float, high: float) -> str:
    """Return an interval of numbers, or a mark where it is not known."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return NOT_KNOWN
    low, high = (end if abs(end) > TINY else 0.0 for end in (low, high))
    return f"{format_number(low)} to {format_number(high)}"


def enumerated(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them.

    Examples
    --------
    >>> enumerated(["a", "b", "c"]), enumerated(["a"])
    ('a, b and c', 'a')
    """
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"
