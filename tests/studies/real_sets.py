"""What ``terrain explain`` states of measured sets, and whether a label changes it.

Each set is explained without a label, under the soil that it was driven on, under another soil, and under a word that
is no soil, or as its runs are labelled.  The names have to be the same, unless its runs were simulated on a soil since
data held out are predicted better on it; and what is named has to gain on data held out, at least half of what the
learner does.  With learned terms the simulation has to gain nine tenths of what the learner does, to make no channel
worse, and to state intervals that cover.  Right intervals cover 90 to 98 % of two runs in half of all draws, so that
``--draws`` measures over several.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import beta

from pipelines.data.datasets import load_runs
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.tree import Column, Report, Table
from terrain.deviation import Deviation
from terrain.discrepancy.compared import CHANNEL_WORDS, ComparedRun
from terrain.discrepancy.diagnosed_runs import DiagnosedRuns
from terrain.discrepancy.gain import HALF
from terrain.discrepancy.held_out import quarter
from terrain.discrepancy.learner import ENOUGH
from terrain.effects import CHANNELS
from terrain.errors import ConfigError, DataError
from terrain.records import Array, Label, RunLog

EXAMPLE = "python tests/studies real-sets --data ~/sets --sets marmotte,borealtc-SNOW"
FOREIGN = "zork"  #: A label that is no soil
ALL = "all"  #: Channels, in the place of one
COVERS = 0.90, 0.98  #: Accepted coverage of a 95 % interval
LABELS = "none", "own", "other", "foreign", "data"
UNKNOWN = np.nan, (np.nan, np.nan)  #: What was not measured, and its interval
OTHER_THAN = {"grass": "asphalt"}  #: Another soil than that, grass of all others


class Source(NamedTuple):
    """A set: its folder, the robot, the label of the runs that are taken, and the soil that they were driven on."""

    folder: str
    robot: str
    terrain: str | None
    soil: str


SETS = {
    "marmotte": Source("drive_marmotte", "marmotte", None, "snow"),
    "husky": Source("drive_husky", "husky", None, "snow"),
    "husky-wet-grass": Source("drive_recordings/husky_wet_grass", "husky", None, "grass"),
    "warthog-grass": Source("drive_recordings/warthog_grass", "warthog", None, "grass"),
    "warthog-asphalt": Source("drive_recordings/warthog_asphalt", "warthog", None, "asphalt"),
    "warthog": Source("drive_warthog_terrains", "warthog", None, "asphalt"),
    **{
        f"borealtc-{name}": Source("borealtc", "husky", name, soil)
        for name, soil in (
            ("ASPHALT", "asphalt"),
            ("FLOORING", "tiles"),
            ("ICE", "snow"),
            ("SANDY_LOAM", "tilled_loam"),
            ("SNOW", "snow"),
        )
    },
    **{
        f"vulpi-{name}": Source("vulpi", "husky", name, soil)
        for name, soil in (
            ("CONCRETE", "asphalt"),
            ("PLOUGHED", "tilled_loam"),
            ("UNPLOUGHED", "firm_soil_gravel"),
        )
    },
    **{
        f"robotino-{name}": Source("robotino/one_surface", "robotino", name, "tiles")
        for name in ("table", "brown", "gray", "green")
    },
}


class Settings(BaseSettings):
    """Which sets, under which labels."""

    data: Path = setting(Path(os.environ.get("TERRAIN_DATA", ".")), "Folder of the measured sets.")
    sets: Names = setting(tuple(SETS), "Sets, by commas.")
    labels: Names = setting(LABELS[:4], "Labels that the runs are given, by commas; data: their own.")
    draws: int = setting(1, "Draws of the runs held out, over which coverage is measured.", ge=1)
    every: int = setting(1, "Of the runs each so many-th is taken: 2 takes half.", ge=1)


class Row(NamedTuple):
    """What is stated of a set under a label."""

    name: str
    label: str
    soil: str  #: on which the runs were simulated; empty for the default ground
    causes: str  #: with their values
    names: tuple[str, ...]  #: named, and sets
    gain: float  #: on data held out
    gain_ci: tuple[float, float]
    least: float  #: lower end of the least interval of a cause's gain, where it acts; NaN without a cause
    learner_gain: float
    tiers: str  #: by channel
    cpu_s: float


class WholeRow(NamedTuple):
    """What names and learned terms gain in a channel of a set, on runs held out or left out in turn."""

    name: str
    label: str
    channel: str  #: ``all`` for all of them, by their noise
    named_gain: float
    gain: float  #: with learned terms; where no run is held out these are not judged
    gain_ci: tuple[float, float]
    learner_gain: float
    coverage: float  #: of the 95 % interval of the replay with those that are kept
    coverage_ci: tuple[float, float]  #: 95 % interval of that, by how runs differ
    says: str  #: of the term


class RealSets(Result):
    """What is stated of measured sets under labels."""

    rows: tuple[Row, ...] = described("a row a set and label")
    whole: tuple[WholeRow, ...] = described("a row a channel of these, with learned terms")
    changed: tuple[str, ...] = described("sets of which a label changes names without a better ground")
    not_earned: tuple[str, ...] = described("sets with names whose gain is under its bars")


def relabelled(runs: Sequence[RunLog], label: str) -> list[RunLog]:
    """Return runs with one label throughout, or none for the empty one."""
    out = []
    for run in runs:
        times = [stream.time_s[[0, -1]] for stream in run.streams.values()]
        ends = float(np.min(times)), float(np.max(times))
        out.append(replace(run, labels=(Label(*ends, label),) if label else ()))
    return out


def explain_set(name: str, label: str, runs: Sequence[RunLog], draws: int = 1) -> tuple[Row, list[WholeRow]]:
    """Return what is stated of runs of a set under a label, and what that gains with learned terms."""
    import terrain

    soil = SETS[name].soil
    given = {"none": "", "own": soil, "other": OTHER_THAN.get(soil, "grass"), "foreign": FOREIGN}
    runs = relabelled(runs, given[label]) if label in given else list(runs)
    start_s = time.process_time()
    try:
        about = runs, SETS[name].robot
        result, *more = [
            terrain.explain(*about, hold_out=quarter(len(runs)), seed=seed) for seed in range(draws)
        ]
    except DataError as error:
        return Row(name, label, "", str(error), (), *UNKNOWN, np.nan, np.nan, "", np.nan), []
    cpu_s = (time.process_time() - start_s) / draws
    found, gain = result.diagnosis, result.diagnosis.gain
    causes = [
        f"{cause.name} {', '.join(f'{value.value:.3g}' for value in cause.parameters)}"
        for cause in found.causes
    ]
    sets = [f"one of {', '.join(sorted(names))}" for names in found.ambiguous_sets]
    row = Row(
        name,
        label,
        ", ".join(match.soil for match in result.diagnosed.terrains if match.soil),
        "; ".join([*causes, *sets]),
        tuple(sorted([*[cause.name for cause in found.causes], *sets])),
        gain.reduction if gain else np.nan,
        gain.ci if gain else UNKNOWN[1],
        min([cause.gain_ci[0] for cause in found.built_in], default=np.nan),
        gain.learner_reduction if gain else np.nan,
        "; ".join(f"{one.channel} {one.tier.value if one.tier else 'agrees'}" for one in found.channels),
        cpu_s,
    )
    return row, whole_rows(name, label, [each.diagnosed for each in (result, *more)])


def whole_rows(name: str, label: str, draws: Sequence[DiagnosedRuns]) -> list[WholeRow]:
    """Return what names and learned terms gain by channel, and what the intervals of the replay cover over all draws.

    Terms are decided on by the runs that fit them.  Where no run is held out, they are not judged.  Gains are those of
    the first draw.
    """
    found = draws[0]
    gain, named = found.whole_gain, found.diagnosis.gain
    says = {shown: each.term.says for shown, each in found.learned.items() if each.term is not None}
    rows = []
    for channel, of in gain.channels.items():
        covered = coverage_of(covered_runs(draws, channel))
        before = named.channels[channel].reduction if named and channel in named.channels else np.nan
        gains = before, of.reduction, of.ci, of.learner_reduction
        rows.append(WholeRow(name, label, channel, *gains, *covered, says.get(channel, "")))
    before = named.reduction if named else np.nan
    gains = before, gain.reduction, gain.ci, gain.learner_reduction
    return [*rows, WholeRow(name, label, ALL, *gains, *UNKNOWN, "")]


def coverage_of(runs: Sequence[Array]) -> tuple[float, tuple[float, float]]:
    """Return which part of the rows (k,) of runs is covered, and its 95 % interval, that of a binomial proportion.

    It is of as many independent rows as the coverage scatters over runs, and of one a run at the least (Jeffreys'
    interval: Brown, Cai and DasGupta, Statistical Science 2001).

    Examples
    --------
    >>> runs = [np.arange(100) < n for n in (90, 95, 96, 99)]
    >>> part, (low, high) = coverage_of(runs)
    >>> part, round(low, 2), round(high, 2)
    (0.95, 0.9, 0.98)
    """
    runs = [run for run in runs if run.size]
    if not runs:
        return UNKNOWN
    rows, inside = np.array([(run.size, run.sum()) for run in runs]).T
    part, n = float(inside.sum() / rows.sum()), len(runs)
    square = float((((inside - part * rows) / rows.sum()) ** 2).sum()) * n / max(n - 1, 1)
    n_rows = max(part * (1.0 - part) / square, n) if square > 0.0 else n
    low, high = beta.ppf([0.025, 0.975], part * n_rows + 0.5, (1.0 - part) * n_rows + 0.5).tolist()
    return part, (low, high)


def covered_runs(draws: Sequence[DiagnosedRuns], channel: str) -> list[Array]:
    """Return of each run that was held out in some draw whether its rows (k,), of all these draws, are covered."""
    covered: dict[str, list[Array]] = {}
    for found in draws:
        behind = {run.run_id for run in found.fit}
        for run in found.whole:
            if run.run_id not in behind:
                covered.setdefault(run.run_id, []).append(covered_rows(run, found.deviation, channel))
    return [np.concatenate(rows) for rows in covered.values()]


def covered_rows(run: ComparedRun, deviation: Deviation, channel: str) -> Array:
    """Return of the rows of a run (k,) where a channel is known whether its 95 % interval covers them."""
    if channel not in deviation.channels:
        return np.empty(0)
    residual = (run.measured - run.simulated)[:, CHANNELS.index(channel)]
    half = deviation.channels[channel].half_95(run.speed_mps, run.inputs["turn_mps"])
    return np.asarray((np.abs(residual) <= half)[np.isfinite(residual)])


def run(settings: Settings, progress: Progress = silent) -> RealSets:
    """Explain sets under labels."""
    if unknown := [name for name in settings.sets if name not in SETS]:
        raise ConfigError(f"there is no set {unknown[0]!r}; there are {', '.join(SETS)}")
    if unknown := [label for label in settings.labels if label not in LABELS]:
        raise ConfigError(f"--labels has {unknown[0]!r}; {', '.join(LABELS)} are accepted")
    rows: list[Row] = []
    whole: list[WholeRow] = []
    for name in settings.sets:
        of = SETS[name]
        runs = list(load_runs(settings.data / of.folder, robot=of.robot))
        runs = [run for run in runs if of.terrain is None or run.terrains == (of.terrain,)][:: settings.every]
        for label in settings.labels:
            row, channels = explain_set(name, label, runs, settings.draws)
            rows.append(row)
            whole += channels
            progress("sets", len(rows), len(settings.sets) * len(settings.labels))
    first = {row.name: row for row in reversed(rows)}
    changed = [
        f"{row.name} {row.label}" for row in rows if row.names != first[row.name].names and not row.soil
    ]
    named = [row for row in rows if row.names]
    weak = [row for row in named if not (row.least > 0.0 and row.gain >= HALF * row.learner_gain)]
    return RealSets(
        tuple(rows), tuple(whole), tuple(changed), tuple(f"{row.name} {row.label}" for row in weak)
    )


def report(result: RealSets) -> Report:
    """Return what is stated, and where a label changes it."""
    columns = (
        Column("set", of="name"),
        Column("label", of="label"),
        Column("soil", of="soil"),
        Column("causes", of="causes"),
        Column("gain", ".0%", of="gain"),
        Column("95 %", ".0%", of="gain_ci"),
        Column("least of a cause", ".0%", of="least"),
        Column("learner", ".0%", of="learner_gain"),
        Column("channels", of="tiers"),
        Column("CPU", ".0f", "s", of="cpu_s"),
    )
    answer = (
        f"A label changes names without a better ground in {len(result.changed)} of {len(result.rows)} results; of "
        f"{len(result.not_earned)} results with names the gain is under its bars."
    )
    note = "; ".join(
        f"{text}: {', '.join(names)}"
        for text, names in (("changed", result.changed), ("not earned", result.not_earned))
        if names
    )
    of_whole = (
        Column("set", of="name"),
        Column("label", of="label"),
        Column("channel", of=lambda row: ALL if row.channel == ALL else CHANNEL_WORDS[row.channel][0]),
        Column("names", ".0%", of="named_gain"),
        Column("with terms", ".0%", of="gain"),
        Column("95 %", ".0%", of="gain_ci"),
        Column("learner", ".0%", of="learner_gain"),
        Column("covered", ".0%", of="coverage"),
        Column("95 %", ".0%", of="coverage_ci"),
        Column("says", of="says", long=True),
    )
    there = [row for row in result.whole if row.channel == ALL and row.learner_gain > 0.0]
    worse = [row for row in result.whole if row.gain < 0.0]
    worse_by_term = [row for row in result.whole if row.says and row.gain < row.named_gain]
    covered = [row for row in result.whole if np.isfinite(row.coverage)]
    apart = [row for row in covered if row.coverage_ci[1] < COVERS[0] or row.coverage_ci[0] > COVERS[1]]
    of_terms = (
        f"With terms the gain is at least 90 % of the learner's in "
        f"{sum(row.gain >= ENOUGH * row.learner_gain for row in there)} of {len(there)} results; {len(worse)} of "
        f"{len(result.whole)} rows are worse than before, {len(worse_by_term)} by a term; intervals cover 90 "
        f"to 98 % in {sum(COVERS[0] <= row.coverage <= COVERS[1] for row in covered)} of {len(covered)}, and in "
        f"{len(apart)} the interval of that, by run, is outside."
    )
    parts = (Table(columns, result.rows, note=note), Table(of_whole, result.whole, note=of_terms))
    return Report("Measured sets under labels", answer, parts=parts)
