"""Scores of blind trials: rates with exact intervals, the table, and how small an effect is found."""

import math
from dataclasses import replace

import pytest
from scipy.stats import binomtest

from studies.blind_trials.hidden import OUTSIDE, Row
from studies.blind_trials.scoring import FOUND_TRIALS, found_from, rate_of, table_of
from studies.blind_trials.trial import Trial
from terrain.discrepancy.verdict import Verdict

PLAIN = Trial(
    row=Row.NONE,
    number=0,
    robot="husky",
    n_runs=8,
    hidden={},
    causes=(),
    outside="",
    over_limit=0.0,
    classes={},
    verdict=Verdict.NONE,
    named=(),
    sets=(),
    unexplained=(),
    intervals={},
    gain_low=math.nan,
    seconds=0.3,
)


def trial(row, hidden="payload", over=3.0, **changed):
    """Return a trial that names what is hidden, with its value in the middle of the interval."""
    causes = (hidden,) if hidden else ()
    right = {
        "hidden": {f"{name}_ratio": 0.2 for name in causes},
        "causes": causes,
        "over_limit": over,
        "verdict": Verdict.EXPLAINED,
        "named": causes,
        "intervals": {f"{name}_ratio": (0.2, 0.1, 0.3) for name in causes},
        "gain_low": 0.1,
    }
    return replace(PLAIN, row=Row(row), **{**right, **changed})


@pytest.mark.parametrize(("k", "n"), [(0, 300), (1, 100), (3, 7), (97, 100), (20, 20)])
def test_a_rate_has_the_interval_of_clopper_and_pearson(k, n):
    found = rate_of([True] * k + [False] * (n - k))
    expected = binomtest(k, n).proportion_ci(0.95, "exact")
    assert found[:2] == (k, n)
    assert found[2:] == pytest.approx((k / n, expected.low, expected.high))


def test_a_rate_of_no_trials_is_nan():
    found = rate_of([])
    assert (found.hits, found.of, found.low, found.high) == (0, 0, 0.0, 1.0)
    assert math.isnan(found.rate)


def test_a_cause_counts_as_found_alone_or_within_its_confusable_class():
    hidden = trial("strong", "payload", classes={"payload": ("motor_constant", "payload")})
    assert hidden.found("payload")
    assert hidden.right
    beside = replace(hidden, named=("payload", "scrub"))
    assert beside.found("payload")
    assert (beside.right, beside.wrong) == (False, True)
    twins = replace(hidden, named=(), sets=(("motor_constant", "payload"),))
    assert (twins.found("payload"), twins.wrong) == (True, False)
    with_other = replace(hidden, named=(), sets=(("scrub", "payload"),))
    assert (with_other.found("payload"), with_other.wrong) == (False, False)
    other = replace(hidden, named=(), sets=(("scrub", "turning_slip"),))
    assert (other.found("payload"), other.wrong) == (False, True)
    silent = replace(hidden, named=(), verdict=Verdict.NONE)
    assert (silent.found("payload"), silent.right, silent.wrong) == (False, False, False)


def test_the_table_counts_outcomes_by_row():
    alarm = trial("none", "", verdict=Verdict.UNEXPLAINED, gain_low=math.nan)
    outside_of = trial("strong", intervals={"payload_ratio": (0.4, 0.3, 0.5)})
    wrong = trial("strong", named=("scrub",), intervals={"scrub_ratio": (0.1, 0.0, 0.2)}, gain_low=-0.1)
    eccentric = trial("outside", "", outside=OUTSIDE[0], named=("wheel_radius",), intervals={})
    left = trial(
        "outside", "", outside=OUTSIDE[2], verdict=Verdict.UNEXPLAINED, unexplained=(("current_a", "time"),)
    )
    ambiguous = trial("poor", named=(), verdict=Verdict.AMBIGUOUS, sets=(("payload", "motor_constant"),))
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
            ambiguous,
            both,
            replace(both, named=("payload",)),
        ]
    )

    def score(name):
        return table[name].hits, table[name].of, table[name].met

    assert score("none: false alarms") == (1, 100, True)
    assert score("strong: named") == (97, 98, True)
    assert score("strong: wrongly named") == (1, 98, False)
    assert score("ladder: wrongly named") == (0, 3, True)
    # of effects over the limit that were named: 96 and 1 of the strong row, 2 of the ladder
    assert score("value inside its 95 % interval") == (98, 99, False)
    assert score("two: both, and only both") == (1, 2, False)
    assert score("outside: confidently misnamed") == (1, 2, False)
    assert score("outside: called unexplained") == (1, 2, False)
    assert score(f"outside, {OUTSIDE[0]}: misnamed")[:2] == (1, 1)
    assert score(f"outside, {OUTSIDE[2]}: unexplained")[:2] == (1, 1)
    assert f"outside, {OUTSIDE[1]}: misnamed" not in table
    assert score("poor: a wrong single name") == (0, 1, True)
    assert score("poor: ambiguous or not excited")[:2] == (1, 1)
    assert not table["held-out gain above zero with its interval"].met
    assert table_of([]) == {}


def test_the_amplitude_from_which_nine_in_ten_are_found_is_recovered():
    over = [0.5 + 0.05 * i for i in range(60)]
    trials = [
        trial("found", "payload", x, number=i, named=("payload",) if x > 1.3 else ())
        for i, x in enumerate(over)
    ]
    found = found_from(trials)
    assert set(found) == {"husky"}
    assert found["husky"]["payload"] == pytest.approx(1.3, rel=0.15)
    assert found_from(trials[: FOUND_TRIALS - 1]) == {}
