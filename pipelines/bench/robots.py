"""Robots that drive against a service: many in one process, each with a connection of its own."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from time import monotonic
from typing import Any, NamedTuple

import msgpack
from websockets.asyncio.client import connect

from terrain.errors import TerrainError

ANSWER_S = 5.0

APART_S = 2.0
"""Robots do not start at one instant, and their windows do not end at one."""


class Driven(NamedTuple):
    """What a robot saw: round trips, rows sent, and answers that did not come."""

    times_ms: list[float]
    rows: int
    unanswered: int


class Packed(NamedTuple):
    """A message as it is sent, when, whether it asks for a step, and its rows."""

    message: bytes
    time_s: float
    step: bool
    rows: int


def packed(messages: Sequence[dict[str, Any]]) -> list[Packed]:
    """Return messages as they are sent, at the times of their steps."""
    first_s = float(messages[0]["time_s"])
    return [
        Packed(
            msgpack.packb(content),
            content["time_s"] - first_s,
            bool(content.get("step")),
            sum(len(time_s) for time_s, _ in content["streams"].values()),
        )
        for content in messages
    ]


def hello(session: str, robot: str, channels: dict[str, list[str]]) -> bytes:
    """Return the first message of a robot that asks for each of its steps."""
    content = {"type": "hello", "session": session, "robot": robot, "streams": channels}
    message: bytes = msgpack.packb({**content, "control": True, "follows": False, "rate_hz": 0.0})
    return message


async def drive(url: str, first: bytes, messages: Sequence[Packed], delay_s: float = 0.0) -> Driven:
    """Drive one robot in real time; return the round trips of its steps.

    Raises
    ------
    TerrainError
        if the service refuses the robot.
    """
    times_ms: list[float] = []
    rows = unanswered = 0
    async with connect(f"{url}/robots", compression=None, max_size=None) as socket:
        await socket.send(first)
        answer = msgpack.unpackb(await socket.recv())
        if answer.get("type") != "welcome":
            raise TerrainError(f"the service refuses a robot: {answer.get('message')}")
        begin_s = monotonic() + delay_s
        for one in messages:
            wait_s = begin_s + one.time_s - monotonic()
            if wait_s > 0.0:
                await asyncio.sleep(wait_s)
            sent_s = monotonic()
            await socket.send(one.message)
            rows += one.rows
            if one.step:
                try:
                    async with asyncio.timeout(ANSWER_S):
                        while msgpack.unpackb(await socket.recv()).get("type") != "step":
                            pass
                    times_ms.append((monotonic() - sent_s) * 1e3)
                except TimeoutError:
                    unanswered += 1
    return Driven(times_ms, rows, unanswered)


async def drive_all(
    url: str, robot: str, channels: dict[str, list[str]], messages: Sequence[Packed], n: int
) -> list[Driven]:
    """Drive several robots at once, their starts spread over the time of a window."""
    tasks = [
        drive(url, hello(f"bench-{k}", robot, channels), messages, 0.5 + APART_S * k / n) for k in range(n)
    ]
    return list(await asyncio.gather(*tasks))
