"""One run of a tracked robot: speeds of its tracks in, an ordinary run log with its truth out.

The belts follow the commanded speeds with a lag; :mod:`~terrain.simulation.tracked.motion` gives the motion
on an even slope, on soils or with slip that is given, one after the other; sensors add noise.
Poses are those of cameras around the field, positions of satellites are raw, and a compass shows the heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import TrackedRobot
from terrain.simulation.sensors import (
    BODY_TRUTH,
    COMPASS_STD_RAD,
    GYRO_BIAS,
    RAW_HZ,
    RAW_STD_M,
    raw_fixes,
    wheel_channels,
)
from terrain.simulation.tracked.contact import CONTACT_SIZE, contact_array
from terrain.simulation.tracked.given_slip import GivenSlip
from terrain.simulation.tracked.motion import HEAP, STATE_SIZE, STEP_S, TRAVELLED, VX, VY, YAW, W, X, Y, drive
from terrain.simulation.tracked.slope import LEVEL, Slope, tilt_at
from terrain.slip import slip_angle, slip_ratio
from terrain.terramechanics.soil import Soil

COMMANDS_HZ, WHEELS_HZ, IMU_HZ = 50.0, 50.0, 100.0
"""Rates of the commands and of the loggers."""


class TrackedSensors(NamedTuple):
    """Rates and noise of a tracked robot's sensors: standard deviations of white noise, all assumed but one.

    Parameters
    ----------
    encoder_mps : of each speed
    gyro_radps, gyro_bias_radps : of each sample, and of the bias from run to run
    accel_mps2, tilt_rad, yaw_rad : of the IMU; its heading is the integral of its gyro
    gnss_hz, gnss_m : raw satellite fixes; 2 cm and 10 Hz, Deremetz et al., section VI
    compass_rad : of the heading beside each fix
    pose_hz, pose_m, pose_rad : cameras around the field
    belt_lag_s : of the belts behind their commands
    """

    encoder_mps: float = 0.001
    gyro_radps: float = 0.003
    gyro_bias_radps: float = 0.0005
    accel_mps2: float = 0.05
    tilt_rad: float = 0.002
    yaw_rad: float = 0.001
    gnss_hz: float = RAW_HZ
    gnss_m: float = RAW_STD_M
    compass_rad: float = COMPASS_STD_RAD
    pose_hz: float = 100.0
    pose_m: float = 0.001
    pose_rad: float = 0.002
    belt_lag_s: float = 0.1


NOISY = TrackedSensors()
"""Ordinary sensors."""

QUIET = TrackedSensors(**{name: 0.0 for name in TrackedSensors._fields if not name.endswith("_hz")})
"""Sensors without noise, and belts without a lag."""


class Stretch(NamedTuple):
    """A stretch of one ground.

    Parameters
    ----------
    ground : a soil that shears, or the slip itself
    length_m : distance travelled on it; the last one of a run goes on for ever
    """

    ground: Soil | GivenSlip
    length_m: float = math.inf


def simulate_tracked(
    robot: TrackedRobot,
    ground: Soil | GivenSlip | Sequence[Stretch],
    track_speed_mps: Array,
    seed: int | np.random.SeedSequence,
    *,
    slope: Slope = LEVEL,
    yaw_rad: float = 0.0,
    sensors: TrackedSensors = NOISY,
    run_id: str = "run",
) -> RunLog:
    """Drive the tracks of a robot and return what its loggers wrote, with the truth beside it.

    Parameters
    ----------
    robot : tracked
    ground : one for the whole run, or stretches of several
    track_speed_mps : (n, 2) commanded speeds of the left and the right track at 50 Hz, from rest
    seed : of the noise; the same gives the same bytes
    slope : an even one, level by default
    yaw_rad : heading at the start, in the plane of the slope
    sensors : rates and noise; :data:`QUIET` has none
    run_id : of the run; its label is the soil's name

    Returns
    -------
    RunLog
        streams wheels (speeds of the tracks), imu, pose (cameras around the field), gnss and compass,
        commands and truth, with ``slip_left_ratio``, ``slip_right_ratio`` by each track's own middle, and
        the slip angle of the body ``slip_body_rad``

    Raises
    ------
    ConfigError
        if speeds are not (n, 2) finite numbers, a soil does not shear, or no stretch is given.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> run = simulate_tracked(load_robot("patako"), load_soil("dry_sand"), np.full((200, 2), 0.05), 0)
    >>> sorted(run.streams)
    ['commands', 'compass', 'gnss', 'imu', 'pose', 'truth', 'wheels']
    >>> round(float(run.streams["truth"].values[-1, BODY_TRUTH.index("speed_x_mps")]), 3)
    0.05
    """
    commands = np.asarray(track_speed_mps, dtype=float)
    if commands.ndim != 2 or commands.shape[1] != 2 or len(commands) < 2 or not np.isfinite(commands).all():
        raise ConfigError(
            f"track_speed_mps has shape {commands.shape}, (n, 2) finite numbers with two rows are required"
        )
    stretches = [Stretch(ground)] if isinstance(ground, Soil | GivenSlip) else list(ground)
    if not stretches:
        raise ConfigError("ground: no stretch is given, one at least is required")
    belts = _followed(commands, sensors.belt_lag_s)
    start = np.zeros(STATE_SIZE)
    start[YAW] = yaw_rad
    states = drive(*_grounds(robot, stretches), robot.half_track_m, np.array(slope), start, belts, STEP_S)
    rngs = [np.random.default_rng(child) for child in np.random.SeedSequence(_entropy(seed)).spawn(5)]
    bias_radps = sensors.gyro_bias_radps * rngs[0].standard_normal()
    tilt = np.array([tilt_at(slope.angle_rad, slope.uphill_rad, yaw) for yaw in states[:, YAW]])
    every = round(1.0 / (WHEELS_HZ * STEP_S))
    wheels = belts[::every] + sensors.encoder_mps * rngs[1].standard_normal((len(belts[::every]), 2))
    streams = {
        "wheels": Stream(np.arange(len(wheels)) / WHEELS_HZ, wheels, robot.rate_channels),
        "imu": _imu(states, tilt, bias_radps, sensors, rngs[2]),
        "pose": _pose(states, sensors, rngs[3]),
        **_satellites(states, sensors, rngs[4]),
        "commands": Stream(np.arange(len(commands)) / COMMANDS_HZ, commands, robot.rate_channels),
        "truth": _truth(robot, states, tilt, belts, bias_radps),
    }
    return RunLog(run_id, robot.name, streams, _labels(stretches, states), source="simulated, tracked")


def _entropy(seed: int | np.random.SeedSequence) -> list[int]:
    """Return the words of a seed; a sequence is left as it is."""
    sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return [int(word) for word in sequence.generate_state(4)]


def _followed(commands: Array, lag_s: float) -> Array:
    """Return the speeds of the belts (m, 2) at every step: those commanded, with a lag."""
    every = round(1.0 / (COMMANDS_HZ * STEP_S))
    belts = np.repeat(commands, every, axis=0)[: (len(commands) - 1) * every + 1]
    keep = math.exp(-STEP_S / lag_s) if lag_s > 0.0 else 0.0
    followed = np.empty_like(belts)
    followed[0] = 0.0 if lag_s > 0.0 else belts[0]
    for k in range(1, len(belts)):
        followed[k] = keep * followed[k - 1] + (1.0 - keep) * belts[k]
    return followed


def _grounds(robot: TrackedRobot, stretches: Sequence[Stretch]) -> tuple[Array, Array, Array]:
    """Return the numbers of each ground as the kernels take them, and where each ends."""
    grounds, given = np.zeros((len(stretches), CONTACT_SIZE)), np.zeros((len(stretches), 7))
    for k, (ground, _) in enumerate(stretches):
        if isinstance(ground, Soil):
            grounds[k] = contact_array(robot, ground)
        else:
            given[k] = ground
    return grounds, given, np.cumsum([length_m for _, length_m in stretches])


def _labels(stretches: Sequence[Stretch], states: Array) -> tuple[Label, ...]:
    """Return the soils by time; slip that is given has no name."""
    ends_m = np.cumsum([length_m for _, length_m in stretches])
    which = np.minimum(np.searchsorted(ends_m, states[:, TRAVELLED], side="right"), len(stretches) - 1)
    labels = []
    for k, (ground, _) in enumerate(stretches):
        steps = np.flatnonzero(which == k)
        if steps.size and isinstance(ground, Soil):
            labels.append(Label(float(steps[0] * STEP_S), float(steps[-1] * STEP_S), ground.name))
    return tuple(label for label in labels if label.end_s > label.start_s)


def _imu(
    states: Array, tilt: Array, bias_radps: float, sensors: TrackedSensors, rng: np.random.Generator
) -> Stream:
    """Return gyro, specific force and attitude; on an even slope the body turns about its z axis alone."""
    n, turn = len(states), states[:, W]
    grade, roll = tilt.T
    values = np.zeros((n, len(IMU_CHANNELS)))
    values[:, 2] = turn + bias_radps
    values[:, :3] += sensors.gyro_radps * rng.standard_normal((n, 3))
    values[:, 3] = np.gradient(states[:, VX], STEP_S) - turn * states[:, VY] + GRAVITY_MPS2 * np.sin(grade)
    values[:, 4] = np.gradient(states[:, VY], STEP_S) + turn * states[:, VX]
    values[:, 4] += GRAVITY_MPS2 * np.sin(roll) * np.cos(grade)
    values[:, 5] = GRAVITY_MPS2 * np.cos(roll) * np.cos(grade)
    values[:, 3:6] += sensors.accel_mps2 * rng.standard_normal((n, 3))
    values[:, 6], values[:, 7] = roll, -grade
    values[:, 6:8] += sensors.tilt_rad * rng.standard_normal((n, 2))
    yaw = states[:, YAW] - states[0, YAW] + bias_radps * STEP_S * np.arange(n)
    values[:, 8] = wrapped(yaw + sensors.yaw_rad * rng.standard_normal(n))
    return Stream(np.arange(n) * STEP_S, values, IMU_CHANNELS)


def _pose(states: Array, sensors: TrackedSensors, rng: np.random.Generator) -> Stream:
    rows, time_s = _samples(len(states), sensors.pose_hz)
    std = np.array([sensors.pose_m, sensors.pose_m, sensors.pose_rad])
    seen = states[rows][:, [X, Y, YAW]] + std * rng.standard_normal((len(rows), 3))
    seen[:, 2] = wrapped(seen[:, 2])
    return Stream(time_s, seen, POSE_CHANNELS)


def _satellites(states: Array, sensors: TrackedSensors, rng: np.random.Generator) -> dict[str, Stream]:
    rows, time_s = _samples(len(states), sensors.gnss_hz)
    pose, std = states[rows][:, [X, Y, YAW]], (sensors.gnss_m, sensors.compass_rad)
    return raw_fixes(time_s, pose, states[rows, VX : VY + 1], std, rng)


def _samples(n: int, rate_hz: float) -> tuple[Array, Array]:
    """Return the steps and stamps of a sensor of a rate."""
    if not 0.0 < rate_hz <= 1.0 / STEP_S:
        raise ConfigError(
            f"a sensor's rate is {rate_hz:g} Hz, above 0 and up to {1.0 / STEP_S:g} is required"
        )
    rows = np.arange(0, n, round(1.0 / (rate_hz * STEP_S)))
    return rows, rows * STEP_S


def _truth(robot: TrackedRobot, states: Array, tilt: Array, belts: Array, bias_radps: float) -> Stream:
    v_x, v_y, turn = states[:, VX], states[:, VY], states[:, W]
    grade, roll = tilt.T
    along = v_x[:, None] - turn[:, None] * robot.wheel_positions_m[:, 1]
    columns = [
        *(states[:, X], states[:, Y], wrapped(states[:, YAW]), roll, -grade, v_x, v_y, turn),
        np.gradient(v_x, STEP_S) - turn * v_y,
        np.gradient(v_y, STEP_S) + turn * v_x,
        belts / robot.wheel_radius_m,
        slip_ratio(belts, along, min_speed_mps=0.005),
        slip_angle(v_x, v_y, min_speed_mps=0.005),
        np.full(len(states), bias_radps),
        states[:, HEAP],
    ]
    tracks = (*wheel_channels("wheel_radps", robot.wheels), *wheel_channels("slip_ratio", robot.wheels))
    channels = (*BODY_TRUTH, *tracks, "slip_body_rad", GYRO_BIAS, "heap_m2")
    return Stream(np.arange(len(states)) * STEP_S, np.column_stack(columns), channels)
