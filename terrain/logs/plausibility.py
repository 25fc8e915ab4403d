"""Whether a run log can be what it states: gravity, units, signs, sampling, names, constants, overlap.

A run can be read without fault and be wrong throughout: an accelerometer in g, a gyro in degrees, stamps in
milliseconds.  Each check compares a figure of the run with what every vehicle on Earth, or its own other
sensors, have to show, and states both in one sentence.  What cannot be judged is unknown.

Gyro and wheels of a robot with two sides agree by ``w = k (v_right - v_left)``; ``1 / k`` is its effective track,
which skidding makes 1 to 2.6 times the nominal one, and more where wheels dig in.  A gyro in degrees makes k 57
times as large, a sign that is turned makes it negative.

Thresholds were chosen so that no measured run of four robots is implausible (BorealTC, Vulpi, DRIVE), and
that the usual mistakes are: a factor of 9.81, 57.3, 3.6, 1000, a turned sign or axis.

:func:`stream_quality` states what shape a stream is in: rate, gaps, jitter, stuck channels, missing values.
"""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError, LogError
from terrain.logs.clock import MIN_SAMPLES as MIN_YAW_RATES
from terrain.logs.clock import yaw_rate_pair
from terrain.logs.samples import BEYOND, MAX_MAGNITUDE
from terrain.logs.schema import NO_FEATURES, signal_set_of, unit_of
from terrain.records import Array, RunLog, Stream
from terrain.signals import Pair

GAP_PERIODS = 1.5
"""An interval of this many median periods has lost at least one sample."""

STUCK_IMU_SAMPLES = 20
"""A gyro or accelerometer shows its noise in the last digit even at rest: on 69 published Husky runs it never
holds a value for more than 2 samples, so 20 (0.2 s at 100 Hz) are a fault."""

STUCK_SIBLING_CHANGES = 20
"""A wheel speed may hold one value for a whole run of steady driving, and a current rest at its floor.  They
are stuck when the same quantity at another wheel changes so often meanwhile; on the published runs
it changes at most 7 times."""

IMU_QUANTITIES = ("gyro", "accel")


class StreamQuality(NamedTuple):
    """Sampling of a stream and the quality of its channels.

    A gap is an interval of more than ``GAP_PERIODS`` median periods.  ``longest_gap_s`` is 0 and
    ``longest_gap_at_s`` NaN where there is none.  ``jitter_s`` is the standard deviation of the other
    intervals.  ``stuck`` names channels; missing samples and the longest stretch of one value are by channel.
    """

    n: int
    rate_hz: float
    duration_s: float
    n_gaps: int
    longest_gap_s: float
    longest_gap_at_s: float
    jitter_s: float
    stuck: tuple[str, ...]
    n_nonfinite: dict[str, int]
    longest_constant_s: dict[str, float]


def stream_quality(stream: Stream) -> StreamQuality:
    """Return the quality of a stream of at least two samples.

    A gyro or accelerometer channel is stuck when it holds one value for ``STUCK_IMU_SAMPLES``.  A speed is
    stuck when it holds one value over ``STUCK_SIBLING_CHANGES`` changes of a sibling: the same quantity, in
    the same unit, at another wheel.  Currents rest at their floor while the other side works, so that they
    are stuck only if they never leave one value.  Other channels are not judged.

    Examples
    --------
    >>> time_s = np.delete(np.arange(0.0, 1.0, 0.01), [50, 51])
    >>> quality = stream_quality(Stream(time_s, np.sin(time_s)[:, None], ("gyro_z_radps",)))
    >>> quality.n_gaps, round(quality.longest_gap_s, 3), round(quality.longest_gap_at_s, 3), quality.stuck
    (1, 0.03, 0.49, ())
    """
    intervals_s = np.diff(stream.time_s)
    gap = intervals_s > GAP_PERIODS * np.median(intervals_s)
    longest = int(np.argmax(intervals_s))
    constant = {name: constant_stretches(stream.channel(name)) for name in stream.channels}
    return StreamQuality(
        n=len(stream),
        rate_hz=stream.rate_hz,
        duration_s=stream.duration_s,
        n_gaps=int(gap.sum()),
        longest_gap_s=float(intervals_s[longest]) if gap.any() else 0.0,
        longest_gap_at_s=float(stream.time_s[longest]) if gap.any() else float("nan"),
        jitter_s=float(np.std(intervals_s[~gap])),
        stuck=tuple(name for name, (first, last) in constant.items() if _is_stuck(stream, name, first, last)),
        n_nonfinite={name: int(np.sum(~np.isfinite(stream.channel(name)))) for name in stream.channels},
        longest_constant_s={
            name: float(np.max(stream.time_s[last] - stream.time_s[first], initial=0.0))
            for name, (first, last) in constant.items()
        },
    )


def constant_stretches(values: Array) -> tuple[Array, Array]:
    """Return first and last index (m,) of the stretches of one finite value that cover ``values`` (n,).

    Examples
    --------
    >>> first, last = constant_stretches(np.array([1.0, 1.0, np.nan, 2.0, 2.0, 2.0]))
    >>> first.tolist(), last.tolist()
    ([0, 3], [1, 5])
    """
    first = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    last = np.r_[first[1:] - 1, values.size - 1]
    finite = np.isfinite(values[first])
    return first[finite], last[finite]


def _is_stuck(stream: Stream, name: str, first: Array, last: Array) -> bool:
    quantity = name.partition("_")[0]
    if not first.size:
        return False
    if quantity in IMU_QUANTITIES:
        return bool(np.max(last - first) + 1 >= STUCK_IMU_SAMPLES)
    if quantity not in ("speed", "current"):
        return False
    if quantity == "current" and np.unique(stream.channel(name)[first]).size > 1:
        return False
    for sibling in stream.channels:
        if sibling != name and _kind(sibling) == _kind(name):
            n_changes = np.r_[0, np.cumsum(np.diff(stream.channel(sibling)) != 0.0)]
            if np.max(n_changes[last] - n_changes[first]) >= STUCK_SIBLING_CHANGES:
                return True
    return False


def _kind(channel: str) -> tuple[str, str]:
    return channel.partition("_")[0], channel.rpartition("_")[2]


class Level(StrEnum):
    """How plausible a run is in one respect; unknown where it cannot be judged, never ok by default."""

    OK = "ok"
    UNKNOWN = "unknown"
    DOUBTFUL = "doubtful"
    IMPLAUSIBLE = "implausible"


class Check(NamedTuple):
    """One respect in which a run was judged.

    Parameters
    ----------
    check : what was judged: ``gravity``, ``yaw rate``, ``wheel speed``, ``sampling``, ``values``,
        ``channel names``, ``constant channels``, ``overlap``
    level : how plausible it is
    place : stream or channel that it is about
    measured : the figure that was judged; NaN where there is none
    sentence : what was measured, and what is expected
    """

    check: str
    level: Level
    place: str
    measured: float
    sentence: str


FEATURE_UNITS: dict[str, str] = {
    "gyro": "radps",
    "accel": "mps2",
    "speed": "mps",
    "current": "a",
}
"""Unit of each quantity that features are made of by name."""


OTHER_QUANTITIES: tuple[str, ...] = (
    *("motor", "angle", "roll", "pitch", "yaw", "voltage", "position", "velocity", "quaternion", "rate"),
    *("std", "fix", "confidence", "torque", "temperature", "wheel", "steer", "status", "force", "load"),
    *(
        "sinkage",
        "slip",
        "traction",
        "side",
        "normal",
        "heading",
        "power",
        "pressure",
        "magnetic",
        "height",
        "tick",
        "pulse",
    ),
)
"""Quantities that logs have and no feature is made of."""

AXES = ("x", "y", "z")

NEAR = 0.75
"""Similarity (:mod:`difflib`) from which a name is taken for a misspelt one: two letters that changed places
in ``gyor`` make 0.75, and no two known quantities are nearer than 0.67."""


def check_names(name: str, stream: Stream) -> list[Check]:
    """Return what is odd about the names of a stream's channels; one ok where nothing is.

    Examples
    --------
    >>> [check] = check_names("imu", Stream([0.0, 1.0], [[0.0], [0.0]], ("gyor_z_radps",)))
    >>> check.sentence
    "channel 'gyor_z_radps' of stream 'imu': no feature is made of 'gyor'; is it 'gyro_z_radps'?"
    """
    if name in NO_FEATURES or name in ("estimator", "slip"):
        return [_check(Level.OK, name, f"stream {name!r}: no feature is made of its channels by name")]
    found = [check for channel in stream.channels if (check := _odd(name, channel)) is not None]
    return found or [_check(Level.OK, name, f"stream {name!r}: all quantities are known")]


def _odd(stream: str, channel: str) -> Check | None:
    quantity, _, rest = channel.partition("_")
    place = f"channel {channel!r} of stream {stream!r}"
    known = tuple(dict.fromkeys((*FEATURE_UNITS, *OTHER_QUANTITIES)))
    if quantity not in known:
        near = difflib.get_close_matches(quantity, known, 1, NEAR)
        if near:
            return _check(
                Level.IMPLAUSIBLE if near[0] in FEATURE_UNITS else Level.DOUBTFUL,
                channel,
                f"{place}: no feature is made of {quantity!r}; is it {f'{near[0]}_{rest}'!r}?",
            )
        of_features = ", ".join(FEATURE_UNITS)
        return _check(
            Level.DOUBTFUL,
            channel,
            f"{place}: no feature is made of {quantity!r} (features are made of {of_features})",
        )
    if signal_set_of(stream, channel) is None or quantity not in FEATURE_UNITS:
        return None
    try:
        unit = unit_of(channel)
    except LogError as error:
        return _check(Level.DOUBTFUL, channel, str(error))
    expected = FEATURE_UNITS[quantity]
    if unit != expected:
        return _check(
            Level.IMPLAUSIBLE if quantity in IMU_QUANTITIES else Level.DOUBTFUL,
            channel,
            f"{place}: {quantity} is in {unit!r}, {expected!r} is expected (a name ends in its unit)",
        )
    axis = rest.rpartition("_")[0]
    if quantity in IMU_QUANTITIES and axis not in AXES:
        return _check(
            Level.DOUBTFUL, channel, f"{place}: {axis!r} is no axis, one of {', '.join(AXES)} is expected"
        )
    return None


def _check(level: Level, place: str, sentence: str) -> Check:
    return Check("channel names", level, place, math.nan, sentence)


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
        found = yaw_rate_pair(run, track_m)
    except DataError:
        return check(Level.UNKNOWN, math.nan, "yaw rate: no gyro about z, or no left and right wheel speed")
    if found is None:
        return check(Level.UNKNOWN, math.nan, "yaw rate: too few samples of gyro and wheels together")
    fits = [
        fit for shift in np.linspace(-MAX_SHIFT_S, MAX_SHIFT_S, N_SHIFTS) for fit in _fit(found[0], shift)
    ]
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


def _fit(pair: Pair, shift_s: float) -> list[_Fit]:
    """Return the fit at a shift; none where less than half of the run overlaps."""
    gyro = pair.at(pair.time_s + shift_s)
    there = np.isfinite(gyro)
    if there.sum() < max(MIN_YAW_RATES, 0.5 * there.size):
        return []
    gyro, wheels = gyro[there], pair.measured[there]
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
