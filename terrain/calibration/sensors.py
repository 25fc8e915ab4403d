r"""Sensors of a robot that stands or is held still: stretches found by the log, biases, scales, noise; and the camera.

**Gyro biases** are means over standing stretches (Danzi, AgriMaRo thesis, 3.3.3).

**Accelerometer in six positions** (thesis 3.3.3): held still, in any orientation, it measures gravity only.  With
``a = k f + b`` an axis, the means of the stretches fulfil::

    |(a - b) / k| = g

six unknowns, for which six positions with each axis up and down once are enough, however crooked they are.

**Noise** of the standing robot, and the variances that a filter makes of it (thesis 4.4.3).  *Corrected*: (4.39) takes
the variance about the mean of ten minutes, so that a walking bias, and the heading that it turns, pass for noise.
Here it is the variance within batches of a second about a straight line.

**Motion** as the camera saw it is given without what a camera makes up.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import median_filter

from terrain.angles import unwrapped
from terrain.calibration.finding import Finding, around, undetermined
from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.feed import MIN_CONFIDENCE_RATIO
from terrain.identify import Parameter, half_width, identify, std_interval
from terrain.kinematics.camera import CHANNELS, body_motion
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import point_velocity, rolled_twist
from terrain.logs.schema import IMU_CHANNELS, TWIST
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.signals import true_stretches

#: Shorter stops are passed over: the robot still swings, and noise averages out too little.
MIN_STANDING_S = 5.0
BLOCK_S = 0.2  #: Length over which the IMU is judged to be quiet.
#: A quiet sensor scatters at most this many times as much as its description says, which may be a poor guess.
QUIET_FACTOR = 5.0
#: A steady rate above this is a rotation: the BNO055's zero-rate offset is within 3 deg/s (Bosch data sheet).
MAX_BIAS_RADPS = 0.06
#: Largest circumferential speed of a standing wheel: a single step of its Hall sensor reads as more after the low-pass
#: of the motor driver.
STANDING_MPS = 0.01
BATCH_S = 1.0  #: Means over batches of this length are as good as independent.
NO_STANDING = f"no run has a standing stretch of {MIN_STANDING_S:g} s: let the robot stand, switched on"

GYRO, ACCEL = IMU_CHANNELS[:3], IMU_CHANNELS[3:6]


class Stretch(NamedTuple):
    """A stretch of a run, ``[start_s, end_s)``; all of it by default."""

    run: RunLog
    start_s: float = -math.inf
    end_s: float = math.inf

    def of(self, stream: str, channels: Sequence[str]) -> Stream | None:
        """Return the known samples of some channels, None where there are not even two."""
        whole = self.run.streams.get(stream)
        if whole is None or not set(channels) <= set(whole.channels):
            return None
        first, end = np.searchsorted(whole.time_s, [self.start_s, self.end_s])
        values = np.column_stack([whole.channel(channel)[first:end] for channel in channels])
        known = np.isfinite(values).all(axis=1)
        if known.sum() < 2:
            return None
        return Stream(whole.time_s[first:end][known], values[known], tuple(channels))


def standing(run: RunLog, robot: Robot, min_s: float = MIN_STANDING_S) -> list[Stretch]:
    """Return the stretches, of at least ``min_s``, in which nothing moves.

    The wheels stand, where the log has any; the IMU is there, scatters about its noise (as described, or else as in
    its quietest tenth), turns by no more than a bias can, and is not frozen.  What is returned is short of the motion
    at either end by a block.
    """
    there = run.streams["imu"].channels if "imu" in run.streams else ()
    channels = [name for name in GYRO + ACCEL if name in there]
    imu = Stretch(run).of("imu", channels) if channels else None
    if imu is None:
        return []
    size = max(round(BLOCK_S * imu.rate_hz), 3)
    n = len(imu) // size
    values, time_s = imu.values[: n * size].reshape(n, size, -1), imu.time_s[: n * size].reshape(n, size)
    scatter, rates = values.std(axis=1), [name in GYRO for name in channels]
    wheels = Stretch(run).of("wheels", robot.rate_channels)
    if robot.describes("sensors"):
        usual = np.where(rates, robot.sensors.gyro_std_radps, robot.sensors.accel_std_mps2)
    elif wheels is None or not n:
        return []
    else:  # the quietest that the run has, where its wheels stand
        usual = np.array(
            [np.quantile(each[each > 0], 0.1) if (each > 0).any() else 0.0 for each in scatter.T]
        )
    quiet = ((scatter > 0) & (scatter < QUIET_FACTOR * usual)).all(axis=1) & (
        np.ptp(time_s, axis=1) < 1.5 * BLOCK_S
    )
    quiet &= (np.abs(values[:, :, rates].mean(axis=1)) < MAX_BIAS_RADPS).all(axis=1)
    if wheels is not None:
        by_rate = robot.wheel_radius_m / robot.reduction_ratio if robot.by_motor else 1.0
        moving_s = wheels.time_s[np.abs(wheels.values).max(axis=1) * by_rate > STANDING_MPS]
        quiet &= np.searchsorted(moving_s, time_s[:, 0]) == np.searchsorted(moving_s, time_s[:, -1])
        quiet &= (time_s[:, 0] >= wheels.time_s[0]) & (time_s[:, -1] <= wheels.time_s[-1] + BLOCK_S)
    # Nearly a block at either end shares its block with a motion; one more is left away for what swings on.
    return [
        Stretch(run, float(time_s[first + 1, 0]), float(time_s[end - 1, 0]))
        for first, end in true_stretches(quiet)
        if end - first > 2 and (end - first + 2) * BLOCK_S >= min_s
    ]


def batches(stream: Stream, length_s: float = BATCH_S) -> Iterator[Array]:
    """Yield the values (k, channels) of whole consecutive batches of a stream."""
    size = max(round(length_s * stream.rate_hz), 3)
    for first in range(0, len(stream) - size + 1, size):
        yield stream.values[first : first + size]


def gyro_bias(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return the biases of the three gyros and how much they differ from one power-on (each run) to the next.

    Notes
    -----
    The error of a mean is that of the means over :data:`BATCH_S`: the colour of the noise, and a bias that
    walks, count as far as they show within a run.
    """
    there = [stretch.run.streams["imu"].channels for stretch in stretches]
    axes = [
        axis for axis, name in zip("xyz", GYRO, strict=True) if all(name in channels for channels in there)
    ]
    names = [f"sensors.gyro_bias_{axis}_radps" for axis in axes]
    n, means = 0, dict[str, list[Array]]()
    for stretch in stretches:
        if axes and (stream := stretch.of("imu", [f"gyro_{axis}_radps" for axis in axes])):
            n += len(stream)
            means.setdefault(stretch.run.run_id, []).extend(batch.mean(axis=0) for batch in batches(stream))
    if not n:
        names = [f"sensors.gyro_bias_{axis}_radps" for axis in "xyz"]
        return undetermined([*names, "sensors.gyro_bias_std_radps"], NO_STANDING)
    parts = [np.array(part) for part in means.values()]
    found = np.array([part.mean(axis=0) for part in parts])
    variance = np.array([part.var(axis=0, ddof=1) / len(part) for part in parts])
    described = robot.sensors.gyro_bias_std_radps if robot.describes("sensors") else 0.0
    return biases(names, found, variance, described, n, "samples", tuple(means))


MIN_POWER_ONS = 3  #: From two, the upper end of a scatter's interval is four times the scatter.


def biases(
    names: Sequence[str],
    found: Array,
    variance: Array,
    described_std: float,
    n: int,
    counted: str,
    runs: tuple[str, ...],
) -> list[Finding]:
    """Predict the biases of future power-ons, and their scatter, from those of single power-ons.

    Found are (k, axes) biases in each power-on, each run one, with the variances of their errors; the described scatter
    is taken for true where there is one alone, and the interval is of that power-on where none is described.  However
    well a bias is known in one power-on, the scatter limits how well it predicts the next one.  The axes share one
    scatter, as the description has it: k power-ons give k - 1 degrees of freedom an axis.
    """
    (k, n_axes), mean = found.shape, found.mean(axis=0)
    dof, note = n_axes * (k - 1), "each run is taken for a power-on"
    std_name = re.sub("_[xyz]_", "_std_", names[0])
    if k == 1:
        note = f"one power-on: the next differs by {described_std:g}, as described"
        if not described_std > 0.0:
            note = "of this power-on: how much the next differs, one run does not show"
        between, half = math.nan, half_width(np.sqrt(variance[0] + described_std**2), math.inf)
    else:
        between = float(((found - mean) ** 2).sum() / dof)
        half = np.broadcast_to(half_width(math.sqrt(between / k), dof), n_axes)
    each = [around(*row, n, counted, runs, note) for row in zip(names, mean, half, strict=True)]
    if k < MIN_POWER_ONS:
        return each + undetermined(
            [std_name], f"{k} power-ons: {MIN_POWER_ONS} at least show how much they differ"
        )
    # What a single power-on's own error adds to the scatter is taken off.
    low, std, high = (
        math.sqrt(max(edge**2 - float(variance.mean()), 0.0))
        for edge in sorted((*std_interval(between, dof), math.sqrt(between)))
    )
    return [*each, Finding(std_name, std, low, high, k, "power-ons", runs, note)]


JUMP_S = 0.075  #: Width of the running median that a relocalisation of the camera stands out from.
#: By more than this, in m/s of both speeds, rad/s and rad; driving and noise stay below.
JUMP = (0.1, 0.1, 0.1, 0.05)
MAX_GAP_S = 0.1  #: Over a longer gap nothing is interpolated.
SEEN = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")


def seen_motion(stretch: Stretch, robot: Robot) -> Stream | None:
    """Return speeds of the camera point, yaw rate and yaw by the camera, with its latency taken off.

    Samples of low confidence, and those of a relocalisation (wrong speeds for a few samples), are left out.
    None where the camera saw nothing.
    """
    odometry = stretch.of("odometry", CHANNELS)
    if odometry is None or not robot.describes("camera"):
        return None
    camera = robot.camera
    seen = body_motion(odometry, camera)
    values = np.column_stack([seen.speed_mps, seen.yaw_rate_radps, seen.yaw_rad])
    confident = np.isfinite(values).all(axis=1) & (
        odometry.channel("confidence_ratio") >= MIN_CONFIDENCE_RATIO
    )
    if not confident.any():
        return None
    time_s, values = seen.time_s[confident] - camera.latency_s, values[confident]
    width = 2 * round(JUMP_S * odometry.rate_hz / 2) + 1
    kept = (np.abs(values - median_filter(values, size=(width, 1), mode="nearest")) <= JUMP).all(axis=1)
    return Stream(time_s[kept], values[kept], SEEN) if kept.any() else None


def origin_twist(stretch: Stretch, robot: Robot) -> Stream | None:
    """Return the twist of the robot's origin by the camera, or None where it saw nothing."""
    seen = seen_motion(stretch, robot)
    if seen is None:
        return None
    camera = robot.camera
    x_mps, y_mps, turn_radps = seen.values[:, :3].T
    origin = point_velocity(x_mps, y_mps, turn_radps, -camera.lever_x_m, -camera.lever_y_m)
    return Stream(seen.time_s, np.column_stack([*origin, turn_radps]), TWIST)


MIN_POSITION_S = 2.0  #: Of a position: "a couple of seconds" (thesis 3.3.3).
UPRIGHT_SHARE = 0.8  #: An axis points up or down where it carries that much of gravity: within 37 degrees.
#: Means over batches of this length are as good as independent: an accelerometer at rest has little colour.
POSITION_BATCH_S = 0.5

LEVEL_ONLY = (
    "level standing alone cannot tell: along z a bias looks like a scale, along x and y like a tilt; "
    "hold the IMU still in six positions, each axis up and down, in one log"
)

GRAVITY = f"gravity taken for {GRAVITY_MPS2} m/s^2; on Earth it is within 0.3 % of that"


def fit_gravity(means_mps2: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Return what makes gravity of the means of n resting stretches (n, 3) with the variances of their errors (n, 3).

    Biases (3,), scales (3,), and the covariance (6, 6) of both; ``DataError`` if an axis was never turned both up and
    down.

    Examples
    --------
    >>> up = GRAVITY_MPS2 * np.vstack([np.eye(3), -np.eye(3)])
    >>> bias, scale, _ = fit_gravity(1.02 * up + 0.1, np.full((6, 3), 1e-6))
    >>> bias.round(3), scale.round(3)
    (array([0.1, 0.1, 0.1]), array([1.02, 1.02, 1.02]))
    """
    share = means_mps2 / np.linalg.norm(means_mps2, axis=1)[:, None]
    for i, axis in enumerate("xyz"):
        if share[:, i].max() < UPRIGHT_SHARE or share[:, i].min() > -UPRIGHT_SHARE:
            raise DataError(f"axis {axis} was not turned both up and down: six positions are needed")
    values = np.concatenate([(means_mps2.max(axis=0) + means_mps2.min(axis=0)) / 2, np.ones(3)])
    parameters = [
        Parameter(f"{name}_{axis}", v) for name, v in (("bias", 0.0), ("scale", 1.0)) for axis in "xyz"
    ]

    def residual(values: Array) -> Array:
        force = (means_mps2 - values[:3]) / values[3:]
        size = np.linalg.norm(force, axis=1)
        towards = force / size[:, None] / values[3:]  # d|f|/da
        return np.asarray((GRAVITY_MPS2 - size) / np.sqrt((towards**2 * variance).sum(axis=1)))

    fit = identify(residual, parameters, starts=[values])
    dof = len(means_mps2) - 6
    spread = max(float(fit.residual @ fit.residual) / dof, 1.0) if dof else 1.0
    return fit.value[:3], fit.value[3:], spread * fit.cov


def accelerometer(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return biases and scales of the accelerometer by runs held in six positions, and how much biases differ."""
    bias_names, scale_names = (
        [f"sensors.accel_{name}_{axis}_{unit}" for axis in "xyz"]
        for name, unit in (("bias", "mps2"), ("scale", "ratio"))
    )
    of_run: dict[str, list[Array]] = {}
    for stretch in stretches:
        if stream := stretch.of("imu", ACCEL):
            means = np.array([batch.mean(axis=0) for batch in batches(stream, POSITION_BATCH_S)])
            of_run.setdefault(stretch.run.run_id, []).append(means)
    fits = {}
    for run_id, positions in of_run.items():
        spare = sum(len(means) - 1 for means in positions)
        squares = sum(((means - means.mean(axis=0)) ** 2).sum(axis=0) for means in positions)
        try:
            fits[run_id] = fit_gravity(
                np.array([means.mean(axis=0) for means in positions]),
                np.array([squares / spare / len(means) for means in positions]),
            )
        except DataError:
            continue
    if not fits:
        return undetermined([*bias_names, *scale_names, "sensors.accel_bias_std_mps2"], LEVEL_ONLY)
    runs = tuple(fits)
    n = sum(len(of_run[run_id]) for run_id in runs)
    bias, scale, cov = (np.array(part) for part in zip(*fits.values(), strict=True))
    variance = np.diagonal(cov, axis1=1, axis2=2)
    described = robot.sensors.accel_bias_std_mps2 if robot.describes("sensors") else 0.0
    half = half_width(np.sqrt(variance[:, 3:].mean(axis=0) / len(runs)), math.inf)
    scales = zip(scale_names, scale.mean(axis=0), half, strict=True)
    return [
        *biases(bias_names, bias, variance[:, :3], described, n, "positions", runs),
        *(around(*row, n, "positions", runs, GRAVITY) for row in scales),
    ]


NO_NOISE_SHARE = 0.01  #: Of the described standard deviation: a channel with less shows no noise at rest.
#: Noise under this share of an encoder's step hides in the step; above, step^2/12 taken off is right (Sheppard).
MIN_NOISE_STEPS = 0.4
FIXED_RATIO = 0.5  #: Of a stretch whose fixes have less, the noise is that of another solution.
LAGS = 10  #: Lags over which noise is looked at for colour.
#: Least variance of a measurement, in its squared natural unit: no filter shall take a sensor for perfect (4.4.3).
NOISE_FLOOR = 1e-5


#: Stream and channels whose scatter at rest a number is; those of each wheel with its name for the braces.
NOISE: Mapping[str, tuple[str, Sequence[str]]] = {
    "sensors.gyro_std_radps": ("imu", GYRO),
    "sensors.accel_std_mps2": ("imu", ACCEL),
    "sensors.yaw_std_rad": ("imu", ("yaw_rad",)),
    "sensors.motor_std_radps": ("wheels", ("motor_{}_radps",)),
    "sensors.current_std_a": ("wheels", ("current_{}_a",)),
    "sensors.steering_std_rad": ("steering", ("angle_{}_rad",)),
    "camera.speed_std_mps": ("", SEEN[:2]),
    "camera.yaw_rate_std_radps": ("", SEEN[2:3]),
    "camera.yaw_std_rad": ("", SEEN[3:]),
    "identified.gnss_std_m": ("gnss", ("position_x_m", "position_y_m")),
    "identified.pose_std_m": ("pose", ("position_x_m", "position_y_m")),
    "identified.lidar_std_mps": ("lidar", TWIST[:2]),
}


def sensor_noise(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return the standard deviation of the noise of each kind of sensor at rest.

    Notes
    -----
    The interval is that of chi square with ``n / (1 + 2 sum rho_k^2)`` degrees of freedom, ``rho_k`` the
    autocorrelation.  Of the steering angle, the variance of its steps, ``step^2/12``, is taken off: the
    description has the steps by themselves.
    """
    if not stretches:
        return undetermined([name for name in NOISE if robot.describes(name.partition(".")[0])], NO_STANDING)
    seen, found = [seen_motion(stretch, robot) for stretch in stretches], []
    for parameter, (stream, names) in NOISE.items():
        channels = [
            name.format(wheel) for name in names for wheel in (robot.wheels if "{" in name else ("",))
        ]
        n, runs, left = 0, [], []
        logged = [set(each.run.streams[stream].channels) for each in stretches if stream in each.run.streams]
        channels = [name for name in channels if all(name in has for has in logged)] if logged else channels
        if not (logged and channels) and stream and not robot.describes(parameter.partition(".")[0]):
            continue
        for stretch, by_camera in zip(stretches, seen, strict=True):
            signal = stretch.of(stream, channels) if channels else None
            if stream == "gnss" and (fixed := stretch.of("gnss", (*channels, "fix_ratio"))) is not None:
                signal = Stream(fixed.time_s, fixed.values[:, :-1], tuple(channels))
                signal = signal if fixed.values[:, -1].min() >= FIXED_RATIO else None
            if not stream and by_camera is not None:
                columns = by_camera.columns(channels)
                signal = Stream(by_camera.time_s, columns, tuple(channels))
            elif signal is not None and parameter.endswith("_rad"):
                turned = np.column_stack([unwrapped(column) for column in signal.values.T])
                signal = Stream(signal.time_s, turned, signal.channels)
            if signal is not None:
                n += len(signal)
                runs.append(stretch.run.run_id)
                for batch in batches(signal):  # about the straight line that fits each channel best
                    x, centred = np.linspace(-1.0, 1.0, len(batch))[:, None], batch - batch.mean(axis=0)
                    left.append(centred - x * (x * centred).sum(axis=0) / (x**2).sum())
        found.append(_noise(parameter, left, n, runs, robot))
    return found


def _noise(parameter: str, residuals: Sequence[Array], n: int, runs: Sequence[str], robot: Robot) -> Finding:
    """Return the finding of one number by the residuals of batches about straight lines."""
    section, _, name = parameter.partition(".")
    described = getattr(getattr(robot, section), name) if robot.describes(section) else 0.0
    if not residuals:
        return undetermined([parameter], "no standing stretch has this signal")[0]
    squares = float(sum((part**2).sum() for part in residuals))
    if squares <= sum(part.size for part in residuals) * (NO_NOISE_SHARE * described) ** 2:
        return undetermined([parameter], "no noise at rest")[0]
    together = [
        sum(float((part[lag:] * part[:-lag]).sum()) for part in residuals if len(part) > lag)
        for lag in range(1, LAGS + 1)
    ]
    correlation = np.array(together) / sum(float((part**2).sum()) for part in residuals)
    # A line takes two samples' worth of white noise with it, and more of coloured noise.
    taken = 2 * max(1 + 2 * correlation.sum(), 1.0)
    dof = sum((len(part) - taken) * part.shape[1] for part in residuals)
    variance = squares / dof
    low, high = std_interval(variance, dof / (1 + 2 * (correlation**2).sum()))
    step_variance = 0.0
    if parameter == "sensors.steering_std_rad" and robot.describes("sensors"):
        step = 2 * math.pi / robot.sensors.steering_steps_ratio
        step_variance = step**2 / 12
        if variance - step_variance < (MIN_NOISE_STEPS * step) ** 2:
            return undetermined([parameter], f"the noise hides below the encoder's step of {step:.2g} rad")[0]
    value, low, high = (math.sqrt(max(x - step_variance, 0.0)) for x in (variance, low**2, high**2))
    return Finding(parameter, value, low, high, n, "samples", tuple(dict.fromkeys(runs)))


MOUNTING = tuple(f"identified.imu_{name}_rad" for name in ("roll", "pitch", "yaw"))
SPAN_S = 0.5  #: Over which a change of speed is compared with the integral of the acceleration.
MIN_SPEED_CHANGE_MPS = 0.05  #: Over that; less is noise.
MAX_TURNED_RAD = 0.1  #: Interval of a yaw from which on it is not stated.
SLOPE = "over runs, as the slope under one and the bias of the accelerometer look alike"


def mounting(
    runs: Sequence[RunLog],
    rests: Sequence[Stretch],
    robot: Robot,
    bias_mps2: Sequence[float] = (0.0, 0.0, 0.0),
) -> list[Finding]:
    """Return roll, pitch and yaw by which the IMU is turned in the body; its accelerometer's biases are taken off.

    Notes
    -----
    Gravity at rest on a level floor is ``(-sin pitch, sin roll cos pitch, cos roll cos pitch) g`` in the axes of the
    IMU.  Over :data:`SPAN_S` the integrals of both horizontal axes are the changes of speed ``dv`` ahead and ``v w dt``
    to the left, by the wheels and the gyro, turned by the yaw; each has a gain of its own, as a body that pitches or
    rolls adds gravity in proportion.  Robots that drive sideways have no direction ahead that the wheels alone show.
    """
    with_accel = [
        run for run in runs if "imu" in run.streams and set(ACCEL) <= set(run.streams["imu"].channels)
    ]
    if not with_accel:
        return undetermined(
            MOUNTING, "no run has all of accel_x_mps2, accel_y_mps2 and accel_z_mps2 (stream 'imu')"
        )
    of_run: dict[str, list[Array]] = {}
    for stretch in rests:
        if stream := stretch.of("imu", ACCEL):
            of_run.setdefault(stretch.run.run_id, []).append(stream.values.mean(axis=0))
    found = undetermined(MOUNTING[:2], NO_STANDING)
    if of_run:
        x, y, z = (np.array([np.mean(means, axis=0) for means in of_run.values()]) - bias_mps2).T
        angles = np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))])
        found = undetermined(MOUNTING[:2], f"{len(angles)} runs at rest: {MIN_POWER_ONS} are needed {SLOPE}")
        if len(angles) >= MIN_POWER_ONS:
            half = half_width(angles.std(axis=0, ddof=1) / math.sqrt(len(angles)), len(angles) - 1)
            rows = zip(MOUNTING, angles.mean(axis=0), half, strict=False)
            found = [around(*row, len(angles), "runs", of_run, SLOPE) for row in rows]
    changes = [part for run in with_accel if (part := _speed_changes(run, robot)) is not None]
    nothing = undetermined(MOUNTING[2:], "too few starts and stops beside wheel speeds show where ahead is")
    if robot.sideways or sum(map(len, changes)) < 2 * MIN_DRIVEN:
        return [*found, *nothing]
    number = np.repeat(np.arange(len(changes)), [len(part) for part in changes])
    if len(changes) < MIN_POWER_ONS:  # blocks of time
        number = np.concatenate([np.arange(len(part)) // MIN_DRIVEN for part in changes])
        number += np.repeat(100_000 * np.arange(len(changes)), [len(part) for part in changes])
        number = np.unique(number, return_inverse=True)[1]
    ahead, left, x, y = np.concatenate(changes).T

    def residual(p: Array) -> Array:
        by_x, by_y = p[0] * ahead, p[1] * left
        turned_x, turned_y = (
            by_x * np.cos(p[2]) + by_y * np.sin(p[2]),
            by_y * np.cos(p[2]) - by_x * np.sin(p[2]),
        )
        return np.column_stack([x - turned_x - p[3], y - turned_y - p[4]])

    gains = [Parameter(f"gain_{axis}", 1.0, 0.2, 5.0, step=0.1) for axis in "xy"]
    offsets = [Parameter(f"offset_{axis}_mps", 0.0, step=0.05) for axis in "xy"]
    turned = Parameter("yaw_rad", 0.0, -4.0, 4.0, step=0.1)
    starts = [np.array([1.0, 1.0, at, 0.0, 0.0]) for at in (0.0, math.pi / 2, -math.pi / 2, math.pi)]
    fit = identify(residual, [*gains, turned, *offsets], number, True, starts, scale=(0.1, 1e-3))
    yaw, apart = float(fit.value[2]), float(half_width(fit.std[2], len(fit.influence) - 1))
    if not apart < MAX_TURNED_RAD / 2:
        return [*found, *nothing]
    ids = [run.run_id for run in with_accel]
    return [
        *found,
        around(MOUNTING[2], yaw, apart, len(x), "changes of speed", ids, "by accelerations along the motion"),
    ]


MIN_DRIVEN = 20  #: Changes of speed of a cluster, and half of those at the least.


def _speed_changes(run: RunLog, robot: Robot) -> Array | None:
    """Return changes of speed ahead and to the left by wheels and gyro, and integrals of both accelerations (n, 4)."""
    driven, imu = with_rolled(run, robot), Stretch(run).of("imu", ("gyro_z_radps", *ACCEL[:2]))
    if driven is None or imu is None:
        return None
    time_s, twist = driven
    edges_s = np.arange(max(time_s[0], imu.time_s[0]), min(time_s[-1], imu.time_s[-1]), SPAN_S)
    if len(edges_s) < 3:
        return None
    gained = cumulative_trapezoid(imu.values, imu.time_s, axis=0, initial=0.0)
    yaw, x, y = np.diff([np.interp(edges_s, imu.time_s, column) for column in gained.T])
    speed = np.interp(edges_s, time_s, twist[:, 0])
    ahead, left = np.diff(speed), 0.5 * (speed[1:] + speed[:-1]) * yaw
    moves = np.hypot(ahead, left) >= MIN_SPEED_CHANGE_MPS
    return np.column_stack([ahead, left, x, y])[moves] if moves.any() else None


def with_rolled(run: RunLog, robot: Robot) -> tuple[Array, Array] | None:
    """Return stamps (n,) and the twist (n, 3) that the wheels would roll without slip; None without their speeds."""
    run = with_wheel_speeds(run, robot)
    speeds = Stretch(run).of("wheels", [f"speed_{wheel}_mps" for wheel in robot.logged_wheels])
    if speeds is None:
        return None
    steer = np.zeros((len(speeds), len(robot.wheels)))
    if robot.steered:
        angles = Stretch(run).of("steering", robot.steer_channels)
        if angles is None:
            return None
        for i, column in enumerate(angles.values.T):
            steer[:, i] = (
                np.interp(speeds.time_s, angles.time_s, unwrapped(column)) - robot.steering_zeros_rad[i]
            )
    return speeds.time_s, rolled_twist(robot, speeds.values, steer)


WHEEL_NOISE = "identified.wheel_speed_std_mps"


def wheel_noise(runs: Sequence[RunLog], robot: Robot) -> list[Finding]:
    """Return the noise of wheel speeds in motion, by their second differences, of which the median counts.

    Of white noise they have six times its variance; a speed that changes evenly has none.  Values that repeat are
    one measurement held.
    """
    if robot.by_motor:
        return []
    stds, ids = [], []
    for run in runs:
        stream = Stretch(run).of("wheels", robot.rate_channels)
        values = np.empty((0, 1)) if stream is None else stream.values
        parts = [column[np.flatnonzero(np.diff(column, prepend=np.nan))] for column in values.T]
        second = (
            np.concatenate([np.diff(part[np.abs(part) > STANDING_MPS], 2) for part in parts])
            if parts
            else values
        )
        if len(second) >= MIN_DRIVEN:
            stds.append(float(np.median(np.abs(second)) / 0.6745 / math.sqrt(6.0)))
            ids.append(run.run_id)
    if len(stds) < MIN_POWER_ONS:
        return undetermined(
            [WHEEL_NOISE], f"{len(stds)} runs drive: {MIN_POWER_ONS} at least show how noise differs"
        )
    half = float(half_width(float(np.std(stds, ddof=1)) / math.sqrt(len(stds)), len(stds) - 1))
    if not np.mean(stds) > half:
        return undetermined([WHEEL_NOISE], "the noise hides below the steps of the wheel speeds")
    return [around(WHEEL_NOISE, float(np.mean(stds)), half, len(stds), "runs", ids, "of a sample, in motion")]


def measurement_variances(robot: Robot, floor: float = NOISE_FLOOR) -> dict[str, float]:
    """Return the variance of each row that a filter measures, in its squared natural unit.

    Parameters
    ----------
    robot : swerve robot with all sections
    floor : least variance

    Notes
    -----
    These are the sensors' own, sample by sample and at rest: thesis 4.4.3 with the floor of its (4.40).  A
    low-pass before the filter makes them smaller, driving over rough ground makes those of the
    accelerations larger.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> variances = measurement_variances(load_robot("agrimaro"))
    >>> variances["camera_speed_x_mps"], round(variances["accel_x_mps2"], 6)
    (1e-05, 0.000135)
    """
    motors, camera, sensors = robot.motors, robot.camera, robot.sensors
    steering = sensors.steering_std_rad**2 + (2 * math.pi / sensors.steering_steps_ratio) ** 2 / 12
    variances = {
        **{f"wheel_{i}_radps": (sensors.motor_std_radps / motors.reduction_ratio) ** 2 for i in robot.wheels},
        "accel_x_mps2": (sensors.accel_std_mps2 / sensors.accel_scale_x_ratio) ** 2,
        "accel_y_mps2": (sensors.accel_std_mps2 / sensors.accel_scale_y_ratio) ** 2,
        "gyro_z_radps": sensors.gyro_std_radps**2,
        "imu_yaw_rad": sensors.yaw_std_rad**2,
        **{f"steer_{i}_rad": steering for i in robot.wheels},
        "camera_speed_x_mps": camera.speed_std_mps**2,
        "camera_speed_y_mps": camera.speed_std_mps**2,
        "camera_yaw_rate_radps": camera.yaw_rate_std_radps**2,
        "camera_yaw_rad": camera.yaw_std_rad**2,
    }
    return {row: max(variance, floor) for row, variance in variances.items()}
