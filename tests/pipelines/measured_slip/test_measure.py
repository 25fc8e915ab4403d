import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.data.datasets import load_runs
from pipelines.ground_changes.find import find_changes
from pipelines.ground_changes.settings import FindChangesSettings
from pipelines.measured_slip.measure import measure_slip
from pipelines.measured_slip.settings import MeasureSlipSettings
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError, DataError, LogError
from terrain.kinematics import omni
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot

ROBOTINO = load_robot("robotino")
SLIP = {"cork": 0.1, "moss": 0.4}
CURRENT = {"cork": 0.4, "moss": 0.8}


def run_of(rng, run_id, terrains, direction, length_s=9.0, session=""):
    """Return a run at 0.1 m/s in one direction, half on each of two grounds where two are named."""
    time_s = np.arange(0.0, length_s, 0.031)
    second = (time_s > length_s / 2) & (len(terrains) > 1)
    here = np.where(second, terrains[-1], terrains[0])
    twist = 0.1 * np.array([np.cos(direction), np.sin(direction), 0.0])
    wheels = omni.inverse(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad, twist)
    slip = np.array([SLIP[name] for name in here])
    travelled = np.cumsum(0.1 * (1 - slip)) * 0.031
    pose = np.column_stack(
        [travelled * np.cos(direction), travelled * np.sin(direction), np.zeros(time_s.size)]
    )
    pose += rng.normal(0.0, 0.0005, pose.shape)
    current = np.array([CURRENT[name] for name in here])[:, None] * (0.5 + np.abs(wheels) / 0.1)
    current = current + rng.normal(0.0, 0.05, current.shape)
    rates = ROBOTINO.logged_rates(wheels) + rng.normal(0.0, 0.5, current.shape)
    channels = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
    commands = Stream(
        time_s, np.tile(twist, (time_s.size, 1)), ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    )
    streams = {
        "wheels": Stream(time_s, np.hstack([rates, current]), channels),
        "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
        "commands": commands,
    }
    labels = (Label(0.0, length_s, terrains[0]),) if len(terrains) == 1 else ()
    return with_wheel_speeds(RunLog(run_id, "robotino", streams, labels, session=session), ROBOTINO)


@pytest.fixture(scope="module")
def one_ground():
    rng = np.random.default_rng(0)
    return [run_of(rng, f"{name}_{i:02d}", (name,), i * 0.3) for name in SLIP for i in range(20)]


@pytest.fixture(scope="module")
def two_grounds():
    rng = np.random.default_rng(1)
    return [run_of(rng, f"both_{i}", ("cork", "moss"), i, session="border") for i in range(6)]


def settings_of(tmp_path, **changes):
    return MeasureSlipSettings(data=tmp_path, delay="0", **changes)


def test_slip_by_surface_and_its_prediction(tmp_path, one_ground, two_grounds):
    runs = [*one_ground, *two_grounds]
    result = measure_slip(runs, settings_of(tmp_path, predict=True, figures=tmp_path / "page"))
    found = {row.terrain: row for row in result.surfaces}
    assert list(found) == ["cork", "moss", ""]
    for name, slip in SLIP.items():
        assert found[name].slip_ratio == pytest.approx(slip, abs=0.01)
        assert found[name].held_out < 0.01
    by_name = {row.held_out: row for row in result.predictions}
    assert set(by_name) == {"runs", "regimes", "border"}
    assert by_name["runs"].rms < 0.02
    assert by_name["runs"].coverage > 0.9
    assert by_name["border"].n_runs == 6
    page = (tmp_path / "page" / "measured_slip.html").read_text(encoding="utf-8")
    assert "Predicted from currents" in page
    assert "moss" in page


def test_the_same_input_and_seed_give_the_same_result(tmp_path, one_ground):
    first, second = (
        json.dumps(as_json(measure_slip(one_ground[::4], settings_of(tmp_path, seed=3)))) for _ in range(2)
    )
    assert first == second


def test_runs_are_written_with_their_slip(tmp_path, one_ground):
    out = tmp_path / "out"
    result = measure_slip(one_ground[:3], settings_of(tmp_path, out=out))
    again = load_runs(out)
    assert [run.run_id for run in again] == [run.run_id for run in one_ground[:3]]
    slip = again[0].streams["slip"]
    assert slip.channels == ("slip_1_ratio", "slip_2_ratio", "slip_3_ratio")
    assert np.nanmedian(np.abs(slip.values)) == pytest.approx(0.1, abs=0.03)
    assert result.out == out
    with pytest.raises(LogError, match="is there already"):
        measure_slip(one_ground[:3], settings_of(tmp_path, out=out))


def test_changes_are_found_and_judged(tmp_path, one_ground, two_grounds):
    settings = FindChangesSettings(data=tmp_path, calibrate=tmp_path)
    result = find_changes(two_grounds, one_ground, settings)
    assert result.n_steps == 6
    assert result.found_ratio == 1.0
    assert abs(result.delay_median_s) < 2.0
    quiet = find_changes(one_ground[:5], one_ground[5:], settings)
    assert quiet.n_steps == 0
    assert quiet.n_without_step == 5
    assert np.isnan(quiet.found_ratio)
    with pytest.raises(DataError, match="is watched and calibrated on"):
        find_changes(one_ground[:5], one_ground, settings)


def test_what_cannot_be_measured_is_refused_in_one_sentence(tmp_path, one_ground):
    blind = [
        replace(run, streams={name: s for name, s in run.streams.items() if name != "pose"})
        for run in one_ground[:2]
    ]
    with pytest.raises(
        DataError, match=r"none of 2 runs has a slip; the first for this: run cork_00: nothing"
    ):
        measure_slip(blind, settings_of(tmp_path))
    other = replace(one_ground[0], robot="husky", run_id="other")
    with pytest.raises(DataError, match="of the robots husky, robotino"):
        measure_slip([one_ground[0], other], settings_of(tmp_path))
    with pytest.raises(DataError, match="there is no session 'loaded'"):
        measure_slip(one_ground, settings_of(tmp_path, predict=True, hold_out=("loaded",)))
    with pytest.raises(ConfigError, match=r"--delay is 'late'"):
        MeasureSlipSettings(data=tmp_path, delay="late")


def test_the_commands_print_and_write_their_results(tmp_path, one_ground, two_grounds):
    for folder, runs in (("one", one_ground), ("two", two_grounds)):
        for run in runs:
            write_run(run, tmp_path / folder)
    runner = CliRunner()
    json_file = tmp_path / "slip.json"
    found = runner.invoke(app, ["measure-slip", "--data", str(tmp_path / "one"), "--json", str(json_file)])
    assert found.exit_code == 0, found.output
    assert "moss" in found.output
    document = json.loads(json_file.read_text(encoding="utf-8"))
    assert document["surfaces"][1]["slip_ratio"] == pytest.approx(0.4, abs=0.01)
    found = runner.invoke(
        app, ["find-changes", "--data", str(tmp_path / "two"), "--calibrate", str(tmp_path / "one")]
    )
    assert found.exit_code == 0, found.output
    assert "found in 100.0 % of them" in found.output.replace("\n", " ")


@pytest.mark.slow
def test_measured_runs_reach_what_is_stated(tmp_path, measured):
    """Bounds are those of the task, not today's figures: a wrong sign or scale misses them by far."""
    runs = load_runs(measured("robotino") / "one_surface")
    result = measure_slip(runs, MeasureSlipSettings(data=tmp_path, predict=True))
    slips = {row.terrain: row.slip_ratio for row in result.surfaces}
    assert slips["table"] < slips["brown"] < slips["gray"] < slips["green"]
    for row in result.predictions:
        assert row.rms < 0.05
        assert 0.9 <= row.coverage <= 0.98
