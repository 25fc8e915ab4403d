"""Figures and bars of drives with a sensor fault, on made-up drives; and a pilot that fails keeps its command."""

import math

import numpy as np
import pytest

from terrain.control.fault_drives import (
    BARS,
    FAULT_SITUATIONS,
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
OK = np.ones(N, dtype=bool)


def between(start_s, end_s):
    begun, ended = (TIME_S - each + STEP_S / 2 > 0.0 for each in (start_s, end_s))
    return begun & ~ended


def during(value, start_s, end_s, usual=0.1):
    """Return rows (n,) of a usual value, with another one between two times."""
    return np.where(between(start_s, end_s), value, usual)


def ok_but(*intervals):
    return ~np.any([~OK, *(between(*interval) for interval in intervals)], axis=0)


LOST = ok_but((START_S, END_S))


def made(**changed):
    """A drive at 1 m/s with a slip of 0.1 that is estimated rightly, and the status OK."""
    rows = dict.fromkeys(("slip_ratio", "true_slip_ratio", "body_slip_ratio"), np.full(N, 0.1))
    rows |= dict.fromkeys(("commanded_mps", "desired_mps", "speed_mps"), np.ones(N))
    return FaultDrive(**({"time_s": TIME_S, "ok": OK, "moving": OK} | rows | changed))


def figures(drive, clean=None, plain=None, end_s=END_S, **counts):
    return fault_figures(drive, clean or made(), plain or made(), START_S, end_s, **counts)


def test_a_drive_like_the_clean_one_meets_all_bars_that_apply():
    for nature, ok, others in (
        (Nature.LYING, LOST, {"goes_on": None}),
        (Nature.TOLERABLE, OK, {"ok_ends": None}),
        (Nature.DEGRADED, OK, {"goes_on": None, "ok_ends": None}),
    ):
        assert judge(figures(made(ok=ok)), nature) == dict.fromkeys(BARS, True) | {"stop": None} | others
    assert judge(figures(made(), n_not_finite=1), Nature.DEAD)["finite"] is False


def body(slip_ratio, start_s, end_s):
    return {"body_slip_ratio": during(slip_ratio, start_s, end_s)}


STOP = np.where(TIME_S >= START_S, 0.0, 1.0)
BEYOND = np.full(N, math.nan)
CASES = [
    ("ok_ends", {"ok": LOST | between(2.0, 2.3)}, {}, {}, {"ok_total_s": 0.3}, True),
    ("ok_ends", {"ok": LOST | between(2.0, 2.32)}, {}, {}, {"ok_longest_s": 0.32}, False),
    ("ok_ends", {"ok": LOST | between(2.0, 2.2) | between(4.0, 4.2)}, {}, {}, {"ok_longest_s": 0.2}, False),
    ("ok_ends", {"moving": ~between(2.3, 9.0)}, {}, {}, {"ok_total_s": 0.3}, True),  # the robot stands
    ("goes_on", {"ok": ok_but((2.0, 2.3))}, {}, {}, {"not_ok_s": 0.3}, True),
    ("goes_on", {"ok": ok_but((2.0, 2.4))}, {}, {}, {"not_ok_s": 0.4}, False),
    ("goes_on", {"ok": ok_but((2.0, 2.4))}, {"ok": LOST}, {}, {"not_ok_s": 0.0}, True),
    ("slip_error", {"slip_ratio": during(0.15, 4, 4.1)}, {}, {}, {"slip_error_ratio": 0.05}, True),
    ("slip_error", {"slip_ratio": during(0.049, 4, 4.1)}, {}, {}, {"slip_error_ratio": 0.051}, False),
    ("slip_error", {"slip_ratio": during(0.9, 4, 4.1), "ok": LOST}, {}, {}, {"slip_error_ratio": 0.0}, True),
    ("slip_error", {"slip_ratio": during(0.9, 0, 2)}, {}, {}, {"slip_error_ratio": 0.0}, True),  # before
    ("slip_error", {"true_slip_ratio": BEYOND}, {}, {}, {"slip_error_ratio": math.nan}, None),
    ("slip_error", {"slip_ratio": during(0.22, 4, 4.1)}, {"slip_ratio": during(0.2, 3, 3.1)}, {}, {}, True),
    ("slip_peak", body(0.23, 6, 6.1), {}, body(-0.2, 3, 4), {}, True),
    ("slip_peak", body(-0.24, 6, 6.1), {}, body(0.2, 3, 4), {}, False),
    ("slip_peak", body(0.9, 1, 1.1), {}, {}, {"slip_peak_ratio": 0.1}, True),
    ("stop", {"stop_m": 1.1}, {}, {"stop_m": 1.0}, {"stop_ratio": 1.1}, True),
    ("stop", {"stop_m": 1.11}, {}, {"stop_m": 1.0}, {"stop_ratio": 1.11}, False),
    ("stop", {}, {}, {"stop_m": 1.0}, {"stop_ratio": math.inf}, False),
    ("recovery", {"ok": ok_but((2.0, 6.0))}, {}, {}, {"recovery_s": 1.0}, True),
    ("recovery", {"ok": ok_but((5.5, 5.6), (6.5, 6.6))}, {}, {}, {"recovery_s": 1.6}, False),
    ("recovery", {"ok": ok_but((2.0, 8.0))}, {}, {}, {"recovery_s": math.inf}, False),
    ("recovery", {"ok": LOST, "moving": ~between(4.0, 9.0)}, {}, {}, {"recovery_s": math.nan}, None),
    ("overspeed", {"desired_mps": STOP, "commanded_mps": STOP + 0.04}, {}, {}, {"overspeed_s": 0.0}, True),
    ("overspeed", {"desired_mps": STOP, "commanded_mps": during(0.2, 2, 3.02, STOP)}, {}, {}, {}, False),
]


@pytest.mark.parametrize(("bar", "drive", "clean", "plain", "expected", "met"), CASES)
def test_each_bar_is_met_up_to_its_limit_while_it_counts(bar, drive, clean, plain, expected, met):
    found = figures(made(**drive), made(**clean), made(**plain))
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, nan_ok=True)
    assert judge(found, Nature.TOLERABLE if bar == "goes_on" else Nature.LYING)[bar] is met


def test_a_fault_counts_until_its_end_or_for_good():
    assert figures(made(), end_s=2.2).ok_total_s == 0.2
    for_good = figures(made(), end_s=math.inf)
    assert (for_good.ok_total_s, math.isnan(for_good.recovery_s)) == (6.0, True)
    assert judge(for_good, Nature.DEAD)["ok_ends"] is False


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

    estimate, health = None, {"imu": "lost", "wheels": "fresh"}

    def __init__(self, fails=()):
        self.k, self.fails = -1, dict(fails)

    def step(self, sample):
        self.k += 1
        wrong = self.fails.get(self.k)
        if isinstance(wrong, str):
            raise ValueError(wrong)
        wheels = np.full(3, float(self.k)) if wrong is None else wrong
        return Command(wheels, np.zeros(3), np.zeros(3), {"status_code": 0.0, "slip_ratio": 0.1})


def driven(pilot, n=6):
    guarded = GuardedPilot(pilot)
    return guarded, [guarded.step(Sample(0.02 * k, np.zeros(3), {})) for k in range(n)]


def test_a_pilot_that_fails_keeps_its_last_command_is_counted_and_names_its_sensors():
    fails = {2: "no such row", 3: np.array([3.0, math.nan, 3.0]), 4: np.zeros(2), 5: ["fast"] * 3}
    guarded, commands = driven(FakePilot(fails))
    assert [command.wheel_radps[0] for command in commands] == [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert (guarded.n_exceptions, guarded.n_not_finite) == (1, 3)
    assert guarded.exception == "ValueError: no such row"
    codes = [command.status["status_code"] for command in commands]
    assert codes == [TractionStatus.OK] * 2 + [TractionStatus.NO_SLIP] * 4
    assert named_sensors(guarded.health, [True] * 6, 0.02) == {"imu": "lost"}
    assert named_sensors(guarded.health, [True] * 4 + [False] * 2, 0.02) == {}  # for 0.08 s
    assert named_sensors([None] * 6, [True] * 6, 0.02) is None
    with pytest.raises(ValueError, match="no such row"):
        driven(FakePilot({0: "no such row"}))
