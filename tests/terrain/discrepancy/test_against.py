"""What changed between two sets of runs: it is named with its size, and nothing is named where nothing changed."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.trial import simulation_of

from pipelines.explain.against import against_parts, against_text
from terrain.discrepancy.against import compare_sets, compare_with
from terrain.discrepancy.diagnosed_runs import diagnose_runs
from terrain.discrepancy.runs import low_pass_of, rows_of, signals_of
from terrain.effects import effect_named, vector_of
from terrain.errors import DataError
from terrain.robots import load_robot

pytestmark = pytest.mark.usefixtures("without_next_drive")
HUSKY = load_robot("husky")
LIBRARY = tuple(map(effect_named, ("wheel_radius", "effective_track", "payload", "gyro_scale", "camera_yaw")))


@pytest.fixture(scope="module")
def sets(hide):
    """Return a function that makes the signals of a first set and of a second one, of 5 runs each."""

    def make(first, second, seed=1, **about):
        pairs = []
        for k, hidden in enumerate((first, second)):
            runs = hide(hidden, n=5, duration_s=20.0, seed=seed + 40 * k)
            pairs.append(tuple([replace(signals_of(run, HUSKY), **about) for run in runs]))
        return pairs

    return make


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wheel_radius_ratio", -0.05),
        ("payload_ratio", 0.3),
        ("effective_track_ratio", 0.6),
        ("gyro_scale_ratio", 0.03),
    ],
)
def test_what_changed_is_named_with_its_size_beside_what_both_have(sets, name, value):
    both = {"camera_yaw_rad": 0.03}
    first, second = sets(both, {**both, name: value})
    simulation = simulation_of(HUSKY)
    against = compare_sets(first, second, simulation, ("camera_yaw_rad",), LIBRARY)
    (each,) = against.differences
    (own,), (before,) = each.parameters, each.first
    assert (own.name, each.rivals, against.unnamed) == (name, (), ())
    assert own.value == pytest.approx(value, rel=0.2)
    assert own.low - 0.05 * abs(value) < value < own.high + 0.05 * abs(value)
    assert abs(before.value) < 0.15 * abs(value)


def test_sets_that_are_alike_differ_in_nothing_though_the_simulation_is_wrong_in_both(sets):
    for seed in (1, 2, 3):
        first, second = sets({"gyro_scale_ratio": 0.06}, {"gyro_scale_ratio": 0.06}, seed=seed)
        against = compare_sets(first, second, simulation_of(HUSKY), (), LIBRARY)
        assert (against.differences, against.unnamed) == ((), ())
        assert np.isnan(against.reduction)
        assert "nothing changed" in against_text(against, "b")


def test_a_difference_that_held_out_runs_do_not_have_is_a_candidate(sets):
    first, second = sets({}, {"wheel_radius_ratio": -0.05})
    for changed in (0.0, -0.05):
        held_out = sets({}, {"wheel_radius_ratio": changed}, seed=7)
        against = compare_sets(first, second, simulation_of(HUSKY), (), LIBRARY, held_out)
        named, not_earned = ([each.name for each in of] for of in (against.differences, against.candidates))
        assert (named, not_earned) == ((["wheel_radius"], []) if changed else ([], ["wheel_radius"]))
        assert ("not stated: wheel radius" in against_text(against, "b")) == (not changed)
        assert (against.reduction > 0.0) == bool(changed)


def test_two_changes_are_named_where_runs_that_are_held_out_have_both(sets):
    change = {"wheel_radius_ratio": -0.05, "gyro_scale_ratio": 0.04}
    first, second = sets({}, change)
    against = compare_sets(first, second, simulation_of(HUSKY), (), LIBRARY, sets({}, change, seed=7))
    sizes = {each.name: each.parameters[0].value for each in against.differences}
    assert sizes == pytest.approx({"wheel_radius": -0.05, "gyro_scale": 0.04}, rel=0.2)
    assert (against.candidates, against.ci[0] > 0.0) == ((), True)


def test_a_change_to_a_size_that_no_builder_would_believe_is_not_named(sets):
    first, second = sets({"wheel_radius_ratio": 0.08}, {"wheel_radius_ratio": -0.16})
    against = compare_sets(first, second, simulation_of(HUSKY), ("wheel_radius_ratio",), LIBRARY)
    assert "wheel_radius" not in [each.name for each in against.differences]


def test_a_difference_acts_in_the_second_set_alone_as_its_parameter_does(sets):
    (first, *_), (second, *_) = sets({}, {})
    low_pass, planar = low_pass_of([first, second]), simulation_of(HUSKY).planar_on("")
    plain, names = vector_of({"wheel_radius_ratio": 0.02}), ("wheel_radius_ratio", "wheel_radius_ratio+")
    both = np.concatenate([plain, vector_of({"wheel_radius_ratio": 0.05})])
    for run, radius, acts in ((first, 0.02, 0.0), (replace(second, is_second=True), 0.07, 1.0)):
        rows = rows_of(run, planar, both, names, low_pass)
        alone = rows_of(run, planar, vector_of({"wheel_radius_ratio": radius}), names[:1], low_pass)
        np.testing.assert_array_equal(rows.predicted, alone.predicted)
        np.testing.assert_array_equal(rows.sensitivity[0], alone.sensitivity[0])
        np.testing.assert_array_equal(rows.sensitivity[1], acts * alone.sensitivity[0])


def test_a_change_without_a_name_is_left_to_a_channel(sets):
    first, second = sets({}, {"gyro_scale_ratio": 0.08})
    against = compare_sets(first, second, simulation_of(HUSKY), (), [effect_named("payload")])
    assert against.differences == ()
    assert "yaw_rate_radps" in [left.channel for left in against.unnamed]
    assert "yaw rate" in against_text(against, "b")


def test_runs_are_held_out_for_the_gain_and_one_session_a_side_is_stated(hide):
    first, second = (
        [
            replace(run, run_id=f"{name}_{run.run_id}", session=name)
            for run in hide(hidden, n=8, duration_s=20.0, seed=s)
        ]
        for name, hidden, s in (("a", {}, 1), ("b", {"wheel_radius_ratio": -0.06}, 41))
    )
    diagnosed = diagnose_runs(first, HUSKY, LIBRARY, 2, 0)
    against = compare_with(diagnosed, HUSKY, second, LIBRARY)
    assert [each.name for each in against.differences] == ["wheel_radius"]
    assert (against.n_runs, against.n_held_out, against.n_sessions) == ((6, 6), 4, (1, 1))
    assert against.ci[0] > 0.0
    text = against_text(against, "b").replace("\N{NO-BREAK SPACE}", " ")
    assert "From these runs to b changed: wheel radius by" in text
    assert "On 4 held-out runs of both that removes" in text
    assert "Each set is of one session" in text
    (table,) = against_parts(against, "b", HUSKY)
    assert table.rows[0][0] == "wheel radius"
    with pytest.raises(DataError, match="second set has 2 runs"):
        compare_with(diagnosed, HUSKY, second[:2], LIBRARY)


def test_with_several_sessions_a_side_they_are_the_clusters(sets):
    first, second = sets({}, {"wheel_radius_ratio": -0.05})
    named = [
        [replace(run, session=f"{k}{i % 2}") for i, run in enumerate(runs)]
        for k, runs in enumerate((first, second))
    ]
    against = compare_sets(*named, simulation_of(HUSKY), (), LIBRARY)
    assert (against.clusters, against.n_sessions, against.is_one_session_each) == ("sessions", (2, 2), False)
