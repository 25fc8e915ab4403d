import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from features.windows import WindowRule
from pipelines.learn import checks
from pipelines.learn.checks import (
    CURVE_DRAWS,
    learning_curve,
    slow_fast,
    stiffness_figures,
)
from pipelines.learn.crossval import crossval
from pipelines.learn.evaluate import Examples, HeldOut, evaluate
from pipelines.learn.protocols import folds_of, grouped_samples, run_speeds, slow_fast_split
from pipelines.learn.recipes import feature_matrix, make_recipe, recipe_of
from pipelines.report.json_file import as_json
from terrain.classify import unknown_figures
from terrain.classify.learning_curve import enough_runs
from terrain.classify.unknown_figures import Scored
from terrain.errors import ConfigError, DataError
from terrain.records import RunLog, Stream

SPEEDS = (0.3, 0.4, 0.7, 0.8)
PLAIN = WindowRule(steady=None)


@pytest.fixture
def runs_at(drive):
    """Return a maker of runs of one terrain, one a speed."""

    def make(terrain, speeds, duration_s=32.0, **options):
        return [
            drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), duration_s, speed_mps=speed, **options)
            for i, speed in enumerate(speeds)
        ]

    return make


def joined(run_id, first, second, duration_s):
    """Return a run over the terrains of two, one after the other."""
    streams = {
        name: Stream(
            np.concatenate([a.time_s, second.streams[name].time_s + duration_s]),
            np.concatenate([a.values, second.streams[name].values]),
            a.channels,
        )
        for name, a in first.streams.items()
    }
    terrains = first.labels[0].terrain, second.labels[0].terrain
    labels = ((0.0, duration_s, terrains[0]), (duration_s, 2 * duration_s, terrains[1]))
    return RunLog(run_id, "husky", streams, labels)


def test_the_speed_of_a_run_is_that_of_its_faster_wheel_where_it_moves(drive):
    run = drive("r", "GRASS", 0, 40.0)
    wheels = run.streams["wheels"]
    values = wheels.values.copy()
    values[:, 0], values[:, 1] = 0.2, -0.6  # turning: the right wheel is faster, backwards
    values[:240, :2] = [0.02, -0.01]  # it creeps, or rests, for 24 of 40 s
    moving = Stream(wheels.time_s, values.copy(), wheels.channels)
    values[:, :2] = 0.0
    standing = Stream(wheels.time_s, values, wheels.channels)
    moved = replace(run, streams=run.streams | {"wheels": moving})
    still = replace(run, run_id="s", streams=run.streams | {"wheels": standing})
    speeds = run_speeds(grouped_samples([moved, still], PLAIN).windows)
    assert speeds["r"] == pytest.approx(0.6)
    assert np.isnan(speeds["s"])


def test_each_class_is_split_at_its_own_median_speed(runs_at):
    plan = {"ASPHALT": SPEEDS, "GRASS": (0.9, 0.5, 1.0, 0.6), "GRAVEL": (0.1, 0.2, 0.3, 0.4, 0.5)}
    samples = grouped_samples([r for t, s in plan.items() for r in runs_at(t, s)], WindowRule())
    split = slow_fast_split(samples)
    assert split.left_out == {}
    slow, fast = (set(samples.run_id[split.side == side].tolist()) for side in ("slow", "fast"))
    assert slow == {"ASPHALT_0", "ASPHALT_1", "GRASS_1", "GRASS_3", "GRAVEL_0", "GRAVEL_1", "GRAVEL_2"}
    assert fast == {"ASPHALT_2", "ASPHALT_3", "GRASS_0", "GRASS_2", "GRAVEL_3", "GRAVEL_4"}
    assert split.classes["GRASS"].slow_mps == pytest.approx(0.55, abs=0.02)
    assert split.classes["GRASS"].fast_mps == pytest.approx(0.95, abs=0.02)


def test_a_class_with_too_little_on_a_side_is_left_out_and_named(runs_at):
    enough = [*runs_at("ASPHALT", SPEEDS), *runs_at("GRASS", SPEEDS)]
    three = runs_at("GRAVEL", (0.3, 0.4, 0.8), 64.0)
    samples = grouped_samples(enough + three, WindowRule())
    split = slow_fast_split(samples)
    assert split.left_out == {"GRAVEL": "fast runs: 1"}
    assert set(split.classes) == {"ASPHALT", "GRASS"}
    assert slow_fast(None, None, samples, 1).status == "not applicable"  # three classes are needed
    assert set(split.side[samples.terrain == "GRAVEL"]) == {""}
    # 2 x 28 s a side are too short; windows that overlap cover no more of them, though they are more.
    short = runs_at("GRAVEL", SPEEDS, 28.0)
    for stride_s in (None, 0.5):
        split = slow_fast_split(grouped_samples(enough + short, WindowRule(2.0, stride_s)))
        assert split.left_out == {"GRAVEL": "slow runs: 56 s"}


def test_what_is_learned_slow_and_does_not_apply_fast_is_detected(runs_at, settings):
    """The vibration of a fast run is that of the next terrain driven slowly; in the control it is its own."""
    levels = {"ASPHALT": 0.3, "GRASS": 0.8, "GRAVEL": 2.0}
    following = dict(zip(levels, [*list(levels.values())[1:], levels["ASPHALT"]], strict=True))
    common = {"smoothness": 0.4, "current_a": 2.0}
    accuracy = {}
    for name, fast_levels in (("own", levels), ("next", following)):
        runs = [
            run
            for terrain in levels
            for side, fast in (((0.3, 0.4), False), ((0.7, 0.8), True))
            for run in runs_at(
                terrain, (0.0, 0.0, *side) if fast else side,
                level=(fast_levels if fast else levels)[terrain], **common,
            )[2 if fast else 0 :]
        ]  # fmt: skip
        samples = grouped_samples(runs, WindowRule())
        recipe = make_recipe("svm", ("imu",))
        accuracy[name] = slow_fast(recipe[-1], feature_matrix(recipe, samples.windows), samples, 1)
    assert accuracy["own"].slow_to_fast > 0.9
    assert accuracy["own"].fast_to_slow > 0.9
    assert accuracy["next"].slow_to_fast < 0.1
    assert accuracy["next"].fast_to_slow < 0.1


def test_speed_alone_is_right_just_where_terrains_were_driven_at_speeds_of_their_own(
    drive, settings, monkeypatch
):
    alike = {"level": 0.8, "smoothness": 0.4, "current_a": 2.0, "duration_s": 12.0}
    monkeypatch.setattr(checks, "CURVE_RUNS", ())
    accuracy = []
    for own_speeds in (True, False):
        runs = [
            drive(
                f"{t}_{i}",
                t,
                7 * i + k,
                speed_mps=0.3 + 0.2 * (k if own_speeds else i % 4) + 0.01 * i,
                **alike,
            )
            for k, t in enumerate(("ASPHALT", "GRASS", "GRAVEL"))
            for i in range(5)
        ]
        accuracy.append(crossval(runs, settings(extras=True)).speed_only_accuracy)
    assert accuracy[0] > 0.95
    assert accuracy[1] < 0.55


@pytest.mark.slow
def test_the_learning_curve_draws_that_many_runs_and_leaves_test_folds_alone(drive_all, drive, monkeypatch):
    runs = [*drive_all(("ASPHALT", "GRASS"), 5, duration_s=10.0), drive("GRAVEL_1", "GRAVEL", 1, 40.0)]
    samples = grouped_samples(runs, WindowRule())
    windows = samples.windows
    recipe = make_recipe("svm")
    folds = folds_of(samples, "grouped", 1, 0)
    seen = []

    def spy(classifier, examples, drawn, *rest):
        seen.extend(drawn)
        return evaluate(classifier, examples, drawn, *rest)

    monkeypatch.setattr(checks, "evaluate", spy)
    examples = Examples(feature_matrix(recipe, windows), windows.terrain.astype(str), samples.group)
    curve = learning_curve(recipe[-1], examples, folds, 0.77, 0, 1)
    assert len(seen) == 3 * CURVE_DRAWS * len(folds)  # 1, 2 and 3 of the 4 training runs of each fold
    for fold in seen:
        (original,) = [f for f in folds if np.array_equal(f.test, fold.test)]
        assert set(fold.train) <= set(original.train)
        size = 1 + fold.repeat // CURVE_DRAWS
        for terrain, n_runs in (("ASPHALT", size), ("GRASS", size), ("GRAVEL", 1)):
            drawn = set(windows.run_id[fold.train][windows.terrain[fold.train] == terrain])
            assert len(drawn) == n_runs
        kept = set(windows.run_id[fold.train])  # a run that is drawn is drawn whole
        np.testing.assert_array_equal(
            fold.train, original.train[np.isin(windows.run_id[original.train], list(kept))]
        )
    draws = [{tuple(f.train) for f in seen if f.repeat == draw} for draw in range(CURVE_DRAWS)]
    assert draws[0] != draws[1]
    assert curve.runs_per_class == pytest.approx([1.0, (2 + 2 + 1) / 3, (3 + 3 + 1) / 3, (4 + 4 + 1) / 3])
    assert curve.accuracy[-1] == 0.77
    assert curve.accuracy_spread[-1] is None
    assert all(0 <= accuracy <= 1 for accuracy in curve.accuracy)


@pytest.mark.parametrize(("scale", "power"), [(0.3, 1.0), (0.2, 0.6), (0.4, 1.5)])
def test_enough_runs_of_a_known_law(scale, power):
    m = np.array([1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
    found = enough_runs(m, 0.95 - scale * m**-power)
    # Doubling m gains scale m^-power (1 - 2^-power); solved for a gain of one per cent.
    law = (100 * scale * (1 - 2.0**-power)) ** (1 / power)
    assert found.n_runs == pytest.approx(law, abs=1.05)
    assert found.statement.startswith("enough:" if found.n_runs <= 12 else "not enough yet:")


def test_a_curve_that_still_climbs_gives_no_number():
    m = np.array([1.0, 2.0, 3.0, 4.0])
    found = enough_runs(m, 0.1 + 0.1 * np.log2(m))
    assert found.n_runs is None
    assert found.statement.startswith("not enough yet: doubling the 4.0 runs per class would still gain")
    assert (
        enough_runs(m[:3], m[:3] / 4).statement == "3 sizes are too few to estimate how many runs are enough"
    )
    assert enough_runs(m, np.full(4, 0.8)).n_runs == 1


def test_a_protocol_and_the_extra_of_one_name_give_one_number(runs_at, settings):
    runs = [run for terrain in ("ASPHALT", "GRASS", "GRAVEL") for run in runs_at(terrain, SPEEDS)]
    samples = grouped_samples(runs, WindowRule())
    recipe = recipe_of(settings())
    extra = slow_fast(recipe[-1], feature_matrix(recipe, samples.windows), samples, 1)
    for protocol, expected in (("slow-fast", extra.slow_to_fast), ("fast-slow", extra.fast_to_slow)):
        report = crossval(runs, settings(protocol=protocol))
        assert report.accuracy == pytest.approx(expected)
        assert len(report.folds) == 1
        trained, tested = protocol.split("-")
        assert report.notes[0].startswith(f"{tested} runs held out, {trained} ones trained on")
        fast = {run.run_id[-1] for run in report.per_run} == {"2", "3"}
        assert fast == (tested == "fast")
        assert report.n_windows == report.folds[0].n_test == sum(run.n_windows for run in report.per_run)


def test_a_speed_protocol_on_runs_of_one_speed_is_one_sentence(runs_at, settings):
    runs = [run for terrain in ("ASPHALT", "GRASS", "GRAVEL") for run in runs_at(terrain, (0.5,))]
    with pytest.raises(DataError, match=r"^slow and fast runs are compared on 3 terrains .*GRASS: slow"):
        crossval(runs, settings(protocol="slow-fast"))
    with pytest.raises(ConfigError, match=r"^'fast-slow' has a single fold assignment"):
        settings(protocol="fast-slow", repeats=3)


def test_a_run_slow_on_one_class_and_fast_on_another_is_on_no_side(runs_at, settings, monkeypatch):
    """Its windows would otherwise train and test at once."""
    folds = []
    monkeypatch.setattr(
        checks, "evaluate", lambda *args: folds.extend(args[2]) or SimpleNamespace(accuracies=[0.5, 0.5])
    )
    runs = [run for terrain in ("ASPHALT", "GRASS", "GRAVEL") for run in runs_at(terrain, SPEEDS)]
    slow_grass, fast_gravel = (next(r for r in runs if r.run_id == name) for name in ("GRASS_0", "GRAVEL_3"))
    mixed = joined("mixed", slow_grass, fast_gravel, 32.0)
    samples = grouped_samples([r for r in runs if r not in (slow_grass, fast_gravel)] + [mixed], WindowRule())
    split = slow_fast_split(samples)
    assert set(split.side[samples.run_id == "mixed"]) == {""}
    slow_fast(None, None, samples, 1)
    assert len(folds) == 2
    run_id = samples.windows.run_id
    for fold in folds:
        assert not set(run_id[fold.train]) & set(run_id[fold.test])
        assert "mixed" not in run_id[np.concatenate([fold.train, fold.test])]


@pytest.mark.slow
def test_runs_with_several_labels_can_be_learned_from_few(drive, settings):
    """One group may hold all classes: the inner folds are then as many as the groups allow."""
    runs = []
    for number in range(6):
        a, b = (drive(f"r{number}", terrain, number, 12.0) for terrain in ("GRASS", "GRAVEL"))
        runs.append(joined(f"r{number}", a, b, 12.0))
    report = crossval(runs, settings(repeats=1, extras=True))
    assert report.learning_curve.runs_per_class[0] == 1.0
    assert {row.run_id for row in report.per_run} >= {"r0 (GRASS)", "r0 (GRAVEL)"}


@pytest.fixture(scope="module")
def report(runs, settings):
    return crossval(runs, settings(protocol="leave-terrain-out"))


def test_report_has_the_areas_their_intervals_and_both_rates(report):
    document = as_json(report)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (document["protocol"], document["repeats"]) == ("leave-terrain-out", 1)
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
    part = Scored(np.arange(40), np.arange(40, 70), known, new, 0.0)
    compared = unknown_figures._compare([part], run_of)
    expected = roc_auc_score(np.repeat([0, 1], [40, 30]), np.concatenate([known, new]))
    assert compared.won.sum() / compared.pairs.sum() == pytest.approx(expected)
    weights = np.ones((50, 7)) + np.random.default_rng(1).multinomial(7, np.full(7, 1 / 7), 50)
    low, high = unknown_figures._interval([compared], weights)
    assert low < expected < high


NAMES = {"ASPHALT": "ASPHALT", "GRASS": "CONCRETE", "GRAVEL": "SNOW"}
"""Two hard terrains and a soft one, in place of the names of the drawn runs."""


@pytest.fixture(scope="module")
def drawn(drive_all, settings):
    runs = drive_all(n_runs=4)
    samples = grouped_samples(runs, settings().rule)
    windows = samples.windows
    windows = replace(windows, terrain=np.array([NAMES[name] for name in windows.terrain], dtype=object))
    samples = samples._replace(windows=windows)
    return samples, feature_matrix(make_recipe("svm"), windows)


def held_out(samples, predicted, certainty=1.0):
    """Return probabilities of one repeat that put ``certainty`` on each predicted class."""
    classes = np.unique(samples.windows.terrain.astype(str))
    column = np.searchsorted(classes, predicted)
    rest = (1 - certainty) / (len(classes) - 1)
    probability = np.full((1, len(column), len(classes)), rest)
    probability[0, np.arange(len(column)), column] = certainty
    return HeldOut(classes, probability, np.zeros((1, len(column)), dtype=int), classes[column], [])


def test_a_wrong_class_of_the_right_level_costs_little(drawn):
    samples, features = drawn
    terrain = samples.windows.terrain.astype(str)
    right = stiffness_figures(held_out(samples, terrain), features, samples, 0)
    assert (right.accuracy, right.cost, right.soft_hard_ratio) == (1.0, 0.0, 0.0)
    paved = np.where(terrain == "ASPHALT", "CONCRETE", terrain)
    within = stiffness_figures(held_out(samples, paved), features, samples, 0)
    share = float(np.mean(terrain == "ASPHALT"))
    assert (within.accuracy, within.cost) == (1.0, pytest.approx(0.25 * share))
    snow = np.where(terrain == "ASPHALT", "SNOW", terrain)
    apart = stiffness_figures(held_out(samples, snow), features, samples, 0)
    assert apart.cost == apart.soft_hard_ratio == pytest.approx(share)
    assert apart.accuracy == pytest.approx(1 - share)
    assert apart.cost_ci[0] <= apart.cost <= apart.cost_ci[1]
    assert -1.0 <= apart.clusters.interval[0] <= apart.clusters.interval[1] <= 1.0
    assert apart.levels == {"ASPHALT": "HARD", "CONCRETE": "HARD", "SNOW": "SOFT"}


def test_two_hard_classes_together_outweigh_a_more_probable_soft_one(drawn):
    samples, features = drawn
    terrain = samples.windows.terrain.astype(str)
    doubtful = stiffness_figures(held_out(samples, np.full(len(terrain), "SNOW"), 0.4), features, samples, 0)
    hard = float(np.mean(terrain != "SNOW"))
    assert doubtful.cost == pytest.approx(hard)
    assert doubtful.least_cost < doubtful.cost
    assert doubtful.gain == pytest.approx(doubtful.cost - doubtful.least_cost)


def test_without_a_known_level_there_are_no_figures(drawn, drive_all, settings):
    samples, features = drawn
    unknown = grouped_samples(drive_all(n_runs=2), settings().rule)  # GRASS and GRAVEL have no known level
    terrain = unknown.windows.terrain.astype(str)
    assert stiffness_figures(held_out(unknown, terrain), features, unknown, 0) is None
    hard = np.flatnonzero(samples.windows.terrain != "SNOW")
    paved = samples.of(hard)
    terrain = paved.windows.terrain.astype(str)
    assert stiffness_figures(held_out(paved, terrain), features[hard], paved, 0) is None
