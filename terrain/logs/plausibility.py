"""Whether a run log can be what it states: gravity, units, signs, sampling, names, constants, overlap.

A run can be read without fault and be wrong throughout: an accelerometer in g, a gyro in degrees, stamps in
milliseconds.  Each check compares a figure of the run with what every vehicle on Earth, or its own other
sensors, have to show, and states both in one sentence.  What cannot be judged is unknown.

Gyro and wheels of a robot with two sides agree by ``w = k (v_right - v_left)``; ``1 / k`` is its effective track,
which skidding makes 1 to 2.6 times the nominal one, and more where wheels dig in.  A gyro in degrees makes k 57
times as large, a sign that is turned makes it negative.

A respect in which a run is judged is a table of cases, from the first of which that holds it has its level and its
sentence.  Thresholds were chosen so that no measured run of four robots is implausible (BorealTC, Vulpi, DRIVE), and
that the usual mistakes are: a factor of 9.81, 57.3, 3.6, 1000, a turned sign or axis.

:func:`stream_quality` states what shape a stream is in: rate, gaps, jitter, stuck channels, missing values.
"""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError, LogError
from terrain.logs.clock import MIN_SAMPLES as MIN_YAW_RATES
from terrain.logs.clock import yaw_rate_pair
from terrain.logs.motion_checks import Described, Finding, joint_findings, motion_findings
from terrain.logs.samples import BEYOND, MAX_MAGNITUDE
from terrain.logs.schema import NO_FEATURES, signal_set_of, unit_of
from terrain.records import Array, RunLog, Stream
from terrain.signals import agreement

GAP_PERIODS = 1.5  #: An interval of this many median periods has lost at least one sample.
#: A gyro or accelerometer shows its noise in the last digit even at rest: on 69 published Husky runs it never holds a
#: value for more than 2 samples, so 20 (0.2 s at 100 Hz) are a fault.
STUCK_IMU_SAMPLES = 20
#: A wheel speed may hold one value for a whole run of steady driving, and a current rest at its floor.  They are
#: stuck when the same quantity at another wheel changes so often meanwhile; on the published runs it changes at most
#: 7 times.
STUCK_SIBLING_CHANGES = 20

IMU_QUANTITIES = ("gyro", "accel")


class StreamQuality(NamedTuple):
    """Sampling of a stream and the quality of its channels.

    ``longest_gap_s`` is 0 and ``longest_gap_at_s`` NaN where there is no gap; ``jitter_s`` is the standard deviation
    of the other intervals; missing samples and the longest stretch of one value are by channel.
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
    kinds = {name: (name.partition("_")[0], name.rpartition("_")[2]) for name in stream.channels}
    stuck, longest_constant_s = [], {}
    for name, kind in kinds.items():
        values, quantity = stream.channel(name), kind[0]
        first, last = constant_stretches(values)
        longest_constant_s[name] = float(np.max(stream.time_s[last] - stream.time_s[first], initial=0.0))
        if not first.size or quantity not in (*IMU_QUANTITIES, "speed", "current"):
            continue
        if quantity in IMU_QUANTITIES:
            is_stuck = np.max(last - first) + 1 >= STUCK_IMU_SAMPLES
        elif quantity == "current" and np.unique(values[first]).size > 1:
            is_stuck = False
        else:
            siblings = [other for other in kinds if other != name and kinds[other] == kind]
            changes = [np.r_[0, np.cumsum(np.diff(stream.channel(other)) != 0.0)] for other in siblings]
            is_stuck = any(np.max(n[last] - n[first]) >= STUCK_SIBLING_CHANGES for n in changes)
        if is_stuck:
            stuck.append(name)
    return StreamQuality(
        n=len(stream),
        rate_hz=stream.rate_hz,
        duration_s=stream.duration_s,
        n_gaps=int(gap.sum()),
        longest_gap_s=float(intervals_s[longest]) if gap.any() else 0.0,
        longest_gap_at_s=float(stream.time_s[longest]) if gap.any() else float("nan"),
        jitter_s=float(np.std(intervals_s[~gap])),
        stuck=tuple(stuck),
        n_nonfinite={name: int(np.sum(~np.isfinite(stream.channel(name)))) for name in stream.channels},
        longest_constant_s=longest_constant_s,
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


class Level(StrEnum):
    """How plausible a run is in one respect; unknown where it cannot be judged, never ok by default."""

    OK = "ok"
    UNKNOWN = "unknown"
    DOUBTFUL = "doubtful"
    IMPLAUSIBLE = "implausible"


OK, UNKNOWN, DOUBTFUL, IMPLAUSIBLE = Level


class Check(NamedTuple):
    """One respect in which a run was judged."""

    #: what was judged: ``gravity``, ``yaw rate``, ``wheel speed``, ``sampling``, ``values``, ``channel names``,
    #: ``constant channels``, ``overlap``
    check: str
    level: Level  #: how plausible it is
    place: str  #: stream or channel that it is about
    measured: float  #: the figure that was judged; NaN where there is none
    sentence: str  #: what was measured, and what is expected


def _unknown(check: str, place: str, why: str, measured: float = math.nan) -> Check:
    return Check(check, UNKNOWN, place, measured, why)


UNKNOWN_ROBOT = Described()

MIN_SAMPLES = 5  #: Fewer show no rate.
Case = tuple[bool | np.bool_, Level, str]  #: Whether it holds, how plausible a run is then, and why.


def _first(check: str, place: str, measured: float, *cases: Case) -> Check:
    """Return a check by the first case that holds."""
    level, sentence = next((level, sentence) for holds, level, sentence in cases if holds)
    return Check(check, level, place, measured, sentence)


def judge(run: RunLog, robot: Described = UNKNOWN_ROBOT) -> tuple[Check, ...]:
    """Return the verdict on a run in each respect; several of one where several apply.

    Examples
    --------
    An accelerometer in g:

    >>> accel = Stream(0.01 * np.arange(300), np.tile([0.0, 0.0, 1.0], (300, 1)),
    ...                ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2"))
    >>> [check.sentence for check in judge(RunLog("a", "husky", {"imu": accel})) if check.check == "gravity"]
    ['gravity: the mean specific force is 1 m/s^2, 9.81 is expected: an accelerometer in g read as m/s^2?']
    """
    streams = {  # without values that no quantity can have, which one check is about
        name: Stream(s.time_s, np.where(np.abs(s.values) > MAX_MAGNITUDE, np.nan, s.values), s.channels)
        for name, s in run.streams.items()
    }
    known = replace(run, streams=streams)
    checks = [_gravity(known), _turns(known, robot), _speeds(known, robot)]
    for name, stream in run.streams.items():
        checks += [_sampling(name, stream), *check_names(name, stream)]
    if robot.lacking:
        text = f"channels: 'wheels' lacks {', '.join(robot.lacking)}: motion and slip stay unknown"
        checks.append(Check("channels", DOUBTFUL, "wheels", float(len(robot.lacking)), text))
    motion = map(_check_of, motion_findings(known, robot))
    return (*checks, *motion, *_values(run, robot), *_constants(known), _overlap(run), *_pauses(run))


def judge_together(runs: Sequence[tuple[RunLog, Described]]) -> tuple[Check, ...]:
    """Return what is odd about short runs of one robot with the same sensors, taken together."""
    return tuple(map(_check_of, joint_findings(runs)))


def _check_of(found: Finding) -> Check:
    return Check(found.check, (OK, DOUBTFUL, IMPLAUSIBLE)[found.level], *found[2:])


# -- Gravity: what an accelerometer measures on Earth ---------------------------------------------------------

#: Mean specific force over gravity: scale errors of cheap accelerometers are 3 %, and over 6 s of rough driving
#: measured runs reach 0.93 to 1.085.
GRAVITY_RATIO = (0.9, 1.1)
#: Beyond, no driving explains it: the mean acceleration of a run is that of its change of speed.
IMPLAUSIBLE_GRAVITY_RATIO = (0.8, 1.2)
#: Less is an accelerometer without gravity, as some fusing IMUs report it: of use for vibration, not for tilt, so
#: that it is doubtful.
NO_GRAVITY_RATIO = 0.2

#: Least part of the mean specific force along z, a tilt of 26 degrees; measured runs reach 0.97.
UPRIGHT_RATIO = 0.9
TILTED_RATIO = 0.7  #: Less is a tilt of 45 degrees: another axis points up.
MIN_GRAVITY_S = 1.0  #: Over shorter runs a brake is as large as gravity.


def _gravity(run: RunLog) -> Check:
    stream, names = run.streams.get("imu"), [f"accel_{axis}_mps2" for axis in AXES]
    if stream is None or not set(names) <= set(stream.channels):
        return _unknown("gravity", "imu", "gravity: the run has no accelerometer of three axes")
    values = stream.columns(names)
    finite = np.isfinite(values).all(axis=1)
    if finite.sum() < MIN_SAMPLES or np.ptp(stream.time_s[finite]) < MIN_GRAVITY_S:
        return _unknown("gravity", "imu", f"gravity: fewer than {MIN_GRAVITY_S:g} s of the accelerometer")
    mean = values[finite].mean(axis=0)
    size = float(np.linalg.norm(mean))
    ratio, (low, high) = size / GRAVITY_MPS2, IMPLAUSIBLE_GRAVITY_RATIO
    upright = float(mean[2] / size) if size else math.nan
    force = f"gravity: the mean specific force is {size:.3g} m/s^2"
    measured, along = f"{force}, {GRAVITY_MPS2:.3g} is expected", ", ".join(f"{part:.3g}" for part in mean)
    axes = f"gravity: it is ({along}) m/s^2 along x, y and z, mostly along +z is expected"
    cases: list[Case] = [
        (abs(size - 1.0) <= 1.0 - low, IMPLAUSIBLE, f"{measured}: an accelerometer in g read as m/s^2?"),
        (abs(ratio / GRAVITY_MPS2 - 1.0) <= 1.0 - low, IMPLAUSIBLE, f"{measured}: one in m/s^2 read as g?"),
        (ratio < NO_GRAVITY_RATIO, DOUBTFUL, f"{measured}: gravity removed?"),
        (not low <= ratio <= high, IMPLAUSIBLE, f"{measured}: another unit, or a scale?"),
        (upright < -TILTED_RATIO, IMPLAUSIBLE, f"{axes}: z points down?"),
        (upright < TILTED_RATIO, IMPLAUSIBLE, f"{axes}: another axis points up?"),
        (upright < UPRIGHT_RATIO, DOUBTFUL, f"{axes}: a tilted sensor, or a steep slope?"),
        (
            not GRAVITY_RATIO[0] <= ratio <= GRAVITY_RATIO[1],
            DOUBTFUL,
            f"{measured}: a wrong scale, or an offset?",
        ),
    ]
    return _first("gravity", "imu", size, *cases, (True, OK, f"{force}, along z"))


# -- Yaw rate: the gyro beside the turn of a left and a right wheel -------------------------------------------

MAX_SHIFT_S = 1.5  #: Two loggers that were started by hand are apart by up to this on the published runs.
N_SHIFTS = 31
#: Root mean square of the yaw rate, of gyro or wheels, below which offsets are as large as the turns.
MIN_TURN_RADPS = 0.1
#: Cosine of the angle between both signals from which a slope and a sign mean something.  It counts the level of a
#: steady turn, which a correlation does not, and which does not depend on the shift.
MIN_LIKENESS = 0.8

MAX_OTHER_LIKENESS = 0.3  #: A regular to and fro is like both signs at some shift: then none is certain.
#: Yaw rate over that of wheels that do not slip.  Measured runs of four robots reach 0.12 (a Husky on snow) to 1.0;
#: two of 200 dig in and hardly turn (0.03, 0.05), so that less is doubtful and no more.
TURN_RATIO = (0.1, 1.5)
MIN_STUCK_S = 10.0  #: A robot that digs in for seconds is none whose wheels are in another unit.
#: Nothing turns a robot faster than its wheels by so much; degrees make it 20 to 60.
MAX_IMPLAUSIBLE_TURN_RATIO = 8.0


def _turns(run: RunLog, robot: Described) -> Check:
    """Return how the gyro's yaw rate agrees with the turn of a left and a right wheel."""
    about, described = ("yaw rate", "gyro_z_radps"), math.isfinite(robot.track_m)
    try:
        pair = yaw_rate_pair(run, robot.track_m if described else 1.0)
    except DataError:
        return _unknown(*about, "yaw rate: no gyro about z, or no left and right wheel speed")
    if pair is None:
        return _unknown(*about, "yaw rate: too few samples of gyro and wheels together")
    fits = []  # likeness at a shift, slope of the gyro over the wheels, and the larger of both rates
    for shift_s in np.linspace(-MAX_SHIFT_S, MAX_SHIFT_S, N_SHIFTS):
        both = np.column_stack([pair[0].at(pair[0].time_s + shift_s), pair[0].measured])
        there = both[np.isfinite(both[:, 0])]
        power = (there**2).sum(axis=0)
        if len(there) >= max(MIN_YAW_RATES, 0.5 * len(both)) and power.min() > 0.0:
            like, slope = (float(each[0]) for each in agreement(there[:, :1], there[:, 1:]))
            fits.append((like, slope, math.sqrt(power.max() / len(there))))
    if not fits:
        return _unknown(*about, "yaw rate: gyro and wheels hardly overlap")
    likeness, ratio, rate_radps = max(fits, key=lambda fit: abs(fit[0]))
    other = max(-math.copysign(1.0, likeness) * fit[0] for fit in fits)
    alike = f"(likeness {likeness:.2f} of 1)"
    if rate_radps < MIN_TURN_RADPS or abs(likeness) < MIN_LIKENESS or other > MAX_OTHER_LIKENESS:
        return _unknown(*about, f"yaw rate: gyro and wheels show no turns in common {alike}", likeness)
    seconds = run.streams["wheels"].duration_s
    measured = f"yaw rate: the gyro shows {ratio:.3g} rad/s for each m/s between the sides"
    if described:
        measured = f"yaw rate: the gyro shows {ratio:.3g} times the yaw rate of the wheels {alike}"
    low, high = TURN_RATIO
    odd = f"{measured}, {low:g} to {high:g} is expected"
    cases: list[Case] = [
        (likeness < 0.0, IMPLAUSIBLE, f"{odd}: turned sign of the gyro, or sides swapped"),
        (ratio > MAX_IMPLAUSIBLE_TURN_RATIO, IMPLAUSIBLE, f"{odd}: a gyro in deg/s read as rad/s?"),
        (
            ratio < low and seconds > MIN_STUCK_S,
            DOUBTFUL,
            f"{odd}: wheels that dig in, or in rad/s or km/h read as m/s?",
        ),
        (ratio > high, DOUBTFUL, f"{odd}: another track?"),
    ]
    return _first(*about, ratio, *cases, (True, OK, measured))


# -- Wheel speed: what a robot reaches ------------------------------------------------------------------------

#: Of off-road robots without a described top speed; from the first on doubtful, then implausible.
MAX_SPEED_MPS = (12.0, 50.0)
#: Wheel speed over the described top speed: downhill, or with noise, up to 1.1; in km/h 3.6, which another gear may
#: explain; in rad/s 3.3 (a wheel of 0.3 m) to 6.
MAX_OVERSPEED = (1.5, 5.0)

SPEED_QUANTILE = 0.99


def _speeds(run: RunLog, robot: Described) -> Check:
    about, stream, speeds = ("wheel speed", "wheels"), run.streams.get("wheels"), np.empty(0)
    if stream is not None:
        speeds = stream.values[:, [name.startswith("speed_") for name in stream.channels]]
        speeds = np.abs(speeds[np.isfinite(speeds)])
    if not speeds.size:
        return _unknown(*about, "wheel speed: the run has none")
    fast = float(np.quantile(speeds, SPEED_QUANTILE))
    low, high = MAX_SPEED_MPS
    expected = f"up to {low:g} m/s is expected"
    if math.isfinite(robot.speed_max_mps):
        low, high = (factor * robot.speed_max_mps for factor in MAX_OVERSPEED)
        expected = f"the robot's top speed is {robot.speed_max_mps:.3g} m/s"
    measured = f"wheel speed: {fast:.3g} m/s ({SPEED_QUANTILE:.0%} of the samples are slower)"
    odd = f"{measured}, {expected}: rad/s or km/h read as m/s?"
    odd_cases: list[Case] = [(fast > max(low, high), IMPLAUSIBLE, odd), (fast > low, DOUBTFUL, odd)]
    still = (fast == 0.0, UNKNOWN, "wheel speed: the wheels never turn")
    return _first(*about, fast, *odd_cases, still, (True, OK, measured))


# -- Sampling, names, values, constants, overlap --------------------------------------------------------------

#: Of any sensor of a vehicle; milliseconds read as seconds make 10 Hz 0.01 Hz, the reverse 10 kHz.
RATE_HZ = (0.5, 1e4)
#: Of a run: shorter holds nothing to classify, longer than two nights is no single recording.
DURATION_S = (0.5, 2 * 24 * 3600.0)
#: Largest magnitudes, in SI units, that sensors of a vehicle report: gyros to 4000 deg/s, accelerometers to 40 g.
DOUBTFUL_VALUES: dict[str, float] = {"gyro": 70.0, "accel": 400.0, "current": 1000.0, "speed": 50.0}

#: A current may rest at 0, and a quantised speed at one step, throughout a command of 6 s.
MIN_CONSTANT_S = 10.0
#: Common part of the streams over the longest: below the first doubtful, below the second implausible; the published
#: runs reach 0.9.
MIN_OVERLAP_RATIO = (0.5, 0.1)


def _sampling(name: str, stream: Stream) -> Check:
    rate_hz, duration_s = stream.rate_hz, stream.duration_s
    (slowest, fastest), (shortest, longest) = RATE_HZ, DURATION_S
    place, n = f"sampling of stream {name!r}", len(stream)
    rate = f"{place}: {rate_hz:.3g} Hz, {slowest:g} Hz to {fastest / 1e3:g} kHz is expected"
    length = f"{place}: {duration_s:.3g} s long, {shortest:g} s to {longest / 3600:g} h is expected"
    cases: list[Case] = [
        (n < MIN_SAMPLES, UNKNOWN, f"{place}: {n} samples show no rate"),
        (rate_hz < slowest, DOUBTFUL if name in NO_FEATURES else IMPLAUSIBLE, f"{rate}: ms read as s?"),
        (rate_hz > fastest, IMPLAUSIBLE, f"{rate}: s read as ms?"),
        (duration_s < shortest, DOUBTFUL, f"{length}: s read as ms?"),
        (duration_s > longest, DOUBTFUL, f"{length}: ms read as s?"),
        (True, OK, f"{place}: {rate_hz:.3g} Hz over {duration_s:.3g} s"),
    ]
    rated = n < MIN_SAMPLES or not slowest <= rate_hz <= fastest or shortest <= duration_s <= longest
    return _first("sampling", name, rate_hz if rated else duration_s, *cases)


#: Unit of each quantity that features are made of by name.
FEATURE_UNITS: dict[str, str] = {"gyro": "radps", "accel": "mps2", "speed": "mps", "current": "a"}
#: Quantities that logs have and no feature is made of.
OTHER_QUANTITIES = (
    "motor angle roll pitch yaw voltage position velocity quaternion rate std fix confidence torque temperature "
    "wheel steer status force load sinkage slip traction side normal heading power pressure magnetic height tick pulse"
)

AXES = ("x", "y", "z")
#: Similarity (:mod:`difflib`) from which a name is taken for a misspelt one: two letters that changed places in
#: ``gyor`` make 0.75, and no two known quantities are nearer than 0.67.
NEAR = 0.75


def check_names(name: str, stream: Stream) -> list[Check]:
    """Return what is odd about the names of a stream's channels; one ok where nothing is.

    Examples
    --------
    >>> [check] = check_names("imu", Stream([0.0, 1.0], [[0.0], [0.0]], ("gyor_z_radps",)))
    >>> check.sentence
    "channel 'gyor_z_radps' of stream 'imu': no feature is made of 'gyor'; is it 'gyro_z_radps'?"
    """
    if name in NO_FEATURES or name in ("estimator", "slip"):
        sound = f"stream {name!r}: no feature is made of its channels by name"
        return [Check("channel names", OK, name, math.nan, sound)]
    known, checks = (*FEATURE_UNITS, *OTHER_QUANTITIES.split()), []
    for channel in stream.channels:
        quantity, _, rest = channel.partition("_")
        place = f"channel {channel!r} of stream {name!r}"
        near = (
            "" if quantity in known else next(iter(difflib.get_close_matches(quantity, known, 1, NEAR)), "")
        )
        other = f"{place}: no feature is made of {quantity!r}"
        meant = f"{other}; is it {f'{near}_{rest}'!r}?"
        unit, expected, fault = "", FEATURE_UNITS.get(quantity, ""), ""
        features = signal_set_of(name, channel) is not None and bool(expected)
        if features:
            try:
                unit = unit_of(channel)
            except LogError as error:
                fault = str(error)
        of_imu, axis = quantity in IMU_QUANTITIES, rest.rpartition("_")[0]
        wrong = f"{place}: {quantity} is in {unit!r}, {expected!r} is expected (a name ends in its unit)"
        no_axis = f"{place}: {axis!r} is no axis, one of {', '.join(AXES)} is expected"
        cases: list[Case] = [
            (near in FEATURE_UNITS, IMPLAUSIBLE, meant),
            (bool(near), DOUBTFUL, meant),
            (quantity not in known, DOUBTFUL, f"{other} (features are made of {', '.join(FEATURE_UNITS)})"),
            (bool(fault), DOUBTFUL, fault),
            (features and unit != expected, IMPLAUSIBLE if of_imu else DOUBTFUL, wrong),
            (features and of_imu and axis not in AXES, DOUBTFUL, no_axis),
        ]
        checks.append(_first("channel names", channel, math.nan, *cases, (True, OK, "")))
    odd = [check for check in checks if check.level is not OK]
    sound = f"stream {name!r}: all quantities are known"
    return odd or [Check("channel names", OK, name, math.nan, sound)]


def _values(run: RunLog, robot: Described) -> list[Check]:
    checks = []
    for name, stream in run.streams.items():
        largest = np.nanmax(np.abs(stream.values), axis=0, initial=0.0)
        for channel, value in zip(stream.channels, largest.tolist(), strict=True):
            place = f"channel {channel!r} of stream {name!r}: reaches"
            most = DOUBTFUL_VALUES.get(channel.partition("_")[0], math.inf)
            if channel.startswith("current_") and math.isfinite(robot.current_max_a):
                most = math.inf  # that of its motors is compared
            much = value > most and signal_set_of(name, channel) is not None
            cases = (
                (value > MAX_MAGNITUDE, IMPLAUSIBLE, f"{place} {value:.6g}; {BEYOND}"),
                (much, DOUBTFUL, f"{place} {value:.4g} in its SI unit, up to {most:g} is expected"),
                (True, OK, ""),
            )
            checks.append(_first("values", channel, value, *cases))
    sound = Check("values", OK, "all", math.nan, "values: all are such as sensors of a vehicle report")
    return [check for check in checks if check.level is not OK] or [sound]


def _constants(run: RunLog) -> list[Check]:
    """Return channels that are constant while another one of their signals varies, or the wheels turn."""
    still: dict[tuple[str, str, str], bool] = {}
    for name, stream in run.streams.items():
        if len(stream) < STUCK_IMU_SAMPLES:
            continue
        for channel, values in zip(stream.channels, stream.values.T, strict=True):
            signals = signal_set_of(name, channel)
            if signals == "imu" or (
                signals in ("wheels", "currents") and stream.duration_s >= MIN_CONSTANT_S
            ):
                finite = values[np.isfinite(values)]
                still[name, channel, str(signals)] = not finite.size or not np.ptp(finite)
    varying = {(name, signals) for (name, _, signals), constant in still.items() if not constant}
    turning = any(signals == "wheels" for _, signals in varying)
    checks = []
    for (name, channel, signals), constant in still.items():
        if constant and ((name, signals) in varying or (turning and signals == "imu")):
            value = float(run.streams[name].channel(channel)[0])
            is_still = f"channel {channel!r} of stream {name!r}: is {value:.4g} throughout"
            why = f"{is_still}; a sensor that works varies"
            checks.append(Check("constant channels", DOUBTFUL, channel, value, why))
    what = "none is" if varying else "there is none to judge"
    level = OK if varying else UNKNOWN
    return checks or [Check("constant channels", level, "all", math.nan, f"constant channels: {what}")]


def _overlap(run: RunLog) -> Check:
    streams = {name: stream for name, stream in run.streams.items() if name not in NO_FEATURES}
    for name, other in run.streams.items():
        if (
            streams
            and name in NO_FEATURES
            and not any(
                other.time_s[0] <= stream.time_s[-1] and stream.time_s[0] <= other.time_s[-1]
                for stream in streams.values()
            )
        ):
            text = f"overlap: stream {name!r} is at no time at which {', '.join(streams)} are: clocks apart?"
            return Check("overlap", DOUBTFUL, name, 0.0, text)
    longest_s = max((stream.duration_s for stream in streams.values()), default=0.0)
    if len(streams) < 2:
        return _unknown("overlap", "all", "overlap: there is one stream of sensors")
    if not longest_s > 0.0:
        return _unknown("overlap", "all", "overlap: the streams have no duration")
    start_s = max(stream.time_s[0] for stream in streams.values())
    end_s = min(stream.time_s[-1] for stream in streams.values())
    ratio = max(float(end_s - start_s), 0.0) / longest_s
    measured = f"overlap: {100 * ratio:.0f} % of the longest stream lie in all ({', '.join(streams)})"
    doubtful, implausible = MIN_OVERLAP_RATIO
    expected = f"{measured}, {100 * doubtful:.0f} % is expected"
    odd = f"{expected}: other units of time, or loggers that were started apart?"
    odd_cases: list[Case] = [(ratio < implausible, IMPLAUSIBLE, odd), (ratio < doubtful, DOUBTFUL, odd)]
    return _first("overlap", "all", ratio, *odd_cases, (True, OK, measured))


MAX_PAUSE_S = 300.0  #: A longer one in all sensors is between two runs.


def _pauses(run: RunLog) -> list[Check]:
    time_s = np.sort(np.concatenate([stream.time_s for stream in run.streams.values()] or [np.zeros(1)]))
    longest_s = float(np.max(np.diff(time_s), initial=0.0))
    if longest_s < MAX_PAUSE_S:
        return []
    text = (
        f"sampling: no stream has a sample for {longest_s:.0f} s: two runs in one, or a clock that was set?"
    )
    return [Check("sampling", DOUBTFUL, "all", longest_s, text)]


# -- Sentences on many runs -----------------------------------------------------------------------------------

MAX_NAMED = 3  #: A sentence that concerns many runs is written for so many, and counted for the others.


def worst(checks: Sequence[Check]) -> Level:
    """Return the worst level; unknown where none is known.

    Examples
    --------
    >>> worst([Check("gravity", Level.OK, "imu", 9.8, ""), Check("yaw rate", Level.UNKNOWN, "imu", 0.0, "")])
    <Level.OK: 'ok'>
    """
    order = (UNKNOWN, OK, DOUBTFUL, IMPLAUSIBLE)
    return max((check.level for check in checks), key=order.index, default=UNKNOWN)


class Doubt(NamedTuple):
    """A check of a run that is doubtful or implausible."""

    run_id: str
    check: Check


def doubts_of(verdicts: Mapping[str, Sequence[Check]]) -> tuple[Doubt, ...]:
    """Return what is doubtful or implausible in the checks of runs, by their id."""
    doubts = (Doubt(run_id, check) for run_id, checks in verdicts.items() for check in checks)
    return tuple(doubt for doubt in doubts if doubt.check.level in (DOUBTFUL, IMPLAUSIBLE))


def refuse_implausible_runs(doubts: Sequence[Doubt], accepted: Mapping[str, Container[str]]) -> None:
    """Raise :class:`LogError` with the first implausible check, and how many there are.

    ``accepted`` has by run what was counted when it was read with ``--repair``: that was decided, and is only stated.
    """
    found = [
        doubt
        for doubt in doubts
        if doubt.check.level == IMPLAUSIBLE and _kind(doubt.check) not in accepted.get(doubt.run_id, ())
    ]
    if not found:
        return
    runs = len({doubt.run_id for doubt in found})
    more = f" ({len(found)} such findings in {runs} run{'s' * (runs > 1)})" if len(found) > 1 else ""
    raise LogError(
        f"{found[0].run_id}: implausible {found[0].check.sentence}{more} (mend it where it is "
        "read, by a mapping, say, or take it as it is, and counted, with --repair)"
    )


def _kind(check: Check) -> str:
    return f"implausible {check.check}"


def counted(run: RunLog, checks: Sequence[Check]) -> RunLog:
    """Return a run that states among what was dropped or changed which checks it does not pass."""
    odd = Counter(_kind(check) for check in checks if check.level == IMPLAUSIBLE)
    new = {kind: n for kind, n in odd.items() if kind not in run.dropped}
    return replace(run, dropped=dict(run.dropped) | new) if new else run


def doubt_sentences(doubts: Sequence[Doubt]) -> Iterator[str]:
    """Yield a sentence a doubt; where one check concerns many runs, some of them and their number."""
    seen: Counter[tuple[str, str, Level]] = Counter()
    for run_id, check in doubts:
        kind = (check.check, check.place, check.level)
        seen[kind] += 1
        if seen[kind] <= MAX_NAMED:
            yield f"{run_id}: {check.level} {check.sentence}"
    for (name, place, level), n in seen.items():
        if n > MAX_NAMED:
            yield f"{n - MAX_NAMED} more runs: {level} {name} ({place})"
