"""By which factor, or level, measured and simulated are apart in a channel: a slope through zero, robust."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.verdict import Diagnosis
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.records import Array

CLEAR_STDS = 3.0  #: A factor or a level is stated where it is off by so many standard deviations over runs

OUTLIER_STDS = 3.0
"""Distance of a run from the others, in their standard deviations, beyond which it is far out."""

LEAST_OFF = 0.03  #: Least ratio by which a factor is off: below it a sentence has nothing to state
EXPLAINS = 0.15  #: Least part of the absolute residual that a factor or a level has to remove, to describe it
LEVEL_RATIO = 0.3  #: Least ratio of the residual's root mean square that a level has to be

APART_STDS, APART_RATIO = 4.0, 0.05
"""Terrains differ if their factors are so many standard deviations apart, the two furthest of several, and by
that ratio."""


class Slope(NamedTuple):
    """Measured over simulated, by a slope through zero, or by a level."""

    ratio: float = math.nan  #: NaN where it is not clear from 1, or does not describe the residual
    std: float = math.nan  #: over runs
    level: float = math.nan
    """Measured minus simulated, in the channel's unit; NaN where a factor is stated or none clear."""


def slope_through_zero(simulated: Array, measured: Array) -> float:
    """Return the slope ``b`` that minimises ``sum |measured - b simulated|``; NaN where nothing is simulated.

    It is the median of ``measured / simulated``, each weighted by ``|simulated|``, of rows (n,) without NaN.

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


def slopes_of(runs: Sequence[ComparedRun]) -> dict[str, Slope]:
    """Return the slope of measured on simulated by channel, over all rows of some runs, before."""
    slopes = {}
    for c, channel in enumerate(CHANNELS):
        pairs = []
        for run in runs:
            x, y = run.before[:, c], run.measured[:, c]
            seen = np.isfinite(x) & np.isfinite(y)
            if seen.any():
                pairs.append((x[seen], y[seen]))
        if pairs:
            slopes[channel] = _slope(pairs)
    return slopes


def _slope(pairs: Sequence[tuple[Array, Array]]) -> Slope:
    x, y = (np.concatenate([pair[i] for pair in pairs]) for i in range(2))
    ratio, left = slope_through_zero(x, y), np.abs(y - x).sum()
    each = np.array([slope_through_zero(*pair) for pair in pairs])
    std = _std_of_mean(each - ratio, np.array([np.abs(pair[0]).sum() for pair in pairs]))
    scaled = np.abs(y - ratio * x).sum() < (1.0 - EXPLAINS) * left
    if abs(ratio - 1.0) > max(CLEAR_STDS * std, LEAST_OFF) and scaled:
        return Slope(ratio, std)
    level = float(np.median(y - x))
    medians = np.array([float(np.median(pair[1] - pair[0])) for pair in pairs])
    level_std = _std_of_mean(medians - level, np.array([float(pair[0].size) for pair in pairs]))
    rms = float(np.sqrt(np.mean((y - x) ** 2)))
    shifted = np.abs(y - x - level).sum() < (1.0 - EXPLAINS) * left
    return (
        Slope(level=level)
        if abs(level) > max(CLEAR_STDS * level_std, LEVEL_RATIO * rms) and shifted
        else Slope()
    )


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


def terrains_apart(diagnosis: Diagnosis, used: Sequence[ComparedRun]) -> Mapping[str, Slope]:
    """Return measured over simulated by terrain where terrains clearly differ; empty where they do not.

    They are compared in the channel of the effect that varies, or of a cause whose caveat is the run; with
    runs of one label, or runs that are alike, nothing is compared.
    """
    channels = [effect.channel for effect in diagnosis.varying]
    channels += [cause.channels[0] for cause in diagnosis.causes if "run" in cause.caveat and cause.channels]
    labels = sorted({run.terrain for run in used if run.terrain})
    if not channels or len(labels) < 2:
        return {}
    of_label = {label: slopes_of([run for run in used if run.terrain == label]) for label in labels}
    for channel in dict.fromkeys(channels):
        slopes = {label: slopes.get(channel, Slope()) for label, slopes in of_label.items()}
        known = {label: slope for label, slope in slopes.items() if math.isfinite(slope.std)}
        if len(known) > 1:
            low, *_, high = sorted(known.values(), key=lambda slope: slope.ratio)
            least = max(APART_STDS * math.hypot(low.std, high.std), APART_RATIO * abs(low.ratio))
            if high.ratio - low.ratio > least:
                return known
    return {}


# -- What sentences call channels, and what a simulation does that is off in one ---------------------------

TIMES, MOST_TIMES = 1.5, 20.0
"""A factor from the first is stated as "2.5 times", below it in percent; over the second it is not stated."""

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

TURNS, DRIVES, SIZE = (
    ("the simulation turns", "fast", "slowly", "slow"),
    ("the simulation drives", "fast", "slowly", "slow"),
    ("simulated, it is", "large", "small", "small"),
)
"""What a simulation does with too much of it and too little, and with too low a level."""

OFF_WORDS = {**dict.fromkeys(CHANNEL_WORDS, SIZE), GYRO: TURNS, HEADING: TURNS, SPEED_X: DRIVES}


def off_by(channel: str, ratio: float, level: float = math.nan) -> str:
    """Return by which factor (measured over simulated) or level (measured minus simulated) a channel is off.

    Examples
    --------
    >>> off_by("yaw_rate_radps", 0.4), off_by("speed_x_mps", 1.05)
    ('the simulation turns 2.5 times too fast', 'the simulation drives 4.8 % too slowly')
    >>> off_by("current_a", math.nan, 1.98)
    'simulated, it is 2 A too small throughout'
    """
    verb, more, less, low = OFF_WORDS[channel]
    if not math.isfinite(ratio):
        size = f"{abs(level):.2g} {CHANNEL_WORDS[channel][1]}"
        if channel in (GYRO, HEADING, SPEED_Y):  # a level to one side is no lack of turning
            return f"measured is {size} more to the {'left' if level > 0 else 'right'} throughout"
        is_off = verb if more == "large" else "the simulation is"
        return f"{is_off} {size} too {low if level > 0 else more} throughout"
    if ratio < 0.0:
        return f"{verb} of the wrong sign" if more == "large" else f"{verb} backward"
    times = max(ratio, 1.0 / max(ratio, 1e-9))
    if times < TIMES:
        size = f"{100.0 * abs(1.0 / ratio - 1.0):.2g} %"
    else:
        size = f"{times:.2g} times" if times <= MOST_TIMES else f"more than {MOST_TIMES:g} times"
    return f"{verb} {size} too {more if ratio < 1.0 else less}"
