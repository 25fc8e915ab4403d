"""Laws of response: what was hidden comes back, what answers otherwise is found, and what says little is kept."""

import numpy as np
import pytest

from terrain.classify import answers
from terrain.classify.answers import (
    Observed,
    best_misfit,
    check_answers,
    learn_answers,
    over_manoeuvre,
)
from terrain.classify.limits import rarities
from terrain.errors import DataError

SLOPES = {"asphalt": 0.50, "gravel": 0.45, "sand": 0.40}
BETWEEN, WITHIN = 0.02, 0.03  #: Of the slope between sessions, and of a window's yaw rate in rad/s.


def drive(terrain, seed, n_sessions=6, n_runs=20, slope=None, turning=2.0):
    """Return what was observed in three windows a run, terrain, session and run, and ends in s."""
    rng, n = np.random.default_rng(seed), n_sessions * n_runs * 3
    session = np.repeat(np.arange(n_sessions), n_runs * 3)
    speed = np.repeat(rng.uniform(-turning, turning, n_sessions * n_runs), 3)
    of_session = (SLOPES[terrain] if slope is None else slope) + BETWEEN * rng.standard_normal(n_sessions)
    yaw = of_session[session] * speed + WITHIN * rng.standard_t(5, n)
    current = 3.0 + 2.0 * np.abs(speed) + rng.normal(0.0, 0.5, n)
    driving = np.zeros((n, 2, 3))
    driving[:, 0], driving[:, 1, :2] = (
        np.stack([np.ones(n), speed, speed * np.abs(speed)], axis=1),
        np.stack([np.ones(n), np.abs(speed)], axis=1),
    )
    run = np.repeat(np.arange(n_sessions * n_runs), 3)
    groups = np.char.add(f"{terrain} {seed} ", np.stack([session, 1000 + run], axis=1).astype(str))
    observed = Observed(("turn", "current"), np.stack([yaw, current], axis=1), driving)
    return observed, np.full(n, terrain), groups, np.tile([2.0, 4.0, 6.0], n // 3)


def joined(parts):
    observed, *rest = zip(*parts, strict=True)
    both = (np.concatenate([getattr(each, name) for each in observed]) for name in ("response", "driving"))
    return Observed(observed[0].quantities, *both), *(np.concatenate(each) for each in rest)


@pytest.fixture(scope="module")
def laws():
    return learn_answers(*joined([drive(name, k) for k, name in enumerate(SLOPES)]), seed=1)


def unknown(laws, observed, end_s, groups):
    score = best_misfit(over_manoeuvre(laws.misfits(observed), end_s, groups[:, 1]))
    both = np.stack([np.full(len(score), np.nan), score], axis=1)
    return np.linalg.norm(rarities(laws.reference, both), axis=1) > laws.threshold


def test_the_law_and_its_scatter_between_and_within_sessions_come_back(laws):
    slope = laws.coefficients[0, :, 1] * laws.spread[0] / laws.scale[0, 1]
    # the mean of six sessions: 3 x 0.02 / sqrt(6)
    np.testing.assert_allclose(slope, list(SLOPES.values()), atol=3 * BETWEEN / np.sqrt(6))
    of_session = np.sqrt(laws.covariance[0, :, 1, 1]) * laws.spread[0] / laws.scale[0, 1]
    assert (of_session > 0.8 * BETWEEN).all()
    assert (of_session < 2.0 * BETWEEN).all()
    np.testing.assert_allclose(np.sqrt(laws.noise[0]) * laws.spread[0], WITHIN, rtol=0.3)


def test_a_ground_that_turns_otherwise_is_found_and_new_sessions_of_known_ones_are_kept(laws):
    ice, _, groups, end_s = drive("asphalt", 11, slope=0.2)
    found = unknown(laws, ice, end_s, groups)
    assert found.mean() > 0.65
    quick = np.abs(ice.driving[:, 0, 1]) > 1.0
    assert found[quick].mean() > 0.95
    assert (
        laws.reason(laws.misfits(ice)[np.flatnonzero(quick)[0]], "asphalt")
        == "asphalt does not turn like this"
    )
    known, _, groups, end_s = joined([drive(name, 20 + k, n_sessions=20) for k, name in enumerate(SLOPES)])
    assert unknown(laws, known, end_s, groups).mean() < 0.08
    # straight on, ice answers as all grounds do, and no driving raises false alarms
    straight, _, groups, end_s = drive("asphalt", 12, slope=0.2, turning=0.02)
    assert unknown(laws, straight, end_s, groups).mean() < 0.08
    # nor does driving that was never seen, as far as the ground goes: twice as fast
    faster, _, groups, end_s = drive("sand", 13, turning=4.0)
    assert unknown(laws, faster, end_s, groups).mean() < 0.3


def test_what_is_drawn_is_named_and_a_response_that_is_missing_is_left_out(laws):
    observed, _, groups, end_s = drive("gravel", 14)
    response = observed.response.copy()
    response[:, 1] += 10.0
    heavy = observed._replace(response=response)
    assert unknown(laws, heavy, end_s, groups).all()
    assert laws.reason(laws.misfits(heavy)[0], "gravel") == "gravel does not draw such currents"
    response = response.copy()
    response[:, 1] = np.nan
    assert unknown(laws, heavy._replace(response=response), end_s, groups).mean() < 0.15
    response[:] = np.nan
    nothing = heavy._replace(response=response)
    assert np.isnan(best_misfit(laws.misfits(nothing))).all()
    assert not unknown(laws, nothing, end_s, groups).any()
    with pytest.raises(DataError, match="do not show what the laws are of: turn, current"):
        laws.misfits(observed.only(("turn",)))
    with pytest.raises(DataError, match="do not show"):
        laws.misfits(None)


def test_a_quantity_that_is_hardly_known_has_no_law_and_few_rows_are_refused():
    observed, y, groups, end_s = joined([drive(name, k, n_sessions=2) for k, name in enumerate(SLOPES)])
    response = observed.response.copy()
    response[5:, 1] = np.nan
    rare = observed._replace(response=response)
    assert learn_answers(rare, y, groups, end_s).quantities == ("turn",)
    with pytest.raises(DataError, match="too few"):
        learn_answers(observed.of(np.array([0, -1])), y[[0, -1]], groups[[0, -1]], end_s[[0, -1]])
    with pytest.raises(DataError, match="of turn, current too few are known"):
        learn_answers(rare._replace(response=np.full_like(response, np.nan)), y, groups, end_s)


def test_a_quantity_of_one_run_has_no_law_and_leaves_the_others_theirs():
    observed, y, groups, end_s = joined([drive(name, 9, 1, 3) for name in SLOPES])
    observed.response[groups[:, 1] != groups[0, 1], 1] = np.nan
    assert learn_answers(observed, y, groups[:, 1], end_s).quantities == ("turn",)


def test_novelty_shares_the_threshold_and_each_alone_raises_the_alarm():
    data = joined([drive(name, k) for k, name in enumerate(SLOPES)])
    novelty = np.random.default_rng(3).standard_normal(len(data[1]))
    both = learn_answers(*data, novelty)
    for alarm in ([9.0, np.nan], [np.nan, 99.0]):
        assert np.linalg.norm(rarities(both.reference, np.array([alarm]))) > both.threshold
    assert np.linalg.norm(rarities(both.reference, np.zeros((1, 2)))) < both.threshold


def test_numbers_that_do_not_fit_are_refused(laws):
    observed = drive("sand", 1)[0]
    check_answers(laws, tuple(SLOPES), observed)
    for name in ("scale", "coefficients", "covariance", "noise", "limit", "reference"):
        wrong = np.array(getattr(laws, name))
        wrong[..., -1] = np.nan
        with pytest.raises(DataError, match=f"the {name} of the laws of response are not"):
            check_answers(laws._replace(**{name: wrong}), tuple(SLOPES), observed)
    with pytest.raises(DataError, match="not above zero"):
        check_answers(laws._replace(noise=0.0 * laws.noise), tuple(SLOPES), observed)
    for classes, shown in (
        (("ice",), observed),
        (tuple(SLOPES), None),
        (tuple(SLOPES), observed.only(("turn",))),
    ):
        with pytest.raises(DataError, match="other terrains, or of what"):
            check_answers(laws, classes, shown)


def test_the_threshold_is_over_sessions(monkeypatch):
    observed, y, groups, end_s = joined([drive(name, k) for k, name in enumerate(SLOPES)])
    units, threshold = [], answers.conformal_threshold
    monkeypatch.setattr(
        answers, "conformal_threshold", lambda s, unit, *a: units.append(unit) or threshold(s, unit, *a)
    )
    learn_answers(observed, y, groups, end_s)
    assert set(units[0]) == set(groups[:, 0])
