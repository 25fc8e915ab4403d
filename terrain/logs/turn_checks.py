r"""Gyro and wheels of a run against each other: units and signs that disagree.

A robot with two sides turns at ``w = k (v_right - v_left)``; ``1 / k`` is its effective track, which skidding
makes 1 to 2.6 times the nominal one, and more where wheels dig in.  A gyro in degrees makes k 57 times as
large, a sign that is turned makes it negative.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.logs.checks import Check, Level
from terrain.logs.yaw_rates import MIN_SAMPLES, YawRatePair, gyro_at, imu_time_s, low_passed_pair
from terrain.records import Array, RunLog

MAX_SHIFT_S = 1.5
"""Two loggers that were started by hand are apart by up to this on the published runs."""

N_SHIFTS = 31

MIN_TURN_RADPS = 0.1
"""Root mean square of the yaw rate, of gyro or wheels, below which offsets are as large as the turns."""

MIN_LIKENESS = 0.8
"""Cosine of the angle between both signals from which a slope and a sign mean something.  It counts the level
of a steady turn, which a correlation does not, and which does not depend on the shift."""

MAX_OTHER_LIKENESS = 0.3
"""A regular to and fro is like both signs at some shift: then none is certain."""

TURN_RATIO = (0.1, 1.5)
"""Yaw rate over that of wheels that do not slip.  Measured runs of four robots reach 0.12 (a Husky on snow)
to 1.0; two of 200 dig in and hardly turn (0.03, 0.05), so that less is doubtful and no more."""

MAX_IMPLAUSIBLE_TURN_RATIO = 8.0
"""Nothing turns a robot faster than its wheels by so much; degrees make it 20 to 60."""

MAX_SPEED_MPS = (12.0, 50.0)
"""Of off-road robots without a described top speed; from the first on doubtful, then implausible."""

MAX_OVERSPEED = (1.5, 5.0)
"""Wheel speed over the described top speed: downhill, or with noise, up to 1.1; in km/h 3.6, which another
gear may explain; in rad/s 3.3 (a wheel of 0.3 m) to 6."""

SPEED_QUANTILE = 0.99


class Scale(NamedTuple):
    """What is known of the robot.

    Parameters
    ----------
    track_m : nominal; NaN where unknown
    speed_max_mps : described top speed; infinite where unknown
    """

    track_m: float = math.nan
    speed_max_mps: float = math.inf


def check_turns(run: RunLog, scale: Scale) -> Check:
    """Return how the gyro's yaw rate agrees with the turn of a left and a right wheel."""
    place = "gyro_z_radps"

    def check(level: Level, measured: float, sentence: str) -> Check:
        return Check("yaw rate", level, place, measured, sentence)

    track_m = scale.track_m if math.isfinite(scale.track_m) else 1.0
    try:
        pair = low_passed_pair(run, track_m)
    except DataError:
        return check(Level.UNKNOWN, math.nan, "yaw rate: no gyro about z, or no left and right wheel speed")
    if pair is None:
        return check(Level.UNKNOWN, math.nan, "yaw rate: too few samples of gyro and wheels together")
    fits = [fit for shift in np.linspace(-MAX_SHIFT_S, MAX_SHIFT_S, N_SHIFTS) for fit in _fit(pair, shift)]
    if not fits:
        return check(Level.UNKNOWN, math.nan, "yaw rate: gyro and wheels hardly overlap")
    best = max(fits, key=lambda fit: abs(fit.likeness))
    r, ratio = best.likeness, best.ratio
    other = max(-math.copysign(1.0, r) * fit.likeness for fit in fits)
    if best.turn_radps < MIN_TURN_RADPS or abs(r) < MIN_LIKENESS or other > MAX_OTHER_LIKENESS:
        return check(
            Level.UNKNOWN, r, f"yaw rate: gyro and wheels show no turns in common (likeness {r:.2f} of 1)"
        )
    measured = (
        f"yaw rate: the gyro shows {ratio:.3g} times the yaw rate of the wheels (likeness {r:.2f} of 1)"
        if math.isfinite(scale.track_m)
        else f"yaw rate: the gyro shows {ratio:.3g} rad/s for each m/s between the sides"
    )
    low, high = TURN_RATIO
    expected = f"{low:g} to {high:g} is expected"
    if r < 0.0:
        return check(
            Level.IMPLAUSIBLE, ratio, f"{measured}, {expected}: turned sign of the gyro, or sides swapped"
        )
    if ratio > MAX_IMPLAUSIBLE_TURN_RATIO:
        return check(Level.IMPLAUSIBLE, ratio, f"{measured}, {expected}: a gyro in deg/s read as rad/s?")
    if not low <= ratio <= high:
        why = "wheels that dig in, or in rad/s or km/h read as m/s?" if ratio < low else "another track?"
        return check(Level.DOUBTFUL, ratio, f"{measured}, {expected}: {why}")
    return check(Level.OK, ratio, measured)


class _Fit(NamedTuple):
    """How alike both yaw rates are at a shift, slope of the gyro's over the wheels', and the larger one."""

    likeness: float
    ratio: float
    turn_radps: float


def _fit(pair: YawRatePair, shift_s: float) -> list[_Fit]:
    """Return the fit at a shift; none where less than half of the run overlaps."""
    gyro, there = gyro_at(pair, imu_time_s(pair, 0.0, shift_s, 0.0), pair.gyro_radps)
    if there.sum() < max(MIN_SAMPLES, 0.5 * there.size):
        return []
    gyro, wheels = gyro[there], pair.wheels_radps[there]
    sizes = float(gyro @ gyro), float(wheels @ wheels)
    if min(sizes) == 0.0:
        return []
    product = float(gyro @ wheels)
    turn_radps = math.sqrt(max(sizes) / len(gyro))
    return [_Fit(product / math.sqrt(sizes[0] * sizes[1]), product / sizes[1], turn_radps)]


def check_speeds(run: RunLog, scale: Scale) -> Check:
    """Return whether the wheel speeds are ones that a robot reaches."""

    def check(level: Level, measured: float, sentence: str) -> Check:
        return Check("wheel speed", level, "wheels", measured, sentence)

    speeds = _wheel_speeds(run)
    if not speeds.size:
        return check(Level.UNKNOWN, math.nan, "wheel speed: the run has none")
    fast = float(np.quantile(np.abs(speeds), SPEED_QUANTILE))
    described = math.isfinite(scale.speed_max_mps)
    low, high = (factor * scale.speed_max_mps for factor in MAX_OVERSPEED) if described else MAX_SPEED_MPS
    of_robot = (
        f"the robot's top speed is {scale.speed_max_mps:.3g} m/s" if described else f"up to {low:g} m/s"
    )
    measured = f"wheel speed: {fast:.3g} m/s ({SPEED_QUANTILE:.0%} of the samples are slower)"
    if fast > low:
        level = Level.IMPLAUSIBLE if fast > high else Level.DOUBTFUL
        why = "" if described else " is expected"
        return check(level, fast, f"{measured}, {of_robot}{why}: rad/s or km/h read as m/s?")
    if fast == 0.0:
        return check(Level.UNKNOWN, fast, "wheel speed: the wheels never turn")
    return check(Level.OK, fast, measured)


def _wheel_speeds(run: RunLog) -> Array:
    stream = run.streams.get("wheels")
    if stream is None:
        return np.zeros(0)
    columns = [i for i, name in enumerate(stream.channels) if name.startswith("speed_")]
    values = stream.values[:, columns].ravel()
    return np.asarray(values[np.isfinite(values)])
