"""Numbers of the messages of one topic as they are read, and the stamps of these messages."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from pipelines.data.faults import DAMAGED_MESSAGE, Faults
from terrain.errors import ConfigError, LogError
from terrain.files.names import listed, shown
from terrain.logs.parquet_file import MAX_VALUES
from terrain.records import Array

STAMPS = (
    ("header.stamp.sec", "header.stamp.nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("timestamp.seconds", "timestamp.nanos"),
    ("timestamp.sec", "timestamp.nsec"),
)
"""Where messages of ROS, and those of Foxglove in Protobuf and JSON, have the time of a measurement."""

_LATEST_NS = 2**62
_STEP = re.compile(r"([A-Za-z]\w*)(?:\[(\d{1,8})\])?")

Number = Callable[[Any], float]


class Numbers(NamedTuple):
    """Numbers (n, k) of the messages of a topic, with their stamps (n,) in ns; in the order of the log."""

    stamp_ns: Array
    values: Array


def number_at(topic: str, kind: str, message: Any, path: str) -> Number:
    """Return what takes a number from each message of a topic; NaN where one lacks it.

    Parameters
    ----------
    topic, kind : name and type, as messages name them
    message : the first one, which shows what fields there are
    path : as ``twist.linear.x`` or ``data[2]``

    Raises
    ------
    ConfigError
        if there is no such field, or it holds no number.

    Examples
    --------
    >>> speed = number_at("/speeds", "a_msgs/Speeds", {"speeds": [1.5, 2.5]}, "speeds[1]")
    >>> speed({"speeds": [3, 4]}), speed({"speeds": []})
    (4.0, nan)
    """
    steps: list[str | int] = []
    place = f"topic {topic}: field {shown(path)}"
    value, owner = message, kind
    for part in path.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ConfigError(f"field {shown(path)} is no path, as 'twist.linear.x' or 'data[2]' is one")
        name, index = found[1], None if found[2] is None else int(found[2])
        fields = field_names(value)
        if name not in fields:
            lacks = f"has no {name!r} (it has {listed(fields)})" if fields else "has no fields of its own"
            raise ConfigError(f"{place}: {owner} {lacks}")
        value, owner = _field(value, name), repr(name)
        steps.append(name)
        if is_array(value) == (index is None):
            fault = (
                f"is an array: give an index, as {name}[0]"
                if index is None
                else f"is no array: leave the index out, as {name}"
            )
            raise ConfigError(f"{place}: {name!r} {fault}")
        if index is not None:
            steps.append(index)
            if index >= len(value):  # another message may have more elements
                return _following(steps)
            value = value[index]
    if not _is_number(value):
        fields = field_names(value)
        inner = f" (it has {listed(fields)})" if fields else ""
        raise ConfigError(f"{place} is of type {type(value).__name__}, a number is required{inner}")
    if all(isinstance(step, str) for step in steps) and not isinstance(message, dict):
        return attrgetter(".".join(map(str, steps)))
    return _following(steps)


def _following(steps: Sequence[str | int]) -> Number:
    def number(message: Any) -> float:
        for step in steps:
            if isinstance(step, str):
                message = _field(message, step)
            elif step < len(message):
                message = message[step]
            else:
                return np.nan
            if message is None:
                return np.nan
        return float(message)

    return number


def field_names(message: Any) -> list[str]:
    """Return the names of the fields of a message; empty of what is none."""
    if isinstance(message, dict):
        return [str(name) for name in message]
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name)


def is_array(value: Any) -> bool:
    """Return whether a value is indexed: an array, a list or what Protobuf repeats."""
    return hasattr(value, "__getitem__") and not isinstance(value, str | bytes | dict) and np.ndim(value) > 0


def _is_number(value: Any) -> bool:
    return value is None or isinstance(value, int | float | np.number | np.bool_)


class Collector:
    """Numbers of the messages of a topic.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic, kind : whose messages are taken, and their type
    paths : to the numbers, each with the name of a joint where one stands for an index
    by_header : stamps are those of the messages, where there are any; else the log times
    faults : gets what is damaged
    """

    def __init__(
        self,
        place: str,
        topic: str,
        kind: str,
        paths: Sequence[tuple[str, str]],
        by_header: bool,
        faults: Faults,
    ) -> None:
        self.topic, self._kind, self._place, self._faults = topic, kind, place, faults
        self._paths, self._by_header = paths, by_header
        self._is_by_joint = any(joint for _, joint in paths)
        self._numbers: list[Number] | None = None
        self._stamp: tuple[Number, Number] | None = None
        self._places: dict[tuple[str, ...], list[tuple[str, int]]] = {}
        self._log_ns: list[int] = []
        self._stamp_ns: list[int] = []
        self._rows: list[Sequence[float]] = []

    def take(self, log_ns: int, message: Any) -> None:
        """Take a message; what it has no number for is NaN.

        Raises
        ------
        LogError
            if it is damaged, or there are too many.
        ConfigError
            if it is the first one and lacks a field, or a field is no number.
        """
        if self._numbers is None:
            self._numbers = self._prepared(message)
        try:
            if self._is_by_joint:
                row: Sequence[float] = self._of_joints(message)
            else:
                row = [float(number(message)) for number in self._numbers]
            stamp_ns = log_ns
            if self._stamp is not None:
                seconds, rest = (number(message) for number in self._stamp)
                stamp_ns = int(seconds) * 10**9 + int(rest)
            if not -_LATEST_NS < stamp_ns < _LATEST_NS:
                raise ValueError("a stamp is beyond what clocks show")
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self.damaged(error)
            return
        if (
            self._is_by_joint and not np.isfinite(row).any()
        ):  # a robot may send its joints in several messages
            return
        self._rows.append(row)
        self._stamp_ns.append(stamp_ns)
        self._log_ns.append(log_ns)
        if len(self._rows) * max(len(self._paths), 1) > MAX_VALUES:
            raise LogError(f"{self._place}: topic {shown(self.topic)} has more than {MAX_VALUES} values")

    def damaged(self, error: Exception) -> None:
        """Refuse or count a message that cannot be decoded."""
        text = f"topic {shown(self.topic)} has a message that is not as defined ({str(error)[:120]})"
        self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def _prepared(self, message: Any) -> list[Number]:
        if self._by_header:
            for pair in STAMPS:
                try:
                    seconds, rest = (number_at(self.topic, self._kind, message, path) for path in pair)
                except ConfigError:
                    continue
                self._stamp = (seconds, rest)
                break
        if not self._is_by_joint:
            return [number_at(self.topic, self._kind, message, path) for path, _ in self._paths]
        fields = field_names(message)
        for path, _ in self._paths:
            if path not in fields or "name" not in fields or not is_array(_field(message, path)):
                raise ConfigError(f"topic {self.topic}: field {shown(path)} is no array of joints")
        return []

    def _of_joints(self, message: Any) -> list[float]:
        names = tuple(_field(message, "name"))
        if names not in self._places:
            self._places[names] = [
                (path, names.index(joint) if joint in names else -1) for path, joint in self._paths
            ]
        row = []
        for path, index in self._places[names]:
            values = _field(message, path)
            row.append(float(values[index]) if 0 <= index < len(values) else np.nan)
        return row

    def numbers(self) -> Numbers:
        """Return what was collected, in the order of log times."""
        log_ns, stamp_ns = (np.array(each, dtype=np.int64) for each in (self._log_ns, self._stamp_ns))
        values = np.array(self._rows, dtype=np.float64).reshape(len(log_ns), len(self._paths))
        self._rows = []
        order = np.argsort(log_ns, kind="stable")
        return Numbers(stamp_ns[order], values[order])


class TextCollector:
    """Texts of the messages of a topic of ``std_msgs/String``, with their log times.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic : whose messages are taken
    faults : gets what is damaged
    most : texts that are taken
    """

    def __init__(self, place: str, topic: str, faults: Faults, most: int) -> None:
        self.topic, self._place, self._faults, self._most = topic, place, faults, most
        self._texts: list[tuple[int, str]] = []

    def take(self, log_ns: int, message: Any) -> None:
        """Take a message; those beyond the most that are taken are refused."""
        if len(self._texts) >= self._most:
            raise LogError(f"{self._place}: topic {shown(self.topic)} has more than {self._most} messages")
        self._texts.append((log_ns, str(message.data)))

    def damaged(self, error: Exception) -> None:
        """Refuse or count a message that cannot be decoded."""
        text = f"topic {shown(self.topic)} has a message that is no text ({str(error)[:120]})"
        self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def texts(self) -> list[tuple[int, str]]:
        """Return log times in ns with the texts, in order."""
        return sorted(self._texts, key=lambda each: each[0])


Taker = Collector | TextCollector


def give(takers: Mapping[str, Sequence[Taker]], decoders: Mapping[str, Callable[[bytes], Any]]) -> Any:
    """Return a function that decodes a message once, and gives it to all that take its topic."""

    def given(topic: str, log_ns: int, content: bytes) -> None:
        try:
            message = decoders[topic](content)
        except Exception as error:  # whatever a library makes of damaged bytes
            takers[topic][0].damaged(error)
            return
        for taker in takers[topic]:
            taker.take(log_ns, message)

    return given
