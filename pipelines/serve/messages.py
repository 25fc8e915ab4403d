"""What the messages of a robot and of the service hold; ``docs/service.md`` describes them."""

from __future__ import annotations

from time import time
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from pipelines.live.classifying import WindowOutput
from pipelines.live.session import COMMAND_VALID_S, RobotSession, Served, SessionRequest, StepOutput
from pipelines.live.state import LiveState
from pipelines.serve.wire import WireError
from terrain.control.traction import TractionStatus

PROTOCOL: Literal[2] = 2
"""Of the messages; since 2 a token comes before the hello, in a header or as the first frame."""

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$", max_length=64)]
Channel = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)]

CONTROL_RATE_LEAST_HZ = 5.0
"""Of commands: a longer step than half a second is taken for a clock that was set, and a command holds for a
quarter of a second."""


class Hello(BaseModel):
    """First message of a robot: what it is, what it sends, and what it asks for.

    ``rate_hz`` is the rate of the answers; 0 asks for one at each message with ``"step": true``.
    """

    model_config = ConfigDict(extra="forbid", strict=True)

    type: Literal["hello"]
    protocol: Literal[2] = PROTOCOL
    session: Name
    robot: Name
    streams: Annotated[
        dict[Name, Annotated[list[Channel], Field(min_length=1, max_length=64)]],
        Field(min_length=1, max_length=16),
    ]
    control: bool = False
    follows: bool = True
    rate_hz: Annotated[float, Field(ge=0.0, le=200.0, strict=False)] = 10.0
    record: bool = False

    @property
    def request(self) -> SessionRequest:
        """What the session is made of."""
        channels = {stream: tuple(names) for stream, names in self.streams.items()}
        return SessionRequest(self.session, self.robot, channels, self.control, self.follows)


def read_hello(content: dict[str, Any]) -> Hello:
    """Return a hello.

    Raises
    ------
    WireError
        if it is none, or something in it is not accepted; the sentence names the first thing that is not.

    Examples
    --------
    >>> hello = {"type": "hello", "session": "r7", "robot": "husky", "streams": {"imu": ["gyro_z_radps"]}}
    >>> read_hello(hello).rate_hz
    10.0
    >>> read_hello({"type": "samples"})
    Traceback (most recent call last):
    pipelines.serve.wire.WireError: the first message is of the type 'samples', a hello is required
    """
    if content.get("type") != "hello":
        kind = str(content.get("type"))[:40]
        raise WireError("hello-first", f"the first message is of the type {kind!r}, a hello is required")
    try:
        hello = Hello.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))[:120] or "the message"
        raise WireError("malformed", f"hello: {place}: {first['msg']}") from None
    if hello.control and 0.0 < hello.rate_hz < CONTROL_RATE_LEAST_HZ:
        raise WireError(
            "malformed",
            f"hello: rate_hz: commands need {CONTROL_RATE_LEAST_HZ:g} Hz or more, or 0: one at each message",
        )
    for stream, channels in hello.streams.items():
        if len(set(channels)) < len(channels):
            raise WireError("malformed", f"hello: stream {stream!r} names a channel twice")
    return hello


def welcome(
    hello: Hello, chain: RobotSession, restored: LiveState | None, limits: dict[str, float]
) -> dict[str, Any]:
    """Return the answer to a hello."""
    known = restored and {
        "age_s": max(time() - restored.saved_s, 0.0),
        "biases": sorted(restored.biases),
        "terrain": restored.terrain or None,
    }
    return {
        "type": "welcome",
        "protocol": PROTOCOL,
        "session": hello.session,
        "rate_hz": hello.rate_hz,
        "control": hello.control,
        "command_valid_s": COMMAND_VALID_S,
        "served": served_content(chain.served),
        "recording": chain.recording,
        "restored": known,
        "limits": limits,
    }


def served_content(served: Served) -> dict[str, Any]:
    """Return which model and table are used."""
    return {
        "number": served.number,
        "model": served.model_name or None,
        "classes": [] if served.model is None else list(served.model.info.classes),
        "table": served.table.name,
    }


def step_content(output: StepOutput) -> dict[str, Any]:
    """Return the message of a step."""
    seen, command = output.observation, output.command
    observation = seen._asdict() | {
        "terrain": seen.terrain or None,
        "window": None if seen.window is None else _window_content(seen.window),
        "target_slip": {
            state: {"slip_ratio": one.slip_ratio, "slip_std": one.slip_std, "status": str(one.status)}
            for state, one in seen.target.items()
        },
        "target_of": next(iter(seen.target.values())).terrain,
    }
    del observation["target"]
    content = {
        "type": "step",
        "time_s": output.time_s,
        "number": output.number,
        "message": output.message,
        "latency_s": output.latency_s,
        "observation": observation,
    }
    if command is None:
        return content
    code = int(command.status.get("status_code", TractionStatus.UNSOUND))
    return content | {
        "command": {
            "status": output.status.value,
            "traction": TractionStatus(code).label,
            "valid_s": COMMAND_VALID_S,
            "wheel_radps": command.wheel_radps,
            "steer_rad": command.steer_rad,
            "twist": command.twist,
        }
    }


def _window_content(window: WindowOutput) -> dict[str, Any]:
    return {
        "start_s": window.start_s,
        "end_s": window.end_s,
        "terrain": window.terrain or None,
        "probabilities": dict(zip(window.classes, window.probabilities.tolist(), strict=True)),
        "refused": window.refused or None,
        "nearest": window.nearest or None,
        "novelty": window.novelty,
        "supported": window.supported,
    }


def error_content(code: str, sentence: str, *, fatal: bool = False) -> dict[str, Any]:
    """Return the message of an error; after a fatal one the connection is closed."""
    return {"type": "error", "code": code, "message": sentence, "fatal": fatal}
