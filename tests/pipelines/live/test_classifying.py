"""Windows classified on a thread: in order, bounded, apart by robot, and nothing stops it."""

import threading
import time
from collections import namedtuple

import numpy as np
import pytest

from pipelines.live.classifying import MAX_WAITING, AtOnce, ClassifierThread, WindowOutput, classify_window

Info = namedtuple("Info", "classes")
Model = namedtuple("Model", "recipe info")
Window = namedtuple("Window", "start_s length_s")


class Recipe:
    classes_ = np.array(["a", "b"])

    def __init__(self, *rows):
        self.rows = list(rows)

    def predict_proba(self, window):
        row = self.rows.pop(0)
        if isinstance(row, Exception):
            raise row
        return np.array([row])


def model(*rows):
    return Model(Recipe(*rows), Info(("a", "b")))


def window(start_s):
    return Window(np.array([start_s]), 2.0)


def output(start_s):
    return WindowOutput(start_s, start_s + 2.0, "a", 1.0, np.array([1.0, 0.0]), ("a", "b"))


def wait_for(found, n, timeout_s=10.0):
    """The outputs of a robot, once there are n."""
    outputs, end_s = [], time.monotonic() + timeout_s
    while len(outputs) < n and time.monotonic() < end_s:
        outputs += found()
        time.sleep(0.001)
    return outputs


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
    found = classify_window(model([0.25, 0.75]), window(4.0))
    assert found[:4] == (4.0, 6.0, "b", 0.75)
    assert found.probabilities.tolist() == [0.25, 0.75]
    assert found.took_s > 0.0


@pytest.mark.parametrize(
    ("row", "refused"),
    [
        (ValueError("Input X contains NaN."), "Input X contains NaN."),
        (FloatingPointError("overflow"), "overflow"),
        ([np.nan, 0.5], "a probability is not finite"),
    ],
)
def test_a_refused_window_has_no_class_and_the_reason(row, refused):
    found = classify_window(model(row), window(0.0))
    assert (found.terrain, found.refused) == ("", refused)
    assert np.isnan([found.probability, *found.probabilities]).all()


def test_at_once_gives_each_output_once():
    classifying = AtOnce()
    classifying.submit(model([0.9, 0.1]), window(0.0))
    assert [one.terrain for one in classifying.finished()] == ["a"]
    assert classifying.finished() == []


def test_submitting_waits_for_nothing_and_outputs_come_in_order(gate):
    event, thread = gate
    robot = thread.robot()
    for start_s in (0.0, 2.0, 4.0):
        robot.submit(model(), window(start_s))
    assert robot.finished() == []
    event.set()
    assert [one.start_s for one in wait_for(robot.finished, 3)] == [0.0, 2.0, 4.0]
    assert robot.n_overrun == 0


def test_of_too_many_windows_the_oldest_are_left_out_and_counted(gate):
    event, thread = gate
    robot = thread.robot()
    n = MAX_WAITING + 6
    robot.submit(model(), window(0.0))
    while robot._waiting:  # until the thread is at the first
        time.sleep(0.001)
    for k in range(1, n):
        robot.submit(model(), window(2.0 * k))
    event.set()
    starts = [one.start_s for one in wait_for(robot.finished, MAX_WAITING + 1)]
    assert starts == [0.0, *(2.0 * k for k in range(n - MAX_WAITING, n))]
    assert robot.n_overrun == n - 1 - MAX_WAITING


def test_robots_get_their_own_outputs_and_one_cannot_take_the_turns_of_another(gate):
    event, thread = gate
    busy, other = thread.robot(), thread.robot()
    for k in range(40):
        busy.submit(model(), window(2.0 * k))
    other.submit(model(), window(100.0))
    event.set()
    assert [one.start_s for one in wait_for(other.finished, 1)] == [100.0]
    assert all(one.start_s < 100.0 for one in wait_for(busy.finished, MAX_WAITING))


def test_an_unforeseen_error_costs_one_window():
    def classify(model, window):
        if window.start_s[0] == 0.0:
            raise KeyError("unforeseen")
        return output(float(window.start_s[0]))

    thread = ClassifierThread(classify)
    robot = thread.robot()
    robot.submit(model(), window(0.0))
    robot.submit(model(), window(2.0))
    assert [one.start_s for one in wait_for(robot.finished, 1)] == [2.0]
    assert thread.failures == {"KeyError": 1}
    thread.stop()
    assert not thread._thread.is_alive()
