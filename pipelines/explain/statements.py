"""A diagnosis in words: one sentence a channel, and the sentences about verdict, gain, variation and limits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

from pipelines.report.numbers import enumerated
from terrain.discrepancy.compared import CHANNEL_WORDS, ComparedRun, Slope, off_by, slopes_of
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.patterns import Kind
from terrain.discrepancy.robot_terms import (
    UNITS,
    in_robot_terms,
    quantity_in_robot_terms,
    value_in_robot_terms,
    values_with_intervals,
)
from terrain.discrepancy.runs import TerrainMatch
from terrain.discrepancy.verdict import Diagnosis, RuledOut, Value, Varying
from terrain.effects import PARAMETER, TRACKED, effect_named
from terrain.robots import Robot

CHANGED = 0.05
"""Least ratio by which the residual of a channel changes for that to be stated."""

MINUS, NBSP = "\N{MINUS SIGN}", "\N{NO-BREAK SPACE}"

SHOWN_RUNS = 5
"""Names of runs that a sentence lists."""

WHERE = "on data held out"

AGREE = "measured and simulated agree"

OF_TRACKS = {
    "wheel radius": "sprocket radius",
    "Wheel radius": "Sprocket radius",
    "wheel": "track",
    "wheels": "tracks",
    "Wheel": "Track",
    "Wheels": "Tracks",
}
"""Words for robots on wheels, and for those on tracks."""


class Statement(NamedTuple):
    """A channel in one sentence, with the causes that act on it and how far measured and simulated are apart.

    Errors are root mean squares of measured minus simulated in the ``runs`` named, the second NaN where nothing
    was built in; factor and level are of the runs compared, NaN where not clear.
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
) -> tuple[Statement, ...]:
    """Return a sentence a channel, those that state something first; errors are those on data held out."""
    slopes = slopes_of(used)
    statements = []
    for of_channel in diagnosis.channels:
        channel, slope = of_channel.channel, slopes.get(of_channel.channel, Slope())
        errors = of_channel.rms_before, of_channel.rms_after
        of = Statement(channel, of_channel.causes, *errors, "", slope.ratio, slope.level, WHERE)
        name, unit = CHANNEL_WORDS[channel]
        text = (
            "; ".join(_clauses(of, diagnosis, robot)) or f"{AGREE} to {of.rms_before:.2g} {unit} rms {WHERE}"
        )
        statements.append(of._replace(text=f"{name}: {text}."))
    return tuple(sorted(statements, key=lambda statement: not statement.differs))


def _clauses(of: Statement, diagnosis: Diagnosis, robot: Robot) -> Iterator[str]:
    """Yield what is wrong in a channel, what repairs it, what may be behind it, and what remains."""
    channel, before, after = of.channel, of.rms_before, of.rms_after
    unit, ratio, level = CHANNEL_WORDS[channel][1], of.measured_over_simulated, of.measured_minus_simulated
    if math.isfinite(ratio) or math.isfinite(level):
        yield off_by(channel, ratio, level)
    changed, causes = (
        abs(after - before) >= CHANGED * before,
        {cause.name: cause for cause in diagnosis.built_in},
    )
    # an error that stays is worth stating where a cause shows most
    names = [name for name in of.causes if changed or causes[name].channels[0] == channel]
    repaired = math.isfinite(after) and (changed or bool(names))
    if repaired:
        terms = enumerated([in_robot_terms(name, causes[name].parameters, robot) for name in names])
        verb = "falls" if after < before else "rises"
        sizes = f"{verb} from {before:.2g} to {after:.2g}" if changed else f"stays at {after:.2g}"
        yield f"with {terms or 'what is named for other channels'} its error {sizes} {unit} {of.runs}"
    values = diagnosis.ambiguous_values
    for rivals in diagnosis.ambiguous_sets:
        terms = enumerated(
            [in_robot_terms(name, values[name], robot) for name in rivals if name in values], "or"
        )
        if terms and channel in effect_named(rivals[0]).channels[:1]:
            yield f"{terms} explains it, and these runs do not distinguish which"
    for effect in diagnosis.varying:
        if effect.channel == channel:
            parameter = PARAMETER[effect.parameter]
            size = f"{100.0 * effect.scatter:.2g} %" if parameter.as_percent else f"{effect.scatter:.2g}"
            size_unit = "" if parameter.unit == "ratio" else f" {UNITS.get(parameter.unit, parameter.unit)}"
            yield f"the {parameter.label} differs from run to run by {size}{size_unit}"
    rest = f"{after if math.isfinite(after) else before:.2g} {unit}"
    candidates = {effect.name: effect.parameters for effect in diagnosis.candidates}
    for left in diagnosis.unexplained:
        constant = left.input == "constant"
        if left.channel != channel or (constant and not repaired and math.isfinite(level)):
            continue  # that is the level already stated
        many, one, what = "depend", "depends", f"on {left.input}"
        if left.input in candidates:
            terms = in_robot_terms(left.input, candidates[left.input], robot)
            many, one, what = "look", "looks", f"like {terms}, a candidate that did not earn its name"
        elif constant:
            many, one, what = "are", "is", "a constant offset"
        if repaired:
            yield f"{rest} rms remain, which {many} {what}"
        else:
            yield f"measured and simulated are {rest} rms apart, which {one} {what}"


def would_have_shown(diagnosis: Diagnosis) -> list[RuledOut]:
    """Return the effects that are ruled out: those that these runs would have shown."""
    missed = {limit.name for limit in diagnosis.not_shown}
    return [e for e in diagnosis.ruled_out if not {p.name for p in effect_named(e.name).parameters} <= missed]


def notes_of(
    diagnosis: Diagnosis, matches: Sequence[TerrainMatch], apart: Mapping[str, Slope]
) -> tuple[str, ...]:
    """Return what a reader has to know of terrains and sessions that differ, in sentences.

    Terrains are ``apart`` where measured over simulated differs, as of
    :func:`terrain.discrepancy.compared.terrains_apart`.
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


def gain_text(gain: Gain) -> str:
    """Return what an extension gains on data held out, beside the black-box learner.

    Examples
    --------
    >>> gain = Gain("8 runs held out", (), (), "runs", {}, 0.81, (0.74, 0.88), False, 0.83, (0.75, 0.91))
    >>> gain_text(gain).replace(NBSP, " ")
    'Judged on 8 runs held out, the extension removes 81 % (74 to 88 %) of the square, a black-box learner 83 %.'
    """
    learner = f"a black-box learner {percent_text(gain.learner_reduction)}"
    if not math.isfinite(gain.reduction):
        return f"Judged on {gain.how}, nothing is built in; {learner} of the square."
    part = f"{percent_text(gain.reduction)} ({percent_text(gain.ci[0], '')} to {percent_text(gain.ci[1])})"
    refused = ", which may be nothing" if gain.refused else ""
    return f"Judged on {gain.how}, the extension removes {part} of the square{refused}, {learner}."


def sources_of(diagnosis: Diagnosis, data: str) -> dict[str, str]:
    """Return by parameter that is built in where it comes from: runs, gain, and of which set it is, if of one."""
    assert diagnosis.gain is not None
    runs = f"terrain explain, {diagnosis.n_runs} runs of {data}"
    sources: dict[str, str] = {}
    for cause in diagnosis.built_in:
        low, high = cause.gain_ci
        removes = (
            f"removes {100 * cause.held_out_gain:.0f} % ({100 * low:.0f} to {100 * high:.0f} %) of the square"
        )
        text = f"{runs}; {removes} where it acts, judged on {diagnosis.gain.how}"
        for names in diagnosis.ambiguous_sets:
            if cause.name in names:
                others = [effect_label(name) for name in names if name != cause.name]
                text += f"; these runs do not distinguish it from {enumerated(others, 'or')}"
        sources |= {value.name: text for value in cause.parameters}
    return sources


def percent_text(ratio: float, unit: str = f"{NBSP}%") -> str:
    """Return a part of a square in percent, in full ones."""
    return f"{100.0 * ratio:.0f}{unit}".replace("-", MINUS)


def varying_text(effect: Varying, robot: Robot) -> str:
    r"""Return how an effect differs from run to run, in a sentence or two.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> about = "wheel_radius", "wheel_radius_ratio", "ratio", (), -0.035, 0.022, 10.2, (), "speed_x_mps"
    >>> trend = Varying(*about, Kind.TREND, -0.07, (-0.072, -0.068), None, 20)
    >>> varying_text(trend, load_robot("husky")).replace("\xa0", " ")
    'The wheel radius falls by 7 % (6.8 to 7.2 %) over these 20 runs.'
    """
    mean, scatter = quantity_in_robot_terms(effect.parameter, effect.mean, effect.scatter, robot)
    name, ends = effect_label(effect.name), sorted(map(abs, effect.change_ci))
    if effect.name not in effect.parameter:
        name = f"{name} ({PARAMETER[effect.parameter].label})"
    by = values_with_intervals([Value(effect.parameter, abs(effect.change), effect.unit, *ends)])
    rises, parts = effect.change > 0.0, []
    for value, std, runs, of in effect.groups:
        n, names = len(runs), ", ".join((*runs[:SHOWN_RUNS], *["..."] * (len(runs) > SHOWN_RUNS)))
        where = f"in {n} run{'s' * (n != 1)} ({names})"
        if of:
            where = f"{'on' if effect.pattern is Kind.TERRAINS else 'in'} {of} ({n})"
        parts.append(f"{quantity_in_robot_terms(effect.parameter, value, std, robot)[0]} {where}")
    if effect.pattern is Kind.TREND:
        text = f"The {name} {'rises' if rises else 'falls'} by {by} over these {effect.n_runs} runs."
    elif effect.pattern is Kind.CHANGE:
        first = effect.groups[1].runs[0]
        text = f"The {name} {'rises' if rises else 'falls'} by {by} at one point of the order of the runs, {first}: "
        text += f"{' and '.join(parts)}."
    elif parts:
        named = {Kind.SESSIONS: "sessions", Kind.TERRAINS: "terrains"}
        between = named.get(effect.pattern, "two groups of runs")
        text = f"The {name} differs between {between} by {by}: {enumerated(parts)}."
    else:
        text = (
            f"The {name} differs from run to run: {mean} on average, with a standard deviation of {scatter}."
        )
    if effect.latest is not None:
        last = effect.latest
        latest = value_in_robot_terms(last.name, last.value, last.low, last.high, robot)
        text += (
            f" The extended robot has its value after the last run, {latest}, for which no gain is claimed."
        )
    if effect.rivals:
        rivals = enumerated([effect_label(rival) for rival in effect.rivals], "or")
        text += f" It may as well be {rivals} that differs."
    return text


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
