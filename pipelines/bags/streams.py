"""Streams of a mapping from the numbers of their topics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipelines.bags.collect import Collector, Numbers
from pipelines.bags.mapping import TYPES, Channel, StreamMapping, by_radius, described, joint_unit
from pipelines.bags.standard import KINDS, Converted
from pipelines.messages.definitions import Definition, short_type
from pipelines.messages.storage import Faults, Topic
from terrain.errors import ConfigError, LogError
from terrain.files.names import shown
from terrain.logs.samples import checked_stream, longest_rise
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, unit_of
from terrain.records import Array, Stream

UNMATCHED = "messages without one of equal stamp on the other topics"


class RawStream(NamedTuple):
    """A stream before it is judged: stamps (n,) in ns, channels, and values (n, c)."""

    stamp_ns: Array
    channels: tuple[str, ...]
    values: Array


class StreamCollector:
    """Collects what a stream of a mapping is made of.

    Parameters
    ----------
    place : of the bag, as messages name it
    name : of the stream
    mapping : of it
    by_header : whether stamps are those of headers, where the stream does not state it
    definitions : by topic
    topics : of the bag, by name
    wheel_radius_m : of the robot; None where unknown
    faults : gets what is damaged

    Raises
    ------
    LogError
        if a topic is of another type than the kind has.
    ConfigError
        if a field is unknown or no number, or a radius is missing.
    """

    def __init__(
        self,
        place: str,
        name: str,
        mapping: StreamMapping,
        *,
        by_header: bool,
        definitions: Mapping[str, Definition],
        topics: Mapping[str, Topic],
        wheel_radius_m: float | None,
        faults: Faults,
    ) -> None:
        self._place, self._name, self._mapping, self._faults = place, name, mapping, faults
        by_header = mapping.time == "header" if mapping.time else by_header
        self._radius_m = wheel_radius_m
        if mapping.wheel_radius is not None:
            self._radius_m = mapping.wheel_radius.value * UNIT_SCALES[mapping.wheel_radius.unit][1]
        self._by_topic = _channels_by_topic(mapping)
        self._kind = short_type(topics[mapping.topic].kind)
        if mapping.kind != "fields" and self._kind not in TYPES[mapping.kind]:
            raise LogError(
                f"{place}: stream {name}: topic {mapping.topic} is of type {topics[mapping.topic].kind}, "
                f"kind {mapping.kind!r} is {' or '.join(TYPES[mapping.kind])} "
                f"(there are {described([*topics.values()])})"
            )
        for channel, entry in mapping.channels.items():
            if mapping.kind == "joints" and by_radius(entry, unit_of(channel)) and self._radius_m is None:
                raise ConfigError(
                    f"{place}: stream {name}: channel {channel} is the speed of a joint that turns: "
                    f"'wheel_radius' is missing, and the robot has no description"
                )
        self.collectors = [
            Collector(place, topic, definitions[topic], self._paths(channels), by_header, faults)
            for topic, channels in self._by_topic.items()
        ]

    def _paths(self, channels: Mapping[str, Channel]) -> list[tuple[str, str]]:
        if self._kind in KINDS and self._mapping.kind != "fields":
            return [(path, "") for path in KINDS[self._kind].paths]
        return [(channel.field, channel.joint) for channel in channels.values()]

    def raw(self) -> RawStream:
        """Return the channels at the stamps of the stream.

        Raises
        ------
        LogError
            if its topic has no message, or the stamps of its topics do not agree.
        """
        numbers = [collector.numbers() for collector in self.collectors]
        for collector, each in zip(self.collectors, numbers, strict=True):
            if not each.stamp_ns.size:
                what = " with any of the joints" if self._mapping.kind == "joints" else ""
                raise LogError(f"{self._place}: topic {shown(collector.topic)} has no message{what}")
        if self._mapping.kind in ("fields", "joints"):
            stamp_ns, rows = numbers[0].stamp_ns, [each.values for each in numbers]
            if len(numbers) > 1:
                stamp_ns, rows = self._joined(numbers)
            names = [name for channels in self._by_topic.values() for name in channels]
            found = self._in_si(names, np.concatenate(rows, axis=1))
        else:
            stamp_ns, found = numbers[0].stamp_ns, KINDS[self._kind].converted(numbers[0].values)
        if not found.channels:
            raise LogError(
                f"{self._place}: topic {shown(self._mapping.topic)} states that it measures nothing"
            )
        return RawStream(stamp_ns, found.channels, found.values)

    def _in_si(self, names: list[str], values: Array) -> Converted:
        columns = []
        for name, column in zip(names, values.T, strict=True):
            channel, desired = self._mapping.channels[name], unit_of(name)
            unit = joint_unit(channel) if self._mapping.kind == "joints" else channel.unit
            factor = 1.0 if desired == "code" else UNIT_SCALES[unit][1]
            zero = UNIT_OFFSETS.get(unit, 0.0)
            if self._mapping.kind == "joints" and by_radius(channel, desired):
                factor *= self._radius_m or np.nan
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged later
                columns.append((column * channel.scale + channel.offset) * factor + zero)
        order = [names.index(name) for name in self._mapping.channels]
        return Converted(tuple(self._mapping.channels), np.column_stack(columns)[:, order])

    def _joined(self, numbers: list[Numbers]) -> tuple[Array, list[Array]]:
        """Return the samples of several topics at stamps that all of them have, or at those of the first."""
        orders = [np.argsort(each.stamp_ns, kind="stable") for each in numbers]
        stamps = [each.stamp_ns[order] for each, order in zip(numbers, orders, strict=True)]
        values = [each.values[order] for each, order in zip(numbers, orders, strict=True)]
        if self._mapping.join == "previous":
            return stamps[0], [
                values[0],
                *(_previous(stamps[0], *o) for o in zip(stamps[1:], values[1:], strict=True)),
            ]
        common = stamps[0]
        for each in stamps[1:]:
            common = np.intersect1d(common, each)
        n_lost = sum(each.size for each in stamps) - common.size * len(stamps)
        if n_lost:
            topics = " and ".join(shown(topic) for topic in self._by_topic)
            text = f"{self._name}: {n_lost} messages of {topics} lack one of equal stamp (join: previous)"
            self._faults.found(self._place, UNMATCHED, text, n_lost)
        if not common.size:
            raise LogError(
                f"{self._place}: stream {self._name}: no two stamps of its topics agree (join: previous)"
            )
        return common, [
            value[np.searchsorted(each, common)] for each, value in zip(stamps, values, strict=True)
        ]


def _previous(at_ns: Array, stamp_ns: Array, values: Array) -> Array:
    """Return the last values (m, k) by each of some instants; NaN before the first.

    Examples
    --------
    >>> _previous(np.array([1, 5]), np.array([3, 4]), np.array([[1.0], [2.0]])).tolist()
    [[nan], [2.0]]
    """
    last = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    return np.where((last >= 0)[:, None], values[np.maximum(last, 0)], np.nan)


def _channels_by_topic(mapping: StreamMapping) -> dict[str, dict[str, Channel]]:
    found: dict[str, dict[str, Channel]] = {}
    for name, channel in mapping.channels.items():
        found.setdefault(channel.topic or mapping.topic, {})[name] = channel
    if mapping.topic in found or not found:
        return {mapping.topic: found.pop(mapping.topic, {}), **found}
    return found


def start_of(stamps: list[Array], repairs: Counter[str] | None) -> int:
    """Return the stamp in ns at which a run begins: the first one; when repairing, of those in order.

    Examples
    --------
    >>> start_of([np.array([50, 40, 60])], None), start_of([np.array([0, 40, 50, 60])], Counter())
    (40, 0)
    """
    if repairs is None:
        return min(int(each.min()) for each in stamps)
    return min(int(each[longest_rise(each)[0]]) for each in stamps)


def stream_of(place: str, name: str, raw: RawStream, start_ns: int, repairs: Counter[str] | None) -> Stream:
    """Return a stream on the clock of the run.

    Raises
    ------
    LogError
        if stamps go back or repeat, a channel has nothing finite, or there are fewer than two samples.
    """
    if raw.stamp_ns.size > 1 and not np.any(raw.stamp_ns):
        raise LogError(f"{place}: stream {name}: all headers are stamped 0; take the log times (time: log)")
    return checked_stream(
        f"{place}: stream {name}",
        (raw.stamp_ns - start_ns) / 1e9,
        raw.values,
        raw.channels,
        row_of=lambda sample: sample + 1,
        repairs=repairs,
    )
