"""Scores of blind trials: rates with exact intervals, what counts as right in each row, and the table."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from scipy.stats import binomtest

from studies.blind_trials.hidden import OUTSIDE, Row, Statement, cases_of
from studies.blind_trials.scoring import (
    FOUND_TRIALS,
    found_from,
    is_right,
    score,
    states_something,
    table_of,
    wrong_names,
)
from studies.blind_trials.trial import CLOCK_STATED_S, Trial, Varying, run_trial
from terrain.discrepancy.faults import Column, FaultKind
from terrain.discrepancy.verdict import Clock, RunGroup, Value, Verdict

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
    verdict=Verdict.EXPLAINED,
    named=("payload",),
    sets=(),
    unexplained=(),
    intervals={"payload_ratio": (0.2, 0.1, 0.3)},
    gain_low=0.1,
    seconds=0.3,
)
OFF = {"payload_ratio": (0.4, 0.3, 0.5)}
SILENT = replace(RIGHT, named=(), verdict=Verdict.NONE, intervals={}, gain_low=math.nan)
QUIET = replace(SILENT, row=Row.NONE, hidden={}, causes=(), over_limit=0.0)
WRONG = replace(RIGHT, named=("scrub",), intervals={"scrub_ratio": (0.1, 0.0, 0.2)}, gain_low=-0.1)
BESIDE = replace(RIGHT, named=("payload", "scrub"))
TWINS = replace(SILENT, verdict=Verdict.AMBIGUOUS, sets=(("payload", "motor_constant"),))
REFUSED = replace(SILENT, verdict=Verdict.REFUSED, refusal="runs: only 2 of 8 are fit")


def counted(trials):
    return {name: (one.hits, one.of, one.met) for name, one in table_of(trials).items()}


@pytest.mark.parametrize(("k", "n"), [(0, 300), (1, 100), (3, 7), (97, 100), (20, 20)])
def test_a_rate_has_the_interval_of_clopper_and_pearson(k, n):
    one = score([True] * k + [False] * (n - k))
    expected = binomtest(k, n).proportion_ci(0.95, "exact")
    assert one[:2] == (k, n)
    assert one[2:5] == pytest.approx((k / n, expected.low, expected.high))
    assert math.isnan(score([]).rate)


def test_a_cause_counts_as_found_alone_or_within_its_confusable_class():
    with_other = replace(TWINS, sets=(("scrub", "payload"),))
    other = replace(TWINS, sets=(("scrub", "turning_slip"),))
    for trial, found, right, wrong in (
        (RIGHT, True, True, False),
        (BESIDE, True, False, True),
        (TWINS, True, True, False),
        (with_other, False, False, False),
        (other, False, False, True),
        (SILENT, False, False, False),
        (REFUSED, False, False, False),
    ):
        assert (trial.found("payload"), trial.right, trial.wrong) == (found, right, wrong)
    for row in (Row.GROSS, Row.SHORT, Row.SENSOR_LATE):
        table = counted([replace(t, row=row) for t in (RIGHT, TWINS, SILENT, WRONG, BESIDE, REFUSED)])
        assert table[f"{row.value}: right or its twin set"] == (2, 6, False)
        assert table[f"{row.value}: a wrong single name"] == (2, 6, False)


def test_bars_are_met_at_their_rates():
    gross = replace(RIGHT, row=Row.GROSS)
    enough = [*[gross] * 85, *[replace(SILENT, row=Row.GROSS)] * 13, *[replace(WRONG, row=Row.GROSS)] * 2]
    assert counted(enough)["gross: right or its twin set"] == (85, 100, True)
    assert counted(enough)["gross: a wrong single name"] == (2, 100, True)
    assert not counted([*enough, replace(WRONG, row=Row.GROSS)])["gross: a wrong single name"][2]


def test_a_late_logger_is_found_by_its_name_or_by_the_delay_that_is_stated():
    late = replace(RIGHT, row=Row.LATE, causes=("clock_offset", "payload"), late_s=-0.25)
    stated = replace(late, clock_s=-0.25 + 0.9 * CLOCK_STATED_S)
    off = replace(late, clock_s=-0.25 + 1.1 * CLOCK_STATED_S)
    other_sign = replace(late, clock_s=0.25)
    named = replace(late, named=("clock_offset", "payload"))
    alone = replace(stated, named=())
    assert [is_right(t) for t in (late, stated, off, other_sign, named, alone)] == [
        *(False, True, False, False, True, False),
    ]
    table = counted([late, stated, alone])
    assert table["late: delay found"][:2] == (2, 3)
    assert table["late: effect beside it found"][:2] == (2, 3)
    strong = replace(RIGHT, row=Row.STRONG, causes=("clock_offset",), named=(), clock_s=0.0)
    assert not strong.found("clock_offset")


def test_the_track_that_scatters_too_is_no_wrong_name():
    scattered = replace(RIGHT, row=Row.SCATTERED, accepted=("effective_track",))
    track = (Varying("effective_track", ()),)
    assert is_right(replace(scattered, varying=track))
    assert is_right(replace(scattered, named=("payload", "effective_track")))
    assert not is_right(replace(scattered, varying=(Varying("scrub", ()),)))
    assert not is_right(replace(RIGHT, row=Row.SCATTERED, varying=track))
    table = counted([scattered, replace(scattered, intervals=OFF)])
    assert table["scattered: mean value inside its 95 % interval"][:2] == (1, 2)


def test_stalled_runs_have_to_be_excluded():
    stalled = replace(RIGHT, row=Row.STALLED, stalled=("run_02", "run_05"))
    excluded = ("run_02", "run_05"), ("run_02", "run_05", "run_07"), ("run_02",), ()
    trials = [replace(stalled, excluded=ids) for ids in excluded]
    assert [is_right(t) for t in trials] == [True, True, False, False]
    table = counted(trials)
    assert table["stalled: all stalled runs excluded"][:2] == (2, 4)
    assert table["stalled: another run excluded"][:2] == (1, 4)


def test_an_effect_of_half_of_the_runs_has_to_be_named_as_one_that_varies():
    half = replace(RIGHT, row=Row.HALF, present=("a", "b"))
    groups = ((0.2, ("b", "a")), (0.0, ("c", "d")))
    varies = replace(half, named=(), varying=(Varying("payload", groups),))
    mixed = replace(varies, varying=(Varying("payload", ((0.2, ("a", "c")), (0.0, ("b", "d")))),))
    other = replace(half, named=(), varying=(Varying("scrub", groups),))
    rival = replace(half, named=(), varying=(Varying("scrub", groups, ("payload",)),))
    twins = replace(rival, classes={"payload": ("scrub",)})
    assert [is_right(t) for t in (rival, twins)] == [False, True]
    assert not wrong_names(rival)
    assert [is_right(t) for t in (varies, mixed, half, other)] == [True, True, False, False]
    assert [bool(wrong_names(t)) for t in (varies, mixed, half, other)] == [False, False, False, True]
    assert counted([varies, mixed, half])["half: groups of runs are right"][:2] == (1, 2)


def test_a_fault_has_to_be_stated_in_words():
    fault = replace(QUIET, row=Row.FAULT, fault="gyro_deg", variant="gyro_deg")
    stated = replace(fault, statements=(Statement("unit", "gyro", "the gyro is in deg/s"),))
    other = replace(fault, statements=(Statement("sign", "gyro", "its sign is turned"),))
    named = replace(fault, named=("effective_track",))
    assert [is_right(t) for t in (stated, other, fault, named)] == [True, False, False, False]
    table = counted([stated, other, named])
    assert table["fault: stated in words"] == (1, 3, False)
    assert table["fault: a wrong single name"] == (1, 3, False)
    assert table["fault, gyro_deg: stated"][:2] == (1, 3)


def test_the_dynamic_simulation_with_nothing_hidden_asks_for_silence():
    quiet = replace(QUIET, row=Row.DYNAMIC)
    loud = [
        replace(quiet, verdict=Verdict.UNEXPLAINED),
        replace(quiet, statements=(Statement("stuck", "gyro", "it is frozen"),)),
        replace(quiet, varying=(Varying("payload", ()),)),
        replace(quiet, verdict=Verdict.REFUSED),
    ]
    assert is_right(quiet)
    assert is_right(replace(quiet, verdict=Verdict.NOT_EXCITED))
    assert all(states_something(t) and not is_right(t) for t in loud)
    hidden = [replace(t, row=Row.DYNAMIC) for t in (RIGHT, replace(RIGHT, intervals=OFF), TWINS, SILENT)]
    table = counted([*[quiet] * 57, *loud[:3], *hidden])
    assert table["dynamic, nothing hidden: something stated"] == (3, 60, True)
    assert table["dynamic, wheel radius: named or in its set"] == (3, 4, False)
    assert table["dynamic, wheel radius: true value inside"][:2] == (1, 3)


def test_the_known_track_has_to_be_named_with_its_value():
    known = replace(
        RIGHT,
        row=Row.KNOWN,
        variant="late",
        hidden={"effective_track_ratio": 1.5},
        causes=("effective_track",),
        accepted=("clock_offset",),
        classes={},
        named=("effective_track", "clock_offset"),
        intervals={"effective_track_ratio": (1.6, 1.5, 1.7)},
    )
    off = replace(known, intervals={"effective_track_ratio": (1.7, 1.4, 2.0)})
    table = counted([known, off, replace(known, named=("effective_track", "lever_arm"))])
    assert table["known, late: named, value within 5 %"] == (2, 3, False)
    assert table["known, late: a wrong single name"] == (1, 3, False)
    assert not any(name.startswith("known, plain") for name in table)


def test_the_table_counts_outcomes_by_row():
    def of(row, trial=RIGHT, **changed):
        return replace(trial, row=row, **changed)

    both = of(Row.TWO, causes=("payload", "scrub"), named=("scrub", "payload"))
    table = counted(
        [
            *[QUIET] * 99,
            replace(QUIET, verdict=Verdict.UNEXPLAINED),
            *[of(Row.STRONG)] * 96,
            of(Row.STRONG, intervals=OFF),
            of(Row.STRONG, WRONG),
            of(Row.LADDER, over_limit=0.5),
            *[of(Row.LADDER)] * 2,
            of(Row.OUTSIDE, QUIET, outside=OUTSIDE[0], named=("wheel_radius",)),
            of(Row.OUTSIDE, QUIET, outside=OUTSIDE[2], unexplained=(("current_a", "time"),)),
            of(Row.POOR, TWINS),
            both,
            replace(both, named=("payload",)),
        ]
    )
    assert table["none: false alarms"] == (1, 100, True)
    assert table["strong: named"] == (97, 98, True)
    assert table["strong: wrongly named"] == (1, 98, False)
    assert table["ladder: wrongly named"] == (0, 3, True)
    # of effects over the limit that were named: 96 and 1 of the strong row, 2 of the ladder
    assert table["value inside its 95 % interval"] == (98, 99, False)
    assert table["two: both, and only both"] == (1, 2, False)
    assert table["outside: confidently misnamed"] == (1, 2, False)
    assert table["outside: called unexplained"] == (1, 2, False)
    assert table[f"outside, {OUTSIDE[0]}: misnamed"][:2] == (1, 1)
    assert table[f"outside, {OUTSIDE[2]}: unexplained"][:2] == (1, 1)
    assert f"outside, {OUTSIDE[1]}: misnamed" not in table
    assert table["poor: a wrong single name"] == (0, 1, True)
    assert table["poor: ambiguous or not excited"][:2] == (1, 1)
    assert not table["held-out gain above zero with its interval"][2]
    assert table_of([]) == {}


def test_the_amplitude_from_which_nine_in_ten_are_found_is_recovered():
    over = [0.5 + 0.05 * i for i in range(60)]
    trials = [
        replace(RIGHT, row=Row.FOUND, over_limit=x, named=("payload",) if x > 1.3 else ()) for x in over
    ]
    found = found_from(trials)
    assert set(found) == {"husky"}
    assert found["husky"]["payload"] == pytest.approx(1.3, rel=0.15)
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
        verdict=Verdict.AMBIGUOUS,
        unexplained=(),
        clocks=(Clock("a", -0.2, 0.01), Clock("b", math.nan, math.nan), Clock("c", -0.3, 0.01)),
        excluded_runs=(SimpleNamespace(run_id="b"),),
        faults=(SimpleNamespace(change=deg, sentence="it is in deg/s"),),
        varying=(SimpleNamespace(name="payload", groups=groups, rivals=("motor_constant",)),),
    )
    monkeypatch.setattr("studies.blind_trials.trial.diagnose", lambda *_: answer)
    found = run_trial(cases_of(Row.FAULT, 1, 0, 3)[0])
    assert found.clock_s == pytest.approx(-0.25)
    assert found.excluded == ("b",)
    assert found.statements == (("unit", "gyro", "it is in deg/s"),)
    assert found.varying == (Varying("payload", ((0.1, ("a",)), (0.2, ("c",))), ("motor_constant",)),)
    assert found.intervals == {"motor_constant_ratio": (0.1, 0.0, 0.2)}
