"""``terrain learn-slip`` of a swerve robot: one command over simulated runs, and what it leaves out or refuses."""

import json
from dataclasses import replace
from functools import partial

import pytest
from click.testing import CliRunner

from pipelines.cli.main import app
from pipelines.report.results import silent
from pipelines.slip.learn_slip import Settings, learn_slip_table, run
from pipelines.slip.shown import write_figures
from terrain.control.learned_table import FALLBACK
from terrain.control.slip_table import DRIVE_STATES, load_slip_table
from terrain.errors import ConfigError, DataError, TerrainError
from terrain.logs.run_folders import write_run
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import Drive, learning_runs
from terrain.slip_learning.curve import learn_curve
from terrain.slip_learning.learn import terrain_runs

ROBOT = load_robot("agrimaro")
DRIVES = (
    Drive("sweep", 1.0, 0.8, 21.0),
    Drive("sweep", 1.0, 0.8, 21.0),
    Drive("starts", 1.5, 1.2, 15.0),
    Drive("climb", 2.0, 1.2, 15.0, 0.06, 0.06),
)


@pytest.fixture(scope="module")
def runs():
    return [run for terrain in ("snow", "dry_sand") for run in learning_runs(ROBOT, terrain, 1500, DRIVES)]


@pytest.fixture(scope="module")
def learned(runs, tmp_path_factory):
    """The command over two terrains that were driven enough, and one that was not; few draws of runs."""
    place = tmp_path_factory.mktemp("learned")
    for each in [*runs, *learning_runs(ROBOT, "clay", 1500, DRIVES[2:3])]:
        write_run(each, place / "runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.chdir(place)
        patch.setattr("terrain.slip_learning.learn.learn_curve", partial(learn_curve, n_bootstrap=30))
        line = ["learn-slip", "--data", "runs", "--robot", "agrimaro", "--out", "table.yaml"]
        done = CliRunner().invoke(app, [*line, "--json", "result.json"])
    assert done.exception is None, done.output
    return place, json.loads((place / "result.json").read_text()), done.output


def without(run, stream, channel):
    removed = run.streams[stream]
    names = [name for name in removed.channels if name != channel]
    kept = Stream(removed.time_s, removed.columns(names), names)
    return replace(run, streams={**run.streams, stream: kept})


def test_table_holds_learned_and_assumed_targets(learned):
    place, _, screen = learned
    table = load_slip_table(place / "table.yaml", robot="agrimaro")
    assert set(table.targets) == {"clay", "dry_sand", "snow", FALLBACK}
    for terrain, law, status in (("snow", "magic", "peak"), ("dry_sand", "janosi", "no_peak")):
        assert (table.curves[terrain].law, table.curves[terrain].peak_status) == (law, status)
        assert {target.status for target in table.lookup(terrain).values()} == {"estimated"}
        assert table.curves[terrain].working_slip_ratio > table.curves[terrain].balance_slip_ratio
    default, lava = load_slip_table(), table.lookup("lava")
    for state, target in table.lookup("clay").items():
        assert (target.slip_ratio, target.status) == (default.lookup("clay")[state].slip_ratio, "unestimated")
        assert "table default, clay" in target.source
    assert "runs with valid slip" in table.reasons["clay"]
    known = [table.lookup(terrain) for terrain in ("snow", "dry_sand")]
    for state in DRIVE_STATES:
        assert lava[state].status == "unestimated"
        assert abs(lava[state].slip_ratio) == min(abs(row[state].slip_ratio) for row in known)
    assert table.lookup("dry_sand")["steady"].slip_ratio == pytest.approx(0.203, abs=0.05)
    assert "learned on 2 of 3 terrains, from 9 runs" in screen


def test_json_has_peaks_intervals_and_counts(learned):
    result = learned[1]
    snow, clay = result["terrains"]["snow"], result["terrains"]["clay"]
    assert snow["peak_slip_ci"][0] <= snow["peak_slip"] <= snow["peak_slip_ci"][1]
    assert (snow["status"], snow["n_runs"]) == ("estimated", 4)
    assert snow["slip_range"][1] > 0.5
    assert (clay["status"], clay["n_runs"], clay["peak_slip"]) == ("unestimated", 1, None)
    run = next(row for row in result["runs"] if row["run_id"].startswith("snow_sweep"))
    assert run["n_samples"] > 50
    assert {"slip known", "speed fresh", "moving", "torque free"} <= set(run["left_out"])
    assert "tracking_run_id" not in result  # the same runs and seed give the same bytes


def test_the_run_is_logged_with_table_pictures_and_digest(learned, monkeypatch):
    import mlflow

    place, result, _ = learned
    monkeypatch.chdir(place)
    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{place / 'mlruns' / 'mlflow.db'}")
    experiments = [item.experiment_id for item in client.search_experiments()]
    (run,) = client.search_runs(experiments, "tags.kind = 'slip table'")
    assert run.data.tags["data_digest"] == result["data_digest"]
    assert run.data.params["robot"] == "agrimaro"
    assert run.data.metrics["snow.peak_slip"] == pytest.approx(result["terrains"]["snow"]["peak_slip"])
    assert "clay.peak_slip" not in run.data.metrics
    files = {item.path for item in client.list_artifacts(run.info.run_id)}
    assert {"table.yaml", "learn_slip.json", "figures"} <= files
    pictures = client.list_artifacts(run.info.run_id, "figures")
    assert len(pictures) == 4
    assert min(item.file_size for item in pictures) > 5000


def test_one_run_on_a_terrain_in_no_table_is_counted_and_keeps_its_name(runs, tmp_path):
    labels = [label._replace(terrain="moon/dust") for label in runs[0].labels]
    table = learn_slip_table([replace(runs[0], labels=labels)], ROBOT)
    row = table.terrains["moon/dust"]
    assert (row["status"], row["n_runs"]) == ("unestimated", 1)
    assert len(table.to_pandas()) == 3 * len(table.targets)
    (tmp_path / "t.yaml").write_text("old: true\n")
    again = load_slip_table(table.save(tmp_path / "t.yaml"))
    assert "table default, unknown" in again.lookup("moon/dust")["traction"].source
    default = load_slip_table().lookup("lava")["traction"].slip_ratio
    assert again.lookup("lava")["traction"].slip_ratio == default
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".t")]
    files = write_figures(table.pictures, tmp_path / "f")
    assert str(tmp_path / "f" / "moon_dust.svg") in files
    assert "moon/dust" in table.report.save(tmp_path / "page.html").read_text()


def test_runs_without_the_required_data_are_refused_and_left_out_on_request(runs):
    bad = without(runs[1], "wheels", "current_1_a")
    for refused, fault in (
        (replace(runs[0], labels=()), "none of 1 runs has a label"),
        (bad, "'wheels' has no channel 'current_1_a'"),
        (without(runs[0], "imu", "roll_rad"), "'imu' has no channel 'roll_rad'"),
        (replace(runs[0], robot="husky"), "is of robot 'husky'"),
    ):
        with pytest.raises(DataError, match=fault):
            learn_slip_table([refused], ROBOT)
    result = learn_slip_table([runs[0], bad], ROBOT, repair=True)
    assert result.n_runs == 1
    (sentence,) = result.skipped
    assert "current_1_a" in sentence


def test_the_bins_of_a_run_are_of_its_session(runs):
    (found,) = terrain_runs(replace(runs[0], session="monday"), ROBOT)
    assert found.bins.session == "monday"


def test_paths_that_cannot_be_written_are_refused(learned, tmp_path):
    asked = Settings(data=learned[0] / "runs", robot="agrimaro", out=tmp_path)
    with pytest.raises(ConfigError, match="is a folder; --out names a file"):
        run(asked, silent)
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrainError, match="cannot be written"):
        run(asked.with_(out=tmp_path / "file" / "t.yaml"), silent)
