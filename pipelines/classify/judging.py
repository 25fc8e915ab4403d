"""A new model against the champion: on runs that neither was trained on when it predicted them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipelines.classify.training_data import TrainingData
from pipelines.crossval.results import CrossvalReport
from pipelines.crossval.splits import Samples
from pipelines.data.datasets import joint_digest
from pipelines.learn.tracking import Champion, Judge, Verdict
from pipelines.models.champion import Comparison, Scope, Standing, champion_decision, scope_of
from pipelines.models.model_files import TerrainModel
from pipelines.models.results import ModelInfo
from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.metrics import runs_by_terrain
from terrain.records import Array

N_BOOTSTRAP = 2000


class HeldOutRun(NamedTuple):
    """Windows of a run and how many of them were classified correctly while it was held out."""

    n_windows: int
    accuracy: float


def held_out_runs(samples: Samples, report: CrossvalReport) -> dict[str, HeldOutRun]:
    """Return the held-out accuracy of each run, over all of its terrains."""
    windows = samples.cut.windows
    run_id = windows.run_id.astype(str)
    run_of = dict(zip(runs_by_terrain(run_id, windows.terrain.astype(str)).tolist(), run_id, strict=True))
    n_right: dict[str, float] = {}
    n_all: dict[str, int] = {}
    for row in report.per_run:
        name = str(run_of[row.run_id])
        n_all[name] = n_all.get(name, 0) + row.n_windows
        n_right[name] = n_right.get(name, 0.0) + row.n_windows * row.accuracy
    return {name: HeldOutRun(n_all[name], n_right[name] / n_all[name]) for name in n_all}


def standing_of(info: ModelInfo, report: CrossvalReport) -> Standing:
    """Return what the choice of the champion depends on, of a model that has no version yet."""
    return Standing("", scope_of(info), info.data_digest, report.macro_f1, report.accuracy_ci, report.chance)


def standing_tags(standing: Standing, scope: Scope) -> dict[str, str]:
    """Return the tags of a registered version."""
    low, high = standing.accuracy_ci
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


def judge_of(data: TrainingData, report: CrossvalReport, standing: Standing, seed: int) -> Judge:
    """Return what judges a new version of a model against the present champion.

    Parameters
    ----------
    data : that the new version was trained on
    report : its cross-validation
    standing : of the new version
    seed : of the bootstrap over runs
    """
    held_out = held_out_runs(data.samples, report)

    def judge(champion: Champion | None, version: str) -> Verdict:
        candidate = standing._replace(version=version)
        if champion is None or champion.model is None:
            present = None if champion is None else candidate._replace(version=champion.version, scope=None)
            return Verdict(*champion_decision(present, candidate, lambda: None))
        model = champion.model
        same = same_data(model.info, candidate.data_digest, data)
        present = Standing(
            champion.version,
            scope_of(model.info),
            candidate.data_digest if same else model.info.data_digest,
            float(champion.tags.get("macro_f1", model.info.evaluation.get("macro_f1", "-inf"))),
            (0.0, 1.0),
            0.0,
        )
        return Verdict(*champion_decision(present, candidate, lambda: compare(model, data, held_out, seed)))

    return judge


def same_data(info: ModelInfo, digest: str, data: TrainingData) -> bool:
    """Return whether a model was trained on data with a digest, be it as runs or as a store of features.

    Parameters
    ----------
    info : of the model
    digest : of the data as they are given now
    data : the same
    """
    joint = joint_digest([run.digest for run in data.runs])
    return info.data_digest in (digest, joint) or joint_digest(info.run_digests) == digest


def compare(
    model: TerrainModel, data: TrainingData, held_out: Mapping[str, HeldOutRun], seed: int
) -> Comparison | None:
    """Return how a model does against the held-out figures of another one, None where it cannot be judged.

    A run that the model was not trained on is predicted, where it can be; one that it was trained on counts
    with the accuracy that it had when it was held out, where that is known.

    Parameters
    ----------
    model : to be judged
    data : of the other model
    held_out : held-out accuracy of each of its runs, by id
    seed : of the bootstrap over runs
    """
    run_id, terrain = data.run_id, data.terrain
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
