"""Figures and bars of drives with a sensor fault, on made-up drives; and a pilot that fails keeps its command."""

import math
from enum import Enum

import numpy as np
import pytest

from terrain.control.fault_drives import (
    BARS,
    FAULT_SITUATIONS,
    LIMITS,
    FaultDrive,
    GuardedPilot,
    bar_texts,
    fault_figures,
    judge,
    make_fault_situation,
    named_sensors,
)
from terrain.control.traction import TractionStatus
from terrain.errors import ConfigError
from terrain.records import Command, Sample
from terrain.robots import load_robot
from terrain.simulation.faults import Nature

STEP_S, START_S, END_S, N = 0.02, 2.0, 5.0, 400
TIME_S = STEP_S * np.arange(N)


def between(start_s, end_s):
    begun, ended = (TIME_S - each + STEP_S / 2 > 0.0 for each in (start_s, end_s))
    return begun & ~ended


def made(**changed):
    """A drive at 1 m/s with a slip of 0.1 that is estimated rightly, and the status OK."""
    ones = np.ones(N)
    fields = {
        "time_s": TIME_S,
        "ok": ones > 0,
        "slip_ratio": 0.1 * ones,
        "true_slip_ratio": 0.1 * ones,
        "body_slip_ratio": 0.1 * ones,
        "moving": ones > 0,
        "commanded_mps": ones,
        "desired_mps": ones,
        "speed_mps": 0.9 * ones,
    }
    return FaultDrive(**(fields | changed))


def with_(values, at, value):
    return np.where(at, value, values)


OK = np.ones(N, dtype=bool)
LOST = with_(OK, between(START_S, END_S), False).astype(bool)
STOPPED = {"stop_s": START_S, "stop_m": 1.0}


def figures(drive, clean=None, plain=None, end_s=END_S, **counts):
    return fault_figures(drive, clean or made(), plain or made(), START_S, end_s, **counts)


def bar(name, drive, nature=Nature.DEAD, **given):
    return judge(figures(drive, **given), nature)[name]


def test_a_drive_like_the_clean_one_meets_all_bars_that_apply():
    found = judge(figures(made(ok=LOST)), Nature.LYING)
    assert found == dict.fromkeys(BARS, True) | {"goes_on": None, "stop": None}
    found = judge(figures(made()), Nature.TOLERABLE)
    assert found == dict.fromkeys(BARS, True) | {"ok_ends": None, "stop": None}
    assert judge(figures(made()), Nature.DEGRADED)["ok_ends"] is None
    assert judge(figures(made()), Nature.DEGRADED)["goes_on"] is None
    assert set(bar_texts()) == set(BARS)


@pytest.mark.parametrize("nature", [Nature.DEAD, Nature.LYING])
@pytest.mark.parametrize(
    ("intervals", "total_s", "longest_s", "met"),
    [
        ([(2.0, 2.3)], 0.3, 0.3, True),
        ([(2.0, 2.32)], 0.32, 0.32, False),
        ([(2.0, 2.2), (4.0, 4.2)], 0.4, 0.2, False),
        ([(2.0, 5.0)], 3.0, 3.0, False),
    ],
)
def test_ok_is_counted_while_a_stream_is_dead_or_lying(intervals, total_s, longest_s, met, nature):
    ok = LOST.copy()
    for interval in intervals:
        ok |= between(*interval)
    found = figures(made(ok=ok))
    assert (found.ok_total_s, found.ok_longest_s) == (total_s, longest_s)
    assert judge(found, nature)["ok_ends"] is met


def test_ok_does_not_count_while_the_robot_stands_nor_after_the_fault():
    standing = made(moving=~between(2.3, 9.0))
    assert figures(standing).ok_total_s == 0.3
    assert figures(made(), end_s=2.2).ok_total_s == 0.2
    assert figures(made(), end_s=math.inf).ok_total_s == 6.0


@pytest.mark.parametrize(("end_s", "clean_ok", "met"), [(2.3, OK, True), (2.4, OK, False), (2.4, LOST, True)])
def test_a_tolerable_fault_costs_no_more_time_without_ok_than_a_drive_without_it(end_s, clean_ok, met):
    drive = made(ok=~between(START_S, end_s))
    assert bar("goes_on", drive, Nature.TOLERABLE, clean=made(ok=clean_ok)) is met
    assert figures(drive).not_ok_s == pytest.approx(end_s - START_S)


@pytest.mark.parametrize(
    ("error", "clean_error", "met"),
    [(0.05, 0.0, True), (0.051, 0.0, False), (0.12, 0.1, True), (0.14, 0.1, False), (-0.051, 0.0, False)],
)
def test_the_error_of_slip_counts_while_the_status_is_ok(error, clean_error, met):
    clean = made(slip_ratio=with_(made().slip_ratio, between(3.0, 3.1), 0.1 + clean_error))
    slip = with_(made().slip_ratio, between(4.0, 4.1), 0.1 + error)
    found = figures(made(slip_ratio=slip), clean=clean)
    assert found.slip_error_ratio == pytest.approx(abs(error))
    assert found.clean_slip_error_ratio == pytest.approx(clean_error)
    assert judge(found, Nature.DEGRADED)["slip_error"] is met
    assert bar("slip_error", made(slip_ratio=slip, ok=LOST)) is True  # it is not used


def test_slip_that_is_unknown_or_before_the_fault_has_no_error():
    slip = with_(made().slip_ratio, between(0.0, START_S), 0.9)
    assert figures(made(slip_ratio=slip)).slip_error_ratio == 0.0
    slow = made(slip_ratio=slip + 0.5, true_slip_ratio=np.full(N, math.nan))
    assert math.isnan(figures(slow).slip_error_ratio)
    assert judge(figures(slow), Nature.DEAD)["slip_error"] is None


@pytest.mark.parametrize(("peak", "met"), [(0.23, True), (0.24, False), (-0.24, False)])
def test_the_peak_of_slip_is_compared_with_that_of_plain_commands(peak, met):
    plain = made(body_slip_ratio=with_(made().body_slip_ratio, between(3.0, 3.1), -0.2))
    drive = made(body_slip_ratio=with_(made().body_slip_ratio, between(6.0, 6.1), peak))
    assert bar("slip_peak", drive, plain=plain) is met
    assert figures(drive, plain=plain).slip_peak_ratio == pytest.approx(abs(peak))
    before = made(body_slip_ratio=with_(made().body_slip_ratio, between(1.0, 1.1), 0.9))
    assert bar("slip_peak", before) is True


@pytest.mark.parametrize(
    ("stop_m", "ratio", "met"), [(1.1, 1.1, True), (1.11, 1.11, False), (math.nan, math.inf, False)]
)
def test_the_stopping_distance_is_compared_with_that_of_plain_commands(stop_m, ratio, met):
    plain = made(**STOPPED)
    drive = made(**(STOPPED | {"stop_m": stop_m}))
    assert figures(drive, plain=plain).stop_ratio == ratio
    assert bar("stop", drive, plain=plain) is met
    assert bar("stop", made()) is None


@pytest.mark.parametrize(
    ("not_ok", "recovery_s", "met"),
    [
        ([], 0.0, True),
        ([(2.0, 6.0)], 1.0, True),
        ([(2.0, 6.02)], 1.02, False),
        ([(5.5, 5.6), (6.5, 6.6)], 1.6, False),
        ([(2.0, 8.0)], math.inf, False),
    ],
)
def test_recovery_lasts_until_the_status_is_ok_and_remains_so(not_ok, recovery_s, met):
    ok = OK.copy()
    for interval in not_ok:
        ok &= ~between(*interval)
    assert figures(made(ok=ok)).recovery_s == pytest.approx(recovery_s)
    assert bar("recovery", made(ok=ok), Nature.DEGRADED) is met


def test_recovery_is_not_asked_for_good_nor_of_a_robot_that_stands():
    assert math.isnan(figures(made(ok=LOST), end_s=math.inf).recovery_s)
    assert bar("recovery", made(ok=LOST, moving=~between(4.0, 9.0))) is None
    assert bar("recovery", made(ok=~between(2.0, 9.0), moving=~between(5.5, 9.0))) is False


@pytest.mark.parametrize(("end_s", "longest_s", "met"), [(3.0, 1.0, True), (3.02, 1.02, False)])
def test_the_commanded_speed_is_above_the_desired_one_for_a_bounded_time(end_s, longest_s, met):
    stop = with_(np.ones(N), TIME_S >= START_S, 0.0)
    commanded = with_(stop, between(START_S, end_s), 0.2)
    drive = made(desired_mps=stop, commanded_mps=commanded)
    assert figures(drive).overspeed_s == longest_s
    assert bar("overspeed", drive) is met
    in_reach = made(desired_mps=stop, commanded_mps=stop + 0.04)  # of the torque's share among wheels
    assert figures(in_reach).overspeed_s == 0.0


@pytest.mark.parametrize("count", ["n_exceptions", "n_not_finite"])
def test_one_exception_or_command_that_is_not_finite_is_too_many(count):
    assert bar("finite", made()) is True
    assert bar("finite", made(), **{count: 1}) is False


def test_limits_decide():
    drive = made(ok=LOST | between(2.0, 2.4))
    assert bar("ok_ends", drive) is False
    assert judge(figures(drive), Nature.DEAD, LIMITS._replace(ok_s=0.4))["ok_ends"] is True


def test_situations_have_no_fault_by_chance_and_unknown_ones_are_refused():
    robot = load_robot("agrimaro")
    for name in FAULT_SITUATIONS:
        made_ = make_fault_situation(name, robot, "grass", 3)
        assert not made_.situation.faults.by_chance
        assert made_.start_s + 3.0 < made_.situation.scenario.time_s[-1]
    with pytest.raises(ConfigError, match="situation 'go' is unknown: use start, stop, steady"):
        make_fault_situation("go", robot, "grass", 3)


class FakePilot:
    """Commands the step's number, and fails as it is asked to."""

    estimate = None

    def __init__(self, fails=(), health=None):
        self.k, self.fails, self.command = -1, dict(fails), None
        if health is not None:
            self.health = health

    def step(self, sample):
        self.k += 1
        wheels = np.full(3, float(self.k))
        wrong = self.fails.get(self.k)
        if wrong == "raise":
            raise ValueError("no such row")
        if wrong == "nan":
            wheels[1] = math.nan
        if wrong == "shape":
            wheels = np.zeros(2)
        if wrong == "text":
            wheels = ["fast"] * 3
        return Command(wheels, np.zeros(3), np.zeros(3), {"status_code": 0.0, "slip_ratio": 0.1})


def driven(pilot, n=6):
    guarded = GuardedPilot(pilot)
    return guarded, [guarded.step(Sample(0.02 * k, np.zeros(3), {})) for k in range(n)]


def test_a_pilot_that_fails_keeps_its_last_command_and_is_counted():
    guarded, commands = driven(FakePilot({2: "raise", 3: "nan", 4: "shape", 5: "text"}))
    assert [command.wheel_radps[0] for command in commands] == [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert (guarded.n_exceptions, guarded.n_not_finite) == (1, 3)
    assert guarded.exception == "ValueError: no such row"
    codes = [command.status["status_code"] for command in commands]
    assert codes == [TractionStatus.OK] * 2 + [TractionStatus.NO_SLIP] * 4
    assert driven(FakePilot())[0].exception == ""
    with pytest.raises(ValueError, match="no such row"):
        driven(FakePilot({0: "raise"}))


class Health(Enum):
    FRESH = 0
    LOST = 1


@pytest.mark.parametrize("health", [{"imu": "lost"}, lambda: {"imu": Health.LOST, "wheels": Health.FRESH}])
def test_the_sensors_that_a_pilot_names_are_recorded(health):
    guarded, _ = driven(FakePilot(health=health))
    assert named_sensors(guarded.health, [True] * 6, 0.02) == {"imu": "lost"}
    assert named_sensors(guarded.health, [True] * 4 + [False] * 2, 0.02) == {}  # for 0.08 s
    assert named_sensors(driven(FakePilot())[0].health, [True] * 6, 0.02) is None
