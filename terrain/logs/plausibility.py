"""Whether a run log can be what it states: gravity, units, signs, sampling, names, constants, overlap.

A run can be read without fault and be wrong throughout: an accelerometer in g, a gyro in degrees, stamps in
milliseconds.  Each check compares a figure of the run with what every vehicle on Earth, or its own other
sensors, have to show, and states both in one sentence.  What cannot be judged is unknown.

Thresholds were chosen so that no measured run of four robots is implausible (BorealTC, Vulpi, DRIVE), and
that the usual mistakes are: a factor of 9.81, 57.3, 3.6, 1000, a turned sign or axis.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import LogError
from terrain.logs.channel_names import check_names
from terrain.logs.checks import Check, Level
from terrain.logs.plausible import BEYOND, MAX_MAGNITUDE
from terrain.logs.schema import NO_FEATURES, signal_set_of
from terrain.logs.turn_checks import Scale, check_speeds, check_turns
from terrain.records import RunLog, Stream

GRAVITY_RATIO = (0.9, 1.1)
"""Mean specific force over gravity: scale errors of cheap accelerometers are 3 %, and over 6 s of rough
driving measured runs reach 0.93 to 1.085."""

IMPLAUSIBLE_GRAVITY_RATIO = (0.8, 1.2)
"""Beyond, no driving explains it: the mean acceleration of a run is that of its change of speed."""

NO_GRAVITY_RATIO = 0.2
"""Less is an accelerometer without gravity, as some fusing IMUs report it: of use for vibration, not for
tilt, so that it is doubtful."""

UPRIGHT_RATIO = 0.9
"""Least part of the mean specific force along z, a tilt of 26 degrees; measured runs reach 0.97."""

TILTED_RATIO = 0.7
"""Less is a tilt of 45 degrees: another axis points up."""

MIN_GRAVITY_S = 1.0
"""Over shorter runs a brake is as large as gravity."""

RATE_HZ = (0.5, 1e4)
"""Of any sensor of a vehicle; milliseconds read as seconds make 10 Hz 0.01 Hz, the reverse 10 kHz."""

DURATION_S = (0.5, 2 * 24 * 3600.0)
"""Of a run: shorter holds nothing to classify, longer than two nights is no single recording."""

MIN_SAMPLES = 5
"""Fewer show no rate."""

DOUBTFUL_VALUES: dict[str, float] = {"gyro": 70.0, "accel": 400.0, "current": 1000.0, "speed": 50.0}
"""Largest magnitudes, in SI units, that sensors of a vehicle report: gyros to 4000 deg/s, accelerometers to
40 g."""

MIN_CONSTANT_S = 10.0
"""A current may rest at 0, and a quantised speed at one step, throughout a command of 6 s."""

MIN_OVERLAP_RATIO = (0.5, 0.1)
"""Common part of the streams over the longest: below the first doubtful, below the second implausible; the
published runs reach 0.9."""


MAX_NAMED = 3
"""A sentence that concerns many runs is written for so many, and counted for the others."""

UNKNOWN_ROBOT = Scale()
"""Nothing is known of the robot."""


def judge(run: RunLog, scale: Scale = UNKNOWN_ROBOT) -> tuple[Check, ...]:
    """Return the verdict on a run in each respect; several of one where several apply.

    Parameters
    ----------
    run : as a reader returns it
    scale : what is known of the robot

    Examples
    --------
    An accelerometer in g:

    >>> accel = Stream(0.01 * np.arange(300), np.tile([0.0, 0.0, 1.0], (300, 1)),
    ...                ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"))
    >>> [check.sentence for check in judge(RunLog("a", "husky", {"imu": accel})) if check.check == "gravity"]
    ['gravity: the mean specific force is 1 m/s^2, 9.81 is expected: an accelerometer in g read as m/s^2?']
    """
    known = _within_bounds(run)
    checks: list[Check] = [_gravity(known), check_turns(known, scale), check_speeds(known, scale)]
    for name, stream in run.streams.items():
        checks.append(_sampling(name, stream))
        checks += check_names(name, stream)
    checks += _values(run)
    checks += _constants(known)
    checks.append(_overlap(run))
    return tuple(checks)


def worst(checks: Sequence[Check]) -> Level:
    """Return the worst level; unknown where none is known.

    Examples
    --------
    >>> worst([Check("gravity", Level.OK, "imu", 9.8, ""), Check("yaw rate", Level.UNKNOWN, "imu", 0.0, "")])
    <Level.OK: 'ok'>
    """
    order = (Level.UNKNOWN, Level.OK, Level.DOUBTFUL, Level.IMPLAUSIBLE)
    return max((check.level for check in checks), key=order.index, default=Level.UNKNOWN)


class Doubt(NamedTuple):
    """A check of a run that is doubtful or implausible."""

    run_id: str
    check: Check


def doubts_of(verdicts: Mapping[str, Sequence[Check]]) -> tuple[Doubt, ...]:
    """Return what is doubtful or implausible in the checks of runs, by their id."""
    odd = (Level.DOUBTFUL, Level.IMPLAUSIBLE)
    return tuple(
        Doubt(run_id, check) for run_id, checks in verdicts.items() for check in checks if check.level in odd
    )


def refuse_implausible_runs(doubts: Sequence[Doubt]) -> None:
    """Raise :class:`LogError` with the first implausible check, and how many there are."""
    found = [doubt for doubt in doubts if doubt.check.level == Level.IMPLAUSIBLE]
    if not found:
        return
    runs = len({doubt.run_id for doubt in found})
    more = f" ({len(found)} such findings in {runs} run{'s' * (runs > 1)})" if len(found) > 1 else ""
    raise LogError(
        f"{found[0].run_id}: implausible {found[0].check.sentence}{more}; mend it where it is read, by a "
        "mapping, say, or import it as it is, and counted, with --repair"
    )


def counted(run: RunLog, checks: Sequence[Check]) -> RunLog:
    """Return a run that states among what was dropped or changed which checks it does not pass."""
    odd = Counter(f"implausible {check.check}" for check in checks if check.level == Level.IMPLAUSIBLE)
    return replace(run, dropped=Counter(run.dropped) + odd) if odd else run


def doubt_sentences(doubts: Sequence[Doubt]) -> Iterator[str]:
    """Yield a sentence a doubt; where one check concerns many runs, some of them and their number."""
    seen: Counter[tuple[str, str, Level]] = Counter()
    kinds = [(doubt.check.check, doubt.check.place, doubt.check.level) for doubt in doubts]
    for doubt, kind in zip(doubts, kinds, strict=True):
        seen[kind] += 1
        if seen[kind] <= MAX_NAMED:
            yield f"{doubt.run_id}: {doubt.check.level} {doubt.check.sentence}"
    for (check, place, level), n in Counter(kinds).items():
        if n > MAX_NAMED:
            yield f"{n - MAX_NAMED} more runs: {level} {check} ({place})"


def _within_bounds(run: RunLog) -> RunLog:
    """Return the run with NaN for values that no quantity can have, which one check is about."""
    streams = dict(run.streams)
    for name, stream in streams.items():
        beyond = np.abs(stream.values) > MAX_MAGNITUDE
        if beyond.any():
            streams[name] = Stream(stream.time_s, np.where(beyond, np.nan, stream.values), stream.channels)
    return replace(run, streams=streams)


def _gravity(run: RunLog) -> Check:
    def check(level: Level, measured: float, sentence: str) -> Check:
        return Check("gravity", level, "imu", measured, f"gravity: {sentence}")

    stream = run.streams.get("imu")
    names = tuple(f"accel_{axis}_mps2" for axis in "xyz")
    if stream is None or not set(names) <= set(stream.channels):
        return check(Level.UNKNOWN, math.nan, "the run has no accelerometer of three axes")
    values = np.column_stack([stream.channel(name) for name in names])
    finite = np.isfinite(values).all(axis=1)
    if finite.sum() < MIN_SAMPLES or np.ptp(stream.time_s[finite]) < MIN_GRAVITY_S:
        return check(Level.UNKNOWN, math.nan, f"fewer than {MIN_GRAVITY_S:g} s of the accelerometer")
    values = values[finite]
    mean = values.mean(axis=0)
    size = float(np.linalg.norm(mean))
    measured = f"the mean specific force is {size:.3g} m/s^2, {GRAVITY_MPS2:.3g} is expected"
    ratio = size / GRAVITY_MPS2
    low, high = IMPLAUSIBLE_GRAVITY_RATIO
    if abs(ratio * GRAVITY_MPS2 - 1.0) <= 1.0 - low:
        return check(Level.IMPLAUSIBLE, size, f"{measured}: an accelerometer in g read as m/s^2?")
    if abs(size / GRAVITY_MPS2**2 - 1.0) <= 1.0 - low:
        return check(Level.IMPLAUSIBLE, size, f"{measured}: one in m/s^2 read as g?")
    if ratio < NO_GRAVITY_RATIO:
        return check(Level.DOUBTFUL, size, f"{measured}: gravity removed?")
    if not low <= ratio <= high:
        return check(Level.IMPLAUSIBLE, size, f"{measured}: another unit, or a scale?")
    upright = float(mean[2] / size)
    along = ", ".join(f"{part:.3g}" for part in mean)
    expected = f"it is ({along}) m/s^2 along x, y and z, mostly along +z is expected"
    if upright < TILTED_RATIO:
        why = "z points down?" if upright < -TILTED_RATIO else "another axis points up?"
        return check(Level.IMPLAUSIBLE, size, f"{expected}: {why}")
    if upright < UPRIGHT_RATIO:
        return check(Level.DOUBTFUL, size, f"{expected}: a tilted sensor, or a steep slope?")
    if not GRAVITY_RATIO[0] <= ratio <= GRAVITY_RATIO[1]:
        return check(Level.DOUBTFUL, size, f"{measured}: a wrong scale, or an offset?")
    return check(Level.OK, size, f"the mean specific force is {size:.3g} m/s^2, along z")


def _sampling(name: str, stream: Stream) -> Check:
    def check(level: Level, measured: float, sentence: str) -> Check:
        return Check("sampling", level, name, measured, f"sampling of stream {name!r}: {sentence}")

    rate_hz, duration_s = stream.rate_hz, stream.duration_s
    if len(stream) < MIN_SAMPLES:
        return check(Level.UNKNOWN, rate_hz, f"{len(stream)} samples show no rate")
    low, high = RATE_HZ
    if not low <= rate_hz <= high:
        level = Level.DOUBTFUL if name in NO_FEATURES and rate_hz < low else Level.IMPLAUSIBLE
        why = "ms read as s?" if rate_hz < low else "s read as ms?"
        return check(level, rate_hz, f"{rate_hz:.3g} Hz, {low:g} Hz to {high / 1e3:g} kHz is expected: {why}")
    if not DURATION_S[0] <= duration_s <= DURATION_S[1]:
        why = "s read as ms?" if duration_s < DURATION_S[0] else "ms read as s?"
        return check(
            Level.DOUBTFUL,
            duration_s,
            f"{duration_s:.3g} s long, {DURATION_S[0]:g} s to {DURATION_S[1] / 3600:g} h is expected: {why}",
        )
    return check(Level.OK, rate_hz, f"{rate_hz:.3g} Hz over {duration_s:.3g} s")


def _values(run: RunLog) -> Iterator[Check]:
    n_odd = 0
    for name, stream in run.streams.items():
        largest = np.nanmax(np.abs(stream.values), axis=0, initial=0.0)
        for channel, value in zip(stream.channels, largest, strict=True):
            place = f"channel {channel!r} of stream {name!r}"
            of_quantity = DOUBTFUL_VALUES.get(channel.partition("_")[0], math.inf)
            if value > MAX_MAGNITUDE:
                n_odd += 1
                yield Check(
                    "values",
                    Level.IMPLAUSIBLE,
                    channel,
                    float(value),
                    f"{place}: reaches {value:.6g}; {BEYOND}",
                )
            elif value > of_quantity and signal_set_of(name, channel) is not None:
                n_odd += 1
                yield Check(
                    "values",
                    Level.DOUBTFUL,
                    channel,
                    float(value),
                    f"{place}: reaches {value:.4g} in its SI unit, up to {of_quantity:g} is expected",
                )
    if not n_odd:
        yield Check(
            "values", Level.OK, "all", math.nan, "values: all are such as sensors of a vehicle report"
        )


def _constants(run: RunLog) -> Iterator[Check]:
    """Yield channels that are constant while another one of their signals varies, or the wheels turn."""
    still: dict[tuple[str, str], bool] = {}
    for name, stream in run.streams.items():
        if len(stream) < MIN_SAMPLES or stream.duration_s < MIN_CONSTANT_S:
            continue
        for channel, values in zip(stream.channels, stream.values.T, strict=True):
            if signal_set_of(name, channel) in ("imu", "wheels", "currents"):
                finite = values[np.isfinite(values)]
                still[name, channel] = not finite.size or not np.ptp(finite)
    varying = {
        (name, signal_set_of(name, channel)) for (name, channel), constant in still.items() if not constant
    }
    turning = any(signals == "wheels" for _, signals in varying)
    n_odd = 0
    for (name, channel), constant in still.items():
        signals = signal_set_of(name, channel)
        if constant and ((name, signals) in varying or (turning and signals == "imu")):
            n_odd += 1
            value = float(run.streams[name].channel(channel)[0])
            yield Check(
                "constant channels",
                Level.DOUBTFUL,
                channel,
                value,
                f"channel {channel!r} of stream {name!r}: is {value:.4g} throughout; a sensor that works "
                "varies",
            )
    if not n_odd:
        level = Level.OK if varying else Level.UNKNOWN
        what = "none is" if varying else "there is none to judge"
        yield Check("constant channels", level, "all", math.nan, f"constant channels: {what}")


def _overlap(run: RunLog) -> Check:
    streams = {name: stream for name, stream in run.streams.items() if name not in NO_FEATURES}
    if len(streams) < 2:
        return Check("overlap", Level.UNKNOWN, "all", math.nan, "overlap: there is one stream of sensors")
    start_s = max(stream.time_s[0] for stream in streams.values())
    end_s = min(stream.time_s[-1] for stream in streams.values())
    longest_s = max(stream.duration_s for stream in streams.values())
    ratio = float(max(end_s - start_s, 0.0) / longest_s) if longest_s > 0.0 else math.nan
    measured = f"overlap: {100 * ratio:.0f} % of the longest stream lie in all ({', '.join(streams)})"
    if math.isnan(ratio):
        return Check("overlap", Level.UNKNOWN, "all", ratio, "overlap: the streams have no duration")
    doubtful, implausible = MIN_OVERLAP_RATIO
    if ratio < doubtful:
        level = Level.IMPLAUSIBLE if ratio < implausible else Level.DOUBTFUL
        why = "other units of time, or loggers that were started apart?"
        return Check("overlap", level, "all", ratio, f"{measured}, {100 * doubtful:.0f} % is expected: {why}")
    return Check("overlap", Level.OK, "all", ratio, measured)
