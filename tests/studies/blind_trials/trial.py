"""Blind trials: effects are hidden in simulated runs at random around their detection limits, and asked for.

They are diagnosed by what ``terrain explain`` calls, a quarter of the runs held out; it gets logs without truth and
without source, and knows nothing of this module.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from studies.blind_trials.drives import (
    STEP_HZ,
    Drives,
    car_drives,
    command_drives,
    poor_drives,
    rich_drives,
)
from studies.blind_trials.limits import Limits, Sensing, confusable_class, limits_of
from terrain.discrepancy.diagnosed_runs import diagnose_runs
from terrain.discrepancy.health.fault import Column, FaultKind
from terrain.discrepancy.runs import Simulation
from terrain.discrepancy.verdict import Tier
from terrain.effects import (
    ACCEL,
    BOTH,
    BOUNDS,
    CURRENT,
    GYRO,
    HEADING,
    LIBRARY,
    PARAMETER,
    SKIDDING,
    SPEED_X,
    SPEED_Y,
    SWERVE,
    TURNING_CURRENT,
    Effect,
    effect_named,
    library_of,
    nuisances_of,
)
from terrain.errors import DataError
from terrain.logs.schema import TWIST
from terrain.records import Array, RunLog, Stream
from terrain.robots import BicycleRobot, Robot, load_robot
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
    # What measured runs have besides.
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
CLIP_RATIO = 0.9  #: ratio of the plausible range of an effect, beyond which none is hidden
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


def log_uniform(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(math.exp(rng.uniform(*np.log(ends))))


def values_of(effect: Effect, limits: Limits, over: float, rng: np.random.Generator) -> dict[str, float]:
    """Return values of an effect, of an amplitude over its limit, in a random direction within its plausible range."""
    low, high = (np.array(ends) for ends in zip(*(p.plausible for p in effect.parameters), strict=True))
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
    >>> is_clipped({"gyro_scale_ratio": 0.9 * 0.08}), is_clipped({"gyro_scale_ratio": 0.04})
    (True, False)
    """
    return any(
        value != 0.0 and value in [CLIP_RATIO * end for end in PARAMETER[name].plausible]
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
    runs, lead_s = [], drives.lead_s
    for i, (twist, hills, own) in enumerate(zip(drives.twists, drives.hills, each, strict=True)):
        draws = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i))
        names = {"run_id": f"run_{i + 1:02d}", "terrain": "ground"}
        run = simulate(robot, twist, Ground(), draws, effects=own, conditions=hills, **about, **names)
        shown = {name: stream for name, stream in run.streams.items() if name not in ("truth", "commands")}
        labels = run.labels
        if lead_s > 0.0:  # the log begins after the lead, at the 0 of its clocks: none has drifted there
            labels = tuple(label._replace(end_s=label.end_s - lead_s) for label in labels)
            for name, stream in shown.items():
                after = stream.time_s >= lead_s - 0.5 / (2.0 * STEP_HZ)
                ahead_s = 0.0 if name == "wheels" else own.get("clock_rate_ratio", 0.0) * lead_s
                time_s = stream.time_s[after] - lead_s - ahead_s
                shown[name] = Stream(time_s, stream.values[after], stream.channels)
        runs.append(replace(run, streams=shown, labels=labels, source=""))
    return tuple(runs)


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


def with_stalled(
    draw: Draw,
    runs: Sequence[RunLog],
    stalled: Sequence[int],
    drives: Drives,
    effects: Mapping[str, float] | Sequence[Mapping[str, float]],
    **options: Any,
) -> tuple[RunLog, ...]:
    """Return runs of :meth:`Draw.runs` of which some are stalled: all but the wheels' logger sees a body creep."""
    creep = np.ones(len(runs))
    creep[list(stalled)] = draw.rng.uniform(*CREEP_RATIO, len(stalled))
    slow = drives._replace(twists=tuple(t * c for t, c in zip(drives.twists, creep, strict=True)))
    out, seen = list(runs), draw.runs(slow, effects, **options)
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
    return replace(run, streams={**streams, "lidar": Stream(seen.time_s, values, TWIST)})


def as_command_log(run: RunLog) -> RunLog:
    """Return a skid-steer robot's run of the planar simulation, with a heading, as the DRIVE layout holds it."""
    full = with_lidar(run).streams
    wheels = tuple(name for name in full["wheels"].channels if name.startswith("speed_"))
    imu = ("gyro_z_radps", *(f"accel_{axis}_mps2" for axis in "xyz"))
    layout = {"wheels": wheels, "imu": imu, "lidar": TWIST}
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
# They are made by what ``terrain simulate`` calls.

TERRAIN, SCENARIOS = "grass", ("complex", "starts", "survey")
HIDDEN = {"wheel_radius_ratio": 0.03}  #: in every second trial


def dynamic_runs(
    robot: Robot, scenario: str, vary: bool, seed: int, n_runs: int, effects: Mapping[str, float]
) -> tuple[RunLog, ...]:
    """Return runs 1, 2... of a scenario, without the truth."""
    runs = []
    for number in range(1, n_runs + 1):
        run = simulate_run(robot, TERRAIN, scenario, seed, number, vary=vary, effects=effects)
        shown = {name: stream for name, stream in run.streams.items() if name != "truth"}
        runs.append(replace(run, streams=shown, source=""))
    return tuple(runs)


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
    kind: FaultKind  #: of the statement, as :class:`terrain.discrepancy.health.fault.Change` has it
    column: Column
    word: str = ""  #: in the sentence

    def written(self, run: RunLog, robot: Robot) -> RunLog:
        """Return a run with the fault written into its log."""
        return replace(run, streams={**run.streams, self.stream: self.write(run.streams[self.stream], robot)})

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


# -- A robot of known truth that resembles a measured skid-steer one, in five cases from simple to complete --

TRACK_ERROR = 1.5
"""Effective track over the nominal, less 1: a measured Husky turns 2.5 times less than it says."""
TRACK_SCATTER, WHEELS_LATE_S, N_STALLED = 0.15, 0.28, 4
"""Scatter of the track from run to run, delay of the wheels' stamps, and number of stalled runs."""
VALUE_RATIO = 0.05  #: largest error of the effective track that counts as right


KNOWN = {
    "plain": (),
    "scatter": ("scatter",),
    "late": ("late",),
    "stalled": ("stalled",),
    "all": ("scatter", "late", "stalled"),
}
"""Cases by name, which trials take in turn: what each has beside the track that is off."""


def value_is_right(intervals: Mapping[str, tuple[float, float, float]]) -> bool:
    """Return whether an answer gives the effective track within :data:`VALUE_RATIO`.

    Examples
    --------
    >>> value_is_right({TRACK_RATIO: (1.6, 1.5, 1.7)}), value_is_right({TRACK_RATIO: (1.7, 1.5, 1.9)})
    (True, False)
    """
    off = intervals[TRACK_RATIO][0] - TRACK_ERROR if TRACK_RATIO in intervals else math.inf
    return abs(off) <= VALUE_RATIO * (1.0 + TRACK_ERROR)


# -- One trial: what was hidden, and what the diagnosis answered ------------------------------------------

CLOCK = "clock_offset"  #: effect that a late logger is
CLOCK_STATED_S = 0.04  #: largest error of its delay that is stated: two samples of the wheels' logger


class Varying(NamedTuple):
    """An effect that differs from run to run as it was answered: value and run ids of each group, and its rivals."""

    name: str
    groups: tuple[tuple[float, tuple[str, ...]], ...]
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trial:
    """What was hidden, and what the diagnosis answered."""

    row: Row
    number: int
    robot: str
    n_runs: int
    hidden: dict[str, float]  #: values by parameter
    causes: tuple[str, ...]  #: names of the effects hidden
    outside: str  #: name of what is hidden and not in the library
    over_limit: float  #: amplitude over the detection limit, of a single effect
    classes: dict[str, tuple[str, ...]]  #: by cause, the effects of its confusable class
    seconds: float  #: duration of the diagnosis
    # -- what is asked, by some rows
    variant: str = ""  #: of the row, where it has several
    accepted: tuple[str, ...] = ()  #: names that are no error beside the causes
    clipped: bool = False  #: whether an amplitude was beyond the bounds of its effect
    late_s: float = math.nan  #: how far the logger of IMU and camera is behind that of the wheels
    stalled: tuple[str, ...] = ()  #: ids of the runs that are stalled
    present: tuple[str, ...] = ()  #: ids of those that have the effect if only some do
    fault: str = ""  #: name of the one written into the logs
    # -- the answer
    verdict: Tier | None = None
    refusal: str = ""  #: why the runs were not accepted, as too few seemed to be fit
    named: tuple[str, ...] = ()
    sets: tuple[tuple[str, ...], ...] = ()
    unexplained: tuple[tuple[str, str], ...] = ()
    intervals: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    gain_low: float = math.nan  #: lower end of the smallest held-out gain of a cause
    clock_s: float = math.nan  #: median delay of IMU and camera that is stated
    excluded: tuple[str, ...] = ()  #: ids of the runs that were excluded
    varying: tuple[Varying, ...] = ()  #: effects that differ from run to run
    statements: tuple[Statement, ...] = ()  #: on faults of the logs

    def found(self, cause: str) -> bool:
        """Return whether a hidden effect is named, alone or in a set with none but its confusable class.

        A late logger is found by the delay that is stated, too.
        """
        twins = {cause, *self.classes.get(cause, ())}
        if cause == CLOCK and abs(self.clock_s - self.late_s) <= CLOCK_STATED_S:
            return True
        return cause in self.named or any(cause in names and set(names) <= twins for names in self.sets)

    @property
    def right(self) -> bool:
        """Whether all that is hidden is named, and nothing else."""
        return all(self.found(cause) for cause in self.causes) and not self.wrong

    @property
    def wrong(self) -> bool:
        """Whether something is named, alone or in a set, that is not hidden."""
        fine = {*self.causes, *self.accepted}
        return bool(set(self.named) - fine) or any(not set(names) & fine for names in self.sets)


def simulation_of(robot: Robot) -> Simulation:
    """Return the simulation under test, with the known scatter from run to run."""
    every = spread_numbers("scatter")
    scatter = {name: every[name] for name in nuisances_of(robot.drive)}
    return Simulation(robot, Ground(), robot.effects, scatter)


def run_trial(case: Case) -> Trial:
    """Hide effects in simulated runs, diagnose them, and return both."""
    robot = load_robot(case.robot)
    key = [case.seed, case.number, list(Row).index(case.row), case.n_runs]
    drawn, noise = np.random.SeedSequence(key).spawn(2)
    stage = stage_of(case, robot, np.random.default_rng(drawn), noise)
    hidden, start_s = stage.hidden, time.perf_counter()
    try:
        found = diagnose_runs(stage.runs, robot, hidden.library, None, case.seed).diagnosis
    except DataError as error:
        answer: dict[str, Any] = {"refusal": str(error)}
    else:
        in_sets = [found.ambiguous_values.get(name, ()) for names in found.ambiguous_sets for name in names]
        values = [v for some in (*in_sets, *(cause.parameters for cause in found.causes)) for v in some]
        offset_s = np.array([clock.offset_s for clock in found.clocks])
        known_s = offset_s[np.isfinite(offset_s)]
        answer = {
            "verdict": found.verdict,
            "named": tuple(cause.name for cause in found.causes),
            "sets": found.ambiguous_sets,
            "unexplained": tuple((left.channel, left.input) for left in found.unexplained),
            "intervals": {value.name: (value.value, value.low, value.high) for value in values},
            "gain_low": min((cause.gain_ci[0] for cause in found.causes), default=math.nan),
            "clock_s": float(np.median(known_s)) if known_s.size else math.nan,
            "excluded": tuple(run.run_id for run in (*found.excluded_runs, *found.gain.excluded_runs)),
            "varying": tuple(
                Varying(
                    effect.name, tuple((group.value, group.runs) for group in effect.groups), effect.rivals
                )
                for effect in found.varying
            ),
            "statements": tuple(
                Statement(fault.change.kind.value, fault.change.column.value, fault.sentence)
                for fault in found.faults
            ),
        }
    seconds = time.perf_counter() - start_s
    # by cause, the effects that no log of these drives distinguishes from it
    classes, limits = {}, stage.limits
    has_heading = any("lidar" in run.streams for run in stage.runs)
    for effect in (effect for effect in LIBRARY if limits and effect.name in hidden.causes):
        twins = {name for name, channel in effect.twins if not (has_heading and channel == HEADING)}
        twins |= confusable_class(limits, effect, robot.drive)
        if case.row in DRIVE_ROWS:  # without currents a rolling resistance is nearly a smaller radius
            others = library_of(robot.drive)
            twins |= {o.name for o in others if limits.in_place_of(effect, hidden.effects, o)}
        classes[effect.name] = tuple(sorted(twins))
    return Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=len(stage.runs),
        hidden={**hidden.effects, **hidden.outside_values},
        causes=hidden.causes,
        outside=hidden.outside,
        over_limit=hidden.over_limit,
        classes=classes,
        seconds=seconds,
        **stage.asked,
        **answer,
    )


# -- A trial before the diagnosis: what it is given, and what is kept from it ------------------------------

CLEAR = (STRONG, 20.0)
"""Range of amplitudes over the limit beside what measured runs have: from one that has to be named to where
row ``gross`` begins."""
GROSS = (20.0, 100.0)  #: range in row ``gross``
SHORT = (10.0, 50.0)
"""Range in row ``short``: a replay of samples at 20 Hz is off by one limit of a delay, 0.3 ms, and the effect
that has to be named is clear of that."""
NOTHING_EVERY = 5  #: in rows of a drive one trial of so many hides nothing
LATE_STREAMS = {"gyro": ("imu",), "camera": ("odometry",), "lidar": ("lidar",)}
"""Sensors that are late in row ``sensor_late``, and their streams."""
LATE_CAUSES = {
    "gyro": ("imu_latency",),
    "camera": ("camera_latency",),
    "lidar": ("lidar_latency", "camera_latency"),
}
"""Effects that a late sensor is: the first that the catalogue has, or the last."""


class Stage(NamedTuple):
    """A trial before the diagnosis."""

    runs: tuple[RunLog, ...]  #: that the diagnosis gets
    hidden: Hidden  #: in them
    limits: Limits | None  #: of the drives, for the confusable classes; None where nothing is hidden
    asked: Mapping[str, Any] = MappingProxyType({})  #: fields of a trial that some rows have


class Draw(NamedTuple):
    """Case, robot, generator, and seed of the noise."""

    case: Case
    robot: Robot
    rng: np.random.Generator
    noise: np.random.SeedSequence

    @property
    def library(self) -> tuple[Effect, ...]:
        """Effects that apply to the robot."""
        return library_of(self.robot.drive)

    @property
    def turn(self) -> int:
        """How many trials of the robot came before."""
        return self.case.number // len(ROBOTS)

    def rich(self) -> Drives:
        """Return drives that excite all effects."""
        return rich_drives(self.rng, self.case.n_runs)

    def runs(self, drives: Drives, effects: Any, **options: Any) -> tuple[RunLog, ...]:
        """Return the logs of drives with effects hidden."""
        return hidden_runs(self.robot, drives, self.noise, effects, **options)

    def strong(
        self, limits: Limits, over_limit: tuple[float, float] = CLEAR, without: Sequence[str] = ()
    ) -> Hidden:
        """Draw an effect that these drives excite: its amplitude is plausible."""
        over = log_uniform(self.rng, over_limit)
        fit = [e for e in self.library if e.name not in without and e.parameters[0].name in limits.names]
        for i in self.rng.permutation(len(fit)):
            values = values_of(fit[i], limits, over, self.rng)
            if not is_clipped(values):
                return Hidden(self.library, values, (fit[i].name,), over)
        raise RuntimeError(
            f"no effect of {over:.1f} times its limit is within its bounds"
        )  # no drives do that


def stage_of(case: Case, robot: Robot, rng: np.random.Generator, noise: np.random.SeedSequence) -> Stage:
    """Draw a trial: ``rng`` draws what is driven and hidden, ``noise`` seeds all that differs from run to run."""
    draw = Draw(case, robot, rng, noise)
    return _STAGES.get(case.row, _with_known_scatter)(draw)


def _with_known_scatter(draw: Draw) -> Stage:
    """Rows whose runs have the scatter and the noise that the diagnosis is given."""
    case, rng, library = draw.case, draw.rng, draw.library
    rich = rich_drives(rng, case.n_runs)
    drives = poor_drives(rng, case.n_runs) if case.row is Row.POOR else rich
    if case.row is Row.NONE:
        return Stage(draw.runs(drives, {}), Hidden(library), None)
    limits, turn = limits_of(draw.robot, rich), case.number // len(ROBOTS)
    acting = [effect for effect in library if not effect.modifies]  # the others do nothing alone
    over = STRONG
    if case.row is Row.OUTSIDE:
        kind = OUTSIDE[turn % len(OUTSIDE)]
        if kind in [effect.name for effect in library]:  # its entry is taken out
            over = float(rng.uniform(*ENTRY_TAKEN_OUT))
            rest = tuple(other for other in library if other.name != kind)
            hidden = Hidden(rest, values_of(effect_named(kind), limits, over, rng), (), over, kind)
        else:
            ranges = {name: ends for name, ends in OUTSIDE_SIZES.items() if name.startswith(kind)}
            sizes = {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}
            hidden = Hidden(library, outside=kind, outside_values=sizes)
        return Stage(draw.runs(drives, hidden.effects, outside=hidden.outside_values), hidden, limits)
    if case.row is Row.FOUND:
        effect, over = acting[turn % len(acting)], log_uniform(rng, FOUND_LADDER)
    else:
        effect = acting[int(rng.integers(len(acting)))]
        over = log_uniform(rng, LADDER) if case.row is Row.LADDER else STRONG
    values, causes = values_of(effect, limits, over, rng), [effect]
    if case.row is Row.TWO:
        alike = confusable_class(limits, effect, draw.robot.drive) | {name for name, _ in effect.twins}

        def is_distinct(other: Effect) -> bool:
            """Return whether no third effect can take the place of one of the two."""
            pair = effect, other
            rest = [e for e in acting if e not in pair and not any(limits.alike(one, e) for one in pair)]
            return not any(limits.spanned(pair, third) for third in rest)

        others = [other for other in acting if other.name not in alike and is_distinct(other)]
        causes.append(others[int(rng.integers(len(others)))])
        values |= values_of(causes[1], limits, over, rng)
    hidden = Hidden(library, values, tuple(cause.name for cause in causes), over)
    return Stage(draw.runs(drives, values), hidden, limits)


def _of_drive(draw: Draw) -> Stage:
    """Rows of robots whose logs have no currents: effects in turn of 3 times their limit, of a plausible size."""
    robot, rng, library = draw.robot, draw.rng, draw.library
    drives = car_drives(rng, robot, draw.case.n_runs) if isinstance(robot, BicycleRobot) else draw.rich()
    turn = draw.case.number // len(ROBOTS_OF_ROW[draw.case.row])
    if turn % NOTHING_EVERY == NOTHING_EVERY - 1:
        return Stage(draw.runs(drives, {}), Hidden(library), None)
    limits = limits_of(robot, drives)
    most = {effect: CLIP_RATIO * min(p.plausible[1] for p in effect.parameters) for effect in library}
    shown = [effect for effect in library if STRONG * limits.of(effect) < most[effect]]
    effect = shown[(turn - turn // NOTHING_EVERY) % len(shown)]
    while is_clipped(values := values_of(effect, limits, STRONG, rng)):
        pass  # in another direction it is not
    return Stage(draw.runs(drives, values), Hidden(library, values, (effect.name,), STRONG), limits)


def _gross(draw: Draw) -> Stage:
    drives = draw.rich()
    limits = limits_of(draw.robot, drives)
    seen = [effect for effect in draw.library if math.isfinite(limits.of(effect))]
    effect = seen[int(draw.rng.integers(len(seen)))]
    over = log_uniform(draw.rng, GROSS)
    values = values_of(effect, limits, over, draw.rng)
    hidden = Hidden(draw.library, values, (effect.name,), over)
    return Stage(draw.runs(drives, values), hidden, limits, {"clipped": is_clipped(values)})


def _short(draw: Draw) -> Stage:
    drives = command_drives(draw.rng, draw.robot, draw.case.n_runs)
    limits = limits_of(draw.robot, drives, sensing_of())
    hidden = draw.strong(limits, SHORT)
    runs = draw.runs(drives, hidden.effects, heading=True)
    return Stage(tuple(map(as_command_log, runs)), hidden, limits)


def _late(draw: Draw) -> Stage:
    drives = draw.rich()
    every = limits_of(draw.robot, drives)
    others = effect_named(CLOCK).parameters[0].inverse.streams  # whom that effect makes late
    loggers = ("wheels", WHEELS_LOGGER, -1.0), ("imu and camera", others, 1.0)
    variant, names, sign = loggers[draw.turn % 2]
    late_s = float(draw.rng.uniform(*LOGGER_LATE_S))
    alike = confusable_class(every, effect_named(CLOCK), draw.robot.drive)
    hidden = draw.strong(every.free("clock_offset_s"), without=tuple(alike))
    runs = with_late_streams(draw.runs(drives, hidden.effects), names, late_s)
    both = hidden._replace(causes=(CLOCK, *hidden.causes))
    return Stage(runs, both, every, {"variant": variant, "late_s": sign * late_s})


def _scattered(draw: Draw) -> Stage:
    drives, robot, n_runs = draw.rich(), draw.robot, draw.case.n_runs
    ratio = float(draw.rng.uniform(*SCATTER_RATIO))
    scatter = spread_numbers("scatter")
    if robot.skids:
        scatter = {**scatter, TRACK_RATIO: ratio}
    limits = limits_of(robot, drives, Sensing(scatter=scatter))
    hidden = draw.strong(limits)
    each = scattered_values(hidden.effects, draw.rng, ratio, n_runs, track=robot.skids)
    asked = {"variant": f"{ratio:.0%}", "accepted": (TRACK,) if robot.skids else ()}
    return Stage(draw.runs(drives, each), hidden, limits, asked)


def _stalled(draw: Draw) -> Stage:
    drives, n_runs = draw.rich(), draw.case.n_runs
    limits = limits_of(draw.robot, drives)
    hidden = draw.strong(limits)
    runs = draw.runs(drives, hidden.effects)
    n = max(1, round(draw.rng.uniform(*STALLED_RATIO) * n_runs))
    places = sorted(draw.rng.choice(n_runs, n, replace=False).tolist())
    runs = with_stalled(draw, runs, places, drives, hidden.effects)
    return Stage(runs, hidden, limits, {"stalled": tuple(runs[i].run_id for i in places)})


def _half(draw: Draw) -> Stage:
    drives, n_runs = draw.rich(), draw.case.n_runs
    places = sorted(draw.rng.permutation(n_runs)[: n_runs // 2].tolist())
    some = Drives(tuple(drives.twists[i] for i in places), tuple(drives.hills[i] for i in places))
    limits = limits_of(draw.robot, some)
    hidden = draw.strong(limits)
    runs = draw.runs(drives, [hidden.effects if i in places else {} for i in range(n_runs)])
    return Stage(runs, hidden, limits, {"present": tuple(runs[i].run_id for i in places)})


def _sensor_late(draw: Draw) -> Stage:
    drives, robot = draw.rich(), draw.robot
    sensors = tuple(LATE_STREAMS) if robot.skids else ("gyro", "camera")
    sensor = sensors[draw.turn % len(sensors)]
    late_s = float(draw.rng.uniform(*SENSOR_LATE_S))
    lidar = sensor == "lidar"
    runs = draw.runs(drives, {}, heading=lidar)
    channels = (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
    limits = limits_of(robot, drives, Sensing(channels) if lidar else None)
    if lidar:
        runs = tuple(map(with_lidar, runs))
    names = [effect.name for effect in draw.library]
    cause = next((name for name in LATE_CAUSES[sensor] if name in names), LATE_CAUSES[sensor][-1])
    hidden = Hidden(draw.library, {f"{cause}_s": late_s}, (cause,))
    return Stage(with_late_streams(runs, LATE_STREAMS[sensor], late_s), hidden, limits, {"variant": sensor})


def _fault(draw: Draw) -> Stage:
    faults = faults_of(draw.robot.drive)
    fault = faults[draw.turn % len(faults)]
    runs = [fault.written(run, draw.robot) for run in draw.runs(draw.rich(), {})]
    return Stage(tuple(runs), Hidden(draw.library), None, {"variant": fault.name, "fault": fault.name})


def _dynamic(draw: Draw) -> Stage:
    """Every combination of scenario, varied conditions and whether something is hidden, in twelve."""
    number = draw.case.number
    scenario, vary, values = SCENARIOS[number // 2 % 3], number // 6 % 2 == 1, HIDDEN if number % 2 else {}
    seed = int(draw.rng.integers(2**31))
    runs = dynamic_runs(draw.robot, scenario, vary, seed, draw.case.n_runs, values)
    causes, limits = tuple(e.name for e in draw.library if e.parameters[0].name in values), None
    if values:  # of the commanded twists on level ground
        axes = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
        twists = [np.column_stack([run.streams["commands"].channel(axis) for axis in axes]) for run in runs]
        limits = limits_of(draw.robot, Drives(tuple(twists), (Conditions(),) * len(twists)))
    variant = f"{scenario}, varied" if vary else scenario
    return Stage(runs, Hidden(draw.library, dict(values), causes), limits, {"variant": variant})


def _known(draw: Draw) -> Stage:
    robot, rng, n_runs = draw.robot, draw.rng, draw.case.n_runs
    variant, beside = [*KNOWN.items()][draw.case.number % len(KNOWN)]
    drives = command_drives(rng, robot, n_runs)
    scatter, each = spread_numbers("scatter"), [{TRACK_RATIO: TRACK_ERROR}] * n_runs
    if "scatter" in beside:
        scatter = {**scatter, TRACK_RATIO: TRACK_SCATTER}
        each = scattered_values(each[0], rng, TRACK_SCATTER, n_runs, track=True)
    limits = limits_of(robot, drives, sensing_of(scatter))
    runs, places = draw.runs(drives, each, heading=True), ()
    if "stalled" in beside:
        places = tuple(sorted(rng.choice(n_runs, N_STALLED, replace=False).tolist()))
        runs = with_stalled(draw, runs, places, drives, each, heading=True)
    runs, asked = tuple(map(as_command_log, runs)), {"variant": variant}
    if "late" in beside:
        runs = with_late_streams(runs, WHEELS_LOGGER, WHEELS_LATE_S)
        asked |= {"accepted": (CLOCK,), "late_s": -WHEELS_LATE_S}
    asked["stalled"] = tuple(runs[i].run_id for i in places)
    return Stage(runs, Hidden(draw.library, {TRACK_RATIO: TRACK_ERROR}, (TRACK,)), limits, asked)


_STAGES: dict[Row, Callable[[Draw], Stage]] = {
    Row.GROSS: _gross,
    Row.SHORT: _short,
    Row.LATE: _late,
    Row.SCATTERED: _scattered,
    Row.STALLED: _stalled,
    Row.HALF: _half,
    Row.SENSOR_LATE: _sensor_late,
    Row.FAULT: _fault,
    Row.DYNAMIC: _dynamic,
    Row.KNOWN: _known,
    Row.TRACKED: _of_drive,
    Row.CAR: _of_drive,
}
