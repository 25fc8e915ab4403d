"""Calibration results: the value of one parameter of a robot's description, or why it is undetermined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.identify import half_width, std_interval
from terrain.records import Array


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
    parameter: str, value: float, half: float, n: int, counted: str, runs: tuple[str, ...], note: str = ""
) -> Finding:
    """Return a finding whose interval is ``half`` on either side of its value."""
    return Finding(parameter, float(value), float(value - half), float(value + half), n, counted, runs, note)


def biases(
    parameters: Sequence[str],
    std_parameter: str,
    found: Array,
    variance: Array,
    described_std: float,
    n: int,
    counted: str,
    runs: tuple[str, ...],
) -> list[Finding]:
    """Predict the biases of future power-ons, and their scatter, from those of single power-ons.

    Found are (k, 3) biases in each power-on, each run one, with the variances of their errors; the described scatter is
    taken for true where there is one alone.  However well a bias is known in one power-on, the scatter limits how well
    it predicts the next one.  The axes share one scatter, as the description has it: k power-ons give 3 (k - 1)
    degrees of freedom.
    """
    k = len(found)
    mean = found.mean(axis=0)
    note = "each run is taken for a power-on"
    if k == 1:
        note = f"one power-on: the next differs by {described_std:g}, as described"
        half = half_width(np.sqrt(variance[0] + described_std**2), math.inf)
        between = math.nan
    else:
        between = float(((found - mean) ** 2).sum() / (3 * (k - 1)))
        half = np.broadcast_to(half_width(math.sqrt(between / k), 3 * (k - 1)), 3)
    found_biases = [
        around(name, mean[i], half[i], n, counted, runs, note) for i, name in enumerate(parameters)
    ]
    if k < MIN_POWER_ONS:
        return found_biases + undetermined(
            [std_parameter], f"{k} power-ons: {MIN_POWER_ONS} at least show how much they differ"
        )
    # What a single power-on's own error adds to the scatter is taken off.
    low, std, high = (
        math.sqrt(max(edge**2 - float(variance.mean()), 0.0))
        for edge in sorted((*std_interval(between, 3 * (k - 1)), math.sqrt(between)))
    )
    return [*found_biases, Finding(std_parameter, std, low, high, k, "power-ons", runs, note)]


MIN_POWER_ONS = 3  #: From two, the upper end of a scatter's interval is four times the scatter.
