"""Messages as text and bytes: JSON in text frames, MessagePack in binary frames.

Neither form has a number that is not finite in what is sent: it is ``null``.
"""

from __future__ import annotations

import json
import math
from typing import Any

import msgpack
import numpy as np
from pydantic_core import from_json

from terrain.errors import TerrainError

CODES = {
    "malformed": "the message is no JSON, no MessagePack, or not of the form that its type has",
    "too-large": "the message or an entry of it is larger than is accepted",
    "too-fast": "more messages, rows, bytes or decoding than are accepted; what is over is dropped",
    "unknown-type": "there is no message of that type",
    "hello-first": "the first message has to be a hello",
    "refused": "the session cannot be served: no such channels, robot, or model",
    "name-taken": "another connection has a session of that name",
    "too-many": "as many sessions as are accepted are open",
    "token": "a token is required, or it is another",
    "closing": "the service ends",
    "too-slow": "the receiver did not read for too long",
}
"""Codes of errors, and what each means."""


class WireError(TerrainError):
    """A message that cannot be taken: one of :data:`CODES` for programs, and a sentence."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


def decode(message: str | bytes) -> dict[str, Any]:
    """Return the content of a message.

    JSON is read by pydantic's parser, which takes a sixth of the time of the standard library's, and a tenth
    where the text is wrong: no robot is served while a parser runs.

    Raises
    ------
    WireError
        if it is not one object with names as keys.

    Examples
    --------
    >>> decode('{"type": "bye"}')
    {'type': 'bye'}
    >>> decode("[" * 100000)
    Traceback (most recent call last):
    pipelines.serve.wire.WireError: the message is no JSON: recursion limit exceeded at line 1 column 202
    """
    form = "JSON" if isinstance(message, str) else "MessagePack"
    try:
        content = from_json(message) if isinstance(message, str) else msgpack.unpackb(message)
    except RecursionError:
        raise WireError("malformed", f"the message is no {form}: it is nested too deeply") from None
    except (ValueError, TypeError, KeyError, OverflowError, MemoryError, msgpack.UnpackException) as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise WireError("malformed", f"the message is no {form}: {reason}") from None
    if not isinstance(content, dict):
        raise WireError("malformed", f"the message is a {type(content).__name__}, an object is required")
    return content


def encode(content: dict[str, Any], *, packed: bool = False) -> str | bytes:
    """Return a message of plain values, as :func:`plain` makes them: JSON, or MessagePack where ``packed``."""
    if not packed:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    message: bytes = msgpack.packb(content)
    return message


def plain(value: Any) -> Any:
    """Return a value for a message: lists for arrays, None for what is not finite.

    Examples
    --------
    >>> plain({"slip_ratio": np.array([0.1, np.nan]), "probability": math.inf})
    {'slip_ratio': [0.1, None], 'probability': None}
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return [plain(one) for one in value.tolist()]
    if isinstance(value, dict):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value
