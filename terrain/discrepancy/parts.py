"""Values of named causes in parts of the data: whether each is one number shows at a glance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.answers import INTERVAL_T
from terrain.discrepancy.constancy import constancy_of
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.verdict import Cause, Value


class Part(NamedTuple):
    """A value in a part of the data, and half its 95 % interval; NaN where that part does not show it."""

    name: str
    value: float
    half: float


class PartValues(NamedTuple):
    """A value of a named cause, and that of thirds of the time and halves of the runs."""

    value: Value
    parts: tuple[Part, ...]


def part_values(info: Evidence, causes: Sequence[Cause]) -> tuple[PartValues, ...]:
    """Return the values of named causes by thirds of the time and halves of the runs.

    Parameters
    ----------
    info : around the simulation with the causes built in
    causes : named
    """
    names = [value.name for cause in causes for value in cause.values]
    found = []
    for cause in causes:
        own = [value.name for value in cause.values]
        inflation = max(cause.dispersion, 1.0) if math.isfinite(cause.dispersion) else 1.0
        constant = constancy_of(info, names, own, np.zeros(len(names)), inflation)
        for k, value in enumerate(cause.values):
            found.append(
                PartValues(
                    value,
                    tuple(
                        Part(
                            group.name, value.value + float(group.values[k]), INTERVAL_T * float(group.std[k])
                        )
                        for group in (*constant.thirds, *constant.halves)
                    ),
                )
            )
    return tuple(found)
