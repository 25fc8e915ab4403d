import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from pipelines.cli.main import app
from pipelines.data.datasets import load_runs
from pipelines.slip.estimate import estimate_runs
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.write import write_run

SLIP = {"cork": 0.1, "moss": 0.4}
CURRENT = {"cork": 0.4, "moss": 0.8}


@pytest.fixture(scope="module")
def one_ground(omni_run):
    rng = np.random.default_rng(0)
    return [
        omni_run(rng, f"{name}_{i:02d}", name, i * 0.3, SLIP[name], CURRENT[name], noise=(0.05, 0.5))
        for name in SLIP
        for i in range(20)
    ]


@pytest.fixture(scope="module")
def two_grounds(omni_run):
    """Runs without a label, half on each of two grounds."""
    rng, first = np.random.default_rng(1), np.arange(0.0, 9.0, 0.031) < 4.5
    slip, current = (np.where(first, both["cork"], both["moss"]) for both in (SLIP, CURRENT))
    return [omni_run(rng, f"both_{i}", "", i, slip, current, "border", (0.05, 0.5)) for i in range(6)]


def measured_slips(runs, **options):
    return estimate_runs(runs, filter="pose", **({"delay": "0"} | options)).result


def test_slip_by_surface_and_its_prediction(one_ground, two_grounds):
    result = measured_slips([*one_ground, *two_grounds], predict=True)
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
    assert set(result.pictures) == {"slip_by_surface", "slip_by_run", "slip_by_motion"}
    assert result.report.answer.startswith("robotino slips by 0.1")


def test_the_same_input_and_seed_give_the_same_result(one_ground):
    first, second = (json.dumps(measured_slips(one_ground[::4], seed=3).as_json()) for _ in range(2))
    assert first == second


def test_changes_are_found_and_judged(one_ground, two_grounds):
    from pipelines.learn.ground_changes import find_changes

    result = find_changes(two_grounds, one_ground)
    assert result.n_steps == 6
    assert result.found_ratio == 1.0
    assert abs(result.delay_median_s) < 2.0
    quiet = find_changes(one_ground[:5], one_ground[5:])
    assert quiet.n_steps == 0
    assert quiet.n_without_step == 5
    assert np.isnan(quiet.found_ratio)
    with pytest.raises(DataError, match="is watched and calibrated on"):
        find_changes(one_ground[:5], one_ground)


def test_what_cannot_be_measured_is_refused_in_one_sentence(one_ground):
    blind = [replace(run, streams={"wheels": run.streams["wheels"]}) for run in one_ground[:2]]
    other = replace(one_ground[0], robot="husky", run_id="other")
    for runs, options, error, sentence in (
        (blind, {}, DataError, r"none of 2 runs has a slip; the first for this: run cork_00: nothing"),
        ([one_ground[0], other], {}, DataError, "of the robots husky, robotino"),
        (one_ground, {"predict": True, "hold_out": ("loaded",)}, DataError, "there is no session 'loaded'"),
        ([other], {"rollers": True}, ConfigError, "drive 'skid_steer' has no rollers"),
    ):
        with pytest.raises(error, match=sentence):
            measured_slips(runs, **options)


def test_the_command_writes_result_runs_and_pictures(tmp_path, one_ground):
    for run in one_ground:
        write_run(run, tmp_path / "one")
    words = ["estimate", "--filter", "pose", "--data", str(tmp_path / "one"), "--out", str(tmp_path / "out")]
    words += ["--json", str(tmp_path / "slip.json"), "--figures", str(tmp_path / "figures")]
    found = CliRunner().invoke(app, words)
    assert found.exception is None, found.output
    assert "moss" in found.output
    document = json.loads((tmp_path / "slip.json").read_text(encoding="utf-8"))
    assert document["surfaces"][1]["slip_ratio"] == pytest.approx(0.4, abs=0.01)
    assert document["figures"][0].endswith("slip_by_surface.png")
    slip = load_runs(tmp_path / "out")[0].streams["slip"]
    assert slip.channels == ("slip_1_ratio", "slip_2_ratio", "slip_3_ratio")
    assert np.nanmedian(np.abs(slip.values)) == pytest.approx(0.1, abs=0.03)
    assert isinstance(CliRunner().invoke(app, words).exception, LogError)


@pytest.mark.slow
def test_measured_runs_reach_what_is_stated(measured):
    """Bounds are those of the task, not today's figures: a wrong sign or scale misses them by far."""
    runs = load_runs(measured("robotino") / "one_surface")
    result = measured_slips(runs, delay="auto", predict=True)
    slips = {row.terrain: row.slip_ratio for row in result.surfaces}
    assert slips["table"] < slips["brown"] < slips["gray"] < slips["green"]
    for row in result.predictions:
        assert row.rms < 0.05
        assert 0.9 <= row.coverage <= 0.98
