"""How a trial of each row is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from terrain.discrepancy.hold_out import split_runs
from terrain.discrepancy.trials.command_logs import as_command_log, sensing_of, with_lidar
from terrain.discrepancy.trials.drives import Drives, car_drives, command_drives, poor_drives
from terrain.discrepancy.trials.dynamic_runs import HIDDEN, drives_of, dynamic_runs, setting_of
from terrain.discrepancy.trials.hidden_effects import (
    ROBOTS,
    ROBOTS_OF_ROW,
    Case,
    Hidden,
    draw_hidden,
    hidden_runs,
    is_clipped,
    values_of,
)
from terrain.discrepancy.trials.known_truth import (
    KNOWN,
    N_STALLED,
    TRACK_ERROR,
    TRACK_SCATTER,
    WHEELS_LATE_S,
    track_of_runs,
)
from terrain.discrepancy.trials.late_logs import (
    LOGGER_LATE_S,
    SENSOR_LATE_S,
    WHEELS_LOGGER,
    with_late_streams,
)
from terrain.discrepancy.trials.limits import Sensing, confusable_class, limits_of
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.trials.scattered_values import (
    SCATTER_RATIO,
    TRACK,
    TRACK_RATIO,
    scattered_values,
)
from terrain.discrepancy.trials.stage import Draw, Stage
from terrain.discrepancy.trials.stalled_logs import draw_stalled, with_stalled
from terrain.discrepancy.trials.written_faults import faults_of, with_fault
from terrain.effects import (
    ACCEL,
    CURRENT,
    GYRO,
    HEADING,
    OTHER_LOGGER,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    effect_named,
    library_of,
)
from terrain.records import RunLog
from terrain.robots import BicycleRobot, Robot
from terrain.simulation.planar.noise import load_scatter

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
