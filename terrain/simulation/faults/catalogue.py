"""The catalogue of sensor faults: one entry a fault, with the streams it touches and what it makes of them.

Magnitudes are those at which a fault matters for slip control at 1 m/s: an error of 0.3 m/s in the speed over
ground is 30 % of slip, one of 20 % in a motor's rate 17 %; the others are several times what a sensor that
works shows (``sensors`` of a robot's description), and none is so large that a limit of range would find it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.faults import changes as change
from terrain.simulation.faults.changes import Change, on
from terrain.simulation.faults.fault import STREAMS, Action, Nature, SensorFault
from terrain.simulation.sensors import TILT_NOISE_RAD

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
    yield from _of_each("loss", "{}: no sample arrives", Nature.DEAD, change.lost)
    yield SensorFault(
        "loss_all", "loss", "no sample of any stream arrives", STREAMS, Nature.DEAD, on(STREAMS, change.lost)
    )


def _freezes() -> Iterable[SensorFault]:
    frozen, dead = change.frozen, Nature.DEAD
    yield from _of_each("freeze", "{}: all values repeat, stamps go on", dead, frozen())
    yield SensorFault(
        "freeze_all", "freeze", "all values of all streams repeat", STREAMS, dead, on(STREAMS, frozen())
    )
    yield _one(
        "freeze_camera_speed", "the forward speed repeats", "odometry", dead, change.camera_speed_frozen
    )
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
        made = change.camera_speed_offset(sign * speed)
        yield _one(f"step_camera_speed{name}", about, "odometry", lying, made)
    about = f"orientation turned to the left by {YAW_STEP_RAD:g} rad"
    yield _one("step_camera_yaw", about, "odometry", lying, change.camera_turned(YAW_STEP_RAD))
    made = change.scaled(_columns("wheels", "motor_1"), MOTOR_FACTOR)
    yield _one("step_motor_1", f"rate of motor 1 times {MOTOR_FACTOR:g}", "wheels", lying, made)
    for stream, start, name, amount, unit in (
        ("imu", "pitch", "pitch", PITCH_STEP_RAD, "rad"),
        ("imu", "yaw", "yaw", YAW_STEP_RAD, "rad"),
        ("imu", "gyro_z", "gyro", GYRO_STEP_RADPS, "rad/s"),
        ("imu", "accel_x", "accel", ACCEL_STEP_MPS2, "m/s^2"),
        ("steering", "angle_1", "steering_1", STEERING_STEP_RAD, "rad"),
    ):
        made = change.offset(_columns(stream, start), amount)
        yield _one(f"step_{name}", f"{name} {amount:g} {unit} more", stream, lying, made)


def _bad_values() -> Iterable[SensorFault]:
    yield from _of_each("nan", "{}: all values are NaN", Nature.DEAD, change.filled(math.nan))
    tenth = f"{{}}: of each {change.EVERY} samples one has "
    yield from _of_each(
        "nan_some", tenth + "values of NaN", Nature.TOLERABLE, change.filled_at_times(math.nan)
    )
    yield from _of_each("inf", "{}: all values are infinite", Nature.DEAD, change.filled(math.inf))
    yield from _of_each("minus_inf", "{}: all values are -inf", Nature.DEAD, change.filled(-math.inf))
    yield from _of_each(
        "spikes", f"{tenth}values of {SPIKE:g}", Nature.TOLERABLE, change.filled_at_times(SPIKE)
    )
    yield from _of_each("zeros", "{}: all values are 0", Nature.LYING, change.filled(0.0))


def _noises(robot: Robot) -> Iterable[SensorFault]:
    for stream, std in noise_std(robot).items():
        yield SensorFault(
            f"noise_{stream}",
            "noise",
            f"{stream}: noise {NOISE_FACTOR:g} times the described one is added",
            (stream,),
            Nature.DEGRADED,
            on((stream,), change.noisy(NOISE_FACTOR * std)),
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
    yield from _of_each("text", "{}: words in place of values", Nature.DEAD, change.as_text)
    yield from _of_each("none", "{}: None in place of stamps and values", Nature.DEAD, change.as_nothing)
    yield from _of_each("ragged", "{}: rows of different lengths", Nature.DEAD, change.as_ragged)
    for stream in STREAMS:
        made = change.of_other_width(OTHER_WIDTH[stream])
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
            yield _arriving(f"late_{text}_{stream}", about, stream, change.late(stream, delay_s))
    for stream in STREAMS:
        about = f"samples arrive up to {1000 * JITTER_S:g} ms after their stamps, by chance"
        yield _arriving(f"jitter_{stream}", about, stream, change.late(stream, 0.0, JITTER_S))
    for stream in STREAMS:
        about = "of each two samples the later one arrives first"
        yield _arriving(f"disorder_{stream}", about, stream, change.out_of_order(stream))
    yield from _of_each("duplicates", "{}: each sample arrives twice", Nature.TOLERABLE, change.duplicated)
    about = f"{{}}: stamps are {1000 * BEHIND_S:g} ms behind"
    yield from _of_each("behind", about, Nature.TOLERABLE, change.shifted_stamps(-BEHIND_S))


def _bad_stamps() -> Iterable[SensorFault]:
    yield from _of_each("stampless", "{}: all stamps are NaN", Nature.DEAD, change.shifted_stamps(math.nan))
    for text, ahead_s in FUTURE_S.items():
        for stream in STREAMS:
            about = f"{stream}: of each {change.EVERY} samples one is stamped {ahead_s:g} s ahead"
            made = change.shifted_at_times(ahead_s)
            yield _one(f"future_{text}_{stream}", about, stream, Nature.TOLERABLE, made)


def _clock_steps() -> Iterable[SensorFault]:
    for text, step_s in CLOCK_STEPS_S.items():
        for stream in STREAMS:
            about, made = f"{stream}: its clock steps by {step_s:g} s", change.shifted_stamps(step_s)
            yield _one(f"clock_{text}_{stream}", about, stream, Nature.TOLERABLE, made)
        yield SensorFault(
            f"clock_{text}_all",
            "clock",
            f"the clocks of all streams and of the steps step by {step_s:g} s",
            STREAMS,
            Nature.DEGRADED,
            change.shifted_clock(step_s),
        )
