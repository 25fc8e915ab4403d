"""What each signal set is worth to the classifier, on all labelled sets, beside a plain baseline.

Slip is given where it is known: against a lidar or a camera (``terrain estimate --filter pose``), else by the filter
of skid-steer robots, whose slip is NaN where nothing measures the speed over ground.  Sessions are held out, runs where
there are none, and differences are paired by them.  All recipes are judged on the same windows: those of runs that
have a slip, of streams that all runs have.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from features.protocols import folds_of, samples_of
from features.recipes import feature_matrix, make_recipe
from features.windows import WindowRule
from pipelines.data.datasets import load_runs
from pipelines.learn.evaluate import evaluate
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import JobsSettings, Names, setting
from pipelines.report.tree import Column, Report, Table
from pipelines.slip.estimate import Filter, estimate_runs
from terrain.classify.held_out import Examples
from terrain.classify.metrics import Difference, Outcome, compare_outcomes
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS, signal_set_of
from terrain.records import RunLog
from terrain.robots import load_robot

EXAMPLE = "python tests/studies ablation --data ~/sets --sets borealtc"
MEASURED = ("imu", "wheels", "currents")  #: What a robot without a measurement from outside has
BASELINE = "plain"


class Source(NamedTuple):
    """A labelled set: its folders with the robot of each, and what gives slip."""

    folders: Mapping[str, str]
    filter: Filter


SETS = {
    "borealtc": Source({"borealtc": "husky"}, "slip"),
    "vulpi": Source({"vulpi": "husky"}, "slip"),
    "drive_warthog_terrains": Source({"drive_warthog_terrains": "warthog"}, "pose"),
    "drive_recordings": Source(
        {
            "drive_recordings/warthog_grass": "warthog",
            "drive_recordings/warthog_asphalt": "warthog",
            "drive_recordings/husky_wet_grass": "husky",
        },
        "pose",
    ),
    "robotino": Source({"robotino/one_surface": "robotino", "robotino/weights": "robotino"}, "pose"),
}


class Settings(JobsSettings):
    """On which sets, and by which recipes."""

    data: Path = setting(Path(os.environ.get("TERRAIN_DATA", ".")), "Folder of the measured sets.")
    sets: Names = setting(tuple(SETS), "Sets, by commas.")
    recipes: Names = setting(("svm", "trees"), "Recipes on features, by commas.")
    repeats: int = setting(2, "Fold assignments.", ge=1)
    seed: int = setting(0, "Deals units into folds.", ge=0)


class Worth(NamedTuple):
    """Accuracy of a recipe without a signal set, or of the baseline, against all signals."""

    dataset: str
    recipe: str
    signals: str  #: ``without SET``, or the baseline
    found: Difference  #: from all signals to this


class Ablation(Result):
    """What signal sets are worth."""

    repeats: int = described("fold assignments")
    units: Mapping[str, str] = described("windows and units by set")
    rows: tuple[Worth, ...] = described("accuracy by set, recipe and signals")


def runs_with_slip(source: Source, data: Path) -> list[RunLog]:
    """Return the runs of a set with a slip, and of their streams those that all have."""
    runs: list[RunLog] = []
    for folder, robot in source.folders.items():
        loaded = load_runs(data / folder, robot=robot)
        runs += estimate_runs(loaded, load_robot(robot), source.filter).runs
    common = set.intersection(*(set(run.streams) for run in runs))
    kept = []
    for run in runs:
        streams = {name: each for name, each in run.streams.items() if name in common}
        kept.append(
            RunLog(run.run_id, run.robot, streams, run.labels, session=run.session, filter=run.filter)
        )
    return kept


def ablate(name: str, settings: Settings, progress: Progress) -> tuple[str, list[Worth]]:
    """Return windows and units of a set in words, and what signals are worth to each recipe."""
    samples = samples_of(runs_with_slip(SETS[name], settings.data), WindowRule(), skip_short=True)
    windows, unit = samples.windows, samples.unit
    folds = folds_of(samples, "grouped", settings.repeats, settings.seed)
    held = {signal_set_of(stream, each) for stream, names in windows.channels.items() for each in names}
    present = [each for each in SIGNAL_SETS if each in held]

    def outcome(recipe: str, sets: list[str]) -> Outcome:
        made = make_recipe(recipe, sets, seed=settings.seed)
        examples = Examples(feature_matrix(made, windows), samples.terrain, samples.group)
        task = f"{name}, {recipe} of {' '.join(sets)}"
        return Outcome.of(evaluate(made[-1], examples, folds, settings.jobs, task, progress), unit)

    plain, rows = outcome(BASELINE, [each for each in present if each in MEASURED]), []
    for recipe in settings.recipes:
        whole = outcome(recipe, present)
        others = {f"without {left}": outcome(recipe, [s for s in present if s != left]) for left in present}
        for signals, other in {**others, BASELINE: plain}.items():
            found = compare_outcomes(whole, other, np.random.default_rng(settings.seed)).accuracy
            rows.append(Worth(name, recipe, signals, found))
    with_session = unit != samples.run_id
    kind = "runs" if not with_session.any() else "sessions" if with_session.all() else "sessions or runs"
    return f"{len(windows)} windows of {len(np.unique(unit))} {kind}", rows


def run(settings: Settings, progress: Progress = silent) -> Ablation:
    """Leave out signal sets in turn."""
    if unknown := [name for name in settings.sets if name not in SETS]:
        raise ConfigError(f"there is no set {unknown[0]!r}; there are {', '.join(SETS)}")
    units, rows = {}, list[Worth]()
    for name in settings.sets:
        units[name], found = ablate(name, settings, progress)
        rows += found
    return Ablation(settings.repeats, units, tuple(rows))


def report(result: Ablation) -> Report:
    """Return the accuracy with all signals, and what is lost without each set."""
    slip = [
        row for row in result.rows if row.signals == "without slip" and row.recipe == result.rows[0].recipe
    ]
    parts = [f"{-100 * row.found.difference:+.1f} points on {row.dataset}" for row in slip]
    columns = (
        Column("set", of="dataset"),
        Column("recipe", of="recipe"),
        Column("signals", of="signals"),
        Column("all", ".1%", of=lambda row: row.found.a),
        Column("these", ".1%", of=lambda row: row.found.b),
        Column("difference", "+.1f", "points", of=lambda row: 100 * row.found.difference),
        Column("95 %", "+.1f", "points", of=lambda row: tuple(100 * np.array(row.found.interval))),
    )
    answer = (
        f"Slip and what follows from it are worth {', '.join(parts)} ({slip[0].recipe})."
        if slip
        else "No slip."
    )
    note = "; ".join(f"{name}: {units}" for name, units in result.units.items())
    return Report("Signal sets left out in turn", answer, parts=(Table(columns, result.rows, note=note),))
