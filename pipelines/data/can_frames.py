"""Frames of a CAN bus to samples and back, and its logs as runs, by the DBC that a user has, with cantools.

A DBC with the names of :data:`SIGNALS` is read, whatever its frames.  A frame is eight bytes, so that the
channels of a stream come in several.

What a controller needs beside it is here: which signal is which channel, in which unit; values that were not
measured; bounds; CRC and counter.  The lowest raw value of a signed signal, and the highest of an unsigned
one, stands for a value that was not measured; of a signal of floating point NaN does.  A value beyond what a
signal can hold is sent as the end of its range, never wrapped.  CRC-8 of SAE J1850 is over the identifier, 2
bytes or 4 of an extended one, high byte first, and the data with the CRC's own bits as 0.

Logs are ASC and BLF of Vector's tools, candump's log, TRC; one run a file.  :mod:`terrain.logs.parts` has which frames
make one sample.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrain import errors
from terrain.errors import ConfigError, LogError, one_line
from terrain.files.documents import read_yaml
from terrain.files.names import data_folder
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.logs.parts import Assembler, Part
from terrain.logs.samples import checked_stream, whole_run_label
from terrain.logs.schema import TWIST, UNIT_SCALES, canonical_unit, check_unit, unit_of
from terrain.records import Reading, RunLog
from terrain.robots import Robot

if TYPE_CHECKING:
    from can import Message as Frame

DEFAULT_DBC, SKIDDING_DBC = "agrimaro.dbc", "skid_steer.dbc"
MAX_BYTES = 8
UNITLESS = ("", "-", "1")  #: Units of a code

library = partial(errors.library, need="CAN needs the packages python-can and cantools", extra="can")

BUS_OFF_BIT = 0x40  #: In the identifier of an error frame of socketcan

COUNTER, CRC = "Counter", "Crc8"
"""Signals that any message may have: rises by one a sample; CRC-8 over identifier and data."""

SIGNALS: Mapping[str, Mapping[str, str]] = read_yaml(data_folder("can") / "signals.yaml")
"""Signal of each channel, by stream; the channels are in the order of its columns."""

RECEIVED = ("wheels", "steering", "imu", "odometry", "twist")
"""Streams of AgriMaRo that the bridge receives, the last of them desired and not measured; it sends the others."""

SENT = ("corrections", "command", "status")
"""Streams that the bridge sends: corrections of the wheels' rates, the twist to drive, and what it does."""

OPTIONAL = frozenset(
    (*(f"position_{axis}_m" for axis in "xyz"), "quaternion_w_ratio", "confidence_ratio", *SIGNALS["status"])
)
"""Channels that no controller needs, or that follow from others: a DBC may lack them."""

COMMANDED = ("CommandedSpeedX", "CommandedSpeedY", "CommandedYawRate")
"""Signals of the twist to drive, for a controller of a robot of another drive that takes one."""

_WORDS = {"motor": "MotorRate", "speed": "WheelSpeed", "current": "MotorCurrent", "angle": "SteeringAngle"}
_OF_STREAM = {"odometry": "Ground", "gnss": "Gnss"}


def signals_of(robot: Robot | None = None) -> Mapping[str, Mapping[str, str]]:
    """Return the signal of each channel of a robot, by stream; of a swerve robot, and without one, :data:`SIGNALS`.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> signals = signals_of(load_robot("husky"))
    >>> list(signals["wheels"].values())
    ['WheelSpeedLeft', 'WheelSpeedRight', 'MotorCurrentLeft', 'MotorCurrentRight']
    >>> list(signals["corrections"].values())
    ['CorrectionLeft', 'CorrectionRight']
    >>> signals["gnss"]["velocity_x_mps"], signals["odometry"]["speed_x_mps"]
    ('GnssVelocityX', 'GroundSpeedX')
    """
    if robot is None or robot.drive == "swerve":
        return SIGNALS
    found: dict[str, Mapping[str, str]] = {}
    for stream, channels in sensor_channels(robot).items():
        if stream == "imu":
            found[stream] = SIGNALS[stream]
            continue
        named = {channel: channel.rpartition("_")[0].split("_") for channel in channels}
        found[stream] = {
            channel: _OF_STREAM.get(stream, "")
            + "".join(_word(stream, at, part) for at, part in enumerate(parts))
            for channel, parts in named.items()
        }
    corrections = {f"correction_{wheel}_radps": f"Correction{_name(wheel)}" for wheel in robot.logged_wheels}
    own = {"corrections": corrections, "command": dict(zip(TWIST, COMMANDED, strict=True))}
    return {**found, "twist": SIGNALS["twist"], **own, "status": SIGNALS["status"]}


def _word(stream: str, at: int, part: str) -> str:
    return _WORDS.get(part, _name(part)) if at == 0 and stream in ("wheels", "steering") else _name(part)


def _name(wheel: str) -> str:
    return wheel.title().replace("_", "")


QUATERNION = tuple(CAMERA_CHANNELS.index(f"quaternion_{part}_ratio") for part in "xyzw")
"""Columns of the camera's quaternion; a real part that the DBC lacks is the one that is not negative."""

READERS = {
    ".asc": ("ASCReader", "r"),
    ".blf": ("BLFReader", "rb"),
    ".log": ("CanutilsLogReader", "r"),
    ".trc": ("TRCReader", "r"),
}
"""Reader of python-can for each kind of file, and how it is opened."""

QUEUE = 1000  #: Most samples of a stream between two readings: ten seconds of an IMU; the oldest are dropped
INCOMPLETE_S = 0.02  #: A sample whose other frames have not come for so long is used without them


class Drop(StrEnum):
    """Why a frame is not used."""

    BUS_OFF = "bus off"
    ERROR = "error frame"
    REMOTE = "remote frame"
    UNKNOWN = "unknown id"
    LENGTH = "wrong length"
    CHECKSUM = "wrong checksum"
    UNREADABLE = "unreadable"
    TIME = "time not finite"


USUAL = (Drop.UNKNOWN, Drop.ERROR, Drop.BUS_OFF, Drop.REMOTE)
"""What a log of any bus has besides the frames that are read: counted, and no fault of the log."""


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal of a message that is used; values are in the unit of the DBC."""

    name: str  #: in the DBC
    column: int  #: of its channel in the stream
    factor: float  #: from the unit of the DBC to SI
    scale: float  #: one step of a raw value; 0 of floating point
    #: low, high: least and largest value that is a measurement
    low: float
    high: float
    absent: float  #: value that stands for one that was not measured


@dataclass(frozen=True, slots=True, eq=False)
class MessagePlan:
    """One message that is used."""

    message: Any  #: of cantools
    stream: str  #: that it carries
    signals: tuple[SignalPlan, ...]  #: of the stream's channels
    counter_bits: int  #: of its counter; 0 without one
    crc_bits: int  #: bits of its CRC in the data, the first byte the highest; 0 without one
    others: Mapping[str, int | float]  #: value of each further signal when it is sent


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """All messages that are used, by identifier and whether it is an extended one, and by stream."""

    name: str
    by_key: Mapping[tuple[int, bool], MessagePlan]
    by_stream: Mapping[str, Sequence[MessagePlan]]
    signals: Mapping[str, Mapping[str, str]]  #: of the robot, as :func:`signals_of` has them

    @property
    def received(self) -> tuple[str, ...]:
        """Streams that the bridge receives, the last of them the desired twist."""
        return tuple(name for name in self.signals if name not in SENT)

    def columns(self, stream: str) -> frozenset[int]:
        """Return the columns of a stream that the DBC has."""
        return frozenset(signal.column for plan in self.by_stream.get(stream, ()) for signal in plan.signals)


def load_layout(
    path: str | Path | None = None, robot: Robot | None = None, *, complete: bool = True
) -> Layout:
    """Return what a DBC has of the signals that are used.

    Parameters
    ----------
    path : DBC file; AgriMaRo's by default, of robots that skid that of the package
    robot : whose; a swerve robot by default
    complete : whether it must have what a pilot needs: all signals but those that may be lacking; of other than swerve
        robots the wheels' rates, the desired twist, and corrections or the twist to drive

    Raises
    ------
    ConfigError
        if the file cannot be read, a signal is missing or ambiguous, or has a unit that does not fit.

    Examples
    --------
    >>> layout = load_layout()
    >>> [plan.message.name for plan in layout.by_stream["wheels"]]
    ['MotorRates', 'MotorCurrents']
    """
    named = signals_of(robot)
    if path is None and named is not SIGNALS and robot is not None and not robot.skids:
        raise ConfigError(
            f"robot {robot.name}: no DBC of drive {robot.drive!r} is packaged, give one with --dbc"
        )
    default = DEFAULT_DBC if named is SIGNALS else SKIDDING_DBC
    path = data_folder("can") / default if path is None else Path(path)
    places = {
        name: (stream, column, channel)
        for stream, names in named.items()
        for column, (channel, name) in enumerate(names.items())
    }
    cantools = library("cantools")
    try:
        messages = cantools.database.load_file(path, database_format="dbc", strict=True).messages
    except OSError as error:
        raise ConfigError(f"{path}: cannot be opened ({error.strerror})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        raise ConfigError(f"{path}: is no DBC ({one_line(error)})") from error
    owner: dict[str, Any] = {}
    by_stream: dict[str, list[MessagePlan]] = {}
    for message in messages:
        used = [signal for signal in message.signals if signal.name in places]
        for signal in used:
            if owner.setdefault(signal.name, message) is not message:
                both = f"{owner[signal.name].name!r} and {message.name!r}"
                raise ConfigError(
                    f"{path}: the signal {signal.name!r} is in the messages {both}; one is required"
                )
        signals = tuple(_signal_plan(path, signal, *places[signal.name][1:]) for signal in used)
        carried = list(dict.fromkeys(places[signal.name][0] for signal in used))
        if not carried:
            continue
        if len(carried) > 1:
            both = " and ".join(map(repr, carried[:2]))
            raise ConfigError(
                f"{path}: the message {message.name!r} has signals of {both}; each needs messages of its own"
            )
        if message.length > MAX_BYTES:
            raise ConfigError(
                f"{path}: the message {message.name!r} has {message.length} bytes; "
                f"a frame of classical CAN has at most {MAX_BYTES}"
            )
        by_name = {signal.name: signal for signal in message.signals}
        others = {
            name: signal.conversion.raw_to_scaled(signal.raw_initial or 0, False)
            for name, signal in by_name.items()
            if name not in places
        }
        counter_bits = by_name[COUNTER].length if COUNTER in by_name else 0
        crc_bits = 0
        if CRC in by_name and by_name[CRC].length == 8:
            raw = dict.fromkeys(by_name, 0) | {CRC: 255}
            crc_bits = int.from_bytes(message.encode(raw, scaling=False, padding=False, strict=False), "big")
        plan = MessagePlan(message, carried[0], signals, counter_bits, crc_bits, others)
        by_stream.setdefault(carried[0], []).append(plan)
    required = [name for name, place in places.items() if place[2] not in OPTIONAL]
    if robot is not None and named is not SIGNALS:
        required = [named["wheels"][rate] for rate in robot.rate_channels] + [*named["twist"].values()]
        required += () if "command" in by_stream else named["corrections"].values()
    missing = [name for name in required if name not in owner]
    if complete and missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(f"{path}: lacks the signal {missing[0]!r}{more}; docs/can.md lists those required")
    plans = [plan for of_stream in by_stream.values() for plan in of_stream]
    by_key = {(plan.message.frame_id, plan.message.is_extended_frame): plan for plan in plans}
    return Layout(path.name, by_key, by_stream, named)


def _signal_plan(path: Path, signal: Any, column: int, channel: str) -> SignalPlan:
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and scale and math.isfinite(offset)):
        raise ConfigError(f"{path}: the signal {signal.name!r} has the scale {scale:g}; 0 is not accepted")
    convert = signal.conversion.raw_to_scaled
    stated = [end for end in (signal.minimum, signal.maximum) if end is not None]
    if signal.is_float:
        largest = float(np.finfo(f"f{signal.length // 8}").max)
        ends, absent = sorted([convert(-largest, False), convert(largest, False)]), math.nan
        low, high = (max(ends[0], stated[0]), min(ends[1], stated[1])) if len(stated) == 2 else ends
    else:
        most = 2 ** (signal.length - signal.is_signed) - 1
        least = -most - 1 if signal.is_signed else 0
        absent = float(convert(least if signal.is_signed else most, False))
        least, most = (least + 1, most) if signal.is_signed else (least, most - 1)
        if len(stated) == 2:  # bounds are written in decimals
            first, last = sorted((end - offset) / scale for end in stated)
            least, most = max(least, math.ceil(first - 1e-6)), min(most, math.floor(last + 1e-6))
        low, high = sorted([convert(least, False), convert(most, False)]) if least <= most else (1.0, 0.0)
    if low > high:
        raise ConfigError(f"{path}: the signal {signal.name!r} has no value between its bounds")
    given, required = signal.unit or "", unit_of(channel)
    if (required == "code" and given in UNITLESS) or (required == "ratio" and not given):
        factor = 1.0
    else:  # a DBC has its own offsets
        check_unit(f"{path}: the signal {signal.name!r} of {channel}", given, required)
        factor = UNIT_SCALES[canonical_unit(given)][1]
    step = 0.0 if signal.is_float else abs(scale)
    return SignalPlan(signal.name, column, factor, step, float(low), float(high), absent)


def _crc_of(plan: MessagePlan, data: bytes) -> int:
    """Return the CRC over the identifier and all bits of the data but its own, unused ones too."""
    from crccheck.crc import Crc8SaeJ1850

    width = 4 if plan.message.is_extended_frame else 2
    others = (int.from_bytes(data, "big") & ~plan.crc_bits).to_bytes(len(data), "big")
    return int(Crc8SaeJ1850.calc(plan.message.frame_id.to_bytes(width, "big") + others))


def decode(layout: Layout, frame: Frame) -> Part | Drop:
    """Return what a frame has of a sample, or why it is not used.

    The time of a frame is on the clock of the bus; the identifier of an error frame states its kinds.

    Examples
    --------
    >>> layout = load_layout()
    >>> frame, = encode(layout, "steering", [0.1, -0.2, math.nan], counter=7)
    >>> decode(layout, frame)
    Part(stream='steering', counter=7, values={0: 0.09999, 1: -0.20001, 2: nan}, n_out_of_range=0)
    >>> frame.data = frame.data[:5]
    >>> decode(layout, frame)
    <Drop.LENGTH: 'wrong length'>
    """
    if frame.is_error_frame:
        return Drop.BUS_OFF if frame.arbitration_id & BUS_OFF_BIT else Drop.ERROR
    if frame.is_remote_frame:
        return Drop.REMOTE
    plan = layout.by_key.get((frame.arbitration_id, frame.is_extended_id))
    if plan is None:
        return Drop.UNKNOWN
    if len(frame.data) != plan.message.length:
        return Drop.LENGTH
    if not math.isfinite(frame.timestamp):
        return Drop.TIME
    data = bytes(frame.data)
    try:
        decoded = plan.message.decode(data, decode_choices=False)
        if plan.crc_bits and decoded[CRC] != _crc_of(plan, data):
            return Drop.CHECKSUM
        counter = int(decoded[COUNTER]) if plan.counter_bits else None
    except Exception:  # whatever a DBC makes of bytes, as of a multiplexer that it does not describe
        return Drop.UNREADABLE
    values, n_out = dict[int, float](), 0
    for signal in plan.signals:
        value = decoded.get(signal.name)  # of a multiplexed message only some are there
        if value is None:
            continue
        values[signal.column] = math.nan
        if signal.low <= value <= signal.high and value != signal.absent:
            values[signal.column] = round(signal.factor * value, 12)
        elif value != signal.absent and not math.isnan(value):
            n_out += 1
    return Part(plan.stream, counter, values, n_out)


def encode(
    layout: Layout,
    stream: str,
    values: Sequence[float],
    counter: int,
    time_s: float = 0.0,
    clipped: Counter[str] | None = None,
) -> list[Frame]:
    """Return the frames of one sample; none where the DBC has no message of the stream.

    Parameters
    ----------
    layout : of the DBC
    stream : one of :data:`SIGNALS`
    values : of all its channels, SI; what is not finite is sent as not measured
    counter : of the sample; it wraps
    time_s : of the frames
    clipped : gets the number of values beyond their range, by signal
    """
    can = library("can")
    frames = []
    for plan in layout.by_stream.get(stream, ()):
        sent: dict[str, Any] = dict(plan.others)
        for signal in plan.signals:
            value = float(values[signal.column]) / signal.factor
            sent[signal.name] = signal.absent
            if math.isfinite(value):
                sent[signal.name] = min(max(value, signal.low), signal.high)
                if abs(value - sent[signal.name]) > 0.5 * signal.scale and clipped is not None:
                    clipped[signal.name] += 1
        if plan.counter_bits:
            sent[COUNTER] = counter % 2**plan.counter_bits
        data = bytes(plan.message.encode(sent, padding=False, strict=False))
        if plan.crc_bits:
            sent[CRC] = _crc_of(plan, data)
            data = bytes(plan.message.encode(sent, padding=False, strict=False))
        about = {"arbitration_id": plan.message.frame_id, "is_extended_id": plan.message.is_extended_frame}
        frames.append(can.Message(time_s, data=data, **about))
    return frames


class Receiver:
    """Samples from frames as they come; whatever comes, it does not raise.

    Parameters
    ----------
    layout : of the DBC
    streams : that are read; frames of others are left alone
    most : samples of a stream that are held between two readings; the oldest are dropped

    Attributes
    ----------
    dropped : what was not used, as counts by kind
    n_used : frames that were used

    Examples
    --------
    >>> layout = load_layout()
    >>> receiver = Receiver(layout, ("wheels",))
    >>> for frame in encode(layout, "wheels", [10.0, 11.0, 12.0, 1.0, 2.0, 3.0], counter=0, time_s=4.0):
    ...     stream = receiver.take(frame)
    >>> receiver.readings(5.0)["wheels"].values
    array([[10., 11., 12.,  1.,  2.,  3.]])
    """

    def __init__(self, layout: Layout, streams: tuple[str, ...], most: float = QUEUE) -> None:
        self._layout = layout
        self.dropped: Counter[str] = Counter()
        self.n_used = 0
        self._streams = {}
        for name in streams:
            if name in layout.by_stream:
                columns = layout.columns(name)
                seen = name == "odometry" and layout.signals is SIGNALS
                quaternion = QUATERNION if seen and QUATERNION[3] not in columns else ()
                about = len(layout.signals[name]), columns, self.dropped, most, quaternion
                self._streams[name] = Assembler(name, *about)

    def take(self, frame: Frame) -> str | None:
        """Take a frame; return the stream that it is of, None where it is not used."""
        part = decode(self._layout, frame)
        if isinstance(part, Drop):
            self.dropped[part.value] += 1
            return None
        assembler = self._streams.get(part.stream)
        if assembler is None:
            self.dropped[f"{part.stream}: not read here"] += 1
            return None
        assembler.take(frame.timestamp, part)
        self.n_used += 1
        return part.stream

    def readings(self, now_s: float) -> dict[str, Reading]:
        """Return the samples since the last call, by stream; of incomplete ones those that are old enough."""
        readings = {name: each.reading(now_s - INCOMPLETE_S) for name, each in self._streams.items()}
        return {name: reading for name, reading in readings.items() if reading is not None}


def find_runs(folder: Path, layout: Layout, robot: str) -> list[Callable[..., RunLog]]:
    """Return a function for each log under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    folder : of the logs; one in a folder of its own is labelled with that folder's name as its terrain
    layout : of the DBC
    robot : of all runs
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in READERS and path.is_file())
    return [partial(read_run, path, folder, layout, robot) for path in paths]


def read_run(path: Path, folder: Path, layout: Layout, robot: str, *, repair: bool = False) -> RunLog:
    """Return the run of a log; its time begins at the first frame.

    Parameters
    ----------
    path, folder : the log, and the folder that its name counts from
    layout : of the DBC
    robot : of the run
    repair : drop and count what is damaged or missing, which a strict read refuses

    Raises
    ------
    LogError
        if the log cannot be read, has none of the signals, or is damaged.
    """
    receiver = Receiver(layout, tuple(layout.signals), most=math.inf)
    first_s: float | None = None
    for frame in _frames(path):
        first_s = frame.timestamp if first_s is None else first_s
        frame.timestamp -= first_s
        receiver.take(frame)
    readings, dropped = receiver.readings(math.inf), receiver.dropped
    faults = {kind: n for kind, n in dropped.items() if kind not in USUAL}
    if faults and not repair:
        kind, n = max(faults.items(), key=lambda fault: fault[1])
        raise LogError(f"{path}: {n} of kind {kind!r}; read it with --repair to leave them out")
    streams = {}
    for name in readings:
        if name not in layout.received:
            continue
        seen = name == "odometry" and layout.signals is SIGNALS
        columns = sorted(layout.columns(name) | ({QUATERNION[3]} if seen else set()))
        channels = tuple(layout.signals[name])
        streams["commands" if name == "twist" else name] = checked_stream(
            f"{path}, {name}",
            readings[name].time_s,
            readings[name].values[:, columns],
            [channels[column] for column in columns],
            row_of=lambda sample: sample + 1,
            repairs=dropped if repair else None,
        )
    if not streams:
        raise LogError(f"{path}: has no frame of the messages of {layout.name}")
    place = path.relative_to(folder).with_suffix("").parts
    labels = (whole_run_label(streams, place[0]),) if len(place) > 1 else ()
    return RunLog("_".join(place), robot, streams, labels, source=str(path), dropped=dropped)


def _frames(path: Path) -> Iterator[Any]:
    can = library("can")
    reader, mode = READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # a reader that fails leaves a file of its own open
            yield from getattr(can, reader)(file)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        raise LogError(f"{path}: is no log of a CAN bus, or is damaged ({one_line(error)})") from error
