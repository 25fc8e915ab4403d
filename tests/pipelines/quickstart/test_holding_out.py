"""What quickstart predicts is held out for real, and its page says so."""

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.data.datasets import data_digest
from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.learn.load import load_model
from pipelines.quickstart.holding_out import divide
from pipelines.quickstart.settings import QuickstartSettings
from terrain.errors import ConfigError, DataError
from terrain.logs.write import write_run


@pytest.mark.slow
def test_the_runs_that_are_predicted_took_no_part(in_tracked, drive_all, settings, tmp_path, monkeypatch):
    from pipelines.quickstart.quickstart import quickstart

    monkeypatch.setattr("pipelines.crossval.extras.CURVE_RUNS", (1,))
    runs = drive_all(n_runs=3, duration_s=16.0)
    for run in runs:
        write_run(run, tmp_path / "data")
    asked = QuickstartSettings(data=tmp_path / "data", out=tmp_path / "out", name="held")
    result = quickstart(asked, evaluation=settings())
    assert result.held_out == ("ASPHALT_3",)
    assert {row.run_id for row in result.predict.windows} == {"ASPHALT_3"}
    assert result.predict.training_runs == ()
    info = load_model(result.train.model_uri).info
    training = [run for run in runs if run.run_id != "ASPHALT_3"]
    assert sorted(info.run_digests) == sorted(data_digest([run]) for run in training)
    assert info.data_digest == result.data_digest == data_digest(training)
    assert {run.run_id for run in result.crossval.per_run} == {run.run_id for run in training}
    assert [" --without ASPHALT_3" in step for step in result.commands] == [True, True, False]
    assert result.commands[-1].endswith(" --only ASPHALT_3")
    page = Path(result.report).read_text()
    assert "the model was neither trained nor evaluated on ASPHALT_3" in page
    loaded = load(AlignedRunsSettings(data=tmp_path / "data", without="ASPHALT_3")).runs
    assert data_digest(loaded) == result.data_digest


@pytest.mark.slow
def test_copies_of_runs_are_refused_or_merged(in_tracked, drive_all, settings, tmp_path, monkeypatch):
    from pipelines.quickstart.quickstart import quickstart

    monkeypatch.setattr("pipelines.crossval.extras.CURVE_RUNS", (1,))
    runs = drive_all(n_runs=3, duration_s=16.0)
    for run in [*runs, replace(runs[0], run_id="copy")]:
        write_run(run, tmp_path / "data")
    asked = QuickstartSettings(data=tmp_path / "data", out=tmp_path / "out", name="copied")
    with pytest.raises(DataError, match="--merge-duplicates"):
        quickstart(asked, evaluation=settings())
    result = quickstart(asked.with_(merge_duplicates=True), evaluation=settings())
    assert result.crossval.notes[0].startswith("runs ASPHALT_1, copy hold the same measurements")
    assert result.crossval.n_runs + len(result.held_out) == 9


@pytest.mark.parametrize(
    ("counts", "held_out"),
    [
        ({"ice": 6, "mud": 7, "sand": 2}, ["ice_5", "mud_6"]),
        ({"ice": 5, "mud": 4}, ["ice_4"]),
        ({"ice": 3, "mud": 2}, []),  # five runs are needed for five folds
        ({"ice": 2, "mud": 2, "sand": 2}, []),
        ({}, []),
    ],
)
def test_enough_is_left_of_every_terrain(make_run, counts, held_out):
    runs = [make_run(f"{name}_{i}", name, i, 1.0) for name, n in counts.items() for i in range(n)]
    training, out = divide(runs)
    assert [run.run_id for run in out] == held_out
    assert sorted(run.run_id for run in (*training, *out)) == sorted(run.run_id for run in runs)


def test_runs_are_chosen_by_id(make_run, tmp_path):
    for number in range(3):
        write_run(make_run(f"a{number}", seed=number), tmp_path)

    def chosen(**options):
        return [run.run_id for run in load(AlignedRunsSettings(data=tmp_path, **options)).runs]

    assert chosen() == ["a0", "a1", "a2"]
    assert chosen(only="a2, a0") == ["a0", "a2"]
    assert chosen(without="a1") == ["a0", "a2"]
    assert chosen(only="a0,a1", without="a1") == ["a0"]
    with pytest.raises(ConfigError, match="--without: there is no run 'b'; there are a0, a1, a2"):
        chosen(without="b")
    with pytest.raises(ConfigError, match="leave no run"):
        chosen(only="a0", without="a0")
