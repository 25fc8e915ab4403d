"""Faults of sensors in a closed loop: a catalogue, one entry a fault, and the bus that applies one.

A fault acts on readings, on their stamps, and on when they arrive.  It is a function of a sample and of what
has to be remembered from sample to sample, :class:`Memory`; the motion and the sensors' own arrays are not
touched, so that a drive with a fault differs from one without by what the controller makes of it alone.  A
:data:`Change` is given arrays of its own, which it may write to, and returns what arrives of them.

Magnitudes are those at which a fault matters for slip control at 1 m/s: an error of 0.3 m/s in the speed over
ground is 30 % of slip, one of 20 % in a motor's rate 17 %; the others are several times what a sensor that
works shows (``sensors`` of a robot's description), and none is so large that a limit of range would find it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_body, to_camera
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot
from terrain.simulation.sensors import TILT_NOISE_RAD

STREAMS: tuple[str, ...] = ("wheels", "steering", "imu", "odometry")
"""Streams that faults act on; ``odometry`` is the camera's."""


class Nature(Enum):
    """What a fault makes of the streams that it touches, which decides what a controller has to do.

    ``DEAD`` and ``LYING`` streams carry no information or a wrong one: no correction may be based on them.
    With a ``TOLERABLE`` fault the streams still carry the motion, and the controller has to go on.  With a
    ``DEGRADED`` one it may do either.
    """

    DEAD = "dead"
    LYING = "lying"
    TOLERABLE = "tolerable"
    DEGRADED = "degraded"


@dataclass(slots=True)
class StreamMemory:
    """What is remembered of one stream.

    Parameters
    ----------
    rng : of all that is drawn for the stream
    last : (c,) its last values before the fault began; None before the first sample
    n_samples : number of its samples that the fault has acted on
    pending : times at which samples that are held back are due, and the samples, in order
    """

    rng: np.random.Generator
    last: Array | None = None
    n_samples: int = 0
    pending: list[tuple[float, Reading]] = field(default_factory=list)


Memory = dict[str, StreamMemory]
"""What is remembered, by stream."""

Action = Callable[[Sample, Memory], Sample]
"""From what the sensors gave at a step to what arrives."""


@dataclass(frozen=True, slots=True)
class SensorFault:
    """An entry of the catalogue.

    Parameters
    ----------
    name, kind : of the fault, and of the group that it is in
    about : what it does, in one sentence
    streams : that it touches
    nature : what it makes of them
    action : what it does to a sample
    """

    name: str
    kind: str
    about: str
    streams: tuple[str, ...]
    nature: Nature
    action: Action


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
    >>> lost = SensorFault("lost", "loss", "", ("imu",), Nature.DEAD, lambda s, _: s._replace(readings={}))
    >>> arrived = []
    >>> bus = FaultyBus(lambda sample: arrived.append(sorted(sample.readings)), lost, 1.0, 2.0, seed=0)
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
        drawn = np.random.SeedSequence([seed, zlib.crc32(fault.name.encode())]).spawn(len(STREAMS))
        self._memory = {
            stream: StreamMemory(np.random.default_rng(each))
            for stream, each in zip(STREAMS, drawn, strict=True)
        }

    def __call__(self, sample: Sample) -> Command:
        """Return the controller's command for what arrives of a sample."""
        if sample.time_s < self._start_s:
            for name, memory in self._memory.items():
                if name in sample.readings:
                    memory.last = sample.readings[name].values[-1].copy()
        elif sample.time_s < self._end_s:
            sample = self._fault.action(sample, self._memory)
        else:
            sample = released(sample, self._memory)
        return self._controller(sample)


def released(sample: Sample, memory: Memory) -> Sample:
    """Return a sample with all that was held back before it, which is held back no more."""
    readings = dict(sample.readings)
    for stream, remembered in memory.items():
        if remembered.pending:
            held = [reading for _, reading in remembered.pending]
            readings[stream] = joined([*held, *([readings[stream]] if stream in readings else [])])
            remembered.pending.clear()
    return sample._replace(readings=readings)


def joined(readings: list[Reading]) -> Reading:
    """Return readings, one at least, as one, in their order."""
    return Reading(
        np.concatenate([reading.time_s for reading in readings]),
        np.concatenate([reading.values for reading in readings]),
    )


EVERY = 10
"""Of the faults of single samples, one in so many samples has one."""

_SLACK_S = 1e-9  # stamps and steps that differ by less are the same instant
_QUATERNION = slice(
    CAMERA_CHANNELS.index("quaternion_x_ratio"), CAMERA_CHANNELS.index("quaternion_w_ratio") + 1
)
_VELOCITY = slice(CAMERA_CHANNELS.index("velocity_x_mps"), CAMERA_CHANNELS.index("velocity_z_mps") + 1)

Change = Callable[[Reading, StreamMemory], Reading | None]
"""From what a stream gave at a step to what arrives of it; None for nothing."""


def on(streams: Sequence[str], change: Change) -> Action:
    """Return the action that changes the readings of streams, and nothing else."""

    def act(sample: Sample, memory: Memory) -> Sample:
        readings = {}
        for name, reading in sample.readings.items():
            given: Reading | None = reading
            if name in streams:
                given = change(Reading(reading.time_s.copy(), reading.values.copy()), memory[name])
                memory[name].n_samples += len(reading.time_s)
            if given is not None:
                readings[name] = given
        return sample._replace(readings=readings)

    return act


def lost(reading: Reading, memory: StreamMemory) -> None:
    """Let nothing arrive."""


def frozen(columns: Sequence[int] | slice = slice(None)) -> Change:
    """Repeat the last values before the fault; stamps go on."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        last = _last_values(reading, memory)
        reading.values[:, columns] = last[columns]
        return reading

    return change


def written(write: Callable[[Array], object]) -> Change:
    """Let a function write to all values (k, c)."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        write(reading.values)
        return reading

    return change


def offset(columns: Sequence[int], amount: float) -> Change:
    """Add a number to channels."""

    def write(values: Array) -> None:
        values[:, columns] += amount

    return written(write)


def scaled(columns: Sequence[int], factor: float) -> Change:
    """Multiply channels by a number."""

    def write(values: Array) -> None:
        values[:, columns] *= factor

    return written(write)


def filled(value: float) -> Change:
    """Replace all values by one."""
    return written(lambda values: values.fill(value))


def filled_at_times(value: float) -> Change:
    """Replace all values of each tenth sample by one."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[_chosen(reading, memory)] = value
        return reading

    return change


def noisy(std: Array) -> Change:
    """Add white noise with standard deviations (c,) to the channels."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:] += std * memory.rng.standard_normal(reading.values.shape)
        return reading

    return change


def shifted_stamps(offset_s: float) -> Change:
    """Add a time to all stamps; a time that is not finite takes their place."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        return reading._replace(time_s=reading.time_s + offset_s)

    return change


def shifted_at_times(offset_s: float) -> Change:
    """Add a time to the stamp of each tenth sample."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.time_s[_chosen(reading, memory)] += offset_s
        return reading

    return change


def duplicated(reading: Reading, memory: StreamMemory) -> Reading:
    """Let each sample arrive twice."""
    return Reading(np.repeat(reading.time_s, 2), np.repeat(reading.values, 2, axis=0))


def as_text(reading: Reading, memory: StreamMemory) -> Reading:
    """Give words in place of the values."""
    return reading._replace(values=np.full(reading.values.shape, "unknown"))


def as_nothing(reading: Reading, memory: StreamMemory) -> Reading:
    """Give None in place of stamps and values."""
    return Reading(None, None)  # type: ignore[arg-type]


def as_ragged(reading: Reading, memory: StreamMemory) -> Reading:
    """Give a list whose rows have different lengths."""
    rows = [[0.0] * (1 + k) for k in range(len(reading.time_s) + 1)]
    return reading._replace(values=rows)  # type: ignore[arg-type]


def of_other_width(n_columns: int) -> Change:
    """Give the samples of another robot, with that number of columns; those that are added are 0."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        values = np.zeros((len(reading.time_s), n_columns))
        kept = min(n_columns, reading.values.shape[1])
        values[:, :kept] = reading.values[:, :kept]
        return reading._replace(values=values)

    return change


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

    def write(values: Array) -> None:
        values[:, _VELOCITY] += amount_mps * camera_forward(values)

    return written(write)


def camera_speed_frozen(reading: Reading, memory: StreamMemory) -> Reading:
    """Repeat the camera's last forward speed before the fault; all else goes on."""
    last = _last_values(reading, memory)[None, :]
    held_mps = float((last[:, _VELOCITY] * camera_forward(last)).sum())
    forward = camera_forward(reading.values)
    speed_mps = (reading.values[:, _VELOCITY] * forward).sum(axis=1)
    reading.values[:, _VELOCITY] += (held_mps - speed_mps)[:, None] * forward
    return reading


def camera_turned(angle_rad: float) -> Change:
    """Turn the camera's orientation to the left about the vertical; its velocity stays."""
    w, up = math.cos(angle_rad / 2), math.sin(angle_rad / 2)

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        x, y, z, scalar = reading.values[:, _QUATERNION].T.copy()  # y is up
        reading.values[:, _QUATERNION] = np.column_stack(
            [w * x + up * z, w * y + up * scalar, w * z - up * x, w * scalar - up * y]
        )
        return reading

    return change


def late(stream: str, delay_s: float, jitter_s: float = 0.0) -> Action:
    """Deliver each sample a time after its stamp, and up to ``jitter_s`` later by chance; in their order."""

    def act(sample: Sample, memory: Memory) -> Sample:
        remembered = memory[stream]
        readings = dict(sample.readings)
        for row in _rows(readings.pop(stream, None)):
            due_s = float(row.time_s[0]) + delay_s
            due_s += float(remembered.rng.uniform(0.0, jitter_s)) if jitter_s else 0.0
            before_s = remembered.pending[-1][0] if remembered.pending else -math.inf
            remembered.pending.append((max(due_s, before_s), row))
        n_due = sum(due_s <= sample.time_s + _SLACK_S for due_s, _ in remembered.pending)
        if n_due:
            readings[stream] = joined([row for _, row in remembered.pending[:n_due]])
            del remembered.pending[:n_due]
        return sample._replace(readings=readings)

    return act


def out_of_order(stream: str) -> Action:
    """Deliver of each two samples the later one first."""

    def act(sample: Sample, memory: Memory) -> Sample:
        pending = memory[stream].pending
        readings, arrived = dict(sample.readings), []
        for row in _rows(readings.pop(stream, None)):
            if pending:
                arrived += [row, pending.pop()[1]]
            else:
                pending.append((float(row.time_s[0]), row))
        if arrived:
            readings[stream] = joined(arrived)
        return sample._replace(readings=readings)

    return act


def shifted_clock(offset_s: float) -> Action:
    """Shift the clock of the whole robot: all stamps, and that of the step."""

    def act(sample: Sample, memory: Memory) -> Sample:
        readings = {
            name: reading._replace(time_s=reading.time_s + offset_s)
            for name, reading in sample.readings.items()
        }
        return sample._replace(time_s=sample.time_s + offset_s, readings=readings)

    return act


def _last_values(reading: Reading, memory: StreamMemory) -> Array:
    """Return the last values (c,) before the fault; without any, the first during it."""
    if memory.last is None:
        memory.last = reading.values[0].copy()
    return memory.last


def _chosen(reading: Reading, memory: StreamMemory) -> Array:
    """Return which samples (k,) are each tenth of those that the fault has acted on."""
    place = memory.n_samples + np.arange(len(reading.time_s))
    return np.asarray(place % EVERY == EVERY - 1)


def _rows(reading: Reading | None) -> list[Reading]:
    """Return the samples of a reading one by one."""
    if reading is None:
        return []
    return [
        Reading(reading.time_s[i:j].copy(), reading.values[i:j].copy())
        for i, j in pairwise(range(len(reading.time_s) + 1))
    ]


SPEED_STEP_MPS, MOTOR_FACTOR, PITCH_STEP_RAD, YAW_STEP_RAD = 0.3, 1.2, 0.2, 0.3
GYRO_STEP_RADPS, ACCEL_STEP_MPS2, STEERING_STEP_RAD = 0.1, 2.0, 0.1
NOISE_FACTOR = 10.0
SPIKE = 1e6
LATE_S: tuple[float, ...] = (0.03, 0.1, 0.15)
BEHIND_S = 0.03
JITTER_S = 0.06
EITHER = (
    "freeze_steering",
    "freeze_steering_1",
    "zeros_steering",
    "step_yaw",
    "late_100ms_wheels",
    "late_150ms_wheels",
)
"""Faults of which a controller may be right to go on, or to stop correcting: steering that repeats itself or
reads zero tells the truth on a straight drive; a heading of the IMU that was set is no slip; wheels that come
so late are too slow for a control of slip."""

FUTURE_S: Mapping[str, float] = {"1s": 1.0, "1h": 3600.0}
CLOCK_STEPS_S: Mapping[str, float] = {"forward": 3600.0, "back": -3600.0}

OTHER_WIDTH: Mapping[str, int] = {"wheels": 4, "steering": 4, "imu": 6, "odometry": 3}
"""Number of columns of another robot's streams: one with four wheels, and sensors that report less."""

_CHANNELS: Mapping[str, tuple[str, ...]] = {
    "wheels": WHEELS_CHANNELS,
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
}


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
    parts = (
        *(_losses(), _freezes(), _steps(), _bad_values(), _noises(robot), _bad_shapes()),
        *(_late(), _bad_stamps(), _clock_steps()),
    )
    return {
        fault.name: replace(fault, nature=Nature.DEGRADED) if fault.name in EITHER else fault
        for part in parts
        for fault in part
    }


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


def _of_each(kind: str, about: str, nature: Nature, made: Change) -> Iterable[SensorFault]:
    """Return a fault for each stream; ``{}`` in the text is the stream."""
    for stream in STREAMS:
        yield SensorFault(
            f"{kind}_{stream}", kind, about.format(stream), (stream,), nature, on((stream,), made)
        )


def _one(name: str, about: str, stream: str, nature: Nature, made: Change) -> SensorFault:
    return SensorFault(name, name.partition("_")[0], about, (stream,), nature, on((stream,), made))


def _columns(stream: str, *starts: str) -> list[int]:
    return [i for i, channel in enumerate(_CHANNELS[stream]) if channel.startswith(starts)]


def _losses() -> Iterable[SensorFault]:
    yield from _of_each("loss", "{}: no sample arrives", Nature.DEAD, lost)
    yield SensorFault(
        "loss_all", "loss", "no sample of any stream arrives", STREAMS, Nature.DEAD, on(STREAMS, lost)
    )


def _freezes() -> Iterable[SensorFault]:
    dead = Nature.DEAD
    yield from _of_each("freeze", "{}: all values repeat, stamps go on", dead, frozen())
    yield SensorFault(
        "freeze_all", "freeze", "all values of all streams repeat", STREAMS, dead, on(STREAMS, frozen())
    )
    yield _one("freeze_camera_speed", "the forward speed repeats", "odometry", dead, camera_speed_frozen)
    yield _one(
        "freeze_camera_orientation",
        "the orientation repeats",
        "odometry",
        dead,
        frozen(_columns("odometry", "quaternion")),
    )
    for i in (1, 2, 3):
        columns = _columns("wheels", f"motor_{i}")
        yield _one(f"freeze_motor_{i}", f"the rate of motor {i} repeats", "wheels", dead, frozen(columns))
    for name in ("gyro", "accel", "pitch"):
        yield _one(f"freeze_{name}", f"{name} repeats", "imu", dead, frozen(_columns("imu", name)))
    columns = _columns("steering", "angle_1")
    yield _one("freeze_steering_1", "steering angle 1 repeats", "steering", dead, frozen(columns))


def _steps() -> Iterable[SensorFault]:
    lying, speed = Nature.LYING, SPEED_STEP_MPS
    for name, sign, word in (("", 1.0, "more"), ("_down", -1.0, "less")):
        about = f"forward speed {speed:g} m/s {word}"
        made = camera_speed_offset(sign * speed)
        yield _one(f"step_camera_speed{name}", about, "odometry", lying, made)
    about = f"orientation turned to the left by {YAW_STEP_RAD:g} rad"
    yield _one("step_camera_yaw", about, "odometry", lying, camera_turned(YAW_STEP_RAD))
    made = scaled(_columns("wheels", "motor_1"), MOTOR_FACTOR)
    yield _one("step_motor_1", f"rate of motor 1 times {MOTOR_FACTOR:g}", "wheels", lying, made)
    for stream, start, name, amount, unit in (
        ("imu", "pitch", "pitch", PITCH_STEP_RAD, "rad"),
        ("imu", "yaw", "yaw", YAW_STEP_RAD, "rad"),
        ("imu", "gyro_z", "gyro", GYRO_STEP_RADPS, "rad/s"),
        ("imu", "accel_x", "accel", ACCEL_STEP_MPS2, "m/s^2"),
        ("steering", "angle_1", "steering_1", STEERING_STEP_RAD, "rad"),
    ):
        made = offset(_columns(stream, start), amount)
        yield _one(f"step_{name}", f"{name} {amount:g} {unit} more", stream, lying, made)


def _bad_values() -> Iterable[SensorFault]:
    yield from _of_each("nan", "{}: all values are NaN", Nature.DEAD, filled(math.nan))
    tenth = f"{{}}: of each {EVERY} samples one has "
    yield from _of_each("nan_some", tenth + "values of NaN", Nature.TOLERABLE, filled_at_times(math.nan))
    yield from _of_each("inf", "{}: all values are infinite", Nature.DEAD, filled(math.inf))
    yield from _of_each("minus_inf", "{}: all values are -inf", Nature.DEAD, filled(-math.inf))
    yield from _of_each("spikes", f"{tenth}values of {SPIKE:g}", Nature.TOLERABLE, filled_at_times(SPIKE))
    yield from _of_each("zeros", "{}: all values are 0", Nature.LYING, filled(0.0))


def _noises(robot: Robot) -> Iterable[SensorFault]:
    for stream, std in noise_std(robot).items():
        yield SensorFault(
            f"noise_{stream}",
            "noise",
            f"{stream}: noise {NOISE_FACTOR:g} times the described one is added",
            (stream,),
            Nature.DEGRADED,
            on((stream,), noisy(NOISE_FACTOR * std)),
        )


def noise_std(robot: Robot) -> dict[str, Array]:
    """Return the described standard deviation of the noise of each channel, by stream (c,).

    A rotation by a small angle changes a quaternion's vector part by half of it; the confidence has none.
    """
    _, _, _, camera, sensors = robot.equipment
    wheels, imu, seen = (
        [sensors.motor_std_radps] * 3 + [sensors.current_std_a] * 3,
        [sensors.gyro_std_radps] * 3 + [sensors.accel_std_mps2] * 3 + [TILT_NOISE_RAD] * 2,
        [camera.position_std_m] * 3 + [camera.yaw_std_rad / 2] * 3 + [0.0],
    )
    imu += [sensors.yaw_std_rad]
    seen += [camera.speed_std_mps] * 3 + [camera.yaw_rate_std_radps] * 3 + [0.0]
    steering = [sensors.steering_std_rad] * 3
    given = {"wheels": wheels, "steering": steering, "imu": imu, "odometry": seen}
    return {stream: np.array(given[stream]) for stream in STREAMS}


def _bad_shapes() -> Iterable[SensorFault]:
    yield from _of_each("text", "{}: words in place of values", Nature.DEAD, as_text)
    yield from _of_each("none", "{}: None in place of stamps and values", Nature.DEAD, as_nothing)
    yield from _of_each("ragged", "{}: rows of different lengths", Nature.DEAD, as_ragged)
    for stream in STREAMS:
        made = of_other_width(OTHER_WIDTH[stream])
        about = f"{stream}: samples of another robot, with {OTHER_WIDTH[stream]} columns"
        yield _one(f"width_{stream}", about, stream, Nature.DEAD, made)


def _arriving(name: str, about: str, stream: str, action: Action) -> SensorFault:
    kind = name.partition("_")[0]
    return SensorFault(name, kind, f"{stream}: {about}", (stream,), Nature.TOLERABLE, action)


def _late() -> Iterable[SensorFault]:
    for delay_s in LATE_S:
        text = f"{1000 * delay_s:g}ms"
        for stream in STREAMS:
            about = f"samples arrive {1000 * delay_s:g} ms after their stamps"
            yield _arriving(f"late_{text}_{stream}", about, stream, late(stream, delay_s))
    for stream in STREAMS:
        about = f"samples arrive up to {1000 * JITTER_S:g} ms after their stamps, by chance"
        yield _arriving(f"jitter_{stream}", about, stream, late(stream, 0.0, JITTER_S))
    for stream in STREAMS:
        about = "of each two samples the later one arrives first"
        yield _arriving(f"disorder_{stream}", about, stream, out_of_order(stream))
    yield from _of_each("duplicates", "{}: each sample arrives twice", Nature.TOLERABLE, duplicated)
    about = f"{{}}: stamps are {1000 * BEHIND_S:g} ms behind"
    yield from _of_each("behind", about, Nature.TOLERABLE, shifted_stamps(-BEHIND_S))


def _bad_stamps() -> Iterable[SensorFault]:
    yield from _of_each("stampless", "{}: all stamps are NaN", Nature.DEAD, shifted_stamps(math.nan))
    for text, ahead_s in FUTURE_S.items():
        for stream in STREAMS:
            about = f"{stream}: of each {EVERY} samples one is stamped {ahead_s:g} s ahead"
            made = shifted_at_times(ahead_s)
            yield _one(f"future_{text}_{stream}", about, stream, Nature.TOLERABLE, made)


def _clock_steps() -> Iterable[SensorFault]:
    for text, step_s in CLOCK_STEPS_S.items():
        for stream in STREAMS:
            about, made = f"{stream}: its clock steps by {step_s:g} s", shifted_stamps(step_s)
            yield _one(f"clock_{text}_{stream}", about, stream, Nature.TOLERABLE, made)
        yield SensorFault(
            f"clock_{text}_all",
            "clock",
            f"the clocks of all streams and of the steps step by {step_s:g} s",
            STREAMS,
            Nature.DEGRADED,
            shifted_clock(step_s),
        )
