"""How far runs deviate from the simulation of an extended robot: the band about its replay.

Of a channel, measured minus simulated behind one low-pass has the standard deviation::

    s(v, w)^2 = at_rest^2 + (per_speed v)^2 + (per_turn w)^2

with the speed ``v`` of the wheels and the difference ``w`` of those of the two sides, m/s both (``speed_mps`` or, of
omni wheels, with ``sideways_mps``, and ``turn_mps`` of :data:`terrain.discrepancy.runs.INPUTS`): a robot that stands is
quiet.  Within ``times_95 s`` lie 95 % of the rows of a further run.  That factor is a quantile of ``|r| / s`` of runs
that were left out of the fit in turn, as tails are heavy (jackknife: Barber, Candes, Ramdas and Tibshirani, Annals of
Statistics 2021), and larger where few runs differ from one to the next.

The section ``deviation`` of a robot's description::

    deviation:
      schema: 1
      low_pass: {cutoff_hz: 2.5, rate_hz: 6.25}
      channels:
        yaw_rate_radps: {at_rest: 0.01, per_speed: 0.02, per_turn: 0.03, times_95: 2.2, n_runs: 24}

``low_pass`` is that of the fitted rows, and their rate; ``n_runs`` is the number of runs, or of sessions where there
are several, that were left out in turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import yaml

from terrain.effects import CHANNELS
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, is_number
from terrain.files.names import shown
from terrain.records import Array

SCHEMA = 1  #: Version of the section that is read and written.


class ChannelDeviation(NamedTuple):
    """Deviation of a channel, in its unit."""

    at_rest: float  #: standard deviation at rest
    per_speed: float  #: per m/s of the speed of the wheels
    per_turn: float  #: per m/s of right minus left wheel speed
    times_95: float  #: half of the 95 % interval, in standard deviations
    n_runs: int  #: that were left out in turn; sessions where there are several

    def std(self, speed_mps: Array, turn_mps: Array) -> Array:
        """Return the standard deviation (m,) at speeds and turns (m,) of the wheels.

        Examples
        --------
        >>> ChannelDeviation(0.3, 0.0, 0.2, 2.0, 9).std(np.zeros(2), np.array([0.0, -2.0]))
        array([0.3, 0.5])
        """
        square = self.at_rest**2 + (self.per_speed * speed_mps) ** 2 + (self.per_turn * turn_mps) ** 2
        return np.asarray(np.sqrt(square))

    def half_95(self, speed_mps: Array, turn_mps: Array) -> Array:
        """Return half of the 95 % interval (m,) of measured minus simulated."""
        return self.times_95 * self.std(speed_mps, turn_mps)


@dataclass(frozen=True, slots=True)
class Deviation:
    """Deviation from a robot's simulation, by channel, behind a low-pass.

    ``ConfigError`` for a channel that is unknown, or a number that is not accepted.
    """

    cutoff_hz: float  #: of the low-pass
    rate_hz: float  #: of its rows
    channels: Mapping[str, ChannelDeviation]

    def __post_init__(self) -> None:
        if not (0.0 < self.cutoff_hz < math.inf and 0.0 < self.rate_hz < math.inf):
            raise ConfigError(f"deviation: {self.cutoff_hz:g} and {self.rate_hz:g} Hz are no low-pass")
        for name, of in self.channels.items():
            if name not in CHANNELS:
                raise ConfigError(
                    f"deviation: the channel {shown(name)} is unknown, one of {', '.join(CHANNELS)} is required"
                )
            stds, factor = of[:3], of.times_95
            if (
                not all(0.0 <= each < math.inf for each in stds)
                or not any(stds)
                or not 0.0 < factor < math.inf
            ):
                raise ConfigError(
                    f"deviation: {name}: its numbers are {', '.join(f'{each:g}' for each in of[:4])}; deviations "
                    "from 0 up, not all 0, and a factor above 0 are required"
                )


def read_deviation(place: str, described: Any) -> Deviation:
    """Return the deviation of a section; ``place`` is file and section, as messages name them.

    Raises
    ------
    ConfigError
        if the schema is newer, a key is unknown or missing, or a number is not accepted.
    """
    check_keys(place, described, ["schema", "low_pass", "channels"])
    schema, low_pass, channels = (described[key] for key in ("schema", "low_pass", "channels"))
    if isinstance(schema, bool) or not isinstance(schema, int) or not 1 <= schema <= SCHEMA:
        raise ConfigError(f"{place}: schema is {shown(schema)}; this version of terrain reads {SCHEMA}")
    check_keys(f"{place}: low_pass", low_pass, ["cutoff_hz", "rate_hz"])
    if not isinstance(channels, dict) or not all(isinstance(name, str) for name in channels):
        raise ConfigError(f"{place}: channels are {shown(channels)}, a deviation by channel is required")
    for name, entry in channels.items():
        check_keys(f"{place}: {name}", entry, list(ChannelDeviation._fields))
    numbers = [*low_pass.values(), *[each for entry in channels.values() for each in entry.values()]]
    for number in numbers:
        if not is_number(number):
            raise ConfigError(f"{place}: {shown(number)} is no finite number")
    of = {}
    for name, entry in channels.items():
        rest, speed, turn, times_95, n_runs = [float(entry[key]) for key in ChannelDeviation._fields]
        of[name] = ChannelDeviation(rest, speed, turn, times_95, int(n_runs))
    try:
        return Deviation(float(low_pass["cutoff_hz"]), float(low_pass["rate_hz"]), of)
    except ConfigError as error:
        raise ConfigError(f"{place.removesuffix(': deviation')}: {error}") from error


def deviation_lines(deviation: Deviation | None) -> list[str]:
    """Return the lines of a section ``deviation``; none where it is not known."""
    if deviation is None or not deviation.channels:
        return []
    section = {
        "schema": SCHEMA,
        "low_pass": {"cutoff_hz": _rounded(deviation.cutoff_hz), "rate_hz": _rounded(deviation.rate_hz)},
        "channels": {
            name: {**dict(zip(of._fields[:4], map(_rounded, of[:4]), strict=True)), "n_runs": of.n_runs}
            for name, of in deviation.channels.items()
        },
    }
    text = yaml.safe_dump({"deviation": section}, sort_keys=False, default_flow_style=None, width=110)
    return str(text).rstrip().splitlines()


def _rounded(value: float) -> float:
    return float(f"{value:.7g}")
