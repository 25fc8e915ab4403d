"""Observers by name over whole logs: which robot has which, contracts of all, logs with estimates."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.observers.choice import OBSERVERS, make_observer, observers_of
from terrain.estimation.observers.estimate import observe_run, seconds_by_status, with_estimates
from terrain.estimation.observers.family import ObserverStatus
from terrain.estimation.observers.live import LiveObserver
from terrain.estimation.observers.rows import ROWS
from terrain.estimation.observers.slip_model import PARAMETERS, SlipModel, model_of
from terrain.estimation.observers.slip_model_file import read_slip_model, write_slip_model
from terrain.estimation.observers.summary import summarize_observer
from terrain.logs.read import read_run
from terrain.logs.write import write_run
from terrain.records import Reading, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.tracked import PrescribedSlip, simulate_tracked

UGV, CAR, HUSKY = (load_robot(name) for name in ("orchard_ugv", "adap2e", "husky"))
ROBOTS = {name: UGV if name in observers_of(UGV) else CAR for name in OBSERVERS}


@pytest.fixture(scope="module")
def straight():
    return simulate_tracked(UGV, PrescribedSlip(0.85, 0.85), np.tile([0.6, 0.6], (2001, 1)), 0)


@pytest.mark.parametrize("name", OBSERVERS)
def test_an_observer_keeps_to_the_interface(name):
    observer = make_observer(name, ROBOTS[name], SlipModel())
    assert observer.name == name
    assert set(observer.rows) <= set(ROWS)
    assert all(slip.startswith("slip_") and slip.endswith(("_ratio", "_rad")) for slip in observer.slips)
    output = observer.read(observer.params, observer.start)
    assert len(output.mean) == len(output.std) == len(observer.states)
    assert len(output.slip) == len(output.slip_std) == len(observer.slips)
    assert output.status == ObserverStatus.STARTING
    assert np.isnan(output.slip).all()  # what was never observed


@pytest.mark.parametrize("name", OBSERVERS)
def test_any_input_leaves_the_memory_finite_and_the_step_pure(name):
    observer, rng = make_observer(name, ROBOTS[name], SlipModel()), np.random.default_rng(5)
    wrong = np.array([np.nan, np.inf, -np.inf, 0.0, -0.5, 1e300, -1e9, 4.0])
    memory = np.array(observer.start)
    for _ in range(400):
        row = rng.normal(size=len(observer.rows)) * 0.5
        chosen = rng.random(len(row)) < 0.3
        row[chosen] = rng.choice(wrong, chosen.sum())
        dt_s = rng.choice([0.02, 0.0, -1.0, np.nan, 1e6, 0.1])
        kept, given = memory.copy(), row.copy()
        after = observer.step(observer.params, memory, row, float(dt_s))
        assert memory.tobytes() == kept.tobytes()
        assert row.tobytes() == given.tobytes()
        assert np.isfinite(after).all(), (row, dt_s)
        output = observer.read(observer.params, after)
        assert ObserverStatus(output.status) in ObserverStatus
        assert not np.isinf(np.concatenate([output.mean, output.std, output.slip, output.slip_std])).any()
        memory = after


@pytest.mark.parametrize("name", [name for name in OBSERVERS if ROBOTS[name] is UGV])
def test_live_is_the_batch(name, straight):
    batch = observe_run(straight, UGV, name, SlipModel())
    channels = {stream: straight.streams[stream].channels for stream in straight.streams}
    live, found = LiveObserver(make_observer(name, UGV, SlipModel()), UGV, channels), []
    for begin in np.arange(0.0, 5.0, 0.1):
        arrived = {}
        for stream, values in straight.streams.items():
            new = (values.time_s >= begin - 1e-9) & (values.time_s < begin + 0.1 - 1e-9)
            arrived[stream] = Reading(values.time_s[new], values.values[new])
        found += live.step(arrived)
    n = len(found)
    assert n == 250
    assert np.array([each.mean for each in found]).tobytes() == batch.track.mean[:n].tobytes()
    assert np.array([each.status for each in found]).tolist() == batch.track.status[:n].tolist()


def test_a_robot_has_the_observers_of_its_description():
    assert observers_of(HUSKY) == ()
    only = replace(UGV, filters=("tracked",))
    assert observers_of(only) == ("tracked",)
    with pytest.raises(ConfigError, match="filter 'endo' is not for robot orchard_ugv"):
        make_observer("endo", only)
    with pytest.raises(ConfigError, match="whose drive is skid_steer: none is"):
        make_observer("tracked", HUSKY)


def test_estimates_are_written_and_read_as_streams_of_the_log(straight, tmp_path):
    found = observe_run(straight, UGV, "tracked")
    write_run(with_estimates(found), tmp_path)
    run = read_run(tmp_path / "run")
    assert run.filter == "tracked"
    assert run.streams["slip"].channels == ("slip_left_ratio", "slip_right_ratio")
    assert run.streams["slip"].values[-1] == pytest.approx([0.15, 0.15], abs=0.02)
    assert run.streams["estimator"].channels == ("speed_x_mps", "yaw_rate_radps")
    assert {"std_slip_left_ratio", "observer_code", "eta_left_ratio"} <= set(run.streams["state"].channels)
    learned = with_estimates(observe_run(straight, UGV, "slip-learning"))
    assert "angle_roll_rad" not in learned.streams["state"].channels


def test_figures_of_a_run_are_those_of_its_truth(straight):
    found = observe_run(straight, UGV, "tracked")
    figures = summarize_observer(found)
    assert figures.slip["slip_left_ratio"].true_mean == pytest.approx(0.15)
    assert figures.status_s == seconds_by_status(found.track)
    assert sum(figures.status_s.values()) == pytest.approx(40.0)
    assert figures.finite
    assert figures.position_rmse_m < 0.05
    blind = RunLog("a", "orchard_ugv", {k: v for k, v in straight.streams.items() if k != "truth"})
    figures = summarize_observer(observe_run(blind, UGV, "gyrodometry"))
    assert np.isnan(figures.position_rmse_m)
    assert figures.slip == {}


def test_a_robot_with_an_effect_is_corrected_first(straight):
    slipping = observe_run(straight, UGV, "tracked").track
    radius = {"wheel_radius_ratio": -0.15}
    larger = replace(UGV, effects=radius, effects_cov=np.full((1, 1), np.nan))
    explained = observe_run(straight, larger, "tracked").track
    assert slipping.slip[-1] == pytest.approx([0.15, 0.15], abs=0.02)
    assert explained.slip[-1] == pytest.approx([0.0, 0.0], abs=0.02)


def test_a_log_without_fixes_or_gyro_is_run_and_says_so(straight):
    def without(*names):
        return RunLog("a", "orchard_ugv", {k: v for k, v in straight.streams.items() if k not in names})

    found = observe_run(without("pose", "gnss", "compass"), UGV, "tracked")
    assert found.missing == ("position_x_m", "position_y_m", "yaw_rad")
    assert summarize_observer(found).missing == found.missing
    assert summarize_observer(observe_run(straight, UGV, "tracked")).missing == ()
    blind = found.track
    assert set(blind.status) == {ObserverStatus.STARTING}
    assert np.isnan(blind.slip).all()
    assert np.isfinite(observe_run(without("imu"), UGV, "gyrodometry").track.mean[:, :3]).all()


def test_a_slip_model_is_read_as_it_was_written(tmp_path):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(len(PARAMETERS), len(PARAMETERS)))
    given = model_of(rng.uniform(0.1, 1.0, len(PARAMETERS)))
    model = replace(
        given, covariance=1e-4 * root @ root.T, slip_std_ratio=0.01, run_angle_std_rad=0.04, correlation_s=0.7
    )
    file = tmp_path / "slip.yaml"
    write_slip_model(file, model, "patako")
    read = read_slip_model(file, "patako")
    assert read.vector == pytest.approx(model.vector, rel=1e-5)
    assert read.covariance == pytest.approx(model.covariance, rel=1e-4, abs=1e-9)
    assert (read.slip_std_ratio, read.run_angle_std_rad, read.correlation_s) == (0.01, 0.04, 0.7)
    with pytest.raises(ConfigError, match="is the slip model of robot 'patako', not 'marmotte'"):
        read_slip_model(file, "marmotte")
    with pytest.raises(ConfigError, match="is there already"):
        write_slip_model(file, model, "patako")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("turning_exponent: {value: 0.87", "turning_exponent: {value: .nan", "a finite number is required"),
        ("turning_exponent:", "turning_exponents:", "key 'turning_exponents' is unknown"),
        ("slip_std_ratio: 0.01", "slip_std_ratio: -1", "from zero up is required"),
        ("correlation:\n", "correlation: [[1.0]]\nfound2:\n", "key 'found2' is unknown"),
    ],
)
def test_a_slip_model_that_cannot_be_is_refused(tmp_path, old, new, message):
    file = tmp_path / "slip.yaml"
    write_slip_model(file, SlipModel(turning_exponent=0.87, slip_std_ratio=0.01), "patako")
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        read_slip_model(file, "patako")


def test_an_estimate_of_channels_that_are_missing_is_refused(straight):
    wheels = straight.streams["wheels"]
    left = Stream(wheels.time_s, wheels.values[:, :1], wheels.channels[:1])
    lost = dict(straight.streams) | {"wheels": left}
    with pytest.raises(ConfigError, match="'speed_right_mps' must be among them"):
        observe_run(RunLog("a", "orchard_ugv", lost), UGV, "tracked")
