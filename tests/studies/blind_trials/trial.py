"""One blind trial: effects are hidden in simulated runs, and the diagnosis is asked for them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from studies.blind_trials.drives import Drives, car_drives, command_drives, poor_drives, rich_drives
from studies.blind_trials.hidden import (
    CLIP_RATIO,
    DRIVE_ROWS,
    HIDDEN,
    KNOWN,
    LOGGER_LATE_S,
    N_STALLED,
    ROBOTS,
    ROBOTS_OF_ROW,
    SCATTER_RATIO,
    SENSOR_LATE_S,
    STRONG,
    TRACK,
    TRACK_ERROR,
    TRACK_RATIO,
    TRACK_SCATTER,
    WHEELS_LATE_S,
    WHEELS_LOGGER,
    Case,
    Hidden,
    Row,
    Statement,
    as_command_log,
    draw_hidden,
    draw_stalled,
    drives_of,
    dynamic_runs,
    faults_of,
    hidden_runs,
    is_clipped,
    log_uniform,
    scattered_values,
    sensing_of,
    setting_of,
    values_of,
    with_fault,
    with_late_streams,
    with_lidar,
    with_stalled,
)
from studies.blind_trials.limits import Limits, Sensing, confusable_class, limits_of
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.diagnosed_runs import simulation_for
from terrain.discrepancy.held_out import split_runs
from terrain.discrepancy.runs import Simulation
from terrain.discrepancy.verdict import Diagnosis, Verdict
from terrain.effects import (
    ACCEL,
    CURRENT,
    GYRO,
    HEADING,
    LIBRARY,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    Effect,
    effect_named,
    library_of,
    nuisances_of,
)
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import BicycleRobot, Robot, load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers

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
    verdict: Verdict = Verdict.REFUSED
    """By default where the runs were not accepted, as too few seemed to be fit."""
    refusal: str = ""  #: why they were refused
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
        answer = _answered(
            diagnose(stage.runs, stage.simulation or simulation_of(robot), stage.hidden.library)
        )
    except DataError as error:
        answer = {"refusal": str(error)}
    return Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=len(stage.runs),
        hidden={**hidden.effects, **hidden.outside_values},
        causes=hidden.causes,
        outside=hidden.outside,
        over_limit=hidden.over_limit,
        classes=_classes(stage, robot, case.row),
        seconds=time.perf_counter() - start_s,
        **stage.asked,
        **answer,
    )


def _answered(answer: Diagnosis) -> dict[str, Any]:
    """Return the fields of a trial that are the answer."""
    causes, sets = answer.causes, answer.ambiguous_sets
    in_sets = [answer.ambiguous_values.get(name, ()) for names in sets for name in names]
    values = [value for some in (*in_sets, *(cause.parameters for cause in causes)) for value in some]
    offset_s = np.array([clock.offset_s for clock in answer.clocks])
    known_s = offset_s[np.isfinite(offset_s)]
    return {
        "verdict": answer.verdict,
        "named": tuple(cause.name for cause in causes),
        "sets": sets,
        "unexplained": tuple((left.channel, left.input) for left in answer.unexplained),
        "intervals": {value.name: (value.value, value.low, value.high) for value in values},
        "gain_low": min((cause.gain_ci[0] for cause in causes), default=math.nan),
        "clock_s": float(np.median(known_s)) if known_s.size else math.nan,
        "excluded": tuple(run.run_id for run in answer.excluded_runs),
        "varying": tuple(
            Varying(effect.name, tuple((group.value, group.runs) for group in effect.groups), effect.rivals)
            for effect in answer.varying
        ),
        "statements": tuple(
            Statement(fault.change.kind.value, fault.change.column.value, fault.sentence)
            for fault in answer.faults
        ),
    }


def _classes(stage: Stage, robot: Robot, row: Row) -> dict[str, tuple[str, ...]]:
    """Return, by cause, the effects that no log of these drives distinguishes from it."""
    if stage.limits is None:
        return {}
    has_heading = any("lidar" in run.streams for run in stage.runs)
    classes = {}
    for effect in (effect for effect in LIBRARY if effect.name in stage.hidden.causes):
        twins = {name for name, channel in effect.twins if not (has_heading and channel == HEADING)}
        twins |= confusable_class(stage.limits, effect, robot.drive)
        if row in DRIVE_ROWS:  # without currents a rolling resistance is nearly a smaller radius
            others, values = library_of(robot.drive), stage.hidden.effects
            twins |= {o.name for o in others if stage.limits.in_place_of(effect, values, o)}
        classes[effect.name] = tuple(sorted(twins))
    return classes


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
    simulation: Simulation | None = None  #: under test; None for the one with the known scatter


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
        """Draw an effect that these drives excite: its amplitude is within its bounds."""
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
    if case.row not in _STAGES:
        return _with_known_scatter(draw)
    stage = _STAGES[case.row](draw)
    # with the simulation that ``terrain explain`` would test
    return stage._replace(simulation=simulation_for(stage.runs, robot, stage.hidden.library)[0])


def _with_known_scatter(draw: Draw) -> Stage:
    """Rows whose runs have the scatter and the noise that the diagnosis is given."""
    case, robot, rng, _ = draw
    rich = draw.rich()
    drives = poor_drives(rng, case.n_runs) if case.row is Row.POOR else rich
    limits = None if case.row is Row.NONE else limits_of(robot, rich)
    hidden = draw_hidden(case, robot, limits, rng)
    return Stage(draw.runs(drives, hidden.effects, outside=hidden.outside_values), hidden, limits)


def _of_drive(draw: Draw) -> Stage:
    """Rows of robots whose logs have no currents: effects in turn of 3 times their limit, within their bounds."""
    robot, rng, library = draw.robot, draw.rng, draw.library
    drives = car_drives(rng, robot, draw.case.n_runs) if isinstance(robot, BicycleRobot) else draw.rich()
    turn = draw.case.number // len(ROBOTS_OF_ROW[draw.case.row])
    if turn % NOTHING_EVERY == NOTHING_EVERY - 1:
        return Stage(draw.runs(drives, {}), Hidden(library), None)
    limits = limits_of(robot, drives)
    most = {effect: CLIP_RATIO * min(p.high for p in effect.parameters) for effect in library}
    shown = [effect for effect in library if STRONG * limits.of(effect) < most[effect]]
    effect = shown[(turn - turn // NOTHING_EVERY) % len(shown)]
    values = values_of(effect, limits, STRONG, rng)
    while is_clipped(values):  # in another direction it is not
        values = values_of(effect, limits, STRONG, rng)
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
        scatter = {**scatter, "effective_track_ratio": ratio}
    limits = limits_of(robot, drives, Sensing(scatter=scatter))
    hidden = draw.strong(limits)
    each = scattered_values(hidden.effects, draw.rng, ratio, n_runs, track=robot.skids)
    asked = {"variant": f"{ratio:.0%}", "accepted": (TRACK,) if robot.skids else ()}
    return Stage(draw.runs(drives, each), hidden, limits, asked)


def _stalled(draw: Draw) -> Stage:
    drives = draw.rich()
    limits = limits_of(draw.robot, drives)
    hidden = draw.strong(limits)
    runs = draw.runs(drives, hidden.effects)
    places = draw_stalled(draw.rng, len(runs))
    runs = with_stalled(runs, places, draw.rng, draw.robot, drives, draw.noise, hidden.effects)
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
    runs = with_fault(draw.runs(draw.rich(), {}), fault, draw.robot)
    return Stage(runs, Hidden(draw.library), None, {"variant": fault.name, "fault": fault.name})


def _dynamic(draw: Draw) -> Stage:
    setting = setting_of(draw.case.number)
    seed, values = int(draw.rng.integers(2**31)), HIDDEN if setting.hides else {}
    runs = dynamic_runs(draw.robot, setting, seed, draw.case.n_runs, values)
    used, _ = split_runs(runs, None, 0)
    causes = tuple(e.name for e in draw.library if e.parameters[0].name in values)
    limits = limits_of(draw.robot, drives_of(used)) if values else None
    variant = f"{setting.scenario}, varied" if setting.vary else setting.scenario
    return Stage(tuple(used), Hidden(draw.library, dict(values), causes), limits, {"variant": variant})


def _known(draw: Draw) -> Stage:
    robot, rng, n_runs = draw.robot, draw.rng, draw.case.n_runs
    known = KNOWN[draw.case.number % len(KNOWN)]
    drives = command_drives(rng, robot, n_runs)
    scatter, each = spread_numbers("scatter"), [{TRACK_RATIO: TRACK_ERROR}] * n_runs
    if known.scatters:
        scatter = {**scatter, "effective_track_ratio": TRACK_SCATTER}
        each = scattered_values(each[0], rng, TRACK_SCATTER, n_runs, track=True)
    limits = limits_of(robot, drives, sensing_of(scatter))
    runs, places = draw.runs(drives, each, heading=True), ()
    if known.stalled:
        places = tuple(sorted(rng.choice(n_runs, N_STALLED, replace=False).tolist()))
        runs = with_stalled(runs, places, rng, robot, drives, draw.noise, each, heading=True)
    runs, asked = tuple(map(as_command_log, runs)), {"variant": known.name}
    if known.late:
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
