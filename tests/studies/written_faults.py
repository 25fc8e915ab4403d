"""Faults written into measured logs: which of them ``terrain explain`` names, and that it states no other.

A fault is a change of the logs of a set, with the answers that are right.  The set is diagnosed once as published: what
is stated of that too is no answer to the fault.  A fault of a column that was not written counts as wrong, also beside
the right answer, and so does a cause that is named only with the fault, where no right answer is given.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.data.datasets import load_runs
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as Options
from pipelines.report.tree import Column, Report, Table
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.runs import Simulation, comparable
from terrain.discrepancy.verdict import Diagnosis
from terrain.errors import ConfigError, DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog, Stream
from terrain.robots import load_robot

EXAMPLE = "python tests/studies written-faults --data ~/sets --sets vulpi"


class Source(NamedTuple):
    """A measured set: its folder, its robot, and how many of its runs of a session are taken (of all, without)."""

    folder: str
    robot: str
    n_runs: int


SETS = {
    "drive_husky": Source("drive_husky", "husky", 60),
    "drive_warthog_terrains": Source("drive_warthog_terrains", "warthog", 12),
    "warthog_grass": Source("drive_recordings/warthog_grass", "warthog", 20),
    "husky_wet_grass": Source("drive_recordings/husky_wet_grass", "husky", 60),
    "borealtc": Source("borealtc", "husky", 60),
    "vulpi": Source("vulpi", "husky", 60),
    "robotino": Source("robotino/weights", "robotino", 60),
}

# -- Faults as data ---------------------------------------------------------------------------------------------

#: What a fault does to a column: samples (n, c) of a run at some times (n, 1) since its start; ``part`` is the run's
#: place in the set, 0 to 1.
Edit = Callable[[Array, Array, float], Array]
#: Which runs have the fault, of ids and places in the order of the runs.
Where = Callable[[str, int, int], bool]


class Written(NamedTuple):
    """A fault, and what is right to state of it."""

    name: str
    data: str
    columns: Mapping[str, tuple[str, ...]]  #: by stream, the beginnings of the channels that it changes
    edit: Edit
    #: ``kind/column`` of a fault of the logs, ``cause: parameter`` with the change of its value, ``unfit``
    answers: Mapping[str, float]
    where: Where = lambda run_id, i, n: True


def times(factor: float) -> Edit:
    """Return samples times a factor."""
    return lambda time_s, values, part: factor * values


def exchanged(time_s: Array, values: Array, part: float) -> Array:
    """Return columns in the opposite order."""
    return values[:, ::-1]


def late(delay_s: float) -> Edit:
    """Return samples as they are measured later."""

    def delayed(time_s: Array, values: Array, part: float) -> Array:
        at_s = time_s[:, 0]
        return np.column_stack([np.interp(at_s - delay_s, at_s, column) for column in values.T])

    return delayed


def slow(rate: float) -> Edit:
    """Return samples of a clock of another rate."""

    def stretched(time_s: Array, values: Array, part: float) -> Array:
        at_s = time_s[:, 0]
        return np.column_stack([np.interp(at_s * (1.0 - rate), at_s, column) for column in values.T])

    return stretched


def lost(start_s: float, length_s: float, value: float = math.nan) -> Edit:
    """Return samples that hold their value, or read another, for a time."""

    def dropped(time_s: Array, values: Array, part: float) -> Array:
        inside, out = (time_s[:, 0] >= start_s) & (time_s[:, 0] < start_s + length_s), values.copy()
        if inside.any():
            out[inside] = values[np.argmax(inside)] if math.isnan(value) else value
        return out

    return dropped


def clip(limit: float) -> Edit:
    """Return samples within the range of a sensor."""
    return lambda time_s, values, part: np.clip(values, -limit, limit)


def plus(offset: float, per_s: float = 0.0, over_runs: float = 0.0) -> Edit:
    """Return samples with an offset that grows along a run, and from the first run to the last."""
    return lambda time_s, values, part: values + offset + per_s * time_s + over_runs * part


def shrinking(to: float) -> Edit:
    """Return samples times a factor that goes from 1 to another over the runs."""
    return lambda time_s, values, part: values * (1.0 + (to - 1.0) * part)


def of(*sessions: str) -> Where:
    """Return whether a run is of one of some sessions."""
    return lambda run_id, i, n: run_id.startswith(sessions)


def half(run_id: str, i: int, n: int) -> bool:
    """Return whether a run is one of every other."""
    return i % 2 == 1


def third(run_id: str, i: int, n: int) -> bool:
    """Return whether a run is one of every third."""
    return i % 3 == 1


def middle(run_id: str, i: int, n: int) -> bool:
    """Return whether a run is the one in the middle."""
    return i == n // 2


IMU_Z, LIDAR_YAW = {"imu": ("gyro_z",)}, {"lidar": ("yaw_rate",)}
LIDAR, WHEELS, CURRENTS = {"lidar": ("speed_",)}, {"wheels": ("speed_", "motor_")}, {"wheels": ("current_",)}
X_AND_Z, Y_AND_Z = {"imu": ("gyro_x", "gyro_z")}, {"imu": ("gyro_y", "gyro_z")}
DEG, KMH = 180.0 / math.pi, 3.6
SIDES = {"swapped/wheel speeds": 0.0, "swapped/wheel speeds and currents": 0.0}
GYRO_SIGN, LAG, RATE = {"sign/gyro": 0.0} | SIDES, "clock_offset_s", "clock_rate_ratio"
GYRO_DELAY = "gyro behind the wheels"  #: By what is stated of clocks and of the IMU together

FAULTS = (
    Written("gyro sign", "drive_husky", IMU_Z, times(-1), {"sign/gyro": 0.0}),
    Written("heading sign", "drive_warthog_terrains", LIDAR_YAW, times(-1), {"sign/heading rate": 0.0}),
    Written(
        "speed sign in a session",
        "drive_warthog_terrains",
        LIDAR,
        times(-1),
        {"sign/speed over ground": 0.0},
        of("gravel_1"),
    ),
    Written(
        "left wheel sign", "drive_husky", {"wheels": ("speed_left",)}, times(-1), {"sign/wheel speeds": 0.0}
    ),
    Written("wheel signs", "drive_warthog_terrains", WHEELS, times(-1), {"sign/wheel speeds": 0.0}),
    Written("gyro sign without heading", "vulpi", IMU_Z, times(-1), GYRO_SIGN),
    Written("gyro sign on a recording", "warthog_grass", IMU_Z, times(-1), {"sign/gyro": 0.0}),
    Written("gyro in deg/s", "drive_husky", IMU_Z, times(DEG), {"unit/gyro": 0.0}),
    Written("speed in km/h", "drive_warthog_terrains", LIDAR, times(KMH), {"unit/speed over ground": 0.0}),
    Written(
        "wheels in km/h in sessions",
        "drive_warthog_terrains",
        WHEELS,
        times(KMH),
        {"unit/wheel speeds": 0.0},
        of("sand_1", "sand_2"),
    ),
    Written("gyro in deg/s, no heading", "borealtc", IMU_Z, times(DEG), {"unit/gyro": 0.0}),
    Written("wheels in km/h, no heading", "vulpi", WHEELS, times(KMH), {"unit/wheel speeds": 0.0}),
    Written("speed in mm/s", "husky_wet_grass", LIDAR, times(1e3), {"unit/speed over ground": 0.0}),
    Written("currents in mA", "borealtc", CURRENTS, times(1e3), {"unit/currents": 0.0}),
    Written("heading in deg/s", "warthog_grass", LIDAR_YAW, times(DEG), {"unit/heading rate": 0.0}),
    Written("wheels exchanged", "drive_husky", WHEELS, exchanged, SIDES),
    Written(
        "x and y of the speed", "drive_warthog_terrains", LIDAR, exchanged, {"swapped/speed over ground": 0.0}
    ),
    Written(
        "wheels exchanged in a session", "drive_warthog_terrains", WHEELS, exchanged, SIDES, of("asphalt_2")
    ),
    Written("wheels exchanged, recording", "husky_wet_grass", WHEELS, exchanged, SIDES),
    Written(
        "wheels 1 and 2 of omni wheels",
        "robotino",
        {"wheels": ("motor_1", "motor_2")},
        exchanged,
        {"swapped/wheel speeds": 0.0},
    ),
    Written(
        "gyro late",
        "drive_husky",
        IMU_Z,
        late(0.4),
        {GYRO_DELAY: 0.4, "imu_latency_s": 0.4, LAG: 0.4, "camera_latency_s": -0.4},
    ),
    Written(
        "lidar late",
        "warthog_grass",
        {"lidar": ("speed_", "yaw_rate")},
        late(0.4),
        {"camera_latency_s": 0.4, LAG: 0.4},
    ),
    Written(
        "wheels late on a recording", "warthog_grass", WHEELS, late(0.4), {LAG: -0.4, "encoder_lag_s": 0.4}
    ),
    Written("wheels late", "drive_warthog_terrains", WHEELS, late(0.4), {LAG: -0.4, "encoder_lag_s": 0.4}),
    Written("IMU clock 2 % slow", "warthog_grass", IMU_Z, slow(0.02), {RATE: 0.02}),
    Written("wheel clock 2 % slow", "borealtc", {"wheels": ("",)}, slow(0.02), {RATE: -0.02}),
    Written(
        "gyro scale",
        "drive_husky",
        IMU_Z,
        times(1.15),
        {"scale/gyro": 0.0, "gyro_scale_ratio": 0.15},  # it is beyond what a builder believes of a sensor
    ),
    Written("gyro x for z", "vulpi", X_AND_Z, exchanged, {"axes/gyro": 0.0}),
    Written("gyro y for z", "borealtc", Y_AND_Z, exchanged, {"axes/gyro": 0.0}),
    Written("gyro x for z, recording", "warthog_grass", X_AND_Z, exchanged, {"axes/gyro": 0.0}),
    Written("gyro held", "vulpi", IMU_Z, lost(8.0, 6.0), {"dropout/gyro": 0.0}),
    Written("gyro reads 0 at times", "drive_husky", IMU_Z, lost(2.0, 1.5, 0.0), {"dropout/gyro": 0.0}, third),
    Written(
        "lidar held in a session",
        "drive_warthog_terrains",
        LIDAR,
        lost(1.5, 3.5),
        {"dropout/speed over ground": 0.0, "unfit": 0.0},
        of("sand_1"),
    ),
    Written("gyro saturates", "vulpi", IMU_Z, clip(0.25), {"saturation/gyro": 0.0}),
    Written("gyro saturates, short runs", "drive_husky", IMU_Z, clip(0.3), {"saturation/gyro": 0.0}),
    Written("gyro zero drifts in a run", "vulpi", IMU_Z, plus(0.0, per_s=0.004), {"drift/gyro": 0.0}),
    Written(
        "gyro zero drifts over runs",
        "drive_husky",
        IMU_Z,
        plus(0.0, over_runs=0.3),
        {"drift/gyro": 0.0, "gyro_bias_radps": 0.15},
    ),
    Written("gyro not zeroed", "drive_warthog_terrains", IMU_Z, plus(0.9), {"offset/gyro": 0.0}),
    Written(
        "payload at half of the runs",
        "borealtc",
        CURRENTS,
        times(1.4),
        {"payload_ratio": 0.2, "motor_constant_ratio": 0.2},
        half,
    ),
    Written("tyre trend", "drive_warthog_terrains", WHEELS, shrinking(1.2), {"wheel_radius_ratio": -0.1}),
    Written("rogue run", "drive_husky", WHEELS, times(2.2), {"unfit": 0.0}, middle),
)


def written(runs: Sequence[RunLog], fault: Written) -> tuple[list[RunLog], set[str]]:
    """Return runs with a fault, and the ids of those that have it."""
    changed, has = [], set()
    for i, run in enumerate(runs):
        if not fault.where(run.run_id, i, len(runs)):
            changed.append(run)
            continue
        streams = dict(run.streams)
        for name, starts in fault.columns.items():
            was = streams.get(name)
            if was is None:
                continue
            at = [k for k, channel in enumerate(was.channels) if channel.startswith(starts)]
            values = was.values.copy()
            since_s = (was.time_s - was.time_s[0])[:, None]
            values[:, at] = fault.edit(since_s, values[:, at], i / max(len(runs) - 1, 1))
            streams[name] = Stream(was.time_s, values, was.channels)
        changed.append(replace(run, streams=streams))
        has.add(run.run_id)
    return changed, has


# -- What is stated, and whether it is right ----------------------------------------------------------------------


class Settings(Options):
    """Which sets and faults, and which runs of a set."""

    data: Path = setting(Path(os.environ.get("TERRAIN_DATA", ".")), "Folder of the measured sets.")
    sets: Names = setting(tuple(SETS), "Sets, by commas.")
    seed: int = setting(0, "Draws the runs of a set.", ge=0)


class Outcome(NamedTuple):
    """What was stated of a fault."""

    fault: str
    dataset: str
    outcome: str  #: right, set, silent or wrong
    stated: str  #: what was stated with the fault alone


class Faults(Result):
    """Which faults that were written into logs are named."""

    seed: int = described("draws the runs")
    outcomes: tuple[Outcome, ...] = described("what was stated of each fault")
    false: tuple[str, ...] = described("faults that were stated of sets as published")


def drawn_runs(source: Source, data: Path, seed: int) -> list[RunLog]:
    """Return runs of a set that can be compared, at most so many of a session, drawn by the seed."""
    robot = load_robot(source.robot)
    runs = [with_wheel_speeds(run, robot) for run in load_runs(data / source.folder, robot=source.robot)]
    fit = {run.run_id for run in comparable(runs, robot)[0]}
    rng, kept, sessions = np.random.default_rng(seed), list[RunLog](), Counter[str]()
    runs = [run for run in runs if run.run_id in fit]
    for i in rng.permutation(len(runs)):
        session = runs[i].session
        if sessions[session] < source.n_runs:
            sessions[session] += 1
            kept.append(runs[i])
    return sorted(kept, key=lambda run: run.run_id)


def stated(diagnosis: Diagnosis) -> tuple[dict[str, float], dict[str, float]]:
    """Return what a diagnosis states, and what it states as one of several: faults and values of parameters."""
    named: dict[str, float] = {
        f"{fault.change.kind}/{fault.change.column}": 0.0 for fault in diagnosis.faults
    }
    several = {f"{each.kind}/{each.column}": 0.0 for fault in diagnosis.faults for each in fault.rivals}
    named |= diagnosis.values
    if {"imu_latency_s", LAG} & named.keys():
        named[GYRO_DELAY] = named.get("imu_latency_s", 0.0) + named.get(LAG, 0.0)
    for values in diagnosis.ambiguous_values.values():
        several |= {value.name: value.value for value in values}
    for cause in diagnosis.candidates:
        several |= {value.name: value.value for value in cause.parameters}
    for varying in diagnosis.varying:
        several[varying.parameter] = math.nan
    return named, several


def judged(fault: Written, has: set[str], now: Diagnosis | str, before: Diagnosis) -> Outcome:
    """Return what was stated of a fault; text in place of a diagnosis is the reason of a refusal."""
    if isinstance(now, str):
        right = "unfit" in fault.answers and any(run_id in now for run_id in has)
        return Outcome(fault.name, fault.data, "right" if right else "silent", now)
    (named, several), (old, old_several) = stated(now), stated(before)
    unfit = {run.run_id for run in now.excluded_runs} - {run.run_id for run in before.excluded_runs}

    def answers(found: Mapping[str, float], was: Mapping[str, float]) -> bool:
        """Return whether a right answer is among what was found, by half of its size over what was found before."""
        for name, size in fault.answers.items():
            if name in found and ("/" in name or math.isnan(found[name])):
                return name not in was or (not math.isnan(was[name]) and "/" not in name)
            change = found.get(name, 0.0) - was.get(name, 0.0)
            if size and name in found and change * size > 0 and abs(change) > 0.5 * abs(size):
                return True
        return False

    new = {name for name in named if name not in old and name != GYRO_DELAY}
    false = {name for name in new if "/" in name and name not in fault.answers}
    if fault.answers.keys() & named.keys() == set() and not answers(several, old_several):
        false |= {name for name in new if name not in fault.answers and name not in old_several}
    parts = [
        *sorted(new),
        *(f"{name} {named[name]:.3g}" for name in fault.answers if name in named and "/" not in name),
    ]
    parts += [f"{len(unfit)} unfit"] if unfit else []
    parts += [f"or {name}" for name in sorted(several) if name not in old_several]
    right = answers(named, old) or ("unfit" in fault.answers and 2 * len(unfit & has) >= len(has))
    if right and not any("/" in name for name in false):
        outcome = "right"
    elif answers(several, {**old_several, **old}) and not any("/" in name for name in false):
        outcome = "set"
    else:
        outcome = "wrong" if false else "silent"
    return Outcome(fault.name, fault.data, outcome, ", ".join(dict.fromkeys(parts)))


def run(settings: Settings, progress: Progress = silent) -> Faults:
    """Diagnose each set as published, and with each fault."""
    if unknown := [name for name in settings.sets if name not in SETS]:
        raise ConfigError(f"there is no set {unknown[0]!r}; there are {', '.join(SETS)}")
    outcomes, false = list[Outcome](), list[str]()
    for name in settings.sets:
        source = SETS[name]
        robot, runs = load_robot(source.robot), drawn_runs(source, settings.data, settings.seed)
        before = diagnose(runs, Simulation(robot))
        false += [f"{name}: {fault.sentence}" for fault in before.faults]
        for fault in (fault for fault in FAULTS if fault.data == name):
            changed, has = written(runs, fault)
            try:
                now: Diagnosis | str = diagnose(changed, Simulation(robot))
            except DataError as error:
                now = str(error)
            outcomes.append(judged(fault, has, now, before))
            progress(f"{name}: {fault.name}", len(outcomes), len(FAULTS))
    return Faults(settings.seed, tuple(outcomes), tuple(false))


def report(result: Faults) -> Report:
    """Return how many faults are named, and what was stated of each."""
    n = Counter(each.outcome for each in result.outcomes)
    answer = (
        f"Of {len(result.outcomes)} faults {n['right']} are named, {n['set']} in a set, {n['silent']} are not "
        f"noticed, {n['wrong']} wrong; {len(result.false)} are stated of the sets as published."
    )
    columns = (
        Column("fault", of="fault"),
        Column("set", of="dataset"),
        Column("outcome", of="outcome"),
        Column("stated", of="stated"),
    )
    return Report(
        "Faults written into logs",
        answer,
        parts=(Table(columns, result.outcomes, note="; ".join(result.false)),),
    )
