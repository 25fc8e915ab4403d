"""What adapting to a session gives: changes of a session hidden in held-out runs, and runs of another session.

Half of the runs of each terrain train; in the others gains of the currents between 0.9 and 1.4, offsets (a tenth of the
median current, one standard deviation) and gains of vibration between 0.8 and 1.25 are hidden, one draw a session.  In
every second one each terrain has a further gain and offset of its own.  Runs of a reference are not judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from features.windows import WindowRule, cut_windows, join_windows, layout_of
from pipelines.data.datasets import load_runs
from pipelines.learn.classifier import TerrainClassifier
from pipelines.live.assess import assess
from pipelines.live.model import TerrainModel
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Table
from terrain.classify.adaptation import OFFSET_STD, START_S, Adaptation, corrected, reference_s
from terrain.classify.folds import split_runs
from terrain.records import Array, Windows

EXAMPLE = "python tests/studies adaptation --data robotino/one_surface --other robotino/weights"
GAINS, SHAKING, OWN_GAIN_STD = (0.9, 1.4), (0.8, 1.25), 0.1
MAX_WINDOWS = 150  #: Of a session that are judged, thinned evenly.


class Settings(BaseSettings):
    """Which runs train and are changed, and which are of another session."""

    data: Path = setting(..., "Folder of labelled runs of one session.")
    other: Path | None = setting(None, "Folder of labelled runs of the same robot in another session.")
    recipe: str = setting("svm", "What is trained.")
    seed: int = setting(0, "Deals runs, and draws changes and references.", ge=0)
    sessions: int = setting(8, "Changes that are drawn for each half of the runs.", ge=1)


class Row(NamedTuple):
    """Parts of the windows of sessions, by what the model was adapted by."""

    session: str
    reference: str
    n_windows: int
    right: float  #: the most probable terrain is the true one
    wrong: float  #: wrong and not unknown
    unknown: float
    probability: float  #: mean of the most probable terrain


class AdaptationStudy(Result):
    """What adapting gives on changes that were hidden, and on another session."""

    rows: tuple[Row, ...] = described("by session and reference")
    status: str = described("what training says of adapting unasked")


def run(settings: Settings, progress: Progress = silent) -> AdaptationStudy:
    """Hide changes in held-out runs, adapt by references, and judge the other runs."""
    rng = np.random.default_rng(settings.seed)
    runs = load_runs(settings.data, repair=True)
    layout, rule = layout_of(runs), WindowRule(2.0, None)
    windows = cut_windows(runs, rule, layout=layout, skip_short=True).windows
    y = windows.terrain.astype(str)
    found: dict[tuple[str, str], list[Array]] = {}
    for train, test in split_runs(y, windows.run_id.astype(str), 2, rng):
        model = TerrainClassifier(settings.recipe).fit(windows[train]).model_
        for number in range(settings.sessions):
            kind = ("changed", "changed, each terrain further")[number % 2]
            session = _shift_session(windows[test], model.adaptation, number % 2 == 1, rng)
            for name, outcomes in _references(model, session, rng):
                found.setdefault((kind, name), []).append(outcomes)
    model = TerrainClassifier(settings.recipe).fit(windows).model_
    if settings.other is not None:
        other = load_runs(settings.other, repair=True)
        session = cut_windows(other, rule, layout=layout, skip_short=True).windows
        for _ in range(settings.sessions):
            for name, outcomes in _references(model, session, rng):
                found.setdefault((settings.other.name, name), []).append(outcomes)
    rows = [(key, np.concatenate(each)) for key, each in found.items()]
    assert model.adaptation is not None
    return AdaptationStudy(
        tuple(Row(*key, len(each), *each.mean(axis=0).tolist()) for key, each in rows),
        model.adaptation.status,
    )


def _shift_session(
    windows: Windows, adaptation: Adaptation | None, own: bool, rng: np.random.Generator
) -> Windows:
    """Return windows of a session whose shift is drawn; of each terrain a further one where it has its own."""
    assert adaptation is not None
    of_all = rng.uniform(*GAINS), OFFSET_STD * rng.standard_normal()
    shaking = rng.uniform(*SHAKING)
    parts = []
    for terrain in adaptation.classes:
        gain, offset = of_all
        if own:
            gain, offset = gain + OWN_GAIN_STD * rng.standard_normal(), offset + 0.05 * rng.standard_normal()
        # the inverse of the shift that is hidden: (x - b) / (1 + a) with these is g x + o
        inverse = {
            "gain of currents": 1.0 / gain - 1.0,
            "offset of currents": -offset / gain,
            "gain of vibration": 1.0 / shaking - 1.0,
        }
        theta = np.array([inverse[name] for name in adaptation.parameters])
        parts.append(corrected(adaptation, windows[windows.terrain == terrain], theta))
    return join_windows(parts)


def _references(
    model: TerrainModel, session: Windows, rng: np.random.Generator
) -> Iterator[tuple[str, Array]]:
    """Yield, by the reference, what the model gives for windows of other runs."""
    terrains = np.unique(session.terrain.astype(str)).tolist()
    every = np.ones(len(session), dtype=bool)
    yield "none: as trained", _outcomes(model, session, every)
    yield "none: spread of sessions", _outcomes(model.at_start(), session, every)
    for terrain in terrains:
        used = np.zeros(len(session), dtype=bool)
        for name in rng.permutation(np.unique(session.run_id[session.terrain == terrain].astype(str))):
            if not used.any() or reference_s(session[used]) < START_S - session.length_s:
                used |= session.run_id.astype(str) == name
        for named in (terrain, ""):
            adapted = model.adapt(session[used], named)
            yield named or "not named", _outcomes(adapted, session, ~used)


def _outcomes(model: TerrainModel, session: Windows, rows: Array) -> Array:
    """Return of windows whether they are right, wrong and not unknown, unknown, and their probability (n, 4)."""
    kept = np.flatnonzero(rows)
    kept = kept[:: max(len(kept) // MAX_WINDOWS, 1)]
    found = [assess(model, session[i]) for i in kept]  # each alone: the runs are thinned
    best = np.array([each.probability[0].argmax() for each in found])
    right = np.asarray(model.info.classes)[best] == session.terrain[kept]
    unknown = np.array([each.unknown[0] for each in found])
    top = [each.probability[0].max() for each in found]
    return np.stack([right, ~right & ~unknown, unknown, top], axis=1).astype(float)


def report(result: AdaptationStudy) -> Report:
    """Return the parts side by side."""
    columns = (
        Column("session", of=lambda row: row.session),
        Column("reference, 20 s", of=lambda row: row.reference),
        Column("windows", of=lambda row: row.n_windows),
        Column("right", ".1%", of=lambda row: row.right),
        Column("wrong, not unknown", ".1%", of=lambda row: row.wrong),
        Column("unknown", ".1%", of=lambda row: row.unknown),
        Column("probability", ".2f", of=lambda row: row.probability),
    )
    return Report(
        "Adapting to a session", f"Unasked: {result.status}.", parts=[Table(columns, list(result.rows))]
    )
