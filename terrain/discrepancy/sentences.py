"""Sentences about a diagnosis: its verdict, its gain, what varies, and what could not have been detected."""

from __future__ import annotations

import math
import re
from dataclasses import fields, is_dataclass, replace
from typing import Any

from terrain.discrepancy.held_out import Gain
from terrain.discrepancy.robot_terms import quantity
from terrain.discrepancy.statements import CHANNEL_WORDS, listed
from terrain.discrepancy.verdict import Diagnosis, Limit, Value, Varying
from terrain.effects import PARAMETER, TRACKED

MINUS, NBSP = "\N{MINUS SIGN}", "\N{NO-BREAK SPACE}"

SHOWN_RUNS = 5
"""Names of runs that a sentence lists."""

OF_TRACKS = {
    "wheel radius": "sprocket radius",
    "wheel": "track",
    "wheels": "tracks",
    "Wheel": "Track",
    "Wheels": "Tracks",
}
"""Words for robots on wheels, and for those on tracks."""


def effect_label(effect: str) -> str:
    """Return what an effect is called.

    Examples
    --------
    >>> effect_label("effective_track")
    'effective track'
    """
    return effect.replace("_", " ")


def channel_label(channel: str) -> str:
    """Return what a channel is called."""
    return CHANNEL_WORDS[channel][0]


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


def value_with_interval(value: Value) -> str:
    r"""Return a value and its interval.

    Examples
    --------
    >>> value_with_interval(Value("payload_ratio", 0.2, "ratio", 0.1, 0.3)).replace("\xa0", " ")
    '20 % (10 to 30 %)'
    """
    return f"{quantity(value.name, value.value)} ({quantity_interval(value)})"


def verdict_text(diagnosis: Diagnosis) -> str:
    """Return what the simulation gets wrong, with values and intervals."""
    sentences = []
    if diagnosis.causes:
        causes = [
            f"{effect_label(cause.name)}, {' and '.join(map(value_with_interval, cause.values))}"
            for cause in diagnosis.causes
        ]
        sentences.append(f"The simulation of {diagnosis.robot} lacks {listed(causes)}.")
    for names in diagnosis.ambiguous_sets:
        rivals = listed([effect_label(name) for name in names], "or")
        sentences.append(f"One of {rivals} is present, and these runs cannot distinguish them.")
    if diagnosis.varying:
        varying = listed([effect_label(each.name) for each in diagnosis.varying])
        sentences.append(f"The size of {varying} differs from run to run.")
    if diagnosis.unexplained:
        channels = listed([*dict.fromkeys(channel_label(left.channel) for left in diagnosis.unexplained)])
        also = " also" if sentences else ""
        sentences.append(f"The residual is{also} systematic, without a known cause, in {channels}.")
    if not sentences:
        sentences.append(f"These runs show nothing that the simulation of {diagnosis.robot} lacks.")
    return " ".join(sentences)


def gain_text(gain: Gain | None, reason: str | None) -> str:
    """Return what an extension gains on held-out runs, or why that was not measured."""
    if gain is None:
        return f"The gain on held-out runs was not measured: {reason}."
    n, (ratio, low, high) = len(gain.run_ids), gain.reduction
    runs = f"{n} held-out runs" if n != 1 else "one held-out run"
    part, least, most = (f"{100.0 * each:.1f}".replace("-", MINUS) for each in (ratio, low, high))
    removes = (
        f"the extension removes {part}{NBSP}% ({least} to {most}{NBSP}%) of the whitened squared residual"
    )
    return (
        f"On {runs} {f'no gain can be claimed: {removes}, which includes zero' if gain.refused else removes}."
    )


def _runs(n: int) -> str:
    return f"{n} run{'s' * (n != 1)}"


def varying_text(each: Varying) -> str:
    """Return how an effect differs from run to run, in a sentence or two."""
    mean, scatter = (quantity(each.parameter, value) for value in (each.mean, each.scatter))
    text = (
        f"The {effect_label(each.name)} differs from run to run: {mean} on average, with a standard "
        f"deviation of {scatter}."
    )
    parts = []
    for group in each.groups:
        names = ", ".join(
            (*group.run_ids[:SHOWN_RUNS], *(["..."] if len(group.run_ids) > SHOWN_RUNS else []))
        )
        parts.append(f"{quantity(each.parameter, group.value)} in {_runs(len(group.run_ids))} ({names})")
    if parts:
        text += f" Two groups: {', and '.join(parts)}."
    if each.rivals:
        rivals = listed([effect_label(rival) for rival in each.rivals], "or")
        text += f" These runs do not distinguish that from {rivals}."
    return text


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


def in_words_of(drive: str, part: Any) -> Any:
    """Return a text, or a report with all its texts, in the words of robots of a drive.

    Effects and sentences are written for wheels; robots on tracks have sprockets.

    Examples
    --------
    >>> in_words_of("tracked", "The simulation lacks wheel radius (2 %); its wheels turn it at 0.3 rad/s.")
    'The simulation lacks sprocket radius (2 %); its tracks turn it at 0.3 rad/s.'
    """
    if drive != TRACKED:
        return part
    if isinstance(part, str):
        for wheel, track in OF_TRACKS.items():
            part = re.sub(rf"\b{wheel}\b", track, part)
        return part
    if is_dataclass(part) and not isinstance(part, type):
        changed = {each.name: in_words_of(drive, getattr(part, each.name)) for each in fields(part)}
        return replace(part, **changed)
    if isinstance(part, list | tuple):
        parts = [in_words_of(drive, each) for each in part]
        return type(part)(*parts) if hasattr(part, "_fields") else type(part)(parts)
    return part
