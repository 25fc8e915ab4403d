"""Yamauchi et al., few and short runs: complete rows, a page, known results, bars of the odometry."""

import re

import pytest

from pipelines.reporting.json_file import as_json
from pipelines.reproduce.papers import PAPERS
from pipelines.reproduce.reproduce import reproduce
from pipelines.reproduce.yamauchi.experiments import EXPERIMENTS
from pipelines.reproduce.yamauchi.force_balance import force_balance
from pipelines.reproduce.yamauchi.trials import UPHILL, Trial, driven, judged_trials, turning_trials

SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("reproduced")


@pytest.fixture(scope="module")
def document(folder):
    """All experiments as JSON."""
    return as_json(reproduce("yamauchi", folder, SEED, quick=True))


def find(document, pattern):
    return [row for row in document["rows"] if re.search(pattern, row["what"])]


def one(document, pattern):
    (row,) = find(document, pattern)
    return row


@pytest.mark.slow
def test_every_experiment_gives_rows_and_a_page(document, folder):
    assert {row["experiment"] for row in document["rows"]} == {each.title for each in EXPERIMENTS}
    page = (folder / "yamauchi.html").read_text(encoding="utf-8")
    assert page.count("<img") == 6
    assert PAPERS["yamauchi"].about in page


def test_misprints_are_corrected_and_the_compaction_is_independent_of_the_slope():
    fall, root, thrust, reverse = force_balance(SEED, True).rows
    assert fall.verdict == "as printed"
    assert {root.verdict, thrust.verdict, reverse.verdict} == {"corrected"}
    assert root.simulated == pytest.approx(1.0)
    assert thrust.simulated == pytest.approx(0.2131, abs=1e-4)
    assert reverse.simulated == pytest.approx(-2.5, abs=0.01)


@pytest.mark.slow
def test_a_hidden_exponent_is_found(document):
    row = one(document, "Error of n where the simulator")
    assert max(abs(error) for error in row["beside"].values()) <= 0.02


@pytest.mark.slow
def test_held_out_positions_improve_by_half_against_both(document):
    rows = find(document, "^Fall of the position RMSE against .* with drift in turns")
    assert len(rows) == 4
    for row in rows:
        assert row["spread"][0] > 0.5
        assert min(row["beside"].values()) > 0.5
        assert "0.5 is exceeded" in row["why"]
    plain = one(document, "against gyrodometry, as printed, turning uphill")
    assert plain["printed_interval"] == [0.685, 0.685]
    assert one(document, "judged turning downhill")["simulated"] < 0 < plain["simulated"]


@pytest.mark.slow
def test_the_model_identified_while_driving_is_that_of_cameras(document):
    row = one(document, "Exponent n by fixes")
    assert abs(row["simulated"] - row["beside"]["by cameras"]) < 3 * row["beside"]["std"] + 0.05
    for gain in find(document, "without fixes"):
        assert gain["simulated"] > 0.5


def test_judged_trials_are_none_of_those_for_training_and_seeds_decide():
    training = {trial.seed for trial in turning_trials(SEED, 3, (UPHILL,))}
    judged = {trial.seed for trials in judged_trials(SEED, False, UPHILL).values() for trial in trials}
    assert len(judged) == 80
    assert not training & judged
    first, again, other = (driven(Trial(8.0, 30.0, UPHILL, seed)) for seed in (1, 1, 2))
    assert first.rows.tobytes() == again.rows.tobytes()
    assert first.rows.tobytes() != other.rows.tobytes()
