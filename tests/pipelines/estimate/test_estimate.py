"""``terrain estimate``: tracks, pictures and JSON of runs, and tuning on chosen ones."""

import json

import numpy as np
import pytest

from pipelines.data.settings import RunsSettings, load
from pipelines.estimate.estimate import estimate
from pipelines.estimate.settings import EstimateSettings
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError, DataError, LogError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.filters.tuning import TuningStatus
from terrain.logs.read import read_run
from terrain.logs.schema import signal_set_of
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.sensors.gnss import Gnss

ROBOT = load_robot("agrimaro")


def drive(scenario="straight", terrain="grass", seed=0, **options):
    return simulate_run(ROBOT, terrain, scenario, seed, **options)


KEYS = {
    *("run_id", "filter", "slip_mean", "slip_std", "slip_true_mean", "slip_observable", "slip_peak"),
    *("steady_s", "stale_s", "nis", "nees", "consistency", "speed_rmse_mps", "n_dropped", "n_gated"),
    *("dropped", "finite"),
}


def tuned_on(*names):
    return EstimateSettings(filter="vio15", tuning="likelihood", tune_on=names)


@pytest.fixture(scope="module")
def straight():
    return drive()


def test_a_skid_steer_robot_without_a_reference_has_no_slip_to_show(datasets_dir, tmp_path):
    from pipelines.data.datasets import load_runs

    run = load_runs(datasets_dir / "vulpi")[0]
    (row,) = estimate([run], EstimateSettings(filter="skid", out=tmp_path / "out")).runs
    assert row.slip_observable is False
    assert row.finite
    written = read_run(tmp_path / "out" / run.run_id)
    assert np.isnan(written.streams["slip"].values).all()
    assert (tmp_path / "out" / "figures" / f"{run.run_id}_motion.png").stat().st_size > 10_000
    with pytest.raises(ConfigError, match=r"vio15.*husky.*use skid"):
        estimate_run(run, load_robot("husky"), "vio15")


def test_runs_are_written_with_their_tracks_and_pictures(straight, tmp_path):
    seen = []
    settings = EstimateSettings(filter="vio15", out=tmp_path)
    result = estimate([straight], settings, progress=lambda *step: seen.append(step))
    assert seen == [("estimate vio15", 1, 1)]
    document = as_json(result)
    assert set(document) == {"filter", "tuning", "tuned", "out", "runs", "skipped", "clocks"}
    assert set(document["runs"][0]) >= KEYS
    assert json.loads(json.dumps(document)) == document
    run = read_run(tmp_path / straight.run_id)
    assert run.streams["slip"].channels == ("slip_1_ratio", "slip_2_ratio", "slip_3_ratio")
    assert run.streams["estimator"].channels[0] == "speed_x_mps"
    state = run.streams["state"]
    assert {"slip_speed_1_mps", "std_slip_1_ratio", "stale_ratio", "nis_camera_speed_ratio"} <= set(
        state.channels
    )
    assert (state.channel("std_speed_x_mps") > 0).all()
    assert all(signal_set_of("state", channel) is None for channel in state.channels)
    assert {"speed_1_mps", "current_1_a", "motor_1_radps"} <= set(run.streams["wheels"].channels)
    assert run.labels == straight.labels
    assert sorted(file.name for file in (tmp_path / "figures").iterdir()) == [
        f"{straight.run_id}_motion.png",
        f"{straight.run_id}_slip.png",
    ]
    with pytest.raises(LogError, match="is there already"):
        estimate([straight], settings)


def test_process_noise_is_tuned_on_chosen_runs():
    runs = [drive("survey", terrain, vary=True, duration_s=15.0) for terrain in ("tiles", "grass")]
    result = estimate(runs, tuned_on(runs[0].run_id))
    assert result.tuned.runs == (runs[0].run_id,)
    assert result.tuned.log_likelihood_after > result.tuned.log_likelihood_before
    assert result.tuned.status["steer"] is TuningStatus.FOUND
    assert all(row.finite and row.slip_observable for row in result.runs)
    with pytest.raises(DataError, match="no run 'grass_7' to tune on"):
        estimate(runs, tuned_on("grass_7"))
    with pytest.raises(ConfigError, match="go with the tuning 'likelihood', not 'physical'"):
        estimate(runs, EstimateSettings(filter="vio15", tune_on=(runs[0].run_id,)))


@pytest.mark.parametrize("training_run", [0, 1])
def test_noise_tuned_with_a_receiver_serves_runs_without_one_and_the_reverse(training_run):
    runs = [drive(duration_s=8.0, number=1, gnss=Gnss()), drive(duration_s=8.0, number=2)]
    result = estimate(runs, tuned_on(runs[training_run].run_id))
    assert all(row.finite and row.slip_observable for row in result.runs)
    assert ["gnss_position" in row.nis for row in result.runs] == [True, False]


def test_loggers_that_are_apart_are_named_and_aligned_on_request(tmp_path):
    """The wheels are logged 0.4 s late: without a word the effective track would be a fiction."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 60.0, 0.02)
    turn = np.convolve(rng.normal(size=time_s.size), np.ones(50) / 50, "same") * 4.0
    gyro = Stream(time_s, np.column_stack([turn + 0.01 * rng.normal(size=time_s.size)]), ("gyro_z_radps",))
    half = 0.5 * 1.5 * turn * 0.5708
    wheels = Stream(
        time_s + 0.4, np.column_stack([0.5 - half, 0.5 + half]), ("speed_left_mps", "speed_right_mps")
    )
    run = RunLog("late", "husky", {"imu": gyro, "wheels": wheels}, (Label(0.0, 60.0, "ICE"),))
    result = estimate([run], EstimateSettings(filter="skid"))
    assert len(result.clocks) == 1
    assert "apart in 1 of 1 runs, by -0.4" in result.clocks[0]
    assert estimate([run], EstimateSettings(filter="skid", align=True)).clocks == ()
    write_run(run, tmp_path)
    loaded = load(RunsSettings(data=tmp_path), align=True).runs[0]
    assert loaded.streams["wheels"].time_s[0] == pytest.approx(0.0, abs=0.05)
