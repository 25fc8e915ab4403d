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

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_body, to_camera
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot
from terrain.simulation.sensors import TILT_NOISE_RAD

_CHANNELS: Mapping[str, tuple[str, ...]] = {
    "wheels": WHEELS_CHANNELS,
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
}

STREAMS: tuple[str, ...] = tuple(_CHANNELS)  # streams that faults act on; ``odometry`` is the camera's


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


@dataclass(frozen=True, slots=True)
class SensorFault:
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
        if sample.time_s < self._start_s:
            for name, memory in self._memory.items():
                if name in sample.readings:
                    memory.last = sample.readings[name].values[-1].copy()
        elif sample.time_s < self._end_s:
            sample = self._changed(sample)
        else:
            sample = self._released(sample)
        return self._controller(sample)

    def _changed(self, sample: Sample) -> Sample:
        readings, shift_s = {}, self._fault.clock_s
        for name in dict.fromkeys((*sample.readings, *self._fault.streams)):
            given = sample.readings.get(name, _NOTHING)
            if name in self._fault.streams:
                memory, time_s = (
                    self._memory[name],
                    given.time_s + shift_s if shift_s else given.time_s.copy(),
                )
                changed = self._fault.change(Reading(time_s, given.values.copy()), memory, sample.time_s)
                memory.n_samples += len(given.time_s)
                given = _NOTHING if changed is None else changed
            if given.time_s is None or len(given.time_s):
                readings[name] = given
        return sample._replace(readings=readings, time_s=sample.time_s + shift_s)

    def _released(self, sample: Sample) -> Sample:
        """Return a sample with all that was held back before it, which is held back no more."""
        readings = dict(sample.readings)
        for stream, memory in self._memory.items():
            if memory.pending:
                held = [reading for _, reading in memory.pending]
                readings[stream] = _joined([*held, *([readings[stream]] if stream in readings else [])])
                memory.pending.clear()
        return sample._replace(readings=readings)


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


def written(write: Callable[[Array, StreamMemory], object]) -> Change:
    """Let a function write to all values (k, c)."""

    def change(reading: Reading, memory: StreamMemory, now_s: float) -> Reading:
        if len(reading.time_s):
            write(reading.values, memory)
        return reading

    return change


def stamped(offset_s: float, chosen: bool = False) -> Change:
    """Add a time to all stamps, or to each tenth; a time that is not finite takes their place."""

    def change(reading: Reading, memory: StreamMemory, now_s: float) -> Reading:
        at = _chosen(len(reading.time_s), memory) if chosen else slice(None)
        reading.time_s[at] += offset_s
        return reading

    return change


def shaped(shape: Callable[[Reading], Reading]) -> Change:
    """Give something of another shape or type in place of a reading."""
    return lambda reading, memory, now_s: shape(reading) if len(reading.time_s) else None


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


def frozen(columns: Sequence[int] | slice = slice(None)) -> Change:
    """Repeat the last values before the fault; stamps go on."""

    def write(values: Array, memory: StreamMemory) -> None:
        values[:, columns] = _last_values(values, memory)[columns]

    return written(write)


def offset(columns: Sequence[int], amount: float) -> Change:
    """Add a number to channels."""

    def write(values: Array, memory: StreamMemory) -> None:
        values[:, columns] += amount

    return written(write)


def filled(value: float, chosen: bool = False) -> Change:
    """Replace all values by one, or those of each tenth sample."""

    def write(values: Array, memory: StreamMemory) -> None:
        values[_chosen(len(values), memory) if chosen else slice(None)] = value

    return written(write)


def noisy(std: Array) -> Change:
    """Add white noise with standard deviations (c,) to the channels."""

    def write(values: Array, memory: StreamMemory) -> None:
        values += std * memory.rng.standard_normal(values.shape)

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


def camera_turned(angle_rad: float) -> Change:
    """Turn the camera's orientation to the left about the vertical; its velocity stays."""
    w, up = math.cos(angle_rad / 2), math.sin(angle_rad / 2)

    def write(values: Array, memory: StreamMemory) -> None:
        x, y, z, scalar = values[:, _QUATERNION].T.copy()  # y is up
        values[:, _QUATERNION] = np.column_stack(
            [w * x + up * z, w * y + up * scalar, w * z - up * x, w * scalar - up * y]
        )

    return written(write)


def _text(reading: Reading) -> Reading:
    return reading._replace(values=np.full(reading.values.shape, "unknown"))


def _ragged(reading: Reading) -> Reading:
    rows = [[0.0] * (1 + k) for k in range(len(reading.time_s) + 1)]
    return reading._replace(values=rows)  # type: ignore[arg-type]


def _of_width(n_columns: int) -> Change:
    """Give the samples of another robot, with that number of columns; those that are added are 0."""

    def shape(reading: Reading) -> Reading:
        values = np.zeros((len(reading.time_s), n_columns))
        kept = min(n_columns, reading.values.shape[1])
        values[:, :kept] = reading.values[:, :kept]
        return reading._replace(values=values)

    return shaped(shape)


SPEED_STEP_MPS, MOTOR_FACTOR, PITCH_STEP_RAD, YAW_STEP_RAD = 0.3, 1.2, 0.2, 0.3
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

# Number of columns of another robot's streams: one with four wheels, and sensors that report less.
OTHER_WIDTH: Mapping[str, int] = {"wheels": 4, "steering": 4, "imu": 6, "odometry": 3}


def fault_catalogue(robot: Robot) -> dict[str, SensorFault]:
    """Return all faults by name, in the order of the table.

    Parameters
    ----------
    robot : a swerve robot with camera and sensors, whose noise is multiplied; names do not depend on it

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> faults = fault_catalogue(load_robot("agrimaro"))
    >>> faults["step_camera_speed"].streams, faults["step_camera_speed"].nature.value
    (('odometry',), 'lying')
    """
    dead, lying, tolerable, degraded = Nature
    faults: dict[str, SensorFault] = {}

    def add(
        name: str,
        about: str,
        stream: str,
        nature: Nature,
        change: Change,
        kind: str = "",
        clock_s: float = 0.0,
    ) -> None:
        streams = STREAMS if stream == "all" else (stream,)
        nature = degraded if name in EITHER else nature
        kind = kind or name.partition("_")[0]
        faults[name] = SensorFault(name, kind, about, streams, nature, change, clock_s)

    def each(kind: str, about: str, nature: Nature, change: Change, group: str = "") -> None:
        for stream in STREAMS:
            add(f"{kind}_{stream}", f"{stream}: {about}", stream, nature, change, group or kind)

    each("loss", "no sample arrives", dead, lost)
    add("loss_all", "no sample of any stream arrives", "all", dead, lost)
    each("freeze", "all values repeat, stamps go on", dead, frozen())
    add("freeze_all", "all values of all streams repeat", "all", dead, frozen())
    held = written(_freeze_camera_speed)
    add("freeze_camera_speed", "the forward speed repeats", "odometry", dead, held)
    turning = frozen(_columns("odometry", "quaternion"))
    add("freeze_camera_orientation", "the orientation repeats", "odometry", dead, turning)
    for i in (1, 2, 3):
        rate = frozen(_columns("wheels", f"motor_{i}"))
        add(f"freeze_motor_{i}", f"the rate of motor {i} repeats", "wheels", dead, rate)
    for name in ("gyro", "accel", "pitch"):
        add(f"freeze_{name}", f"{name} repeats", "imu", dead, frozen(_columns("imu", name)))
    angle = frozen(_columns("steering", "angle_1"))
    add("freeze_steering_1", "steering angle 1 repeats", "steering", dead, angle)

    for name, sign, word in (("", 1.0, "more"), ("_down", -1.0, "less")):
        about = f"forward speed {SPEED_STEP_MPS:g} m/s {word}"
        change = camera_speed_offset(sign * SPEED_STEP_MPS)
        add(f"step_camera_speed{name}", about, "odometry", lying, change)
    about = f"orientation turned to the left by {YAW_STEP_RAD:g} rad"
    add("step_camera_yaw", about, "odometry", lying, camera_turned(YAW_STEP_RAD))

    def faster(values: Array, memory: StreamMemory) -> None:
        values[:, _columns("wheels", "motor_1")] *= MOTOR_FACTOR

    add("step_motor_1", f"rate of motor 1 times {MOTOR_FACTOR:g}", "wheels", lying, written(faster))
    for stream, start, name, amount, unit in (
        ("imu", "pitch", "pitch", PITCH_STEP_RAD, "rad"),
        ("imu", "yaw", "yaw", YAW_STEP_RAD, "rad"),
        ("imu", "gyro_z", "gyro", GYRO_STEP_RADPS, "rad/s"),
        ("imu", "accel_x", "accel", ACCEL_STEP_MPS2, "m/s^2"),
        ("steering", "angle_1", "steering_1", STEERING_STEP_RAD, "rad"),
    ):
        change = offset(_columns(stream, start), amount)
        add(f"step_{name}", f"{name} {amount:g} {unit} more", stream, lying, change)

    tenth = f"of each {EVERY} samples one has values of"
    each("nan", "all values are NaN", dead, filled(math.nan))
    each("nan_some", f"{tenth} NaN", tolerable, filled(math.nan, chosen=True))
    each("inf", "all values are infinite", dead, filled(math.inf))
    each("minus_inf", "all values are -inf", dead, filled(-math.inf))
    each("spikes", f"{tenth} {SPIKE:g}", tolerable, filled(SPIKE, chosen=True))
    each("zeros", "all values are 0", lying, filled(0.0))
    for stream, std in noise_std(robot).items():
        about = f"{stream}: noise {NOISE_FACTOR:g} times the described one is added"
        add(f"noise_{stream}", about, stream, degraded, noisy(NOISE_FACTOR * std))

    each("text", "words in place of values", dead, shaped(_text))
    nothing = shaped(lambda reading: Reading(None, None))  # type: ignore[arg-type]
    each("none", "None in place of stamps and values", dead, nothing)
    each("ragged", "rows of different lengths", dead, shaped(_ragged))
    for stream, width in OTHER_WIDTH.items():
        about = f"{stream}: samples of another robot, with {width} columns"
        add(f"width_{stream}", about, stream, dead, _of_width(width))

    for delay_s in LATE_S:
        ms = f"{1000 * delay_s:g}"
        each(f"late_{ms}ms", f"samples arrive {ms} ms after their stamps", tolerable, late(delay_s), "late")
    about = f"samples arrive up to {1000 * JITTER_S:g} ms after their stamps, by chance"
    each("jitter", about, tolerable, late(0.0, JITTER_S))
    each("disorder", "of each two samples the later one arrives first", tolerable, out_of_order)
    twice = shaped(lambda reading: Reading(*(np.repeat(part, 2, axis=0) for part in reading)))
    each("duplicates", "each sample arrives twice", tolerable, twice)
    each("behind", f"stamps are {1000 * BEHIND_S:g} ms behind", tolerable, stamped(-BEHIND_S))
    each("stampless", "all stamps are NaN", dead, stamped(math.nan))
    for text, ahead_s in (("1s", 1.0), ("1h", 3600.0)):
        about = f"of each {EVERY} samples one is stamped {ahead_s:g} s ahead"
        each(f"future_{text}", about, tolerable, stamped(ahead_s, chosen=True), "future")
    for text, step_s in (("forward", 3600.0), ("back", -3600.0)):
        each(f"clock_{text}", f"its clock steps by {step_s:g} s", tolerable, stamped(step_s), "clock")
        about = f"the clocks of all streams and of the steps step by {step_s:g} s"
        add(f"clock_{text}_all", about, "all", degraded, written(lambda values, memory: None), clock_s=step_s)
    return faults


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


def _columns(stream: str, *starts: str) -> list[int]:
    return [i for i, channel in enumerate(_CHANNELS[stream]) if channel.startswith(starts)]


def noise_std(robot: Robot) -> dict[str, Array]:
    """Return the described standard deviation of the noise of each channel, by stream (c,).

    A rotation by a small angle changes a quaternion's vector part by half of it; the confidence has none.
    """
    _, _, _, camera, sensors = robot.equipment
    imu = [sensors.gyro_std_radps] * 3 + [sensors.accel_std_mps2] * 3 + [TILT_NOISE_RAD] * 2
    seen = [camera.position_std_m] * 3 + [camera.yaw_std_rad / 2] * 3 + [0.0]
    seen += [camera.speed_std_mps] * 3 + [camera.yaw_rate_std_radps] * 3 + [0.0]
    std = {
        "wheels": [sensors.motor_std_radps] * 3 + [sensors.current_std_a] * 3,
        "steering": [sensors.steering_std_rad] * 3,
        "imu": [*imu, sensors.yaw_std_rad],
        "odometry": seen,
    }
    return {stream: np.array(values) for stream, values in std.items()}
