"""Calibration results: the value of one parameter of a robot's description, or why it is undetermined."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Finding(NamedTuple):
    """One parameter estimated from logs; ``value`` is NaN where it is undetermined, and ``note`` says why."""

    parameter: str  #: place in the description, ``sensors.gyro_bias_z_radps``
    value: float  #: the number and its 95 % interval
    low: float
    high: float
    n: int  #: how many of what it rests on (12, ``"stretches"``)
    counted: str
    runs: tuple[str, ...]  #: ids of the runs used
    note: str = ""  #: what is assumed; or why the value is undetermined
    unit: str = ""  #: of the number, and its value before; None where the description has no such number
    described: float | None = None

    @property
    def determined(self) -> bool:
        """Whether the logs determine the value."""
        return math.isfinite(self.value)


def undetermined(parameters: Sequence[str], reason: str) -> list[Finding]:
    """Return a finding without a value for each parameter."""
    return [Finding(name, math.nan, math.nan, math.nan, 0, "", (), reason) for name in parameters]


def around(
    parameter: str, value: float, half: float, n: int, counted: str, runs: Iterable[str], note: str = ""
) -> Finding:
    """Return a finding whose interval is ``half`` on either side of its value; runs may repeat."""
    ends = float(value), float(value - half), float(value + half)
    return Finding(parameter, *ends, n, counted, tuple(dict.fromkeys(runs)), note)
