"""One plain sentence a channel: what the simulation gets wrong there, what repairs it, and what remains."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from terrain.discrepancy.compared import ComparedRun, channels_of, compare_runs, rms_of
from terrain.discrepancy.held_out import Gain
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.robot_terms import UNITS, in_robot_terms, quantity
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.verdict import Diagnosis, Limit, RuledOut, Value, Varying
from terrain.effects import (
    ACCEL,
    CHANNELS,
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
from terrain.records import Array
from terrain.robots import Robot

CHANGED = 0.05
"""Least ratio by which the residual of a channel changes for that to be stated."""

APART_STDS = 4.0
"""Terrains differ if their factors are so many standard deviations apart: the two furthest of several."""

ACTS_RATIO = 0.25
"""Least part of the change of a channel by all causes, root mean square, that one of them makes to be named
with it."""

HELD_OUT, COMPARED = "on held-out runs", "on the runs compared"


SESSION_COLUMNS = ("value", "terrain", "session", "runs", "95 % interval", "sessions of the terrain")


class Statement(NamedTuple):
    """A channel in one sentence.

    Parameters
    ----------
    channel : name
    slope : measured over simulated, of the runs compared
    causes : named ones that act on it
    rms_before, rms_after : of measured minus simulated; the second NaN where nothing was built in
    where : of which runs these are
    text : the sentence
    found : whether it states more than that the two agree
    """

    channel: str
    slope: Slope
    causes: tuple[str, ...]
    rms_before: float
    rms_after: float
    where: str
    text: str
    found: bool

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = {
            name: getattr(self, name) for name in ("channel", "causes", "rms_before", "rms_after", "text")
        }
        apart = {"measured_over_simulated": self.slope.ratio, "measured_minus_simulated": self.slope.level}
        return {**named, **apart, "runs": self.where}


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
    acting : by cause, the channels that it changes, see :func:`acting_causes`; where it shows by default
    """
    slopes = slopes_of(used)
    extended = bool(used) and used[0].after is not None
    found = []
    for channel in channels_of(used):
        if gain is not None and channel in gain.channels:
            before, after = gain.channels[channel].rms_before, gain.channels[channel].rms_after
            where = HELD_OUT
        else:
            before, where = rms_of(used, channel, False), COMPARED
            after = rms_of(used, channel, True) if extended else math.nan
        acts = {cause.name: cause.channels for cause in diagnosis.causes} if acting is None else acting
        causes = tuple(cause.name for cause in diagnosis.causes if channel in acts[cause.name])
        statement = Statement(channel, slopes[channel], causes, before, after, where, "", False)
        found.append(_worded(statement, diagnosis, robot))
    return tuple(sorted(found, key=lambda each: not each.found))


def acting_causes(
    simulation: Simulation, diagnosis: Diagnosis, signals: Sequence[Signals], used: Sequence[ComparedRun]
) -> dict[str, tuple[str, ...]]:
    """Return the channels that each named cause changes: where the extension without it predicts otherwise.

    Parameters
    ----------
    simulation : before
    diagnosis : of the runs
    signals, used : runs behind the diagnosis, and the same beside the simulation
    """
    acting = {}
    low_pass = low_pass_of(signals)
    for cause in diagnosis.causes:
        own = {value.name for value in cause.values}
        others = {name: value for name, value in diagnosis.values.items() if name not in own}
        without = compare_runs(simulation, simulation.with_effects(others), signals, low_pass)
        channels = []
        for c, channel in enumerate(CHANNELS):
            all_of_it = _square([(run.after, run.before, run.measured) for run in used], c)
            part = _square(
                [(run.after, rest.after, run.measured) for run, rest in zip(used, without, strict=True)], c
            )
            if part > (ACTS_RATIO**2) * all_of_it:
                channels.append(channel)
        acting[cause.name] = tuple(channels)
    return acting


def _square(pairs: Sequence[tuple[Array | None, Array | None, Array]], c: int) -> float:
    """Return the sum of the squared differences of two predictions where the channel was measured."""
    total = 0.0
    for one, other, measured in pairs:
        assert one is not None
        assert other is not None
        total += float(np.nansum(np.where(np.isfinite(measured[:, c]), one[:, c] - other[:, c], 0.0) ** 2))
    return total


def _worded(of: Statement, diagnosis: Diagnosis, robot: Robot) -> Statement:
    name, unit = CHANNEL_WORDS[of.channel]
    repair = _repair(of, diagnosis, robot, unit)
    parts = [off_by(of.channel, of.slope), repair, _rivals(of, diagnosis, robot), _varies(of, diagnosis)]
    parts = [part for part in (*parts, _remainder(of, diagnosis, robot, bool(repair))) if part]
    if not parts:
        return of._replace(
            text=f"{name}: measured and simulated agree to {_size(of.rms_before)} {unit} rms {of.where}."
        )
    return of._replace(text=f"{name}: {'; '.join(parts)}.", found=True)


def _size(value: float) -> str:
    return f"{value:.2g}"


def _repair(of: Statement, diagnosis: Diagnosis, robot: Robot, unit: str) -> str:
    """Return what the named causes make of the error."""
    if not math.isfinite(of.rms_after):
        return ""
    change = of.rms_after - of.rms_before
    changed = abs(change) >= CHANGED * of.rms_before
    by_name = {cause.name: cause for cause in diagnosis.causes}
    names = of.causes
    if not changed:  # that is worth stating where a cause shows most
        names = tuple(name for name in names if by_name[name].channels[0] == of.channel)
    causes = [in_robot_terms(name, by_name[name].values, robot) for name in names]
    if not (changed or causes):
        return ""
    words = listed(causes) if causes else "what is named for other channels"
    if not changed:
        return f"with {words} its error stays at {_size(of.rms_after)} {unit} {of.where}"
    verb, sizes = "falls" if change < 0 else "rises", f"{_size(of.rms_before)} to {_size(of.rms_after)}"
    return f"with {words} its error {verb} from {sizes} {unit} {of.where}"


def _rivals(of: Statement, diagnosis: Diagnosis, robot: Robot) -> str:
    """Return the effects of which one explains the channel, where runs do not distinguish them."""
    texts = []
    for names in diagnosis.ambiguous_sets:
        if of.channel not in effect_named(names[0]).channels[:1]:
            continue
        known = [name for name in names if name in diagnosis.ambiguous_values]
        each = [in_robot_terms(name, diagnosis.ambiguous_values[name], robot) for name in known]
        if each:
            texts.append(f"{listed(each, 'or')} explains it, and these runs do not distinguish which")
    return "; ".join(texts)


def _varies(of: Statement, diagnosis: Diagnosis) -> str:
    """Return that the effect behind the channel differs from run to run."""
    texts = []
    for each in diagnosis.varying:
        if each.channel == of.channel:
            parameter = PARAMETER[each.parameter]
            size = f"{100.0 * each.scatter:.2g} %" if parameter.as_percent else f"{each.scatter:.2g}"
            unit = "" if parameter.unit == "ratio" else f" {UNITS.get(parameter.unit, parameter.unit)}"
            texts.append(f"the {parameter.label} differs from run to run by {size}{unit}")
    return "; ".join(texts)


def _remainder(of: Statement, diagnosis: Diagnosis, robot: Robot, repaired: bool) -> str:
    """Return what the named causes do not explain, and what it depends on."""
    unit = CHANNEL_WORDS[of.channel][1]
    rest = f"{_size(of.rms_after if math.isfinite(of.rms_after) else of.rms_before)} {unit}"
    withdrawn = {each.name: each for each in diagnosis.ruled_out if each.values}
    texts = []
    for left in diagnosis.unexplained:
        if left.channel != of.channel:
            continue
        if left.input == "constant" and not repaired and math.isfinite(of.slope.level):
            continue  # that is the level already stated
        effect = withdrawn.get(left.input)
        if effect is not None:
            words = in_robot_terms(effect.name, effect.values, robot)
            how = ("look", "looks"), f"like {words}, a cause that was withdrawn"
        elif left.input == "constant":
            how = ("are", "is"), "a constant offset"
        else:
            how = ("depend", "depends"), f"on {left.input}"
        (many, one), what = how
        if repaired:
            texts.append(f"{rest} rms remain, which {many} {what}")
        else:
            texts.append(f"measured and simulated are {rest} rms apart, which {one} {what}")
    return "; ".join(texts)


def listed(words: Sequence[str], last: str = "and") -> str:
    """Return words as a sentence lists them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def split_ruled_out(diagnosis: Diagnosis) -> tuple[list[RuledOut], list[RuledOut]]:
    """Return causes that were withdrawn, and effects that runs would have shown.

    What the runs did not excite is neither.
    """
    missed = {limit.name for limit in diagnosis.not_excited}
    withdrawn = [effect for effect in diagnosis.ruled_out if effect.values]
    seen = [
        effect
        for effect in diagnosis.ruled_out
        if not effect.values and not {p.name for p in effect_named(effect.name).parameters} <= missed
    ]
    return withdrawn, seen


def terrains_apart(diagnosis: Diagnosis, used: Sequence[ComparedRun]) -> Mapping[str, Slope]:
    """Return measured over simulated by terrain where terrains clearly differ; empty where they do not.

    They are compared in the channel of the effect that varies, or of a cause whose caveat is the run; with
    runs of one label, or runs that are alike, nothing is compared.
    """
    channels = [each.channel for each in diagnosis.varying]
    channels += [cause.channels[0] for cause in diagnosis.causes if "run" in cause.caveat and cause.channels]
    labels = sorted({run.terrain for run in used if run.terrain})
    if not channels or len(labels) < 2:
        return {}
    each = {label: [run for run in used if run.terrain == label] for label in labels}
    for channel in dict.fromkeys(channels):
        slopes = {label: slopes_of(runs).get(channel) for label, runs in each.items()}
        known = {label: slope for label, slope in slopes.items() if slope and math.isfinite(slope.std)}
        ordered = sorted(known.values(), key=lambda slope: slope.ratio)
        if len(ordered) > 1:
            low, high = ordered[0], ordered[-1]
            apart = high.ratio - low.ratio
            if apart > max(APART_STDS * math.hypot(low.std, high.std), CHANGED * abs(low.ratio)):
                return known
    return {}


def session_rows(diagnosis: Diagnosis) -> tuple[tuple[str, ...], ...]:
    """Return the values of named causes by session, a row of :data:`SESSION_COLUMNS` each."""
    rows = []
    for each in diagnosis.by_session:
        alike = "" if len(each.sessions) < 2 else "agree" if each.agree else "differ"
        for i, own in enumerate(each.sessions):
            heads = (PARAMETER[each.parameter].label, each.terrain) if i == 0 else ("", "")
            rows.append((*heads, own.session, str(own.n_runs), own.text, "" if i else alike))
    return tuple(rows)


def notes_of(
    diagnosis: Diagnosis, matches: Sequence[TerrainMatch], apart: Mapping[str, Slope]
) -> tuple[str, ...]:
    """Return what a reader has to know of terrains and sessions that differ, in sentences.

    Parameters
    ----------
    diagnosis : of the runs
    matches : on which the runs of each label were simulated
    apart : measured over simulated by label, as of :func:`terrains_apart`
    """
    notes = [
        f"On {match.terrain} runs fit best if {100.0 * match.effective_ratio:.0f} % of the measured tilt "
        "is a slope to drive up; the rest is attributed to a body that rides over bumps, which takes no "
        "traction."
        for match in matches
        if match.effective_ratio is not None and match.effective_ratio < 1.0
    ]
    if apart:
        each = listed([f"{slope.ratio:.2f} on {label}" for label, slope in apart.items()])
        alone = listed([f"--terrain {label}" for label in apart], "or")
        notes.append(
            f"Terrains differ: measured over simulated is {each}. Explain each by itself with {alone}."
        )
    for session in diagnosis.by_session:
        if not session.agree:
            parameter = PARAMETER[session.parameter]
            values = listed([f"{own.text} in {own.session}" for own in session.sessions])
            of = f" of {session.terrain}" if session.terrain else ""
            notes.append(
                f"Sessions{of} differ: the {parameter.label} is {values}, with the same causes in each; one "
                "value for all of them is a mean."
            )
    return tuple(notes)


# -- What sentences call channels, and what a simulation does that is off in one ---------------------------

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

INPUT_LABELS = {
    "speed_mps": "speed [m/s]",
    "turn_mps": "turn [m/s]",
    "steer_rad": "steering [rad]",
    "grade_rad": "grade [rad]",
    "roll_rad": "roll [rad]",
    "force_ratio": "force [weight]",
    "sideways_mps": "speed to the left [m/s]",
    "time_s": "time [s]",
}
"""Inputs of the simulation as axes call them."""

TIMES, MOST_TIMES = 1.5, 20.0
"""A factor from the first is stated as "2.5 times", below it in percent; over the second it is not stated."""


class _Words(NamedTuple):
    """What a simulation does with too much of it, and too little."""

    verb: str
    more: str
    less: str


_WORDS = {
    GYRO: _Words("the simulation turns", "fast", "slowly"),
    HEADING: _Words("the simulation turns", "fast", "slowly"),
    SPEED_X: _Words("the simulation drives", "fast", "slowly"),
    SPEED_Y: _Words("simulated, it is", "large", "small"),
    ACCEL: _Words("simulated, it is", "large", "small"),
    CURRENT: _Words("simulated, it is", "large", "small"),
    TURNING_CURRENT: _Words("simulated, it is", "large", "small"),
}


def off_by(channel: str, slope: Slope) -> str:
    """Return by which factor or level the simulation is off in a channel; empty where neither is clear.

    Examples
    --------
    >>> off_by("yaw_rate_radps", Slope(0.4, 0.01)), off_by("speed_x_mps", Slope(1.05, 0.01))
    ('the simulation turns 2.5 times too fast', 'the simulation drives 4.8 % too slowly')
    >>> off_by("current_a", Slope(math.nan, math.nan, 1.98, 0.1))
    'simulated, it is 2 A too small throughout'
    """
    words, unit = _WORDS[channel], CHANNEL_WORDS[channel][1]
    if math.isfinite(slope.ratio):
        if slope.ratio < 0.0:
            return f"{words.verb} of the wrong sign" if words.more == "large" else f"{words.verb} backward"
        more = slope.ratio < 1.0
        times = 1.0 / max(slope.ratio, 1e-9) if more else slope.ratio
        if times > MOST_TIMES:
            size = f"more than {MOST_TIMES:g} times"
        elif times >= TIMES:
            size = f"{times:.2g} times"
        else:
            size = f"{100.0 * abs(1.0 / slope.ratio - 1.0):.2g} %"
        return f"{words.verb} {size} too {words.more if more else words.less}"
    if math.isfinite(slope.level):
        low, high = ("small", "large") if words.more == "large" else ("slow", "fast")
        verb = words.verb if words.more == "large" else "the simulation is"
        if channel in (GYRO, HEADING, SPEED_Y):  # a level to one side is no lack of turning
            side = "left" if slope.level > 0 else "right"
            return f"measured is {abs(slope.level):.2g} {unit} more to the {side} throughout"
        return f"{verb} {abs(slope.level):.2g} {unit} too {low if slope.level > 0 else high} throughout"
    return ""


# -- By which factor, or level, measured and simulated are apart in a channel: a slope through zero, robust --

CLEAR_STDS = 3.0
"""A factor or a level is stated where it is off by so many standard deviations over runs."""

OUTLIER_STDS = 3.0
"""Distance of a run from the others, in their standard deviations, beyond which it is far out."""

LEAST_OFF = 0.03
"""Least ratio by which a factor is off: below it a sentence has nothing to state."""

EXPLAINS = 0.15
"""Least part of the absolute residual that a factor or a level has to remove, to describe it."""

LEVEL_RATIO = 0.3
"""Least ratio of the residual's root mean square that a level has to be."""


class Slope(NamedTuple):
    """Measured over simulated.

    Parameters
    ----------
    ratio, std : of the slope through zero, and its standard deviation over runs; NaN where it is not clear
        from 1, or does not describe the residual
    level, level_std : of measured minus simulated, in the channel's unit; NaN where a factor is stated, or no
        level is clear
    """

    ratio: float
    std: float
    level: float = math.nan
    level_std: float = math.nan


def slope_through_zero(simulated: Array, measured: Array) -> float:
    """Return the slope ``b`` that minimises ``sum |measured - b simulated|``; NaN where nothing is simulated.

    It is the median of ``measured / simulated``, each weighted by ``|simulated|``.

    Parameters
    ----------
    simulated, measured : (n,) rows without NaN

    Examples
    --------
    >>> x = np.array([1.0, -2.0, 3.0, 4.0])
    >>> slope_through_zero(x, 0.4 * x + np.array([0.0, 0.0, 9.0, 0.0]))
    0.4
    """
    weight = np.abs(simulated)
    seen = weight > 0.0
    if not seen.any():
        return math.nan
    ratio, weight = measured[seen] / simulated[seen], weight[seen]
    order = np.argsort(ratio, kind="stable")
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, total[-1] / 2.0)])


def slopes_of(runs: Sequence[ComparedRun], extended: bool = False) -> dict[str, Slope]:
    """Return the slope of measured on simulated by channel, over all rows of some runs.

    Parameters
    ----------
    runs : compared
    extended : whether with the causes built in
    """
    slopes = {}
    for c, channel in enumerate(CHANNELS):
        pairs = [_known(run, c, extended) for run in runs]
        pairs = [(x, y) for x, y in pairs if x.size]
        if pairs:
            slopes[channel] = _slope(pairs)
    return slopes


def _known(run: ComparedRun, c: int, extended: bool) -> tuple[Array, Array]:
    simulated = run.after if extended else run.before
    assert simulated is not None
    x, y = simulated[:, c], run.measured[:, c]
    seen = np.isfinite(x) & np.isfinite(y)
    return x[seen], y[seen]


def _slope(pairs: Sequence[tuple[Array, Array]]) -> Slope:
    x, y = (np.concatenate([pair[i] for pair in pairs]) for i in range(2))
    ratio = slope_through_zero(x, y)
    each = np.array([slope_through_zero(*pair) for pair in pairs])
    std = _std_of_mean(each - ratio, np.array([np.abs(pair[0]).sum() for pair in pairs]))
    left = np.abs(y - x).sum()
    off = abs(ratio - 1.0)
    scaled = np.abs(y - ratio * x).sum() < (1.0 - EXPLAINS) * left
    if off > max(CLEAR_STDS * std, LEAST_OFF) and scaled:
        return Slope(ratio, std)
    level = float(np.median(y - x))
    means = np.array([float(np.median(pair[1] - pair[0])) for pair in pairs])
    level_std = _std_of_mean(means - level, np.array([float(pair[0].size) for pair in pairs]))
    rms = float(np.sqrt(np.mean((y - x) ** 2)))
    shifted = np.abs(y - x - level).sum() < (1.0 - EXPLAINS) * left
    if abs(level) > max(CLEAR_STDS * level_std, LEVEL_RATIO * rms) and shifted:
        return Slope(math.nan, math.nan, level, level_std)
    return Slope(math.nan, math.nan)


def _std_of_mean(off: Array, weight: Array) -> float:
    """Return the standard deviation of a weighted mean by how far runs (n,) are from it.

    A run that is far out, as a stalled one, hardly moves a median, and counts as one at the edge.
    """
    known = np.isfinite(off) & (weight > 0.0)
    if known.sum() < 2:
        return math.inf
    edge = OUTLIER_STDS * 1.48 * float(np.median(np.abs(off[known])))
    off = np.clip(off, -edge, edge)
    return float(np.sqrt(((weight * off)[known] ** 2).sum()) / weight[known].sum())


# -- Sentences about a diagnosis: its verdict, its gain, what varies, and what could not have been detected --

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
