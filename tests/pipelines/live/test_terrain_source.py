"""Live windows of a classifier equal those of its training, and no input stops the loop."""

from dataclasses import replace

import numpy as np
import pytest

from features.windows import cut_windows
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import Classifier, KnownTerrain, NoTerrain
from terrain.control.pilot_settings import PilotSettings, PilotStatus
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import SWITCHING, OutputStatus
from terrain.errors import DataError
from terrain.estimation.live.estimator import LiveEstimator
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.logs.replay import replay
from terrain.records import RunLog, Sample, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")
TERRAINS = ("grass", "tiles")


@pytest.fixture(scope="module")
def model(swerve_model):
    return swerve_model


@pytest.fixture(scope="module")
def log():
    return simulate_run(ROBOT, "grass", "survey", 6, duration_s=25.0)


def estimated(run):
    """The run with the streams that ``enriched`` adds, of the estimator on the robot."""
    estimator = LiveEstimator(ROBOT)
    estimates = [estimate for sample in replay(run) for estimate in estimator.step(sample.readings)]
    time_s = [estimate.time_s for estimate in estimates]
    channels = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
    streams = dict(with_wheel_speeds(run, ROBOT).streams)
    streams["estimator"] = Stream(
        time_s, [[getattr(e, name) for name in channels] for e in estimates], channels
    )
    slip = [estimate.slip_ratio for estimate in estimates]
    streams["slip"] = Stream(time_s, slip, tuple(f"slip_{i}_ratio" for i in (1, 2, 3)))
    return RunLog(run.run_id, run.robot, streams, run.labels)


def live(classifier, run, change=lambda sample: sample):
    """The outputs of a classifier for a replayed run, and its windows."""
    estimator, shown, found = LiveEstimator(ROBOT), [], []
    push = classifier._feed.push

    def keep(*sample):
        windows = push(*sample)
        shown.extend(windows)
        return windows

    classifier._feed.push = keep
    for sample in map(change, replay(run)):
        found += classifier.update(sample, estimator.step(sample.readings))
    return found, shown


def test_live_windows_and_outputs_equal_those_of_the_enriched_log(model, log):
    found, shown = live(Classifier(model, ROBOT), log)
    batch = cut_windows([estimated(log)], model.rule, layout=model.layout).windows
    assert len(shown) == len(batch) == len(found) > 5
    for k, window in enumerate(shown):
        assert window.start_s[0] == batch.start_s[k]
        for stream, values in batch.values.items():
            np.testing.assert_array_equal(window.values[stream][0], values[k], err_msg=stream)
    probability = model.recipe.predict_proba(batch)
    classes = model.recipe.classes_
    assert [one.terrain for one in found] == [classes[best] for best in probability.argmax(axis=1)]
    assert [one.probability for one in found] == pytest.approx(probability.max(axis=1), abs=1e-12)
    ends_s = batch.start_s + model.rule.length_s
    late_s = np.array([one.time_s for one in found]) - ends_s
    assert (np.abs(late_s) < 0.05).all()


def test_the_belief_of_a_classifier_ends_when_a_sensor_of_its_windows_is_lost(model, log):
    """Windows need the IMU: after 5 s of driving without one the terrain is unknown."""
    switching = SWITCHING._replace(unconfirmed_max_s=5.0)
    pilot = LivePilot(ROBOT, load_slip_table(), Classifier(model, ROBOT), PilotSettings(switching=switching))
    seen = []
    for sample in replay(log):
        if sample.time_s > 12.0:
            kept = {name: reading for name, reading in sample.readings.items() if name != "imu"}
            sample = sample._replace(readings=kept)
        seen.append((sample.time_s, *pilot.step(sample).status.values()))
    fields = ("time_s", *PilotStatus._fields)
    time_s, code, output, target = (
        np.array([row[fields.index(name)] for row in seen])
        for name in ("time_s", "terrain_code", "output_code", "target_ratio")
    )
    last_s = time_s[output == OutputStatus.ACCEPTED].max()
    assert last_s < 12.5
    assert (code[(time_s > last_s) & (time_s < last_s + 4.9)] >= 0).all()
    assert (code[time_s > last_s + 5.1] == -1).all()
    assert target[-1] == load_slip_table().lookup("")["traction"].slip_ratio
    assert np.abs(np.diff(target)).max() <= switching.rate_ratio * 0.0201


def test_a_pilot_accepts_the_classification_and_its_belief_outlasts_a_stop(model, log):
    pilot, accepted = LivePilot(ROBOT, load_slip_table(), Classifier(model, ROBOT)), []
    for sample in replay(log):
        accepted.append(pilot.step(sample).status["terrain_code"])
    assert pilot.terrains[int(accepted[-1])] == "grass"
    assert set(accepted) == {-1.0, accepted[-1]}
    for k in range(1500):  # half a minute
        last = pilot.step(Sample(sample.time_s + 0.02 * (k + 1), np.zeros(3), {})).status
    assert last["terrain_code"] >= 0


@pytest.mark.parametrize(
    ("stream", "channel"), [("imu", "accel_q_mps2"), ("gnss", "speed_x_mps"), ("estimator", "speed_z_mps")]
)
def test_a_model_that_requires_a_missing_channel_is_refused(model, stream, channel):
    channels = dict(model.info.channels)
    channels[stream] = (*channels.get(stream, ()), channel)
    rates = {**model.info.rate_hz, stream: 50.0}
    wanting = model._replace(info=replace(model.info, channels=channels, rate_hz=rates))
    with pytest.raises(DataError) as refused:
        Classifier(wanting, ROBOT)
    assert str(refused.value).startswith(
        f"the model requires {channel!r} of the stream {stream!r}, which is neither measured nor estimated"
    )


def test_a_known_terrain_is_given_once_a_change_and_no_terrain_never():
    known = KnownTerrain(lambda terrain: {"clay": "grass"}.get(terrain, terrain))
    terrains = ["", "clay", "clay", "", "clay", "snow", "snow", ""]
    samples = [Sample(float(k), np.zeros(3), {}, terrain) for k, terrain in enumerate(terrains)]
    found = [one for sample in samples for one in known.update(sample, [])]
    assert [(one.time_s, one.terrain, one.probability) for one in found] == [
        (1.0, "grass", 1.0),
        (5.0, "snow", 1.0),
    ]
    assert not any(NoTerrain().update(sample, []) for sample in samples)
    assert (known.certain, NoTerrain.certain, Classifier.certain) == (True, False, False)
