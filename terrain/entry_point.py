"""Compiled functions without numba's dispatch, for loops that cannot wait."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def entry_point(kernel: Any) -> Callable[..., Any]:
    """Return the machine code of a function compiled for one signature.

    A call does not look up the types of its arguments, which takes longer than most steps: it is the caller
    who sees to it that they are those of the signature.

    Parameters
    ----------
    kernel : decorated by ``njit`` with one signature

    Examples
    --------
    >>> from numba import float64, njit
    >>> entry_point(njit(float64(float64))(lambda x: 2.0 * x))(1.5)
    3.0
    """
    (compiled,) = kernel.overloads.values()
    return compiled.entry_point  # type: ignore[no-any-return]
