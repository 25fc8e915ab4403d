"""What a blind trial hides in simulated runs, drawn at random around the effects' detection limits.

The diagnosis gets run logs without truth and without source, and knows nothing of this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from studies.blind_trials.drives import STEP_HZ, Drives
from studies.blind_trials.limits import Limits, Sensing, confusable_class
from terrain.discrepancy.health import Column, FaultKind
from terrain.effects import (
    BOTH,
    BOUNDS,
    GYRO,
    HEADING,
    SKIDDING,
    SPEED_X,
    SPEED_Y,
    SWERVE,
    Effect,
    effect_named,
    library_of,
)
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.drive import CHANNELS as TWIST_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Conditions


class Row(StrEnum):
    """What is hidden in the runs of a trial."""

    NONE = "none"  #: nothing
    STRONG = "strong"  #: one effect of 3 times its detection limit
    LADDER = "ladder"  #: one effect of 0.1 to 10 times its limit
    FOUND = "found"  #: each effect in turn, around its limit
    TWO = "two"  #: two effects
    OUTSIDE = "outside"  #: something that is not in the library
    POOR = "poor"  #: one effect, with drives that excite little
    # What measured runs have besides, see :mod:`studies.blind_trials.trial`.
    GROSS = "gross"  #: one effect of 20 to 100 times its limit
    SHORT = "short"  #: one effect in 80 runs of 6 s
    LATE = "late"  #: a logger is late, beside one effect
    SCATTERED = "scattered"  #: an effect that differs from run to run
    STALLED = "stalled"  #: runs whose body is at rest, beside one effect
    HALF = "half"  #: an effect in half of the runs
    SENSOR_LATE = "sensor_late"  #: one sensor is late
    FAULT = "fault"  #: a sign, a unit or an order written into the log
    DYNAMIC = "dynamic"  #: runs of the dynamic simulation, half of the trials with nothing hidden
    KNOWN = "known"  #: a skid-steer robot of which the effective track is far off, in 80 runs of 6 s
    # Robots of other drives, none of which logs currents: each effect in turn, nothing in every fifth trial.
    TRACKED = "tracked"
    CAR = "car"


DRIVE_ROWS = (Row.TRACKED, Row.CAR)  #: of drives whose robots log no currents
ROBOTS = ("agrimaro", "husky")  #: trials take them in turn
ROBOTS_OF_ROW = {
    Row.SHORT: ROBOTS[1:],
    Row.KNOWN: ROBOTS[1:],
    Row.DYNAMIC: ROBOTS[:1],
    Row.TRACKED: ("patako", "marmotte"),
    Row.CAR: ("adap2e",),
}  #: robots of rows that have others
SHORT_RUNS = 80  #: number of runs where a run is one command of 6 s

STRONG = 3.0  #: amplitude over the detection limit, of an effect that has to be named
CLIP_RATIO = 0.9  #: ratio of the bounds of an effect, beyond which none is hidden
LADDER, FOUND_LADDER = (0.1, 10.0), (0.5, 6.5)  #: ranges of amplitudes over the limit, in these rows
OUTSIDE = ("wheel_eccentricity", "motor_drift", "stick_slip", "clock_rate")
"""Hidden in row ``outside``: two effects that no library has, and two whose entry is taken out."""
OUTSIDE_SIZES = {"wheel_eccentricity_ratio": (0.01, 0.04), "stick_slip_a": (5.0, 20.0)}
"""Ranges of the amplitudes of what no library has: a wheel's centre 2 to 8 mm off, spikes of a few ampere."""
ENTRY_TAKEN_OUT = (3.0, 10.0)  #: range over the limit, of those whose entry is taken out

TRACK, TRACK_RATIO = ("effective_track", "effective_track_ratio")
"""What scatters as well on a skid-steer robot."""


class Case(NamedTuple):
    """One trial to be done: its kind and number, the robot's name, how many runs, and the seed of all trials."""

    row: Row
    number: int
    robot: str
    n_runs: int
    seed: int


class Hidden(NamedTuple):
    """What is hidden in the runs of a trial."""

    library: tuple[Effect, ...]  #: effects that the diagnosis may name
    effects: Mapping[str, float] = MappingProxyType({})  #: values by parameter, of effects of the catalogue
    causes: tuple[str, ...] = ()  #: names of the effects that the diagnosis may and should name
    over_limit: float = 0.0  #: amplitude over the detection limit; 0 where nothing of the catalogue is hidden
    outside: str = ""  #: name of what is hidden and not in the library
    outside_values: Mapping[str, float] = MappingProxyType({})  #: values by parameter, of what no library has


def cases_of(row: Row, n: int, seed: int, n_runs: int) -> list[Case]:
    """Return ``n`` cases of a row, the robots in turn where a row has several.

    The rows of 6 s a run have :data:`SHORT_RUNS` of the skid-steer robot whatever is asked for.
    """
    robots = ROBOTS_OF_ROW.get(row, ROBOTS)
    n_runs = SHORT_RUNS if row in (Row.SHORT, Row.KNOWN) else n_runs
    return [Case(row, i, robots[i % len(robots)], n_runs, seed) for i in range(n)]


def draw_hidden(case: Case, robot: Robot, limits: Limits | None, rng: np.random.Generator) -> Hidden:
    """Draw what a trial hides; nothing without the ``limits`` of its drives."""
    library = library_of(robot.drive)
    if limits is None:
        return Hidden(library)
    turn = case.number // len(ROBOTS)
    if case.row is Row.OUTSIDE:
        return _draw_outside(OUTSIDE[turn % len(OUTSIDE)], limits, library, rng)
    acting = [effect for effect in library if not effect.modifies]  # the others do nothing alone
    if case.row is Row.FOUND:
        effect = acting[turn % len(acting)]
        over = log_uniform(rng, FOUND_LADDER)
        return Hidden(library, values_of(effect, limits, over, rng), (effect.name,), over)
    effect = acting[int(rng.integers(len(acting)))]
    over = log_uniform(rng, LADDER) if case.row is Row.LADDER else STRONG
    values = values_of(effect, limits, over, rng)
    if case.row is not Row.TWO:
        return Hidden(library, values, (effect.name,), over)
    alike = confusable_class(limits, effect, robot.drive) | {name for name, _ in effect.twins}
    others = [other for other in acting if other.name not in alike]
    others = [other for other in others if not _is_another_pair(limits, (effect, other), acting)]
    other = others[int(rng.integers(len(others)))]
    values |= values_of(other, limits, over, rng)
    return Hidden(library, values, (effect.name, other.name), over)


def log_uniform(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(math.exp(rng.uniform(*np.log(ends))))


def _is_another_pair(limits: Limits, pair: tuple[Effect, Effect], library: Sequence[Effect]) -> bool:
    """Return whether a third effect can take the place of one of two: no log distinguishes them then."""
    rest = [
        other for other in library if other not in pair and not any(limits.alike(one, other) for one in pair)
    ]
    return any(limits.spanned(pair, third) for third in rest)


def _draw_outside(kind: str, limits: Limits, library: tuple[Effect, ...], rng: np.random.Generator) -> Hidden:
    """Draw an effect that the library does not have: its entry is taken out, or there never was one."""
    if kind in [effect.name for effect in library]:
        effect = effect_named(kind)
        over = float(rng.uniform(*ENTRY_TAKEN_OUT))
        rest = tuple(other for other in library if other is not effect)
        return Hidden(rest, values_of(effect, limits, over, rng), (), over, kind)
    sizes = {name: ends for name, ends in OUTSIDE_SIZES.items() if name.startswith(kind)}
    return Hidden(library, outside=kind, outside_values={n: float(rng.uniform(*e)) for n, e in sizes.items()})


def values_of(effect: Effect, limits: Limits, over: float, rng: np.random.Generator) -> dict[str, float]:
    """Return values of an effect, of an amplitude over its limit, in a random direction within its bounds."""
    low, high = (np.array(ends) for ends in zip(*((p.low, p.high) for p in effect.parameters), strict=True))
    direction = rng.standard_normal(len(effect.parameters))
    direction /= np.linalg.norm(direction)
    direction = np.where((low == 0.0) & (direction < 0), -direction, direction)
    amplitude = over * limits.of(effect, direction)
    values = np.clip(amplitude * direction, CLIP_RATIO * low, CLIP_RATIO * high)
    return {p.name: float(value) for p, value in zip(effect.parameters, values, strict=True)}


def is_clipped(values: Mapping[str, float]) -> bool:
    """Return whether :func:`values_of` clipped a value.

    Examples
    --------
    >>> is_clipped({"gyro_scale_ratio": 0.135}), is_clipped({"gyro_scale_ratio": 0.13})
    (True, False)
    """
    return any(
        value != 0.0 and value in [CLIP_RATIO * bound for bound in BOUNDS[name]]
        for name, value in values.items()
    )


def hidden_runs(
    robot: Robot,
    drives: Drives,
    seed: np.random.SeedSequence,
    effects: Mapping[str, float] | Sequence[Mapping[str, float]],
    outside: Mapping[str, float] | None = None,
    *,
    scatter: Mapping[str, float] | None = None,
    heading: bool = False,
) -> tuple[RunLog, ...]:
    """Return the logs of drives with effects hidden in all of them; truth and source are removed.

    Parameters
    ----------
    effects : values by parameter, of all runs or of each one
    outside : amplitudes of what no library has
    scatter : of the runs; that of the package by default
    heading : log a heading that does not depend on the gyro, too
    """
    about = {
        "scatter": scatter or spread_numbers("scatter"),
        "noise": spread_numbers("noise"),
        "outside": outside,
        "heading": heading,
    }
    each = [effects] * len(drives.twists) if isinstance(effects, Mapping) else effects
    runs = []
    for i, (twist, hills, own) in enumerate(zip(drives.twists, drives.hills, each, strict=True)):
        draws = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i))
        names = {"run_id": f"run_{i + 1:02d}", "terrain": "ground"}
        run = simulate(robot, twist, Ground(), draws, effects=own, conditions=hills, **about, **names)
        shown = {name: stream for name, stream in run.streams.items() if name not in ("truth", "commands")}
        rate = own.get("clock_rate_ratio", 0.0)
        runs.append(_after(replace(run, streams=shown, source=""), drives.lead_s, rate))
    return tuple(runs)


def _after(run: RunLog, lead_s: float, clock_rate_ratio: float) -> RunLog:
    """Return a run from a time on, which becomes the 0 of its clocks: none has drifted there."""
    if lead_s == 0.0:
        return run
    streams = {}
    for name, stream in run.streams.items():
        after = stream.time_s >= lead_s - 0.5 / (2.0 * STEP_HZ)
        ahead_s = 0.0 if name == "wheels" else clock_rate_ratio * lead_s
        streams[name] = Stream(stream.time_s[after] - lead_s - ahead_s, stream.values[after], stream.channels)
    labels = tuple(label._replace(end_s=label.end_s - lead_s) for label in run.labels)
    return replace(run, streams=streams, labels=labels)


# -- Values of an effect that differ from run to run, as they do on measured robots ------------------------

SCATTER_RATIO = (0.1, 0.35)
"""Range of the deviation from run to run over the value, as measured robots show it."""


def factors(rng: np.random.Generator, ratio: float, n_runs: int) -> Array:
    """Return log-normal factors (n,) of mean 1: a factor never turns a sign.

    Examples
    --------
    >>> drawn = factors(np.random.default_rng(0), 0.3, 100_000)
    >>> round(float(drawn.mean()), 2), round(float(drawn.std()), 2), bool((drawn > 0).all())
    (1.0, 0.3, True)
    """
    std = math.sqrt(math.log(1.0 + ratio**2))
    return np.asarray(np.exp(std * rng.standard_normal(n_runs) - std**2 / 2))


def scattered_values(
    values: Mapping[str, float], rng: np.random.Generator, ratio: float, n_runs: int, *, track: bool
) -> list[dict[str, float]]:
    """Return the values of each run, within the bounds of the effects.

    Parameters
    ----------
    values : by parameter, the mean of all runs
    ratio : standard deviation over the value
    track : whether the effective track scatters as well, by the same ratio of the track
    """
    columns = {}
    for name, value in values.items():
        if not (track and name == TRACK_RATIO):
            columns[name] = value * factors(rng, ratio, n_runs)
    if track:
        columns[TRACK_RATIO] = (1.0 + values.get(TRACK_RATIO, 0.0)) * factors(rng, ratio, n_runs) - 1.0
    return [
        {name: float(np.clip(column[i], *BOUNDS[name])) for name, column in columns.items()}
        for i in range(n_runs)
    ]


# -- Logs whose stamps are late, and logs of stalled runs --------------------------------------------------

WHEELS_LOGGER = ("wheels", "steering")
"""Streams that one logger stamps; others: those of the effect ``clock_offset``."""
LOGGER_LATE_S = (0.15, 0.4)  #: range of its delay: wheels of measured robots are 0.26 to 0.28 s late
SENSOR_LATE_S = (0.1, 0.3)  #: range of the delay of one sensor: a measured lidar is 0.16 s late
STALLED_RATIO = (0.05, 0.15)  #: range of the ratio of runs that are stalled; one at the least
CREEP_RATIO = (0.0, 0.03)  #: range of the ratio of the wheels' motion that a stalled body follows


def with_late_streams(runs: Sequence[RunLog], names: Collection[str], late_s: float) -> tuple[RunLog, ...]:
    """Return runs in which some streams, where a run has them, are stamped later than they were sampled."""
    late = []
    for run in runs:
        own = {name: run.streams[name] for name in names if name in run.streams}
        shifted = {name: replace(stream, time_s=stream.time_s + late_s) for name, stream in own.items()}
        late.append(replace(run, streams={**run.streams, **shifted}))
    return tuple(late)


def draw_stalled(rng: np.random.Generator, n_runs: int) -> tuple[int, ...]:
    """Return which runs are stalled, in order."""
    n = max(1, round(rng.uniform(*STALLED_RATIO) * n_runs))
    return tuple(sorted(rng.choice(n_runs, n, replace=False).tolist()))


def with_stalled(
    runs: Sequence[RunLog],
    stalled: Sequence[int],
    rng: np.random.Generator,
    robot: Robot,
    drives: Drives,
    seed: np.random.SeedSequence,
    effects: Mapping[str, float] | Sequence[Mapping[str, float]],
    *,
    heading: bool = False,
) -> tuple[RunLog, ...]:
    """Return runs of :func:`hidden_runs` of which some are stalled: all but the wheels' logger sees a body creep."""
    creep = np.ones(len(runs))
    creep[list(stalled)] = rng.uniform(*CREEP_RATIO, len(stalled))
    slow = drives._replace(twists=tuple(t * c for t, c in zip(drives.twists, creep, strict=True)))
    out, seen = list(runs), hidden_runs(robot, slow, seed, effects, heading=heading)
    for i in stalled:
        driven = {name: stream for name, stream in runs[i].streams.items() if name in WHEELS_LOGGER}
        out[i] = replace(runs[i], streams={**seen[i].streams, **driven})
    return tuple(out)


# -- Logs of the DRIVE layout from those of the planar simulation: 20 Hz, a lidar, no currents and no tilt --
# DRIVE: Baril et al., ICRA 2024; see :mod:`terrain.logs.drive`.

RATE_HZ = 20.0  #: of all streams
CUTOFF_HZ = 0.4 * RATE_HZ  #: above which such a log holds nothing of the motion


def sensing_of(scatter: Mapping[str, float] | None = None) -> Sensing:
    """Return what such logs hold, of runs with a scatter."""
    return Sensing((GYRO, SPEED_X, SPEED_Y, HEADING), CUTOFF_HZ, scatter, tilt=False)


def with_lidar(run: RunLog) -> RunLog:
    """Return a skid-steer robot's run whose speeds over ground and heading rate are those of one lidar."""
    seen, heading = run.streams["odometry"], run.streams["lidar"]
    values = np.column_stack([seen.values, heading.values])
    streams = {name: stream for name, stream in run.streams.items() if name != "odometry"}
    return replace(run, streams={**streams, "lidar": Stream(seen.time_s, values, TWIST_CHANNELS)})


def as_command_log(run: RunLog) -> RunLog:
    """Return a skid-steer robot's run of the planar simulation, with a heading, as the DRIVE layout holds it."""
    full = with_lidar(run).streams
    wheels = tuple(name for name in full["wheels"].channels if name.startswith("speed_"))
    imu = ("gyro_z_radps", *(f"accel_{axis}_mps2" for axis in "xyz"))
    layout = {"wheels": wheels, "imu": imu, "lidar": TWIST_CHANNELS}
    end_s = min(full[name].time_s[-1] for name in layout)
    time_s, streams = np.arange(1, int(end_s * RATE_HZ)) / RATE_HZ, {}
    for name, channels in layout.items():
        columns = [_averaged(full[name].time_s, full[name].channel(c), time_s) for c in channels]
        streams[name] = Stream(time_s - time_s[0], np.column_stack(columns), channels)
    return replace(run, streams=streams)


def _averaged(stamps_s: Array, values: Array, time_s: Array) -> Array:
    """Return the mean of a signal over a period around each instant, so that nothing quick is aliased."""
    steps = np.diff(stamps_s) * (values[1:] + values[:-1]) / 2.0
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    half_s = 0.5 / RATE_HZ
    ends = [np.interp(time_s + side * half_s, stamps_s, integral) for side in (1.0, -1.0)]
    return np.asarray((ends[0] - ends[1]) * RATE_HZ)


# -- Runs of the dynamic simulation, which differs from the planar one that the diagnosis replays ----------
# They are made by what ``terrain simulate`` calls, and diagnosed as ``terrain explain`` does.

TERRAIN, SCENARIOS = "grass", ("complex", "starts", "survey")
HIDDEN = {"wheel_radius_ratio": 0.03}  #: in every second trial


class Setting(NamedTuple):
    """What is driven, whether conditions vary, and whether something is hidden."""

    scenario: str
    vary: bool
    hides: bool


def setting_of(number: int) -> Setting:
    """Return the setting of a trial: every combination in twelve.

    Examples
    --------
    >>> len({setting_of(number) for number in range(12)})
    12
    """
    return Setting(SCENARIOS[number // 2 % 3], number // 6 % 2 == 1, number % 2 == 1)


def dynamic_runs(
    robot: Robot, setting: Setting, seed: int, n_runs: int, effects: Mapping[str, float]
) -> tuple[RunLog, ...]:
    """Return runs 1, 2... of a scenario, as ``terrain explain`` diagnoses them; the truth is removed."""
    runs = []
    for number in range(1, n_runs + 1):
        run = simulate_run(robot, TERRAIN, setting.scenario, seed, number, vary=setting.vary, effects=effects)
        shown = {name: stream for name, stream in run.streams.items() if name != "truth"}
        runs.append(with_wheel_speeds(replace(run, streams=shown, source=""), robot))
    return tuple(runs)


def drives_of(runs: Sequence[RunLog]) -> Drives:
    """Return the commanded twists of runs on level ground."""
    axes = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    twists = [np.column_stack([run.streams["commands"].channel(axis) for axis in axes]) for run in runs]
    return Drives(tuple(twists), tuple(Conditions() for _ in runs))


# -- Faults written into logs: a sign, a unit, or two channels in each other's place, in all runs ----------
# They are no effects of a robot: the right answer is a sentence about the log.


class Statement(NamedTuple):
    """What an answer states of a fault of the logs: its kind, the channel or column, and the sentence."""

    kind: str
    channel: str
    sentence: str


class WrittenFault(NamedTuple):
    """A fault of a log: drives of robots whose logs show it, the stream, and what gives it the fault."""

    name: str
    drives: tuple[str, ...]
    stream: str
    write: Callable[[Stream, Robot], Stream]
    kind: FaultKind  #: of the statement, as :class:`terrain.discrepancy.health.Change` has it
    column: Column
    word: str = ""  #: in the sentence

    def stated_in(self, statements: Iterable[Statement]) -> bool:
        """Return whether one states this fault.

        Examples
        --------
        >>> FAULTS["gyro_deg"].stated_in([Statement("unit", "gyro", "the gyro is in deg/s")])
        True
        """
        return any(s[:2] == (self.kind, self.column) and self.word in s.sentence for s in statements)


def _scaled(part: str, factor: float) -> Callable[[Stream, Robot], Stream]:
    """Return what multiplies all channels whose name has a part."""

    def write(stream: Stream, _: Robot) -> Stream:
        values = stream.values.copy()
        values[:, [part in name for name in stream.channels]] *= factor
        return replace(stream, values=values)

    return write


def _swapped(*kinds: str) -> Callable[[Stream, Robot], Stream]:
    """Return what puts the channels of the last two wheels in each other's place.

    Of the catalogue's swerve robot the first two always turn alike, unless it drives sideways while it turns:
    their exchange leaves a log as it was.
    """

    def write(stream: Stream, robot: Robot) -> Stream:
        values = stream.values.copy()
        for kind in kinds:
            pair = [kind.format(wheel) for wheel in robot.wheels[-2:]]
            if set(pair) <= set(stream.channels):
                at = [stream.channels.index(name) for name in pair]
                values[:, at] = values[:, at[::-1]]
        return replace(stream, values=values)

    return write


_SIGN, _UNIT, _SWAPPED, _WHEELS = FaultKind.SIGN, FaultKind.UNIT, FaultKind.SWAPPED, Column.WHEELS
_KMH, _DEG, _RPM = _scaled("speed_", 3.6), _scaled("gyro_", 180.0 / math.pi), _scaled("motor_", 30 / math.pi)
_ALL_WHEELS = _swapped("speed_{}_mps", "motor_{}_radps")

FAULTS = {
    fault.name: fault
    for fault in (
        WrittenFault("gyro_sign", BOTH, "imu", _scaled("gyro_z_", -1.0), _SIGN, Column.GYRO),
        WrittenFault("gyro_deg", BOTH, "imu", _DEG, _UNIT, Column.GYRO, "deg/s"),
        WrittenFault("wheels_kmh", SKIDDING, "wheels", _KMH, _UNIT, _WHEELS, "km/h"),
        WrittenFault("camera_kmh", SKIDDING, "odometry", _KMH, _UNIT, Column.SPEED, "km/h"),
        WrittenFault("wheels_rpm", (SWERVE,), "wheels", _RPM, _UNIT, _WHEELS, "rpm"),
        WrittenFault(
            "swapped_currents", SKIDDING, "wheels", _swapped("current_{}_a"), _SWAPPED, Column.CURRENTS
        ),
        WrittenFault("swapped_wheels", BOTH, "wheels", _ALL_WHEELS, _SWAPPED, _WHEELS),
    )
}
"""By name.  A swap of currents does not show on a swerve robot, of which only their sum is compared."""


def faults_of(drive: str) -> tuple[WrittenFault, ...]:
    """Return the faults that logs of robots of a drive can have."""
    return tuple(fault for fault in FAULTS.values() if drive in fault.drives)


def with_fault(runs: Iterable[RunLog], fault: WrittenFault, robot: Robot) -> tuple[RunLog, ...]:
    """Return runs with a fault written into each log."""
    return tuple(
        replace(run, streams={**run.streams, fault.stream: fault.write(run.streams[fault.stream], robot)})
        for run in runs
    )


# -- A robot of known truth that resembles a measured skid-steer one, in five cases from simple to complete --

TRACK_ERROR = (
    1.5  #: effective track over the nominal, less 1: a measured Husky turns 2.5 times less than it says
)
TRACK_SCATTER, WHEELS_LATE_S, N_STALLED = 0.15, 0.28, 4
"""Scatter of the track from run to run, delay of the wheels' stamps, and number of stalled runs."""
VALUE_RATIO = 0.05  #: largest error of the effective track that counts as right


class Known(NamedTuple):
    """A case: its name, and what it has beside the track that is off."""

    name: str
    scatters: bool = False
    late: bool = False
    stalled: bool = False


KNOWN = (
    Known("plain"),
    Known("scatter", scatters=True),
    Known("late", late=True),
    Known("stalled", stalled=True),
    Known("all", scatters=True, late=True, stalled=True),
)
"""Trials take them in turn."""


def value_is_right(intervals: Mapping[str, tuple[float, float, float]]) -> bool:
    """Return whether an answer gives the effective track within :data:`VALUE_RATIO`.

    Examples
    --------
    >>> value_is_right({TRACK_RATIO: (1.6, 1.5, 1.7)}), value_is_right({TRACK_RATIO: (1.7, 1.5, 1.9)})
    (True, False)
    """
    off = intervals[TRACK_RATIO][0] - TRACK_ERROR if TRACK_RATIO in intervals else math.inf
    return abs(off) <= VALUE_RATIO * (1.0 + TRACK_ERROR)
