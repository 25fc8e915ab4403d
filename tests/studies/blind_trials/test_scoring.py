"""Scores of blind trials: rates with exact intervals, what counts as right in each row, and the table."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from scipy.stats import binomtest

from studies.blind_trials.scoring import FOUND_TRIALS, found_from, is_right, score, table_of, wrong_names
from studies.blind_trials.trial import (
    CLOCK_STATED_S,
    OUTSIDE,
    TRACK,
    TRACK_RATIO,
    Row,
    Statement,
    Trial,
    Varying,
    cases_of,
    run_trial,
)
from terrain.discrepancy.health.fault import Column, FaultKind
from terrain.discrepancy.verdict import Clock, RunGroup, Tier, Value

RIGHT = Trial(
    row=Row.SHORT,
    number=0,
    robot="husky",
    n_runs=80,
    hidden={"payload_ratio": 0.2},
    causes=("payload",),
    outside="",
    over_limit=5.0,
    classes={"payload": ("motor_constant", "payload")},
    seconds=0.3,
    verdict=Tier.NAMED,
    named=("payload",),
    intervals={"payload_ratio": (0.2, 0.1, 0.3)},
    gain_low=0.1,
)
OFF = {"payload_ratio": (0.4, 0.3, 0.5)}
SILENT = replace(RIGHT, named=(), verdict=None, intervals={}, gain_low=math.nan)
QUIET = replace(SILENT, row=Row.NONE, hidden={}, causes=(), over_limit=0.0)
WRONG = replace(RIGHT, named=("scrub",), intervals={"scrub_ratio": (0.1, 0.0, 0.2)}, gain_low=-0.1)
BESIDE = replace(RIGHT, named=("payload", "scrub"))
TWINS = replace(SILENT, verdict=Tier.SET, sets=(("payload", "motor_constant"),))
REFUSED = replace(SILENT, refusal="runs: only 2 of 8 are fit")


@pytest.mark.parametrize(("k", "n"), [(0, 300), (1, 100), (3, 7), (97, 100), (20, 20)])
def test_a_rate_has_the_interval_of_clopper_and_pearson(k, n):
    one = score([True] * k + [False] * (n - k))
    expected = binomtest(k, n).proportion_ci(0.95, "exact")
    assert one[:2] == (k, n)
    assert one[2:5] == pytest.approx((k / n, expected.low, expected.high))
    assert math.isnan(score([]).rate)


@pytest.mark.parametrize(
    ("trial", "answer"),
    [
        (RIGHT, (True, True, False)),
        (BESIDE, (True, False, True)),
        (TWINS, (True, True, False)),
        (replace(TWINS, sets=(("scrub", "payload"),)), (False, False, False)),
        (replace(TWINS, sets=(("scrub", "turning_slip"),)), (False, False, True)),
        (SILENT, (False, False, False)),
        (REFUSED, (False, False, False)),
    ],
)
def test_a_cause_counts_as_found_alone_or_within_its_confusable_class(trial, answer):
    assert (trial.found("payload"), trial.right, trial.wrong) == answer


DYNAMIC = replace(QUIET, row=Row.DYNAMIC)
LATE = replace(RIGHT, row=Row.LATE, causes=("clock_offset", "payload"), late_s=-0.25)
STATED = replace(LATE, clock_s=-0.25 + 0.9 * CLOCK_STATED_S)
SCATTERED = replace(RIGHT, row=Row.SCATTERED, accepted=(TRACK,))
STALLED = replace(RIGHT, row=Row.STALLED, stalled=("run_02", "run_05"), excluded=("run_02", "run_05"))
HALF = replace(RIGHT, row=Row.HALF, present=("a", "b"))
GROUPS = ((0.2, ("b", "a")), (0.0, ("c", "d")))
VARIES = replace(HALF, named=(), varying=(Varying("payload", GROUPS),))
RIVAL = replace(HALF, named=(), varying=(Varying("scrub", GROUPS, ("payload",)),))
FAULT = replace(QUIET, row=Row.FAULT, fault="gyro_deg", variant="gyro_deg")
DEG = replace(FAULT, statements=(Statement("unit", "gyro", "the gyro is in deg/s"),))


@pytest.mark.parametrize(
    ("trial", "right", "wrong"),
    [
        # a late logger is found by its name or by the delay that is stated
        (LATE, False, False),
        (STATED, True, False),
        (replace(LATE, clock_s=-0.25 + 1.1 * CLOCK_STATED_S), False, False),
        (replace(LATE, clock_s=0.25), False, False),
        (replace(LATE, named=("clock_offset", "payload")), True, False),
        (replace(STATED, named=()), False, False),
        # the track that scatters too is no wrong name
        (replace(SCATTERED, varying=(Varying(TRACK, ()),)), True, False),
        (replace(SCATTERED, named=("payload", TRACK)), True, False),
        (replace(SCATTERED, varying=(Varying("scrub", ()),)), False, True),
        (replace(SCATTERED, accepted=(), varying=(Varying(TRACK, ()),)), False, True),
        # stalled runs have to be excluded
        (STALLED, True, False),
        (replace(STALLED, excluded=("run_02", "run_05", "run_07")), True, False),
        (replace(STALLED, excluded=("run_02",)), False, False),
        # an effect of half of the runs has to be named as one that varies
        (HALF, False, False),
        (VARIES, True, False),
        (RIVAL, False, False),
        (replace(RIVAL, classes={"payload": ("scrub",)}), True, False),
        (replace(VARIES, varying=(Varying("scrub", GROUPS),)), False, True),
        # a fault has to be stated in words
        (FAULT, False, False),
        (DEG, True, False),
        (replace(FAULT, statements=(Statement("sign", "gyro", "its sign is turned"),)), False, False),
        (replace(FAULT, named=(TRACK,)), False, True),
        # the dynamic simulation with nothing hidden asks for silence
        (DYNAMIC, True, False),
        (replace(DYNAMIC, verdict=Tier.NOT_SHOWN), True, False),
        (replace(DYNAMIC, verdict=Tier.CANDIDATE), True, False),
        (replace(DYNAMIC, verdict=Tier.UNEXPLAINED, unexplained=(("current_a", "time"),)), False, False),
        (replace(DYNAMIC, statements=(Statement("stuck", "gyro", "it is frozen"),)), False, False),
        (replace(DYNAMIC, varying=(Varying("payload", ()),)), False, True),
        (replace(DYNAMIC, refusal="too few"), False, False),
    ],
)
def test_each_row_has_a_right_answer_of_its_own(trial, right, wrong):
    assert (is_right(trial), bool(wrong_names(trial))) == (right, wrong)


def of(row, trial=RIGHT, **changed):
    return replace(trial, row=row, **changed)


KNOWN = of(
    Row.KNOWN,
    variant="late",
    hidden={TRACK_RATIO: 1.5},
    causes=(TRACK,),
    accepted=("clock_offset",),
    classes={},
    named=(TRACK, "clock_offset"),
    intervals={TRACK_RATIO: (1.6, 1.5, 1.7)},
)
BOTH = of(Row.TWO, causes=("payload", "scrub"), named=("scrub", "payload"))
TRIALS = [
    *[replace(t, row=Row.SHORT) for t in (RIGHT, TWINS, SILENT, WRONG, BESIDE, REFUSED)],
    *([of(Row.GROSS)] * 85 + [of(Row.GROSS, SILENT)] * 13 + [of(Row.GROSS, WRONG)] * 2),
    *(LATE, STATED, replace(STATED, named=())),
    *(SCATTERED, replace(SCATTERED, intervals=OFF)),
    *(STALLED, replace(STALLED, excluded=("run_02", "run_07"))),
    *(VARIES, replace(VARIES, present=("a", "c")), HALF),
    *(DEG, FAULT, replace(FAULT, named=(TRACK,))),
    *([DYNAMIC] * 57 + [replace(DYNAMIC, refusal="too few")] * 3),
    *[of(Row.DYNAMIC, t) for t in (RIGHT, replace(RIGHT, intervals=OFF), TWINS, SILENT)],
    *(
        KNOWN,
        replace(KNOWN, intervals={TRACK_RATIO: (1.7, 1.4, 2.0)}),
        replace(KNOWN, named=(TRACK, "scrub")),
    ),
    *([QUIET] * 99 + [replace(QUIET, verdict=Tier.UNEXPLAINED, unexplained=(("current_a", "time"),))]),
    *([of(Row.STRONG)] * 96 + [of(Row.STRONG, intervals=OFF), of(Row.STRONG, WRONG)]),
    *([of(Row.LADDER, over_limit=0.5)] + [of(Row.LADDER)] * 2),
    of(Row.OUTSIDE, QUIET, outside=OUTSIDE[0], named=("wheel_radius",)),
    of(Row.OUTSIDE, QUIET, outside=OUTSIDE[2], unexplained=(("current_a", "time"),)),
    of(Row.POOR, TWINS),
    *(BOTH, replace(BOTH, named=("payload",))),
]
COUNTS = {
    "short: right or its twin set": (2, 6, False),
    "short: a wrong single name": (2, 6, False),
    "gross: right or its twin set": (85, 100, True),
    "gross: a wrong single name": (2, 100, True),
    "late: delay found": (2, 3, True),
    "late: effect beside it found": (2, 3, True),
    "scattered: mean value inside its 95 % interval": (1, 2, True),
    "stalled: all stalled runs excluded": (1, 2, True),
    "stalled: another run excluded": (1, 2, True),
    "half: groups of runs are right": (1, 2, True),
    "fault: stated in words": (1, 3, False),
    "fault: a wrong single name": (1, 3, False),
    "fault, gyro_deg: stated": (1, 3, True),
    "dynamic, nothing hidden: something stated": (3, 60, True),
    "dynamic, wheel radius: named or in its set": (3, 4, False),
    "dynamic, wheel radius: true value inside": (1, 3, False),
    "known, late: named, value within 5 %": (2, 3, False),
    "known, late: a wrong single name": (1, 3, False),
    "known, plain: a wrong single name": None,
    "none: false alarms": (1, 100, True),
    "strong: named": (97, 98, True),
    "strong: wrongly named": (1, 98, False),
    "ladder: wrongly named": (0, 3, True),
    # of effects over the limit that were named: 96 and 1 of the strong row, 2 of the ladder
    "value inside its 95 % interval": (98, 99, False),
    "two: both, and only both": (1, 2, False),
    "outside: confidently misnamed": (1, 2, False),
    "outside: called unexplained": (1, 2, False),
    f"outside, {OUTSIDE[0]}: misnamed": (1, 1, True),
    f"outside, {OUTSIDE[1]}: misnamed": None,
    f"outside, {OUTSIDE[2]}: unexplained": (1, 1, True),
    "poor: a wrong single name": (0, 1, True),
    "poor: a set, a candidate or not shown": (1, 1, True),
}


def test_the_table_counts_outcomes_by_row():
    counted = {name: (one.hits, one.of, one.met) for name, one in table_of(TRIALS).items()}
    assert {name: counted.get(name) for name in COUNTS} == COUNTS


def test_the_amplitude_from_which_nine_in_ten_are_found_is_recovered():
    over = [0.5 + 0.05 * i for i in range(60)]
    trials = [of(Row.FOUND, over_limit=x, named=("payload",) if x > 1.3 else ()) for x in over]
    assert found_from(trials) == {"husky": {"payload": pytest.approx(1.3, rel=0.15)}}
    assert found_from(trials[: FOUND_TRIALS - 1]) == {}


def test_a_trial_takes_what_the_diagnosis_answers(monkeypatch):
    """Faults and effects that vary are read where a diagnosis has them."""
    value = Value("motor_constant_ratio", 0.1, "ratio", 0.0, 0.2)
    groups = (RunGroup(0.1, 0.01, ("a",)), RunGroup(0.2, 0.01, ("c",)))
    deg = SimpleNamespace(kind=FaultKind.UNIT, column=Column.GYRO)
    answer = SimpleNamespace(
        causes=(),
        ambiguous_sets=(("payload", "motor_constant"),),
        ambiguous_values={"motor_constant": (value,)},
        verdict=Tier.SET,
        unexplained=(),
        clocks=(Clock("a", -0.2, 0.01), Clock("b", math.nan, math.nan), Clock("c", -0.3, 0.01)),
        excluded_runs=(SimpleNamespace(run_id="b"),),
        faults=(SimpleNamespace(change=deg, sentence="it is in deg/s"),),
        varying=(SimpleNamespace(name="payload", groups=groups, rivals=("motor_constant",)),),
        gain=SimpleNamespace(excluded_runs=(SimpleNamespace(run_id="d"),)),
    )
    diagnosed = SimpleNamespace(diagnosis=answer)
    monkeypatch.setattr("studies.blind_trials.trial.diagnose_runs", lambda *_: diagnosed)
    trial = run_trial(cases_of(Row.FAULT, 1, 0, 3)[0])
    assert (trial.clock_s, trial.excluded) == (pytest.approx(-0.25), ("b", "d"))
    assert trial.statements == (("unit", "gyro", "it is in deg/s"),)
    assert trial.varying == (Varying("payload", ((0.1, ("a",)), (0.2, ("c",))), ("motor_constant",)),)
    assert trial.intervals == {"motor_constant_ratio": (0.1, 0.0, 0.2)}
