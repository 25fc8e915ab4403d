"""``terrain predict``: terrain, probability and target slip of every window of a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from features.windows import WindowCut, cut_windows, join_windows
from pipelines.classify.results import Predictions, TargetSlipRow, WindowPrediction
from pipelines.data.datasets import data_digest, robot_of
from pipelines.live.model import Assessed, assess, class_sets
from pipelines.live.over_time import filter_of, novelty_evidence
from pipelines.live.windows import lacking_estimates, windows_of_log
from pipelines.models.model_files import TerrainModel
from terrain.classify.terrain_filter import filter_run, reported
from terrain.control.slip_table import DRIVE_STATES, SlipTable
from terrain.control.switching import UNKNOWN
from terrain.errors import ConfigError
from terrain.records import Array, RunLog, SlipTarget, Windows
from terrain.robots import Robot

NOT_LEARNED = "unknown"
"""Terrain of a window that is like none that was learned."""


def predict(
    runs: Sequence[RunLog],
    model: TerrainModel,
    table: SlipTable,
    *,
    robot: Robot | None = None,
    skip_short: bool = False,
) -> Predictions:
    """Predict every window that the model's own rule keeps.

    Where a model uses what a filter estimates and a log has none of it, the live chain runs over the log.

    Parameters
    ----------
    runs : run logs, labelled or not
    model : fitted recipe with the rule by which its windows are cut
    table : target slips
    robot : description of the robot of runs that bear its name; the package's by default
    skip_short : leave out and count runs that are shorter than a window instead of refusing them

    Raises
    ------
    DataError
        if a run lacks a channel or has another rate than the model was trained on.
    ConfigError
        if the table is for another robot than a run is of.
    """
    other = next((run for run in runs if table.robot and run.robot != table.robot), None)
    if other is not None:
        raise ConfigError(
            f"table {table.name} is for robot {table.robot!r}, run {other.run_id} is of {other.robot!r}"
        )
    raw = [run for run in runs if lacking_estimates(run, model.info)]
    cuts = [_cut(run, model, robot, skip_short=skip_short) for run in runs]
    windows = join_windows(
        [cut_windows([], model.rule, layout=model.layout).windows, *(c.windows for c in cuts)]
    )
    classes = np.asarray(model.recipe.classes_, dtype=str)
    assessed = assess(model, windows) if len(windows) else _nothing(len(classes))
    predicted = classes[assessed.probability.argmax(axis=1)]
    label = windows.terrain.astype(str)
    over_time = filtered_terrains(windows, assessed, model)
    targets = {terrain: table.lookup(terrain) for terrain in classes.tolist()}
    rows = _rows(windows, assessed, over_time, model, table)
    known = np.isin(label, classes)
    unknown, counts = np.unique(label[(label != "") & ~known], return_counts=True)
    return Predictions(
        windows=rows,
        n_windows=len(rows),
        n_runs=len(runs),
        classes=tuple(targets),
        accuracy=float(np.mean(predicted[known] == label[known])) if known.any() else None,
        filtered_accuracy=float(np.mean(over_time[known] == label[known])) if known.any() else None,
        n_judged=int(known.sum()),
        training_runs=tuple(run.run_id for run in runs if data_digest([run]) in model.info.run_digests),
        repaired=dict(sum((Counter(run.dropped) for run in runs), Counter())),
        unknown_labels={str(name): int(count) for name, count in zip(unknown, counts, strict=True)},
        n_unknown_labels=int(counts.sum()),
        dropped=dict(sum((Counter(cut.dropped) for cut in cuts), Counter())),
        filtered=tuple(run.run_id for run in raw),
        table_name=table.name,
        table={terrain: _table_row(found) for terrain, found in targets.items()},
        n_unknown=int(assessed.unknown.sum()),
        n_unsupported=None if model.support is None else int((assessed.supported == 0).sum()),
    )


def _nothing(n_classes: int) -> Assessed:
    empty = np.zeros(0)
    return Assessed(np.zeros((0, n_classes)), empty, empty.astype(bool), empty, empty)


def _rows(
    windows: Windows, assessed: Assessed, over_time: Array, model: TerrainModel, table: SlipTable
) -> tuple[WindowPrediction, ...]:
    """Return the prediction of each window; an unknown one has no terrain, and the table's fallback."""
    classes = np.asarray(model.recipe.classes_, dtype=str)
    best = assessed.probability.argmax(axis=1)
    sets = class_sets(model, assessed.probability)
    rows = []
    for i in range(len(windows)):
        nearest = str(classes[best[i]])
        terrain = UNKNOWN if assessed.unknown[i] else nearest
        targets = table.lookup(terrain)
        rows.append(
            WindowPrediction(
                run_id=str(windows.run_id[i]),
                start_s=float(windows.start_s[i]),
                terrain=terrain or NOT_LEARNED,
                probability=float(assessed.probability[i, best[i]]),
                target_slip={state: targets[state].slip_ratio for state in DRIVE_STATES},
                slip_entry=targets["traction"].terrain,
                status={state: targets[state].status for state in DRIVE_STATES},
                label=str(windows.terrain[i]) or None,
                filtered_terrain=str(over_time[i]) or None,
                nearest=nearest,
                novelty=None if np.isnan(assessed.novelty[i]) else float(assessed.novelty[i]),
                supported=None if np.isnan(assessed.supported[i]) else bool(assessed.supported[i]),
                terrain_set=None if sets is None else sets[i],
            )
        )
    return tuple(rows)


def filtered_terrains(windows: Windows, assessed: Assessed, model: TerrainModel) -> Array:
    """Return the terrain (n,) by each run's windows up to each; empty where none is certain enough.

    Parameters
    ----------
    windows : n, of each run in order of time
    assessed : what the model says of them
    model : whose training gives the class shares; equal ones where it does not know them
    """
    classes = np.asarray(model.recipe.classes_, dtype=str)
    settings = filter_of(model.info)
    evidence = novelty_evidence(assessed.novelty, assessed.unknown)
    named = np.append(classes, "")  # the last, at -1, is unknown
    found = np.full(len(windows), "", dtype=object)
    for run_id in dict.fromkeys(windows.run_id):
        rows = np.flatnonzero(windows.run_id == run_id)
        end_s = windows.start_s[rows] + windows.length_s
        belief = filter_run(assessed.probability[rows], end_s, settings, evidence[rows])
        found[rows] = named[reported(belief, settings.threshold)]
    return found


def _cut(run: RunLog, model: TerrainModel, robot: Robot | None, *, skip_short: bool) -> WindowCut:
    if lacking_estimates(run, model.info):
        return windows_of_log(run, model.info, robot_of(run, robot), skip_short=skip_short)
    return cut_windows([run], model.rule, layout=model.layout, skip_short=skip_short)


def _table_row(targets: Mapping[str, SlipTarget]) -> TargetSlipRow:
    return TargetSlipRow(
        **{state: targets[state].slip_ratio for state in DRIVE_STATES},
        entry=targets["traction"].terrain,
        status=", ".join(dict.fromkeys(targets[state].status for state in DRIVE_STATES)),
        source="; ".join(dict.fromkeys(targets[state].source for state in DRIVE_STATES)),
    )
