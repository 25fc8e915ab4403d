"""Messages as text and bytes: JSON in text frames, MessagePack in binary frames.

Neither form has a number that is not finite in what is sent: it is ``null``.
"""

from __future__ import annotations

from typing import Any

import msgpack
from pydantic_core import from_json, to_json, to_jsonable_python

from terrain.errors import TerrainError


class WireError(TerrainError):
    """A message that cannot be taken: a code for programs, as ``docs/service.md`` lists them, and a sentence."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


def decode(message: str | bytes) -> dict[str, Any]:
    """Return the content of a message.

    JSON is read by pydantic's parser, which takes a sixth of the time of the standard library's, and a tenth
    of it of wrong JSON.

    Raises
    ------
    WireError
        ``malformed`` where it is no JSON or MessagePack, or no object.

    Examples
    --------
    >>> decode('{"type": "bye"}'), decode(encode({"type": "bye"}, packed=True))
    ({'type': 'bye'}, {'type': 'bye'})
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
    """Return a message: JSON, or MessagePack where ``packed``; arrays become lists.

    Examples
    --------
    >>> import numpy as np
    >>> encode({"slip_ratio": np.array([0.1, np.nan]), "probability": float("inf")})
    '{"slip_ratio":[0.1,null],"probability":null}'
    """
    if not packed:
        return to_json(content, inf_nan_mode="null", fallback=_listed).decode()
    message: bytes = msgpack.packb(to_jsonable_python(content, inf_nan_mode="null", fallback=_listed))
    return message


def _listed(array: Any) -> Any:
    return array.tolist()
