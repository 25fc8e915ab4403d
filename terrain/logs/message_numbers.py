"""Numbers in the messages of a topic, whatever decoded them: an object of ROS or Protobuf, or JSON."""

from __future__ import annotations

import re
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.files.names import listed, shown

STAMPS = (
    ("header.stamp.sec", "header.stamp.nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("timestamp.seconds", "timestamp.nanos"),
    ("timestamp.sec", "timestamp.nsec"),
)
"""Where messages of ROS, and those of Foxglove in Protobuf and JSON, have the time of a measurement."""

Number = Callable[[Any], float]


def number_at(topic: str, kind: str, message: Any, path: str, joint: str = "") -> Number:
    """Return what takes a number from each message of a topic; NaN where one lacks it.

    Parameters
    ----------
    topic, kind : name and type, as messages name them
    message : the first one, which shows what fields there are
    path : as ``twist.linear.x`` or ``data[2]``; of a joint the array that has its number
    joint : name that stands for an index: its place in the field ``name``

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
    place = f"topic {topic}: field {shown(path)}"
    if joint:
        if not {path, "name"} <= set(_fields(message)) or not _is_array(_field(message, path)):
            raise ConfigError(f"{place} is no array of joints")
        return lambda message: _of_joint(message, path, joint)
    steps: list[str | int] = []
    value, owner = message, kind
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        fields = _fields(value)
        if name not in fields:
            lacks = f"has no {name!r} (it has {listed(fields)})" if fields else "has no fields of its own"
            raise ConfigError(f"{place}: {owner} {lacks}")
        value, owner = _field(value, name), repr(name)
        if _is_array(value) != bool(index):
            fault = f"give an index, as {name}[0]" if not index else f"leave the index out, as {name}"
            raise ConfigError(f"{place}: {name!r} is {'an' if not index else 'no'} array: {fault}")
        steps += [name, int(index)] if index else [name]
        if index:
            if int(index) >= len(value):  # another message may have more elements
                return lambda message: _following(message, steps)
            value = value[int(index)]
    if value is not None and not isinstance(value, int | float | np.number | np.bool_):
        fields = _fields(value)
        inner = f" (it has {listed(fields)})" if fields else ""
        raise ConfigError(f"{place} is of type {type(value).__name__}, a number is required{inner}")
    if isinstance(message, dict) or not all(isinstance(step, str) for step in steps):
        return lambda message: _following(message, steps)
    return attrgetter(path)


def stamp_at(topic: str, kind: str, message: Any) -> tuple[Number, Number] | None:
    """Return what takes whole seconds and nanoseconds of a measurement from each message; None: it has none."""
    for pair in STAMPS:
        try:
            seconds, rest = (number_at(topic, kind, message, path) for path in pair)
        except ConfigError:
            continue
        return seconds, rest
    return None


def _following(message: Any, steps: list[str | int]) -> float:
    for step in steps:
        if isinstance(step, str):
            message = _field(message, step)
        else:
            message = message[step] if step < len(message) else None
        if message is None:
            return np.nan
    return float(message)


def _of_joint(message: Any, path: str, joint: str) -> float:
    names, values = list(_field(message, "name")), _field(message, path)
    place = names.index(joint) if joint in names else len(values)
    return float(values[place]) if place < len(values) else np.nan


def _fields(message: Any) -> list[str]:
    """Return the names of the fields of a message; empty of what is none."""
    if isinstance(message, dict):
        return [str(name) for name in message]
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name)


def _is_array(value: Any) -> bool:
    return hasattr(value, "__getitem__") and not isinstance(value, str | bytes | dict) and np.ndim(value) > 0
