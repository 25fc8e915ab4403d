from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.model_selection import StratifiedGroupKFold, cross_val_predict, cross_validate

from features.windows import WindowRule
from pipelines.learn.evaluate import Examples, FoldResult, HeldOut, evaluate, figures_of
from pipelines.learn.protocols import Fold, Samples, folds_of, grouped_samples
from pipelines.learn.recipes import WindowPipeline, feature_matrix, make_recipe
from terrain.errors import ConfigError
from terrain.records import Windows


@pytest.fixture(scope="module")
def samples(drive_all, drive):
    """Windows of runs among which one class has a single run."""
    runs = drive_all(("ASPHALT", "GRASS"), n_runs=4, duration_s=16.0)
    return grouped_samples([*runs, drive("GRAVEL_1", "GRAVEL", 5, duration_s=50.0)], WindowRule())


@pytest.fixture(scope="module")
def results(samples):
    windows = samples.windows
    recipe = make_recipe("svm", seed=3)
    features = feature_matrix(recipe, windows)
    folds = folds_of(samples, "grouped", 1, seed=3)
    examples = Examples(features, windows.terrain.astype(str), samples.group)
    return evaluate(recipe[-1], examples, folds)


def test_scikit_learn_cross_validates_whole_recipes_to_the_same_answers(samples, results):
    windows = samples.windows
    y = windows.terrain.astype(str)
    folds = [(result.fold.train, result.fold.test) for result in results.results]
    expected = cross_val_predict(make_recipe("svm", seed=3), windows, y, cv=folds, method="predict_proba")
    np.testing.assert_allclose(results.probability[0], expected, atol=1e-9)
    found = cross_validate(
        make_recipe("svm", seed=3), windows, y, groups=windows.run_id, cv=folds[:2], return_estimator=True
    )
    report = as_figures(results, samples, 0)
    assert found["test_score"].tolist() == pytest.approx([fold.accuracy for fold in report.folds[:2]])
    for estimator, fold in zip(found["estimator"], report.folds[:2], strict=True):
        assert 0 < estimator[-1].n_inner_fits_ <= 20
        assert estimator[-1].best_._asdict() == fold.chosen
    several = windows[windows.terrain != "GRAVEL"]
    folds_of_runs = StratifiedGroupKFold(2, shuffle=True, random_state=0)
    found = cross_validate(
        make_recipe("svm"), several, several.terrain.astype(str), groups=several.run_id, cv=folds_of_runs
    )
    assert np.all(found["test_score"] > 0.6)


def test_the_recipe_gives_its_last_step_the_run_of_each_window(samples):
    seen = {}

    class Spy:
        def fit(self, X, y, groups=None):
            seen["groups"] = groups
            return self

    windows = samples.windows
    recipe = WindowPipeline([("features", make_recipe("svm")[0]), ("last", Spy())])
    recipe.fit(windows, windows.terrain)
    np.testing.assert_array_equal(seen["groups"], windows.run_id)
    with pytest.raises(ConfigError, match="there is no recipe 'oracle'; there are svm"):
        make_recipe("oracle")


def as_figures(held_out, samples, seed):
    return SimpleNamespace(**figures_of(held_out, samples, seed))


def hand_made(run_ids, start_s, y, answers, folds, classes=("ice", "mud")):
    """Return samples and results in which ``answers`` (repeats, n) are predicted, at 0.8."""
    n = len(y)
    windows = Windows(
        {"imu": np.zeros((n, 1, 4))},
        {"imu": ("gyro_z_radps",)},
        {"imu": 4.0},
        1.0,
        np.asarray(start_s, float),
        np.array(run_ids, dtype=object),
        np.array(y, dtype=object),
    )
    samples = Samples(windows, {}, windows.run_id, 1)
    results = []
    n_repeats = 1 + max(fold.repeat for fold in folds)
    pooled, number = np.full((n_repeats, n, len(classes)), np.nan), np.full((n_repeats, n), -1)
    for fold in folds:
        probability = np.full((len(fold.test), len(classes)), 0.2)
        for row, answer in zip(probability, np.asarray(answers)[fold.repeat][fold.test], strict=True):
            row[classes.index(answer)] = 0.8
        results.append(FoldResult(fold, probability, {}))
        pooled[fold.repeat, fold.test], number[fold.repeat, fold.test] = probability, fold.number
    return samples, HeldOut(np.array(classes), pooled, number, np.array(y), results)


def test_figures_of_hand_made_predictions():
    y = ["ice"] * 4 + ["mud"] * 4
    runs, start_s = ["a", "a", "b", "b", "c", "c", "d", "d"], [0, 1] * 4
    answers = [
        ["ice", "ice", "ice", "mud", "mud", "mud", "mud", "mud"],  # 7 of 8
        ["ice", "ice", "mud", "mud", "mud", "mud", "ice", "mud"],  # 5 of 8
    ]
    none = np.empty(0, dtype=int)
    rows = np.arange(8)
    folds = [Fold(r, k, none, rows[k * 4 : k * 4 + 4]) for r in range(2) for k in range(2)]
    samples, results = hand_made(runs, start_s, y, answers, folds)
    report = as_figures(results, samples, 0)
    assert report.accuracy_per_repeat == (7 / 8, 5 / 8)
    assert report.accuracy == 0.75
    assert report.accuracy_spread == pytest.approx(np.std([7 / 8, 5 / 8], ddof=1))
    assert (report.n_windows, report.n_runs, report.repeats) == (8, 4, 2)
    assert report.confusion == ((5, 3), (1, 7))
    assert report.per_class["ice"].recall == 5 / 8
    assert [fold.accuracy for fold in report.folds] == [0.75, 1.0, 0.5, 0.75]
    # All are equally confident: 0.8 stated, 7/8 and 5/8 right; every window its own bin of mass one.
    assert report.ece == pytest.approx(np.mean([(7 * 0.2 + 1 * 0.8) / 8, (5 * 0.2 + 3 * 0.8) / 8]))
    # Votes are of one or two windows of equal weight: only 'd' could be outvoted, in the second repeat.
    per_run = {row.run_id: row for row in report.per_run}
    assert per_run["b"].accuracy == 0.25
    assert per_run["b"].mistaken_for == "mud"
    low, high = report.accuracy_ci
    assert 0.25 <= low < report.accuracy < high <= 1.0


def test_one_repeat_has_no_spread():
    folds = [Fold(0, 0, np.empty(0, dtype=int), np.arange(4))]
    y = ["ice", "ice", "mud", "mud"]
    samples, results = hand_made(list("abcd"), range(4), y, [y], folds)
    assert as_figures(results, samples, 0).accuracy_spread is None


def test_votes_never_mix_two_runs_whatever_their_names_and_folds():
    # Run x1 in fold 12 and run x11 in fold 2: both would be x112 if names and numbers were just joined.
    y = ["ice"] * 3 + ["mud"] * 3
    runs, start_s = ["x1"] * 3 + ["x11"] * 3, [0, 1, 2, 3, 4, 5]
    folds = [
        Fold(0, 12, np.empty(0, dtype=int), np.arange(3)),
        Fold(0, 2, np.empty(0, dtype=int), np.arange(3, 6)),
    ]
    samples, results = hand_made(runs, start_s, y, [y], folds)
    assert as_figures(results, samples, 0).vote_accuracy == 1.0


def test_a_vote_states_how_many_windows_it_has():
    y = ["ice"] * 3 + ["mud"]
    folds = [Fold(0, 0, np.empty(0, dtype=int), np.arange(4))]
    samples, results = hand_made(["a"] * 3 + ["b"], [0, 1, 2, 0], y, [y], folds)
    assert as_figures(results, samples, 0).vote_windows == (1 + 2 + 3 + 1) / 4


def test_votes_do_not_reach_across_the_blocks_of_a_run():
    y = ["ice"] * 6 + ["mud"]
    folds = [
        Fold(0, 0, np.empty(0, dtype=int), np.arange(3)),
        Fold(0, 1, np.empty(0, dtype=int), np.arange(3, 7)),
    ]
    answers = ["mud", "mud", "mud", "ice", "ice", "ice", "mud"]
    samples, results = hand_made(["a"] * 6 + ["b"], range(7), y, [answers], folds)
    assert as_figures(results, samples, 0).vote_accuracy == 4 / 7
