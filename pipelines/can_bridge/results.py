"""What a bridge did, from its start to its stop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Latency:
    """Times in ms: None where there was none."""

    median_ms: float | None
    p99_ms: float | None


@dataclass(frozen=True, slots=True)
class BridgeReport:
    """What a bridge did.

    Parameters
    ----------
    interface, channel, dbc, robot : of the session
    duration_s : from its start to its stop
    frames_in, frames_used, frames_out : received, of signals that are used, sent
    samples : by stream
    dropped : what was not used, as counts by kind
    bus_errors : by message
    clipped : values sent as the end of their range, by signal
    states : control steps by state of the bridge
    ticks_missed : control steps that were left out as one before took too long
    wheels_to_correction : from the first frame of the wheels' newest sample to the correction sent
    step : of a control step
    """

    interface: str
    channel: str
    dbc: str
    robot: str
    duration_s: float
    frames_in: int
    frames_used: int
    frames_out: int
    samples: Mapping[str, int]
    dropped: Mapping[str, int]
    bus_errors: Mapping[str, int]
    clipped: Mapping[str, int]
    states: Mapping[str, int]
    ticks_missed: int
    wheels_to_correction: Latency
    step: Latency
