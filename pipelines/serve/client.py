"""A client of the live service, for a robot's own program.

It needs ``websockets`` and ``msgpack`` and nothing else of the service::

    with TerrainClient("ws://127.0.0.1:8765", "mower-1", "husky", streams, rate_hz=10.0) as client:
        client.send({"imu": (stamps, rows)})
        step = client.latest()
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from time import monotonic
from typing import Any, Self

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.sync.client import connect

from pipelines.serve.wire import WireError, decode, encode
from terrain.errors import TerrainError

MAX_ERRORS = 100

TIMEOUT_S = 10.0  #: For the connection, and for a step that is waited for


class ServiceError(WireError):
    """The service refused something, or cannot be reached: a code for programs, and a sentence."""


class TerrainClient:
    """One robot's connection to the live service, in MessagePack.

    Parameters
    ----------
    url : ``ws://HOST:PORT`` of the service
    session : name of the robot, one a connection
    robot : name of its description
    streams : channels of each stream that is sent, in the order of the columns
    control : whether commands are asked for
    follows : whether the robot does what is commanded, and is compared with it; False where another controller drives
    rate_hz : of the steps that come back; 0 for one at each message that asks for it
    token : that the service requires
    record : whether the session is recorded there

    Attributes
    ----------
    welcome : the service's answer to the hello
    errors : the last errors that it sent
    n_steps : number of steps that came

    Raises
    ------
    ServiceError
        if the service cannot be reached (code ``unreachable``) or refuses the session.
    """

    def __init__(
        self,
        url: str,
        session: str,
        robot: str,
        streams: Mapping[str, Sequence[str]],
        *,
        control: bool = False,
        follows: bool = True,
        rate_hz: float = 10.0,
        token: str = "",
        record: bool = False,
    ) -> None:
        self._steps: deque[tuple[float, dict[str, Any]]] = deque(maxlen=1)
        self._came = threading.Condition()
        self._closed: ServiceError | None = None
        self._newest_s = -math.inf  # of the last samples: a clock may be set back
        self.errors: deque[dict[str, Any]] = deque(maxlen=MAX_ERRORS)
        self.n_steps = 0
        with ExitStack() as leaving:
            try:
                connecting = connect(
                    f"{url.rstrip('/')}/robots",
                    open_timeout=TIMEOUT_S,
                    compression=None,
                    max_size=None,
                    additional_headers={"Authorization": f"Bearer {token}"} if token else None,
                )
                self._socket = leaving.enter_context(connecting)
            except InvalidStatus as error:
                code = "token" if error.response.status_code == 401 else "refused"
                raise ServiceError(code, error.response.body.decode(errors="replace").strip()) from None
            except (OSError, TimeoutError, InvalidURI, InvalidHandshake, ValueError) as error:
                raise ServiceError("unreachable", f"{url}: cannot be reached ({error})") from None
            hello = {"type": "hello", "protocol": 2, "session": session, "robot": robot, "control": control}
            hello |= {"follows": follows, "rate_hz": rate_hz, "record": record}
            self._send(hello | {"streams": dict(streams)})
            try:
                self.welcome = decode(self._socket.recv(TIMEOUT_S))
            except (ConnectionClosed, TimeoutError) as error:
                raise ServiceError("unreachable", f"{url}: did not answer ({error})") from None
            if self.welcome.get("type") != "welcome":
                raise ServiceError(str(self.welcome.get("code")), str(self.welcome.get("message")))
            self._leaving = leaving.pop_all()
        self._reader = threading.Thread(target=self._read, name="terrain client", daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def send(
        self,
        streams: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float]]]],
        twist: Sequence[float] | None = None,
        *,
        step: bool = False,
        time_s: float | None = None,
    ) -> None:
        """Send samples, and the desired motion.

        Parameters
        ----------
        streams : by name, stamps ``(k,)`` and rows ``(k, channels)``; NaN or None where nothing was measured
        twist : desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``; it holds for half a second
        step : ask for a step now, where the session has no rate
        time_s : of that step, on the clock of the stamps; by default that clock's time now, as far as known

        Raises
        ------
        ServiceError
            if the connection has ended.
        """
        samples = {"type": "samples", "streams": dict(streams), "twist": twist}
        self._send(samples | {"step": step, "time_s": time_s})
        stamps = [float(stamp) for stamps, _ in streams.values() for stamp in stamps if stamp is not None]
        self._newest_s = max((stamp for stamp in stamps if math.isfinite(stamp)), default=self._newest_s)

    def latest(self, max_age_s: float | None = None) -> dict[str, Any] | None:
        """Return the newest step; None before the first, and where it is older than an age.

        It is old where it came so long ago, or where samples that much newer than its time have been sent.

        Parameters
        ----------
        max_age_s : by default a command's time of validity
        """
        age_s = float(self.welcome["command_valid_s"]) if max_age_s is None else max_age_s
        with self._came:
            if not self._steps:
                return None
            came_s, step = self._steps[-1]
        of_s = step["time_s"]
        late = of_s is not None and self._newest_s - of_s > age_s
        return None if late or monotonic() - came_s > age_s else step

    def step(self, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """Wait for a step that has not been returned by this method yet.

        Raises
        ------
        ServiceError
            if none comes in time (code ``timeout``), or the connection has ended.
        """
        with self._came:
            self._came.wait_for(lambda: self._steps or self._closed, timeout_s)
            if not self._steps:
                raise self._closed or ServiceError("timeout", "the service gave no step in time")
            return self._steps.pop()[1]

    def close(self) -> None:
        """End the session."""
        with suppress(ServiceError):
            self._send({"type": "bye"})
        self._leaving.close()
        self._reader.join(TIMEOUT_S)

    def _send(self, content: dict[str, Any]) -> None:
        try:
            self._socket.send(encode(content, packed=True))
        except ConnectionClosed as error:
            raise self._closed or ServiceError("closed", f"the connection has ended ({error})") from None

    def _read(self) -> None:
        reason = ""
        try:
            for message in self._socket:
                content = decode(message)
                with self._came:
                    if content.get("type") == "step":
                        self._steps.append((monotonic(), content))
                        self.n_steps += 1
                    elif content.get("type") == "error":
                        self.errors.append(content)
                        if content.get("fatal"):
                            self._closed = ServiceError(content["code"], content["message"])
                    self._came.notify_all()
        except (ConnectionClosed, TerrainError, OSError) as error:
            reason = f" ({error})"
        finally:
            with self._came:
                self._closed = self._closed or ServiceError("closed", f"the connection has ended{reason}")
                self._came.notify_all()
