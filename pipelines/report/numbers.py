"""How a number is written: one function for screens, pages, cards and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

from terrain.files.names import printable

NOT_KNOWN = "\N{EN DASH}"  #: Written where a figure is not known

NBSP = "\N{NO-BREAK SPACE}"
MINUS = "\N{MINUS SIGN}"

TINY = 1e-12  #: Ends of an interval below this are written as 0: rounding of two equal numbers

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_value(value: Any, form: str = "", unit: str = "") -> str:
    r"""Return a value as it is written everywhere.

    Parameters
    ----------
    value : a number, a text, a truth value, None, or a pair (low, high), which is an interval
    form : Python's format, as ``.3f`` or ``.1%``; empty for three significant digits of a number with a
        fraction, and for all others as they are
    unit : behind the number

    Examples
    --------
    >>> format_value(0.8134, ".1%"), format_value(-0.25, "+.2f"), format_value(None), format_value(3)
    ('81.3\xa0%', '−0.25', '–', '3')
    >>> format_value(-0.0004, ".3f"), format_value(-0.0004, "+.3f")
    ('0.000', '+0.000')
    >>> format_value((0.7236, 0.9079), ".1%"), format_value(0.12648, unit="m/s")
    ('72.4 to 90.8\xa0%', '0.126\xa0m/s')
    """
    pair = isinstance(value, tuple) and len(value) == 2
    pair = pair and not isinstance(value[0], str) and not isinstance(value[1], str)
    texts = []
    for each in value if pair else (value,):
        if each is None:
            text = NOT_KNOWN
        elif isinstance(each, bool):
            text = "yes" if each else "no"
        elif isinstance(each, Enum):
            text = str(each.value)
        elif isinstance(each, str):
            text = plain_line(each)
        else:
            number = each if isinstance(each, int | float) or not hasattr(each, "item") else each.item()
            if pair and isinstance(each, float) and abs(each) < TINY:
                number = 0.0
            if isinstance(number, float) and not math.isfinite(number):
                text = NOT_KNOWN if math.isnan(number) else ("∞" if number > 0 else f"{MINUS}∞")
            elif form:
                text = f"{number:{form}}".removesuffix("%")
                if text.startswith("-") and not text.strip("-0."):  # less than half of the last digit below 0
                    text = f"{abs(number):{form}}".removesuffix("%")
                text = text.replace("-", MINUS)
            else:
                text = format_number(number) if isinstance(number, float) else str(number).replace("-", MINUS)
        texts.append(text)
    if NOT_KNOWN in texts:
        return NOT_KNOWN
    ending = "%" if form.endswith("%") else unit
    return " to ".join(texts) + (f"{NBSP}{ending}" if ending else "")


def plain_line(text: str) -> str:
    r"""Return a text on one line, with escapes for what a terminal would act on; spaces that do not break stay.

    Examples
    --------
    >>> plain_line("a\nb 3\xa0m")
    'a\\nb 3\xa0m'
    """
    return NBSP.join(map(printable, text.split(NBSP)))


def format_number(number: float) -> str:
    """Return a number with three significant digits.

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
        mantissa, _, power = f"{number:.2e}".partition("e")
        text = f"{float(mantissa):g}·10{str(int(power)).translate(_SUPERSCRIPT)}"
    else:
        text = f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"
    return text.replace("-", MINUS)


def format_counts(counts: Mapping[str, int]) -> str:
    """Return counts by kind, sorted by kind.

    Examples
    --------
    >>> format_counts({"not moving": 1, "gap": 2})
    '2 gap, 1 not moving'
    """
    return ", ".join(f"{n} {kind}" for kind, n in sorted(counts.items()))


def plural(n: int, thing: str) -> str:
    """Return a number of things.

    Examples
    --------
    >>> plural(1, "run"), plural(2, "class")
    ('1 run', '2 classes')
    """
    return f"{n} {thing if n == 1 else thing + ('es' if thing.endswith('s') else 's')}"


def enumerated(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them.

    Examples
    --------
    >>> enumerated(["a", "b", "c"]), enumerated(["a"]), enumerated([])
    ('a, b and c', 'a', '')
    """
    return f"{', '.join(names[:-1])} {last} {names[-1]}" if len(names) > 1 else "".join(names)


def sentence(text: str) -> str:
    """Write a remark as a sentence.

    Examples
    --------
    >>> sentence("not enough yet")
    'Not enough yet.'
    """
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
