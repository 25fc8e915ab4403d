"""Clocks of streams: stamps that are set, late, ahead or garbage, and what is counted of them."""

import math

import numpy as np
import pytest

from terrain.estimation.clocks import AHEAD_S, N_AGREED, PERIOD_S, Clocks, Inbox
from terrain.estimation.live import REWIND_S
from terrain.records import Reading

STREAMS, HOUR_S = ("wheels", "imu"), 3600.0
ANY_STEP = pytest.mark.parametrize("step_s", [HOUR_S, -HOUR_S, 0.6, -0.4])


def reading(*stamps):
    return Reading(np.array(stamps), np.arange(len(stamps), dtype=float)[:, None] * np.ones(3))


class Robot:
    """Two streams with a sample a step, and a clock of the steps; each may be set."""

    def __init__(self, n=10):
        self.clocks, self.true_s = Clocks(), 100.0
        self.step_s = dict.fromkeys((*STREAMS, "time"), 0.0)
        self.late_s = dict.fromkeys(STREAMS, 0.0)
        self.begun = self.run(n)

    def step(self):
        """Return the time since the start by the clocks, and by stream how old its sample seems to be."""
        self.true_s += PERIOD_S
        given = {name: reading(self.true_s - self.late_s[name] + self.step_s[name]) for name in STREAMS}
        now_s, found = self.clocks.step(self.true_s + self.step_s["time"], given)
        return now_s, {name: now_s - taken.time_s[-1] for name, taken in found.items()}

    def run(self, n):
        return [self.step() for _ in range(n)]


@ANY_STEP
@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_the_clock_of_one_stream_is_found_again_after_three_readings(step_s, late_s):
    robot = Robot(0)
    robot.late_s["imu"] = late_s
    robot.run(10)
    robot.step_s["imu"] = step_s
    ages = [ages for _, ages in robot.run(10)]
    assert all(age["wheels"] == pytest.approx(0.0) for age in ages)
    assert ["imu" in age for age in ages] == [False] * (N_AGREED - 1) + [True] * (11 - N_AGREED)
    assert all(age["imu"] == pytest.approx(late_s) for age in ages[N_AGREED - 1 :])
    assert robot.clocks.counts == {"imu: off the clock": N_AGREED - 1, "imu: clock set": 1}


@ANY_STEP
def test_clocks_that_are_all_set_together_cost_two_readings_and_time_goes_on(step_s):
    robot = Robot()
    robot.step_s = dict.fromkeys(robot.step_s, step_s)
    after = robot.run(10)
    assert np.diff([now_s for now_s, _ in robot.begun + after]) == pytest.approx(np.full(19, PERIOD_S))
    assert [len(ages) for _, ages in after] == [0] * (N_AGREED - 1) + [2] * (11 - N_AGREED)
    assert after[-1][1] == pytest.approx(dict.fromkeys(STREAMS, 0.0))
    assert robot.clocks.counts["time: clock set"] == 1


@ANY_STEP
def test_the_clock_of_the_steps_alone_costs_no_reading(step_s):
    """The time goes on as it did: the streams' stamps still agree with it."""
    robot = Robot()
    robot.step_s["time"] = step_s
    after = robot.run(10)
    assert [len(ages) for _, ages in after] == [2] * 10
    expected_s = robot.true_s - PERIOD_S * np.arange(9, -1, -1)
    assert [now_s for now_s, _ in after] == pytest.approx(expected_s)
    assert robot.clocks.counts == {"time: clock set": 1}


def test_clocks_that_are_set_by_little_again_and_again_are_found_again():
    """Each time by less than a stream's own stamps tell: that the steps' clock was set says it."""
    robot = Robot()
    for k in range(4):
        robot.step_s = dict.fromkeys(robot.step_s, -0.15 * (k + 1))
        after = robot.run(10)
    assert [len(ages) for _, ages in after][N_AGREED:] == [2] * (10 - N_AGREED)
    assert robot.clocks.counts["wheels: too late"] == 0


@pytest.mark.parametrize("seed", range(5))
def test_time_never_goes_back_however_often_it_is_set(seed):
    robot, rng = Robot(1), np.random.default_rng(seed)
    last_s = robot.begun[0][0]
    for _ in range(60):
        steps_s = [0.0, HOUR_S, -HOUR_S, -0.01, 0.7, math.nan, math.inf, 1e300]
        robot.step_s["time"] = float(rng.choice(steps_s))
        now_s, _ = robot.step()
        assert last_s <= now_s < last_s + 1.0
        last_s = now_s


@pytest.mark.parametrize("ahead_s", [2.0 * AHEAD_S, 1.0, HOUR_S])
def test_single_stamps_of_the_future_are_left_out_and_counted(ahead_s):
    robot = Robot()
    for _ in range(4):
        robot.step_s["imu"] = ahead_s
        assert "imu" not in robot.step()[1]
        robot.step_s["imu"] = 0.0
        assert all(ages["imu"] == pytest.approx(0.0) for _, ages in robot.run(6))
    assert robot.clocks.counts == {"imu: off the clock": 4}


@pytest.mark.parametrize(("late_s", "taken"), [(0.9 * REWIND_S, True), (1.1 * REWIND_S, False), (2.0, False)])
def test_what_comes_later_and_later_without_a_jump_is_late_and_no_clock_that_was_set(late_s, taken):
    robot = Robot()
    for late in np.linspace(0.0, late_s, 150):
        robot.late_s["imu"] = float(late)
        robot.step()
    assert [("imu" in ages) for _, ages in robot.run(20)] == [taken] * 20
    counts = robot.clocks.counts
    assert counts.get("imu: too late", 0) >= (0 if taken else 20)
    assert set(counts) == (set() if taken else {"imu: too late"})


def test_stamps_that_are_no_numbers_cost_their_samples_only_and_what_is_no_reading_is_counted():
    for bad in (math.nan, math.inf, -math.inf):
        _, found = Clocks().step(1.0, {"imu": reading(0.98, bad, 0.99), "wheels": reading(bad)})
        assert found["imu"].time_s.tolist() == [0.98, 0.99]
        assert found["imu"].values[:, 0].tolist() == [0.0, 2.0]
        assert "wheels" not in found
    pairs = (np.zeros(2), np.zeros((3, 6))), (np.zeros((1, 1)), np.zeros((1, 6)))
    for given in (None, 3.0, "wheels", (), (1.0, 2.0), *pairs):
        clocks = Clocks()
        _, found = clocks.step(1.0, {"imu": given, "wheels": reading(0.99)})
        assert list(found) == ["wheels"]
        assert clocks.counts == {"imu: unreadable": 1}
        assert clocks.step(1.02, given)[1] == {}


@pytest.mark.parametrize("bad", [math.nan, math.inf, "now", None, 1e300, -1e13])
def test_a_time_that_is_none_passes_a_period(bad):
    robot = Robot()
    assert robot.clocks.step(bad, {})[0] == pytest.approx(robot.begun[-1][0] + PERIOD_S)
    robot.true_s += PERIOD_S
    now_s, ages = robot.step()
    assert now_s == pytest.approx(robot.true_s)
    assert len(ages) == 2
    assert robot.clocks.counts == {}


def test_a_stream_that_ended_before_the_clock_was_set_back_is_lost():
    inbox = Inbox({"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)})
    for stream in ("imu", "wheels"):
        inbox.put(stream, [0.0], [[0.1]])
    inbox.take(5000.0)
    for k in range(20):
        inbox.put("imu", [0.0], [[0.1]])
        inbox.take(1000.0 + 0.1 * k)
    assert inbox.health(1002.0) == {"imu": "fresh", "wheels": "lost"}
