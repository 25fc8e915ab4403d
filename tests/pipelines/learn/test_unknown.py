import json

import numpy as np
import pytest

from pipelines.learn import checks
from pipelines.learn.crossval import crossval
from pipelines.report.json_file import as_json
from terrain.errors import DataError


@pytest.fixture(scope="module")
def report(runs, settings):
    return crossval(runs, settings(protocol="leave-terrain-out"))


def test_report_has_the_areas_their_intervals_and_both_rates(report):
    document = as_json(report)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (document["protocol"], document["repeats"], "unknown" in document) == (
        "leave-terrain-out",
        1,
        False,
    )
    assert set(document["unknown_by_terrain"]) == {"ASPHALT", "GRASS", "GRAVEL"}
    for name in ("auroc_unknown", "auroc_unknown_10s"):
        low, high = document[f"{name}_ci"]
        assert 0.0 <= low <= document[name] <= high <= 1.0
    rows = report.unknown_by_terrain.values()
    assert np.mean([row.auroc for row in rows]) == pytest.approx(report.auroc_unknown)
    assert report.auroc_unknown > 0.6  # the middle one of three terrains lies between the others
    assert 0.8 < report.known_kept <= 1.0


def test_two_terrains_and_few_runs_are_refused(runs, settings):
    two = [run for run in runs if run.labels[0].terrain != "GRASS"]
    with pytest.raises(DataError, match=r"2 terrains \(ASPHALT, GRAVEL\).*at least 3"):
        crossval(two, settings(protocol="leave-terrain-out"))
    few = [run for run in runs if run.labels[0].terrain != "GRASS"][::2] + [
        run for run in runs if run.labels[0].terrain == "GRASS"
    ]
    with pytest.raises(DataError, match=r"4 runs without GRASS are fewer than 5 folds"):
        crossval(few, settings(protocol="leave-terrain-out"))


@pytest.mark.slow
def test_no_run_of_the_left_out_terrain_and_no_tested_run_trains(runs, settings, monkeypatch):
    trained = []

    class Recorded(checks.NoveltyScore):
        def fit(self, X, y, groups=None):
            trained.append((set(y), set(groups)))
            return super().fit(X, y, groups)

    monkeypatch.setattr(checks, "NoveltyScore", Recorded)
    crossval(runs, settings(protocol="leave-terrain-out", n_jobs=1))
    terrain_of = {run.run_id: run.labels[0].terrain for run in runs}
    assert len(trained) == 15
    for terrains, groups in trained:
        assert len(terrains) == 2
        assert {terrain_of[group] for group in groups} == terrains
        assert len(groups) < 8  # one of the eight runs of two terrains at least is held out


def test_area_by_runs_is_that_of_all_pairs():
    from sklearn.metrics import roc_auc_score

    rng = np.random.default_rng(0)
    known, new = np.round(rng.normal(size=40), 1), np.round(rng.normal(0.7, 1, 30), 1)
    run_of = np.concatenate([np.repeat(np.arange(4), 10), np.repeat(np.arange(4, 7), 10)])
    part = checks._Scored(np.arange(40), np.arange(40, 70), known, new, 0.0)
    compared = checks._compare([part], run_of)
    expected = roc_auc_score(np.repeat([0, 1], [40, 30]), np.concatenate([known, new]))
    assert compared.won.sum() / compared.pairs.sum() == pytest.approx(expected)
    weights = np.ones((50, 7)) + np.random.default_rng(1).multinomial(7, np.full(7, 1 / 7), 50)
    low, high = checks._interval([compared], weights)
    assert low < expected < high
