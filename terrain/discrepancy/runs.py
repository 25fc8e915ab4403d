"""Runs beside the simulation under test: signals on one clock, low-pass filtered, with predictions and sensitivities.

From streams to signals (:func:`signals_of`), the inputs of the simulation and what it is compared with; from these to
rows (:func:`rows_of`): measured, predicted and the sensitivity to each parameter.  All pass the **same** low-pass: the
prediction contains the noise of a differentiated encoder, which otherwise looks like latency or mass.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import pairwise
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from scipy.ndimage import median_filter

from terrain.angles import unwrapped, wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.differences import in_common, in_set
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    INDEX,
    ONE_SIDED,
    PARAMETERS,
    SENSED_ONLY,
    SHOWS,
    SPEED_X,
    SPEED_Y,
    STEPS,
    TURNING_CURRENT,
    Effect,
    library_of,
    vector_of,
)
from terrain.errors import ConfigError, DataError
from terrain.kernels import njit
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.kinematics.wheels import rolled_twist
from terrain.learned_term import FIELDS, LearnedTerm
from terrain.logs.counters import count_rates
from terrain.logs.schema import GNSS_CHANNELS, POSE_CHANNELS, TWIST
from terrain.records import Array, RunLog
from terrain.robots import BicycleRobot, Robot
from terrain.simulation.plants.planar import (
    TRUTH,
    Ground,
    Planar,
    PlanarDrive,
    corrected_inputs,
    delayed,
    lateness,
    learned_motion,
    make_planar,
    move,
    moved_by,
    planar_ground,
    replay,
    sense,
)
from terrain.slip_learning.measured import travelled
from terrain.terramechanics.soil import load_soil

# -- The simulation under test: a robot, its terrain, the effects built in, and scatter from run to run --------


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What :func:`terrain.discrepancy.diagnose.diagnose` compares measured runs with."""

    robot: Robot
    ground: Ground = field(default_factory=Ground)  #: default terrain
    #: that are built in already; those not named are 0
    effects: Mapping[str, float] = field(default_factory=dict)
    #: standard deviation from run to run of parameters in NUISANCES; those not named are 0
    scatter: Mapping[str, float] = field(default_factory=dict)
    grounds: Mapping[str, Ground] = field(default_factory=dict)  #: terrains by the label of a run
    #: how large the simulation's own error is in units of parameters, the same in all runs; what is no larger is not
    #: stated
    model_error: Mapping[str, float] = field(default_factory=dict)
    #: mean over runs and scatter of them that conditions may make which differ from run to run, in units of parameters:
    #: see :mod:`terrain.discrepancy.constancy`
    varied_error: Mapping[str, float] = field(default_factory=dict)
    varied_scatter: Mapping[str, float] = field(default_factory=dict)
    #: how much the residual of a channel depends on an input by the simulation's own error
    probe_error: Mapping[tuple[str, str], float] = field(default_factory=dict)
    learned: tuple[LearnedTerm, ...] = ()  #: what is built in without a name

    @property
    def library(self) -> tuple[Effect, ...]:
        """Effects that apply to this robot."""
        return library_of(self.robot.drive)

    def planar_on(self, terrain: str) -> Planar:
        """Return the numbers for the kernels on the terrain of a label, the default one for all others."""
        return make_planar(self.robot, self.grounds.get(terrain, self.ground))._replace(learned=self.learned)

    @property
    def known_scatter(self) -> dict[str, float]:
        """Scatter from run to run that is no news: what is assumed, or what conditions may make."""
        both = {*self.scatter, *self.varied_scatter}
        return {n: max(self.scatter.get(n, 0.0), self.varied_scatter.get(n, 0.0)) for n in both}

    @property
    def vector(self) -> Array:
        """Parameters (len(PARAMETERS),) of the effects built in."""
        return vector_of(self.effects)

    def with_learned(self, terms: Sequence[LearnedTerm]) -> Simulation:
        """Return the same with learned terms added to those that are built in already."""
        return replace(self, learned=(*self.learned, *terms)) if terms else self

    def with_effects(self, values: Mapping[str, float]) -> Simulation:
        """Return the same with effects added to those that are built in already."""
        added = {name: self.effects.get(name, 0.0) + value for name, value in values.items()}
        return replace(self, effects={**self.effects, **added})


class TerrainMatch(NamedTuple):
    """The terrain on which runs of a label are simulated."""

    terrain: str  #: label of the runs; empty for runs without a label or with several
    soil: str | None  #: its soil of the package; None for the default terrain
    effective_ratio: float | None
    """Part of the tilt that acts as a slope, 0 to 1; None on the default terrain."""

    @property
    def text(self) -> str:
        """On which terrain the runs were simulated, in words."""
        if self.soil:
            return f"soil {self.soil}"
        runs = f"label {self.terrain}" if self.terrain else "runs without a label (or with several)"
        return f"{runs}: default terrain"


def drivable(robot: Robot, soil: str) -> bool:
    """Return whether a robot does not get stuck on a soil of the package."""
    try:
        planar_ground(robot, load_soil(soil))
    except ConfigError:
        return False
    return True


# -- From streams to signals on one clock ---------------------------------------------------------------------

MAX_RATE_HZ = 50.0  #: Clock of the replay, unless the wheels are logged slower.
MAX_GAP_PERIODS = 3.5  #: Longest hole of a stream that is bridged by a straight line, in its own periods.
MIN_LENGTH_S = 4.0  #: Of a shorter run nothing is left once filters have settled.
#: A camera speed is a jump of its map if it differs from the median over the first before and after by the second,
#: and by so many times the usual deviation.
JUMP_S, JUMP_MPS, JUMP_SIGMAS = 0.05, 0.1, 8.0

POSITION, VELOCITY = GNSS_CHANNELS[:2], GNSS_CHANNELS[2:4]  #: Of a receiver.
#: Course over ground is the heading of a robot that is faster: a receiver's velocity is off by 0.02 to 0.05 m/s.
MOVING_MPS = 0.4
#: A wheel turns backward if it is faster than that on at least so many samples.
BACKWARD_MPS, MIN_BACKWARD = 0.02, 5
#: Part of the described friction, which is often assumed, that a wheel that drives takes at the least.
LEAST_FRICTION = 0.5
#: A run whose currents are not known in more than that ratio of its samples counts as one without.
MOSTLY_BRAKED = 0.5
#: Least norm of the mean of the wheels' unit vectors at which the sum of currents measures traction: wheels within 18
#: degrees of each other.
PARALLEL = 0.95


#: Channels of an IMU, axis by axis.
IMU_AXES = tuple(
    f"{kind}_{axis}_{unit}" for kind, unit in (("gyro", "radps"), ("accel", "mps2")) for axis in "xyz"
)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Signals:
    """A run on one clock."""

    run_id: str  #: of the run; the terrain is empty where it has no label or several
    terrain: str
    dt_s: float  #: period of the clock
    start_s: float  #: first instant on the run's own clock
    #: (n, wheels) wheel speeds with the nominal radius, of a car-like robot (n, 1) that of the rear axle; NaN where a
    #: logger was silent
    wheel_speed_mps: Array
    #: (n, steered wheels) steering angles, zeros taken off; (n, wheels) zeros of a robot without
    steer_rad: Array
    grade_rad: Array  #: (n,) measured tilt, uphill and left side up positive; 0 where none is measured
    roll_rad: Array
    #: (n, len(CHANNELS)) what the simulation is compared with; NaN where nothing was measured
    measured: Array
    session: str = ""  #: that the run is part of; empty where that is not known
    place: float = math.nan  #: in the order in which runs were driven, from 0; NaN: as they are given
    #: (n, len(IMU_AXES)) all axes of the IMU, which tell exchanged axes; (n, 0) where they are not logged
    axes: Array = field(default_factory=partial(np.empty, (0, 0)))
    is_second: bool = False  #: of two sets that are compared

    def __len__(self) -> int:
        return len(self.measured)

    @property
    def time_s(self) -> Array:
        """Time (n,) on the run's own clock."""
        return self.start_s + self.dt_s * np.arange(len(self))


UNLIKE = "it is unlike the other"  #: How the reason begins of a run whose robot or terrain is not that of the others


class Excluded(NamedTuple):
    """A run that is excluded from the comparison, and why."""

    run_id: str
    reason: str


def in_order(runs: Sequence[RunLog]) -> list[RunLog]:
    """Return runs in the order in which they were driven, as far as it is known.

    That is by their stamps where these are of one clock, on which no two runs overlap; else by their ids, numbers in
    these by size.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> imu = Stream(np.arange(3.0), np.zeros((3, 0)), ())
    >>> [run.run_id for run in in_order([RunLog(name, "husky", {"imu": imu}) for name in ("r_10", "r_2")])]
    ['r_2', 'r_10']
    """

    def parts(run: RunLog) -> list[tuple[int, str]]:
        return [(int(x), "") if x.isdecimal() else (-1, x) for x in re.split(r"(\d+)", run.run_id)]

    by_id = sorted(runs, key=parts)
    by_time = sorted(by_id, key=lambda run: run.start_s)
    on_one_clock = all(before.end_s <= after.start_s for before, after in pairwise(by_time))
    return by_time if on_one_clock else by_id


def comparable(runs: Sequence[RunLog], robot: Robot) -> tuple[tuple[Signals, ...], tuple[Excluded, ...]]:
    """Return the signals of runs that can be compared with the simulation, and why the others cannot be.

    A run on another clock than most is one of the latter: one low-pass serves all that are compared.

    Raises
    ------
    DataError
        if no run can be compared, with the reason of the first.
    """
    signals, excluded = [], []
    for run in runs:
        try:
            signals.append(signals_of(run, robot))
        except DataError as error:
            excluded.append(Excluded(run.run_id, str(error).removeprefix(f"run {run.run_id}: ")))
    if not signals and excluded:
        raise DataError(f"run {excluded[0].run_id}: {excluded[0].reason}")
    rates = np.array([1 / run.dt_s for run in signals])
    together = [(rates >= slow) & (rates <= (1 + SAME_CLOCK) * slow) for slow in rates]
    usual = max(together, key=np.sum, default=rates > 0)
    for other, rate_hz in ((signals[i].run_id, rates[i]) for i in np.flatnonzero(~usual)):
        most_hz = float(np.median(rates[usual]))
        reason = f"it is on a clock of {rate_hz:.3g} Hz, most runs are on one of {most_hz:.3g} Hz"
        excluded.append(Excluded(other, reason))
    return tuple(signals[i] for i in np.flatnonzero(usual)), tuple(excluded)


def signals_of(run: RunLog, robot: Robot) -> Signals:
    """Return the signals of a run, resampled to one clock.

    Currents are compared where the motors of the robot are described.  Those of omni wheels, which drive in three
    directions, are magnitudes.  Others get the sign of the wheel speed where the motor driver logs magnitudes only: if
    a wheel turns backward and its current is never negative.  Braking cannot be seen in such a log.

    Raises
    ------
    DataError
        if the run is of another robot or lacks inputs of the simulation, if none of its channels is
        simulated, or if it is too short.
    """
    name = f"run {run.run_id}"
    if run.robot != robot.name:
        raise DataError(f"{name} is of the robot {run.robot!r}, the simulation is of {robot.name!r}")
    inputs = ("wheels", "steering") if robot.steered else ("wheels",)
    for stream in inputs:
        if stream not in run.streams:
            raise DataError(f"{name}: it has no stream {stream!r}, which drives the simulation")
    wheels, imu = run.streams["wheels"], run.streams.get("imu")
    # a robot whose motors are not described logs speeds
    for pattern in ("motor_{}_radps", "speed_{}_mps"):
        names = [pattern.format(wheel) for wheel in robot.logged_wheels]
        if set(names) <= set(wheels.channels):
            break
    else:
        raise DataError(
            f"{name}: its wheels have the channels {', '.join(wheels.channels)}; a speed of each of "
            f"{', '.join(robot.logged_wheels)} is required"
        )
    is_motor = names[0].startswith("motor")
    scale = robot.wheel_radius_m / robot.reduction_ratio if is_motor else 1.0
    speeds = wheels.columns(names) * scale
    outside = _outside(run, robot)

    used = [*inputs, *(each for each in ("imu", "odometry", "lidar") if each in run.streams)]
    spans_s = np.array(
        [run.streams[each].time_s[[0, -1]] for each in [*used, outside][: len(used) + bool(outside)]]
    )
    start_s, end_s = float(spans_s[:, 0].max()), float(spans_s[:, 1].min())
    rate_hz = min(MAX_RATE_HZ, wheels.rate_hz)
    n = math.floor((end_s - start_s) * rate_hz + 1e-6) + 1 if end_s > start_s else 0
    if n < MIN_LENGTH_S * rate_hz:
        raise DataError(
            f"{name}: its streams have {max(end_s - start_s, 0.0):.1f} s in common, "
            f"at least {MIN_LENGTH_S:g} s are required"
        )
    time_s = start_s + np.arange(n) / rate_hz

    def resampled(stamps_s: Array, columns: Array) -> Array:
        return np.column_stack([_resample(time_s, stamps_s, column) for column in columns.T])

    steer = np.zeros((n, len(robot.steer_channels) or len(robot.wheels)))
    if robot.steered:
        steering, angles = run.streams["steering"], []
        for channel, zero in zip(robot.steer_channels, robot.steering_zeros_rad, strict=False):
            raw = unwrapped(steering.channel(channel))
            turn = 2 * math.pi * np.round((raw[np.isfinite(raw)][:1].sum() - zero) / (2 * math.pi))
            angles.append(raw - zero - turn)
        steer = resampled(steering.time_s, np.column_stack(angles))
    tilt, has_tilt = np.zeros((n, 2)), imu is not None and {"roll_rad", "pitch_rad"} <= set(imu.channels)
    if imu is not None and has_tilt:
        tilt = resampled(imu.time_s, np.column_stack([-imu.channel("pitch_rad"), imu.channel("roll_rad")]))
    measured = np.full((n, len(CHANNELS)), np.nan)
    for channel, stamps_s, values in _measurements(run, robot, has_tilt, outside, time_s):
        measured[:, CHANNELS.index(channel)] = _resample(time_s, stamps_s, values)
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    # of motors that are not described no current is known: a traction of 1 N would count as 1 A
    if robot.describes("motors") and set(names) <= set(wheels.channels):
        currents = wheels.columns(names)
        if robot.on_omni_wheels:
            currents = np.abs(currents)
        else:
            unsigned = not np.nanmin(currents) < 0
            for current, speed in zip(currents.T, speeds.T, strict=False):
                if (speed < -BACKWARD_MPS).sum() >= MIN_BACKWARD and not np.nanmin(current) < 0:
                    current *= np.sign(speed)
            if unsigned and robot.skids:  # a wheel that turns with less than its friction takes is braked
                least_a = LEAST_FRICTION * robot.motors.friction_nm / robot.motors.nm_per_a
                braked = (np.abs(speeds) > BACKWARD_MPS) & (np.abs(currents) < least_a)
                mostly = braked.any(axis=1).mean() > MOSTLY_BRAKED
                currents[braked if not mostly else slice(None)] = np.nan
        each = resampled(wheels.time_s, currents)
        measured[:, CHANNELS.index(CURRENT)] = np.sum(list(each.T), axis=0)
        parallel = np.abs(np.exp(1j * steer).mean(axis=1)) > PARALLEL
        measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
        if robot.skids:
            measured[:, CHANNELS.index(TURNING_CURRENT)] = each[:, 1] - each[:, 0]
    if not np.isfinite(measured).any():
        raise DataError(
            f"{name}: none of its channels is simulated; a gyro, currents of all wheels, a speed "
            "over ground, poses, GNSS or an accelerometer with its tilt is required"
        )
    terrain = run.terrains[0] if len(run.terrains) == 1 else ""
    on_clock = resampled(wheels.time_s, speeds), steer, tilt[:, 0], tilt[:, 1], measured
    axes = np.empty((n, 0))
    if imu is not None and set(IMU_AXES) <= set(imu.channels):
        axes = resampled(imu.time_s, imu.columns(IMU_AXES))
    return Signals(run.run_id, terrain, 1 / rate_hz, float(time_s[0]), *on_clock, run.session, axes=axes)


def _outside(run: RunLog, robot: Robot) -> str:
    """Return the stream of poses, or else of GNSS, that counts where no lidar measures all motion; empty of none."""
    pose, gnss, lidar = (run.streams.get(name) for name in ("pose", "gnss", "lidar"))
    if lidar is not None and set(TWIST) <= set(lidar.channels):
        return ""
    if pose is not None and set(POSE_CHANNELS) <= set(pose.channels):
        return "pose"
    better = lidar is not None or "odometry" in run.streams
    if gnss is None or better or robot.sideways:  # a receiver's velocity has no heading
        return ""
    return "gnss" if any(set(names) <= set(gnss.channels) for names in (VELOCITY, POSITION)) else ""


def _gnss_motion(run: RunLog, robot: Robot) -> tuple[Array, Array]:
    """Return speed ahead and heading rate (n,) at the fixes of a receiver, of a body that moves where it points.

    The speed has the sign of the wheels; the rate is that of the course, known while the robot moves.  Velocities are
    those of the receiver, or central differences of its positions.
    """
    gnss, wheels = run.streams["gnss"], run.streams["wheels"]
    time_s = gnss.time_s
    if set(VELOCITY) <= set(gnss.channels):
        east, north = gnss.columns(VELOCITY).T
    else:
        east, north = (count_rates(time_s, column) for column in gnss.columns(POSITION).T)
        east[[0, -1]] = np.nan  # there they are half a period off
    names = [name for name in robot.rate_channels if name in wheels.channels] or list(wheels.channels[:1])
    rolled = wheels.columns(names).mean(axis=1)
    known = np.isfinite(rolled)
    backward = (
        np.interp(time_s, wheels.time_s[known], rolled[known]) < 0.0 if known.any() else time_s < -np.inf
    )
    speed, course = np.hypot(east, north), np.arctan2(north, east) + np.pi * backward
    course[~(speed > MOVING_MPS)] = np.nan
    rate = np.full(len(time_s), np.nan)
    if len(time_s) > 2:
        rate[1:-1] = wrapped(course[2:] - course[:-2]) / (time_s[2:] - time_s[:-2])
    return np.where(backward, -speed, speed), rate


def _measurements(
    run: RunLog, robot: Robot, has_tilt: bool, outside: str, time_s: Array
) -> Iterator[tuple[str, Array, Array]]:
    """Yield what sensors measured: channel, stamps and values; of one channel the last counts.

    Speeds over ground and the heading rate are from a camera's poses, its speeds, or a lidar, or, where there are none
    of these, from the stream ``outside``: poses, none where these pause or jump, or GNSS.  ``time_s`` is the clock.
    """
    direct = [("imu", "gyro_z_radps", GYRO)] + [("imu", "accel_x_mps2", ACCEL)] * has_tilt
    if outside == "gnss":
        for channel, rates in zip((SPEED_X, HEADING), _gnss_motion(run, robot), strict=True):
            yield channel, run.streams["gnss"].time_s, rates
    if outside == "pose":
        # over the clock's own periods: stamps of poses may be close to each other, and their sums stay right
        seen, half_s = travelled(run, robot), 0.5 * (time_s[1] - time_s[0])
        edges_s = np.append(time_s - half_s, time_s[-1] + half_s)
        at = np.column_stack([np.interp(edges_s, seen.time_s, column) for column in seen.values.T])
        before = np.searchsorted(seen.time_s, edges_s[:-1], side="right") - 1
        after = np.searchsorted(seen.time_s, edges_s[1:], side="left")
        inside = (before >= 0) & (after < len(seen.time_s))
        inside[inside] = seen.part[before[inside]] == seen.part[after[inside]]
        rates = np.where(inside[:, None], np.diff(at, axis=0), np.nan) / (2.0 * half_s)
        for channel, rate in zip((SPEED_X, SPEED_Y, HEADING), rates.T, strict=True):
            yield channel, time_s, rate
    camera = run.streams.get("odometry")
    if camera is not None and set(CAMERA_CHANNELS) <= set(camera.channels):
        speed = body_motion(camera, robot.camera).speed_mps
        width = 2 * round(JUMP_S * camera.rate_hz) + 1
        off = np.abs(speed - median_filter(speed, (width, 1), mode="nearest"))
        usual = 1.48 * np.nanmedian(off, axis=0) if len(off) else np.zeros(2)
        relocalised = (off > np.maximum(JUMP_MPS, JUMP_SIGMAS * usual)).any(axis=1)
        speed = np.where(relocalised[:, None], np.nan, speed)
        yield SPEED_X, camera.time_s, speed[:, 0]
        yield SPEED_Y, camera.time_s, speed[:, 1]
    else:
        direct += [("odometry", "speed_x_mps", SPEED_X), ("odometry", "speed_y_mps", SPEED_Y)]
    direct += [("lidar", "speed_x_mps", SPEED_X), ("lidar", "speed_y_mps", SPEED_Y)]
    for stream, name, channel in [*direct, ("lidar", "yaw_rate_radps", HEADING)]:
        if stream in run.streams and name in run.streams[stream].channels:
            yield channel, run.streams[stream].time_s, run.streams[stream].channel(name)


def _resample(time_s: Array, stamps_s: Array, values: Array) -> Array:
    """Return a signal on the clock by straight lines between its samples; NaN in its holes."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return np.full(time_s.size, np.nan)
    stamps, samples = stamps_s[known], values[known]
    period_s = float(np.median(np.diff(stamps_s)))
    at = np.interp(time_s, stamps, samples)
    after = np.searchsorted(stamps, time_s, side="left").clip(1, stamps.size - 1)
    hole = (stamps[after] - stamps[after - 1]) > MAX_GAP_PERIODS * period_s
    inside = (time_s > stamps[after - 1]) & (time_s < stamps[after])
    outside = (time_s < stamps[0] - period_s) | (time_s > stamps[-1] + period_s)
    at[(hole & inside) | outside] = np.nan
    return at


# -- From signals to rows: behind one low-pass, with sensitivities ---------------------------------------------

#: Cut-off of the common low-pass at the full clock; commands of a wheeled robot change within 2 Hz.
CUTOFF_HZ = 2.5
INPUT_CUTOFFS = 2.4  #: Cut-off of the inputs of the simulation, over that of the common low-pass.
#: Cut-off of the wheel speeds that serve as instruments of the sensitivities, over that of the common low-pass: see
#: :func:`rows_of`.
INSTRUMENT_CUTOFF_RATIO = 0.6

SAME_CLOCK = 0.05  #: Ratio by which the runs' clocks may differ: one window serves all of them.
CLOCKS_PER_CUTOFF = 10.0  #: Rate of the replay's clock over the cut-off of the common low-pass.
#: Rows a second over the cut-off: the low-pass is down by 50 dB at half the rate of the rows.
ROWS_PER_CUTOFF = 2.5
TAPS_PER_CUTOFF = 2.4  #: Half length of the low-pass times its cut-off.
MIN_KNOWN = 0.75  #: Ratio of the low-pass's weight that has to be known for a row, where a channel has holes.
#: Start and end of a run left out, beside those of the low-pass: the replay starts in steady motion.
SETTLE_S = 0.5
#: A shorter run may have its one change of command at its start, which is kept if it is in steady motion.
SHORT_S = 10.0
#: Steady motion: for so long no wheel's speed and no steering changes by more than that.
STEADY_S, STEADY_MPS, STEADY_RAD = 0.25, 0.05, 0.02


class LowPass(NamedTuple):
    """A symmetric window, and the rate of its output."""

    taps: Array  #: on the clock of the replay
    every: int  #: samples of that clock a row
    rate_hz: float  #: of the rows, and of the window
    cutoff_hz: float
    #: samples of the signals' clock a sample of the replay's; 0 where that clock is too slow for a window of its own
    #: in between
    inputs_every: int
    #: cut-off of the wheel speeds that serve as instruments of the sensitivities, see :func:`rows_of`; infinite for
    #: those of the prediction
    instrument_cutoff_hz: float


T = TypeVar("T")
R = TypeVar("R")


class Rows(NamedTuple):
    """A low-pass filtered run, row by row."""

    run_id: str  #: of the run
    terrain: str
    time_s: Array  #: (m,) from the start of the run
    measured: Array  #: (m, channels)
    predicted: Array
    #: (parameters, m, channels) change of the prediction per change of each parameter; 0 where none is measured
    sensitivity: Array
    inputs: Array  #: (m, len(INPUTS) - 1 + wheels) inputs of the simulation, for probes of the residual

    @property
    def residual(self) -> Array:
        """Measured minus predicted (m, channels)."""
        return self.measured - self.predicted

    @property
    def period_s(self) -> float:
        """From row to row; 0 where there is none."""
        return float(np.median(np.diff(self.time_s))) if self.time_s.size > 1 else 0.0

    @property
    def pace_mps(self) -> Array:
        """Speed (m,) of the wheels, straight ahead or against each other; of omni wheels in any direction."""
        speed = np.hypot(self.inputs[:, 0], self.inputs[:, INPUTS.index("sideways_mps")])
        return np.maximum(speed, 0.5 * np.abs(self.inputs[:, 1]))


#: Mean wheel speed, right minus left (last minus first) wheel speed, mean steering, tilt, traction over weight, 0,
#: and how far the wheels have turned: a column for each of them.  Of an omni robot speed, turn and sideways are those
#: that its wheels would roll ahead, in place (twice the speed of a wheel) and to the left; of a car-like robot turn
#: is the difference of its rear wheels.
INPUTS: tuple[str, ...] = (
    *("speed_mps", "turn_mps", "steer_rad", "grade_rad", "roll_rad"),
    *("force_ratio", "sideways_mps", "wheel_phase_rad"),
)


def low_pass_of(signals: Sequence[Signals]) -> LowPass:
    """Return the low-pass of runs on one clock, which the slowest logger sets.

    Raises
    ------
    DataError
        if the runs' clocks differ by more than a twentieth.
    """
    slow, fast = max(signals, key=attrgetter("dt_s")), min(signals, key=attrgetter("dt_s"))
    rate_hz = 1 / slow.dt_s
    if 1 / fast.dt_s > (1 + SAME_CLOCK) * rate_hz:
        raise DataError(
            f"runs: {slow.run_id} is on a clock of {rate_hz:.3g} Hz, {fast.run_id} on one of "
            f"{1 / fast.dt_s:.3g} Hz; clocks within {SAME_CLOCK:.0%} of each other are required"
        )
    cutoff_hz = min(CUTOFF_HZ, rate_hz / 5.0)
    near = 1 + SAME_CLOCK  # a logger of 49.9 Hz is one of 50
    inputs_every = int(near * rate_hz / (CLOCKS_PER_CUTOFF * cutoff_hz))
    clock_hz = rate_hz / max(inputs_every, 1)
    every = max(int(near * clock_hz / (ROWS_PER_CUTOFF * cutoff_hz)), 1)
    of_rows = every, clock_hz / every, cutoff_hz
    return LowPass(_window(cutoff_hz, clock_hz), *of_rows, inputs_every, INSTRUMENT_CUTOFF_RATIO * cutoff_hz)


def _window(cutoff_hz: float, rate_hz: float) -> Array:
    half = math.ceil(TAPS_PER_CUTOFF / cutoff_hz / 2 * rate_hz)
    k = np.arange(-half, half + 1)
    taps = np.sinc(2 * cutoff_hz / rate_hz * k) * np.hamming(k.size)
    return np.asarray(taps / taps.sum())


def rows_of(
    signals: Signals, planar: Planar, vector: Array, parameters: Sequence[str], low_pass: LowPass
) -> Rows:
    """Return a low-pass filtered run, and the sensitivities to the parameters named, at a vector of them.

    The prediction contains the noise of its input, the wheel speeds, and so does the residual, with the
    opposite sign.  A sensitivity along the same wheel speeds contains it too, and where a robot hardly
    changes its motion the noise is most of it: residual and sensitivity are correlated by their noise, and
    a spurious acceleration looks like an error of the mass.  Sensitivities are therefore computed along
    low-pass filtered wheel speeds, as instruments: the noise of a differentiated encoder grows with
    frequency, the commands do not.
    """
    if len(vector) > len(PARAMETERS):  # of two sets
        names = tuple(dict.fromkeys(map(in_common, parameters)))
        rows = rows_of(signals, planar, in_set(vector, signals.is_second), names, low_pass)
        acts = [name in names or signals.is_second for name in parameters]
        sensitivity = rows.sensitivity[[names.index(in_common(name)) for name in parameters]]
        return rows._replace(sensitivity=sensitivity * np.reshape(acts, (-1, 1, 1)))
    run, window = _prepared(signals, planar, low_pass), (low_pass.taps, low_pass.every)
    dt, tilt = run.dt, (run.steer, run.grade, run.roll)
    now = replay(planar, vector, dt, run.wheel_speed, *tilt)
    speed, *slope = corrected_inputs(planar.body, vector, dt, run.instruments, *tilt[1:])
    truth = move(planar, vector, dt, speed, run.steer, *slope)
    measuring = {CHANNELS[c] for c in run.shown}
    acts = [not measuring.isdisjoint(SHOWS.get(name, CHANNELS)) for name in parameters]
    acting = [name for name, shows in zip(parameters, acts, strict=True) if shows]
    points, each = np.tile(vector, (2, len(acting), 1)), range(len(acting))  # ahead and back
    at, steps = [INDEX[name] for name in acting], np.array([STEPS[name] for name in acting])
    points[0, each, at] += steps
    both_sided = [name not in ONE_SIDED or vector[INDEX[name]] >= STEPS[name] for name in acting]
    points[1, each, at] -= steps * both_sided
    added = _learned(planar, points, dt, run.instruments, *tilt)
    apart = points[0, each, at] - points[1, each, at]
    sensed_only = np.array([name in SENSED_ONLY for name in acting], dtype=np.bool_)
    plant, about = (planar.params, planar.body, dt), (run.shown, run.holes, run.first, run.last, *window)
    change = np.zeros((len(parameters), len(run.time_s), len(CHANNELS)))
    change[acts] = _differences_by(planar.drive)(
        plant, points, apart, sensed_only, (run.instruments, *tilt), truth, added, about
    )
    force = truth["force_n"] / (GRAVITY_MPS2 * planar.robot.mass_kg)
    inputs, inside = run.inputs.copy(), slice(run.first, run.last)
    inputs[:, INPUTS.index("force_ratio")] = decimate(force[inside, None], run.holes[:, :0], *window)[:, 0]
    now = decimate(now[inside], run.holes[inside], *window)
    return Rows(signals.run_id, signals.terrain, run.time_s, run.measured, now, change, inputs)


def of_each(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return a function of each of some runs, in their order; two are computed at a time where there are two cores.

    What is compiled lets go of the lock of Python's; more threads would wait for what is not.
    """
    results: dict[int, R] = {}
    places = iter(range(len(items)))

    def compute() -> None:
        for i in places:  # of all threads
            results[i] = function(items[i])

    with ThreadPoolExecutor(1) as threads:
        others = [threads.submit(compute)] if min(os.cpu_count() or 1, len(items)) > 1 else []
        compute()
        for other in others:
            other.result()
    return [results[i] for i in range(len(items))]


def _learned(
    planar: Planar, points: Array, dt: float, wheel_speed: Array, steer: Array, *tilt: Array
) -> Array:
    """Return what learned terms add (2, k, n) at points (2, k, len(PARAMETERS)); (2, k, 0) without any."""
    added = np.zeros((*points.shape[:2], len(steer) if planar.learned else 0), TRUTH)
    for place in np.ndindex(points.shape[:2] if planar.learned else (0,)):
        speed, *slope = corrected_inputs(planar.body, points[place], dt, wheel_speed, *tilt)
        added[place] = learned_motion(planar, dt, speed, steer, *slope)
    return added


@cache
def _differences_by(drive: PlanarDrive) -> Any:
    """Return the kernel of the sensitivities of a drive: replays ahead and back behind the low-pass, their difference.

    It takes no lock of Python's, so that runs are replayed at the same time.
    """
    moved = moved_by(drive)

    @njit(nogil=True)
    def differences(
        plant: Any, points: Any, apart: Any, sensed_only: Any, inputs: Any, truth: Any, added: Any, about: Any
    ) -> Array:
        (params, body, dt), (wheel_speed, steer, grade, roll) = plant, inputs
        shown, holes, first, last, taps, every = about
        n_rows = max((last - first - taps.size) // every + 1, 0)
        change = np.zeros((apart.size, n_rows, len(CHANNELS)))
        values = np.empty((last - first, shown.size))
        known = np.empty((last - first, min(shown.size, holes.shape[1])), np.bool_)
        for c in range(known.shape[1]):
            known[:, c] = holes[first:last, shown[c]]
        for j in range(apart.size):
            for side in range(2):
                vector, motion = points[side, j], truth
                if not sensed_only[j]:
                    speed, uphill, left_up = corrected_inputs(body, vector, dt, wheel_speed, grade, roll)
                    driven = speed, steer, uphill, left_up, np.zeros((0, 3))
                    motion = moved(params, vector, dt, driven, added[side, j])
                seen = sense(body, vector, dt, motion)
                for c in range(shown.size):
                    values[:, c] = seen[first:last, shown[c]]
                rows = decimate(values, known, taps, every)
                for c in range(shown.size):
                    change[j, :, shown[c]] += (1.0 - 2.0 * side) * rows[:, c]
            change[j] /= apart[j]
        return change

    return differences


class Prepared(NamedTuple):
    """A run behind the window of the inputs, and those of its rows that no parameter changes."""

    dt: float  #: period of the replay's clock
    wheel_speed: Array  #: (n, wheels) on it, and as instruments
    instruments: Array
    steer: Array  #: (n, wheels)
    grade: Array  #: (n,)
    roll: Array
    shown: Array  #: places of the channels that are measured
    holes: Array  #: (n, channels) where these are known; (n, 0) where there are no holes
    first: int  #: samples behind the rows that are kept, and the end
    last: int
    time_s: Array  #: as :class:`Rows` has them, the inputs without force
    measured: Array
    inputs: Array


_PREPARED: WeakKeyDictionary[Signals, tuple[Any, Robot | None, Prepared | None]] = WeakKeyDictionary()


def _prepared(signals: Signals, planar: Planar, low_pass: LowPass) -> Prepared:
    """Return a run as it is replayed, prepared once for a low-pass and a robot."""
    known_as, robot, run = _PREPARED.get(signals, ((), None, None))
    if run is not None and known_as == low_pass[1:] and robot is planar.robot:
        return run
    dt, wheel_speed, steer, grade, roll, measured = prepare_inputs(signals, low_pass)
    n_rows, kept = _kept_rows(dt, wheel_speed, steer, low_pass)
    known, taps, every = np.isfinite(measured), low_pass.taps, low_pass.every
    shown = np.flatnonzero(known.any(axis=0))
    holes = known[:, :0] if known[:, shown].all() else known
    instruments = wheel_speed
    if math.isfinite(low_pass.instrument_cutoff_hz):
        instruments = _decimated(wheel_speed, _window(low_pass.instrument_cutoff_hz, 1.0 / dt), 1)
    speed, turn, sideways = _rolled(planar, instruments, steer)
    driven = np.column_stack([speed, turn, steer.mean(axis=1), grade, roll, np.zeros_like(speed), sideways])
    phase = np.cumsum(instruments, axis=0) * (dt / planar.robot.wheel_radius_m)
    at = taps.size // 2 + every * np.arange(n_rows)[kept]
    filtered = decimate(np.ascontiguousarray(measured), holes, taps, every)[kept]
    inputs = np.column_stack([decimate(driven, known[:, :0], taps, every)[kept], phase[at]])
    first, last = kept.start * every, (kept.stop - 1) * every + taps.size
    of_rows = first, max(first, last if len(at) else 0), at * dt, filtered, inputs
    run = Prepared(dt, wheel_speed, instruments, steer, grade, roll, shown, holes, *of_rows)
    _PREPARED[signals] = low_pass[1:], planar.robot, run
    return run


def _kept_rows(dt: float, wheel_speed: Array, steer: Array, low_pass: LowPass) -> tuple[int, slice]:
    """Return the number of rows of a run, and those that are kept of them."""
    n_rows = max((len(wheel_speed) - low_pass.taps.size) // low_pass.every + 1, 0)
    first = slice(0, math.ceil(STEADY_S / dt) + 1)
    change_mps, change_rad = (np.ptp(values[first], axis=0).max() for values in (wheel_speed, steer))
    steady = change_mps <= STEADY_MPS and change_rad <= STEADY_RAD
    skip = math.ceil(SETTLE_S * low_pass.rate_hz)
    start = 0 if len(wheel_speed) * dt < SHORT_S and steady else skip
    return n_rows, slice(start, max(n_rows - skip, start))


def term_inputs(signals: Signals, simulation: Simulation, low_pass: LowPass) -> tuple[float, Array]:
    """Return the period of the replay's clock, and the inputs of learned terms (n, len(INPUTS)) on it."""
    planar, vector = simulation.planar_on(signals.terrain), simulation.vector
    dt, wheel_speed, steer, grade, roll, _ = prepare_inputs(signals, low_pass)
    wheel_speed, grade, roll = corrected_inputs(planar.body, vector, dt, wheel_speed, grade, roll)
    return dt, np.column_stack([rolled_twist(simulation.robot, wheel_speed, steer), grade, roll])


def term_rows(
    signals: Signals, simulation: Simulation, low_pass: LowPass, channel: str, acts_on: str, columns: Array
) -> Array:
    """Return what a channel shows of columns (n, k) on the replay's clock, as rows (m, k) beside those of a run.

    ``acts_on`` is the channel of the learned term that the columns are of: motion shows as sensors see it.
    """
    planar, vector, c = simulation.planar_on(signals.terrain), simulation.vector, CHANNELS.index(channel)
    dt, wheel_speed, steer, _, _, measured = prepare_inputs(signals, low_pass)
    truth: Any = np.zeros(len(columns), TRUTH)
    at_rest = sense(planar.body, vector, dt, truth)[:, c]
    truth[FIELDS.get(acts_on, acts_on)] = 1.0
    gain = sense(planar.body, vector, dt, truth)[:, c] - at_rest  # what is even is not delayed
    late, seen = lateness(planar.body, vector, dt)[c], np.empty_like(columns)
    for j, column in enumerate(columns.T):
        seen[:, j] = gain * delayed(np.ascontiguousarray(column), *late)
    known = np.isfinite(measured[:, [c]])
    holes = known[:, :0] if known.all() else np.repeat(known, columns.shape[1], axis=1)
    rows = decimate(seen, holes, low_pass.taps, low_pass.every)
    return np.asarray(rows[_kept_rows(dt, wheel_speed, steer, low_pass)[1]])


def _rolled(planar: Planar, wheel_speed: Array, steer: Array) -> tuple[Array, Array, Array]:
    """Return speed, turn and sideways speed (n,) of wheels, as :data:`INPUTS` has them."""
    speed, robot = wheel_speed.mean(axis=1), planar.robot
    if robot.on_omni_wheels:
        rollers = planar.params[0]
        ahead, left, turn = rollers["to_rolled"] @ wheel_speed.T
        return ahead, 2.0 * rollers["wheel_distance_m"] * turn, left
    if isinstance(robot, BicycleRobot):
        ahead, left, turn = rolled_twist(robot, wheel_speed, steer).T
        return ahead, robot.track_m * turn, left
    return speed, wheel_speed[:, -1] - wheel_speed[:, 0], np.zeros_like(speed)


def _decimated(values: Array, taps: Array, every: int) -> Array:
    """Return columns behind a window, of the same length where none is left out, held at both ends."""
    half = taps.size // 2
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.asarray(decimate(padded, np.zeros((0, 0), dtype=np.bool_), taps, every))


def prepare_inputs(signals: Signals, low_pass: LowPass) -> tuple[float, Array, Array, Array, Array, Array]:
    """Return the clock's period, wheel speeds, steering, grade, roll and measurements without holes.

    Holes of the inputs are bridged, and measurements there are dropped.  Both pass a window far above the
    low-pass: nonlinearities of the simulation, as friction about rest, turn noise of the wheels into a bias.
    """
    tilt = signals.grade_rad, signals.roll_rad
    columns = np.column_stack([signals.wheel_speed_mps, signals.steer_rad, *tilt])
    measured = np.array(signals.measured)
    holes = ~np.isfinite(columns).all(axis=1)
    if holes.any():
        at = np.arange(len(columns))
        for column in columns.T:
            known = np.isfinite(column)
            column[:] = np.interp(at, at[known], column[known]) if known.any() else 0.0
        measured[holes] = np.nan
    if low_pass.inputs_every > 0:
        taps = _window(INPUT_CUTOFFS * low_pass.cutoff_hz, 1 / signals.dt_s)
        both = _decimated(np.column_stack([columns, measured]), taps, low_pass.inputs_every)
        columns, measured = both[:, : columns.shape[1]], both[:, columns.shape[1] :]
    wheels = signals.wheel_speed_mps.shape[1]
    parts = np.split(columns, [wheels, 2 * wheels, 2 * wheels + 1], axis=1)
    wheel_speed, steer, grade, roll = (np.ascontiguousarray(part) for part in parts)
    return signals.dt_s * max(low_pass.inputs_every, 1), wheel_speed, steer, grade[:, 0], roll[:, 0], measured


@njit
def decimate(values: Array, known: Array, taps: Array, every: int) -> Array:
    """Return columns (m, c) of ``values`` (n, c) filtered by a window and decimated; a NaN spreads.

    Where ``known`` (n, c) is not empty, it is the window's mean over what is known of each: the same samples have to
    be left out of whatever is compared.  Where less than :data:`MIN_KNOWN` of the window's weight is known, it is the
    mean over all: NaN, if there is one among them.
    """
    n, c = values.shape
    m = max((n - taps.size) // every + 1, 0)
    out = np.zeros((m, c))
    whole = np.abs(taps).sum()
    for row in range(m):
        start = row * every
        for t in range(taps.size):
            for j in range(c):
                out[row, j] += taps[t] * values[start + t, j]
        for j in range(known.shape[1]):
            total, weight, there = 0.0, 0.0, 0.0
            for t in range(taps.size):
                if known[start + t, j]:
                    total += taps[t] * values[start + t, j]
                    weight += taps[t]
                    there += abs(taps[t])
            if there >= MIN_KNOWN * whole:
                out[row, j] = total / weight
    return out


def measured_channels(rows: Sequence[Any]) -> tuple[str, ...]:
    """Return the channels that any run, with what it measured, has, in the order of ``CHANNELS``."""
    return tuple(
        name for c, name in enumerate(CHANNELS) if any(np.isfinite(run.measured[:, c]).any() for run in rows)
    )
