"""Faults of sensors in a closed loop: a catalogue, one entry a fault, and the bus that applies one.

A fault acts on the readings of its streams, on their stamps, and on when they arrive.  It is a :data:`Change`: a
function of a reading and of what has to be remembered from step to step, :class:`StreamMemory`; the motion and the
sensors' own arrays are not touched, so that a drive with a fault differs from one without by what the controller makes
of it alone.

Magnitudes are those at which a fault matters for slip control at 1 m/s: an error of 0.3 m/s in the speed over ground is
30 % of slip, one of 20 % in a motor's rate 17 %; the others are several times what a sensor that works shows
(``sensors`` of a robot's description), and none is so large that a limit of range would find it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_body, to_camera
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot
from terrain.simulation.sensors import TILT_NOISE_RAD, Gnss

STREAMS = ("wheels", "steering", "imu", "odometry", "gnss")
"""Streams that faults act on, those that a robot has; ``odometry`` is the camera's."""


class Nature(Enum):
    """What a fault makes of the streams that it touches, which decides what a controller has to do.

    ``DEAD`` and ``LYING`` streams carry no information or a wrong one: no correction may be based on them.  With a
    ``TOLERABLE`` fault the streams still carry the motion, and the controller has to go on.  With a ``DEGRADED`` one it
    may do either.
    """

    DEAD = "dead"
    LYING = "lying"
    TOLERABLE = "tolerable"
    DEGRADED = "degraded"


@dataclass(slots=True)
class StreamMemory:
    """What is remembered of one stream."""

    rng: np.random.Generator  # of all that is drawn for the stream
    last: Array | None = None  # (c,) its last values before the fault began; None before the first sample
    n_samples: int = 0  # number of its samples that the fault has acted on
    # times at which samples that are held back are due, and the samples, in order
    pending: list[tuple[float, Reading]] = field(default_factory=list)


# From what a stream gave at a step, in arrays that it may write to and maybe none, and the time of the step, to
# what arrives of it; None for nothing.
Change = Callable[[Reading, StreamMemory, float], Reading | None]


class SensorFault(NamedTuple):
    """An entry of the catalogue."""

    name: str  # of the fault, and of the group that it is in
    kind: str
    about: str  # what it does, in one sentence
    streams: tuple[str, ...]  # that it touches
    nature: Nature  # what it makes of them
    change: Change  # what it does to each of them
    # by how much the clock of the whole robot is shifted: all stamps, and that of the step
    clock_s: float = 0.0


class FaultyBus:
    """A controller behind a bus with a fault, to be given to ``simulate`` in its place.

    Parameters
    ----------
    controller : gets what arrives
    fault : acts on the samples of the steps from ``start_s`` on and before ``end_s``
    start_s, end_s : on the clock of the steps; an infinite end is for good
    seed : of all that the fault draws, from 0 up

    Raises
    ------
    ConfigError
        if the start is not finite, or the end not after it.

    Examples
    --------
    >>> gone = SensorFault("gone", "loss", "", ("imu",), Nature.DEAD, lost)
    >>> arrived = []
    >>> bus = FaultyBus(lambda sample: arrived.append(sorted(sample.readings)), gone, 1.0, 2.0, seed=0)
    >>> for time_s in (0.98, 1.0, 2.0):
    ...     bus(Sample(time_s, np.zeros(3), {"imu": Reading(np.array([time_s]), np.zeros((1, 9)))}))
    >>> arrived
    [['imu'], [], ['imu']]
    """

    def __init__(
        self,
        controller: Callable[[Sample], Command],
        fault: SensorFault,
        start_s: float,
        end_s: float,
        seed: int,
    ) -> None:
        if not (math.isfinite(start_s) and end_s > start_s):
            raise ConfigError(f"fault {fault.name}: acts from {start_s!r} to {end_s!r} s, start before end")
        self._controller, self._fault, self._start_s, self._end_s = controller, fault, start_s, end_s
        seeds = np.random.SeedSequence([seed, zlib.crc32(fault.name.encode())]).spawn(len(STREAMS))
        memories = (StreamMemory(np.random.default_rng(drawn)) for drawn in seeds)
        self._memory = dict(zip(STREAMS, memories, strict=True))

    def __call__(self, sample: Sample) -> Command:
        """Return the controller's command for what arrives of a sample."""
        readings, fault, shift_s = dict(sample.readings), self._fault, self._fault.clock_s
        if sample.time_s < self._start_s:
            for name in self._memory.keys() & readings.keys():
                self._memory[name].last = readings[name].values[-1].copy()
        elif sample.time_s < self._end_s:
            for name in fault.streams:
                given, memory = readings.pop(name, _NOTHING), self._memory[name]
                time_s = given.time_s + shift_s if shift_s else given.time_s.copy()
                changed = fault.change(Reading(time_s, given.values.copy()), memory, sample.time_s)
                memory.n_samples += len(given.time_s)
                if changed is not None and (changed.time_s is None or len(changed.time_s)):
                    readings[name] = changed
            sample = sample._replace(readings=readings, time_s=sample.time_s + shift_s)
        else:  # with all that was held back before, which is held back no more
            for name, memory in self._memory.items():
                if memory.pending:
                    late = [reading for _, reading in memory.pending]
                    readings[name] = _joined([*late, *([readings[name]] if name in readings else [])])
                    memory.pending.clear()
            sample = sample._replace(readings=readings)
        return self._controller(sample)


_NOTHING = Reading(np.empty(0), np.empty((0, 0)))


def _joined(readings: Sequence[Reading]) -> Reading:
    return Reading(*(np.concatenate(parts) for parts in zip(*readings, strict=True)))


EVERY = 10  # of the faults of single samples, one in so many samples has one

_SLACK_S = 1e-9  # stamps and steps that differ by less are the same instant
_QUATERNION = slice(
    CAMERA_CHANNELS.index("quaternion_x_ratio"), CAMERA_CHANNELS.index("quaternion_w_ratio") + 1
)
_VELOCITY = slice(CAMERA_CHANNELS.index("velocity_x_mps"), CAMERA_CHANNELS.index("velocity_z_mps") + 1)


def lost(reading: Reading, memory: StreamMemory, now_s: float) -> None:
    """Let nothing arrive."""


def written(write: Callable[[Array, StreamMemory], Any]) -> Change:
    """Let a function write to all values (k, c), or return others in their place."""

    def change(reading: Reading, memory: StreamMemory, now_s: float) -> Reading:
        values = write(reading.values, memory) if len(reading.time_s) else None
        return reading if values is None else reading._replace(values=values)

    return change


def stamped(offset_s: float, chosen: bool = False) -> Change:
    """Add a time to all stamps, or to each tenth; a time that is not finite takes their place."""

    def change(reading: Reading, memory: StreamMemory, now_s: float) -> Reading:
        reading.time_s[_chosen(len(reading.time_s), memory) if chosen else slice(None)] += offset_s
        return reading

    return change


def late(delay_s: float, jitter_s: float = 0.0) -> Change:
    """Deliver each sample a time after its stamp, and up to ``jitter_s`` later by chance; in their order."""

    def change(reading: Reading, memory: StreamMemory, now_s: float) -> Reading | None:
        for row in _rows(reading):
            due_s = float(row.time_s[0]) + delay_s
            due_s += float(memory.rng.uniform(0.0, jitter_s)) if jitter_s else 0.0
            before_s = memory.pending[-1][0] if memory.pending else -math.inf
            memory.pending.append((max(due_s, before_s), row))
        n_due = sum(due_s <= now_s + _SLACK_S for due_s, _ in memory.pending)
        arrives = [row for _, row in memory.pending[:n_due]]
        del memory.pending[:n_due]
        return _joined(arrives) if arrives else None

    return change


def out_of_order(reading: Reading, memory: StreamMemory, now_s: float) -> Reading | None:
    """Deliver of each two samples the later one first."""
    arrives = []
    for row in _rows(reading):
        if memory.pending:
            arrives += [row, memory.pending.pop()[1]]
        else:
            memory.pending.append((float(row.time_s[0]), row))
    return _joined(arrives) if arrives else None


def _rows(reading: Reading) -> list[Reading]:
    """Return the samples of a reading one by one."""
    return [Reading(reading.time_s[i : i + 1], reading.values[i : i + 1]) for i in range(len(reading.time_s))]


def _last_values(values: Array, memory: StreamMemory) -> Array:
    """Return the last values (c,) before the fault; without any, the first during it."""
    if memory.last is None:
        memory.last = values[0].copy()
    return memory.last


def _chosen(n: int, memory: StreamMemory) -> Array:
    """Return which of n samples are each tenth of those that the fault has acted on."""
    return np.asarray((memory.n_samples + np.arange(n)) % EVERY == EVERY - 1)


def _columns(channels: Sequence[str], start: str) -> list[int] | slice:
    """Return the columns of channels that start with a word; all without channels."""
    return [i for i, name in enumerate(channels) if name.startswith(start)] if channels else slice(None)


def frozen(channels: Sequence[str] = (), start: str = "") -> Change:
    """Repeat the last values before the fault; stamps go on."""
    columns = _columns(channels, start)

    def write(values: Array, memory: StreamMemory) -> None:
        values[:, columns] = _last_values(values, memory)[columns]

    return written(write)


def scaled(channels: Sequence[str], start: str, factor: float = 1.0, amount: float = 0.0) -> Change:
    """Multiply channels by a number and add another."""
    columns = _columns(channels, start)

    def write(values: Array, memory: StreamMemory) -> None:
        values[:, columns] = values[:, columns] * factor + amount

    return written(write)


def filled(value: float, chosen: bool = False) -> Change:
    """Replace all values by one, or those of each tenth sample."""

    def write(values: Array, memory: StreamMemory) -> None:
        values[_chosen(len(values), memory) if chosen else slice(None)] = value

    return written(write)


def camera_forward(values: Array) -> Array:
    """Return the robot's forward direction (k, 3) in the camera's fixed frame, in which its velocity is.

    Parameters
    ----------
    values : (k, 14) of the camera; without a rotation in them the direction is NaN

    Examples
    --------
    >>> level = np.zeros((1, 14))
    >>> level[0, 6] = 1.0  # the quaternion of no rotation
    >>> camera_forward(level) + 0.0
    array([[ 0.,  0., -1.]])
    """
    quaternion = values[:, _QUATERNION]
    x, y, z = to_body(quaternion[:, :3]).T
    w = quaternion[:, 3]
    ahead = np.column_stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)])
    ahead[np.linalg.norm(quaternion, axis=1) < 0.5] = np.nan
    return to_camera(ahead)


def camera_speed_offset(amount_mps: float) -> Change:
    """Add to the camera's forward speed, wherever the robot is heading."""

    def write(values: Array, memory: StreamMemory) -> None:
        values[:, _VELOCITY] += amount_mps * camera_forward(values)

    return written(write)


def _freeze_camera_speed(values: Array, memory: StreamMemory) -> None:
    """Repeat the camera's last forward speed before the fault; all else goes on."""
    last = _last_values(values, memory)[None, :]
    held_mps = float((last[:, _VELOCITY] * camera_forward(last)).sum())
    forward = camera_forward(values)
    speed_mps = (values[:, _VELOCITY] * forward).sum(axis=1)
    values[:, _VELOCITY] += (held_mps - speed_mps)[:, None] * forward


def _turn_camera(values: Array, memory: StreamMemory) -> None:
    """Turn the camera's orientation to the left about the vertical; its velocity stays."""
    w, up = math.cos(YAW_STEP_RAD / 2), math.sin(YAW_STEP_RAD / 2)
    x, y, z, scalar = values[:, _QUATERNION].T.copy()  # y is up
    turned = w * x + up * z, w * y + up * scalar, w * z - up * x, w * scalar - up * y
    values[:, _QUATERNION] = np.column_stack(turned)


def _of_width(n_columns: int) -> Change:
    """Give the samples of another robot, with that number of columns; those that are added are 0."""

    def write(values: Array, memory: StreamMemory) -> Array:
        n_added = max(n_columns - values.shape[1], 0)
        return np.pad(values[:, :n_columns], ((0, 0), (0, n_added)))

    return written(write)


SPEED_STEP_MPS, MOTOR_FACTOR, PITCH_STEP_RAD, YAW_STEP_RAD, POSITION_STEP_M = 0.3, 1.2, 0.2, 0.3, 1.0
GYRO_STEP_RADPS, ACCEL_STEP_MPS2, STEERING_STEP_RAD = 0.1, 2.0, 0.1
NOISE_FACTOR, SPIKE = 10.0, 1e6
LATE_S: tuple[float, ...] = (0.03, 0.1, 0.15)
BEHIND_S, JITTER_S = 0.03, 0.06
EITHER = (
    *("freeze_steering", "freeze_steering_1", "zeros_steering", "step_yaw"),
    *("late_100ms_wheels", "late_150ms_wheels"),
)
"""Faults of which a controller may be right to go on, or to stop correcting: steering that repeats itself or reads zero
tells the truth on a straight drive; a heading of the IMU that was set is no slip; wheels that come so late are too slow
for a control of slip."""

# Number of columns of another robot's streams: one with four wheels, and sensors that report less; of streams that have
# as many, two more.
OTHER_WIDTH: Mapping[str, int] = {"wheels": 4, "steering": 4, "imu": 6, "odometry": 3, "gnss": 3}


def fault_catalogue(robot: Robot) -> dict[str, SensorFault]:
    """Return all faults by name, in the order of the table.

    Parameters
    ----------
    robot : with sensors, whose noise is multiplied; its streams are those of
        :func:`~terrain.kinematics.logged_wheels.sensor_channels`

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> faults = fault_catalogue(load_robot("agrimaro"))
    >>> faults["step_camera_speed"].streams, faults["step_camera_speed"].nature.value, len(faults)
    (('odometry',), 'lying', 122)
    >>> len(fault_catalogue(load_robot("husky")))
    122
    """
    dead, lying, tolerable, degraded = Nature
    channels = sensor_channels(robot)
    each, cam, some = "each", "odometry", f"of each {EVERY} samples one"
    late_by, times = "samples arrive{} {:g} ms after their stamps", f"times {MOTOR_FACTOR:g}"
    chance = f"{late_by.format(' up to', 1000 * JITTER_S)}, by chance"
    noisy = f"noise {NOISE_FACTOR:g} times the described one is added"

    def spread(std: Array) -> Change:
        return written(lambda values, memory: values + std * memory.rng.standard_normal(values.shape))

    def shaped(shape: Callable[[Reading], Reading]) -> Change:
        """Give something of another shape or type in place of a reading."""
        return lambda reading, memory, now_s: shape(reading) if len(reading.time_s) else None

    words = written(lambda values, memory: np.full(values.shape, "unknown"))
    ragged = written(lambda values, memory: [[0.0] * (1 + k) for k in range(len(values) + 1)])
    nothing = shaped(lambda reading: Reading(None, None))  # type: ignore[arg-type]
    twice = shaped(lambda reading: Reading(*(np.repeat(part, 2, axis=0) for part in reading)))
    offsets = [
        ("imu", "pitch", "pitch", PITCH_STEP_RAD, "rad"),
        ("imu", "yaw", "yaw", YAW_STEP_RAD, "rad"),
        ("imu", "gyro_z", "gyro", GYRO_STEP_RADPS, "rad/s"),
        ("imu", "accel_x", "accel", ACCEL_STEP_MPS2, "m/s^2"),
    ]
    angle, *_ = *channels.get("steering", ()), ""
    steered = angle.removeprefix("angle_").removesuffix("_rad")
    offsets += [("steering", angle, f"steering_{steered}", STEERING_STEP_RAD, "rad")] if angle else []
    of_gnss = (
        ("speed", "velocity_x", SPEED_STEP_MPS, "m/s"),
        ("position", "position_x", POSITION_STEP_M, "m"),
    )
    if "gnss" in channels:
        offsets += [("gnss", start, f"gnss_{n}", by, unit) for n, start, by, unit in of_gnss]
        offsets.append(("gnss", "velocity_x", "gnss_speed_down", -SPEED_STEP_MPS, "m/s"))
    clocks = {"clock_forward": 3600.0, "clock_back": -3600.0}
    wheels = channels["wheels"]
    rates = [(rate, *_rate_of(rate)) for rate in robot.rate_channels]
    rows: list[tuple[str, str, Nature, str, Change]] = [
        ("loss", each, dead, "no sample arrives", lost),
        ("loss_all", "all", dead, "no sample of any stream arrives", lost),
        ("freeze", each, dead, "all values repeat, stamps go on", frozen()),
        ("freeze_all", "all", dead, "all values of all streams repeat", frozen()),
    ]
    seen = _camera_faults(channels[cam]) if cam in channels else ()
    rows += [(f"freeze_{n}", cam, dead, about, change) for n, is_frozen, about, change in seen if is_frozen]
    rows += [
        (f"freeze_{n}", "wheels", dead, f"the {what} repeats", frozen(wheels, rate))
        for rate, n, what in rates
    ]
    gyros = ("gyro", "accel", "pitch")
    rows += [(f"freeze_{n}", "imu", dead, f"{n} repeats", frozen(channels["imu"], n)) for n in gyros]
    if angle:
        about = f"steering angle {steered} repeats"
        rows.append(
            (f"freeze_steering_{steered}", "steering", dead, about, frozen(channels["steering"], angle))
        )
    if "gnss" in channels:
        parts = ("velocity", "position")
        rows += [
            (f"freeze_gnss_{n}", "gnss", dead, f"the {n} repeats", frozen(channels["gnss"], n)) for n in parts
        ]
    rows += [
        (f"step_{n}", cam, lying, about, change) for n, is_frozen, about, change in seen if not is_frozen
    ]
    rate, n, what = rates[0]
    rows.append((f"step_{n}", "wheels", lying, f"{what} {times}", scaled(wheels, rate, MOTOR_FACTOR)))
    rows += [
        *(
            (
                f"step_{n}",
                stream,
                lying,
                f"{n} {by:g} {unit} more",
                scaled(channels[stream], start, amount=by),
            )
            for stream, start, n, by, unit in offsets
        ),
        ("nan", each, dead, "all values are NaN", filled(math.nan)),
        ("nan_some", each, tolerable, f"{some} has values of NaN", filled(math.nan, chosen=True)),
        ("inf", each, dead, "all values are infinite", filled(math.inf)),
        ("minus_inf", each, dead, "all values are -inf", filled(-math.inf)),
        ("spikes", each, tolerable, f"{some} has values of {SPIKE:g}", filled(SPIKE, chosen=True)),
        ("zeros", each, lying, "all values are 0", filled(0.0)),
        *(
            (f"noise_{stream}", stream, degraded, f"{stream}: {noisy}", spread(NOISE_FACTOR * std))
            for stream, std in noise_std(robot).items()
        ),
        ("text", each, dead, "words in place of values", words),
        ("none", each, dead, "None in place of stamps and values", nothing),
        ("ragged", each, dead, "rows of different lengths", ragged),
        *(
            (f"width_{n}", n, dead, f"{n}: samples of another robot, with {width} columns", _of_width(width))
            for n, names in channels.items()
            for width in [OTHER_WIDTH[n] + 2 * (OTHER_WIDTH[n] == len(names))]
        ),
        *(
            (f"late_{1000 * by:g}ms", each, tolerable, late_by.format("", 1000 * by), late(by))
            for by in LATE_S
        ),
        ("jitter", each, tolerable, chance, late(0.0, JITTER_S)),
        ("disorder", each, tolerable, "of each two samples the later one arrives first", out_of_order),
        ("duplicates", each, tolerable, "each sample arrives twice", twice),
        ("behind", each, tolerable, f"stamps are {1000 * BEHIND_S:g} ms behind", stamped(-BEHIND_S)),
        ("stampless", each, dead, "all stamps are NaN", stamped(math.nan)),
        ("future_1s", each, tolerable, f"{some} is stamped 1 s ahead", stamped(1.0, chosen=True)),
        ("future_1h", each, tolerable, f"{some} is stamped 3600 s ahead", stamped(3600.0, chosen=True)),
    ]
    for name, step_s in clocks.items():
        about = f"the clocks of all streams and of the steps step by {step_s:g} s"
        rows.append((name, each, tolerable, f"its clock steps by {step_s:g} s", stamped(step_s)))
        rows.append((f"{name}_all", "all", degraded, about, written(lambda values, memory: None)))
    faults = {}
    for group, stream, nature, about, change in rows:
        kind = group if group in ("nan_some", "minus_inf") else group.partition("_")[0]
        clock_s = clocks[group.removesuffix("_all")] if group.startswith("clock") and stream == "all" else 0.0
        for one in tuple(channels) if stream == each else (stream,):
            name, stated = (f"{group}_{one}", f"{one}: {about}") if stream == each else (group, about)
            streams = tuple(channels) if stream == "all" else (one,)
            made = degraded if name in EITHER else nature
            faults[name] = SensorFault(name, kind, stated, streams, made, change, clock_s)
    return faults


def _rate_of(channel: str) -> tuple[str, str]:
    """Return what faults call the rate of a wheel, and what it is in words.

    Examples
    --------
    >>> _rate_of("motor_1_radps"), _rate_of("speed_left_mps")
    (('motor_1', 'rate of motor 1'), ('speed_left', 'speed of the wheels left'))
    """
    quantity, wheel = channel.rpartition("_")[0].split("_", 1)
    return (
        f"{quantity}_{wheel}",
        f"rate of motor {wheel}" if quantity == "motor" else f"speed of the wheels {wheel}",
    )


def _camera_faults(channels: Sequence[str]) -> list[tuple[str, bool, str, Change]]:
    """Return faults of a camera: name, whether it freezes or steps, what it is in words, and what it does."""
    speed = f"forward speed {SPEED_STEP_MPS:g} m/s"
    steps = (("camera_speed", "more", 1.0), ("camera_speed_down", "less", -1.0))
    if tuple(channels) != CAMERA_CHANNELS:
        ahead = channels[0]
        held = ("camera_speed", True, "the forward speed repeats", frozen(channels, ahead))
        by = ((n, word, scaled(channels, ahead, amount=sign * SPEED_STEP_MPS)) for n, word, sign in steps)
        return [held, *((n, False, f"{speed} {word}", change) for n, word, change in by)]
    turned = f"orientation turned to the left by {YAW_STEP_RAD:g} rad"
    return [
        ("camera_speed", True, "the forward speed repeats", written(_freeze_camera_speed)),
        ("camera_orientation", True, "the orientation repeats", frozen(channels, "quaternion")),
        *(
            (n, False, f"{speed} {word}", camera_speed_offset(sign * SPEED_STEP_MPS))
            for n, word, sign in steps
        ),
        ("camera_yaw", False, turned, written(_turn_camera)),
    ]


def select_faults(catalogue: Mapping[str, SensorFault], names: Sequence[str]) -> list[SensorFault]:
    """Return the faults that are named, or are of a named kind; all of them where no name is given.

    Raises
    ------
    ConfigError
        if a name is neither; the message lists the kinds.
    """
    kinds = list(dict.fromkeys(fault.kind for fault in catalogue.values()))
    for name in names:
        if name not in catalogue and name not in kinds:
            raise ConfigError(
                f"fault {name!r} is unknown: use a kind ({', '.join(kinds)}) or one fault of a kind, "
                f"as {next(iter(catalogue))}"
            )
    return [fault for fault in catalogue.values() if not names or fault.name in names or fault.kind in names]


def noise_std(robot: Robot) -> dict[str, Array]:
    """Return the described standard deviation of the noise of each channel, by stream (c,).

    A rotation by a small angle changes a quaternion's vector part by half of it; the confidence has none.
    """
    sensors, n, receiver = robot.sensors, len(robot.logged_wheels), Gnss()
    imu = [sensors.gyro_std_radps] * 3 + [sensors.accel_std_mps2] * 3 + [TILT_NOISE_RAD] * 2
    rate = 1.0 if robot.by_motor else robot.wheel_radius_m / robot.motors.reduction_ratio
    std = {
        "wheels": [sensors.motor_std_radps * rate] * n + [sensors.current_std_a] * n,
        "steering": [sensors.steering_std_rad] * len(robot.steered_wheels),
        "imu": [*imu, sensors.yaw_std_rad],
        "gnss": [receiver.fix_std_m] * 2 + [receiver.speed_std_mps] * 2 + [0.0] * 2,
    }
    channels = sensor_channels(robot)
    if "odometry" in channels:
        camera = robot.camera
        seen = [camera.position_std_m] * 3 + [camera.yaw_std_rad / 2] * 3 + [0.0]
        seen += [camera.speed_std_mps] * 3 + [camera.yaw_rate_std_radps] * 3 + [0.0]
        std["odometry"] = seen if robot.drive == "swerve" else [camera.speed_std_mps] * 2
    return {stream: np.array(std[stream]) for stream in channels}
