"""Windows cut and classified on a thread: in order, bounded, apart by robot, and nothing stops it."""

import threading
import time
from collections import Counter, namedtuple

import numpy as np
import pytest

from pipelines.live.classifying import (
    AT_MOST,
    MAX_WAITING,
    ClassifierThread,
    Part,
    WindowOutput,
    classify_window,
)
from pipelines.live.observer import Observer
from terrain.logs.replay import replay
from terrain.records import Reading

Info = namedtuple("Info", "classes")
Model = namedtuple("Model", "recipe info novelty support", defaults=(None, None))
Window = namedtuple("Window", "start_s length_s")


class Recipe:
    classes_ = np.array(["a", "b"])

    def __init__(self, row):
        self.row = row

    def predict_proba(self, window):
        if isinstance(self.row, Exception):
            raise self.row
        return np.array([self.row])


def window(start_s):
    return Window(np.array([start_s]), 2.0)


def output(start_s, terrain="a"):
    return WindowOutput(start_s, start_s + 2.0, terrain, 1.0, np.array([1.0, 0.0]), ("a", "b"))


class EachStep:
    """A feed for which each step is a window, which starts at its newest stamp."""

    due_s = 0.0

    def __init__(self):
        self.dropped = Counter()

    def push(self, readings, estimates):
        return [window(float(readings["imu"].time_s[-1]))]


def step(start_s):
    return {"imu": Reading(np.array([start_s]), np.zeros((1, 1)))}


def wait_for(found, n):
    """The outputs of a robot, once there are n."""
    outputs, end_s = [], time.monotonic() + 10.0
    while len(outputs) < n and time.monotonic() < end_s:
        outputs += found()
        time.sleep(0.001)
    return [one.start_s for one in outputs]


def begun(thread, name="m"):
    robot = thread.robot()
    robot.begin(Part(name, EachStep()))
    while robot._waiting or robot._due_s > 0.0:
        time.sleep(0.001)
    return robot


@pytest.fixture
def gate():
    """A thread that classifies only while its event is set."""
    event = threading.Event()

    def classify(_, window):
        assert event.wait(10.0)
        return output(float(window.start_s[0]))

    thread = ClassifierThread(classify)
    yield event, thread
    event.set()
    thread.stop()


def test_the_output_is_the_class_of_the_largest_probability():
    found = classify_window(Model(Recipe([0.25, 0.75]), Info(("a", "b"))), window(4.0))
    assert found[:4] == (4.0, 6.0, "b", 0.75)
    assert found.probabilities.tolist() == [0.25, 0.75]
    assert found.took_s > 0.0


@pytest.mark.parametrize(
    ("row", "refused"),
    [
        (ValueError("Input X contains NaN."), "Input X contains NaN."),
        ([np.nan, 0.5], "a probability is not finite"),
    ],
)
def test_a_refused_window_has_no_class_and_the_reason(row, refused):
    found = classify_window(Model(Recipe(row), Info(("a", "b"))), window(0.0))
    assert (found.terrain, found.refused) == ("", refused)
    assert np.isnan([found.probability, *found.probabilities]).all()


def test_putting_waits_for_nothing_and_each_robot_gets_its_outputs_in_order(gate):
    event, thread = gate
    busy, other = begun(thread), begun(thread)
    for k in range(40):
        busy.put(step(2.0 * k), [])
    other.put(step(100.0), [])
    assert busy.finished() == other.finished() == []
    event.set()
    assert wait_for(other.finished, 1) == [100.0]
    assert wait_for(busy.finished, 40) == [2.0 * k for k in range(40)]
    assert busy.dropped == {}


def test_of_too_many_steps_the_oldest_are_left_out_and_counted(gate):
    event, thread = gate
    robot = begun(thread)
    robot.put(step(0.0), [])
    while robot._waiting:  # until the thread is at the first
        time.sleep(0.001)
    n = MAX_WAITING + 6
    for k in range(1, n):
        robot.put(step(float(k)), [])
    event.set()
    assert wait_for(robot.finished, MAX_WAITING + 1) == [0.0, *map(float, range(n - MAX_WAITING, n))]
    assert robot.dropped == {"steps: overrun": n - 1 - MAX_WAITING}


def test_the_thread_works_where_a_window_may_be_whole_and_after_many_steps(gate):
    event, thread = gate
    event.set()
    robot = begun(thread)
    robot._part.feed.due_s = robot._due_s = 100.0
    for k in range(AT_MOST - 1):
        robot.put(step(float(k)), [])
    time.sleep(0.05)
    assert robot.finished() == []
    robot.put(step(99.0), [])
    assert len(wait_for(robot.finished, AT_MOST)) == AT_MOST
    robot.put(step(100.0), [])
    assert wait_for(robot.finished, 1) == [100.0]


def test_what_was_put_before_another_model_is_classified_by_the_one_before():
    seen = []
    thread = ClassifierThread(lambda model, window: seen.append(model) or output(float(window.start_s[0])))
    robot = begun(thread, "first")
    for name in ("second", "third"):
        robot.put(step(0.0), [])
        robot.begin(Part(name, EachStep()))
    robot.put(step(1.0), [])
    time.sleep(0.01)
    robot.put(step(2.0), [])
    wait_for(robot.finished, 4)
    assert seen == ["first", "second", "third", "third"]
    thread.stop()


def test_an_unforeseen_error_costs_one_window():
    windows = {2.0: output(2.0)}
    thread = ClassifierThread(lambda model, window: windows[float(window.start_s[0])])
    robot = begun(thread)
    for start_s in (0.0, 2.0):
        robot.put(step(start_s), [])
    assert wait_for(robot.finished, 1) == [2.0]
    assert thread.failures == {"KeyError": 1}
    thread.stop()


def test_on_a_thread_a_robot_gets_the_windows_that_it_would_get_at_once(mower_model, two_drives):
    run, thread = two_drives[4], ClassifierThread()
    at_once, beside = Observer(mower_model), Observer(mower_model, classifying=thread.robot())
    desired, found = [], []
    for sample in replay(run):
        desired += at_once.update(sample.readings)
        found += beside.update(sample.readings)
    end_s = time.monotonic() + 10.0
    while len(found) < len(desired) and time.monotonic() < end_s:
        time.sleep(0.005)
        found += beside.update({})
    assert [one[:4] for one in found] == [one[:4] for one in desired]
    assert beside.belief.terrain == "b"
    thread.stop()
