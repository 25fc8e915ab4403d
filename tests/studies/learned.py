"""What a learned term gains on measured sets beside names and the black-box learner, on sessions or runs held out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.data.datasets import load_runs
from pipelines.report.results import Progress, Result, described
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.tree import Column, Report, Table
from terrain.discrepancy.compared import CHANNEL_WORDS, beside_extended
from terrain.discrepancy.diagnosed_runs import chosen_runs, diagnose_runs
from terrain.discrepancy.learner import replay_std
from terrain.effects import CHANNELS, showing
from terrain.errors import ConfigError
from terrain.robots import load_robot

EXAMPLE = "python tests/studies learned --sets drive_husky,drive_marmotte"


class Source(NamedTuple):
    """A measured set: its folder, robot, and the label of its runs, if only some are taken."""

    folder: str
    robot: str
    terrain: str | None = None


SURFACES = ("table", "brown", "gray", "green")

SETS: Mapping[str, Source] = {
    "drive_husky": Source("drive_husky", "husky"),
    "drive_warthog_terrains": Source("drive_warthog_terrains", "warthog"),
    "drive_recordings": Source("drive_recordings", "warthog"),
    "drive_marmotte": Source("drive_marmotte", "marmotte"),
    **{
        f"robotino_{name}": Source("robotino/one_surface", "robotino", name)
        for name in ("table", "brown", "gray", "green")
    },
    **{
        f"borealtc_{name.lower()}": Source("borealtc", "husky", name)
        for name in ("ASPHALT", "FLOORING", "ICE", "SANDY_LOAM", "SNOW")
    },
}


class Settings(BaseSettings):
    """On which sets, and which runs are held out."""

    data: Path = setting(Path(os.environ.get("TERRAIN_DATA", ".")), "Folder of the measured sets.")
    sets: Names = setting(tuple(SETS), "Sets, by commas.")
    seed: int = setting(0, "Of the sessions or runs that are held out.", ge=0)


class Row(NamedTuple):
    """Gains in a channel of a set, on runs held out: parts of the square before."""

    dataset: str
    channel: str
    runs: int  #: held out, or left out in turn
    learner: float  #: black-box learner
    named: float
    extended: float  #: names and learned terms, those that make it worse too
    coverage: float  #: of the 95 % interval of the replay
    products: int  #: of the term; 0 without one
    says: str


class LearnedStudy(Result):
    """What learned terms gain."""

    seed: int = described("of what is held out")
    rows: tuple[Row, ...] = described("gains by set and channel")


def run(settings: Settings, progress: Progress) -> LearnedStudy:
    """Explain each set, and judge its terms on what was held out."""
    if unknown := sorted(set(settings.sets) - set(SETS)):
        raise ConfigError(f"--sets: {unknown[0]!r} is none of {', '.join(SETS)}")
    rows: list[Row] = []
    for i, name in enumerate(settings.sets):
        rows += rows_of_set(name, settings)
        progress("sets", i + 1, len(settings.sets))
    return LearnedStudy.of(settings, rows=tuple(rows))


def rows_of_set(name: str, settings: Settings) -> list[Row]:
    """Return the gains of a set by channel."""
    source = SETS[name]
    robot = load_robot(source.robot)
    loaded = [
        run for run in load_runs(settings.data / source.folder, robot=source.robot) if run.robot == robot.name
    ]
    library = showing(robot.drive, robot.effects)
    found = diagnose_runs(chosen_runs(loaded, robot, source.terrain), robot, library, None, settings.seed)
    terms = [each.term for each in found.learned.values() if each.term is not None]
    extended = (found.extended or found.simulation).with_learned(terms)
    own = {run.run_id: run for run in found.signals}
    judged = [beside_extended(run, own[run.run_id], extended, found.low_pass) for run in found.judged]
    about = extended, found.low_pass, found.noise, found.diagnosis.covariance, found.learned
    stds = [replay_std(own[run.run_id], *about) for run in judged]
    rows, gain = [], found.diagnosis.gain
    for channel, of in gain.channels.items() if gain is not None else ():
        c, each = CHANNELS.index(channel), found.learned.get(channel)
        before, left = (
            np.concatenate([run.residual(after)[:, c] for run in judged]) for after in (False, True)
        )
        known = np.isfinite(left)
        inside = np.abs(left) <= 1.96 * np.concatenate([std[:, c] for std in stds])
        both = 1.0 - float((left[known] ** 2).sum() / (before[known] ** 2).sum())
        term = None if each is None else each.term
        says = (len(term.products), term.says) if term else (0, "")
        named = of.reduction if found.extended is not None else 0.0
        gains = of.learner_reduction, named, both, float(inside[known].mean())
        rows.append(Row(name, channel, len(judged), *gains, *says))
    return rows


def report(result: LearnedStudy) -> Report:
    """Return the gains, and in how many channels the extension reaches nine tenths of the learner's."""
    there = [row for row in result.rows if row.learner > 0.0]
    reached = sum(row.extended >= 0.9 * row.learner for row in there)
    columns = (
        Column("set", of="dataset"),
        Column("channel", of=lambda row: CHANNEL_WORDS[row.channel][0]),
        Column("runs", of="runs"),
        Column("learner", ".0%", of="learner"),
        Column("names", ".0%", of="named"),
        Column("with the term", ".0%", of="extended"),
        Column("covered", ".0%", of="coverage"),
        Column("products", of="products"),
        Column("says", of="says", long=True),
    )
    answer = f"In {reached} of {len(there)} channels that the learner reduces, names and term reach 90 % of its gain."
    return Report("Learned terms on measured sets", answer, parts=(Table(columns, result.rows),))
