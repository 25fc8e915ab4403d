"""A champion stays unless a comparable model is better: on runs that are new to it, or by its held-out figures."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.learn.card import read_training
from pipelines.learn.champion import Champion, compare, judge, run_accuracies
from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs

TRAINING = RecipeSettings(repeats=1, n_jobs=1)
EVALUATION = EvaluationSettings(repeats=1, n_jobs=1, extras=False)


COMPARED = "of version 1 on the same data"


@pytest.mark.parametrize(
    ("changed", "moved", "reason"),
    [
        ({"macro_f1": 0.8}, False, f"macro F1 0.8000 is not better than 0.8000 {COMPARED}"),
        ({"macro_f1": 0.7}, False, f"macro F1 0.7000 is not better than 0.8000 {COMPARED}"),
        ({"macro_f1": 0.85}, True, f"macro F1 0.8500 is better than 0.8000 {COMPARED}"),
        ({"robots": ("warthog",)}, False, "its robots are warthog, those of version 1 husky: choose another"),
        (
            {"classes": ("ASPHALT", "MUD")},
            False,
            "its classes are ASPHALT, MUD, those of version 1 ASPHALT, ",
        ),
        ({"rate_hz": {"imu": 100.0, "wheels": 10.0}}, False, "its streams, channels or rates are not those"),
        ({"window_s": 3.0}, False, "its windows are 3 s every 3 s, steady motion, those of version 1 2 s ev"),
        (
            {"accuracy_ci": (0.3, 0.6)},
            False,
            "the accuracy (95 % over runs: 30.0 to 60.0\xa0%) is not above ch",
        ),
        ({"data_digest": "bb"}, False, "new data: no run on which version 1 can be judged"),
    ],
)
def test_the_champion_moves_to_what_is_comparable_and_better(tracked, model, changed, moved, reason):
    info, record = read_training(tracked[0] / "model")
    figures = {name: changed.pop(name) for name in ("macro_f1", "accuracy_ci") if name in changed}
    evaluated = replace(record.evaluation, **{"macro_f1": 0.99, "accuracy_ci": (0.9, 0.95)} | figures)
    candidate = replace(info, **changed), evaluated
    found = judge(Champion("1", {"macro_f1": "0.8"}, model), *candidate)
    assert (found[0], found[1][: len(reason)]) == (moved, reason)
    if "accuracy_ci" not in figures:
        assert judge(None, *candidate) == (True, "first version")
        assert judge(Champion("1", {}, None), *candidate) == (True, "version 1 cannot be loaded")
    else:
        assert not judge(None, *candidate)[0]  # at chance, not even the first


@pytest.fixture
def oracle(model, giving):
    """Return a function that makes a model that predicts every window right, or none."""

    def outputs(windows, right):
        true = windows.terrain.astype(str)[:, None] == np.array(model.info.classes)
        return np.roll(true, 0 if right else 1, axis=1).astype(float)

    return lambda right: giving(lambda windows: outputs(windows, right))


def test_on_new_runs_it_stays_where_it_is_better_and_goes_where_it_is_not(oracle, model, drive_all):
    runs = drive_all(n_runs=3, seed=43)
    data, report = data_of_runs(runs, TRAINING), crossval(runs, EVALUATION)
    info = replace(model.info, data_digest=data.digest, run_accuracy=run_accuracies(data, report))
    windows = data.samples.windows
    own = float(np.mean(model.recipe.predict(windows) == windows.terrain.astype(str)))
    assert report.chance < report.accuracy_ci[0]
    assert report.accuracy < 1.0
    for champion, theirs in ((oracle(True), 1.0), (oracle(False), 0.0), (model, own)):
        moved, reason = judge(Champion("1", {"macro_f1": "0.9"}, champion), info, report, data)
        assert moved == (report.accuracy >= theirs)
        figures = f"accuracy {report.accuracy:.1%} against {theirs:.1%} of version 1"
        assert reason.startswith(f"new data: on 9 runs, each held out, {figures}")


def test_its_own_runs_count_with_the_figures_of_when_they_were_held_out(model, oracle, runs, drive_all):
    more = [*runs, *(replace(run, run_id=f"{run.run_id}_new") for run in drive_all(n_runs=1, seed=47))]
    data, report = data_of_runs(more, TRAINING), crossval(more, EVALUATION)
    info, cheat = replace(model.info, run_accuracy=run_accuracies(data, report)), oracle(True)
    assert list(info.run_accuracy) == [run.digest for run in data.runs]
    assert np.mean(list(info.run_accuracy.values())) == pytest.approx(report.accuracy)
    n_runs, found = compare(cheat, info, data)
    own = list(model.info.run_accuracy.values())
    assert n_runs == 15
    assert found.a == pytest.approx((np.sum(own) + 3) / 15)  # what it was trained on is not predicted
    unknown = cheat._replace(info=replace(model.info, run_accuracy={}))
    assert compare(unknown, info, data)[0] == 3
    only_old = {
        digest: right for digest, right in info.run_accuracy.items() if digest in model.info.run_accuracy
    }
    assert compare(unknown, replace(info, run_accuracy=only_old), data) is None
