"""Whether a robot departs from its own extended model while it drives: blocks of samples, and a test over them.

Every :data:`BLOCK_S` the last samples are replayed by the extended model, measured and simulated behind one low-pass,
as runs are by :mod:`terrain.discrepancy.runs`; a log is the same feed, looped.  A channel with residual ``r`` and
prediction ``p`` has two figures a block: ``along = sum(r p) / |p|``, of a robot that turns or drives more or less than
its model, and ``level = sum(r) / sqrt(n)``, of one that is off by an amount.  The gyro minus the yaw rate over ground
is one more channel.  The file of the model states by how much it is off in quiet runs, which is taken off it, and
the variance of the figure in them, ``noise + scatter e``, where ``e = sum(p^2)``, of the level the sum of the squared
wheel speed.  ``z`` is the figure over its standard deviation, and over ``sqrt(memory)``: its long-run variance (Newey
and West 1987), as blocks that follow each other are alike, or rather the upper limit of it with 95 %, of a new session
where there are several.  It is cut off at :data:`CUT`, so that one rogue block is no alarm.

Each figure has two cumulative sums (Page 1954), ``S = max(0, S +- z - offset - k)``, and is an alarm from ``S >= h``
until ``S = 0``; ``offset`` bounds the mean that ``z`` has in quiet driving: that of a new session with 95 %, by
Student's law, from the means of the sessions; of one session its mean and two standard errors.  The mean time between
false alarms of a sum is ``(exp(2kb) - 1 - 2kb) / (2 k^2)`` blocks, ``b = h + 1.166 s``, with the standard deviation
``s`` of its steps (Siegmund 1985, Sequential Analysis); ``h`` makes that of all sums together the time asked for.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2
from scipy.stats import t as student

from terrain.discrepancy.compared import CHANNEL_WORDS
from terrain.discrepancy.noise import growth_of
from terrain.discrepancy.runs import (
    CUTOFF_HZ,
    MAX_RATE_HZ,
    SETTLE_S,
    TAPS_PER_CUTOFF,
    Simulation,
    low_pass_of,
    rows_of,
    signals_of,
)
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.errors import ConfigError, TerrainError
from terrain.extension import region_of
from terrain.files.documents import check_keys, is_number, read_yaml
from terrain.files.names import shown
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, Reading, RunLog, Stream
from terrain.robots import Robot, description_file, outside, robot_from

BLOCK_S = 3.0  #: Of compared rows: runs of 6 s, as single commands are, have one.
SAME_S = 1e-6  #: Stamps that differ by less are the same.
KEPT_S = 60.0  #: Longest time of samples that are kept while none of the wheels come.
WAIT_S = 0.5  #: After the end of a block for samples that come late; later ones are not used.
CUT = 3.0  #: Standard deviations at which a block is cut off.
REFERENCE = 0.5  #: ``k``: half of the change, in standard deviations of a block, that is found soonest.
OVERSHOOT = 1.166  #: Of a sum over its threshold, in standard deviations of a step.
FALSE_ALARM_H = 100.0  #: Hours of driving in which one false alarm is expected.
LEAST_BLOCKS = 8  #: Of which a deviation can be stated.
LEAST_KNOWN = 0.25  #: Ratio of a block's rows that have to be known.
LEAST_MOTION = 0.25  #: Ratio of the quiet runs' median ``e`` below which a block does not show a ratio.
STANDSTILL_MPS = 0.03  #: Of the fastest row of a block.
LEAST_RATIO = 0.1  #: Of what is usual over the prediction, for a departure in percent.
N_FITS = 10  #: Of the variance, each weighted by that of the one before.
MEMORY_BLOCKS = 10  #: Longest memory of blocks.
OTHER_CLOCK = 0.1  #: Ratio by which the clock may differ from that of the quiet runs.
ONE_SESSION = (
    "the usual deviations are those of one session: in others, alarms may come more often than asked for"
)
SCHEMA = 1  #: Version of the section that is read and written.
KINDS = ("along", "level")


class Status(StrEnum):
    """Of a channel."""

    AGREES = "agrees with its model"
    DEPARTS = "departs from its model"
    WAITING = "not known yet"
    STANDS = "not observable: the robot stands"
    SILENT = "not observable: no samples"
    SLOW = "not observable: too little motion"
    OUTSIDE = "not observable: outside the drives that its model was validated on"


class BlockDeviation(NamedTuple):
    """How far a figure of a channel is from 0 in quiet blocks."""

    bias: float  #: median of the ratio, or of the level, by which the model is off in them; it is taken off the figure
    noise: float  #: variance, in the square of the channel's unit
    scatter: float  #: the same per ``e``
    memory: float  #: long-run variance of the figure over its standard deviation, its upper limit
    spread: float  #: variance of the same
    offset: float  #: largest mean of ``z`` that is usual
    least: float  #: ``e`` below which the block does not show the figure
    blocks: int  #: from which these are
    sessions: int  #: of which these are; of one nothing tells how others differ


class Block(NamedTuple):
    """The figures of some seconds."""

    start_s: float  #: of the rows, on the robot's clock
    status: Status  #: ``AGREES`` where it can be compared
    why: str = ""  #: it cannot be
    #: by channel and kind: the figure, its ``e``, and what the size is the ratio of
    figures: Mapping[tuple[str, str], tuple[float, float, float]] = {}


class Alarm(NamedTuple):
    """A departure."""

    channel: str
    kind: str  #: of :data:`KINDS`
    since_s: float  #: when it began, as far as the sum tells, and when it was raised, on the robot's clock
    raised_s: float
    size: float  #: ratio, or level in the channel's unit
    run_id: str = ""  #: of a log: where it was raised, and where it began
    since_run_id: str = ""
    over_s: float = math.nan  #: when it was over; NaN while it is not
    over_run_id: str = ""

    @property
    def text(self) -> str:
        """Return what departs, by how much, in which direction and since when.

        Examples
        --------
        >>> Alarm("heading_rate_radps", "along", 12.0, 30.0, -0.12).text
        'turns 12 % less than its model since 12.0 s'
        """
        of_run = f" of {self.since_run_id}" if self.since_run_id else ""
        return f"{departure(self.channel, self.kind, self.size)} since {clock_text(self.since_s)}{of_run}"


BESIDE = "gyro_beside_poses_radps"  #: The gyro minus the yaw rate over ground: how a ground turns a robot is in both.
NAMES = (*CHANNELS, BESIDE)
WORDS = {**CHANNEL_WORDS, BESIDE: ("gyro minus yaw rate over ground", "rad/s")}

ALONG = {
    BESIDE: ("gyro reads", "more", "less"),
    GYRO: ("turns", "more", "less"),
    HEADING: ("turns", "more", "less"),
    SPEED_X: ("drives", "faster", "slower"),
    SPEED_Y: ("moves sideways", "more", "less"),
    ACCEL: ("accelerates", "more", "less"),
    CURRENT: ("draws current", "more", "less"),
    TURNING_CURRENT: ("draws current to turn", "more", "less"),
}


def departure(channel: str, kind: str, size: float) -> str:
    """Return a departure in words.

    Examples
    --------
    >>> departure("speed_x_mps", "along", -0.05), departure("yaw_rate_radps", "level", 0.031)
    ('drives 5 % slower than its model', 'yaw rate (gyro) is 0.031 rad/s more to the left than its model')
    """
    if kind == "along":
        verb, more, less = ALONG[channel]
        by = {GYRO: " by the gyro", ACCEL: " by the accelerometer", BESIDE: " beside poses"}.get(channel, "")
        if size < -1.0:
            return f"{verb} opposite to its model{by}"
        return f"{verb} {100 * abs(size):.2g} % {more if size > 0 else less} than its model{by}"
    name, unit = WORDS[channel]
    turns = channel in (GYRO, HEADING, SPEED_Y, BESIDE)
    side = ("more to the left", "more to the right") if turns else ("more", "less")
    return f"{name} is {abs(size):.2g} {unit} {side[size < 0]} than its model"


def clock_text(time_s: float) -> str:
    """Return a time of the robot's clock, as hours and minutes where it counts from 1970, else in s."""
    return f"{datetime.fromtimestamp(time_s, UTC):%H:%M:%S} UTC" if time_s > 1e9 else f"{time_s:.1f} s"


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """A robot with the deviations that its extended model states."""

    robot: Robot
    clock_hz: float  #: of the quiet runs
    deviations: Mapping[tuple[str, str], BlockDeviation]  #: by channel and kind
    source: str

    @property
    def doubt(self) -> str:
        """Return why false alarms may come more often than is asked for; empty where there are several sessions."""
        most = max([each.sessions for each in self.deviations.values()], default=0)
        return "" if most > 1 else ONE_SESSION

    def threshold(self, false_alarm_h: float) -> dict[tuple[str, str], float]:
        """Return ``h`` of each figure, with one false alarm of all sums together in so many hours."""
        n_blocks = false_alarm_h * 3600.0 / BLOCK_S * 2 * len(self.deviations)
        b = barrier(n_blocks, REFERENCE)
        steps = {of: math.sqrt(each.spread / each.memory) for of, each in self.deviations.items()}
        return {of: max(b - OVERSHOOT * step, CUT) for of, step in steps.items()}


def barrier(n_blocks: float, k: float) -> float:
    """Return ``b`` of a sum with the drift ``-k`` that reaches it once in so many blocks.

    Examples
    --------
    >>> b = barrier(930.9, 0.5)  # h = 5 in the usual tables, whose exact value is 930.9
    >>> round(b - OVERSHOOT, 1)
    5.0
    """
    return float(brentq(lambda b: math.expm1(2 * k * b) - 2 * k * b - 2 * k * k * n_blocks, 1e-9, 500.0))


# -- From samples to blocks -------------------------------------------------------------------------------------


def margin_s(clock_hz: float) -> float:
    """Return what is replayed before and after the rows of a block: the low-pass, and what it settles in."""
    return TAPS_PER_CUTOFF / min(CUTOFF_HZ, clock_hz / 5.0) / 2 + SETTLE_S


def window_s(clock_hz: float) -> float:
    """Return the time of samples that a block is made of."""
    return BLOCK_S + 2 * margin_s(clock_hz)


def block_of(run: RunLog, simulation: Simulation, clock_hz: float) -> Block:
    """Return the figures of the samples of one window."""
    if "wheels" not in run.streams:
        return Block(math.nan, Status.SILENT, "no samples of the wheels")
    begin_s = float(run.streams["wheels"].time_s[0]) + margin_s(clock_hz)
    try:
        return Block(begin_s, *_compared(run, simulation, clock_hz))
    except Exception as error:  # whatever broken samples lead to, it must not stop a live chain
        return Block(begin_s, Status.SILENT, str(error) if isinstance(error, TerrainError) else repr(error))


def _compared(
    run: RunLog, simulation: Simulation, clock_hz: float
) -> tuple[Status, str, Mapping[tuple[str, str], tuple[float, float, float]]]:
    """Return whether a window can be compared, why not, and its figures."""
    robot = simulation.robot
    run = with_wheel_speeds(run, robot)
    if robot.region is not None:
        beyond = outside(robot.region, region_of([run], robot)._replace(terrains=()))
        if beyond:
            return Status.OUTSIDE, beyond, {}
    signals = signals_of(run, robot)
    if abs(signals.dt_s * clock_hz - 1.0) > OTHER_CLOCK:
        why = f"samples at {1 / signals.dt_s:.3g} Hz, {clock_hz:.3g} Hz are required"
        return Status.SILENT, why, {}
    low_pass = low_pass_of([signals])
    rows = rows_of(signals, simulation.planar_on(""), simulation.vector, (), low_pass)
    if rows.pace_mps.max(initial=0.0) < STANDSTILL_MPS:
        return Status.STANDS, "", {}
    figures, gyro, heading = {}, CHANNELS.index(GYRO), CHANNELS.index(HEADING)
    residual = np.column_stack([rows.residual, rows.residual[:, gyro] - rows.residual[:, heading]])
    predicted = np.column_stack([rows.predicted, rows.predicted[:, gyro]])
    for c, channel in enumerate(NAMES):
        known = np.isfinite(residual[:, c])
        n = int(known.sum())
        if n < LEAST_KNOWN * BLOCK_S * low_pass.rate_hz:
            continue
        r, p, pace = residual[known, c], predicted[known, c], rows.pace_mps[known]
        square = float(p @ p)
        if square > 0.0:
            figures[channel, "along"] = float(r @ p) / math.sqrt(square), square, square
        figures[channel, "level"] = float(r.sum()) / math.sqrt(n), float(pace @ pace), float(n)
    return Status.AGREES, "", figures


def blocks_of(run: RunLog, simulation: Simulation, clock_hz: float) -> list[Block]:
    """Return the blocks of a log, as :class:`Watch` makes them of its samples."""
    wheels_s, blocks, length_s = run.streams["wheels"].time_s, [], window_s(clock_hz)
    start_s = float(wheels_s[0])
    while start_s + length_s <= wheels_s[-1] + SAME_S:
        blocks.append(block_of(_cut(run, start_s, start_s + length_s), simulation, clock_hz))
        start_s = _next_start(wheels_s, start_s)
    return blocks


def _next_start(wheels_s: Array, start_s: float) -> float:
    """Return the start of the window after one, by the stamps of the wheels: after a gap, that of the first sample."""
    next_s = start_s + BLOCK_S
    first_s = float(wheels_s[np.searchsorted(wheels_s, next_s - SAME_S)])
    return next_s if first_s < next_s + BLOCK_S else first_s


def _cut(run: RunLog, start_s: float, end_s: float) -> RunLog:
    streams = {}
    for name, stream in run.streams.items():
        low, high = np.searchsorted(stream.time_s, [start_s - SAME_S, end_s + SAME_S])
        if high - low > 1:
            streams[name] = Stream(stream.time_s[low:high], stream.values[low:high], stream.channels)
    return RunLog(run.run_id, run.robot, streams)


def simulation_of(robot: Robot) -> Simulation:
    """Return the extended model of a robot on the default ground."""
    return Simulation(robot, effects=robot.effects, learned=robot.learned)


# -- The deviations of quiet runs, and the section of a description ------------------------------------------


def watched_on(runs: Sequence[RunLog], robot: Robot, source: str) -> Watched:
    """Return an extended robot with the deviations of its model on runs, in the order in which they were driven."""
    clock_hz = float(np.median([min(run.streams["wheels"].rate_hz, MAX_RATE_HZ) for run in runs]))
    simulation, found = simulation_of(robot), []
    for run in runs:
        found += [(run.session, block) for block in blocks_of(run, simulation, clock_hz)]
    deviations = {}
    for of in [(channel, kind) for channel in NAMES for kind in KINDS]:
        own = [(session, *block.figures[of]) for session, block in found if of in block.figures]
        if len(own) >= LEAST_BLOCKS and (each := _deviation(own, of[1])) is not None:
            deviations[of] = each
    return Watched(robot, clock_hz, deviations, source)


def _deviation(blocks: Sequence[tuple[str, float, float, float]], kind: str) -> BlockDeviation | None:
    """Return the deviation over blocks in order (session and :attr:`Block.figures`); None where they do not show it."""
    sessions, *numbers = zip(*blocks, strict=True)
    figure, e, whole = np.array(numbers)
    least = LEAST_MOTION * float(np.median(e)) if kind == "along" else 0.0
    shows = e >= least
    figure, e, whole, of_session = figure[shows], e[shows], whole[shows], np.array(sessions)[shows]
    bias = float(np.median(figure / np.sqrt(whole))) if len(figure) else 0.0
    figure = figure - bias * np.sqrt(whole)
    n, square = len(figure), figure**2
    if n < LEAST_BLOCKS or not square.any():
        return None
    powers = np.column_stack([np.ones(n), e])
    growth = growth_of(powers, square, N_FITS, CUT)  # what is far out is cut off here as it is in z
    places, memory = np.unique(of_session, return_inverse=True)[1], 1.0
    for _ in range(2):  # cut off as it is over the memory
        most = CUT * math.sqrt(memory)
        z = np.clip(figure / np.sqrt(powers @ growth), -most, most)
        means = np.bincount(places, z) / np.bincount(places)
        spread, memory = _memory(z - means[places], places)
    means /= math.sqrt(memory)
    offset = abs(float(means[0])) + 2.0 / math.sqrt(n)
    if len(means) > 1:
        offset = float(student.ppf(0.975, len(means)) * np.sqrt(np.mean(means**2)))
    return BlockDeviation(
        bias, float(growth[0]), float(growth[1]), memory, spread, offset, least, n, len(means)
    )


def _memory(left: Array, places: Array) -> tuple[float, float]:
    """Return variance and long-run variance (its upper limit) of deviations in order, of sessions by their places.

    Of several sessions the limit is that of a new one, by Student's law of the logarithms of their variances.
    """
    n = len(left)
    spread = memory = float(left @ left) / (n - 1)
    lags = min(MEMORY_BLOCKS, n // 4)
    for lag in range(1, lags + 1):
        alike = places[lag:] == places[:-lag]
        memory += 2.0 * (1.0 - lag / (lags + 1)) * float((left[lag:] * left[:-lag] * alike).sum()) / (n - 1)
    memory = max(memory, spread)
    independent = n * spread / memory
    limit = memory * independent / float(chi2.ppf(0.05, independent))
    sums, counts = np.bincount(places, left**2), np.bincount(places)
    logs = np.log(sums[sums > 0.0] / np.maximum(counts[sums > 0.0] - 1, 1))
    if (m := len(logs)) > 1:
        beyond = float(student.ppf(0.95, m - 1)) * math.sqrt(1.0 + 1.0 / m) * float(logs.std(ddof=1))
        limit = max(limit, memory / spread * math.exp(float(logs.mean()) + beyond))
    return spread, limit


def watch_lines(watched: Watched) -> list[str]:
    """Return the lines of a section ``watch``; none without deviations."""
    if not watched.deviations:
        return []
    lines = [
        "watch:",
        f"  schema: {SCHEMA}",
        f"  source: {json.dumps(watched.source)}",
        f"  clock_hz: {watched.clock_hz:.7g}",
    ]
    lines.append("  deviations:")
    for (channel, kind), each in watched.deviations.items():
        entry = ", ".join([f"{name}: {_written(value)}" for name, value in each._asdict().items()])
        lines.append(f"    {channel} {kind}: {{{entry}}}")
    return lines


def _written(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(f"{value:.7g}"))


def read_watched(path: str | Path) -> Watched:
    """Return the robot of a file that ``terrain explain`` wrote, with its deviations.

    Raises
    ------
    ConfigError
        if it is no description of a robot, or lacks the section ``watch`` or anything of it.
    """
    file = description_file(path)
    described = read_yaml(file)
    robot = robot_from(file.name, described)
    place, section = f"{file.name}: watch", described.get("watch")
    if section is None:
        raise ConfigError(
            f"{file.name}: has no section 'watch', with how far the robot {robot.name} usually is from its model; "
            "extended.yaml of terrain explain has one"
        )
    check_keys(place, section, ["schema", "source", "clock_hz", "deviations"])
    if section["schema"] != SCHEMA:
        raise ConfigError(
            f"{place}: schema is {shown(section['schema'])}; this version of terrain reads {SCHEMA}"
        )
    clock_hz, entries, deviations = section["clock_hz"], section["deviations"], {}
    if (
        not is_number(clock_hz)
        or not 1.0 <= clock_hz <= MAX_RATE_HZ
        or not isinstance(section["source"], str)
    ):
        raise ConfigError(f"{place}: a clock of 1 to {MAX_RATE_HZ:g} Hz and a source in words are required")
    if not isinstance(entries, dict) or not entries:
        raise ConfigError(f"{place}: deviations are {shown(entries)}, one by channel and kind is required")
    for name, entry in entries.items():
        channel, _, kind = str(name).partition(" ")
        if channel not in NAMES or kind not in KINDS:
            raise ConfigError(f"{place}: {shown(name)} is no channel and kind ({' or '.join(KINDS)})")
        check_keys(f"{place}: {name}", entry, [*BlockDeviation._fields])
        if not all(is_number(value) and (value >= 0.0 or key == "bias") for key, value in entry.items()):
            raise ConfigError(f"{place}: {name}: finite numbers are required, from 0 up but for the bias")
        each = BlockDeviation(**entry)
        if not each.memory >= each.spread > 0.0 or not each.noise > 0.0:
            raise ConfigError(
                f"{place}: {name}: noise and spread above 0 are required, and a memory no smaller"
            )
        deviations[channel, kind] = each
    return Watched(robot, float(clock_hz), deviations, section["source"])


# -- The test, block by block -----------------------------------------------------------------------------------


class Sum(NamedTuple):
    """One of the two cumulative sums of a figure."""

    value: float = 0.0
    since_s: float = math.nan  #: start of the first block after it was last 0
    run_id: str = ""  #: of that block
    off: float = 0.0  #: of the blocks since then: what was off, and what it is the ratio of
    of: float = 0.0


class Watch:
    """Watches one robot.

    Parameters
    ----------
    watched : the robot with the deviations of its model
    channels : of each stream, in the order of the columns of its samples; by default those that samples name
    false_alarm_h : hours of driving in which one false alarm is expected
    thread : that replays; at once without one

    Attributes
    ----------
    status : of each channel that the model states a deviation of
    why : why the last block could not be compared; empty where it could
    alarms : all so far, in the order in which they were raised
    raised : those that the last step raised
    news : sentences of these, and of those that were over in it
    """

    def __init__(
        self,
        watched: Watched,
        channels: Mapping[str, Sequence[str]] | None = None,
        false_alarm_h: float = FALSE_ALARM_H,
        thread: ThreadPoolExecutor | None = None,
    ) -> None:
        self.watched, self._simulation = watched, simulation_of(watched.robot)
        self._channels = channels or {}
        self._threshold, self._thread = watched.threshold(false_alarm_h), thread
        self.status = {channel: Status.WAITING for channel, _ in watched.deviations}
        self.why = ""
        self.news: list[str] = []
        self.raised: list[Alarm] = []
        self.alarms: list[Alarm] = []
        self._sums = {(*of, side): Sum() for of in watched.deviations for side in (1, -1)}
        self._open: dict[tuple[str, str, int], int] = {}  # places of alarms that are not over
        self._due: deque[Block | Future[Block]] = deque()
        self.begin()

    def begin(self, run_id: str = "") -> None:
        """Forget the samples, as between two runs or where the clock was set; sums and alarms go on."""
        self.run_id, self._start_s = run_id, math.nan
        self._parts: dict[str, deque[tuple[Array, Array]]] = {}
        self._newest: dict[str, float] = {}

    @property
    def current(self) -> list[Alarm]:
        """Alarms that are not over."""
        return [self.alarms[i] for i in self._open.values()]

    @property
    def levels(self) -> dict[str, float]:
        """How near each channel is to an alarm, at 1: its largest sum over the threshold."""
        found = dict.fromkeys(self.status, 0.0)
        for (channel, kind, _), each in self._sums.items():
            found[channel] = max(found[channel], each.value / self._threshold[channel, kind])
        return found

    def content(self) -> dict[str, Any]:
        """Return what a session says of it."""
        return {
            "alarms": [alarm._asdict() | {"text": alarm.text} for alarm in self.current],
            "channels": {WORDS[channel][0]: str(status) for channel, status in self.status.items()},
            "why": self.why or None,
        }

    def step(self, samples: Mapping[str, Reading]) -> list[Block]:
        """Take samples as a live chain does; return the blocks that were finished, in most steps none."""
        self._channels = getattr(samples, "channels", self._channels)
        self.news, n_alarms = [], len(self.alarms)
        for name in self._channels.keys() & samples.keys():
            reading = samples[name]
            self._keep(name, np.asarray(reading[0], dtype=float), np.asarray(reading[1], dtype=float))
        newest_s = self._newest.get("wheels", math.nan)
        if math.isnan(self._start_s) and not math.isnan(newest_s):
            self._start_s = float(self._parts["wheels"][0][0][0])
        length_s = window_s(self.watched.clock_hz)
        while newest_s >= self._start_s + length_s + WAIT_S:
            run = self._window(self._start_s)
            about = (
                _cut(run, self._start_s, self._start_s + length_s),
                self._simulation,
                self.watched.clock_hz,
            )
            self._due.append(self._thread.submit(block_of, *about) if self._thread else block_of(*about))
            self._start_s = _next_start(run.streams["wheels"].time_s, self._start_s)
        done = []
        while self._due and not (isinstance(self._due[0], Future) and not self._due[0].done()):
            block = self._due.popleft()
            done.append(block.result() if isinstance(block, Future) else block)
            self.take(done[-1])
        self.raised = self.alarms[n_alarms:]
        return done

    def _keep(self, name: str, time_s: Array, values: Array) -> None:
        """Keep samples of a stream that are newer than those before; a clock that was set begins anew."""
        last_s = self._newest.get(name, -math.inf)
        if time_s.size and time_s[-1] < last_s - BLOCK_S:
            self.begin(self.run_id)
            last_s = -math.inf
        rising = time_s > np.fmax.accumulate(np.concatenate([[last_s], time_s]))[:-1]
        if rising.any():
            parts = self._parts.setdefault(name, deque())
            parts.append((time_s[rising], values[rising]))
            self._newest[name] = float(time_s[rising][-1])
            while parts[0][0][-1] < parts[-1][0][0] - KEPT_S:
                parts.popleft()

    def _window(self, start_s: float) -> RunLog:
        """Return the samples from a time on; older ones are left out from then on."""
        streams = {}
        for name, parts in self._parts.items():
            while parts and parts[0][0][-1] < start_s - SAME_S:
                parts.popleft()
            names = self._channels.get(name)
            if parts and names:
                time_s, values = (np.concatenate(column) for column in zip(*parts, strict=True))
                streams[name] = Stream(time_s, values, tuple(names))
        return RunLog(self.run_id, self.watched.robot.name, streams)

    def take(self, block: Block) -> None:
        """Go on with a block."""
        self.why = block.why
        seen = dict.fromkeys(self.status, False)
        for of, each in self.watched.deviations.items():
            figure, e, whole = block.figures.get(of, (math.nan, 0.0, 0.0))
            if e >= each.least and math.isfinite(figure):
                figure -= each.bias * math.sqrt(whole)
                z = figure / math.sqrt((each.noise + each.scatter * e) * each.memory)
                z = max(-CUT, min(CUT, z))
                off = figure * math.sqrt(whole)
                if of[1] == "along":  # a ratio of what is usual, not of the prediction
                    whole *= max(1.0 + each.bias, LEAST_RATIO)
                for side in (1, -1):
                    step = side * z - each.offset - REFERENCE
                    self._add((*of, side), step, block.start_s, off, whole)
                seen[of[0]] = True
        departing = {channel for channel, _, _ in self._open}
        for channel, is_seen in seen.items():
            status = Status.DEPARTS if channel in departing else Status.AGREES
            if block.status is not Status.AGREES:
                status = block.status
            elif not is_seen:
                status = Status.SLOW if (channel, "level") in block.figures else Status.SILENT
            self.status[channel] = status

    def _add(
        self, place: tuple[str, str, int], step: float, start_s: float, off: float, whole: float
    ) -> None:
        """Add to a sum, by what was off in a block and what it is the ratio of; raise or end its alarm."""
        threshold, end_s, last = self._threshold[place[:2]], start_s + BLOCK_S, self._sums[place]
        if last.value == 0.0:
            last = Sum(0.0, start_s, self.run_id)
        now = Sum(min(last.value + step, threshold), *last[1:3], last.off + off, last.of + whole)
        i = self._open.get(place)
        if now.value <= 0.0:
            now = Sum()
            if i is not None:
                del self._open[place]
                self.alarms[i] = self.alarms[i]._replace(over_s=end_s, over_run_id=self.run_id)
                self.news.append(f"over at {clock_text(end_s)}: {self.alarms[i].text}")
        elif i is not None and now.value >= threshold:  # not while it ends: that would be a mean of both
            self.alarms[i] = self.alarms[i]._replace(size=now.off / now.of)
        elif i is None and now.value >= threshold:
            self._open[place] = len(self.alarms)
            alarm = Alarm(*place[:2], now.since_s, end_s, now.off / now.of, self.run_id, now.run_id)
            self.alarms.append(alarm)
            self.news.append(alarm.text)
        self._sums[place] = now
