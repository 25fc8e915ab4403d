"""Numbers and short texts as pages and screens show them."""

from __future__ import annotations

import math
from collections.abc import Mapping

NOT_KNOWN = "\N{EN DASH}"
"""Shown where a figure is not known."""

NBSP = "\N{NO-BREAK SPACE}"

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_number(number: float) -> str:
    """Return a number with three digits.

    Examples
    --------
    >>> format_number(0.12648), format_number(3.81e-4), format_number(7e-6)
    ('0.126', '3.81·10⁻⁴', '7·10⁻⁶')
    >>> format_number(-2.0), format_number(4096.0)
    ('−2', '4096')
    """
    if number == 0:
        return "0"
    if not 1e-3 <= abs(number) < 1e5:
        digits, _, power = f"{number:.2e}".partition("e")
        text = f"{float(digits):g}·10{str(int(power)).translate(_SUPERSCRIPT)}"
    else:
        text = f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def format_known(value: float | None, form: str, unknown: str = "-") -> str:
    """Return a number in a format, or a mark where it is not known.

    Examples
    --------
    >>> format_known(0.1234, "{:+.2f}"), format_known(None, "{:+.2f}"), format_known(math.nan, "{:+.2f}")
    ('+0.12', '-', '-')
    """
    return unknown if value is None or math.isnan(value) else form.format(value)


def percent(ratio: float, digits: int = 1) -> str:
    """Return a ratio as a percentage.

    Examples
    --------
    >>> percent(0.8134), percent(1.0, 0)
    ('81.3%', '100%')
    """
    return f"{ratio:.{digits}%}"


def format_counts(counts: Mapping[str, int]) -> str:
    """Return counts by kind, sorted by kind.

    Examples
    --------
    >>> format_counts({"not moving": 1, "gap": 2})
    '2 gap, 1 not moving'
    """
    return ", ".join(f"{n} {kind}" for kind, n in sorted(counts.items()))


def shorten(text: str, width: int) -> str:
    """Cut the middle out of a text that is too long; both ends of an id carry information.

    Examples
    --------
    >>> shorten("2024-05-01_field_north_run_17", 16)
    '2024-05…h_run_17'
    """
    if len(text) <= width:
        return text
    tail = width // 2
    return f"{text[: width - tail - 1]}…{text[-tail:]}"


def sentence(text: str) -> str:
    """Write a remark as a sentence.

    Examples
    --------
    >>> sentence("not enough yet")
    'Not enough yet.'
    """
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
