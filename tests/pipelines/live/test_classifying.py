"""Live windows of a classifier equal those of its training, at once and on a thread, and no input stops the loop."""

import threading
import time
from collections import deque, namedtuple
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from features.windows import cut_windows
from pipelines.data.datasets import load_runs
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs, info_of, with_limits
from pipelines.live.assess import NOT_LIKE, as_evidence, assess
from pipelines.live.classifying import AT_MOST, MAX_WAITING, Classifier, WindowOutput, classify_window
from terrain.classify.terrain_filter import check_settings, filter_run, reported
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.replay import replay
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import Reading, Stream
from terrain.robots import load_robot

from . import until

ROBOT = load_robot("agrimaro")


def estimated(run):
    """The run with the streams that ``enriched`` adds, of the estimator on the robot."""
    estimator = make_live_filter("vio15", ROBOT, CHANNELS)
    estimates = [estimate for sample in replay(run) for estimate in estimator.step(sample.readings)]
    time_s = [estimate.time_s for estimate in estimates]
    motion = [[getattr(estimate, name) for name in ESTIMATOR_CHANNELS] for estimate in estimates]
    slip = [estimate.slip_ratio for estimate in estimates]
    streams = {
        "estimator": Stream(time_s, motion, ESTIMATOR_CHANNELS),
        "slip": Stream(time_s, slip, tuple(f"slip_{i}_ratio" for i in (1, 2, 3))),
    }
    return replace(run, streams=dict(with_wheel_speeds(run, ROBOT).streams) | streams)


def test_live_windows_and_outputs_equal_those_of_the_enriched_log(swerve_model, survey, monkeypatch):
    shown, found, late_s = [], [], []

    def classify(model, window, recent):
        shown.append(window)
        return classify_window(model, window, recent)

    monkeypatch.setattr("pipelines.live.classifying.classify_window", classify)
    classifier, estimator = Classifier(swerve_model, ROBOT), make_live_filter("vio15", ROBOT, CHANNELS)
    for sample in replay(survey):
        new = classifier.update(sample, estimator.step(sample.readings))
        found += new
        late_s += [sample.time_s - one.time_s for one in new]
    batch = cut_windows([estimated(survey)], swerve_model.info.rule, layout=swerve_model.info.layout).windows
    assert len(shown) == len(batch) == len(found) > 5
    for k, window in enumerate(shown):
        assert window.start_s[0] == batch.start_s[k]
        for stream, values in batch.values.items():
            np.testing.assert_array_equal(window.values[stream][0], values[k], err_msg=stream)
    probability = swerve_model.recipe.predict_proba(batch)
    best = swerve_model.recipe.classes_[probability.argmax(axis=1)]
    assert [one.terrain for one in found] == best.tolist()
    assert [one.probability for one in found] == pytest.approx(probability.max(axis=1), abs=1e-12)
    assert [one.time_s for one in found] == (batch.start_s + batch.length_s).tolist()
    assert np.abs(late_s).max() < 0.05


def test_windows_one_by_one_are_assessed_as_those_of_a_log_and_say_why_they_are_unknown(model, windows):
    """Over a manoeuvre of several windows, which ends with the run; a ground that turns the robot half as far."""
    run = windows[windows.run_id == windows.run_id[-1]]
    place = run.channels["imu"].index("gyro_z_radps")
    imu = run.values["imu"].copy()
    imu[:, place] = imu[:, place] * 0.2 + 0.6
    run = replace(run, values={**run.values, "imu": imu})
    batch, recent = assess(model, run), deque()
    for i in range(len(run)):
        output = classify_window(model, run[i], recent)
        assert output.answers == pytest.approx(batch.answers[i], rel=1e-9)
        assert (output.terrain == "", output.reason) == (batch.unknown[i], batch.reason[i])
        assert len(recent) <= 3
    assert batch.unknown.all()
    assert "does not turn like this" in batch.reason[-1]
    assert assess(model, run[-1]).answers[0] != batch.answers[-1]
    # the filter over time follows within three windows, though the classifier is certain; looks have their own weight
    certain, time_s = np.tile([0.9, 0.05, 0.05], (6, 1)), np.arange(2.0, 14.0, 2.0)
    reason = np.array(["", "", NOT_LIKE, *["ASPHALT does not turn like this"] * 3], dtype=object)
    evidence = as_evidence(certain, reason)
    np.testing.assert_array_equal(evidence[:3], certain[:3])
    found = reported(filter_run(evidence, time_s, check_settings([1 / 3] * 3)))
    assert found.tolist()[:4] + found.tolist()[-1:] == [0, 0, 0, 0, -1]


@pytest.mark.slow
def test_half_the_yaw_of_a_warthog_is_found_in_a_session_that_was_held_out(datasets_dir):
    """As ice has it, which turns the robot less than the wheels say; the looks are those of asphalt."""
    runs = load_runs(datasets_dir / "drive_warthog_terrains", robot="warthog")
    settings = RecipeSettings(signal_sets=("imu", "wheels"))
    data = data_of_runs([run for run in runs if run.session != "asphalt_2"], settings)
    data.recipe[-1].fit(data.rows, data.samples.terrain, groups=data.samples.group)
    info = info_of(data, settings, "")
    model, _ = with_limits(data.recipe, info, data.samples, data.features, data.motion)
    held_out = [run for run in runs if run.session == "asphalt_2"]
    windows = cut_windows(held_out, info.rule, layout=info.layout).windows
    assert assess(model, windows).unknown.mean() < 0.1
    imu = windows.values["imu"].copy()
    imu[:, windows.channels["imu"].index("gyro_z_radps")] *= 0.5
    found = assess(model, replace(windows, values={**windows.values, "imu": imu}))
    assert found.unknown.mean() > 0.6
    assert np.char.endswith(found.reason[found.unknown].astype(str), "does not turn like this").mean() > 0.9


# The thread that cuts and classifies


Window = namedtuple("Window", "start_s length_s")


def window(start_s):
    return Window(np.array([start_s]), 2.0)


def stub_model(name):
    """A model of a name that cuts any windows."""
    info = SimpleNamespace(classes=("a",), channels={}, rate_hz={}, least_rate_hz={}, rule=name, filter="")
    return SimpleNamespace(info=info, over_time=None, adaptation=None)


@pytest.fixture
def gate(monkeypatch):
    """An event, and a thread that classifies only while it is set; each step is a window of its own."""

    def feed_of(*_):
        def push(readings, _):
            return [window(float(readings["imu"].time_s[-1]))]

        return SimpleNamespace(due_s=0.0, dropped={}, push=push)

    def classify(model, window, recent):
        assert event.wait(10.0)
        if window.start_s[0] < 0:
            raise KeyError("unforeseen")
        return WindowOutput(window.start_s[0], 0.0, "a", 1.0, {"a": 1.0}, nearest=model.info.rule)

    monkeypatch.setattr("pipelines.live.classifying.feed_of", feed_of)
    monkeypatch.setattr("pipelines.live.classifying.classify_window", classify)
    event, thread = threading.Event(), ThreadPoolExecutor(1)
    yield event, thread
    event.set()
    thread.shutdown(cancel_futures=True)


def take(robot, start_s):
    return robot.take({"imu": Reading(np.array([start_s]), np.zeros((1, 1)))}, [])


def begun(thread, name="m"):
    robot = Classifier(stub_model(name), None, thread)
    until(lambda: not robot._waiting and robot._due_s == 0.0)
    return robot


def outputs(robot, n):
    """The outputs of a robot, once there are n."""
    until(lambda: len(robot._finished) >= n)
    return list(robot._finished)


def starts(robot, n):
    return [one.start_s for one in outputs(robot, n)]


def test_taking_waits_for_nothing_and_each_robot_gets_its_outputs_in_order(gate):
    """That windows on a thread are those at once is tested with a service."""
    event, thread = gate
    busy, other = begun(thread), begun(thread)
    assert [take(busy, 2.0 * k) for k in range(40)] == [[]] * 40
    assert take(other, 100.0) == []
    event.set()
    assert starts(other, 1) == [100.0]
    assert starts(busy, 40) == [2.0 * k for k in range(40)]
    assert busy.dropped == {}


def test_the_belief_of_the_terrain_filter_goes_on_where_windows_begin_anew(gate):
    """As where the clock was set: the first window after it is not taken alone."""
    model = stub_model("m")
    model.over_time, model.info.window_s = check_settings((0.5, 0.5)), 2.0
    robot, fresh = Classifier(model, None), Classifier(model, None)
    for k in range(8):
        robot._over_time.take(100.0 + k / 4, np.array([0.9, 0.1]))
    robot.restart()
    assert robot._over_time.take(2.0, np.array([0.45, 0.55]))[0] == 0
    assert fresh._over_time.take(2.0, np.array([0.45, 0.55]))[0] == 1


def test_a_window_of_a_model_of_other_terrains_is_no_evidence_after_a_swap(gate):
    event, thread = gate
    event.set()
    robot, model = begun(thread), stub_model("m")
    model.over_time, model.info.window_s, model.info.classes = check_settings((0.5, 0.5)), 2.0, ("b", "c")
    take(robot, 0.0)
    outputs(robot, 1)
    robot.swap(model)
    assert robot.update(SimpleNamespace(readings={}), []) == []
    assert [one.nearest for one in robot.outputs] == ["m"]


def test_of_too_many_steps_the_oldest_are_left_out_and_counted(gate):
    event, thread = gate
    robot = begun(thread)
    take(robot, 0.0)
    until(lambda: not robot._waiting)  # the thread is at the first
    n = MAX_WAITING + 6
    for k in range(1, n):
        take(robot, float(k))
    event.set()
    assert starts(robot, MAX_WAITING + 1) == [0.0, *map(float, range(n - MAX_WAITING, n))]
    assert robot.dropped == {"steps: overrun": n - 1 - MAX_WAITING}


def test_the_thread_works_where_a_window_may_be_whole_and_after_many_steps(gate):
    event, thread = gate
    event.set()
    robot = begun(thread)
    robot._part.feed.due_s = robot._due_s = 100.0
    for k in range(AT_MOST - 1):
        take(robot, float(k))
    time.sleep(0.05)
    assert not robot._finished
    take(robot, 99.0)
    assert len(starts(robot, AT_MOST)) == AT_MOST
    assert len(take(robot, 100.0)) == AT_MOST
    assert starts(robot, 1) == [100.0]


def test_models_are_changed_in_order_and_an_unforeseen_error_costs_one_window(gate):
    event, thread = gate
    event.set()
    robot = begun(thread, "first")
    for name in ("second", "third"):
        robot._waiting.append(({"imu": Reading(np.array([0.0]), np.zeros((1, 1)))}, []))
        robot.swap(stub_model(name))
    for start_s in (-1.0, 1.0, 2.0):
        robot._waiting.append(({"imu": Reading(np.array([start_s]), np.zeros((1, 1)))}, []))
        thread.submit(robot._work_beside)
    assert [one.nearest for one in outputs(robot, 4)] == ["first", "second", "third", "third"]
    assert robot.dropped == {"window: lost to a fault, KeyError": 1}
