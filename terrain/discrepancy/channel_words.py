"""What sentences call channels, and what a simulation does that is off in one."""

from __future__ import annotations

import math
from typing import NamedTuple

from terrain.discrepancy.response_slopes import Slope
from terrain.effects import ACCEL, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT

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
