"""The live observer gives the terrain that the log gives, of every robot, and no input stops it."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from pipelines.learn.predict import predict
from pipelines.learn.training_data import fitted_model
from pipelines.live.classifying import Classifier
from pipelines.live.observer import Observer
from terrain.control.slip_table import load_slip_table
from terrain.errors import DataError
from terrain.estimation.estimate import enriched, estimate_run
from terrain.logs.replay import replay
from terrain.records import Reading, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import Conditions

AGRIMARO, HUSKY, TABLE = load_robot("agrimaro"), load_robot("husky"), load_slip_table()
DATA = Path(os.environ.get("TERRAIN_DATA", "/nowhere"))


@pytest.fixture(scope="module")
def grass():
    return simulate_run(AGRIMARO, "grass", "survey", 5, 7, duration_s=25.0)


def observed(observer, run, rate_hz=50.0):
    return [one for sample in replay(run, rate_hz) for one in observer.update(sample.readings)]


def channels_of(run):
    return {name: stream.channels for name, stream in run.streams.items()}


def assert_same(found, rows):
    assert [(one.start_s, one.terrain) for one in found] == [(row.start_s, row.terrain) for row in rows]
    assert [one.probability for one in found] == pytest.approx([row.probability for row in rows], abs=1e-12)
    for one, row in zip(found, rows, strict=True):
        target = TABLE.lookup(one.terrain)
        assert {state: each.slip_ratio for state, each in target.items()} == row.target_slip


def test_a_raw_log_is_filtered_by_predict_and_live_alike(swerve_model, grass):
    """The filter of a log takes latencies off, which a live one cannot: nearly all windows agree."""
    raw = predict([grass], swerve_model, TABLE)
    assert raw.filtered == (grass.run_id,)
    assert raw.n_judged == raw.n_windows > 5
    observer = Observer(swerve_model, robot=AGRIMARO, channels=channels_of(grass))
    assert observer.belief.terrain == ""
    assert_same(observed(observer, grass), raw.windows)
    whole = predict([enriched(estimate_run(grass, AGRIMARO, "vio15"))], swerve_model, TABLE)
    assert whole.filtered == ()
    assert [row.start_s for row in raw.windows] == [row.start_s for row in whole.windows]
    assert np.mean([a.terrain == b.terrain for a, b in zip(raw.windows, whole.windows, strict=True)]) >= 0.9
    assert observer.belief.terrain == "grass"
    wheels = grass.streams["wheels"]
    for k in range(1, 12 * 50):  # it drives on in silence
        observer.update({"wheels": Reading(wheels.time_s[-1:] + k / 50, wheels.values[-200:-199])})
    assert observer.belief.terrain == ""


def test_a_skid_steer_robot_is_filtered_where_its_model_needs_the_filter(trained):
    if not (DATA / "vulpi").is_dir():
        pytest.skip("TERRAIN_DATA has no vulpi")
    runs = load_runs(DATA / "vulpi")
    model = trained([enriched(estimate_run(run, HUSKY, "slip")) for run in runs[::2]])
    assert (model.info.filter, model.info.robots) == ("slip", ("husky",))
    rows = predict(runs[5:6], model, TABLE).windows
    assert len(rows) > 5
    observer = Observer(model, robot=HUSKY, channels=channels_of(runs[5]))
    assert_same(observed(observer, runs[5]), rows)
    assert observer.estimate.speed_x_mps > 0.1


@pytest.mark.slow
def test_slip_by_an_observer_of_tracked_robots_is_a_feature_in_the_log_and_live(trained):
    robot, sloped = load_robot("orchard_ugv"), Conditions(grade_ratio=(0.15, 0))
    runs = [
        simulate_run(robot, terrain, "survey", 5, k, duration_s=20.0, conditions=sloped)
        for terrain in ("clay", "dry_sand")
        for k in (1, 2, 3)
    ]
    unseen = runs.pop(2)
    model = trained([enriched(estimate_run(run, robot, "tracked")) for run in runs[:4]])
    assert model.info.filter == "tracked"
    assert set(model.info.channels["slip"]) == {"slip_left_ratio", "slip_right_ratio"}
    rows = predict([unseen], model, TABLE).windows
    assert len(rows) >= 5
    observer = Observer(model, robot=robot, channels=channels_of(unseen))
    assert_same(observed(observer, unseen), rows)
    assert observer.estimate.status.label == "standing"  # at the end of the drive


def test_a_terrain_that_nothing_confirms_becomes_unknown_also_where_no_wheels_are_measured(
    mower_model, two_drives
):
    """Of a robot without a description, which is observed by its channels."""
    run, observer = two_drives[4], Observer(mower_model)
    assert_same(observed(observer, run), predict([run], mower_model, TABLE).windows)
    assert observer.belief.terrain == "b"
    for k in range(1, 150):
        observer.update({"imu": Reading(np.array([run.end_s + 0.1 * k]), np.full((1, 1), math.nan))})
    assert observer.belief.terrain == ""


@pytest.mark.parametrize("far_s", [-600.0, 4000.0])
def test_after_a_clock_was_set_windows_begin_anew(mower_model, two_drives, far_s):
    """Set back for good, or far ahead for two samples."""
    observer, run, stamps = Observer(mower_model), two_drives[4], []
    for k, sample in enumerate(replay(run)):
        ahead_s = far_s * (sample.time_s > 6.0 if far_s < 0 else k in (300, 301))
        readings = {name: Reading(t + ahead_s, values) for name, (t, values) in sample.readings.items()}
        stamps += [found.end_s for found in observer.update(readings)]
    assert observer.dropped["time: clock set"] >= 1
    assert sum(stamp_s > 1000.0 for stamp_s in stamps) == 0
    assert min(stamps) < -500.0 if far_s < 0 else max(stamps) > 8.5
    assert observer.belief.terrain == "b"


BROKEN = [
    *(None, "text", {}, {"imu": None}, {"imu": (1.0, 2.0)}, {3: Reading(np.array([1.0]), np.zeros((1, 1)))}),
    *(
        {"imu": Reading(np.array(stamps), np.array(values))}
        for stamps, values in (
            *(([1.0], [[0.0], [0.0]]), ([1.0], [[0.0] * 5]), ([np.nan], [[np.inf]]), ([], np.zeros((0, 1)))),
            *((["a"], [["b"]]), ([10**400], [[1.0]])),
        )
    ),
]


def test_whatever_arrives_nothing_raises_and_the_next_windows_are_as_before(mower_model, two_drives):
    run = two_drives[1]
    observer, found = Observer(mower_model), []
    for k, sample in enumerate(replay(run)):
        if k % 10 == 5:
            assert observer.update(BROKEN[k // 10 % len(BROKEN)]) == []
        found += observer.update(sample.readings)
    assert [one[:4] for one in found] == [one[:4] for one in observed(Observer(mower_model), run)]


def test_samples_that_name_their_columns_need_no_channels(mower_model, two_drives):
    """As of a run with more columns, in another order."""
    run = two_drives[4]
    named = {"imu": ("gyro_z_radps", "accel_z_mps2"), "wheels": ("current_left_a", "speed_left_mps")}
    streams = {
        name: Stream(s.time_s, np.hstack([np.full((len(s), 1), np.nan), s.values]), named[name])
        for name, s in run.streams.items()
    }
    found = observed(Observer(mower_model), RunLog("m", "mower", streams))
    assert [one[:4] for one in found] == [one[:4] for one in observed(Observer(mower_model), run)]
    del streams["imu"]
    with pytest.raises(DataError, match="of the stream 'imu'"):
        observed(Observer(mower_model), RunLog("m", "mower", streams))


def test_a_window_that_the_model_refuses_is_named(mower_model, two_drives):
    class Refusing:
        classes_ = mower_model.recipe.classes_

        def predict_proba(self, windows):
            if windows.start_s[0] < 1.0:
                raise ValueError("Input X contains NaN.")
            return np.array([[math.nan, 0.5]])

    observer = Observer(mower_model._replace(recipe=Refusing()))
    found = observed(observer, two_drives[0])
    reasons = ["Input X contains NaN.", *["a probability is not finite"] * 5]
    assert [(one.refused, one.terrain) for one in found] == [(why, "") for why in reasons]
    assert np.isnan([(one.probability, *one.probabilities.values()) for one in found]).all()
    assert observer.dropped == {f"window: refused, {why}": reasons.count(why) for why in reasons}
    assert observer.belief.terrain == ""


def test_what_does_not_fit_is_refused_at_once(mower_model, swerve_model, grass):
    info, another = swerve_model.info, simulate_run(AGRIMARO, "grass", "survey", 5, 8, duration_s=9.0)
    measured = {name: info.channels[name] for name in ("imu", "wheels")}
    with pytest.raises(DataError, match="requires 'accel_z_mps2' of the stream 'imu'"):
        Observer(mower_model, channels={"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)})
    with pytest.raises(DataError, match="of the stream 'estimator', which is neither"):
        Observer(swerve_model, channels=measured)
    with pytest.raises(DataError, match="filter 'tracked', which robot agrimaro does not run live"):
        Observer(
            swerve_model._replace(info=replace(info, filter="tracked")), None, AGRIMARO, channels_of(grass)
        )
    filtered = [
        enriched(estimate_run(*given))
        for given in ((grass, AGRIMARO, "vio15"), (another, AGRIMARO, "encoder12"))
    ]
    with pytest.raises(DataError, match="estimates of encoder12 and vio15"):
        fitted_model(filtered)
    for stream, channel in (("imu", "accel_q_mps2"), ("gnss", "speed_x_mps"), ("estimator", "speed_z_mps")):
        more = {**info.channels, stream: (*info.channels.get(stream, ()), channel)}
        other = replace(info, channels=more, rate_hz={**info.rate_hz, stream: 50.0})
        with pytest.raises(
            DataError, match=f"'{channel}' of the stream '{stream}', which is neither measured"
        ):
            Classifier(swerve_model._replace(info=other), AGRIMARO)
