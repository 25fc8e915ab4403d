"""Scores of the rows that resemble measured runs, of trials made by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from studies.blind_trials.hidden import Row, Statement, cases_of
from studies.blind_trials.scoring import is_right, states_something, table_of, wrong_names
from studies.blind_trials.trial import CLOCK_STATED_S, Trial, Varying, run_trial
from terrain.discrepancy.health import Column, FaultKind
from terrain.discrepancy.health.runs import Clock
from terrain.discrepancy.verdict import RunGroup, Value, Verdict

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

SILENT = replace(RIGHT, named=(), verdict=Verdict.NONE, intervals={}, gain_low=math.nan)
WRONG = replace(RIGHT, named=("scrub",), intervals={"scrub_ratio": (0.1, 0.0, 0.2)})
BESIDE = replace(RIGHT, named=("payload", "scrub"))
TWINS = replace(SILENT, verdict=Verdict.AMBIGUOUS, sets=(("payload", "motor_constant"),))
REFUSED = replace(SILENT, verdict=Verdict.REFUSED, refusal="runs: only 2 of 8 are fit")


def counted(trials):
    return {name: (score.hits, score.of, score.met) for name, score in table_of(trials).items()}


@pytest.mark.parametrize("row", [Row.GROSS, Row.SHORT, Row.SENSOR_LATE])
def test_a_cause_is_right_alone_or_with_its_twins_and_wrong_beside_another(row):
    trials = [replace(t, row=row) for t in (RIGHT, TWINS, SILENT, WRONG, BESIDE, REFUSED)]
    assert [is_right(t) for t in trials] == [True, True, False, False, False, False]
    assert [bool(wrong_names(t)) for t in trials] == [False, False, False, True, True, False]
    table = counted(trials)
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


def test_the_stated_delay_counts_in_row_late_alone():
    strong = replace(RIGHT, row=Row.STRONG, causes=("clock_offset",), named=(), clock_s=0.0)
    assert not strong.found("clock_offset")


def test_the_track_that_scatters_too_is_no_wrong_name():
    scattered = replace(RIGHT, row=Row.SCATTERED, accepted=("effective_track",))
    track = (Varying("effective_track", ()),)
    assert is_right(replace(scattered, varying=track))
    assert is_right(replace(scattered, named=("payload", "effective_track")))
    assert not is_right(replace(scattered, varying=(Varying("scrub", ()),)))
    assert not is_right(replace(RIGHT, row=Row.SCATTERED, varying=track))
    off = replace(scattered, intervals={"payload_ratio": (0.4, 0.3, 0.5)})
    assert counted([scattered, off])["scattered: mean value inside its 95 % interval"][:2] == (1, 2)


def test_stalled_runs_have_to_be_excluded():
    stalled = replace(RIGHT, row=Row.STALLED, stalled=("run_02", "run_05"))
    out = replace(stalled, excluded=("run_02", "run_05"))
    more = replace(stalled, excluded=("run_02", "run_05", "run_07"))
    some = replace(stalled, excluded=("run_02",))
    assert [is_right(t) for t in (out, more, some, stalled)] == [True, True, False, False]
    table = counted([out, more, some, stalled])
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
    fault = replace(SILENT, row=Row.FAULT, hidden={}, causes=(), fault="gyro_deg", variant="gyro_deg")
    stated = replace(fault, statements=(Statement("unit", "gyro", "the gyro is in deg/s"),))
    other = replace(fault, statements=(Statement("sign", "gyro", "its sign is turned"),))
    named = replace(fault, named=("effective_track",))
    assert [is_right(t) for t in (stated, other, fault, named)] == [True, False, False, False]
    table = counted([stated, other, named])
    assert table["fault: stated in words"] == (1, 3, False)
    assert table["fault: a wrong single name"] == (1, 3, False)
    assert table["fault, gyro_deg: stated"][:2] == (1, 3)


def test_the_dynamic_simulation_with_nothing_hidden_asks_for_silence():
    quiet = replace(SILENT, row=Row.DYNAMIC, hidden={}, causes=())
    loud = [
        replace(quiet, verdict=Verdict.UNEXPLAINED),
        replace(quiet, statements=(Statement("stuck", "gyro", "it is frozen"),)),
        replace(quiet, varying=(Varying("payload", ()),)),
        replace(quiet, verdict=Verdict.REFUSED),
    ]
    assert is_right(quiet)
    assert is_right(replace(quiet, verdict=Verdict.NOT_EXCITED))
    assert all(states_something(t) and not is_right(t) for t in loud)
    hidden = replace(RIGHT, row=Row.DYNAMIC)
    off = replace(hidden, intervals={"payload_ratio": (0.4, 0.3, 0.5)})
    in_set = replace(hidden, named=(), sets=TWINS.sets)
    table = counted([*[quiet] * 57, *loud[:3], hidden, off, in_set, replace(SILENT, row=Row.DYNAMIC)])
    assert table["dynamic, nothing hidden: something stated"] == (3, 60, True)
    assert table["dynamic, wheel radius: named or in its set"] == (3, 4, False)
    assert table["dynamic, wheel radius: true value inside"][:2] == (2, 3)


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
    wrong = replace(known, named=("effective_track", "lever_arm"))
    table = counted([known, off, wrong])
    assert table["known, late: named, value within 5 %"] == (2, 3, False)
    assert table["known, late: a wrong single name"] == (1, 3, False)
    assert not any(name.startswith("known, plain") for name in table)


def test_a_trial_takes_what_the_diagnosis_answers(monkeypatch):
    """Faults and effects that vary are read where a diagnosis has them."""
    value = Value("motor_constant_ratio", 0.1, "ratio", 0.0, 0.2)
    answer = SimpleNamespace(
        causes=(),
        ambiguous_sets=(("payload", "motor_constant"),),
        ambiguous_values={"motor_constant": (value,)},
        verdict=Verdict.AMBIGUOUS,
        unexplained=(),
        clocks=(Clock("a", -0.2, 0.01), Clock("b", math.nan, math.nan), Clock("c", -0.3, 0.01)),
        excluded_runs=(SimpleNamespace(run_id="b"),),
        faults=(
            SimpleNamespace(kind=FaultKind.UNIT, column=Column.GYRO, sentence="it is in deg/s"),
            SimpleNamespace(kind=FaultKind.SIGN, column=Column.HEADING, sentence="it is turned"),
        ),
        varying=(
            SimpleNamespace(
                name="payload",
                groups=(RunGroup(0.1, 0.01, ("a",)), RunGroup(0.2, 0.01, ("c",))),
                rivals=("motor_constant",),
            ),
        ),
    )
    case = cases_of(Row.FAULT, 1, 0, 3)[0]
    monkeypatch.setattr("studies.blind_trials.trial.diagnose", lambda *_: answer)
    found = run_trial(case)
    assert found.clock_s == pytest.approx(-0.25)
    assert found.excluded == ("b",)
    assert found.statements == (
        ("unit", "gyro", "it is in deg/s"),
        ("sign", "heading rate", "it is turned"),
    )
    assert found.varying == (Varying("payload", ((0.1, ("a",)), (0.2, ("c",))), ("motor_constant",)),)
    assert found.intervals == {"motor_constant_ratio": (0.1, 0.0, 0.2)}
