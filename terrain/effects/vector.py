"""The parameters as a vector, as the simulation's compiled kernels take them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from terrain.effects.catalogue import PARAMETER, TILT_OFFSETS
from terrain.errors import ConfigError
from terrain.kernels import record
from terrain.records import Array

PARAMETERS: tuple[str, ...] = (*PARAMETER, *(p.name for p in TILT_OFFSETS))
"""Order of the numbers in the vector."""

INDEX: dict[str, int] = {name: i for i, name in enumerate(PARAMETERS)}
"""Place of each parameter in the vector."""

EFFECTS = record(dict.fromkeys(PARAMETERS, float))
"""The vector as a record: ``vector.view(EFFECTS)[0]`` has the parameters by name."""


def vector_of(values: Mapping[str, float]) -> Array:
    """Return the numbers (len(PARAMETERS),) of a simulation, 0 where none is given.

    Raises
    ------
    ConfigError
        for an unknown parameter, or a value that is not finite.
    """
    vector = np.zeros(len(PARAMETERS))
    for name, value in values.items():
        if name not in INDEX or not math.isfinite(value):
            raise ConfigError(
                f"effects: {name} is {value!r}; a finite number of a known parameter is required"
            )
        vector[INDEX[name]] = value
    return vector
