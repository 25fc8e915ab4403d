import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.control.switching import (
    NOTHING,
    SWITCHING,
    UNKNOWN,
    Belief,
    approach,
    check_switching,
    hear,
)
from terrain.errors import ConfigError

NAN, INF = math.nan, math.inf
GRASS = Belief("grass", 0.9, "grass", 0.0, 100.0)


def told(words, belief=GRASS, start_s=102.0, step_s=2.0):
    """What is believed after each of the words (terrain, probability), one a step."""
    seen = []
    for k, (terrain, probability) in enumerate(words):
        belief = hear(belief, start_s + k * step_s, terrain, probability)
        seen.append(belief.terrain)
    return seen


def test_a_word_is_believed_when_it_was_repeated_for_the_dwell():
    assert told([("clay", 0.9)] * 3, NOTHING) == ["", "clay", "clay"]
    assert told([("clay", 0.9)] * 3) == ["grass", "clay", "clay"]
    assert told([("clay", 0.9)] * 9, step_s=0.25) == ["grass"] * 6 + ["clay"] * 3


@pytest.mark.parametrize("wrong", [("clay", 1.0), ("clay", 0.49), ("clay", NAN), (UNKNOWN, 1.0)])
def test_a_single_wrong_word_never_switches(wrong):
    words = [("grass", 0.9), wrong, ("grass", 0.9)] * 5
    assert set(told(words)) == {"grass"}


def test_words_that_differ_or_come_too_far_apart_are_no_row():
    assert set(told([("clay", 0.9), ("snow", 0.9)] * 5)) == {"grass"}
    assert set(told([("clay", 0.9)] * 5, step_s=SWITCHING.silent_s + 0.1)) == {"grass"}
    assert told([("clay", 0.9)] * 2, step_s=SWITCHING.silent_s)[-1] == "clay"


@pytest.mark.parametrize("doubt", [("clay", 0.49), ("grass", NAN), (UNKNOWN, 0.9), ("snow", -INF)])
def test_doubt_that_lasts_is_believed_whatever_class_goes_with_it(doubt):
    assert told([doubt, doubt]) == ["grass", UNKNOWN]
    assert told([doubt, ("clay", 0.1)]) == ["grass", UNKNOWN]
    later = hear(hear(GRASS, 102.0, *doubt), 104.0, *doubt)
    assert math.isnan(later.probability)


@pytest.mark.parametrize("time_s", [100.0, 99.0, -INF, INF, NAN])
def test_a_word_that_is_not_later_is_not_heard(time_s):
    assert hear(GRASS, time_s, "clay", 0.9) is GRASS


def test_the_probability_is_that_of_the_last_word_for_what_is_believed():
    belief = hear(GRASS, 102.0, "clay", 0.99)
    assert belief.probability == 0.9
    assert hear(belief, 104.0, "clay", 0.8).probability == 0.8


words = st.tuples(
    st.sampled_from(["grass", "clay", ""]), st.sampled_from([0.9, 0.3, NAN]), st.floats(0.1, 12)
)


@given(st.lists(words, max_size=20))
def test_whatever_is_believed_was_said_for_the_whole_dwell(said):
    belief, time_s, row = NOTHING, 0.0, []
    for terrain, probability, wait_s in said:
        time_s += wait_s
        meant = terrain if probability >= 0.5 else ""
        whole = row and row[-1][1] == meant and wait_s <= SWITCHING.silent_s
        row = [*row, (time_s, meant)] if whole else [(time_s, meant)]
        before, belief = belief, hear(belief, time_s, terrain, probability)
        if belief.terrain != before.terrain:
            assert belief.terrain == meant
            assert time_s - row[0][0] >= SWITCHING.dwell_s - 1e-6
        elif meant != before.terrain:
            assert time_s - row[0][0] < SWITCHING.dwell_s


finite = st.floats(-1.0, 1.0)


@given(now=finite, desired=finite, rate=st.floats(0.0, 1.0), dt_s=st.floats(-1.0, 1.0))
def test_a_target_moves_at_its_rate_and_never_past_its_end(now, desired, rate, dt_s):
    there = approach(now, desired, rate, dt_s)
    assert abs(there - now) <= rate * max(dt_s, 0.0) + 1e-12
    assert min(now, desired) - 1e-12 <= there <= max(now, desired) + 1e-12
    if there != pytest.approx(desired, abs=1e-12):
        assert abs(there - now) == pytest.approx(rate * max(dt_s, 0.0), abs=1e-12)
    assert approach(NAN, desired, rate, dt_s) == desired


@pytest.mark.parametrize(
    ("name", "value", "desired"),
    [
        ("probability_least", 1.01, "from 0 to 1"),
        ("probability_least", -0.1, "from 0 to 1"),
        ("probability_least", NAN, "from 0 to 1"),
        ("dwell_s", -1, "from zero up"),
        ("silent_s", INF, "from zero up"),
        ("rate_ratio", "fast", "from zero up"),
        ("rate_ratio", True, "from zero up"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_sentence(name, value, desired):
    with pytest.raises(ConfigError) as refused:
        check_switching(SWITCHING._replace(**{name: value}))
    assert str(refused.value) == f"switching: {name} is {value!r}, a number {desired} is required"
