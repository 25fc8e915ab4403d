"""Which version of a model is champion: of one robot, one set of channels and one set of classes.

The alias ``champion`` never goes to a model that cannot be compared with the present one, that was not better
or is not above chance.  A version that does not become champion is registered all the same.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import NamedTuple

from pipelines.models.results import ModelInfo

WIDE_INTERVAL = 0.2
"""Accuracies that differ by half of this cannot be distinguished where the 95 % interval is wider."""


class Scope(NamedTuple):
    """What models must have in common to be compared.

    Parameters
    ----------
    robots, classes : by name
    channels : streams, channels and rates (rounded to 5 %, which runs may differ by), as a digest
    window : rule by which windows are cut
    """

    robots: tuple[str, ...]
    classes: tuple[str, ...]
    channels: str
    window: str


class Standing(NamedTuple):
    """What the choice of the champion depends on.

    Parameters
    ----------
    version : of the model
    scope : None where the model cannot be loaded
    data_digest : of the training runs
    macro_f1 : of the cross-validation
    accuracy_ci : 95 % interval of its accuracy, over runs
    chance : accuracy of always predicting the most frequent class
    """

    version: str
    scope: Scope | None
    data_digest: str
    macro_f1: float
    accuracy_ci: tuple[float, float]
    chance: float


class Comparison(NamedTuple):
    """Two models on the same windows, of runs that neither was trained on when it predicted them.

    Parameters
    ----------
    n_runs : compared
    n_unknown : runs on which the champion cannot be judged
    champion, candidate : accuracy of each
    difference_ci : 95 % interval of candidate less champion, over runs
    """

    n_runs: int
    n_unknown: int
    champion: float
    candidate: float
    difference_ci: tuple[float, float]


def scope_of(info: ModelInfo) -> Scope:
    """Return what a model can be compared by."""
    streams = {
        name: [sorted(channels), f"{info.rate_hz[name]:.2g}"] for name, channels in info.channels.items()
    }
    digest = hashlib.sha256(json.dumps(streams, sort_keys=True).encode()).hexdigest()[:16]
    stride = info.window_s if info.stride_s is None else info.stride_s
    motion = "all motion" if info.steady is None else "steady motion"
    return Scope(
        tuple(sorted(info.robots)),
        tuple(sorted(info.classes)),
        digest,
        f"{info.window_s:g} s every {stride:g} s, {motion}",
    )


def weaknesses(accuracy_ci: tuple[float, float], chance: float) -> tuple[str, ...]:
    """Return in sentences why a figure must not be relied on, none where it may.

    Examples
    --------
    >>> for text in weaknesses((0.31, 0.48), 0.4):
    ...     print(text)
    the accuracy (95 % over runs: 31.0% to 48.0%) is not above chance,
        40.0% (always the most frequent class)
    >>> weaknesses((0.85, 0.95), 0.4)
    ()
    """
    low, high = accuracy_ci
    found = []
    if not low > chance:
        found.append(
            f"the accuracy (95 % over runs: {low:.1%} to {high:.1%}) is not above chance, {chance:.1%} "
            "(always the most frequent class)"
        )
    if not high - low <= WIDE_INTERVAL:
        found.append(
            f"the interval of the accuracy is {100 * (high - low):.0f} points wide: more runs are needed to "
            "rely on it"
        )
    return tuple(found)


def champion_decision(
    champion: Standing | None, candidate: Standing, compare: Callable[[], Comparison | None]
) -> tuple[bool, str]:
    """Return whether a candidate becomes champion, and why.

    Parameters
    ----------
    champion : the present one, None where there is none
    candidate : just trained
    compare : judges both on the candidate's data, None where that is impossible; called where data differ

    Examples
    --------
    >>> scope = Scope(("husky",), ("ice", "mud"), "ca3b", "2 s every 2 s, steady motion")
    >>> first = Standing("1", scope, "aa", 0.9, (0.85, 0.95), 0.5)
    >>> champion_decision(None, first, lambda: None)
    (True, 'first version')
    >>> champion_decision(first, first._replace(version="2", macro_f1=0.8), lambda: None)
    (False, 'macro F1 0.8000 is not better than 0.9000 of version 1 on the same data')
    >>> other = first._replace(version="2", scope=scope._replace(robots=("warthog",)))
    >>> champion_decision(first, other, lambda: None)
    (False, 'its robots are warthog, those of version 1 husky: choose another --name')
    """
    weak = weaknesses(candidate.accuracy_ci, candidate.chance)
    if weak and not candidate.accuracy_ci[0] > candidate.chance:
        return False, weak[0]
    remark = f"; {'; '.join(weak)}" if weak else ""
    if champion is None:
        return True, f"first version{remark}"
    if champion.scope is None:
        return True, f"version {champion.version} cannot be loaded{remark}"
    other = _difference(champion, candidate)
    if other:
        return False, f"{other}: choose another --name"
    if champion.data_digest == candidate.data_digest:
        comparison = f"{champion.macro_f1:.4f} of version {champion.version} on the same data"
        if candidate.macro_f1 > champion.macro_f1:
            return True, f"macro F1 {candidate.macro_f1:.4f} is better than {comparison}{remark}"
        return False, f"macro F1 {candidate.macro_f1:.4f} is not better than {comparison}"
    return _on_new_data(champion.version, compare(), remark)


def _difference(champion: Standing, candidate: Standing) -> str:
    """Return what two models differ in, empty where they can be compared."""
    theirs, own = champion.scope, candidate.scope
    if theirs is None or own is None:
        return ""
    for name in ("robots", "classes", "window"):
        a, b = getattr(own, name), getattr(theirs, name)
        if a != b:
            shown = [", ".join(each) if isinstance(each, tuple) else each for each in (a, b)]
            return f"its {_NOUNS[name]} {shown[0]}, those of version {champion.version} {shown[1]}"
    if own.channels != theirs.channels:
        return f"its streams, channels or rates are not those of version {champion.version}"
    return ""


_NOUNS = {"robots": "robots are", "classes": "classes are", "window": "windows are"}


def _on_new_data(version: str, found: Comparison | None, remark: str) -> tuple[bool, str]:
    if found is None:
        return False, (
            f"new data: no run on which version {version} can be judged: it was trained on them and has no "
            "figures by run, or it needs other rates, features or the samples of runs"
        )
    low, high = found.difference_ci
    unknown = f", {found.n_unknown} more not compared" if found.n_unknown else ""
    verdict = (
        f"new data: on {found.n_runs} runs{unknown}, each held out, accuracy {found.candidate:.1%} against "
        f"{found.champion:.1%} of version {version} (difference 95 % over runs: {100 * low:+.1f} to "
        f"{100 * high:+.1f} points)"
    )
    return (
        found.candidate >= found.champion,
        f"{verdict}{remark if found.candidate >= found.champion else ''}",
    )
