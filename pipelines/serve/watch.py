"""What the page shows: the newest step of each robot, ten times a second."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect

from pipelines.serve.connection import POLICY, TRY_AGAIN_LATER
from pipelines.serve.guard import token_fits
from pipelines.serve.hub import Hub
from pipelines.serve.messages import error_content, served_content, step_content
from pipelines.serve.wire import Encoding, WireError, decode, encode

RATE_HZ = 10.0
MAX_WATCHERS = 16
TOO_SLOW_S = 10.0


async def watch(socket: WebSocket, hub: Hub, token: str, given_token: str) -> None:
    """Send a page what it shows until it is left; nothing is raised.

    A page says ``{"type": "watch", "token": ..., "session": ...}`` at any time; without a session it is sent
    the first one.
    """
    chosen: dict[str, str] = {}
    tasks: list[asyncio.Task[None]] = []
    try:
        if not token_fits(token, given_token):
            async with asyncio.timeout(10.0):
                first = await _message(socket)
            if not token_fits(token, str(first.get("token", ""))):
                refusal = error_content("token", "a token is required, or it is another", fatal=True)
                await socket.send_text(str(encode(refusal, Encoding.JSON)))
                await socket.close(POLICY, "token")
                return
            chosen["session"] = str(first.get("session", ""))
        if hub.watchers >= MAX_WATCHERS:
            await socket.close(TRY_AGAIN_LATER, f"{MAX_WATCHERS} pages are open, no more are accepted")
            return
        hub.watchers += 1
        try:
            loop = asyncio.get_running_loop()
            tasks = [loop.create_task(_listen(socket, chosen)), loop.create_task(_show(socket, hub, chosen))]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            hub.watchers -= 1
    except (WebSocketDisconnect, WireError, RuntimeError, OSError, TimeoutError):
        pass  # the page was left
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        with suppress(RuntimeError, OSError, WebSocketDisconnect):
            await socket.close()


async def _message(socket: WebSocket) -> dict[str, Any]:
    received = await socket.receive()
    if received["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(received.get("code", 1006))
    return decode((received.get("text") or "")[:4096])


async def _listen(socket: WebSocket, chosen: dict[str, str]) -> None:
    while True:
        with suppress(WireError):
            chosen["session"] = str((await _message(socket)).get("session", ""))


async def _show(socket: WebSocket, hub: Hub, chosen: dict[str, str]) -> None:
    while True:
        async with asyncio.timeout(TOO_SLOW_S):
            await socket.send_text(str(encode(shown(hub, chosen.get("session", "")), Encoding.JSON)))
        await asyncio.sleep(1.0 / RATE_HZ)


def shown(hub: Hub, session: str) -> dict[str, Any]:
    """Return what a page shows of a session, of the first one where it is not there."""
    opened = hub.sessions.get(session) or next(iter(hub.sessions.values()), None)
    content: dict[str, Any] = {
        "type": "state",
        "sessions": list(hub.sessions),
        "served": served_content(hub.served),
        "trouble": list(hub.trouble.values()),
        "session": None,
    }
    if opened is not None:
        robot = hub.robot(opened.chain.request.robot)
        content["session"] = {
            "name": opened.name,
            "robot": opened.chain.request.robot,
            "control": opened.chain.request.control,
            "wheels": [] if robot is None else list(robot.wheels),
            "recording": opened.chain.recording,
            "dropped": opened.chain.dropped,
            "step": None if opened.last is None else step_content(opened.last),
        }
    return content
