"""Compares two results of :mod:`behaviour.record`: what was computed, and not how it is worded.

Numbers and the strings that are data must be the same; sentences may change.  A key or a name that was
changed on purpose is entered in one of the two tables below; the old one is then still accepted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

ALIASES: dict[str, str] = {
    "ours": "simulated",
    "taught_runs": "training_runs",
    "grounds": "terrain_matches",
    "share": "residual_ratio",
    "felt_ratio": "effective_ratio",
    "why_ratio": "status_code",
    "leg_play_rad": "leg_backlash_rad",
    "fixed": "fallback",
    "learned": "classified",
    "oracle": "true_terrain",
    "oracle+track": "true_terrain+track",
    "told:grass": "known:grass",
    "told:clay": "known:clay",
    **{
        f"run_{old}.{kind}": f"run_{new}.{kind}"
        for old, new in {
            "fixed": "fallback",
            "learned": "classified",
            "oracle": "true_terrain",
            "oracle_track": "true_terrain_track",
            "told_grass": "known_grass",
        }.items()
        for kind in ("png", "svg")
    },
}
"""Old key of JSON, old name of a file, stream or channel: the new one.  At any depth."""

ALIASES_OF_VALUES: dict[str, str] = {
    "--leg-play": "--leg-backlash",
    "The first day, run by run": "The first seed, run by run",
    "fixed": "fallback",
    "learned": "classified",
    "oracle": "true_terrain",
    "oracle+track": "true_terrain+track",
    "told:grass": "known:grass",
    "told:clay": "known:clay",
    "What it follows": "What it depends on",
    "Gain, on runs that had no say in it": "Gain on held-out runs",
    "What would not have been seen": "What would not have been detected",
    "Not told apart": "Not distinguished",
    "Without a name": "Unexplained",
    "The paper's figure beside ours": "The paper's figure beside the simulation's",
    "steering_play": "steering_backlash",
    "steering_play_rad": "steering_backlash_rad",
}
"""Old string that is data, or old heading of a page: the new one."""

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

TOLERANCE = 1e-9
"""Relative."""

TINY = 1e-12
"""Absolute: what should be 0 and is rounding."""

LOOSE: dict[str, dict[str, float]] = {
    "estimate_swerve": {"/steps/05/json": 2e-3},
    "testbed": {"/steps/03/json": 2e-2},
    "bench": {"/steps/00/json": 1.0},
}
"""By case, the paths that are compared by a relative tolerance of their own.

In ``estimate_swerve`` step 5 is the tuning ``likelihood``: its search stops where the likelihood is flat, so
that rounding of 1e-13 in the measurements moves the scale of the gyro's bias by 1e-3, and figures by 1e-6.
In ``testbed`` the fits of step 3 end where the sum of squares changes by 1e-5.
In ``bench`` they are what the machine gives: that they are there and above zero is compared."""

_RANDOM_ID = re.compile(r"[0-9a-f]{32}|[0-9a-f]{40}|[0-9a-f]{64}")


def differences(expected: Any, actual: Any, path: str = "", key: str = "") -> list[str]:
    """Return a line for each difference; none where the results agree.

    Parameters
    ----------
    expected, actual : what JSON can hold
    path : where in the whole, for the lines
    key : the last key of that path, which decides what a string is
    """
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
    return _today(expected) == _today(actual)


def _today(text: str) -> str:
    """Return a string of data by its new name; names by commas one by one."""
    if text in ALIASES_OF_VALUES:
        return ALIASES_OF_VALUES[text]
    return ",".join(ALIASES_OF_VALUES.get(part, part) for part in text.split(","))


def _of_mappings(expected: Mapping[str, Any], actual: Mapping[str, Any], path: str, key: str) -> list[str]:
    found = []
    for old, new in ALIASES.items():
        if old in actual and new in actual:  # both are written for a release
            found += differences(actual[old], actual[new], f"{path}/{new} beside {old}")
    required, there = _renamed(expected), _renamed(actual)
    for name in required:
        if name in there:
            # the values of a table that goes by names of its own belong to the table
            of = name if not isinstance(required[name], str) or key not in PROSE_KEYS else key
            found += differences(required[name], there[name], f"{path}/{name}", of)
    missing = [name for name in required if name not in there]
    added = [name for name in there if name not in required]
    for name in list(missing):
        if " " in name:  # a key that is prose: its value has to be there, under whatever words
            same = [other for other in added if not differences(required[name], there[other])]
            if same:
                missing.remove(name)
                added.remove(same[0])
    found += [f"{path}/{name}: is missing; {_short(required[name])} was expected" for name in missing]
    found += [f"{path}/{name}: was not expected; it is {_short(there[name])}" for name in added]
    return found


def _renamed(mapping: Mapping[str, Any]) -> dict[str, Any]:
    return {ALIASES.get(name, name): value for name, value in mapping.items()}


def _of_lists(expected: Sequence[Any], actual: Sequence[Any], path: str, key: str) -> list[str]:
    name = KEYED.get(key)
    if name is not None:
        one, other = ({_today(str(row.get(name))): row for row in rows} for rows in (expected, actual))
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
