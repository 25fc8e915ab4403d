"""Labels: set by a person, where nothing else of a run changes; or proposed by a model and answered."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from pipelines.data.datasets import load_runs
from pipelines.learn.label import SOURCES_FILE, Settings, taken_over_words
from pipelines.learn.label import run as label
from pipelines.learn.model_file import read_model
from terrain.classify.proposals import TakenOver
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.run_folders import WINDOWS_FILE, RecordedWindow, read_run, windows_text, write_run

WINDOWS = [
    RecordedWindow(
        start_s=start_s,
        end_s=start_s + 1.0,
        terrain=terrain,
        probability=p,
        probabilities={"SNOW": p, "ICE": 1 - p},
        doubtful=not p >= 0.5,
        refused="" if terrain else "NaN",
    )
    for start_s, terrain, p in ((0.0, "SNOW", 0.9), (1.0, "SNOW", 0.4), (2.0, "ICE", 0.49), (3.0, "", np.nan))
]


@pytest.fixture
def folder(tmp_path, make_run):
    """Two runs of 4 s labelled SNOW; windows were recorded with the first."""
    write_run(make_run("SNOW_01"), tmp_path / "runs", beside={WINDOWS_FILE: windows_text(WINDOWS)})
    write_run(make_run("SNOW_02"), tmp_path / "runs")
    return tmp_path / "runs"


def found(folder, **options):
    return label(Settings(data=folder, **options))


def labelled(folder, **options):
    return label(Settings(data=folder, **({"run": "SNOW_01"} | options)))


def labels_of(folder, run_id="SNOW_01"):
    return [tuple(label) for label in read_run(folder / run_id).labels]


def test_windows_of_low_confidence_of_all_runs_are_listed(folder):
    result = found(folder)
    assert [row[:4] for row in result.windows] == [
        ("SNOW_01", 1.0, 2.0, "SNOW"),
        ("SNOW_01", 2.0, 3.0, "ICE"),
        ("SNOW_01", 3.0, 4.0, ""),
    ]
    assert {row.label for row in result.windows} == {"SNOW"}
    assert result.runs == (("SNOW_01", 4, 3, 0), ("SNOW_02", None, 0, 0))
    assert found(folder / "SNOW_01").windows == found(folder, run="SNOW_01").windows == result.windows


def test_a_label_replaces_what_was_there_and_keeps_all_else(folder):
    before = json.loads((folder / "SNOW_01" / "run.json").read_text())
    before["note"] = {"kept": [1.5, None, "ä"]}
    (folder / "SNOW_01" / "run.json").write_text(json.dumps(before))
    parquet = (folder / "SNOW_01" / "imu.parquet").read_bytes()
    result = labelled(folder, from_s=1.0, to_s=3.0, terrain="ICE")
    assert labels_of(folder) == [(0.0, 1.0, "SNOW"), (1.0, 3.0, "ICE"), (3.0, 4.0, "SNOW")]
    assert [tuple(label) for label in result.labels] == labels_of(folder)
    after = json.loads((folder / "SNOW_01" / "run.json").read_text())
    assert {**after, "labels": None} == {**before, "labels": None}
    assert (folder / "SNOW_01" / "imu.parquet").read_bytes() == parquet
    assert [row.label for row in found(folder).windows] == ["ICE", "ICE", "SNOW"]
    assert labels_of(folder, "SNOW_02") == [(0.0, 4.0, "SNOW")]


def test_labels_are_removed_in_an_interval_and_a_whole_run_is_labelled_to_its_last_sample(folder):
    labelled(folder, from_s=1.0, to_s=2.0, remove=True)
    assert labels_of(folder) == [(0.0, 1.0, "SNOW"), (2.0, 4.0, "SNOW")]
    assert [row.label for row in found(folder).windows] == [None, "SNOW", "SNOW"]
    assert found(folder).runs[0].n_without_label == 1
    labelled(folder, whole=True, terrain="")
    assert labels_of(folder) == []
    labelled(folder, whole=True, terrain="ICE")
    assert labels_of(folder) == [(0.0, pytest.approx(4.0), "ICE")]

    # Two runs of one id are refused.
    (folder / "SNOW_01").rename(folder / "other")
    head = (folder / "SNOW_02" / "run.json").read_text()
    (folder / "SNOW_02" / "run.json").write_text(head.replace("SNOW_02", "SNOW_01"))
    with pytest.raises(LogError, match="2 runs have the id 'SNOW_01'"):
        labelled(folder, whole=True, terrain="ICE")


@pytest.fixture(scope="module")
def proposed(tmp_path_factory, drive, tracked):
    """What a model proposes for three runs of known ground without a label and one with, two questions first."""
    place = tmp_path_factory.mktemp("proposed")
    for number, name in enumerate(("ASPHALT", "GRASS", "GRAVEL")):
        write_run(drive(f"new_{name}", name, 60 + number, label=None), place / "data")
    write_run(drive("old", "GRASS", 70), place / "data")
    asked = {"model": str(tracked[0] / "model"), "ask": 2, "proposals": place / "proposals.csv"}
    return label(Settings(data=place / "data", **asked))


def rows_of(file):
    return pd.read_csv(file, dtype=str, keep_default_na=False).to_dict("records")


def answered(proposed, place, rows, **options):
    """Take answers that are rows of a table, or a text."""
    table = place / "answers.csv"
    table.write_text(rows if isinstance(rows, str) else pd.DataFrame(rows).to_csv(index=False))
    return label(Settings(data=proposed.data, answers=table, out=place / "out", **options))


def test_proposals_cover_the_runs_and_questions_come_first(proposed):
    assert (proposed.n_runs, proposed.n_asked, proposed.n_taken_over) == (4, 2, 0)
    assert "No proposal is taken over unasked, as more than 2.0" in proposed.taken_over  # of so few runs
    right = sum(p.n_windows for p in proposed.proposals if p.run_id == f"new_{p.terrain}")
    assert right > 0.6 * sum(p.n_windows for p in proposed.proposals if p.run_id != "old")
    rows = rows_of(proposed.file)
    assert [row["ask"] for row in rows[:3]] == ["1", "2", ""]
    assert len({row["run_id"] for row in rows[:2]}) == 2  # not two of one run
    assert {row["run_id"] for row in rows} == {"new_ASPHALT", "new_GRASS", "new_GRAVEL", "old"}
    for run_id in {row["run_id"] for row in rows}:
        spans = sorted((float(r["start_s"]), float(r["end_s"])) for r in rows if r["run_id"] == run_id)
        assert spans[0][0] == 0.0
        assert spans[-1][1] == pytest.approx(24.0)
        assert all(a[1] <= b[0] + 1e-6 for a, b in pairwise(spans))


def test_answers_stand_above_what_the_model_proposes_and_measured_labels_stay(proposed, tmp_path):
    answers = {"new_ASPHALT": "LAVA", "new_GRASS": "none", "new_GRAVEL": "yes"}
    rows = [row | {"answer": answers.get(row["run_id"], "")} for row in rows_of(proposed.file)]
    found = answered(proposed, tmp_path, rows, new_class=True)
    runs, before = ({run.run_id: run for run in load_runs(at)} for at in (found.out, proposed.data))
    assert {label.terrain for label in runs["new_ASPHALT"].labels} == {"LAVA"}
    assert runs["new_GRASS"].labels == before["new_GRAVEL"].labels == ()  # what was recorded is as it was
    assert runs["old"].labels == before["old"].labels != ()
    assert (found.n_labels["measured"], "model" in found.n_labels) == (1, False)
    sources = json.loads((found.out / "new_GRAVEL" / SOURCES_FILE).read_text())["labels"]
    assert {each["source"] for each in sources} == {"person"}
    for run_id, run in before.items():
        np.testing.assert_array_equal(runs[run_id].streams["imu"].values, run.streams["imu"].values)


def test_what_the_model_is_certain_of_needs_no_answer(proposed, tmp_path):
    rows = [row | {"taken_over": str(not row["ask"])} for row in rows_of(proposed.file)]
    found = answered(proposed, tmp_path, rows)
    of_model = [each for labels in found.runs.values() for each in labels if each.source == "model"]
    assert len(of_model) == found.n_labels["model"] >= 1
    assert all(0 < each.confidence <= 1 for each in of_model)
    assert not any(each.source == "model" for each in found.runs["old"])  # it is labelled already


def test_a_table_that_does_not_fit_is_refused_in_one_sentence(proposed, tmp_path, tracked, drive):
    first, *others = rows = rows_of(proposed.file)
    no_proposal = "line 2: is no proposal"
    for other, error, sentence in (
        (rows, ConfigError, "nothing is written"),
        ([row | {"run_id": "other"} for row in rows], ConfigError, "none of those"),
        ([first, *others, first], ConfigError, "overlap"),
        ([first | {"answer": "LAVA"}], ConfigError, "--new-class"),
        ([first | {"end_s": "900"}], ConfigError, "no stretch of run"),
        ([first | {"start_s": "nan"}], LogError, f"{no_proposal} .start_s is 'nan'"),
        ([first | {"n_windows": "many"}], LogError, f"{no_proposal} .n_windows is"),
        (f"{','.join(first)}\nold,0\n", LogError, f"{no_proposal}: it is longer or sh"),
        ("a,b\n1,2\n", LogError, "column 'run_id' is missing"),
    ):
        with pytest.raises(error, match=sentence) as refusal:
            answered(proposed, tmp_path, other)
        assert len(str(refusal.value).splitlines()) == 1
        assert not (tmp_path / "out").exists()
    with pytest.raises(LogError, match="cannot be opened"):
        label(Settings(data=proposed.data, answers=tmp_path / "nowhere.csv", out=tmp_path / "out"))
    (tmp_path / "out").mkdir()
    with pytest.raises(ConfigError, match="exists already"):
        answered(proposed, tmp_path, rows)
    write_run(drive("short", "GRASS", 3, duration_s=1.5), tmp_path / "short")
    with pytest.raises(DataError, match="no run holds a window"):
        label(Settings(data=tmp_path / "short", model=str(tracked[0] / "model")))


def test_what_is_taken_over_is_stated_with_what_held_out_runs_show(tracked):
    info = read_model(str(tracked[0] / "model")).info
    rows = [(0.7, 0.9, 0.03, 0.06, 160, "run", ("ICE",)), (0.9, 0.5, 0.001, 0.019, 150, "run", ("ICE",))]
    shown = replace(info, taken_over=tuple(TakenOver(*row) for row in rows))
    assert taken_over_words(shown, 0.02) == (
        "Proposals are taken over unasked: from a confidence of 0.9 0.1\N{NO-BREAK SPACE}% of the time is wrong in 150 "
        "training runs when held out, at most 1.9\N{NO-BREAK SPACE}% with 95 %; what another day does is not shown."
    )
    assert "a confidence of 0.7" in taken_over_words(shown, 0.1)
    assert "No proposal is taken over unasked, as more than 1.0" in taken_over_words(shown, 0.01)
    assert "held no run out" in taken_over_words(replace(info, taken_over=()), 0.02)
    with pytest.raises(ConfigError):
        Settings(data=tracked[0], error=1.5)
