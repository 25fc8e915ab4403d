"""What screens and pages call effects, channels and quantities, and the sentences that both share."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from pipelines.reporting.numbers import NBSP
from pipelines.reporting.quantities import SI, enumerated, percentage, percentage_interval, quantity
from terrain.discrepancy.channel_words import CHANNEL_WORDS
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.response_slopes import Slope
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.verdict import Diagnosis, Limit, Unexplained, Value, Varying
from terrain.effects import PARAMETER

SHOWN_RUNS = 5
"""Names of runs that a sentence lists."""


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


def value_with_interval(value: Value) -> str:
    r"""Return a value and its interval.

    Examples
    --------
    >>> value_with_interval(Value("payload_ratio", 0.2, "ratio", 0.1, 0.3)).replace("\xa0", " ")
    '20 % (10 % to 30 %)'
    """
    low, high = (quantity(value.name, end) for end in (value.low, value.high))
    return f"{quantity(value.name, value.value)} ({low} to {high})"


def caveat_text(caveat: str) -> str:
    r"""Return a caveat with units as pages write them.

    Examples
    --------
    >>> caveat_text("it differs from run to run by 0.34 ratio")
    'it differs from run to run by 0.34'
    """
    return re.sub(rf"(?<=\d) ({'|'.join(SI)})\b", lambda found: f"{NBSP}{SI[found[1]]}".rstrip(NBSP), caveat)


def varying_text(each: Varying) -> str:
    """Return how an effect differs from run to run, in a sentence or two."""
    mean, scatter = (quantity(each.parameter, value) for value in (each.mean, each.scatter))
    text = (
        f"The {effect_label(each.name)} differs from run to run: {mean} on average, with a standard "
        f"deviation of {scatter}."
    )
    if each.groups:
        parts = []
        for group in each.groups:
            n, shown = len(group.run_ids), ", ".join(group.run_ids[:SHOWN_RUNS])
            more = ", ..." if n > SHOWN_RUNS else ""
            runs = f"{n} run{'s' * (n != 1)} ({shown}{more})"
            parts.append(f"{quantity(each.parameter, group.value)} in {runs}")
        text += f" Two groups: {', and '.join(parts)}."
    if each.rivals:
        rivals = enumerated(list(map(effect_label, each.rivals)), "or")
        text += f" These runs do not distinguish that from {rivals}."
    return text


def unexplained_text(left: Unexplained, diagnosis: Diagnosis) -> str:
    """Return what a channel depends on: an input, or what resembles an effect that was withdrawn."""
    withdrawn = {effect.name for effect in diagnosis.ruled_out if effect.values}
    if left.input in withdrawn:
        return f"resembles {effect_label(left.input)}, which was withdrawn"
    return f"depends on {left.input}"


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
    if diagnosis.varying:
        names = [effect_label(each.name) for each in diagnosis.varying]
        sentences.append(f"The size of {enumerated(names)} differs from run to run.")
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
    low_high = percentage_interval(gain.reduction.low, gain.reduction.high)
    ratio = percentage(gain.reduction.ratio)
    reduction = f"{ratio} of the squared residual after whitening ({low_high})"
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


def terrain_notes(matches: Sequence[TerrainMatch], apart: Mapping[str, Slope]) -> tuple[str, ...]:
    """Return what a reader has to know of the terrains, in sentences.

    Parameters
    ----------
    matches : on which the runs of each label were simulated
    apart : measured over simulated by label, where labels clearly differ
    """
    notes = [
        f"On {match.terrain} runs fit best if {100.0 * match.effective_ratio:.0f} % of the measured tilt "
        "is a slope to drive up; the rest is attributed to a body that rides over bumps, which takes no "
        "traction."
        for match in matches
        if match.effective_ratio is not None and match.effective_ratio < 1.0
    ]
    if apart:
        each = enumerated([f"{slope.ratio:.2f} on {label}" for label, slope in apart.items()])
        notes.append(
            f"Terrains differ: measured over simulated is {each}. Explain each by itself with "
            f"{enumerated([f'--terrain {label}' for label in apart], 'or')}."
        )
    return tuple(notes)


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
