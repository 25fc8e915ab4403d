"""What is found before robots may come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServiceCheck:
    """What would be served.

    Parameters
    ----------
    model : as it was named
    classes, channels, rate_hz, filter, robots : of the model
    table : of target slips, by name
    robot : that model and table were checked against; None without one
    """

    model: str
    classes: tuple[str, ...]
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    filter: str
    robots: tuple[str, ...]
    table: str
    robot: str | None
