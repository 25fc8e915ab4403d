"""Messages as text and bytes: JSON in text frames, MessagePack in binary frames.

Neither form has a number that is not finite in what is sent: it is ``null``.
"""

from __future__ import annotations

import json
import math
from enum import StrEnum
from typing import Any

import msgpack
import numpy as np

from terrain.errors import TerrainError


class Encoding(StrEnum):
    """How a message is written."""

    JSON = "json"
    MSGPACK = "msgpack"


class WireError(TerrainError):
    """A message that cannot be taken: a code for programs, and a sentence.

    Parameters
    ----------
    code : one of :data:`CODES`
    sentence : what is wrong
    """

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


CODES = {
    "malformed": "the message is no JSON, no MessagePack, or not of the form that its type has",
    "too-large": "the message or an entry of it is larger than is accepted",
    "too-fast": "more messages or rows a second than are accepted; what is over is dropped",
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


def decode(message: str | bytes) -> dict[str, Any]:
    """Return the content of a message.

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
    pipelines.serve.wire.WireError: the message is no JSON: it is nested too deeply
    """
    form = "JSON" if isinstance(message, str) else "MessagePack"
    try:
        content = json.loads(message) if isinstance(message, str) else msgpack.unpackb(message)
    except RecursionError:
        raise WireError("malformed", f"the message is no {form}: it is nested too deeply") from None
    except (ValueError, TypeError, KeyError, OverflowError, MemoryError, msgpack.UnpackException) as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise WireError("malformed", f"the message is no {form}: {reason}") from None
    if not isinstance(content, dict):
        raise WireError("malformed", f"the message is a {type(content).__name__}, an object is required")
    return content


def encode(content: dict[str, Any], encoding: Encoding) -> str | bytes:
    """Return a message of plain values, as :func:`plain` makes them."""
    if encoding is Encoding.JSON:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    packed: bytes = msgpack.packb(content)
    return packed


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
