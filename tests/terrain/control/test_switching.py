import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.control.switching import (
    DRIVING_MPS,
    NO_BELIEF,
    SWITCHING,
    UNKNOWN,
    KnownTerrain,
    OutputStatus,
    TerrainBelief,
    TerrainSource,
    approach,
    drive_on,
    output_status,
    update,
)
from terrain.records import Sample

NAN, INF = math.nan, math.inf
GRASS = TerrainBelief("grass", 0.9, "grass", 0.0, 100.0)


def accepted(outputs, belief=GRASS, start_s=102.0, step_s=2.0):
    """The accepted terrain after each of the outputs (terrain, probability), one a step."""
    seen = []
    for k, (terrain, probability) in enumerate(outputs):
        belief = update(belief, start_s + k * step_s, terrain, probability)
        seen.append(belief.terrain)
    return seen


def test_a_class_is_accepted_when_it_was_repeated_for_the_dwell():
    assert accepted([("clay", 0.9)] * 3, NO_BELIEF) == ["", "clay", "clay"]
    assert accepted([("clay", 0.9)] * 3) == ["grass", "clay", "clay"]
    assert accepted([("clay", 0.9)] * 9, step_s=0.25) == ["grass"] * 6 + ["clay"] * 3


@pytest.mark.parametrize("wrong", [("clay", 1.0), ("clay", 0.49), ("clay", NAN), (UNKNOWN, 1.0)])
def test_a_single_wrong_output_never_switches(wrong):
    outputs = [("grass", 0.9), wrong, ("grass", 0.9)] * 5
    assert set(accepted(outputs)) == {"grass"}


@pytest.mark.parametrize("uncertain", [("clay", 0.49), ("grass", NAN), (UNKNOWN, 0.9), ("snow", -INF)])
def test_low_probability_for_the_dwell_is_accepted_as_unknown(uncertain):
    assert accepted([uncertain, uncertain]) == ["grass", UNKNOWN]
    assert accepted([uncertain, ("clay", 0.1)]) == ["grass", UNKNOWN]
    later = update(update(GRASS, 102.0, *uncertain), 104.0, *uncertain)
    assert math.isnan(later.probability)


@pytest.mark.parametrize("time_s", [100.0, 99.0, -INF, INF, NAN])
def test_an_output_that_is_not_later_is_ignored(time_s):
    assert update(GRASS, time_s, "clay", 0.9) is GRASS


# A time of driving or standing, or an output (terrain, probability)
events = st.one_of(
    st.tuples(st.sampled_from([0.0, 0.02, 0.5, 1.0]), st.floats(0.01, 6.0)),
    st.tuples(st.sampled_from(["grass", "clay", ""]), st.sampled_from([0.9, 0.3, NAN])),
)


@given(st.lists(events, max_size=60))
def test_a_class_is_believed_for_a_bounded_time_of_driving_after_its_last_output(happened):
    belief, time_s, driven_s = NO_BELIEF, 0.0, {"grass": INF, "clay": INF}
    for first, second in happened:
        before = belief
        if isinstance(first, str):
            time_s += 0.01
            belief = update(belief, time_s, first, second)
            if output_status(first, second) is OutputStatus.ACCEPTED:
                driven_s[first] = 0.0
            assert belief.terrain in (before.terrain, first if second >= 0.5 else UNKNOWN)
        else:
            time_s += second
            belief = drive_on(belief, first, second)
            if first >= DRIVING_MPS:
                driven_s = {name: driven + second for name, driven in driven_s.items()}
            assert belief.terrain in (before.terrain, UNKNOWN)
            if before.terrain and not belief.terrain:
                assert driven_s[before.terrain] > SWITCHING.unconfirmed_max_s - 1e-6
        if belief.terrain:
            assert driven_s[belief.terrain] <= SWITCHING.unconfirmed_max_s + 1e-6
            assert math.isfinite(belief.probability)
        else:
            assert math.isnan(belief.probability)


finite = st.floats(-1.0, 1.0)


@given(now=finite, desired=finite, rate=st.floats(0.0, 1.0), dt_s=st.floats(-1.0, 1.0))
def test_a_target_moves_at_its_rate_and_never_past_its_end(now, desired, rate, dt_s):
    there = approach(now, desired, rate, dt_s)
    assert abs(there - now) <= rate * max(dt_s, 0.0) + 1e-12
    assert min(now, desired) - 1e-12 <= there <= max(now, desired) + 1e-12
    if there != pytest.approx(desired, abs=1e-12):
        assert abs(there - now) == pytest.approx(rate * max(dt_s, 0.0), abs=1e-12)
    assert approach(NAN, desired, rate, dt_s) == desired


def test_a_known_terrain_is_given_once_a_change_and_no_terrain_never():
    known = KnownTerrain(lambda terrain: {"clay": "grass"}.get(terrain, terrain))
    terrains = ["", "clay", "clay", "", "clay", "snow", "snow", ""]
    samples = [Sample(float(k), np.zeros(3), {}, terrain) for k, terrain in enumerate(terrains)]
    found = [tuple(one) for sample in samples for one in known.update(sample, [])]
    assert found == [(1.0, "grass", 1.0, ""), (5.0, "snow", 1.0, "")]
    assert not any(TerrainSource().update(sample, []) for sample in samples)
