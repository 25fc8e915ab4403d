"""Blind trials: a few of them, how they are counted, and what the command refuses."""

import json
import math
import sys
from dataclasses import replace

import pytest
from scipy.stats import binomtest

from pipelines.cli import main as cli
from pipelines.explain.trials import (
    FOUND_TRIALS,
    OUTSIDE,
    REFUSED,
    ROWS,
    Trial,
    as_json,
    cases_of,
    explain_trials,
    found_from,
    rate_of,
    run_trial,
    table_of,
)
from terrain.effects import library_of
from terrain.errors import ConfigError, DataError

PLAIN = Trial(
    row="none",
    number=0,
    robot="husky",
    n_runs=8,
    hidden={},
    causes=(),
    outside="",
    over_limit=0.0,
    classes={},
    verdict="none",
    named=(),
    sets=(),
    unexplained=(),
    intervals={},
    gain_low=math.nan,
    seconds=0.3,
)


def trial(row, hidden="payload", over=3.0, **told):
    """Return a trial that names what is hidden, with its value in the middle of the interval."""
    causes = (hidden,) if hidden else ()
    right = {
        "hidden": {f"{name}_ratio": 0.2 for name in causes},
        "causes": causes,
        "over_limit": over,
        "verdict": "explained",
        "named": causes,
        "intervals": {f"{name}_ratio": (0.2, 0.1, 0.3) for name in causes},
        "gain_low": 0.1,
    }
    return replace(PLAIN, row=row, **{**right, **told})


@pytest.mark.parametrize(("k", "n"), [(0, 300), (1, 100), (3, 7), (97, 100), (20, 20)])
def test_a_rate_has_the_interval_of_clopper_and_pearson(k, n):
    found = rate_of([True] * k + [False] * (n - k))
    expected = binomtest(k, n).proportion_ci(0.95, "exact")
    assert found[:2] == (k, n)
    assert found[2:] == pytest.approx((k / n, expected.low, expected.high))


def test_a_rate_of_nothing_is_not_known():
    found = rate_of([])
    assert (found.hits, found.of, found.low, found.high) == (0, 0, 0.0, 1.0)
    assert math.isnan(found.rate)


def test_a_name_counts_as_found_alone_or_among_its_twins_only():
    hidden = trial("strong", "payload", classes={"payload": ("motor_constant", "payload")})
    assert hidden.found("payload")
    assert hidden.right
    beside = replace(hidden, named=("payload", "scrub"))
    assert beside.found("payload")
    assert (beside.right, beside.wrong) == (False, True)
    twins = replace(hidden, named=(), sets=(("motor_constant", "payload"),))
    assert (twins.found("payload"), twins.wrong) == (True, False)
    stranger = replace(hidden, named=(), sets=(("scrub", "payload"),))
    assert (stranger.found("payload"), stranger.wrong) == (False, False)
    other = replace(hidden, named=(), sets=(("scrub", "turning_slip"),))
    assert (other.found("payload"), other.wrong) == (False, True)
    silent = replace(hidden, named=(), verdict="none")
    assert (silent.found("payload"), silent.right, silent.wrong) == (False, False, False)


def test_the_table_counts_what_its_rows_say():
    alarm = trial("none", "", verdict="unexplained", gain_low=math.nan)
    outside_of = trial("strong", intervals={"payload_ratio": (0.4, 0.3, 0.5)})
    wrong = trial("strong", named=("scrub",), intervals={"scrub_ratio": (0.1, 0.0, 0.2)}, gain_low=-0.1)
    eccentric = trial("outside", "", outside=OUTSIDE[0], named=("wheel_radius",), intervals={})
    left = trial(
        "outside", "", outside=OUTSIDE[2], verdict="unexplained", unexplained=(("current_a", "time"),)
    )
    unsure = trial("poor", named=(), verdict="ambiguous", sets=(("payload", "motor_constant"),))
    both = trial("two", "payload", causes=("payload", "scrub"), named=("scrub", "payload"))
    table = table_of(
        [
            *[PLAIN] * 99,
            alarm,
            *[trial("strong")] * 96,
            outside_of,
            wrong,
            replace(trial("ladder"), over_limit=0.5),
            *[trial("ladder")] * 2,
            eccentric,
            left,
            unsure,
            both,
            replace(both, named=("payload",)),
        ]
    )

    def told(name):
        return table[name]["hits"], table[name]["of"], table[name]["met"]

    assert told("none: false alarms") == (1, 100, True)
    assert told("strong: named") == (97, 98, True)
    assert told("strong: wrongly named") == (1, 98, False)
    assert told("ladder: wrongly named") == (0, 3, True)
    # of effects over the limit that were named: 96 and 1 of the strong row, 2 of the ladder
    assert told("value inside its 95 % interval") == (98, 99, False)
    assert told("two: both, and only both") == (1, 2, False)
    assert told("outside: confidently misnamed") == (1, 2, False)
    assert told("outside: called unexplained") == (1, 2, False)
    assert told(f"outside, {OUTSIDE[0]}: misnamed")[:2] == (1, 1)
    assert told(f"outside, {OUTSIDE[2]}: unexplained")[:2] == (1, 1)
    assert f"outside, {OUTSIDE[1]}: misnamed" not in table
    assert told("poor: a wrong single name") == (0, 1, True)
    assert told("poor: ambiguous or not excited")[:2] == (1, 1)
    assert not table["held-out gain above zero with its interval"]["met"]
    assert table_of([]) == {}


def test_the_amplitude_from_which_nine_in_ten_are_found_lies_where_they_start_to_be():
    over = [0.5 + 0.05 * i for i in range(60)]
    trials = [
        trial("found", "payload", x, number=i, named=("payload",) if x > 1.3 else ())
        for i, x in enumerate(over)
    ]
    found = found_from(trials)
    assert set(found) == {"husky"}
    assert found["husky"]["payload"] == pytest.approx(1.3, rel=0.15)
    assert found_from(trials[: FOUND_TRIALS - 1]) == {}


def test_cases_take_the_robots_in_turn_and_row_found_every_effect():
    cases = cases_of("found", 50, 7, 8)
    assert [case.robot for case in cases[:4]] == ["agrimaro", "husky"] * 2
    for robot, drive in (("agrimaro", "swerve"), ("husky", "skid_steer")):
        library = library_of(drive)
        own = [case for case in cases if case.robot == robot]
        assert {case.number // 2 % len(library) for case in own} == set(range(len(library)))


def test_a_trial_depends_on_its_seed_and_number_alone():
    cases = cases_of("strong", 4, 3, 3)
    one, other = run_trial(cases[1]), run_trial(cases[1])
    assert replace(one, seconds=0.0) == replace(other, seconds=0.0)
    assert run_trial(cases[3]).hidden != one.hidden
    (told,) = json.loads(json.dumps(as_json([one]), allow_nan=False))
    assert told["hidden"] == one.hidden
    assert told["named"] == list(one.named)


def test_runs_that_the_diagnosis_refuses_count_as_a_false_alarm_and_stop_nothing(monkeypatch):
    def refuse(*_):
        raise DataError("runs: only 2 of 8 are fit to be compared")

    monkeypatch.setattr("pipelines.explain.trials.diagnose", refuse)
    found = run_trial(cases_of("none", 1, 0, 3)[0])
    assert (found.verdict, found.named, found.right) == (REFUSED, (), True)
    assert table_of([found])["none: false alarms"]["hits"] == 1


def test_a_few_blind_trials_come_out_right():
    """One on each robot of each kind that has to be right: more of them are for the command."""
    result = explain_trials(2, seed=1, rows=("none", "strong"), n_runs=4)
    table = result["table"]
    assert len(result["trials"]) == 4
    assert table["none: false alarms"]["hits"] == 0
    assert table["strong: named"]["hits"] == 2
    assert table["strong: wrongly named"]["hits"] == 0
    assert [case["row"] for case in result["trials"]] == ["none", "none", "strong", "strong"]
    assert 0 < result["seconds"]["median"] <= result["seconds"]["worst"]


@pytest.fixture
def terrain(monkeypatch, capsys, tmp_path):
    """Return a function that runs the command in this process: exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["terrain", "explain-trials", *words])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_the_command_prints_its_table_and_writes_every_trial(terrain, tmp_path):
    words = ("--n", "1", "--rows", "none,found", "--runs", "3", "--jobs", "1", "--seed", "2")
    code, out, err = terrain(*words, "--json", "trials.json")
    assert code == 0, err
    assert "none: false alarms" in out
    assert "row found: no effect had 5 trials" in out
    assert "2 trials of 3 runs, seed 2" in out
    told = json.loads((tmp_path / "trials.json").read_text())
    assert (told["n"], told["seed"], told["runs"], told["rows"]) == (1, 2, 3, ["none", "found"])
    assert [case["row"] for case in told["trials"]] == ["none", "found"]
    assert told["trials"][1]["hidden"]
    assert told["found_from"] == {}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--rows", "none,weak"), "--rows is 'none,weak'; some of none,strong,ladder,"),
        (("--rows", ","), "--rows is ''"),
        (("--rows", "none,none"), "each once"),
        (("--n", "0"), "--n is 0; 1 trial"),
        (("--runs", "2"), "--runs is 2; 3 at the least"),
    ],
)
def test_a_users_mistake_is_one_sentence_and_nothing_is_written(terrain, tmp_path, words, message):
    code, out, err = terrain(*words, "--json", "trials.json")
    assert (code, out) == (2, "")
    assert message in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_all_rows_are_run_unless_named():
    with pytest.raises(ConfigError, match=",".join(ROWS)):
        explain_trials(1, rows=("all",))
