"""Compares two results of :mod:`behaviour.record`: what was computed, and not how it is worded.

Numbers and the strings that are data must be the same; sentences may change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

IGNORED: dict[str, str] = {
    "seconds": "time that computing took",
    "elapsed_s": "time that computing took",
    "latency_ms": "time that computing took",
    "onnx_latency_ms": "time that computing took",
    "times_real_time": "how fast computing was",
    "created": "time of writing",
    "model.skops": "size of a compressed file that holds names of its parts drawn anew",
    "commit": "state of the code",
    "data_digest": "the last bit of one sample changes it; the samples are compared themselves",
    "digest": "the last bit of one sample changes it; the samples are compared themselves",
    "measured_digest": "the last bit of one sample changes it; the samples are compared themselves",
    "measured_digests": "the last bit of one sample changes it; the samples are compared themselves",
    "run_accuracy": "by digest; the accuracy of each run is that of the evaluation",
}
"""Keys whose values are not compared, and why; the keys have to be there."""

PROSE_KEYS = frozenset(
    (
        *("about", "alias_reason", "bar", "because", "counted", "experiment", "lead"),
        *("needs", "note", "notes", "printed", "reason", "reasons", "source", "statement", "title"),
        *("what", "where", "why"),
    )
)
"""Keys whose strings are prose even where they are a single word."""

DATA_KEYS = frozenset({"h2", "options", "status", "verdict"})
"""Keys whose strings are data even where they have a space."""

KEYED: dict[str, str] = {"importance": "feature"}
"""Lists of records in an order that ties leave open, and the key that tells their records apart."""

STATISTICS = frozenset({"n", "nan", "sum", "sum_sq", "first", "last"})
"""Keys of what is kept of a long list of numbers."""

TOLERANCE = 1e-9  #: Relative
TINY = 1e-12  #: Absolute: what should be 0 and is rounding

LOOSE: dict[str, dict[str, float]] = {
    "calibrate": {"/steps/05/json": 1e-6},
    "observers": {
        "/files/slip.yaml": 2e-2,
        "/steps/04/json": 1e-2,
        "/files/learning": 1e-4,
        "/steps/05/json": 1e-4,
        "/steps/02/json": 1e-5,
    },
    "estimate_swerve": {"/steps/04/json": 2e-3},
    "slip": {
        "/files/table.yaml/terrains/grass/curve": 2e-3,
        "/steps/01/json/terrains/grass/energy_jpm": 2e-3,
    },
    "testbed": {"/steps/03/json": 2e-2},
}
"""By case, the paths that are compared by a relative tolerance of their own.

In ``estimate_swerve`` step 4 is the tuning ``likelihood``: its search stops where the likelihood is flat, so
that rounding of 1e-13 in the measurements moves the scale of the gyro's bias by 1e-3, and figures by 1e-6.
In ``testbed`` the fits of step 3 end where the sum of squares changes by 1e-5.  ``calibrate``, ``observers`` and
``slip``: fits and filters round otherwise on another processor."""

_RANDOM_ID = re.compile(r"[0-9a-f]{32}|[0-9a-f]{40}|[0-9a-f]{64}")


def differences(expected: Any, actual: Any, path: str = "", key: str = "") -> list[str]:
    """Return a line for each difference of what JSON can hold; the last key of a path decides what a string is."""
    if key in IGNORED:
        return []
    if isinstance(expected, Mapping) and isinstance(actual, Mapping):
        if set(expected) == STATISTICS == set(actual):
            return _of_statistics(expected, actual, path)
        return _of_mappings(expected, actual, path, key)
    if isinstance(expected, list) and isinstance(actual, list):
        return _of_lists(expected, actual, path, key)
    same = _same_leaf(expected, actual, key)
    return [] if same else [f"{path or 'all'}: {_short(expected)} was expected, it is {_short(actual)}"]


def settled(
    expected: Any, actual: Any, loose: Mapping[str, float], path: str = "", tolerance: float = 0.0
) -> Any:
    """Return the actual result, with numbers of loosely compared paths replaced where they are close."""
    tolerance = next((width for place, width in loose.items() if path.startswith(place)), tolerance)
    if isinstance(expected, Mapping) and isinstance(actual, Mapping):
        return {
            name: settled(expected.get(name), value, loose, f"{path}/{name}", tolerance)
            for name, value in actual.items()
        }
    if isinstance(expected, list) and isinstance(actual, list) and len(expected) == len(actual):
        pairs = enumerate(zip(expected, actual, strict=True))
        return [settled(one, other, loose, f"{path}/{i:02d}", tolerance) for i, (one, other) in pairs]
    numbers = isinstance(expected, float) and isinstance(actual, float)
    return expected if numbers and math.isclose(expected, actual, rel_tol=tolerance) else actual


def is_prose(text: str, key: str = "") -> bool:
    """Return whether a string is worded freely.

    Examples
    --------
    >>> is_prose("the runs show nothing of it"), is_prose("as printed", "verdict")
    (True, False)
    """
    return key not in DATA_KEYS and (key in PROSE_KEYS or " " in text)


def _same_leaf(expected: Any, actual: Any, key: str) -> bool:
    if isinstance(expected, str) and isinstance(actual, str):
        return _same_text(expected, actual, key)
    if isinstance(expected, bool) or isinstance(actual, bool):
        return expected is actual
    if isinstance(expected, int | float) and isinstance(actual, int | float):
        if math.isnan(expected) or math.isnan(actual):
            return math.isnan(expected) and math.isnan(actual)
        return math.isclose(expected, actual, rel_tol=TOLERANCE, abs_tol=TINY)
    return type(expected) is type(actual) and bool(expected == actual)


def _same_text(expected: str, actual: str, key: str) -> bool:
    if _RANDOM_ID.fullmatch(expected):
        return _RANDOM_ID.fullmatch(actual) is not None
    if is_prose(expected, key):
        return bool(expected) == bool(actual)  # a reason must not be lost, nor come from nowhere
    return expected == actual


def _of_mappings(expected: Mapping[str, Any], actual: Mapping[str, Any], path: str, key: str) -> list[str]:
    lines = []
    for name in expected:
        if name in actual:
            # the values of a table that goes by names of its own belong to the table
            of = name if not isinstance(expected[name], str) or key not in PROSE_KEYS else key
            lines += differences(expected[name], actual[name], f"{path}/{name}", of)
    missing = [name for name in expected if name not in actual]
    added = [name for name in actual if name not in expected]
    for name in list(missing):
        if " " in name:  # a key that is prose: its value has to be there, under whatever words
            same = [other for other in added if not differences(expected[name], actual[other])]
            if same:
                missing.remove(name)
                added.remove(same[0])
    lines += [f"{path}/{name}: is missing; {_short(expected[name])} was expected" for name in missing]
    lines += [f"{path}/{name}: was not expected; it is {_short(actual[name])}" for name in added]
    return lines


def _of_lists(expected: Sequence[Any], actual: Sequence[Any], path: str, key: str) -> list[str]:
    name = KEYED.get(key)
    if name is not None:
        one, other = ({str(row.get(name)): row for row in rows} for rows in (expected, actual))
        return _of_mappings(one, other, path, key)
    if len(expected) != len(actual):
        return [f"{path}: {len(expected)} entries were expected, there are {len(actual)}: {_short(actual)}"]
    return [
        line
        for i, (one, other) in enumerate(zip(expected, actual, strict=True))
        for line in differences(one, other, f"{path}/{i}", key)
    ]


def _of_statistics(expected: Mapping[str, Any], actual: Mapping[str, Any], path: str) -> list[str]:
    size = math.sqrt(expected["n"] * expected["sum_sq"])  # a sum that cancels is as accurate as its summands
    found = []
    for name in sorted(STATISTICS):
        close = name == "sum" and abs(expected[name] - actual[name]) <= TOLERANCE * size
        if not close:
            found += differences(expected[name], actual[name], f"{path}/{name}", name)
    return found


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 400 else f"{text[:400]}..."
