"""What screens and pages call effects, channels and quantities, and the sentences that both share."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipelines.reporting.numbers import NBSP, NOT_KNOWN, format_number
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.verdict import Diagnosis, Limit, Value
from terrain.effects import PARAMETER

CHANNEL_WORDS = {
    "yaw_rate_radps": ("yaw rate, gyro", "rad/s"),
    "speed_x_mps": ("speed ahead", "m/s"),
    "speed_y_mps": ("speed to the left", "m/s"),
    "accel_x_mps2": ("accelerometer ahead", "m/s²"),
    "current_a": ("sum of the currents", "A"),
    "turning_current_a": ("right minus left current", "A"),
    "heading_rate_radps": ("heading rate, no gyro", "rad/s"),
}
"""What a channel is called, and its unit."""

SI = {
    "ratio": "",
    "radps": "rad/s",
    "rad": "rad",
    "mps2": "m/s²",
    "m": "m",
    "s": "s",
    "s2": "s²",
    "a": "A",
    "nspm": "N s/m",
}
"""How pages write the last word of a parameter's name."""

SMALL = {"rad": "mrad", "radps": "mrad/s", "s": "ms", "m": "mm"}
"""Units of a thousandth."""

TINY = 1e-12
"""Ends of an interval below this are shown as 0: rounding of two equal numbers."""


def effect_label(effect: str) -> str:
    """Return what a page calls an effect.

    Examples
    --------
    >>> effect_label("effective_track")
    'effective track'
    """
    return effect.replace("_", " ")


def channel_label(channel: str) -> str:
    """Return what a page calls a channel."""
    return CHANNEL_WORDS[channel][0]


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


def value_with_interval(value: Value) -> str:
    r"""Return a value and its interval.

    Examples
    --------
    >>> value_with_interval(Value("payload_ratio", 0.2, "ratio", 0.1, 0.3)).replace("\xa0", " ")
    '20 % (10 % to 30 %)'
    """
    low, high = (quantity(value.name, end) for end in (value.low, value.high))
    return f"{quantity(value.name, value.value)} ({low} to {high})"


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


def verdict_text(diagnosis: Diagnosis) -> str:
    """Return the verdict in a sentence or two."""
    causes = [
        f"{effect_label(cause.name)} "
        f"({', '.join(quantity(value.name, value.value) for value in cause.values)})"
        for cause in diagnosis.causes
    ]
    sentences = []
    if causes:
        sentences.append(f"The simulation lacks {enumerated(causes)}.")
    sentences += [
        f"One of {enumerated(list(map(effect_label, names)), 'or')} is present, and these runs cannot "
        "distinguish them."
        for names in diagnosis.ambiguous_sets
    ]
    if diagnosis.unexplained:
        channels = dict.fromkeys(channel_label(left.channel) for left in diagnosis.unexplained)
        also = " also" if sentences else ""
        sentences.append(
            f"The residual is{also} systematic, without a known cause, in {enumerated([*channels])}."
        )
    if not sentences:
        sentences.append("These runs show nothing that the simulation lacks.")
    if diagnosis.not_excited:
        n, of = len(diagnosis.not_excited), len(diagnosis.limits)
        sentences.append(f"Of {of} parameters that may be wrong, {n} could not have been detected.")
    return " ".join(sentences)


def gain_text(gain: Gain) -> str:
    """Return what an extension gains in a sentence."""
    n = len(gain.run_ids)
    runs = f"{n} held-out runs" if n != 1 else "one held-out run"
    ratio = percentage(gain.reduction.ratio)
    reduction = (
        f"{ratio} of the squared residual ({percentage_interval(gain.reduction.low, gain.reduction.high)})"
    )
    if gain.refused:
        return f"On {runs} no gain can be claimed: {reduction}, an interval that includes zero."
    return f"On {runs} the extension removes {reduction}."


def limit_text(limit: Limit, missed: bool) -> str:
    r"""Return a detection limit as a sentence.

    Parameters
    ----------
    missed : whether the runs did not excite the effect

    Examples
    --------
    >>> limit = Limit("steering_offset_1_rad", 0.003, "rad", "several speeds")
    >>> limit_text(limit, False)
    'A steering offset 1 under 3\xa0mrad would not have been detected.'
    >>> limit_text(limit._replace(value=math.inf), True)
    'A steering offset 1 of any size would not have been detected.'
    """
    parameter = PARAMETER[limit.name]
    name = parameter.label
    article = "An" if name[0] in "aeiou" and not name.startswith("one") else "A"
    if not math.isfinite(limit.value):
        return f"{article} {name} of any size would not have been detected."
    off = "off by " if parameter.is_error else ""
    under = f"{off}under {quantity(limit.name, limit.value)}"
    most = max(-parameter.low, parameter.high)
    if missed and limit.value >= most:
        under = f"of any size that is likely (up to {quantity(limit.name, most)})"
    return f"{article} {name} {under} would not have been detected."


def terrain_notes(matches: Sequence[TerrainMatch]) -> tuple[str, ...]:
    """Return a sentence for each terrain on which only a part of the measured tilt acts as a slope."""
    return tuple(
        f"On {match.terrain} runs fit best if {100.0 * match.effective_ratio:.0f} % of the measured tilt "
        "is a slope to drive up; the rest is attributed to a body that rides over bumps, which takes no "
        "traction."
        for match in matches
        if match.effective_ratio is not None and match.effective_ratio < 1.0
    )


def terrain_text(matches: Sequence[TerrainMatch]) -> str:
    """Return on which terrain the runs of each label were simulated.

    Examples
    --------
    >>> terrain_text([TerrainMatch("grass", "grass", 1.0), TerrainMatch("", None, None)])
    'soil grass; runs without a label (or with several): default terrain'
    """
    texts = []
    for match in matches:
        name = f"label {match.terrain}" if match.terrain else "runs without a label (or with several)"
        texts.append(f"soil {match.soil}" if match.soil else f"{name}: default terrain")
    return "; ".join(texts)
