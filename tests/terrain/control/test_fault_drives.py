"""Figures and bars of drives with a sensor fault, on made-up drives; and a pilot that fails keeps its command."""

import math

import numpy as np
import pytest

from terrain.control.fault_drives import (
    BARS,
    FAULT_SITUATIONS,
    LIMITS,
    FaultDrive,
    GuardedPilot,
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


def during(value, start_s, end_s, usual):
    """Return rows (n,) of a usual value, with another one between two times."""
    return np.where(between(start_s, end_s), value, usual)


OK = np.ones(N, dtype=bool)
LOST = ~between(START_S, END_S)


def made(**changed):
    """A drive at 1 m/s with a slip of 0.1 that is estimated rightly, and the status OK."""
    rows = dict.fromkeys(("slip_ratio", "true_slip_ratio", "body_slip_ratio"), np.full(N, 0.1))
    rows |= dict.fromkeys(("commanded_mps", "desired_mps", "speed_mps"), np.ones(N))
    return FaultDrive(**({"time_s": TIME_S, "ok": OK, "moving": OK} | rows | changed))


def figures(drive, clean=None, plain=None, end_s=END_S, **counts):
    return fault_figures(drive, clean or made(), plain or made(), START_S, end_s, **counts)


def bar(name, drive, nature=Nature.DEAD, **given):
    return judge(figures(drive, **given), nature)[name]


def test_a_drive_like_the_clean_one_meets_all_bars_that_apply():
    for nature, ok, others in (
        (Nature.LYING, LOST, {"goes_on": None}),
        (Nature.TOLERABLE, OK, {"ok_ends": None}),
        (Nature.DEGRADED, OK, {"goes_on": None, "ok_ends": None}),
    ):
        assert judge(figures(made(ok=ok)), nature) == dict.fromkeys(BARS, True) | {"stop": None} | others


@pytest.mark.parametrize("nature", [Nature.DEAD, Nature.LYING])
@pytest.mark.parametrize(
    ("intervals", "total_s", "longest_s", "met"),
    [
        ([(2.0, 2.3)], 0.3, 0.3, True),
        ([(2.0, 2.32)], 0.32, 0.32, False),
        ([(2.0, 2.2), (4.0, 4.2)], 0.4, 0.2, False),
    ],
)
def test_ok_is_counted_while_a_stream_is_dead_or_lying(intervals, total_s, longest_s, met, nature):
    ok = np.any([LOST, *(between(*interval) for interval in intervals)], axis=0)
    found = figures(made(ok=ok))
    assert (found.ok_total_s, found.ok_longest_s) == (total_s, longest_s)
    assert judge(found, nature)["ok_ends"] is met
    assert judge(found, nature, LIMITS._replace(ok_s=0.4))["ok_ends"] is True


def test_ok_does_not_count_while_the_robot_stands_nor_after_the_fault():
    assert figures(made(moving=~between(2.3, 9.0))).ok_total_s == 0.3
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
    clean = made(slip_ratio=during(0.1 + clean_error, 3.0, 3.1, 0.1))
    slip = during(0.1 + error, 4.0, 4.1, 0.1)
    found = figures(made(slip_ratio=slip), clean=clean)
    assert found.slip_error_ratio == pytest.approx(abs(error))
    assert found.clean_slip_error_ratio == pytest.approx(clean_error)
    assert judge(found, Nature.DEGRADED)["slip_error"] is met
    assert bar("slip_error", made(slip_ratio=slip, ok=LOST)) is True  # it is not used


def test_slip_that_is_unknown_or_before_the_fault_has_no_error():
    slip = during(0.9, 0.0, START_S, 0.1)
    assert figures(made(slip_ratio=slip)).slip_error_ratio == 0.0
    unknown = made(slip_ratio=slip + 0.5, true_slip_ratio=np.full(N, math.nan))
    assert math.isnan(figures(unknown).slip_error_ratio)
    assert bar("slip_error", unknown) is None


@pytest.mark.parametrize(("peak", "met"), [(0.23, True), (0.24, False), (-0.24, False)])
def test_the_peak_of_slip_is_compared_with_that_of_plain_commands(peak, met):
    plain = made(body_slip_ratio=during(-0.2, 3.0, 3.1, 0.1))
    drive = made(body_slip_ratio=during(peak, 6.0, 6.1, 0.1))
    assert bar("slip_peak", drive, plain=plain) is met
    assert figures(drive, plain=plain).slip_peak_ratio == pytest.approx(abs(peak))
    assert bar("slip_peak", made(body_slip_ratio=during(0.9, 1.0, 1.1, 0.1))) is True  # before the fault


@pytest.mark.parametrize(
    ("stop_m", "ratio", "met"), [(1.1, 1.1, True), (1.11, 1.11, False), (math.nan, math.inf, False)]
)
def test_the_stopping_distance_is_compared_with_that_of_plain_commands(stop_m, ratio, met):
    plain, drive = made(stop_m=1.0), made(stop_m=stop_m)
    assert figures(drive, plain=plain).stop_ratio == ratio
    assert bar("stop", drive, plain=plain) is met


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
    drive = made(ok=~np.any([~OK, *(between(*interval) for interval in not_ok)], axis=0))
    assert figures(drive).recovery_s == pytest.approx(recovery_s)
    assert bar("recovery", drive, Nature.DEGRADED) is met


def test_recovery_is_not_asked_for_good_nor_of_a_robot_that_stands():
    assert math.isnan(figures(made(ok=LOST), end_s=math.inf).recovery_s)
    assert bar("recovery", made(ok=LOST, moving=~between(4.0, 9.0))) is None
    assert bar("recovery", made(ok=~between(2.0, 9.0), moving=~between(5.5, 9.0))) is False


@pytest.mark.parametrize(("end_s", "longest_s", "met"), [(3.0, 1.0, True), (3.02, 1.02, False)])
def test_the_commanded_speed_is_above_the_desired_one_for_a_bounded_time(end_s, longest_s, met):
    stop = np.where(TIME_S >= START_S, 0.0, 1.0)
    drive = made(desired_mps=stop, commanded_mps=np.where(between(START_S, end_s), 0.2, stop))
    assert figures(drive).overspeed_s == longest_s
    assert bar("overspeed", drive) is met
    in_reach = made(desired_mps=stop, commanded_mps=stop + 0.04)  # of the torque's share among wheels
    assert figures(in_reach).overspeed_s == 0.0


@pytest.mark.parametrize("count", ["n_exceptions", "n_not_finite"])
def test_one_exception_or_command_that_is_not_finite_is_too_many(count):
    assert bar("finite", made(), **{count: 1}) is False


def test_situations_have_no_fault_by_chance_and_unknown_ones_are_refused():
    robot = load_robot("agrimaro")
    for name in FAULT_SITUATIONS:
        situation, start_s = make_fault_situation(name, robot, "grass", 3)
        assert not situation.faults.by_chance
        assert start_s + 3.0 < situation.scenario.time_s[-1]
    with pytest.raises(ConfigError, match="situation 'go' is unknown: use start, stop, steady"):
        make_fault_situation("go", robot, "grass", 3)


class FakePilot:
    """Commands the step's number, and fails as it is asked to."""

    estimate = None

    def __init__(self, fails=(), health=None):
        self.k, self.fails = -1, dict(fails)
        if health is not None:
            self.health = health

    def step(self, sample):
        self.k += 1
        wrong = self.fails.get(self.k)
        if isinstance(wrong, str):
            raise ValueError("no such row")
        wheels = np.full(3, float(self.k)) if wrong is None else wrong
        return Command(wheels, np.zeros(3), np.zeros(3), {"status_code": 0.0, "slip_ratio": 0.1})


def driven(pilot, n=6):
    guarded = GuardedPilot(pilot)
    return guarded, [guarded.step(Sample(0.02 * k, np.zeros(3), {})) for k in range(n)]


def test_a_pilot_that_fails_keeps_its_last_command_and_is_counted():
    fails = {2: "raise", 3: np.array([3.0, math.nan, 3.0]), 4: np.zeros(2), 5: ["fast"] * 3}
    guarded, commands = driven(FakePilot(fails))
    assert [command.wheel_radps[0] for command in commands] == [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert (guarded.n_exceptions, guarded.n_not_finite) == (1, 3)
    assert guarded.exception == "ValueError: no such row"
    codes = [command.status["status_code"] for command in commands]
    assert codes == [TractionStatus.OK] * 2 + [TractionStatus.NO_SLIP] * 4
    with pytest.raises(ValueError, match="no such row"):
        driven(FakePilot({0: "raise"}))


def test_the_sensors_that_a_pilot_names_are_recorded():
    guarded, _ = driven(FakePilot(health={"imu": "lost", "wheels": "fresh"}))
    assert named_sensors(guarded.health, [True] * 6, 0.02) == {"imu": "lost"}
    assert named_sensors(guarded.health, [True] * 4 + [False] * 2, 0.02) == {}  # for 0.08 s
    assert named_sensors(driven(FakePilot())[0].health, [True] * 6, 0.02) is None
