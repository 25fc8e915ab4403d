"""Which version of a model is champion: of one robot, one set of channels and one set of classes.

The alias ``champion`` never goes to a model that cannot be compared with the present one, that was not better
or is not above chance.  A version that does not become champion is registered all the same.  On new data both are
judged on runs that neither was trained on when it predicted them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipelines.data.datasets import joint_digest
from pipelines.learn.evaluate import weaknesses
from pipelines.learn.model_file import ModelInfo, TerrainModel, window_words
from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.metrics import runs_by_terrain
from terrain.records import Array

if TYPE_CHECKING:
    from pipelines.learn.card import Evaluated
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.protocols import Samples
    from pipelines.learn.training_data import TrainingData

N_BOOTSTRAP = 2000


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
    return Scope(tuple(sorted(info.robots)), tuple(sorted(info.classes)), digest, window_words(info))


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


class HeldOutRun(NamedTuple):
    """Windows of a run and how many of them were classified correctly while it was held out."""

    n_windows: int
    accuracy: float


def held_out_runs(samples: Samples, report: CrossvalResult) -> dict[str, HeldOutRun]:
    """Return the held-out accuracy of each run, over all of its terrains."""
    run_of = dict(zip(runs_by_terrain(samples.run_id, samples.terrain).tolist(), samples.run_id, strict=True))
    n_right: dict[str, float] = {}
    n_all: dict[str, int] = {}
    for row in report.per_run:
        name = str(run_of[row.run_id])
        n_all[name] = n_all.get(name, 0) + row.n_windows
        n_right[name] = n_right.get(name, 0.0) + row.n_windows * row.accuracy
    return {name: HeldOutRun(n_all[name], n_right[name] / n_all[name]) for name in n_all}


def standing_of(info: ModelInfo, evaluated: Evaluated | CrossvalResult) -> Standing:
    """Return what the choice of the champion depends on, of a model that has no version yet."""
    figures = evaluated.macro_f1, evaluated.accuracy_ci, evaluated.chance
    return Standing("", scope_of(info), info.data_digest, *figures)


def standing_tags(standing: Standing) -> dict[str, str]:
    """Return the tags of a registered version."""
    (low, high), scope = standing.accuracy_ci, standing.scope
    assert scope is not None
    return {
        "data_digest": standing.data_digest,
        "macro_f1": repr(standing.macro_f1),
        "accuracy_interval": f"{low:.4f} to {high:.4f}",
        "chance": f"{standing.chance:.4f}",
        "robots": ", ".join(scope.robots),
        "classes": ", ".join(scope.classes),
        "channels": scope.channels,
        "windows": scope.window,
    }


class Champion(NamedTuple):
    """The present champion; ``model`` is None where it cannot be loaded."""

    version: str
    tags: Mapping[str, str]
    model: TerrainModel | None


class Bench(NamedTuple):
    """What a champion is judged on: the data of a new version, and how that one did on each run held out.

    Parameters
    ----------
    data : that the new version was trained on
    held_out : its held-out accuracy on each run, by id
    seed : of the bootstrap over runs
    """

    data: TrainingData
    held_out: Mapping[str, HeldOutRun]
    seed: int


def judge(champion: Champion | None, candidate: Standing, bench: Bench | None = None) -> tuple[bool, str]:
    """Return whether a new version becomes champion, and why.

    Parameters
    ----------
    champion : the present one, None where there is none
    candidate : the new version
    bench : what both can be judged on; None where the training data are not at hand any more
    """
    if champion is None:
        return champion_decision(None, candidate, lambda: None)
    model, scope, digest = champion.model, None, ""
    macro_f1 = champion.tags.get("macro_f1", "-inf")
    if model is not None:
        scope, digest = scope_of(model.info), model.info.data_digest
        macro_f1 = champion.tags.get("macro_f1", str(model.info.evaluation.get("macro_f1", macro_f1)))
        if bench is not None and same_data(model.info, candidate.data_digest, bench.data):
            digest = candidate.data_digest
    present = Standing(champion.version, scope, digest, float(macro_f1), (0.0, 1.0), 0.0)
    return champion_decision(
        present, candidate, lambda: None if model is None or bench is None else compare(model, bench)
    )


def same_data(info: ModelInfo, digest: str, data: TrainingData) -> bool:
    """Return whether a model was trained on data with a digest, be it of the runs together or of each by itself.

    Parameters
    ----------
    info : of the model
    digest : of the data as they are given now
    data : the same
    """
    joint = joint_digest([run.digest for run in data.runs])
    return info.data_digest in (digest, joint) or joint_digest(info.run_digests) == digest


def compare(model: TerrainModel, bench: Bench) -> Comparison | None:
    """Return how a model does against the held-out figures of another one, None where it cannot be judged.

    A run that the model was not trained on is predicted, where it can be; one that it was trained on counts
    with the accuracy that it had when it was held out, where that is known.
    """
    data, held_out, seed = bench
    run_id, terrain = data.samples.run_id, data.samples.terrain
    digests = {run.run_id: run.digest for run in data.runs}
    theirs: dict[str, float] = {}
    new = [name for name in held_out if digests[name] not in model.info.run_digests]
    rows = np.isin(run_id, new)
    probability = data.probabilities(model, rows) if rows.any() else None
    if probability is not None:
        right = np.asarray(model.recipe.classes_, dtype=str)[probability.argmax(axis=1)] == terrain[rows]
        theirs = {name: float(right[run_id[rows] == name].mean()) for name in new}
    known = model.info.run_accuracy
    theirs |= {name: known[digests[name]] for name in held_out if digests[name] in known and name not in new}
    if not theirs:
        return None
    names = sorted(theirs)
    weight = np.array([held_out[name].n_windows for name in names], dtype=float)
    own = np.array([held_out[name].accuracy for name in names])
    other = np.array([theirs[name] for name in names])
    first = [str(terrain[run_id == name][0]) for name in names]
    return Comparison(
        len(names),
        len(held_out) - len(names),
        float(np.average(other, weights=weight)),
        float(np.average(own, weights=weight)),
        _interval(weight, own - other, np.array(first), np.random.default_rng(seed)),
    )


def _interval(
    weight: Array, difference: Array, terrain: Array, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % interval of a weighted mean over runs, which are drawn within their classes."""
    total, weights = np.zeros((2, N_BOOTSTRAP))
    for name in np.unique(terrain):
        members = np.flatnonzero(terrain == name)
        drawn = members[bootstrap_rows(len(members), N_BOOTSTRAP, rng)]
        total += (weight * difference)[drawn].sum(axis=1)
        weights += weight[drawn].sum(axis=1)
    return percentile_interval(total / weights)
