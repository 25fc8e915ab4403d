"""Predict terrain, probability and target slip of every window of runs; or changes of the ground from currents.

Predictions are written as Parquet or CSV by the ending of ``--out``.  ``--changes DIR`` finds changes of the
ground sample by sample instead, from the currents of the wheels, calibrated on the runs of DIR.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from pydantic import model_validator

from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.report import (
    Column,
    Figure,
    Panel,
    Part,
    Progress,
    Report,
    Result,
    Section,
    Strip,
    Table,
    Text,
    described,
    format_counts,
    format_value,
    plural,
    silent,
)
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from terrain.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd

    from features.windows import WindowCut
    from pipelines.learn.ground_changes import ChangesResult
    from pipelines.learn.model_file import TerrainModel
    from pipelines.live.model import Assessed
    from terrain.control.slip_table import SlipTable
    from terrain.records import Array, RunLog, SlipTarget, Windows
    from terrain.robots import Robot

EXAMPLE = "terrain predict --data runs/ --model models:/field@champion --out predicted.csv"

DRIVE_STATES = ("traction", "braking", "steady")
NOT_LEARNED = "unknown"
"""Terrain of a window that is like none that was learned."""

ENDINGS = (".parquet", ".csv")
MAX_ROWS, MAX_STRIPS = 8, 12
PERCENT = ".1%"


class PredictionSettings(BaseSettings):
    """Prediction: which model predicts, and which table gives the target slips."""

    model: str = setting("", "models:/NAME@champion, models:/NAME/3, or a model folder.")
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(
        None, "From window to window in s, as the filter of a live chain has them (0.25).", "--filter-stride"
    )
    out: Path | None = setting(None, "File of the predictions: .parquet or .csv.")


class ChangesSettings(BaseSettings):
    """Changes of the ground, from the currents of the wheels."""

    changes: Path | None = setting(
        None, "Folder of runs on one ground each, of the same robot, that say what is no change."
    )
    false_alarms: float = setting(
        0.02, "Share of the runs on one ground that may give an alarm.", gt=0.0, lt=0.5
    )


class Settings(PredictionSettings, ChangesSettings, AlignedRunsSettings):
    """What is predicted, of which runs."""

    @model_validator(mode="after")
    def _check_mode(self) -> Self:
        if bool(self.model) == (self.changes is not None):
            raise ConfigError(
                "--model and --changes do not go together: predict terrains, or find changes of the ground"
                if self.model
                else "--model is missing"
            )
        if self.out is not None and self.out.suffix not in ENDINGS:
            raise ConfigError(f"--out is {self.out}: a name that ends in {' or '.join(ENDINGS)} is accepted")
        return self


class WindowPrediction(NamedTuple):
    """The predicted terrain of a window, and the target slips that follow from it.

    Parameters
    ----------
    run_id, start_s : of the window
    terrain : predicted; ``unknown`` where the window is like none that was learned
    probability : of ``nearest``
    target_slip, status : by drive state
    slip_entry : entry of the table of target slips; the fallback where the terrain has none or is unknown
    label : true terrain; None where it is not known
    filtered_terrain : by the windows of the run up to this one; None where none is certain enough
    nearest : the most probable of the learned terrains
    novelty : how unlike all of them the window is; None where the model has no such score
    supported : whether training runs that drove like this support the prediction; None where not counted
    terrain_set : terrains that hold the true one in 90 % of windows; None where not calibrated
    """

    run_id: str
    start_s: float
    terrain: str
    probability: float
    target_slip: Mapping[str, float]
    slip_entry: str
    status: Mapping[str, str]
    label: str | None
    filtered_terrain: str | None = None
    nearest: str = ""
    novelty: float | None = None
    supported: bool | None = None
    terrain_set: tuple[str, ...] | None = None


class TargetSlipRow(NamedTuple):
    """Target slips of a terrain, and the entry of the table that they come from."""

    traction: float
    braking: float
    steady: float
    entry: str
    status: str
    source: str


@dataclass(frozen=True, repr=False)
class Predictions(Result):
    """Predictions of a model for every window that its own rule keeps."""

    windows: tuple[WindowPrediction, ...] = described("the prediction of each window")
    n_windows: int = described("windows")
    n_runs: int = described("runs that they are of")
    classes: tuple[str, ...] = described("terrains that the model has learned")
    accuracy: float | None = described(
        "windows whose nearest terrain is their label; None without labels", "1", form=PERCENT
    )
    n_judged: int = described("windows whose label the model knows")
    training_runs: tuple[str, ...] = described(
        "runs that the model was trained on, whose accuracy does not measure its skill"
    )
    repaired: Mapping[str, int] = described("what a repairing reader dropped, by kind")
    unknown_labels: Mapping[str, int] = described("windows by labels that the model was not trained on")
    n_unknown_labels: int = described("their number")
    dropped: Mapping[str, int] = described("windows left out, by reason")
    table_name: str = described("table of target slips")
    table: Mapping[str, TargetSlipRow] = described("target slips by terrain")
    filtered: tuple[str, ...] = described(
        "runs that the live chain filtered, as they had no estimates", default=()
    )
    filtered_accuracy: float | None = described(
        "as the accuracy, of the terrain filtered over time", "1", form=PERCENT, default=None
    )
    n_unknown: int = described("windows that are like no terrain that was learned", default=0)
    n_unsupported: int | None = described(
        "windows whose prediction no training run supports; None where not counted", default=None
    )
    model: str | None = described("as it was asked for", default=None)
    dataset: str | None = described("name of the data", default=None)
    skipped: tuple[str, ...] | None = described("runs that a repairing reader had to skip", default=None)

    def as_json(self) -> Any:
        """Return all fields without those that the caller did not give."""
        unknown = [name for name in ("model", "dataset", "skipped") if getattr(self, name) is None]
        return {name: value for name, value in Result.as_json(self).items() if name not in unknown}

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a window; its target slips in a column each."""
        import pandas as pd

        rows = []
        for each in self.windows:
            row = each._asdict()
            targets, status = row.pop("target_slip"), row.pop("status")
            row["terrain_set"] = None if each.terrain_set is None else " ".join(each.terrain_set)
            rows.append(
                row
                | {f"target_slip_{state}": targets[state] for state in DRIVE_STATES}
                | {f"status_{state}": status[state] for state in DRIVE_STATES}
            )
        return pd.DataFrame(rows)


def run(settings: Settings, progress: Progress = silent) -> Predictions | ChangesResult:
    """Read runs, and predict their terrain or find changes of the ground.

    Raises
    ------
    ConfigError, LogError, DataError, ModelError
        if a setting is not accepted, a run or the model cannot be read, or the runs are not such as the model
        needs.
    """
    from pipelines.learn.load import load_model
    from pipelines.live.windows import filtered
    from terrain.control.slip_table import load_slip_table
    from terrain.files.atomic import ensure_writable
    from terrain.robots import load_robot

    if settings.out is not None:
        ensure_writable(settings.out.resolve().parent)
    if settings.changes is not None:
        from pipelines.learn.ground_changes import find_changes

        runs, skipped = load(settings)
        quiet, skipped_quiet = load(settings.with_(data=settings.changes, only=(), without=()))
        found = find_changes(runs, quiet, settings.robot, settings.false_alarms, progress)
        changes = replace(found, skipped=(*skipped, *skipped_quiet))
        _write_table(changes, settings.out)
        return changes
    table = load_slip_table(settings.table)
    runs, skipped = load(settings)
    robot = None if settings.robot is None else load_robot(settings.robot)
    model = filtered(load_model(settings.model), settings.filter_stride_s)
    predicted = predict(runs, model, table, robot=robot, skip_short=settings.repair)
    result = replace(predicted, model=settings.model, dataset=settings.dataset, skipped=tuple(skipped))
    _write_table(result, settings.out)
    return result


def _write_table(result: Result, out: Path | None) -> None:
    """Write the natural table of a result, whole or not at all."""
    if out is None:
        return
    from io import BytesIO

    from terrain.files.atomic import atomic_write

    table, stream = result.to_pandas(), BytesIO()
    if out.suffix == ".csv":
        table.to_csv(stream, index=False)
    else:
        table.to_parquet(stream, index=False)
    atomic_write(out, stream.getvalue())


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
    import numpy as np

    from features.windows import cut_windows, join_windows
    from pipelines.live.model import assess
    from pipelines.live.windows import needs_filter
    from terrain.logs.digest import data_digest

    other = next((each for each in runs if table.robot and each.robot != table.robot), None)
    if other is not None:
        raise ConfigError(
            f"table {table.name} is for robot {table.robot!r}, run {other.run_id} is of {other.robot!r}"
        )
    raw = [each for each in runs if needs_filter(model.info, each.streams)]
    cuts = [model_windows(each, model, robot, skip_short=skip_short) for each in runs]
    windows = join_windows(
        [cut_windows([], model.rule, layout=model.layout).windows, *(cut.windows for cut in cuts)]
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
        training_runs=tuple(each.run_id for each in runs if data_digest([each]) in model.info.run_digests),
        repaired=dict(sum((Counter(each.dropped) for each in runs), Counter())),
        unknown_labels={str(name): int(count) for name, count in zip(unknown, counts, strict=True)},
        n_unknown_labels=int(counts.sum()),
        dropped=dict(sum((Counter(cut.dropped) for cut in cuts), Counter())),
        filtered=tuple(each.run_id for each in raw),
        table_name=table.name,
        table={terrain: _table_row(found) for terrain, found in targets.items()},
        n_unknown=int(assessed.unknown.sum()),
        n_unsupported=None if model.support is None else int((assessed.supported == 0).sum()),
    )


def _nothing(n_classes: int) -> Assessed:
    import numpy as np

    from pipelines.live.model import Assessed

    empty = np.zeros(0)
    return Assessed(np.zeros((0, n_classes)), empty, empty.astype(bool), empty, empty)


def _rows(
    windows: Windows, assessed: Assessed, over_time: Array, model: TerrainModel, table: SlipTable
) -> tuple[WindowPrediction, ...]:
    """Return the prediction of each window; an unknown one has no terrain, and the table's fallback."""
    import numpy as np

    from pipelines.live.model import class_sets
    from terrain.control.switching import UNKNOWN

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
    import numpy as np

    from pipelines.live.windows import filter_of
    from terrain.classify.terrain_filter import filter_run, novelty_evidence, reported

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


def model_windows(
    log: RunLog, model: TerrainModel, robot: Robot | None = None, *, skip_short: bool
) -> WindowCut:
    """Return the windows of a log that a model takes; where it lacks estimates, the live chain runs over it.

    Parameters
    ----------
    log, model : run log, and the model whose rule cuts it
    robot : description of the robot of runs that bear its name; the package's by default
    skip_short : leave out and count a run that is shorter than a window instead of refusing it
    """
    from features.windows import cut_windows
    from pipelines.live.windows import needs_filter, windows_of_log
    from terrain.robots import robot_named

    if needs_filter(model.info, log.streams):
        return windows_of_log(log, model.info, robot_named(log.robot, robot), skip_short=skip_short)
    return cut_windows([log], model.rule, layout=model.layout, skip_short=skip_short)


def _table_row(targets: Mapping[str, SlipTarget]) -> TargetSlipRow:
    return TargetSlipRow(
        **{state: targets[state].slip_ratio for state in DRIVE_STATES},
        entry=targets["traction"].terrain,
        status=", ".join(dict.fromkeys(targets[state].status for state in DRIVE_STATES)),
        source="; ".join(dict.fromkeys(targets[state].source for state in DRIVE_STATES)),
    )


def report(result: Predictions) -> Report:
    """Return the terrains along the runs, how far they are right, and what is not certain of them."""
    stretches = [list(rows) for _, rows in groupby(result.windows, lambda row: (row.run_id, row.terrain))]
    counts = Counter(row.terrain for row in result.windows)
    shares = ", ".join(
        f"{name} {format_value(count / result.n_windows, '.0%')}" for name, count in counts.most_common(5)
    )
    found = f"{plural(result.n_windows, 'window')} of {plural(result.n_runs, 'run')}: {shares or 'none'}"
    judged = ""
    if result.accuracy is not None:
        trained = (
            f", {len(result.training_runs)} runs of which trained the model" if result.training_runs else ""
        )
        right = format_value(result.accuracy, PERCENT)
        judged = f"; {right} of {result.n_judged} labelled ones are right{trained}"
    return Report(
        title=f"Terrain of {result.dataset or 'runs'}",
        answer=f"{found}{judged}.",
        lead=f"model {result.model or 'given'}, target slips of the table {result.table_name!r}",
        picture=_picture(stretches),
        parts=[_stretches_table(stretches[:MAX_ROWS], len(stretches)), *_notes(result)],
        details=[Section("All stretches", [_stretches_table(stretches, len(stretches))])],
        next_step=f"terrain serve --model {result.model} --robot ROBOT" if result.model else "",
    )


def _picture(stretches: Sequence[Sequence[WindowPrediction]]) -> Figure | None:
    """Return a strip of terrains for each of the first runs."""
    panels: dict[str, list[tuple[float, float, str]]] = {}
    for rows in stretches:
        step_s = rows[1].start_s - rows[0].start_s if len(rows) > 1 else 2.0
        spans = panels.setdefault(rows[0].run_id, [])
        spans.append((rows[0].start_s, rows[-1].start_s + step_s, rows[0].terrain))
    if not panels:
        return None
    shown = list(panels.items())[:MAX_STRIPS]
    more = f" The first {MAX_STRIPS} of {len(panels)} runs." if len(panels) > MAX_STRIPS else ""
    return Figure(
        "Predicted terrain along the runs",
        [Panel([Strip(spans)], title=name) for name, spans in shown],
        caption=f"Colours are terrains.{more}",
        x_label="time [s]",
    )


def _stretches_table(stretches: Sequence[Sequence[WindowPrediction]], n_all: int) -> Table:
    rows = [
        (
            rows[0].run_id,
            rows[0].start_s,
            len(rows),
            rows[0].terrain,
            sum(row.probability for row in rows) / len(rows),
            *(rows[0].target_slip[state] for state in DRIVE_STATES),
        )
        for rows in stretches
    ]
    return Table(
        (
            "run",
            Column("from", ".1f", "s"),
            "windows",
            "terrain",
            Column("probability", ".2f"),
            *(Column(f"slip, {state}", "+.2f") for state in DRIVE_STATES),
        ),
        rows,
        note=""
        if len(rows) == n_all
        else f"{n_all - len(rows)} stretches more; --out FILE.csv has every window",
    )


def _notes(result: Predictions) -> list[Part]:
    found: list[str] = []
    if result.training_runs:
        found.append("of runs that the model was trained on the accuracy is no measure of its skill")
    if result.n_unknown:
        found.append(
            f"{result.n_unknown} windows are like no terrain that was learned, as are 5 % of those of learned "
            "ones: unknown, for which the table's fallback is used"
        )
    if result.n_unsupported:
        found.append(
            f"{result.n_unsupported} predictions are supported by no training run that drove like this"
        )
    if result.filtered_accuracy is not None:
        accuracy = format_value(result.filtered_accuracy, PERCENT)
        found.append(f"filtered over time {accuracy} are right; what stays uncertain counts as wrong")
    if result.filtered:
        found.append(
            f"{len(result.filtered)} runs had no estimates: filtered as on the robot, sample by sample"
        )
    without = sorted({row.terrain for row in result.windows if row.slip_entry != row.terrain == row.nearest})
    if without:
        found.append(f"no entry in the table of target slips for {', '.join(without)}: the fallback is used")
    if any("unestimated" in row.status.values() for row in result.windows):
        found.append(f"target slips of the table {result.table_name!r} are unestimated: not measured")
    for name, count in result.unknown_labels.items():
        found.append(f"{count} windows are labelled {name}, which the model was not trained on: not judged")
    for text, counts in (("windows left out", result.dropped), ("repaired", result.repaired)):
        if counts:
            found.append(f"{text}: {format_counts(counts)}")
    return [Text(text, "note") for text in (*found, *(result.skipped or ()))]
