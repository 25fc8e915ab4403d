"""Predict terrain, probability and target slip of every window of runs; or changes of the ground from currents.

Predictions are written as Parquet or CSV by the ending of ``--out``.  ``--changes DIR`` finds changes of the
ground sample by sample instead, from the currents of the wheels, calibrated on the runs of DIR.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from pydantic import model_validator

from pipelines.data.datasets import load
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn.settings import TrustSettings
from pipelines.report.figure import Figure, Panel, Strip
from pipelines.report.numbers import format_counts, format_value, plural
from pipelines.report.results import Progress, Result, as_json, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Part, Report, Section, Table, Text
from terrain.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.learn.ground_changes import ChangesResult
    from pipelines.live.assess import Assessed
    from pipelines.live.model import ModelInfo, TerrainModel
    from terrain.control.slip_table import SlipTable
    from terrain.records import Array, RunLog, Windows
    from terrain.robots import Robot

EXAMPLE = "terrain predict --data runs/ --model models:/field@champion --out predicted.csv"

DRIVE_STATES = ("traction", "braking", "steady")
NOT_LEARNED = "unknown"  #: Terrain of a window that is like none that was learned

ENDINGS = (".parquet", ".csv")
MAX_ROWS, MAX_STRIPS = 8, 12
PERCENT = ".1%"


class PredictionSettings(TrustSettings):
    """Prediction: which model predicts, and which table gives the target slips."""

    model: str = setting("", "models:/NAME@champion, models:/NAME/3, or a model folder.")
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(None, option="--filter-stride")
    """From window to window in s, as the filter of a live chain has them (0.25)."""
    out: Path | None = setting(None, "File of the predictions: .parquet or .csv.")
    adapt: str = setting("")
    """Folder of a drive of the same session; start (the first 20 s of each session); spread (probabilities hold any
    session); none (as trained). By default start where training shows that it helps."""
    adapt_terrain: str = setting("", "The terrain that all of that drive, or of each start, is on.")


class ChangesSettings(BaseSettings):
    """Changes of the ground, from the currents of the wheels."""

    changes: Path | None = setting(None)
    """Folder of runs on one ground each, of the same robot, that say what is no change."""
    false_alarms: float = setting(0.02, gt=0.0, lt=0.5)
    """Share of the runs on one ground that may give an alarm."""


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
        if self.adapt_terrain and self.adapt in ("", "spread", "none"):
            raise ConfigError(
                "--adapt-terrain is the terrain of what --adapt names: start, or the folder of a drive"
            )
        return self


class WindowPrediction(NamedTuple):
    """The predicted terrain of a window, and the target slips that follow from it."""

    #: run_id, start_s: of the window
    run_id: str
    start_s: float
    terrain: str  #: predicted; ``unknown`` where the window is like none that was learned
    probability: float  #: of ``nearest``
    #: target_slip, status: by drive state
    target_slip: Mapping[str, float]
    #: entry of the table of target slips; the fallback where the terrain has none or is unknown
    slip_entry: str
    status: Mapping[str, str]
    label: str | None  #: true terrain; None where it is not known
    #: by the windows of the run up to this one; None where none is certain enough
    filtered_terrain: str | None
    nearest: str  #: the most probable of the learned terrains
    novelty: float | None  #: how unlike all of them the window is; None where the model has no such score
    #: whether training runs that drove like this support the prediction; None where not counted
    supported: bool | None
    #: terrains that hold the true one in 90 % of windows; None where not calibrated
    terrain_set: tuple[str, ...] | None
    #: misfit of the terrain that explains best how the ground answered; None where the model has no laws
    answers: float | None
    reason: str  #: why the terrain is unknown; empty where it is not


class Predictions(Result):
    """Predictions of a model for every window that its own rule keeps."""

    windows: tuple[WindowPrediction, ...] = described("the prediction of each window")
    n_windows: int = described("windows")
    n_runs: int = described("runs that they are of")
    classes: tuple[str, ...] = described("terrains that the model has learned")
    accuracy: float | None = described(
        "windows of runs that were not in training whose nearest terrain is the label; None without labels",
        "1",
    )
    n_judged: int = described("windows of runs that were not in training whose label the model knows")
    training_runs: tuple[str, ...] = described("runs that were in training")
    training_accuracy: float | None = described("as the accuracy, of those; it says nothing of others", "1")
    n_judged_training: int = described("windows of those whose label the model knows")
    repaired: Mapping[str, int] = described(
        "what a repairing reader dropped, and values that were interpolated, by kind"
    )
    unknown_labels: Mapping[str, int] = described("windows by labels that the model was not trained on")
    n_unknown_labels: int = described("their number")
    dropped: Mapping[str, int] = described("windows left out, by reason")
    resampled: Mapping[str, int] = described("runs with a stream of another rate than the model's, by rates")
    table_name: str = described("table of target slips")
    table: Mapping[str, Mapping[str, Any]] = described(
        "target slips by terrain and drive state, and the entry of the table that they come from"
    )
    filtered: tuple[str, ...] = described("runs that the live chain filtered, as they had no estimates")
    filtered_accuracy: float | None = described("as the accuracy, of the terrain filtered over time", "1")
    n_unknown: int = described("windows that are like no terrain that was learned")
    known_refused: tuple[float, float, float] | None = described(
        "part of held-out windows of learned terrains that is called unknown, and its interval", "1"
    )
    accuracy_refusing: float | None = described(
        "as the accuracy, what is called unknown counted as wrong", "1"
    )
    accuracy_accepted: float | None = described(
        "as the accuracy, of windows that are not called unknown", "1"
    )
    n_unsupported: int | None = described("windows that no training run supports; None where not counted")
    adapted: tuple[str, ...] = described("what was found of each session that the model was adapted to")
    adaptation: str = described(
        "whether held-out sessions of training show that adapting helps; empty if not used"
    )
    model: str | None = described("as it was asked for", optional=True)
    dataset: str | None = described("name of the data", optional=True)
    skipped: tuple[str, ...] | None = described("runs that a repairing reader had to skip", optional=True)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a window; its target slips in a column each."""
        import pandas as pd

        table = pd.json_normalize([as_json(each) for each in self.windows], sep="_")
        if len(table):
            table["terrain_set"] = table["terrain_set"].str.join(" ")
        return table


def run(settings: Settings, progress: Progress = silent) -> Predictions | ChangesResult:
    """Read runs, and predict their terrain or find changes of the ground; errors as what reads and predicts."""
    from terrain.files.atomic import atomic_write, ensure_writable

    if settings.out is not None:
        ensure_writable(settings.out.resolve().parent)
    result = _predictions(settings) if settings.changes is None else _changes(settings, progress)
    if settings.out is not None:
        table = result.to_pandas()
        as_csv = settings.out.suffix == ".csv"
        atomic_write(settings.out, table.to_csv(index=False) if as_csv else table.to_parquet(index=False))
    return result


def _changes(settings: Settings, progress: Progress) -> ChangesResult:
    from pipelines.learn.ground_changes import find_changes

    runs, skipped, doubts = load(settings)
    quiet, skipped_quiet, more = load(settings.with_(data=settings.changes, only=(), without=()))
    found = find_changes(runs, quiet, settings.robot, settings.false_alarms, progress)
    return replace(found, skipped=(*skipped, *skipped_quiet)).with_doubts([*doubts, *more])


def _predictions(settings: Settings) -> Predictions:
    from pipelines.live.model import with_start
    from pipelines.live.windows import filtered
    from terrain.control.slip_table import load_slip_table
    from terrain.robots import load_robot

    table = load_slip_table(settings.table)
    runs, skipped, doubts = load(settings)
    robot = None if settings.robot is None else load_robot(settings.robot)
    model = filtered(settings.read_model(settings.model), settings.filter_stride_s)
    if settings.adapt in ("", "start", "spread", "none"):
        model = with_start(model, settings.adapt, settings.adapt_terrain)
    else:
        model = _adapted(model, settings, robot)
    found = predict(runs, model, table, robot=robot, skip_short=settings.repair)
    found = replace(found, model=settings.model, dataset=settings.dataset, skipped=tuple(skipped))
    return found.with_doubts(doubts)


def _adapted(model: TerrainModel, settings: Settings, robot: Robot | None) -> TerrainModel:
    """Return a model adapted by a drive, on the terrain that is named; errors as of what reads and adapts."""
    from features.windows import join_windows
    from pipelines.live.windows import windows_of_log

    reference, *_ = load(settings.with_(data=Path(settings.adapt), only=(), without=()))
    cuts = [windows_of_log(each, model.info, robot, skip_short=True) for each in reference]
    return model.adapt(join_windows([cut.windows for cut in cuts]), settings.adapt_terrain)


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
        if a run lacks a channel or has a lower rate than the model takes.
    ConfigError
        if the table is for another robot than a run is of.
    """
    from pipelines.live.assess import SessionStart
    from pipelines.live.windows import needs_filter, windows_of_log

    for each in runs:
        if table.robot and each.robot != table.robot:
            raise ConfigError(
                f"table {table.name} is for robot {table.robot!r}, run {each.run_id} is of {each.robot!r}"
            )
    cuts = [windows_of_log(each, model.info, robot, skip_short=skip_short) for each in runs]
    sessions: dict[str, SessionStart] = {}
    parts, models, assessed = [], [], []
    for each, cut in zip(runs, cuts, strict=True):
        if len(cut.windows):
            session = sessions.setdefault(each.session or each.run_id, SessionStart(model))
            parts.append(cut.windows)
            assessed.append(session.assess(cut.windows))
            models.append(session.model)
    over_time = _filtered(parts, assessed, model.info)
    outputs = zip(parts, assessed, over_time, models, strict=True)
    rows = [row for of_run in outputs for row in _predict_windows(*of_run, table)]
    adapted = []
    for name, session in sessions.items():
        if session.model.adaptation is not None and (text := session.model.adaptation.found):
            adapted.append(text if session.model.adaptation.start is None else f"{name}: {text}")
    classes = model.info.classes
    training = tuple(each.run_id for each in runs if model.info.trained_on(each))
    known = [row for row in rows if row.label in classes]
    judged = [row for row in known if row.run_id not in training]
    trained = [row for row in known if row.run_id in training]
    accepted = [row for row in judged if row.terrain == row.nearest]
    right = sum(row.nearest == row.label for row in accepted)
    unknown = Counter(sorted(row.label for row in rows if row.label and row.label not in classes))
    return Predictions(
        windows=tuple(rows),
        n_windows=len(rows),
        n_runs=len(runs),
        classes=classes,
        accuracy=_accuracy(judged),
        filtered_accuracy=fmean(row.filtered_terrain == row.label for row in judged) if judged else None,
        n_judged=len(judged),
        training_runs=training,
        training_accuracy=_accuracy(trained),
        n_judged_training=len(trained),
        repaired=dict(
            sum(
                (Counter(each) for each in (*(run.dropped for run in runs), *(cut.filled for cut in cuts))),
                Counter(),
            )
        ),
        unknown_labels=dict(unknown),
        n_unknown_labels=unknown.total(),
        dropped=dict(sum((Counter(cut.dropped) for cut in cuts), Counter())),
        resampled=dict(sum((Counter(cut.resampled) for cut in cuts), Counter())),
        filtered=tuple(each.run_id for each in runs if needs_filter(model.info, each.streams)),
        table_name=table.name,
        table={
            terrain: {
                **{state: targets[state].slip_ratio for state in DRIVE_STATES},
                "entry": targets["traction"].terrain,
                "status": ", ".join(dict.fromkeys(targets[state].status for state in DRIVE_STATES)),
                "source": "; ".join(dict.fromkeys(targets[state].source for state in DRIVE_STATES)),
            }
            for terrain, targets in ((terrain, table.lookup(terrain)) for terrain in classes)
        },
        known_refused=model.info.known_refused,
        accuracy_refusing=right / len(judged) if judged else None,
        accuracy_accepted=right / len(accepted) if accepted else None,
        n_unknown=sum(row.terrain != row.nearest for row in rows),
        n_unsupported=None if model.support is None else sum(row.supported is False for row in rows),
        adapted=tuple(dict.fromkeys(adapted)),
        adaptation=model.adaptation.status if model.adaptation and model.adaptation.shift else "",
    )


def _accuracy(rows: Sequence[WindowPrediction]) -> float | None:
    return fmean(row.nearest == row.label for row in rows) if rows else None


def _filtered(parts: Sequence[Windows], assessed: Sequence[Assessed], info: ModelInfo) -> list[Array]:
    """Return the column of the class that is reported over time in each window of runs; -1 for unknown."""
    import numpy as np

    from pipelines.live.assess import Assessed, as_evidence
    from pipelines.live.windows import filter_of
    from terrain.classify.terrain_filter import filter_sessions, novelty_evidence, reported

    settings = filter_of(info)
    if settings is None or not parts:
        return [np.where(each.unknown, -1, each.probability.argmax(axis=1)) for each in assessed]
    found, groups = Assessed.join(assessed), np.concatenate([part.groups for part in parts])
    probability = as_evidence(found.probability, found.reason)
    evidence = novelty_evidence(found.novelty, found.unknown)
    end_s = np.concatenate([part.start_s + part.length_s for part in parts])
    belief = filter_sessions(probability, end_s, groups, info.window_s, settings, evidence)
    return np.split(reported(belief), np.cumsum([len(part) for part in parts])[:-1])


def _predict_windows(
    windows: Windows, assessed: Assessed, over_time: Array, model: TerrainModel, table: SlipTable
) -> list[WindowPrediction]:
    """Return the prediction of each window of a run; an unknown one has no terrain, and the table's fallback."""
    import numpy as np

    from pipelines.live.assess import class_sets
    from terrain.control.switching import UNKNOWN

    best, sets = assessed.probability.argmax(axis=1), class_sets(model, assessed.probability)
    rows = []
    for i in range(len(windows)):
        nearest = model.info.classes[best[i]]
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
                filtered_terrain=None if over_time[i] < 0 else model.info.classes[over_time[i]],
                nearest=nearest,
                novelty=None if np.isnan(assessed.novelty[i]) else float(assessed.novelty[i]),
                supported=None if np.isnan(assessed.supported[i]) else bool(assessed.supported[i]),
                terrain_set=None if sets is None else sets[i],
                answers=None if np.isnan(assessed.answers[i]) else float(assessed.answers[i]),
                reason=str(assessed.reason[i]),
            )
        )
    return rows


def report(result: Predictions) -> Report:
    """Return the terrains along the runs, how far they are right, and what is not certain of them."""
    stretches = [list(rows) for _, rows in groupby(result.windows, lambda row: (row.run_id, row.terrain))]
    counts = Counter(row.terrain for row in result.windows)
    shares = ", ".join(
        f"{name} {format_value(count / result.n_windows, '.0%')}" for name, count in counts.most_common(5)
    )
    found = f"{plural(result.n_windows, 'window')} of {plural(result.n_runs, 'run')}: {shares or 'none'}"
    if result.accuracy is not None:
        right = format_value(result.accuracy, PERCENT)
        of = "labelled ones of runs that were not in training" if result.training_runs else "labelled ones"
        found += f"; {right} of {result.n_judged} {of} are right"
    if result.training_runs:
        from pipelines.live.model import training_words

        trained = len(result.training_runs), result.training_accuracy, result.n_judged_training
        found += f"; {training_words(*trained)}"
    more = len(stretches) - MAX_ROWS
    note = f"{more} stretches more; --out FILE.csv has every window" if more > 0 else ""
    return Report(
        title=f"Terrain of {result.dataset or 'runs'}",
        answer=f"{found}.",
        lead=f"model {result.model or 'given'}, target slips of the table {result.table_name!r}",
        picture=_picture(stretches),
        parts=[Table(STRETCH_COLUMNS, stretches[:MAX_ROWS], note=note), *_notes(result)],
        details=[Section("All stretches", [Table(STRETCH_COLUMNS, stretches)])],
        next_step=f"terrain serve --model {result.model} --robot ROBOT" if result.model else "",
    )


def _target_column(state: str) -> Column:
    return Column(f"slip, {state}", "+.2f", of=lambda rows: rows[0].target_slip[state])


STRETCH_COLUMNS = (
    Column("run", of=lambda rows: rows[0].run_id),
    Column("from", ".1f", "s", of=lambda rows: rows[0].start_s),
    Column("windows", of=len),
    Column("terrain", of=lambda rows: rows[0].terrain),
    Column("probability", ".2f", of=lambda rows: fmean(row.probability for row in rows)),
    *map(_target_column, DRIVE_STATES),
)
"""Of windows of a run that follow each other and are of one terrain."""


def _picture(stretches: Sequence[Sequence[WindowPrediction]]) -> Figure | None:
    """Return a strip of terrains for each of the first runs."""
    panels: dict[str, list[tuple[float, float, str]]] = {}
    for rows in stretches:
        step_s = rows[1].start_s - rows[0].start_s if len(rows) > 1 else 2.0
        spans = panels.setdefault(rows[0].run_id, [])
        spans.append((rows[0].start_s, rows[-1].start_s + step_s, rows[0].terrain))
    if not panels:
        return None
    more = f" The first {MAX_STRIPS} of {len(panels)} runs." if len(panels) > MAX_STRIPS else ""
    return Figure(
        "Predicted terrain along the runs",
        [Panel([Strip(spans)], title=name) for name, spans in list(panels.items())[:MAX_STRIPS]],
        caption=f"Colours are terrains.{more}",
        x_label="time [s]",
    )


def _notes(result: Predictions) -> list[Part]:
    without = {row.terrain for row in result.windows if row.slip_entry != row.terrain == row.nearest}
    unestimated = any("unestimated" in row.status.values() for row in result.windows)
    accuracy, answered, accepted = (
        format_value(each, PERCENT)
        for each in (result.filtered_accuracy, result.accuracy_refusing, result.accuracy_accepted)
    )
    refused = "an unmeasured part"
    if result.known_refused is not None:
        rate, low, high = result.known_refused
        refused = f"{format_value(rate, PERCENT)} ({format_value((low, high), PERCENT)}, 95 %)"
    notes = {
        f"{result.n_unknown} of {result.n_windows} windows are like no terrain that was learned, or answer like none: "
        f"unknown, for which the table's fallback is used; of held-out windows of learned ones "
        f"{refused} are": result.n_unknown,
        f"counting unknown as wrong, {answered} are right; of what is not unknown, {accepted}": result.n_judged,
        **dict.fromkeys(result.adapted, True),
        "adapted to the session, so that a window whose terrain has less than 0.7 is unknown, too; that this helps is "
        f"{result.adaptation}": result.adaptation,
        **{
            f"unknown, {reason}: {plural(count, 'window')}": True
            for reason, count in Counter(row.reason for row in result.windows if row.reason).most_common(3)
        },
        f"{result.n_unsupported} predictions are supported by no training run that drove like this": (
            result.n_unsupported
        ),
        f"filtered over time {accuracy} are right; what stays uncertain counts as wrong": (
            result.filtered_accuracy is not None
        ),
        f"{len(result.filtered)} runs had no estimates: filtered as on the robot, sample by sample": result.filtered,
        f"no entry in the table of target slips for {', '.join(sorted(without))}: the fallback is used": without,
        f"target slips of the table {result.table_name!r} are unestimated: not measured": unestimated,
        **{
            f"{count} windows are labelled {name}, which the model was not trained on: not judged": count
            for name, count in result.unknown_labels.items()
        },
        f"windows left out: {format_counts(result.dropped)}": result.dropped,
        f"of so many runs: {format_counts(result.resampled)}": result.resampled,
        f"changed or left out: {format_counts(result.repaired)}": result.repaired,
        **dict.fromkeys(result.skipped or (), True),
    }
    return [Text(text, "note") for text, applies in notes.items() if applies]
