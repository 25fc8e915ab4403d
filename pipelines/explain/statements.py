"""A diagnosis in words: one sentence a channel, and the sentences about verdict, gain, variation and limits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

from pipelines.report.numbers import enumerated
from terrain.discrepancy.compared import ComparedRun, channels_of, rms_of
from terrain.discrepancy.held_out import Gain, Reference
from terrain.discrepancy.robot_terms import UNITS, in_robot_terms, quantity
from terrain.discrepancy.slopes import Slope, slopes_of
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.verdict import Diagnosis, Limit, RuledOut, Value, Varying
from terrain.effects import (
    ACCEL,
    CURRENT,
    GYRO,
    HEADING,
    PARAMETER,
    SPEED_X,
    SPEED_Y,
    TRACKED,
    TURNING_CURRENT,
    effect_named,
)
from terrain.robots import Robot

CHANGED = 0.05
"""Least ratio by which the residual of a channel changes for that to be stated."""

LITTLE_LEFT = 0.05
"""Part of the square that a black-box reference has to remove beyond the named causes, at the lower end of its
interval, before something is left to find: less would not change what the simulation is good for."""

TIMES, MOST_TIMES = 1.5, 20.0
"""A factor from the first is stated as "2.5 times", below it in percent; over the second it is not stated."""

MINUS, NBSP = "\N{MINUS SIGN}", "\N{NO-BREAK SPACE}"

SHOWN_RUNS = 5
"""Names of runs that a sentence lists."""

CHANNEL_WORDS = {
    GYRO: ("yaw rate (gyro)", "rad/s"),
    SPEED_X: ("speed ahead", "m/s"),
    SPEED_Y: ("speed to the left", "m/s"),
    ACCEL: ("accelerometer ahead", "m/s²"),
    CURRENT: ("sum of the currents", "A"),
    TURNING_CURRENT: ("right minus left current", "A"),
    HEADING: ("heading rate (no gyro)", "rad/s"),
}
"""What a channel is called, and its unit."""

TURNS, DRIVES, SIZE = (
    ("the simulation turns", "fast", "slowly", "slow"),
    ("the simulation drives", "fast", "slowly", "slow"),
    ("simulated, it is", "large", "small", "small"),
)
"""What a simulation does with too much of it and too little, and with too low a level."""

OFF_WORDS = {**dict.fromkeys(CHANNEL_WORDS, SIZE), GYRO: TURNS, HEADING: TURNS, SPEED_X: DRIVES}

AGREE = "measured and simulated agree"

OF_TRACKS = {
    "wheel radius": "sprocket radius",
    "wheel": "track",
    "wheels": "tracks",
    "Wheel": "Track",
    "Wheels": "Tracks",
}
"""Words for robots on wheels, and for those on tracks."""


class Statement(NamedTuple):
    """A channel in one sentence.

    Parameters
    ----------
    channel : name
    causes : named ones that act on it
    rms_before, rms_after : of measured minus simulated; the second NaN where nothing was built in
    text : the sentence
    measured_over_simulated, measured_minus_simulated : of the runs compared, NaN where not clear
    runs : of which runs the errors are
    """

    channel: str
    causes: tuple[str, ...]
    rms_before: float
    rms_after: float
    text: str
    measured_over_simulated: float
    measured_minus_simulated: float
    runs: str

    @property
    def differs(self) -> bool:
        """Whether it states more than that the two agree."""
        return AGREE not in self.text


def statements_of(
    diagnosis: Diagnosis,
    robot: Robot,
    used: Sequence[ComparedRun],
    gain: Gain | None,
    acting: Mapping[str, Sequence[str]] | None = None,
) -> tuple[Statement, ...]:
    """Return a sentence a channel, those that state something first.

    Parameters
    ----------
    diagnosis : of the runs
    robot : as it was tested
    used : runs behind the diagnosis, beside the simulation
    gain : on the runs held out; None where that was not measured
    acting : by cause, the channels that it changes; where it shows by default
    """
    slopes, extended = slopes_of(used), bool(used) and used[0].after is not None
    acts = {cause.name: cause.channels for cause in diagnosis.causes} if acting is None else acting
    statements = []
    for channel in channels_of(used):
        slope, where = slopes[channel], "on the runs compared"
        before, after = rms_of(used, channel, False), rms_of(used, channel, True) if extended else math.nan
        if gain is not None and channel in gain.channels:
            before, after, *_ = gain.channels[channel]
            where = "on held-out runs"
        causes = tuple(cause.name for cause in diagnosis.causes if channel in acts[cause.name])
        name, unit = CHANNEL_WORDS[channel]
        repair = _repair(channel, causes, (before, after), where, diagnosis, robot)
        error = after if math.isfinite(after) else before
        rest = _remainder(channel, slope, f"{error:.2g} {unit}", bool(repair), diagnosis, robot)
        parts = [off_by(channel, slope), repair, *_rivals_and_variation(channel, diagnosis, robot), *rest]
        text = "; ".join(filter(None, parts)) or f"{AGREE} to {before:.2g} {unit} rms {where}"
        apart = slope.ratio, slope.level, where
        statements.append(Statement(channel, causes, before, after, f"{name}: {text}.", *apart))
    return tuple(sorted(statements, key=lambda statement: not statement.differs))


def _repair(
    channel: str,
    names: Sequence[str],
    rms: tuple[float, float],
    where: str,
    diagnosis: Diagnosis,
    robot: Robot,
) -> str:
    """Return what the named causes make of the error."""
    before, after = rms
    if not math.isfinite(after):
        return ""
    changed = abs(after - before) >= CHANGED * before
    causes = {cause.name: cause for cause in diagnosis.causes}
    if not changed:  # that is worth stating where a cause shows most
        names = [name for name in names if causes[name].channels[0] == channel]
        if not names:
            return ""
    words = enumerated([in_robot_terms(name, causes[name].parameters, robot) for name in names])
    words, unit = words or "what is named for other channels", CHANNEL_WORDS[channel][1]
    if not changed:
        return f"with {words} its error stays at {after:.2g} {unit} {where}"
    verb = "falls" if after < before else "rises"
    return f"with {words} its error {verb} from {before:.2g} to {after:.2g} {unit} {where}"


def _rivals_and_variation(channel: str, diagnosis: Diagnosis, robot: Robot) -> Iterator[str]:
    """Yield the effects of which one explains the channel, and how the effect behind it differs from run to run."""
    for names in diagnosis.ambiguous_sets:
        if channel in effect_named(names[0]).channels[:1]:
            values = diagnosis.ambiguous_values
            rivals = [in_robot_terms(name, values[name], robot) for name in names if name in values]
            if rivals:
                yield f"{enumerated(rivals, 'or')} explains it, and these runs do not distinguish which"
    for effect in diagnosis.varying:
        if effect.channel == channel:
            parameter = PARAMETER[effect.parameter]
            size = f"{100.0 * effect.scatter:.2g} %" if parameter.as_percent else f"{effect.scatter:.2g}"
            unit = "" if parameter.unit == "ratio" else f" {UNITS.get(parameter.unit, parameter.unit)}"
            yield f"the {parameter.label} differs from run to run by {size}{unit}"


def _remainder(
    channel: str, slope: Slope, rest: str, repaired: bool, diagnosis: Diagnosis, robot: Robot
) -> Iterator[str]:
    """Yield what the named causes do not explain, and what it depends on."""
    withdrawn = {effect.name: effect for effect in diagnosis.ruled_out if effect.parameters}
    for left in diagnosis.unexplained:
        constant = left.input == "constant"
        if left.channel != channel or (constant and not repaired and math.isfinite(slope.level)):
            continue  # that is the level already stated
        if left.input in withdrawn:
            words = in_robot_terms(left.input, withdrawn[left.input].parameters, robot)
            many, one, what = "look", "looks", f"like {words}, a cause that was withdrawn"
        elif constant:
            many, one, what = "are", "is", "a constant offset"
        else:
            many, one, what = "depend", "depends", f"on {left.input}"
        if repaired:
            yield f"{rest} rms remain, which {many} {what}"
        else:
            yield f"measured and simulated are {rest} rms apart, which {one} {what}"


def off_by(channel: str, slope: Slope) -> str:
    """Return by which factor or level the simulation is off in a channel; empty where neither is clear.

    Examples
    --------
    >>> off_by("yaw_rate_radps", Slope(0.4, 0.01)), off_by("speed_x_mps", Slope(1.05, 0.01))
    ('the simulation turns 2.5 times too fast', 'the simulation drives 4.8 % too slowly')
    >>> off_by("current_a", Slope(level=1.98))
    'simulated, it is 2 A too small throughout'
    """
    verb, more, less, low = OFF_WORDS[channel]
    if math.isfinite(slope.ratio):
        if slope.ratio < 0.0:
            return f"{verb} of the wrong sign" if more == "large" else f"{verb} backward"
        times = 1.0 / max(slope.ratio, 1e-9) if slope.ratio < 1.0 else slope.ratio
        if times > MOST_TIMES:
            size = f"more than {MOST_TIMES:g} times"
        elif times >= TIMES:
            size = f"{times:.2g} times"
        else:
            size = f"{100.0 * abs(1.0 / slope.ratio - 1.0):.2g} %"
        return f"{verb} {size} too {more if slope.ratio < 1.0 else less}"
    if not math.isfinite(slope.level):
        return ""
    size = f"{abs(slope.level):.2g} {CHANNEL_WORDS[channel][1]}"
    if channel in (GYRO, HEADING, SPEED_Y):  # a level to one side is no lack of turning
        return f"measured is {size} more to the {'left' if slope.level > 0 else 'right'} throughout"
    is_off = verb if more == "large" else "the simulation is"
    return f"{is_off} {size} too {low if slope.level > 0 else more} throughout"


def split_ruled_out(diagnosis: Diagnosis) -> tuple[list[RuledOut], list[RuledOut]]:
    """Return causes that were withdrawn, and effects that runs would have shown.

    What the runs did not excite is neither.
    """
    missed = {limit.name for limit in diagnosis.not_excited}
    withdrawn = [effect for effect in diagnosis.ruled_out if effect.parameters]
    others = [effect for effect in diagnosis.ruled_out if not effect.parameters]
    return withdrawn, [e for e in others if not {p.name for p in effect_named(e.name).parameters} <= missed]


def notes_of(
    diagnosis: Diagnosis, matches: Sequence[TerrainMatch], apart: Mapping[str, Slope]
) -> tuple[str, ...]:
    """Return what a reader has to know of terrains and sessions that differ, in sentences.

    Parameters
    ----------
    diagnosis : of the runs
    matches : on which the runs of each label were simulated
    apart : measured over simulated by label, as of :func:`terrain.discrepancy.slopes.terrains_apart`
    """
    notes = [
        f"On {match.terrain} runs fit best if {100.0 * match.effective_ratio:.0f} % of the measured tilt "
        "is a slope to drive up; the rest is attributed to a body that rides over bumps, which takes no "
        "traction."
        for match in matches
        if match.effective_ratio is not None and match.effective_ratio < 1.0
    ]
    if apart:
        ratios = enumerated([f"{slope.ratio:.2f} on {label}" for label, slope in apart.items()])
        alone = enumerated([f"--terrain {label}" for label in apart], "or")
        notes.append(
            f"Terrains differ: measured over simulated is {ratios}. Explain each by itself with {alone}."
        )
    for value in diagnosis.by_session:
        if not value.agree:
            values = enumerated([f"{own.text} in {own.session}" for own in value.sessions])
            of = f" of {value.terrain}" if value.terrain else ""
            notes.append(
                f"Sessions{of} differ: the {PARAMETER[value.name].label} is {values}, with the same causes in "
                "each; one value for all of them is a mean."
            )
    return tuple(notes)


def effect_label(effect: str) -> str:
    """Return what an effect is called."""
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


def values_with_intervals(values: Sequence[Value], last: str = " and ") -> str:
    """Return values and their intervals."""
    return last.join(f"{quantity(value.name, value.value)} ({quantity_interval(value)})" for value in values)


def verdict_text(diagnosis: Diagnosis) -> str:
    """Return what the simulation gets wrong, with values and intervals."""
    sentences = []
    if diagnosis.causes:
        causes = [
            f"{effect_label(cause.name)}, {values_with_intervals(cause.parameters)}"
            for cause in diagnosis.causes
        ]
        sentences.append(f"The simulation of {diagnosis.robot} lacks {enumerated(causes)}.")
    for names in diagnosis.ambiguous_sets:
        rivals = enumerated([effect_label(name) for name in names], "or")
        sentences.append(f"One of {rivals} is present, and these runs cannot distinguish them.")
    if diagnosis.varying:
        varying = enumerated([effect_label(effect.name) for effect in diagnosis.varying])
        sentences.append(f"The size of {varying} differs from run to run.")
    if diagnosis.unexplained:
        channels = enumerated([*dict.fromkeys(channel_label(left.channel) for left in diagnosis.unexplained)])
        also = " also" if sentences else ""
        sentences.append(f"The residual is{also} systematic, without a known cause, in {channels}.")
    return " ".join(sentences) or f"These runs show nothing that the simulation of {diagnosis.robot} lacks."


def gain_text(gain: Gain | None, reason: str | None) -> str:
    """Return what an extension gains on held-out runs, or why that was not measured."""
    if gain is None:
        return f"The gain on held-out runs was not measured: {reason}."
    n, percents = len(gain.runs), (f"{100.0 * x:.1f}" for x in (gain.reduction, *gain.ci))
    runs = f"{n} held-out runs" if n != 1 else "one held-out run"
    part, least, most = (percent.replace("-", MINUS) for percent in percents)
    removes = (
        f"the extension removes {part}{NBSP}% ({least} to {most}{NBSP}%) of the whitened squared residual"
    )
    return (
        f"On {runs} {f'no gain can be claimed: {removes}, which includes zero' if gain.refused else removes}."
    )


def reference_text(reference: Reference) -> str:
    """Return what a black-box reference reaches beside the named causes.

    Examples
    --------
    >>> reference_text(Reference(5, 0.97, 0.96, {}))
    'The named causes remove 96 % of the square, a black-box reference 97 %: little is left to find.'
    >>> reference_text(Reference(5, 0.01, math.nan, {}))
    'Nothing was named, and a black-box reference removes 1 % of the square: little is left to find.'
    """
    named = reference.named_reduction if math.isfinite(reference.named_reduction) else 0.0
    left, removed = reference.reduction - named, f"{100.0 * max(reference.reduction, 0.0):.0f} %"
    channels = [
        channel_label(name)
        for name, channel in reference.channels.items()
        if channel.left_to_find_from > LITTLE_LEFT
    ]
    if channels:
        judged = f"more is left to find in {enumerated(channels)}"
    elif left > LITTLE_LEFT:
        judged = f"{reference.n_runs} runs are too few to state more"
    else:
        judged = "it finds less than the names state" if left < -LITTLE_LEFT else "little is left to find"
    if math.isnan(reference.named_reduction):
        return f"Nothing was named, and a black-box reference removes {removed} of the square: {judged}."
    return (
        f"The named causes remove {100.0 * named:.0f} % of the square, a black-box reference "
        f"{removed}: {judged}."
    )


def varying_text(effect: Varying) -> str:
    """Return how an effect differs from run to run, in a sentence or two."""
    mean, scatter = (quantity(effect.parameter, value) for value in (effect.mean, effect.scatter))
    text = (
        f"The {effect_label(effect.name)} differs from run to run: {mean} on average, with a standard "
        f"deviation of {scatter}."
    )
    parts = []
    for value, _, runs in effect.groups:
        n, names = len(runs), ", ".join((*runs[:SHOWN_RUNS], *["..."] * (len(runs) > SHOWN_RUNS)))
        parts.append(f"{quantity(effect.parameter, value)} in {n} run{'s' * (n != 1)} ({names})")
    if parts:
        text += f" Two groups: {', and '.join(parts)}."
    if effect.rivals:
        rivals = enumerated([effect_label(rival) for rival in effect.rivals], "or")
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
