"""Records: named numbers and arrays that compiled functions take, and write in place, as one argument.

A record is one element of a structured array.  What a plant, a filter, a controller or an observer is made of
(parameters), remembers (state) and takes at a step (row) is one record each, so that a step reads
``step(params[0], state[0], row[0], dt_s)``, a snapshot is a copy of the array, and no number has a place.  From
Python pass the arrays, and take their elements 0 in compiled code: numba knows an array's type at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from terrain.records import Array


def record(fields: Mapping[str, Any]) -> np.dtype[Any]:
    """Return the type of a record.

    Parameters
    ----------
    fields : by name ``float``, ``int``, ``bool``, another record, or any of these with a shape, as
        ``(float, 3)`` or ``(LINE, 29)``; flags are of a byte each, as compiled code has no arrays of bits

    Examples
    --------
    >>> wheel = record({"speed_mps": float, "forces_n": (float, 2)})
    >>> robot = record({"wheels": (wheel, 3), "time_s": float})
    >>> filled(robot, np.nan)[0]["wheels"][1]["forces_n"]
    array([nan, nan])
    """
    pairs = ((name, field if isinstance(field, tuple) else (field, ())) for name, field in fields.items())
    return np.dtype(
        [(name, np.uint8 if kind is bool else kind, shape) for name, (kind, shape) in pairs], align=True
    )


def numbers(names: str) -> dict[str, Any]:
    """Return the fields of a record that are one number each, from their names in a row.

    Examples
    --------
    >>> record(numbers("x_m y_m") | {"n": int}).names
    ('x_m', 'y_m', 'n')
    """
    return dict.fromkeys(names.split(), float)


def filled(fields: np.dtype[Any], value: float = 0.0, **values: Any) -> Array:
    """Return a structured array (1,) of one record, for a compiled function to take its element 0.

    Parameters
    ----------
    fields : type of the record
    value : of all numbers that are not whole; whole ones and flags are 0
    values : by name, in place of it

    Examples
    --------
    >>> filled(record({"speed_mps": float, "n": int}), speed_mps=2.0)[0].item()
    (2.0, 0)
    """
    one = np.zeros(1, fields)
    if value != 0.0:
        _fill(one, value)
    for name, given in values.items():
        one[name] = given
    return one


def _fill(array: Array, value: float) -> None:
    if array.dtype.names is None:
        if array.dtype.kind == "f":
            array[...] = value
        return
    for name in array.dtype.names:
        _fill(array[name], value)


def is_finite(array: Array) -> bool:
    """Return whether all numbers of a structured array are finite.

    Examples
    --------
    >>> is_finite(filled(record({"speed_mps": float, "n": int}))), is_finite(filled(record({"x_m": float}), np.nan))
    (True, False)
    """
    if array.dtype.names is None:
        return bool(np.isfinite(array).all())
    return all(is_finite(array[name]) for name in array.dtype.names)
