"""Which version of a model is champion: of one robot, one set of channels and one set of classes.

The alias ``champion`` never goes to a model that cannot be compared with the present one, that was not better
or is not above chance.  A version that does not become champion is registered all the same.  On new data both are
judged on runs that neither was trained on when it predicted them.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipelines.live.model import ModelInfo, TerrainModel
from terrain.classify.metrics import Difference, paired_accuracy, runs_by_terrain
from terrain.logs.run_folders import joint_digest

if TYPE_CHECKING:
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.training_data import TrainingData


class Champion(NamedTuple):
    """The present champion; ``model`` is None where it cannot be loaded."""

    version: str
    tags: Mapping[str, str]
    model: TerrainModel | None


def run_accuracies(data: TrainingData, evaluated: CrossvalResult) -> dict[str, float]:
    """Return the held-out accuracy of each run, over all of its terrains, by the digest of the run."""
    run_id, accuracy = data.samples.run_id, {row.run_id: row.accuracy for row in evaluated.per_run}
    of_window = np.array([accuracy[name] for name in runs_by_terrain(run_id, data.samples.terrain)])
    return {run.digest: float(of_window[run_id == run.run_id].mean()) for run in data.runs if run.n_windows}


def scope_of(info: ModelInfo) -> dict[str, str]:
    """Return what models must have in common to be compared; channels and rates, to 5 %, as a digest."""
    streams = {
        name: [sorted(channels), f"{info.rate_hz[name]:.2g}"] for name, channels in info.channels.items()
    }
    digest = hashlib.sha256(json.dumps(streams, sort_keys=True).encode()).hexdigest()[:16]
    return {
        "robots": ", ".join(sorted(info.robots)),
        "classes": ", ".join(sorted(info.classes)),
        "windows": info.cut_words,
        "channels": digest,
    }


def tags_of(info: ModelInfo, evaluated: CrossvalResult) -> dict[str, str]:
    """Return the tags of a registered version: what it is compared by."""
    low, high = evaluated.accuracy_ci
    return {
        "data_digest": info.data_digest,
        "macro_f1": repr(evaluated.macro_f1),
        "accuracy_interval": f"{low:.4f} to {high:.4f}",
        "chance": f"{evaluated.chance:.4f}",
        **scope_of(info),
    }


def judge(
    champion: Champion | None, info: ModelInfo, evaluated: CrossvalResult, data: TrainingData | None = None
) -> tuple[bool, str]:
    """Return whether a new version becomes champion, and why.

    Parameters
    ----------
    champion : the present one, None where there is none
    info, evaluated : of the new version
    data : that it was trained on; None where they are not at hand any more
    """
    weak = evaluated.weaknesses
    if weak and not evaluated.accuracy_ci[0] > evaluated.chance:
        return False, weak[0]
    remark = f"; {'; '.join(weak)}" if weak else ""
    if champion is None:
        return True, f"first version{remark}"
    version, model = champion.version, champion.model
    if model is None:
        return True, f"version {version} cannot be loaded{remark}"
    own, theirs = scope_of(info), scope_of(model.info)
    for name, own_text in own.items():
        if own_text != theirs[name]:
            different = f"its {name} are {own_text}, those of version {version} {theirs[name]}"
            if name == "channels":
                different = f"its streams, channels or rates are not those of version {version}"
            return False, f"{different}: choose another --name"
    each = joint_digest([run.digest for run in data.runs]) if data is not None else ""
    digests = info.data_digest, each  # of the runs together, and of each by itself
    if model.info.data_digest in digests or joint_digest(model.info.run_digests) == info.data_digest:
        best = float(champion.tags.get("macro_f1", "-inf"))
        comparison = f"{best:.4f} of version {version} on the same data"
        if evaluated.macro_f1 > best:
            return True, f"macro F1 {evaluated.macro_f1:.4f} is better than {comparison}{remark}"
        return False, f"macro F1 {evaluated.macro_f1:.4f} is not better than {comparison}"
    found = None if data is None else compare(model, info, data)
    if found is None:
        return False, (
            f"new data: no run on which version {version} can be judged: it was trained on them and has no "
            "figures by run, or it needs other rates, features or the samples of runs"
        )
    n_runs, difference = found
    unknown = len(info.run_accuracy) - n_runs
    verdict = (
        f"new data: on {n_runs} runs{f', {unknown} more not compared' if unknown else ''}, each held out, "
        f"accuracy {difference.b:.1%} against {difference.a:.1%} of version {version}"
    )
    low, high = (100 * end for end in difference.interval)
    if not math.isnan(low):
        verdict += f" (difference {evaluated.over}: {low:+.1f} to {high:+.1f} points)"
    better = difference.b >= difference.a
    return better, f"{verdict}{remark if better else ''}"


def compare(model: TerrainModel, info: ModelInfo, data: TrainingData) -> tuple[int, Difference] | None:
    """Return on how many runs both were judged, and the accuracy of a model and of another, each run held out.

    A run that the model was not trained on is predicted, where it can be; one that it was trained on counts
    with the accuracy that it had when it was held out, where that is known.  None where there is no such run.

    Parameters
    ----------
    model : that is compared
    info, data : of the other, and what it was trained on
    """
    run_id, terrain, known = data.samples.run_id, data.samples.terrain, model.info.run_accuracy
    held_out = {run.run_id: run.digest for run in data.runs if run.digest in info.run_accuracy}
    trained = {
        run.run_id for run in data.runs if model.info.trained_on_digests(run.digest, run.measured_digest)
    }
    new = [name for name in held_out if name not in trained]
    theirs = {name: known[held_out[name]] for name in held_out if held_out[name] in known and name not in new}
    rows = np.isin(run_id, new)
    probability = data.probabilities(model, rows) if rows.any() else None
    if probability is not None:
        right = np.asarray(model.recipe.classes_, dtype=str)[probability.argmax(axis=1)] == terrain[rows]
        theirs |= {name: float(right[run_id[rows] == name].mean()) for name in new}
    if not theirs:
        return None
    names = sorted(theirs)
    own = np.array([info.run_accuracy[held_out[name]] for name in names])
    other = np.array([theirs[name] for name in names])
    first = np.array([np.flatnonzero(run_id == name)[0] for name in names])
    n_windows = np.array([(run_id == name).sum() for name in names])
    of_runs = data.samples.unit[first], terrain[first], n_windows, other, own
    return len(names), paired_accuracy(*of_runs, np.random.default_rng(info.seed))
