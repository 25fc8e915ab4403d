"""Whether the sensors of a run that see its motion agree: in unit, sign, axes and scale.

Speeds and turns of a robot are seen by several sensors: wheels, gyro, a lidar or camera, poses, satellites, a compass.
Each becomes the mean of a second on one grid: the change of an angle or a position over that second, or of the integral
of a rate or a speed, so that sensors of any rate compare.  Two clocks may be apart (:data:`SHIFTS_S`).

**Speeds.**  A unit is one factor at every moment, slip is not: a factor is stated where nine of ten points are beyond
what is expected, and of wheels that are faster than the ground where it is the same while their speed varies.

**Turns.**  Velocities of a course are those that speed and integrated yaw rate give, rotated by an unknown angle; with
x and y exchanged they are their mirror image.  As complex numbers p and g, ``|sum(conj(p) g)|`` and ``|sum(p g)|`` over
stretches of up to a minute, in which the gyro drifts little, tell one from the other.  No yaw angle is needed.

**Clocks.**  What is as alike as it can be only seconds apart was stamped by clocks that are apart, or came late.

**Who is wrong.**  Of three sensors the one is named that two others contradict; of two the second.

What certainly is a mistake is a turned sign of what otherwise agrees, or a factor beyond :data:`IMPLAUSIBLE_RATIO`,
which degrees (57.3), km/h (3.6) and mm (1000) are; knots (1.94) and slip are within, and doubtful.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.logs.schema import TWIST
from terrain.records import Array, RunLog, Stream
from terrain.signals import agreement

STEP_S = 0.2
MEAN_S = 1.0  #: Changes of positions and angles are over this: noise of a receiver of 2 cm is then 3 cm/s
MIN_POINTS = 15
SHIFTS_S = np.linspace(-1.4, 1.4, 15)
MIN_SPEED_MPS = 0.05  #: Root mean square below which noise is as large as the motion
MIN_TURN_RADPS = 0.1
#: Cosine of the angle between two signals, from which their ratio and its sign mean something; of speeds, which are all
#: positive, the correlation.
MIN_LIKENESS = 0.8
MAX_OTHER_LIKENESS = 0.3  #: A regular to and fro is like both signs at some shift: then none is certain
DOUBTFUL_RATIO = 1.5
SLIP_RATIO = 1.8  #: Of wheels over ground; a diameter for a radius is 2.
DOUBTFUL_TURN_RATIO = 2.0  #: Scans that were matched in turns are off by more than positions.
IMPLAUSIBLE_RATIO = 3.0
#: A factor that is the same at nine of ten points within this, at speeds that differ by more, is one of units.
ONE_FACTOR, MIN_SPEED_RATIO = 1.45, 1.5
MAX_STEADY_FACTOR = 7.0  #: Wheels that spin steadily are faster by more than km/h and rad/s make them
#: Accelerations over those of wheels: they slip by any part, so that less than so much is doubtful, and no more.
LEAST_OF_WHEELS = 0.3
MIN_TURN_CHANGE_RADPS = (
    0.01  #: Standard deviation of a yaw rate from which its changes tell a sign, whatever the bias
)
COURSE_POINTS = (150, 300)  #: Half a minute, of courses whose turns are many, and a minute
#: A mirror explains at least so much of a course, and so much more of it than a rotation, and so many deviations.
MIN_MIRROR, MIN_OVER_ROTATION, MIN_SIGMAS = 0.7, 0.01, 5.0
MEAN_POINTS = round(1.0 / 0.2)  #: that share a mean of a second
GOES_ON = 0.8  #: Distance over path in five seconds, of a robot that drives; noise has 0.4.
#: Clocks that are further apart than SHIFTS_S are looked for by this, and found where signals are this alike there.
FAR_SHIFTS_S, MIN_FAR_LIKENESS, MIN_FAR_GAIN = np.arange(-12.0, 12.1, 0.2), 0.9, 0.2
#: Part of the power of the velocity along the body's x axis, of a robot that cannot drive sideways.
MIN_AHEAD = (0.5, 0.1)
RECEIVER_RATIO = 1.25  #: Of a receiver's positions and speeds, which do not slip.
STILL_M = 5e-4  #: No receiver's positions stay within this for seconds, the robot's being stuck or not.
MIN_DRIVEN_M = 2.0
STEERING_RATE_RADPS = 20.0  #: No steering is faster.
MAX_STD_OF_FIX_M = 1.0
#: Part of the speeds of steered wheels that no twist explains, from which, and over that of turned angles beyond which,
#: the sign of the steering is turned: sound wheels that slip contradict each other by 0.02.
CONTRADICTION, OVER_TURNED = 0.05, 3.0
#: Ahead, beyond what an IMU that is mounted askew shows; part of the points
MIN_FORCE_MPS2, MOSTLY = 0.3, 0.9
MIN_ACCELERATION_MPS2 = 0.15
MIN_TILT_RATE_RADPS = 0.003  #: Means of a second; noise of both is less
MIN_TILT_RAD = 0.02  #: Less is that of a floor, and of offsets.
MIN_CERTAIN_POINTS = (
    50  #: A run of 10 s; of a shorter one, noise and a shift of clocks may look like a mistake
)
WHEELS, ACCELEROMETER = "the wheels", "the accelerometer"
SIDES = "the turn of the wheels"  #: Of a robot that turns by them, which skids.
#: Factors of usual mistakes.
SPEED_FACTORS: Mapping[str, float] = {"km/h": 3.6, "cm": 100.0, "mm": 1000.0}
GNSS_FACTORS: Mapping[str, float] = {"knots": 1.9438}
TURN_FACTORS: Mapping[str, float] = {"degrees": 57.2958, "rpm": 9.5493}
UNNAMED = "another unit, or scale?"
WITHIN = 1.15  #: A ratio is that of a mistake within this factor: slip and scales are on top


class Described(NamedTuple):
    """What is known of the robot of a run: NaN, infinite or None where nothing is."""

    track_m: float = math.nan
    speed_max_mps: float = math.inf
    twist: Stream | None = None  #: of the body by its wheels, as if they rolled without slip
    sideways: bool | None = None  #: whether it can drive sideways
    wheel_radius_m: float = math.nan
    reduction_ratio: float = math.nan
    length_m: float = math.nan  #: the larger of track and wheelbase
    front_driven: bool = False  #: whether the steered wheel drives, which may turn beyond a right angle
    steering_rate_max_radps: float = math.nan
    current_max_a: float = math.inf
    lacking: tuple[str, ...] = ()  #: channels of its wheels that the run has not, beside some that it has
    #: part of the speeds of steered wheels that no twist of the body explains: as logged, and with angles turned
    contradiction: tuple[float, float] = (math.nan, math.nan)


class Finding(NamedTuple):
    """What two sensors, or one, show: how bad it is (0 sound, 1 doubtful, 2 implausible, -1 unknown)."""

    check: str
    level: int
    place: str
    measured: float
    sentence: str


class Seen(NamedTuple):
    """A motion as a source sees it, on the grid of the run; NaN where it does not."""

    name: str
    velocity_mps: Array | None = (
        None  #: (n, 2), along the body's axes or in a fixed frame, or (n, 3) in a camera's
    )
    in_body: bool = False
    yaw_rate_radps: Array | None = None  #: (n,)
    course_mps: Array | None = None  #: (n, 2) in a fixed frame
    acceleration_mps2: Array | None = None  #: (n, 1 or 2) ahead, and to the left, with what gravity adds


def motion_findings(run: RunLog, robot: Described) -> list[Finding]:
    """Return what the sensors of a run that see its motion show of each other.

    Examples
    --------
    A camera in km/h beside wheels in m/s:

    >>> t = np.arange(0.0, 30.0, 0.1)
    >>> v = np.column_stack([0.5 + 0.4 * np.sin(t), 0.0 * t, 0.0 * t])
    >>> camera = Stream(t, 3.6 * v, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    >>> run = RunLog("a", "husky", {"odometry": camera})
    >>> [found.sentence for found in motion_findings(run, Described(twist=Stream(t, v, camera.channels)))
    ...  if found.level == 2]
    ['speed: that of odometry is 3.6 times that of the wheels, 0.67 to 1.5 is expected: km/h?']
    """
    grid_s = _grid(run)
    if len(grid_s) < MIN_POINTS:
        return []
    sources = _sources(run, robot, grid_s)
    return [
        *_compared(sources, robot),
        *_clocks(sources),
        *_still_positions(run, sources),
        *_attitude(run, grid_s),
        *_tilt_rates(run, grid_s),
        *_steering(run, robot, grid_s),
        *_receiver(run),
        *_currents(run, robot),
        *_efforts(run, sources, grid_s),
    ]


def joint_findings(runs: Sequence[tuple[RunLog, Described]]) -> list[Finding]:
    """Return what short runs of one robot with the same sensors show together, as if they were one; odd ones only.

    A command of 6 s shows neither a ratio nor a sign for certain; a hundred of them do.
    """
    parts = [_sources(run, robot, grid_s) for run, robot in runs if len(grid_s := _grid(run)) >= MIN_POINTS]
    if len(parts) < 2:
        return []
    names = [seen.name for seen in parts[0]]
    parts = [sources for sources in parts if [seen.name for seen in sources] == names]
    apart = max(map(abs, SHIFTS_S.tolist())) / STEP_S  # no shift compares one run with the next

    def joined(k: int, field: str) -> Array | None:
        values = [getattr(sources[k], field) for sources in parts]
        if any(each is None for each in values):
            return None
        gap = np.full((math.ceil(apart) + 1, *values[0].shape[1:]), np.nan)
        return np.concatenate([rows for each in values for rows in (each, gap)])

    sources = [
        Seen(
            seen.name,
            joined(k, "velocity_mps"),
            seen.in_body,
            joined(k, "yaw_rate_radps"),
            joined(k, "course_mps"),
            joined(k, "acceleration_mps2"),
        )
        for k, seen in enumerate(parts[0])
    ]
    over = f"over {len(parts)} runs, "
    found = _compared(sources, runs[0][1])
    return [each._replace(sentence=over + each.sentence) for each in found if each.level > 0]


def is_short(run: RunLog) -> bool:
    """Return whether a run is too short to be judged by itself in what compares two sensors."""
    return len(_grid(run)) < 2 * MIN_CERTAIN_POINTS


def _compared(sources: Sequence[Seen], robot: Described) -> list[Finding]:
    pairs = _speeds(sources, robot), _yaw_rates(sources, robot), _directions(sources, robot)
    others = _reversed_side(sources), _receivers_axes(sources), _acceleration(sources)
    return [found for each in (*pairs, *others) for found in each]


# -- What each sensor shows, a mean of a second ---------------------------------------------------------------


def _grid(run: RunLog) -> Array:
    if not run.streams:
        return np.empty(0)
    start_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    end_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    n = int(min((end_s - start_s) / STEP_S, 50_000))
    return start_s + STEP_S * np.arange(1, max(n, 1))


def _integral(time_s: Array, values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.diff(time_s) * 0.5 * (values[1:] + values[:-1]))])


def _change(time_s: Array, values: Array, grid_s: Array, *, of_rate: bool) -> Array:
    """Return the mean rate (n,) over a second about each instant; NaN at gaps and beyond the ends."""
    known = np.isfinite(values)
    t, x = time_s[known], values[known]
    if len(t) < MIN_POINTS:
        return np.full(len(grid_s), np.nan)
    x = _integral(t, x) if of_rate else x
    before_s, after_s = grid_s - MEAN_S / 2, grid_s + MEAN_S / 2
    rate = (np.interp(after_s, t, x) - np.interp(before_s, t, x)) / MEAN_S
    there = (before_s >= t[0]) & (after_s <= t[-1])
    first, last = np.searchsorted(t, before_s, "right") - 1, np.searchsorted(t, after_s, "left")
    widest_s = np.diff(t)
    gaps = np.concatenate([[0], np.cumsum(widest_s > max(2.0 * MEAN_S, 3.0 * float(np.median(widest_s))))])
    n = len(t) - 1
    there &= gaps[np.clip(last, 0, n)] == gaps[np.clip(first, 0, n)]
    return np.where(there, rate, np.nan)


def _angle_rate(time_s: Array, angle: Array, grid_s: Array) -> Array:
    """Return the rate of an angle, in its own unit; a jump by a turn of rad or of degrees is none."""
    known = np.isfinite(angle)
    if not known.any():
        return np.full(len(grid_s), np.nan)
    t, step = time_s[known], np.diff(angle[known])
    for turn in (2.0 * np.pi, 360.0):
        wrap = np.abs(np.abs(step) - turn) < 0.2 * turn
        step = np.where(wrap, step - np.sign(step) * turn, step)
    return _change(t, np.concatenate([[0.0], np.cumsum(step)]), grid_s, of_rate=False)


def _plane(stream: Stream, names: Sequence[str], grid_s: Array, *, of_rate: bool) -> Array | None:
    if not set(names) <= set(stream.channels):
        return None
    return np.column_stack(
        [_change(stream.time_s, stream.channel(name), grid_s, of_rate=of_rate) for name in names]
    )


def _to_body(velocity_mps: Array, time_s: Array, yaw_rad: Array, grid_s: Array) -> Array:
    """Return velocities (n, 2) of a fixed frame along the axes of a body of this yaw."""
    known = np.isfinite(yaw_rad)
    if not known.any():
        return np.full_like(velocity_mps, np.nan)
    cos, sin = (np.interp(grid_s, time_s[known], each(yaw_rad[known])) for each in (np.cos, np.sin))
    x, y = velocity_mps.T
    return (
        np.column_stack([cos * x + sin * y, cos * y - sin * x]) / np.maximum(np.hypot(cos, sin), 0.1)[:, None]
    )


SPEEDS, VELOCITIES = ("speed_x_mps", "speed_y_mps"), ("velocity_x_mps", "velocity_y_mps")
POSITIONS = ("position_x_m", "position_y_m")


def _sources(run: RunLog, robot: Described, grid_s: Array) -> list[Seen]:
    sources = []
    turn: Array | None
    if (twist := robot.twist) is not None:
        sides = "wheels" in run.streams and "speed_left_mps" in run.streams["wheels"].channels
        turn = _change(twist.time_s, twist.channel(TWIST[2]), grid_s, of_rate=True)
        ahead = _change(twist.time_s, twist.channel(TWIST[0]), grid_s, of_rate=False)[:, None]
        velocity = _plane(twist, SPEEDS, grid_s, of_rate=True)
        sources.append(Seen(WHEELS, velocity, True, None if sides else turn, None, ahead))
        if sides:
            sources.append(Seen(SIDES, yaw_rate_radps=turn))
    for name in ("lidar", "odometry", "pose", "gnss", "imu", "compass"):
        stream = run.streams.get(name)
        if stream is None:
            continue
        has, t = set(stream.channels), stream.time_s
        turn = None
        if rate := next((each for each in ("gyro_z_radps", "yaw_rate_radps") if each in has), ""):
            turn = _change(t, stream.channel(rate), grid_s, of_rate=True)
        if name == "imu" and turn is not None:
            sources.insert(0, Seen("the gyro", yaw_rate_radps=turn))
            turn = None
        if (
            name == "imu"
            and (force := _plane(stream, ("accel_x_mps2", "accel_y_mps2"), grid_s, of_rate=True)) is not None
        ):
            sources.append(Seen(ACCELEROMETER, acceleration_mps2=force))
        if "yaw_rad" in has:
            turn = _angle_rate(t, stream.channel("yaw_rad"), grid_s)
        body = _plane(stream, SPEEDS, grid_s, of_rate=True)
        if body is not None or turn is not None:
            sources.append(Seen(name if name != "imu" else "the yaw of imu", body, True, turn))
        if name == "odometry":  # in a camera's own frame, which is not flat
            three = [f"velocity_{axis}_mps" for axis in "xyz"]
            if (velocity := _plane(stream, three, grid_s, of_rate=True)) is not None:
                sources.append(Seen("odometry", velocity))
            continue
        for words, names, of_rate in (("velocity", VELOCITIES, True), ("position", POSITIONS, False)):
            velocity = _plane(stream, names, grid_s, of_rate=of_rate)
            if velocity is not None:
                course = velocity
                if in_body := name == "pose" and "yaw_rad" in has:
                    velocity = _to_body(velocity, t, stream.channel("yaw_rad"), grid_s)
                elif (
                    name == "gnss"
                    and "compass" in run.streams
                    and "yaw_rad" in run.streams["compass"].channels
                ):
                    compass, in_body = run.streams["compass"], True
                    velocity = _to_body(velocity, compass.time_s, compass.channel("yaw_rad"), grid_s)
                one = name == "pose" or not set(VELOCITIES) <= has
                sources.append(
                    Seen(name if one else f"the {words} of {name}", velocity, in_body, None, course)
                )
    return sources


# -- Comparison -----------------------------------------------------------------------------------------------


class Likeness(NamedTuple):
    """How two signals compare at the shift at which they are most alike."""

    cosine: float = 0.0  #: of the angle between them
    ratio: float = math.nan  #: of their root mean squares, measured over reference
    other: float = 0.0  #: the best cosine of the other sign
    least: float = 0.0  #: the smaller of both root mean squares
    most: float = 0.0  #: the larger
    n: int = 0
    shift: int = 0  #: steps by which the measured one is later

    @property
    def is_known(self) -> bool:
        """Whether ratio and sign mean something."""
        return abs(self.cosine) >= MIN_LIKENESS and self.other <= MAX_OTHER_LIKENESS


def _shifted(measured: Array, reference: Array, shift: int) -> tuple[Array, Array]:
    return (
        measured[max(shift, 0) : len(measured) + min(shift, 0)],
        reference[max(-shift, 0) : len(reference) + min(-shift, 0)],
    )


def _compare(
    measured: Array, reference: Array, shifts_s: Array = SHIFTS_S, *, about_mean: bool = False
) -> Likeness:
    """Compare signals (n, c) at some shifts; all columns count as one."""
    fits = []
    for shift in np.round(shifts_s / STEP_S).astype(int).tolist():
        if abs(shift) >= len(measured):
            continue
        a, b = _shifted(measured, reference, shift)
        both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        if (n := int(both.sum())) < MIN_POINTS:
            continue
        m, r = a[both], b[both]
        of_m, of_r = (math.sqrt(float((each**2).sum()) / n) for each in (m, r))
        if about_mean:
            m, r = m - m.mean(axis=0), r - r.mean(axis=0)
        cosine = float(agreement(m.reshape(-1, 1), r.reshape(-1, 1))[0][0])
        fits.append(
            Likeness(
                cosine, of_m / of_r if of_r else math.inf, 0.0, min(of_m, of_r), max(of_m, of_r), n, shift
            )
        )
    if not fits:
        return Likeness()
    best = max(fits, key=lambda fit: abs(fit.cosine))
    return best._replace(other=max(-math.copysign(1.0, best.cosine) * fit.cosine for fit in fits))


def mistake(ratio: float, factors: Mapping[str, float]) -> str:
    """Return which mistake a ratio of two measurements of one thing comes from, as a question.

    Examples
    --------
    >>> mistake(3.5, SPEED_FACTORS), mistake(1 / 60, TURN_FACTORS), mistake(7.0, TURN_FACTORS)
    ('km/h?', 'degrees?', 'another unit, or scale?')
    """
    factor = max(ratio, 1.0 / ratio) if ratio > 0.0 else math.inf
    near = min(factors, key=lambda name: abs(math.log(factor / factors[name])))
    return f"{near}?" if 1.0 / WITHIN < factor / factors[near] < WITHIN else UNNAMED


def _level(n: int, odd: bool | np.bool_, beyond: bool | np.bool_) -> int:
    """Return how bad a comparison of n points is; of few points what is beyond all is doubtful, and no more."""
    return int(odd) + int(odd and beyond) if n >= MIN_CERTAIN_POINTS else int(odd and beyond)


def _speeds(sources: Sequence[Seen], robot: Described) -> list[Finding]:
    """Compare the speeds of sources with that of the one in the middle, where the robot goes rather than turns."""
    speed = {
        each.name: np.linalg.norm(each.velocity_mps, axis=1)
        for each in sources
        if each.velocity_mps is not None
    }
    level = {}
    for name, values in speed.items():
        known = values[np.isfinite(values)]
        level[name] = math.sqrt(float(np.mean(known**2))) if len(known) >= MIN_POINTS else math.nan
    ranked = sorted((name for name in level if level[name] >= 0.0), key=lambda name: level[name])
    if len(ranked) < 2:
        return []
    # of two the wheels are the reference; of more the one in the middle, or the one beside it where that is the wheels
    middle = WHEELS if len(ranked) == 2 and WHEELS in ranked else ranked[(len(ranked) - 1) // 2]
    if middle == WHEELS and len(ranked) > 2 and len(ranked) % 2 == 0:
        middle = ranked[len(ranked) // 2]
    factors = dict(SPEED_FACTORS)
    if robot.wheel_radius_m > 0.0:
        factors["wheels in rad/s"] = 1.0 / robot.wheel_radius_m
    if robot.reduction_ratio > 1.0:
        factors["rates before or after the reduction"] = robot.reduction_ratio
    found = []
    for name, values in speed.items():
        if name == middle or name not in ranked:
            continue
        # beside wheels, whose unit may be wrong, what measures the ground says how fast the robot goes
        slow = (
            speed[middle]
            if name == WHEELS
            else values
            if middle == WHEELS
            else np.minimum(values, speed[middle])
        )
        goes = _turn_speed(sources, robot) < 0.5 * slow
        pair = [np.where(goes, each, np.nan) for each in (values, speed[middle])]
        by = _compare(pair[0][:, None], pair[1][:, None], about_mean=True)
        factor = _factor(*_shifted(pair[0], pair[1], by.shift), MIN_SPEED_MPS)
        n, ratio = factor.n, factor.ratio
        if n < MIN_POINTS or not 0.0 < ratio < math.inf:
            continue
        of = f"speed: that of {name} is {ratio:.3g} times that of {middle}"
        mistakes = factors | dict(GNSS_FACTORS if "gnss" in (name + middle) else {})
        slips = (middle == WHEELS and ratio < 1.0) or (name == WHEELS and ratio > 1.0)
        why = "wheels that slip, or " * slips + mistake(ratio, mistakes)
        low, high = 1.0 / DOUBTFUL_RATIO, DOUBTFUL_RATIO
        if slips:  # by a third is usual
            low, high = min(low, 1.0 / SLIP_RATIO), max(high, SLIP_RATIO)
        odd = f"{of}, {low:.2g} to {high:.2g} is expected: {why}"
        differs = factor.most < low or factor.least > high
        beyond = factor.most < 1.0 / IMPLAUSIBLE_RATIO or factor.least > IMPLAUSIBLE_RATIO
        if slips:
            named = max(ratio, 1.0 / ratio) < MAX_STEADY_FACTOR and not why.endswith(UNNAMED)
            differs, beyond = differs and factor.is_one and (factor.varies or named), False
        judged = _level(n, differs, beyond)
        if by.cosine < MIN_LIKENESS:  # of two steady speeds; noise of a receiver at rest is a speed, too
            noisy = n < MIN_CERTAIN_POINTS or not all(
                _goes_on(each.velocity_mps)
                for each in sources
                if each.velocity_mps is not None and "gnss" in each.name and each.name in (name, middle)
            )
            judged = 0 if noisy else min(judged, 1)
        place = WHEELS if WHEELS in (name, middle) and len(ranked) == 2 else name
        found.append(Finding("speed", judged, place, ratio, odd if judged else of))
    return found


class Factor(NamedTuple):
    """The factor between two signals at points at which there is motion: at one in ten, one in two, nine in ten."""

    least: float = math.nan
    ratio: float = math.nan
    most: float = math.nan
    n: int = 0
    is_one: bool = False  #: whether it is the same at nearly all points,
    varies: bool = False  #: and the signals vary meanwhile, as slip would with them


def _factor(measured: Array, reference: Array, least_motion: float) -> Factor:
    """Compare signals (n,) where the reference moves, or the measured one where it never does."""
    a, b = np.abs(measured), np.abs(reference)
    known = np.isfinite(a + b)
    if known.sum() < MIN_POINTS:
        return Factor()
    moving = b if np.quantile(b[known], 0.9) >= least_motion else a
    moves = known & (moving > max(least_motion, 0.3 * float(np.quantile(moving[known], 0.9))))
    if moves.sum() < MIN_POINTS:
        return Factor()
    with np.errstate(divide="ignore"):
        least, ratio, most = np.quantile(a[moves] / b[moves], [0.1, 0.5, 0.9], method="nearest").tolist()
    slow, fast = np.quantile(moving[moves], [0.1, 0.9])
    is_one, varies = most < ONE_FACTOR * least, bool(fast > MIN_SPEED_RATIO * slow)
    return Factor(least, ratio, most, int(moves.sum()), is_one, varies)


def _goes_on(velocity_mps: Array) -> bool:
    """Return whether velocities (n, 2) keep their direction for some seconds, which noise does not."""
    known = velocity_mps[np.isfinite(velocity_mps).all(axis=1)]
    sums = np.add.reduceat(
        np.column_stack([known, np.hypot(*known.T)]), np.arange(0, len(known), 5 * MEAN_POINTS)
    )
    return bool(np.median(np.hypot(*sums.T[:2]) / np.maximum(sums[:, 2], 1e-9)) > GOES_ON)


def _turn_speed(sources: Sequence[Seen], robot: Described) -> Array:
    """Return the speed (n,) that the ends of the robot have by its turning alone; 0 where no turn is seen."""
    rates = [
        each.yaw_rate_radps for each in sources if each.yaw_rate_radps is not None and each.name != SIDES
    ]
    if not rates:
        return np.zeros(1)
    length_m = robot.length_m if math.isfinite(robot.length_m) else 1.0
    return np.asarray(length_m * np.abs(np.nan_to_num(np.column_stack(rates))).min(axis=1))


def _yaw_rates(sources: Sequence[Seen], robot: Described) -> list[Finding]:
    """Compare the yaw rates of sources, and the turns of courses, with the first: the gyro's where there is one."""
    turning = [each for each in sources if each.yaw_rate_radps is not None and each.name != SIDES]
    reference = next((each for each in turning if each.name != WHEELS), None)
    if reference is None or reference.yaw_rate_radps is None:
        return []
    rate = reference.yaw_rate_radps
    judged: list[tuple[Seen, float, int]] = []
    for seen in sources:
        if seen is reference or seen.name == SIDES:
            continue
        if seen.course_mps is not None:
            judged += [(seen, sign, n) for sign, n in _turn_of_course(seen.course_mps, rate, sources, robot)]
        if seen.yaw_rate_radps is None or _apart(seen.yaw_rate_radps, rate):
            continue
        by = _compare(seen.yaw_rate_radps[:, None], rate[:, None])
        changes = _compare_changes(seen.yaw_rate_radps, rate)
        if is_certain := changes.is_known and changes.least >= MIN_TURN_CHANGE_RADPS:
            by = changes
        larger = by.most if by.is_known else 0.0
        # a sign is that of two turns, not of a turn and what a robot that does not mean to turn shows, as wheels do
        both = is_certain or by.least >= MIN_TURN_RADPS / 2
        if not (is_certain or larger >= MIN_TURN_RADPS) or not (
            both or (by.cosine > 0.0 and seen.name != WHEELS)
        ):
            continue
        pair = _shifted(seen.yaw_rate_radps, rate, by.shift)
        slips = seen.name == WHEELS and by.cosine > 0.0 and by.ratio > IMPLAUSIBLE_RATIO
        slipped = _factor(*pair, MIN_TURN_CHANGE_RADPS)
        if slips and (robot.sideways or not (slipped.is_one and slipped.varies)):
            continue
        judged.append((seen, math.copysign(by.ratio, by.cosine), by.n))
    contradict = [not 1.0 / IMPLAUSIBLE_RATIO <= factor <= IMPLAUSIBLE_RATIO for _, factor, _ in judged]
    signs = {math.copysign(1.0, factor) for _, factor, _ in judged}
    if len(judged) > 1 and all(contradict) and len(signs) == 1:  # all others contradict the first
        factor = 1.0 / float(np.median([factor for _, factor, _ in judged]))
        others = Seen(" and ".join(each.name for each, *_ in judged))
        return [_turned(reference, others, factor, min(n for *_, n in judged))]
    return [_turned(seen, reference, factor, n) for seen, factor, n in judged]


def _reversed_side(sources: Sequence[Seen]) -> list[Finding]:
    """Return whether a robot that turns by its wheels does so as the sum of both sides, and not as their difference."""
    rates = {each.name: each.yaw_rate_radps for each in sources if each.yaw_rate_radps is not None}
    sides, wheels = (
        rates.pop(SIDES, None),
        next((each.velocity_mps for each in sources if each.name == WHEELS), None),
    )
    if sides is None or wheels is None or not rates:
        return []
    name, rate = next(iter(rates.items()))
    by_sum, by_difference = (_compare_changes(each, rate) for each in (wheels[:, 0], sides))
    alike = (
        by_sum.is_known and by_sum.least >= MIN_TURN_CHANGE_RADPS and abs(by_sum.cosine) >= MIN_FAR_LIKENESS
    )
    if not alike or abs(by_difference.cosine) > 0.5:
        return []
    odd = f"turns: {name} shows turns as the sum of the speeds of both sides, not as their difference"
    return [Finding("turns", 2, WHEELS, by_sum.cosine, f"{odd}: a turned sign of one side?")]


def _turn_of_course(
    course_mps: Array, rate_radps: Array, sources: Sequence[Seen], robot: Described
) -> list[tuple[float, int]]:
    """Return 1 where a course turns as a yaw rate says, -1 where it is its mirror image, with the number of points."""
    wheels = next((each.velocity_mps for each in sources if each.name == WHEELS), None)
    course = course_mps @ [1.0, 1.0j]
    if robot.sideways:
        if wheels is None:
            return []
        ahead = wheels[:, :2] @ [1.0, 1.0j]
    else:
        ahead = np.abs(course) * (1.0 if wheels is None else np.sign(wheels[:, 0]))
    yaw_rad = np.cumsum(np.nan_to_num(rate_radps)) * STEP_S
    body = ahead * np.exp(1.0j * yaw_rad)
    known = np.isfinite(course) & np.isfinite(body) & np.isfinite(rate_radps)
    n = int(known.sum())
    if n < MIN_CERTAIN_POINTS:
        return []
    p, g = np.where(known, body, 0.0), np.where(known, course, 0.0)
    norm = math.sqrt(float((np.abs(p) ** 2).sum() * (np.abs(g) ** 2).sum())) or math.inf
    for points in COURSE_POINTS:
        blocks = np.arange(0, len(course), points)
        turned, mirrored = (
            float(np.abs(np.add.reduceat(each, blocks)).sum()) / norm for each in (np.conj(p) * g, p * g)
        )
        rest = max(1.0 - max(turned, mirrored), 0.0)
        apart = max(MIN_OVER_ROTATION, MIN_SIGMAS * math.sqrt(2.0 * MEAN_POINTS * rest / n))
        if max(turned, mirrored) >= MIN_MIRROR and abs(mirrored - turned) >= apart:
            return [(1.0 if turned > mirrored else -1.0, n)]
    return []


def _turned(seen: Seen, reference: Seen, factor: float, n: int) -> Finding:
    what = "turn of the course" if seen.course_mps is not None else "yaw rate"
    of = f"turns: the {what} of {seen.name} is {factor:.3g} times that of {reference.name}"
    low, high, bound = 1.0 / DOUBTFUL_TURN_RATIO, DOUBTFUL_TURN_RATIO, IMPLAUSIBLE_RATIO
    if WHEELS in (seen.name, reference.name):  # they slip, and the front of a car pushes on
        low, high, bound = 1.0 / IMPLAUSIBLE_RATIO, IMPLAUSIBLE_RATIO, IMPLAUSIBLE_RATIO**2
    why = mistake(factor, TURN_FACTORS)
    if factor < 0.0:
        why = "a turned sign, or axis?"
        if seen.course_mps is not None:
            why = "x and y exchanged (x is east, y north), or a turned axis?"
        elif WHEELS in (seen.name, reference.name):
            why = "a turned sign of the steering or of the gyro, or wheels exchanged?"
    elif low <= factor <= high or seen.course_mps is not None:
        return Finding("turns", 0, seen.name, factor, of)
    beyond = not 1.0 / bound <= factor <= bound
    if seen.name == WHEELS and factor > 1.0:
        beyond, why = False, f"wheels that slip, or {why}"
    level = _level(n, True, beyond)
    odd = f"{of}, {low:.2g} to {high:.2g} is expected: {why}"
    return Finding("turns", level, seen.name, factor, odd if level else of)


def _directions(sources: Sequence[Seen], robot: Described) -> list[Finding]:
    """Compare velocities along the body's axes: of a robot that cannot drive sideways with x, and with the wheels'."""
    found = []
    wheels = next((each.velocity_mps for each in sources if each.name == WHEELS), None)
    columns = 2 if robot.sideways else 1
    for seen in sources:
        if seen.velocity_mps is None or not seen.in_body or seen.name == WHEELS:
            continue
        speed = np.hypot(*seen.velocity_mps.T)
        goes = (speed > MIN_SPEED_MPS) & (_turn_speed(sources, robot) < 0.5 * speed)
        if wheels is not None:  # a robot that slips may slide anywhere
            rolled = np.hypot(*wheels[:, :2].T)
            goes &= ~((speed < rolled / DOUBTFUL_RATIO) | (speed > DOUBTFUL_RATIO * rolled))
        if goes.sum() < MIN_POINTS:
            continue
        v = np.where(goes[:, None], seen.velocity_mps, np.nan)
        ahead = float(np.nanmedian(v[:, 0] ** 2 / speed**2))
        of = f"direction: {100 * ahead:.0f} % of the motion of {seen.name} is along the robot's x axis"
        by = Likeness() if wheels is None else _compare(v[:, :columns], wheels[:, :columns])
        n = int(goes.sum())
        level = _level(n, ahead < MIN_AHEAD[0], ahead < MIN_AHEAD[1]) if robot.sideways is False else 0
        if level:
            odd = f"{of}, which cannot drive sideways: axes exchanged, or a yaw off by 90 degrees?"
            found.append(Finding("direction", level, seen.name, ahead, odd))
        elif robot.sideways and wheels is not None and (turned := _turned_axes(v, wheels, by)):
            odd = f"direction: {seen.name} moves as the wheels do {turned}: other axes, or another zero of its yaw?"
            found.append(Finding("direction", _level(by.n, True, True), seen.name, by.cosine, odd))
        elif by.is_known and by.cosine < 0.0:
            odd = f"direction: {seen.name} moves against the wheels: a turned sign, or a yaw off by 180 degrees?"
            found.append(Finding("direction", _level(by.n, True, True), seen.name, by.cosine, odd))
        elif robot.sideways is False or by.is_known:
            found.append(Finding("direction", 0, seen.name, ahead, of))
    return found


def _clocks(sources: Sequence[Seen]) -> list[Finding]:
    """Compare speeds, and yaw rates, with the first one at shifts of seconds: clocks that are apart, or a delay."""
    rates = [(each.name, each.yaw_rate_radps) for each in sources if each.yaw_rate_radps is not None]
    speeds = [
        (each.name, np.linalg.norm(each.velocity_mps, axis=1))
        for each in sources
        if each.velocity_mps is not None
    ]
    found: dict[tuple[str, str], Finding] = {}
    for signals in (rates, speeds):
        for name, values in signals[1:]:
            reference, first = signals[0]
            if away_s := _apart(values, first):
                odd = f"clocks: {name} and {reference} agree when shifted by {away_s:+.1f} s: clocks apart, or a delay?"
                found.setdefault((name, reference), Finding("clocks", 1, name, away_s, odd))
    return list(found.values())


def _apart(measured: Array, reference: Array) -> float:
    """Return by how much a signal (n,) is later; 0 where it is as much alike within :data:`SHIFTS_S`."""
    near, far = (_compare_changes(measured, reference, shifts_s) for shifts_s in (SHIFTS_S, FAR_SHIFTS_S))
    alike = far.n >= 2 * MIN_CERTAIN_POINTS and far.least >= MIN_TURN_RADPS / 2
    if not alike or abs(far.cosine) < max(MIN_FAR_LIKENESS, abs(near.cosine) + MIN_FAR_GAIN):
        return 0.0
    return STEP_S * far.shift


def _receivers_axes(sources: Sequence[Seen]) -> list[Finding]:
    """Compare a receiver's velocity with the change of its positions, of one frame: direction and size."""
    of = {seen.name: seen.course_mps for seen in sources if seen.course_mps is not None}
    velocity, moved = of.get("the velocity of gnss"), of.get("the position of gnss")
    if velocity is None or moved is None:
        return []
    speeds = np.hypot(*velocity.T), np.hypot(*moved.T)
    slow, fast = np.minimum(*speeds), np.maximum(*speeds)
    goes = (slow > MIN_SPEED_MPS) & (fast < IMPLAUSIBLE_RATIO * slow)
    if (n := int(goes.sum())) < MIN_POINTS:
        return []
    cosine = float(np.median((velocity * moved).sum(axis=1)[goes] / (slow * fast)[goes]))
    apart_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    text = f"direction: the velocity of gnss is {apart_deg:.0f} degrees from its path"
    if cosine < 0.5:
        why = "a course that is not from north, clockwise, or latitude and longitude exchanged?"
        return [Finding("direction", _level(n, True, True), "the velocity of gnss", cosine, f"{text}: {why}")]
    found = [Finding("direction", 0, "the velocity of gnss", cosine, text)]
    for axis, v, m in zip("xy", velocity.T, moved.T, strict=True):
        along = goes & (np.abs(v) > 0.5 * speeds[0])
        if (n := int(along.sum())) < MIN_POINTS:
            continue
        least, ratio, most = np.quantile(m[along] / v[along], [0.1, 0.5, 0.9]).tolist()
        if least > RECEIVER_RATIO or most < 1.0 / RECEIVER_RATIO:
            odd = f"position: that of gnss changes {ratio:.3g} times as fast as its velocity along {axis}"
            why = "degrees without the cosine of the latitude, a sign, or another unit?"
            found.append(Finding("position", _level(n, True, False), "gnss", ratio, f"{odd}: {why}"))
    return found


def _still_positions(run: RunLog, sources: Sequence[Seen]) -> list[Finding]:
    """Return whether positions of a receiver hardly move while the wheels drive for metres: degrees."""
    wheels = next((seen.velocity_mps for seen in sources if seen.name == WHEELS), None)
    gnss = run.streams.get("gnss")
    if wheels is None or gnss is None or not set(POSITIONS) <= set(gnss.channels):
        return []
    driven_m = float(np.nansum(np.hypot(*wheels.T)) * STEP_S)
    positions = gnss.columns(POSITIONS)
    positions = positions[np.isfinite(positions).all(axis=1)]
    spread_m = float(np.ptp(positions, axis=0).max()) if len(positions) else 0.0
    if driven_m < MIN_DRIVEN_M or not 0.0 < spread_m < STILL_M:
        return []
    odd = f"position: gnss stays within {spread_m:.2g} m while the wheels drive {driven_m:.3g} m: in degrees?"
    return [Finding("position", 2, "gnss", spread_m, odd)]


def _turned_axes(velocity_mps: Array, wheels_mps: Array, by: Likeness) -> str:
    """Return how velocities (n, 2) have to be turned or mirrored to be those of the wheels; empty where they need not.

    The rotation, or mirror, that brings one nearest to the other is by the singular values of their products
    (Schoenemann, Psychometrika 1966).
    """
    both = np.isfinite(velocity_mps).all(axis=1) & np.isfinite(wheels_mps).all(axis=1)
    if by.cosine >= 0.5 or both.sum() < MIN_POINTS:
        return ""
    u, singular, vt = np.linalg.svd(velocity_mps[both].T @ wheels_mps[both])
    turn = u @ vt
    straight = (
        singular[1] < 0.1 * singular[0]
    )  # of one direction, which a rotation explains as well as a mirror
    if straight and np.linalg.det(turn) < 0.0:
        turn = u @ np.diag([1.0, -1.0]) @ vt
    if abs(_compare(velocity_mps @ turn, wheels_mps).cosine) < MIN_LIKENESS:
        return ""
    if np.linalg.det(turn) < 0.0:
        return "in a mirror"
    return f"turned by {np.degrees(math.atan2(turn[0, 1], turn[0, 0])):.0f} degrees"


# -- Sensors by themselves ------------------------------------------------------------------------------------


def _quantile(values: Array, part: float = 0.99) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(np.quantile(known, part)) if known.size else math.nan


def _acceleration(sources: Sequence[Seen]) -> list[Finding]:
    """Compare the specific force ahead with the acceleration of the wheels; slopes add to it: at most doubtful."""
    seen = {each.name: each.acceleration_mps2 for each in sources if each.acceleration_mps2 is not None}
    if len(seen) < 2:
        return []
    by, left = (_compare_changes(each, seen[WHEELS][:, 0]) for each in seen[ACCELEROMETER].T)
    if abs(by.cosine) < 0.5 and left.is_known and left.least >= MIN_ACCELERATION_MPS2:
        odd = (
            "acceleration: accel_y, and not accel_x, is as the acceleration of the wheels: x and y exchanged?"
        )
        return [Finding("acceleration", 1, "imu", left.cosine, odd)]
    if not by.is_known or by.least < MIN_ACCELERATION_MPS2:
        return []
    of = f"acceleration: accel_x is {math.copysign(by.ratio, by.cosine):.3g} times the acceleration of the wheels"
    if by.cosine < 0.0:
        return [Finding("acceleration", 1, "imu", -by.ratio, f"{of}: a turned x axis of the IMU?")]
    pair = _shifted(seen[ACCELEROMETER][:, 0], seen[WHEELS][:, 0], by.shift)
    if _factor(*pair, MIN_ACCELERATION_MPS2).most < LEAST_OF_WHEELS:
        return [Finding("acceleration", 1, "imu", by.ratio, f"{of}: wheels in km/h or rad/s read as m/s?")]
    return [Finding("acceleration", 0, "imu", by.ratio, of)]


def _compare_changes(measured: Array, reference: Array, shifts_s: Array = SHIFTS_S) -> Likeness:
    """Compare two signals (n,) about their means: an offset, or a mounting askew, is no turned sign."""
    both = np.isfinite(measured) & np.isfinite(reference)
    if both.sum() < MIN_CERTAIN_POINTS:
        return Likeness()
    m, r = (np.where(both, each - each[both].mean(), np.nan)[:, None] for each in (measured, reference))
    return _compare(m, r, shifts_s)


def _attitude(run: RunLog, grid_s: Array) -> list[Finding]:
    """Compare roll and pitch with what gravity shows along x and y: ``-g sin(pitch)`` and ``g sin(roll)``."""
    imu = run.streams.get("imu")
    found = []
    for name, axis, sign in (("pitch_rad", "x", -1.0), ("roll_rad", "y", 1.0)):
        if imu is None or name not in imu.channels:
            continue
        largest = _quantile(imu.channel(name))
        if largest > 1.1 * np.pi:
            odd = f"attitude: {name} of imu reaches {largest:.3g} rad, {np.pi:.3g} is the most: in degrees?"
            found.append(Finding("attitude", 2, name, largest, odd))
            continue
        if f"accel_{axis}_mps2" not in imu.channels:
            continue
        force = _change(imu.time_s, imu.channel(f"accel_{axis}_mps2"), grid_s, of_rate=True) / GRAVITY_MPS2
        angle = sign * _change(imu.time_s, imu.channel(name), grid_s, of_rate=True)
        by = _compare_changes(angle, force)
        like, ratio = by.cosine, by.ratio
        if not by.is_known or by.least < MIN_TILT_RAD:
            continue
        of = f"attitude: {name} of imu is {math.copysign(ratio, like):.3g} times the tilt that gravity shows"
        if like < 0.0:
            found.append(
                Finding(
                    "attitude", 2, name, -ratio, f"{of}: a turned sign (z up, nose up is a negative pitch)?"
                )
            )
        elif ratio > 10.0:
            found.append(Finding("attitude", 2, name, ratio, f"{of}: in degrees?"))
        else:
            found.append(Finding("attitude", 0, name, ratio, of))
    return found


def _tilt_rates(run: RunLog, grid_s: Array) -> list[Finding]:
    """Compare the gyro about x and y with how the tilt that gravity shows changes, on rough ground or slopes."""
    imu, steps, found = run.streams.get("imu"), round(MEAN_S / STEP_S), []
    for about, axis, sign in (("x", "y", 1.0), ("y", "x", -1.0)):
        names = f"gyro_{about}_radps", f"accel_{axis}_mps2"
        if imu is None or not set(names) <= set(imu.channels) or len(grid_s) < 2 * steps:
            continue
        gyro, force = (_change(imu.time_s, imu.channel(name), grid_s, of_rate=True) for name in names)
        tilt_rad = sign * force / GRAVITY_MPS2
        change_radps = (tilt_rad[steps:] - tilt_rad[:-steps]) / MEAN_S
        mean_radps = np.convolve(gyro, np.ones(steps + 1) / (steps + 1), "valid")
        by = _compare_changes(mean_radps, change_radps)
        if not by.is_known or by.least < MIN_TILT_RATE_RADPS:
            continue
        factor = math.copysign(by.ratio, by.cosine)
        of = f"tilt: the gyro about {about} shows {factor:.3g} times the change of tilt that gravity shows"
        if factor < -1.0 / IMPLAUSIBLE_RATIO:  # less is that of turns, not of tilt
            found.append(
                Finding("tilt", 2, names[0], factor, f"{of}: a turned axis of the gyro or accelerometer?")
            )
        elif factor > IMPLAUSIBLE_RATIO**2:
            found.append(Finding("tilt", 2, names[0], factor, f"{of}: a gyro in deg/s read as rad/s?"))
        else:
            found.append(Finding("tilt", 0, names[0], factor, of))
    return found


def _steering(run: RunLog, robot: Described, grid_s: Array) -> list[Finding]:
    stream = run.streams.get("steering")
    if stream is None or len(stream) < MIN_POINTS:
        return []
    found = []
    given, turned = robot.contradiction
    if given > CONTRADICTION and given > OVER_TURNED * turned:
        odd = (
            f"steering: no motion explains {100 * given:.0f} % of the speeds of the wheels, and all but "
            f"{100 * turned:.0f} % with angles of the other sign: a turned sign of the steering?"
        )
        found.append(Finding("steering", _level(len(stream), True, True), "steering", given, odd))
    known = robot.steering_rate_max_radps > 0.0
    fastest = max(3.0 * robot.steering_rate_max_radps, 2.0) if known else STEERING_RATE_RADPS
    for channel in stream.channels:
        if not channel.startswith("angle_"):
            continue
        angle = stream.channel(channel)
        rate = _quantile(_change(stream.time_s, angle, grid_s, of_rate=False), 0.995)
        largest = _quantile(angle)
        steepest = 1.1 * np.pi if robot.front_driven else 0.55 * np.pi
        if robot.sideways is False and largest > steepest:
            odd = f"steering: {channel} reaches {largest:.3g} rad, {steepest:.3g} is the most: in degrees?"
            found.append(Finding("steering", 2, channel, largest, odd))
        elif rate > fastest:
            odd = (
                f"steering: {channel} turns by up to {rate:.3g} rad/s, {fastest:.3g} is the most: in degrees?"
            )
            found.append(Finding("steering", 2 if largest > np.pi else 1, channel, rate, odd))
        else:
            found.append(
                Finding("steering", 0, channel, rate, f"steering: {channel} turns by up to {rate:.3g} rad/s")
            )
    return found


def _receiver(run: RunLog) -> list[Finding]:
    """Return what is odd about the fix and the deviation that a receiver states."""
    gnss = run.streams.get("gnss")
    if gnss is None:
        return []
    found = []
    fix = gnss.channel("fix_ratio") if "fix_ratio" in gnss.channels else np.full(len(gnss), np.nan)
    if (largest := _quantile(fix, 1.0)) > 1.0:
        odd = f"receiver: fix_ratio reaches {largest:.3g}, 1 is the most: codes of NMEA?"
        found.append(Finding("receiver", 2, "fix_ratio", largest, odd))
    if "std_position_m" in gnss.channels:
        std = gnss.channel("std_position_m")
        fixed = std[(fix > 0.9) & (fix <= 1.0) & np.isfinite(std)]
        if fixed.size and (middle := float(np.median(fixed))) > MAX_STD_OF_FIX_M:
            odd = f"receiver: std_position_m is {middle:.3g} m with an RTK fix, some cm are expected: in mm or cm?"
            found.append(Finding("receiver", 1, "std_position_m", middle, odd))
    return found


def _currents(run: RunLog, robot: Described) -> list[Finding]:
    wheels = run.streams.get("wheels")
    if wheels is None or not math.isfinite(robot.current_max_a):
        return []
    names = [name for name in wheels.channels if name.startswith("current_") and name.endswith("_a")]
    largest = _quantile(wheels.columns(names)) if names else math.nan
    of = (
        f"current: up to {largest:.3g} A, the motors take {robot.current_max_a:.3g} A at their largest torque"
    )
    if not math.isfinite(largest):
        return []
    level = 2 if largest > 30.0 * robot.current_max_a else int(largest > 3.0 * robot.current_max_a)
    return [Finding("current", level, "wheels", largest, of + (": in mA?" if level else ""))]


def _efforts(run: RunLog, sources: Sequence[Seen], grid_s: Array) -> list[Finding]:
    """Compare the power of motors with the force ahead that the accelerometer shows: uphill and speeding up they drive.

    Currents without a sign say nothing.
    """
    wheels, seen = run.streams.get("wheels"), {each.name: each for each in sources}
    names = [] if wheels is None else [name for name in wheels.channels if name.startswith("speed_")]
    pairs = [(name, name.replace("speed_", "current_").replace("_mps", "_a")) for name in names]
    if wheels is None or ACCELEROMETER not in seen or WHEELS not in seen:
        return []
    known = [(speed, current) for speed, current in pairs if current in wheels.channels]
    force, velocity = seen[ACCELEROMETER].acceleration_mps2, seen[WHEELS].velocity_mps
    if not known or force is None or velocity is None:
        return []
    power = sum(wheels.channel(speed) * wheels.channel(current) for speed, current in known)
    power = _change(wheels.time_s, np.asarray(power), grid_s, of_rate=True)
    drives = (force[:, 0] * np.sign(velocity[:, 0]) > MIN_FORCE_MPS2) & (
        np.abs(velocity[:, 0]) > MIN_SPEED_MPS
    )
    braking = power[drives & np.isfinite(power)] < 0.0
    signed = min(float(wheels.channel(current).min()) for _, current in known) < 0.0
    if not signed or len(braking) < MIN_POINTS or np.mean(braking) < MOSTLY:
        return []
    of = f"current: motors brake at {100 * np.mean(braking):.0f} % of the points"
    odd = f"{of} at which the robot climbs or speeds up: a turned sign?"
    return [Finding("current", 1, "wheels", float(np.mean(braking)), odd)]
