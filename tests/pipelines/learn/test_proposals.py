"""Labels that a model proposes: what is asked, what is answered, what is written, and what it gains."""

import csv
import json
from itertools import pairwise

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from pipelines.learn.label import SOURCES_FILE, Settings
from pipelines.learn.label import propose_labels as propose
from pipelines.learn.label import write_labels as write
from pipelines.learn.model_file import read_model
from pipelines.learn.proposals import COLUMNS, read_answers
from pipelines.report.json_file import as_json
from terrain.classify.proposals import Proposal, questions
from terrain.classify.smoothing import smoothed_classes
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.write import write_run


def propose_labels(data, model, n_asked, file):
    return propose(Settings(data=data, ask=n_asked, proposals=file, accept=0.9), model)


def write_labels(data, answers, out, accept=1.01, *, new_class=False):
    return write(Settings(data=data, accept=accept, new_class=new_class), answers, out)


@pytest.fixture(scope="module")
def model(tracked):
    return read_model(tracked[0] / "model")


@pytest.fixture
def recorded(tmp_path, drive):
    """Three runs of known ground without a label, and one with."""
    names = ("ASPHALT", "GRASS", "GRAVEL")
    for number, name in enumerate(names):
        write_run(drive(f"new_{name}", name, 60 + number, label=None), tmp_path / "data")
    write_run(drive("old", "GRASS", 70), tmp_path / "data")
    return tmp_path / "data"


@pytest.fixture
def table(recorded, model, tmp_path):
    file = tmp_path / "proposals.csv"
    propose_labels(recorded, model, 2, file)
    return file


def rows_of(file):
    with file.open() as text:
        return list(csv.DictReader(text))


def put(file, rows):
    with file.open("w", newline="") as text:
        writer = csv.DictWriter(text, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    return file


def answered(file, **answers):
    """Write answers by run id into the table."""
    return put(file, [row | {"answer": answers.get(row["run_id"], "")} for row in rows_of(file)])


def test_proposals_cover_the_runs_and_questions_come_first(recorded, model, tmp_path):
    found = propose_labels(recorded, model, 2, tmp_path / "p.csv")
    assert (found.n_runs, found.n_asked) == (4, 2)
    right = sum(p.n_windows for p in found.proposals if p.run_id == f"new_{p.terrain}")
    assert right > 0.6 * sum(p.n_windows for p in found.proposals if p.run_id != "old")
    rows = rows_of(tmp_path / "p.csv")
    assert [row["ask"] for row in rows[:3]] == ["1", "2", ""]
    assert len({row["run_id"] for row in rows[:2]}) == 2  # not two of one run
    assert {row["run_id"] for row in rows} == {"new_ASPHALT", "new_GRASS", "new_GRAVEL", "old"}
    for run_id in {row["run_id"] for row in rows}:
        spans = sorted((float(r["start_s"]), float(r["end_s"])) for r in rows if r["run_id"] == run_id)
        assert spans[0][0] == 0.0
        assert spans[-1][1] == pytest.approx(24.0)
        assert all(a[1] <= b[0] + 1e-6 for a, b in pairwise(spans))
    json.dumps(as_json(found), allow_nan=False)


def test_answers_stand_above_what_the_model_proposes_and_measured_labels_stay(recorded, table, tmp_path):
    answers = answered(table, new_ASPHALT="GRAVEL", new_GRASS="none", new_GRAVEL="yes")
    found = write_labels(recorded, answers, tmp_path / "out")
    runs = {run.run_id: run for run in load_runs(tmp_path / "out")}
    assert {label.terrain for label in runs["new_ASPHALT"].labels} == {"GRAVEL"}
    assert runs["new_GRASS"].labels == ()
    assert runs["old"].labels == next(r for r in load_runs(recorded) if r.run_id == "old").labels
    assert "model" not in found.n_labels
    assert found.n_labels["measured"] == 1
    sources = json.loads((tmp_path / "out" / "new_GRAVEL" / SOURCES_FILE).read_text())["labels"]
    assert {each["source"] for each in sources} == {"person"}
    assert load_runs(recorded)[0].labels == ()  # what was recorded is as it was
    for run in load_runs(recorded):
        copied = runs[run.run_id].streams["imu"]
        np.testing.assert_array_equal(copied.values, run.streams["imu"].values)


def test_what_the_model_is_certain_of_needs_no_answer(recorded, table, tmp_path):
    found = write_labels(recorded, table, tmp_path / "out", 0.0)
    assert found.n_labels["model"] >= 1
    of_model = [each for labels in found.runs.values() for each in labels if each.source == "model"]
    assert all(0 < each.confidence <= 1 for each in of_model)
    assert not any(each.source == "model" for each in found.runs["old"])  # it is labelled already
    answers = answered(table, new_GRASS="yes")
    stricter = write_labels(recorded, answers, tmp_path / "strict")
    assert set(stricter.n_labels) == {"measured", "person"}


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        (lambda rows: [row | {"run_id": "other"} for row in rows], ConfigError, "none of those"),
        (lambda rows: [*rows, rows[0]], ConfigError, "overlap"),
        (lambda rows: [rows[0] | {"answer": "LAVA"}], ConfigError, "--new-class"),
        (lambda rows: [rows[0] | {"end_s": "900"}], ConfigError, "no stretch of run"),
        (lambda rows: [rows[0] | {"start_s": "nan"}], LogError, "line 2"),
        (lambda rows: [rows[0] | {"n_windows": "many"}], LogError, "line 2"),
    ],
)
def test_a_table_that_does_not_fit_is_refused_in_one_sentence(
    recorded, table, tmp_path, change, error, sentence
):
    put(table, change(rows_of(table)))
    with pytest.raises(error, match=sentence) as refusal:
        write_labels(recorded, table, tmp_path / "out")
    assert len(str(refusal.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_other_files_no_labels_and_folders_that_are_there_are_refused(
    recorded, table, tmp_path, model, drive
):
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    with pytest.raises(LogError, match="no table of proposals"):
        read_answers(tmp_path / "notes.csv", {}, [], new_class=False)
    with pytest.raises(LogError, match="cannot be read"):
        read_answers(tmp_path / "nowhere.csv", {}, [], new_class=False)
    with pytest.raises(ConfigError, match="nothing is written"):
        write_labels(recorded, table, tmp_path / "out")
    with pytest.raises(ConfigError, match="exists already"):
        write_labels(recorded, table, recorded)
    write_run(drive("short", "GRASS", 3, duration_s=1.5), tmp_path / "short")
    with pytest.raises(DataError, match="no run holds a window"):
        propose_labels(tmp_path / "short", model, 2, tmp_path / "p.csv")
    new = write_labels(recorded, answered(table, new_GRASS="LAVA"), tmp_path / "out", new_class=True)
    assert {each.terrain for each in new.runs["new_GRASS"]} == {"LAVA"}


def test_doubt_is_of_what_is_improbable_unsupported_or_unknown():
    certain = Proposal("a", 0.0, 9.0, "ice", 0.99, 1.0, 0.0, 4)
    for changed in ({"confidence": 0.5}, {"supported_ratio": 0.0}, {"unknown_ratio": 1.0}):
        doubtful = certain._replace(run_id="b", **changed)
        assert questions([certain, doubtful], 1) == [1]
        assert not doubtful.taken_over(0.9)
    assert certain.taken_over(0.9)
    assert questions([certain], 5) == [0]
    assert questions([], 5) == []


def test_the_smoothed_sequence_is_the_best_of_all_of_them():
    rng = np.random.default_rng(0)
    probability, prior = rng.dirichlet(np.ones(3), 7), np.array([0.5, 0.3, 0.2])
    time_s = np.cumsum(rng.uniform(0.5, 8.0, 7))
    evidence = np.log(0.98 * probability / prior + 0.02)

    def score(path):
        kept = np.exp(-np.diff(time_s) / 20.0)
        same = np.diff(path) == 0
        return evidence[np.arange(7), path].sum() + np.log(np.where(same, kept, (1 - kept) / 2)).sum()

    every = np.array(np.meshgrid(*[range(3)] * 7)).reshape(7, -1).T
    best = every[np.argmax([score(path) for path in every])]
    assert smoothed_classes(probability, time_s, prior).tolist() == best.tolist()
    assert smoothed_classes(np.zeros((0, 3)), np.zeros(0), prior).tolist() == []
