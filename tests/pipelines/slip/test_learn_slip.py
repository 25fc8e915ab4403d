import json
import math

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.slip.figures import curve_figure, sheet
from pipelines.slip.learn_slip import FALLBACK, learn_slip, learn_terrain, run_parts
from pipelines.slip.study import clopper_pearson, run_case, summary
from terrain.control.slip_table import DRIVE_STATES, load_slip_table
from terrain.errors import ConfigError, DataError, TerrainError
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.slip_sweep import Drive, learning_runs

ROBOT = load_robot("agrimaro")
DRIVES = (
    Drive("sweep", 1.0, 0.8, 21.0),
    Drive("sweep", 1.0, 0.8, 21.0),
    Drive("sweep", 1.0, 0.8, 21.0),
    Drive("starts", 1.5, 1.2, 15.0),
    Drive("climb", 2.0, 1.2, 15.0, 0.06, 0.06),
)


@pytest.fixture(scope="module")
def runs():
    return [run for terrain in ("snow", "dry_sand") for run in learning_runs(ROBOT, terrain, 1500, DRIVES)]


@pytest.fixture(scope="module")
def folder(runs, tmp_path_factory):
    place = tmp_path_factory.mktemp("slip_runs")
    for run in [*runs, *learning_runs(ROBOT, "clay", 1500, DRIVES[3:4])]:
        write_run(run, place)
    return place


@pytest.fixture(scope="module")
def learned(folder, tmp_path_factory):
    """The command over two terrains that were driven enough, and one that was not."""
    place = tmp_path_factory.mktemp("learned")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.chdir(place)
        words = ["learn-slip", "--data", str(folder), "--robot", "agrimaro", "--out", "table.yaml"]
        done = CliRunner().invoke(app, [*words, "--json", "result.json", "--figures", "figures"])
    assert done.exception is None, done.output
    return place, done.output


def without(run, stream, channel=None):
    streams = dict(run.streams)
    told = streams.pop(stream)
    if channel is not None:
        kept = [i for i, name in enumerate(told.channels) if name != channel]
        streams[stream] = Stream(told.time_s, told.values[:, kept], tuple(told.channels[i] for i in kept))
    return RunLog(run.run_id, run.robot, streams, run.labels)


def test_table_says_what_was_learned_and_what_was_not(learned):
    place, screen = learned
    table = load_slip_table(place / "table.yaml", robot="agrimaro")
    assert set(table.targets) == {"clay", "dry_sand", "snow", FALLBACK}
    for terrain, law, status in (("snow", "magic", "peak"), ("dry_sand", "janosi", "no_peak")):
        assert (table.curves[terrain].law, table.curves[terrain].peak_status) == (law, status)
        assert {target.status for target in table.lookup(terrain).values()} == {"estimated"}
        assert table.curves[terrain].working_slip_ratio > table.curves[terrain].balance_slip_ratio
    default = load_slip_table()
    for state, target in table.lookup("clay").items():
        assert (target.slip_ratio, target.status) == (default.lookup("clay")[state].slip_ratio, "unestimated")
        assert "table default, clay" in target.source
    assert "runs with believable slip" in table.reasons["clay"]
    known = [table.lookup(terrain) for terrain in ("snow", "dry_sand")]
    for state in DRIVE_STATES:
        assert table.lookup("lava")[state].status == "unestimated"
        assert abs(table.lookup("lava")[state].slip_ratio) == min(abs(row[state].slip_ratio) for row in known)
    assert table.lookup("dry_sand")["steady"].slip_ratio == pytest.approx(0.203, abs=0.05)
    text = (place / "table.yaml").read_text()
    assert text.startswith("# Slip to aim for")
    assert "learned from 11 runs" in screen
    assert "clay is unestimated" in screen


def test_json_has_peaks_intervals_and_counts(learned):
    place, _ = learned
    result = json.loads((place / "result.json").read_text())
    snow, clay = result["terrains"]["snow"], result["terrains"]["clay"]
    assert snow["peak_slip_ci"][0] <= snow["peak_slip"] <= snow["peak_slip_ci"][1]
    assert (snow["status"], snow["n_runs"]) == ("estimated", 5)
    assert snow["slip_range"][1] > 0.5
    assert clay["status"] == "unestimated"
    assert clay["peak_slip"] is None
    assert clay["n_runs"] == 1
    run = next(row for row in result["runs"] if row["run_id"].startswith("snow_sweep"))
    assert run["n_samples"] > 50
    assert {"slip known", "speed fresh", "moving", "torque free"} <= set(run["left_out"])
    assert "tracking_run_id" not in result  # the same runs and seed give the same bytes
    assert len(result["figures"]) == 9
    assert result["figures"][-1].endswith("slip.html")
    for file in result["figures"]:
        assert (place / file).stat().st_size > 5000


def test_the_run_is_logged_with_table_pictures_and_digest(learned, monkeypatch):
    import mlflow

    place, _ = learned
    monkeypatch.chdir(place)
    result = json.loads((place / "result.json").read_text())
    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{place / 'mlruns' / 'mlflow.db'}")
    (run,) = client.search_runs(
        [item.experiment_id for item in client.search_experiments()], "tags.kind = 'slip table'"
    )
    assert run.data.tags["data_digest"] == result["data_digest"]
    assert run.data.params["robot"] == "agrimaro"
    assert run.data.metrics["snow.peak_slip"] == pytest.approx(result["terrains"]["snow"]["peak_slip"])
    assert "clay.peak_slip" not in run.data.metrics
    files = {item.path for item in client.list_artifacts(run.info.run_id)}
    assert {"table.yaml", "learn_slip.json", "figures"} <= files


def test_learning_again_is_the_same(runs):
    parts = [part for run in runs[:4] for part in run_parts(run, ROBOT)]
    first, second = (learn_terrain("snow", parts, 3, n_bootstrap=10) for _ in range(2))
    assert first.curve.peak_interval == second.curve.peak_interval
    np.testing.assert_array_equal(first.curve.band, second.curve.band)


def test_pictures_of_what_was_learned_and_what_was_not(runs):
    parts = [part for run in runs[:5] for part in run_parts(run, ROBOT)]
    entries = [learn_terrain("snow", parts, 0, 5), learn_terrain("snow", parts[:1], 0, 5)]
    figure = curve_figure(entries[0], "agrimaro")
    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert "target, traction" in labels
    assert "Magic Formula" in figure.get_suptitle()
    assert "unestimated" in curve_figure(entries[1], "agrimaro").get_suptitle()
    assert len(sheet(entries, "agrimaro").axes) == 2


def test_one_run_alone_teaches_nothing_but_is_counted(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = learn_slip(runs[:1], "agrimaro", tmp_path / "table.yaml")
    row = result["terrains"]["snow"]
    assert (row["status"], row["n_runs"]) == ("unestimated", 1)
    table = load_slip_table(tmp_path / "table.yaml")
    assert (
        table.lookup("lava")["traction"].slip_ratio == load_slip_table().lookup("lava")["traction"].slip_ratio
    )


def test_ground_that_no_table_knows_is_learned_under_its_own_name(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = [
        RunLog(
            run.run_id, run.robot, run.streams, [label._replace(terrain="moon/dust") for label in run.labels]
        )
        for run in runs[:1]
    ]
    learn_slip(named, "agrimaro", tmp_path / "t.yaml", figures=tmp_path / "f")
    target = load_slip_table(tmp_path / "t.yaml").lookup("moon/dust")["traction"]
    assert "table default, unknown" in target.source
    assert (tmp_path / "f" / "moon_dust.svg").is_file()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda run: RunLog(run.run_id, run.robot, run.streams), "none of 1 runs has a label"),
        (lambda run: without(run, "wheels", "current_1_a"), "'wheels' has no channel 'current_1_a'"),
        (lambda run: without(run, "imu", "roll_rad"), "'imu' has no channel 'roll_rad'"),
        (lambda run: RunLog(run.run_id, "husky", run.streams, run.labels), "is of robot 'husky'"),
    ],
)
def test_runs_that_cannot_teach_are_named(runs, tmp_path, monkeypatch, change, fault):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=fault):
        learn_slip([change(runs[0])], "agrimaro", tmp_path / "t.yaml")
    assert not (tmp_path / "t.yaml").exists()


def test_a_faulty_run_is_skipped_on_request(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = []
    bad = without(runs[1], "wheels", "current_1_a")
    result = learn_slip(
        [runs[0], bad], "agrimaro", tmp_path / "t.yaml", skip_faulty=True, on_skip=told.append
    )
    assert result["n_runs"] == 1
    assert len(told) == 1
    assert "current_1_a" in told[0]


def test_other_robots_and_places_that_cannot_be_written_are_refused(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="'skid_steer': slip curves are learned for 'swerve' alone"):
        learn_slip(runs, "husky", tmp_path / "t.yaml")
    with pytest.raises(ConfigError, match="is a folder; --out names the file"):
        learn_slip(runs, "agrimaro", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrainError, match="cannot be written"):
        learn_slip(runs, "agrimaro", tmp_path / "file" / "t.yaml")


def test_a_table_that_is_there_is_replaced(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.yaml").write_text("old: true\n")
    learn_slip(runs[:1], "agrimaro", tmp_path / "t.yaml")
    assert yaml.safe_load((tmp_path / "t.yaml").read_text())["schema"] == 2
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".t")]


def test_intervals_hold_the_true_peaks_of_two_terrains():
    """Eight cases at 90 %: fewer than five inside is one time in two hundred."""
    cases = [
        run_case(ROBOT, terrain, 1400 + number, DRIVES, n_bootstrap=40)
        for terrain in ("snow", "grass")
        for number in range(4)
    ]
    result = summary(cases)
    assert result["n_learned"] == 8
    assert result["coverage"] >= 5 / 8
    assert result["error_median_abs"] < 0.03
    assert result["status_right"] == 8
    low, high = clopper_pearson(0, 5)
    assert low == 0.0
    assert high == pytest.approx(1 - 0.025 ** (1 / 5))
    assert math.isclose(clopper_pearson(5, 5)[0], 0.025 ** (1 / 5))


def test_the_page_holds_every_terrain_and_no_name_breaks_it():
    from matplotlib.figure import Figure

    from pipelines.slip.page import slip_page
    from terrain.control.slip_table import load_slip_table

    row = {
        "status": "unestimated",
        "reason": "one run <only>",
        "n_runs": 1,
        "slip_range": None,
        "peak_slip": None,
        "peak_slip_ci": None,
        "peak_status": None,
        "targets": {state: {"slip_ratio": 0.1, "source": "assumed"} for state in DRIVE_STATES},
    }
    found = slip_page({"<mud>": row}, {"<mud>": Figure(figsize=(1, 1))}, load_slip_table(), 1)
    assert "&lt;mud&gt;" in found
    assert "<mud>" not in found
    assert "one run &lt;only&gt;" in found
    assert found == slip_page({"<mud>": row}, {"<mud>": Figure(figsize=(1, 1))}, load_slip_table(), 1)
