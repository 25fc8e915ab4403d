"""One blind trial: effects are hidden in simulated runs, and the diagnosis is asked for them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    scattered_values,
    sensing_of,
    setting_of,
    track_of_runs,
    values_of,
    with_fault,
    with_late_streams,
    with_lidar,
    with_stalled,
)
from studies.blind_trials.limits import Limits, Sensing, confusable_class, limits_of
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.held_out import split_runs
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.terrain_match import simulation_for
from terrain.discrepancy.verdict import Diagnosis, Verdict
from terrain.effects import (
    ACCEL,
    CURRENT,
    GYRO,
    HEADING,
    LIBRARY,
    OTHER_LOGGER,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    effect_named,
    library_of,
    nuisances_of,
)
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import BicycleRobot, Robot, load_robot
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_scatter

CLOCK_STATED_S = 0.04
"""Largest error of the delay between two loggers that is stated: two samples of the wheels' logger."""


OF_STAGE = ("variant", "accepted", "clipped", "late_s", "stalled", "present", "fault")
"""What a trial takes from its stage as it is."""


class Varying(NamedTuple):
    """An effect that differs from run to run as it was answered: value and run ids of each group, and its rivals."""

    name: str
    groups: tuple[tuple[float, tuple[str, ...]], ...]
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trial:
    """What was hidden, and what the diagnosis answered.

    Parameters
    ----------
    row, number, robot, n_runs : of the case; ``n_runs`` that were made
    hidden : values by parameter
    causes : names of the effects hidden
    outside : name of what is hidden and not in the library
    over_limit : amplitude over the detection limit, of a single effect
    classes : by cause, the effects of its confusable class
    verdict : ``REFUSED`` where the diagnosis did not accept the runs, as too few seemed to be fit
    named, sets, unexplained : the answer
    intervals : by parameter named, alone or in a set: value, lower and upper end of its 95 % interval
    gain_low : lower end of the smallest held-out gain of a cause
    seconds : duration of the diagnosis
    variant, accepted, clipped, late_s, stalled, present, fault : as a
        :class:`~studies.blind_trials.trial.Stage` has them
    clock_s : median delay of IMU and camera that the answer states; NaN where it states none
    excluded : ids of the runs that were excluded
    varying : effects that differ from run to run
    statements : what the answer states of faults of the logs
    refusal : why the runs were refused
    """

    row: Row
    number: int
    robot: str
    n_runs: int
    hidden: dict[str, float]
    causes: tuple[str, ...]
    outside: str
    over_limit: float
    classes: dict[str, tuple[str, ...]]
    verdict: Verdict
    named: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    unexplained: tuple[tuple[str, str], ...]
    intervals: dict[str, tuple[float, float, float]]
    gain_low: float
    seconds: float
    variant: str = ""
    accepted: tuple[str, ...] = ()
    clipped: bool = False
    late_s: float = math.nan
    stalled: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    fault: str = ""
    clock_s: float = math.nan
    excluded: tuple[str, ...] = ()
    varying: tuple[Varying, ...] = ()
    statements: tuple[Statement, ...] = ()
    refusal: str = ""

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
    every = load_scatter()
    scatter = {name: getattr(every, name) for name in nuisances_of(robot.drive)}
    return Simulation(robot, Ground(), robot.effects, scatter)


def run_trial(case: Case) -> Trial:
    """Hide effects in simulated runs, diagnose them, and return both."""
    robot = load_robot(case.robot)
    key = [case.seed, case.number, list(Row).index(case.row), case.n_runs]
    drawn, noise = np.random.SeedSequence(key).spawn(2)
    stage = stage_of(case, robot, np.random.default_rng(drawn), noise)
    answer: Diagnosis | None = None
    refusal, start_s = "", time.perf_counter()
    try:
        answer = diagnose(stage.runs, stage.simulation or simulation_of(robot), stage.hidden.library)
    except DataError as error:
        refusal = str(error)
    hidden, seconds = stage.hidden, time.perf_counter() - start_s
    return Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=len(stage.runs),
        hidden=hidden.effects | hidden.outside_values,
        causes=hidden.causes,
        outside=hidden.outside,
        over_limit=hidden.over_limit,
        classes=_classes(stage, robot, case.row),
        seconds=seconds,
        refusal=refusal,
        **{name: getattr(stage, name) for name in OF_STAGE},
        **_answered(answer),
    )


def _answered(answer: Diagnosis | None) -> dict[str, Any]:
    """Return the fields of a trial that are the answer; what a diagnosis does not have is empty."""
    if answer is None:
        none = dict.fromkeys(("named", "sets", "unexplained"), ())
        return {**none, "verdict": Verdict.REFUSED, "intervals": {}, "gain_low": math.nan}
    causes = answer.causes
    in_sets = [
        value
        for names in answer.ambiguous_sets
        for n in names
        for value in answer.ambiguous_values.get(n, ())
    ]
    values = [*in_sets, *(value for cause in causes for value in cause.parameters)]
    offset_s = np.array([clock.offset_s for clock in answer.clocks])
    known_s = offset_s[np.isfinite(offset_s)]
    return {
        "verdict": answer.verdict,
        "named": tuple(cause.name for cause in causes),
        "sets": answer.ambiguous_sets,
        "unexplained": tuple((each.channel, each.input) for each in answer.unexplained),
        "intervals": {value.name: (value.value, value.low, value.high) for value in values},
        "gain_low": min((cause.gain_ci[0] for cause in causes), default=math.nan),
        "clock_s": float(np.median(known_s)) if known_s.size else math.nan,
        "excluded": tuple(run.run_id for run in answer.excluded_runs),
        "varying": tuple(
            Varying(each.name, tuple((group.value, group.runs) for group in each.groups), each.rivals)
            for each in answer.varying
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
    for cause in stage.hidden.causes:
        if cause not in [effect.name for effect in LIBRARY]:
            continue
        effect = effect_named(cause)
        twins = {name for name, channel in effect.twins if not (has_heading and channel == HEADING)}
        twins |= confusable_class(stage.limits, effect, robot.drive)
        if row in DRIVE_ROWS:  # without currents a rolling resistance is nearly a smaller radius
            others, values = library_of(robot.drive), stage.hidden.effects
            twins |= {o.name for o in others if stage.limits.in_place_of(effect, values, o)}
        classes[cause] = tuple(sorted(twins))
    return classes


# -- A trial before the diagnosis: what it is given, and what is kept from it ------------------------------

CLEAR = (STRONG, 20.0)
"""Range of amplitudes over the limit beside what measured runs have: from one that has to be named to where
row ``gross`` begins."""


class Stage(NamedTuple):
    """A trial before the diagnosis.

    Parameters
    ----------
    runs : that the diagnosis gets
    hidden : in them
    limits : of the drives, for the confusable classes; None where nothing is hidden
    simulation : under test; None for the one with the known scatter
    variant : of the row, where it has several
    accepted : names that are no error beside the causes
    clipped : whether an amplitude was beyond the bounds of its effect
    late_s : how far the logger of IMU and camera is behind that of the wheels; NaN where that is not asked
    stalled, present : ids of the runs that are stalled, and of those that have the effect if only some do
    fault : name of the one written into the logs
    """

    runs: tuple[RunLog, ...]
    hidden: Hidden
    limits: Limits | None
    simulation: Simulation | None = None
    variant: str = ""
    accepted: tuple[str, ...] = ()
    clipped: bool = False
    late_s: float = math.nan
    stalled: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    fault: str = ""


class Draw(NamedTuple):
    """Case, robot, generator, and seed of the noise."""

    case: Case
    robot: Robot
    rng: np.random.Generator
    noise: np.random.SeedSequence

    def rich(self) -> Drives:
        """Return drives that excite all effects."""
        return rich_drives(self.rng, self.case.n_runs)

    def strong(
        self, limits: Limits, over_limit: tuple[float, float] = CLEAR, without: Sequence[str] = ()
    ) -> Hidden:
        """Draw an effect that these drives excite: its amplitude is within its bounds."""
        library = library_of(self.robot.drive)
        over = float(math.exp(self.rng.uniform(*np.log(over_limit))))
        fit = [e for e in library if e.name not in without and e.parameters[0].name in limits.names]
        for i in self.rng.permutation(len(fit)):
            values = values_of(fit[i], limits, over, self.rng)
            if not is_clipped(values):
                return Hidden(values, (fit[i].name,), over, "", library, {})
        raise RuntimeError(
            f"no effect of {over:.1f} times its limit is within its bounds"
        )  # no drives do that

    def in_turn(self, limits: Limits, number: int) -> Hidden:
        """Take in turn the effects that these drives show, of 3 times their limit, within their bounds."""
        library = library_of(self.robot.drive)
        most = {effect: CLIP_RATIO * min(p.high for p in effect.parameters) for effect in library}
        shown = [effect for effect in library if STRONG * limits.of(effect) < most[effect]]
        effect = shown[number % len(shown)]
        values = values_of(effect, limits, STRONG, self.rng)
        while is_clipped(values):  # in another direction it is not
            values = values_of(effect, limits, STRONG, self.rng)
        return Hidden(values, (effect.name,), STRONG, "", library, {})

    def compared(self, stage: Stage) -> Stage:
        """Return the stage with the simulation that ``terrain explain`` would test."""
        simulation, _ = simulation_for(stage.runs, self.robot, stage.hidden.library)
        return stage._replace(simulation=simulation)


# -- How a trial of each row is made -----------------------------------------------------------------------

GROSS = (20.0, 100.0)
"""Range of amplitudes over the limit, in row ``gross``."""

SHORT = (10.0, 50.0)
"""Range in row ``short``: a replay of samples at 20 Hz is off by one limit of a delay, 0.3 ms, and the effect
that has to be named is clear of that."""

NOTHING_EVERY = 5
"""In rows of a drive one trial of so many hides nothing."""

CLOCK = "clock_offset"
"""Effect that a late logger is."""

LATE_STREAMS = {"gyro": ("imu",), "camera": ("odometry",), "lidar": ("lidar",)}
"""Sensors that are late in row ``sensor_late``, and their streams."""

LATE_CAUSES = {
    "gyro": ("imu_latency",),
    "camera": ("camera_latency",),
    "lidar": ("lidar_latency", "camera_latency"),
}
"""Effects that a late sensor is: the first that the catalogue has, or the last."""


def stage_of(case: Case, robot: Robot, rng: np.random.Generator, noise: np.random.SeedSequence) -> Stage:
    """Draw a trial.

    Parameters
    ----------
    case : of the trial
    robot : of its name
    rng : draws what is driven and hidden
    noise : seed of all that differs from run to run
    """
    draw = Draw(case, robot, rng, noise)
    build = _STAGES.get(case.row)
    return _standing(draw) if build is None else draw.compared(build(draw))


def _standing(draw: Draw) -> Stage:
    """Rows whose runs have the scatter and the noise that the diagnosis is given."""
    case, robot, rng, noise = draw
    rich = draw.rich()
    drives = poor_drives(rng, case.n_runs) if case.row is Row.POOR else rich
    limits = None if case.row is Row.NONE else limits_of(robot, rich)
    hidden = draw_hidden(case, robot, limits, rng)
    runs = hidden_runs(robot, drives, noise, hidden.effects, hidden.outside_values)
    return Stage(runs, hidden, limits)


def _of_drive(draw: Draw) -> Stage:
    """Rows of robots whose logs have no currents."""
    robot, number = draw.robot, draw.case.number
    car = robot if isinstance(robot, BicycleRobot) else None
    drives = car_drives(draw.rng, car, draw.case.n_runs) if car else draw.rich()
    turn = number // len(ROBOTS_OF_ROW[draw.case.row])
    if turn % NOTHING_EVERY == NOTHING_EVERY - 1:
        hidden, limits = Hidden({}, (), 0.0, "", library_of(robot.drive), {}), None
    else:
        limits = limits_of(robot, drives)
        hidden = draw.in_turn(limits, turn - turn // NOTHING_EVERY)
    return Stage(hidden_runs(robot, drives, draw.noise, hidden.effects), hidden, limits)


def _gross(draw: Draw) -> Stage:
    drives = draw.rich()
    limits = limits_of(draw.robot, drives)
    library = library_of(draw.robot.drive)
    seen = [effect for effect in library if math.isfinite(limits.of(effect))]
    effect = seen[int(draw.rng.integers(len(seen)))]
    over = float(math.exp(draw.rng.uniform(*np.log(GROSS))))
    values = values_of(effect, limits, over, draw.rng)
    hidden = Hidden(values, (effect.name,), over, "", library, {})
    runs = hidden_runs(draw.robot, drives, draw.noise, values)
    return Stage(runs, hidden, limits, clipped=is_clipped(values))


def _short(draw: Draw) -> Stage:
    drives = command_drives(draw.rng, draw.robot, draw.case.n_runs)
    limits = limits_of(draw.robot, drives, sensing_of())
    hidden = draw.strong(limits, SHORT)
    runs = hidden_runs(draw.robot, drives, draw.noise, hidden.effects, heading=True)
    return Stage(tuple(map(as_command_log, runs)), hidden, limits)


def _late(draw: Draw) -> Stage:
    drives = draw.rich()
    every = limits_of(draw.robot, drives)
    variant, names, sign = (
        ("wheels", WHEELS_LOGGER, -1.0),
        ("imu and camera", OTHER_LOGGER, 1.0),
    )[draw.case.number // len(ROBOTS) % 2]
    late_s = float(draw.rng.uniform(*LOGGER_LATE_S))
    alike = confusable_class(every, effect_named(CLOCK), draw.robot.drive)
    hidden = draw.strong(every.free("clock_offset_s"), without=tuple(alike))
    runs = hidden_runs(draw.robot, drives, draw.noise, hidden.effects)
    return Stage(
        with_late_streams(runs, names, late_s),
        hidden._replace(causes=(CLOCK, *hidden.causes)),
        every,
        variant=variant,
        late_s=sign * late_s,
    )


def _scattered(draw: Draw) -> Stage:
    drives, robot, n_runs = draw.rich(), draw.robot, draw.case.n_runs
    ratio = float(draw.rng.uniform(*SCATTER_RATIO))
    scatter = load_scatter()
    if robot.skids:
        scatter = scatter._replace(effective_track_ratio=ratio)
    limits = limits_of(robot, drives, Sensing(scatter=scatter))
    hidden = draw.strong(limits)
    each = scattered_values(hidden.effects, draw.rng, ratio, n_runs, track=robot.skids)
    runs = hidden_runs(robot, drives, draw.noise, each)
    return Stage(runs, hidden, limits, variant=f"{ratio:.0%}", accepted=(TRACK,) if robot.skids else ())


def _stalled(draw: Draw) -> Stage:
    drives = draw.rich()
    limits = limits_of(draw.robot, drives)
    hidden = draw.strong(limits)
    runs = hidden_runs(draw.robot, drives, draw.noise, hidden.effects)
    places = draw_stalled(draw.rng, len(runs))
    runs = with_stalled(runs, places, draw.rng, draw.robot, drives, draw.noise, hidden.effects)
    return Stage(runs, hidden, limits, stalled=_ids(runs, places))


def _half(draw: Draw) -> Stage:
    drives, n_runs = draw.rich(), draw.case.n_runs
    places = sorted(draw.rng.permutation(n_runs)[: n_runs // 2].tolist())
    some = Drives(tuple(drives.twists[i] for i in places), tuple(drives.hills[i] for i in places))
    limits = limits_of(draw.robot, some)
    hidden = draw.strong(limits)
    each = [hidden.effects if i in places else {} for i in range(n_runs)]
    runs = hidden_runs(draw.robot, drives, draw.noise, each)
    return Stage(runs, hidden, limits, present=_ids(runs, places))


def _sensor_late(draw: Draw) -> Stage:
    drives, robot = draw.rich(), draw.robot
    sensors = tuple(LATE_STREAMS) if robot.skids else ("gyro", "camera")
    sensor = sensors[draw.case.number // len(ROBOTS) % len(sensors)]
    late_s = float(draw.rng.uniform(*SENSOR_LATE_S))
    lidar = sensor == "lidar"
    runs = hidden_runs(robot, drives, draw.noise, {}, heading=lidar)
    channels = (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
    limits = limits_of(robot, drives, Sensing(channels) if lidar else None)
    if lidar:
        runs = tuple(map(with_lidar, runs))
    library = library_of(robot.drive)
    known = [name for name in LATE_CAUSES[sensor] if name in [effect.name for effect in library]]
    cause = known[0] if known else LATE_CAUSES[sensor][-1]
    hidden = Hidden({f"{cause}_s": late_s}, (cause,), 0.0, "", library, {})
    return Stage(with_late_streams(runs, LATE_STREAMS[sensor], late_s), hidden, limits, variant=sensor)


def _fault(draw: Draw) -> Stage:
    faults = faults_of(draw.robot.drive)
    fault = faults[draw.case.number // len(ROBOTS) % len(faults)]
    runs = hidden_runs(draw.robot, draw.rich(), draw.noise, {})
    hidden = Hidden({}, (), 0.0, "", library_of(draw.robot.drive), {})
    return Stage(with_fault(runs, fault, draw.robot), hidden, None, variant=fault.name, fault=fault.name)


def _dynamic(draw: Draw) -> Stage:
    setting = setting_of(draw.case.number)
    seed = int(draw.rng.integers(2**31))
    values = HIDDEN if setting.hides else {}
    runs = dynamic_runs(draw.robot, setting, seed, draw.case.n_runs, values)
    used, _ = split_runs(runs, None, 0)
    library = library_of(draw.robot.drive)
    causes = tuple(e.name for e in library if e.parameters[0].name in values)
    limits = limits_of(draw.robot, drives_of(used)) if values else None
    hidden = Hidden(dict(values), causes, 0.0, "", library, {})
    return Stage(tuple(used), hidden, limits, variant=setting.name)


def _known(draw: Draw) -> Stage:
    robot, n_runs = draw.robot, draw.case.n_runs
    known = KNOWN[draw.case.number % len(KNOWN)]
    drives = command_drives(draw.rng, robot, n_runs)
    scatter = load_scatter()
    if known.scatters:
        scatter = scatter._replace(effective_track_ratio=TRACK_SCATTER)
    limits = limits_of(robot, drives, sensing_of(scatter))
    each = track_of_runs(known, draw.rng, n_runs)
    runs = hidden_runs(robot, drives, draw.noise, each, heading=True)
    places: tuple[int, ...] = ()
    if known.stalled:
        places = tuple(sorted(draw.rng.choice(n_runs, N_STALLED, replace=False).tolist()))
        runs = with_stalled(runs, places, draw.rng, robot, drives, draw.noise, each, heading=True)
    runs = tuple(map(as_command_log, runs))
    if known.late:
        runs = with_late_streams(runs, WHEELS_LOGGER, WHEELS_LATE_S)
    hidden = Hidden({TRACK_RATIO: TRACK_ERROR}, (TRACK,), 0.0, "", library_of(robot.drive), {})
    return Stage(
        runs,
        hidden,
        limits,
        variant=known.name,
        accepted=(CLOCK,) if known.late else (),
        late_s=-WHEELS_LATE_S if known.late else math.nan,
        stalled=_ids(runs, places),
    )


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


def _ids(runs: Sequence[RunLog], places: Sequence[int]) -> tuple[str, ...]:
    return tuple(runs[i].run_id for i in places)
