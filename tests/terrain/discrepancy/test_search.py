"""The search on runs in which it is known what is there."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from terrain.discrepancy import search as search_module
from terrain.discrepancy.evidence import Evidence, WaldTest
from terrain.discrepancy.search import (
    RISE,
    RIVAL_LOSS,
    RIVAL_RISE,
    cause_fit,
    names_of,
    pooled,
    relinearize,
    rivals_of,
    search,
    steps_of,
)
from terrain.effects import BOUNDS, INDEX, LIBRARY, effect_named, vector_of

HIDDEN = {"camera_latency_s": 0.15, "payload_ratio": 0.25, "camera_yaw_rad": 0.03}
TRACK = "effective_track_ratio"


def names(causes):
    return {cause.name for cause in causes}


def stds_off(fit, hidden, inflation=1.0):
    """Return by how many standard deviations values (k,) are off."""
    return np.abs(fit.change - [hidden[name] for name in fit.names]) / np.sqrt(np.diag(fit.cov) * inflation)


@pytest.fixture(scope="module")
def posed(hide, pose):
    def make(hidden, library=None, duration_s=25.0):
        return pose(hide(hidden, duration_s=duration_s, seed=5), library)

    return make


@pytest.fixture(scope="module")
def three(posed, solve):
    problem = posed(HIDDEN)
    return problem, solve(problem)


def test_three_causes_are_found_with_their_values_by_relinearisation(three):
    problem, fit = three
    assert names(fit.causes) == {"camera_latency", "payload", "camera_yaw"}
    assert set(fit.names) == set(HIDDEN)
    assert (stds_off(fit, HIDDEN) < 4).all()
    # the latency is far from where sensitivities were taken first
    at = fit.names.index("camera_latency_s")
    assert abs(fit.change[at]) > 20 * np.sqrt(fit.cov[at, at])
    assert set(fit.tests) == names(problem.library)
    assert {name for name, test in fit.tests.items() if test.significant} == names(fit.causes)
    start = problem.at(problem.simulation.vector)
    assert rivals_of(problem, fit.info, start, fit.causes) == {cause.name: {} for cause in fit.causes}


def test_a_set_of_causes_is_not_reached_twice(three, monkeypatch):
    """One comes, drives another out and goes itself: what is left was there before, and so it would go on."""
    problem, fit = three
    first, second, third = (effect_named(name) for name in ("payload", "camera_yaw", "gyro_bias"))
    fitted = []

    def refitted(problem, info, causes):
        fitted.append(names(causes))
        return fit.info

    def weakest(info, causes):
        others = [cause for cause in causes if cause is not first]
        return others[0] if third in causes else None

    monkeypatch.setattr(search_module, "relinearize", refitted)
    monkeypatch.setattr(search_module, "_weakest", weakest)
    none = WaldTest(np.zeros(1), 0.0, 1.0, np.zeros(6), True)
    monkeypatch.setattr(search_module, "wald_test", lambda *_: none)

    def in_turn(info, names, left):
        return [effect for effect in (first, second, third) if effect in left][:1]

    monkeypatch.setattr(search_module, "_pair", in_turn)
    monkeypatch.setattr(search_module, "_swap_for_better", lambda _, info, causes: (causes, info))
    monkeypatch.setattr(search_module, "_one_for_two", lambda *_: None)
    assert [cause.name for cause in search(problem, fit.info).causes] == ["payload", "camera_yaw"]
    with_third = {"payload", "camera_yaw", "gyro_bias"}
    assert fitted == [{"payload"}, {"payload", "camera_yaw"}, with_third, {"payload", "gyro_bias"}]


@pytest.mark.parametrize(
    ("hidden", "library", "seeds"),
    [
        # halfway through a run an offset and a rate of a clock add up to nothing: they are found as a pair
        ({"clock_offset_s": 0.06, "clock_rate_ratio": -0.003}, None, {}),
        # far off together, from a lag that is known
        (
            {"camera_latency_s": 0.25, TRACK: 1.5},
            "camera_yaw lever_arm gyro_scale",
            {"camera_latency_s": 0.2},
        ),
        # a seed that is wrong is dropped
        ({"camera_yaw_rad": 0.03}, "camera_latency gyro_scale", {"camera_latency_s": 0.2}),
        # half a track, which straight lines take for less than none
        ({TRACK: -0.45}, None, {}),
    ],
    ids=["pair", "seeded", "wrong seed", "bound"],
)
def test_what_is_hidden_is_found_from_where_straight_lines_mislead(posed, solve, hidden, library, seeds):
    causes = {next(e.name for e in LIBRARY if name in names_of([e])) for name in hidden}
    problem = posed(hidden, library and [*causes, *library.split()])
    fit = solve(problem, seeds)
    assert names(fit.causes) == causes
    inflation = [test.inflation for cause in fit.causes for test in [fit.tests[cause.name]]]
    assert (stds_off(fit, hidden, inflation) < 4).all()
    if hidden == {TRACK: -0.45}:
        linear, _ = problem.at(problem.simulation.vector).fit([TRACK])
        assert linear[0] < BOUNDS[TRACK][0]


class Bent:
    """One parameter in place of a problem: its residual saturates, and Gauss and Newton overshoot."""

    def near(self, info, vector, parameters):
        x = vector[INDEX[parameters[0]]] / 0.02
        slope, residual = 50.0 / (1 + x**2), -np.arctan(x)
        gram = 1e4 * np.outer([slope, residual], [slope, residual])
        return Evidence(tuple(parameters), vector, vector, gram[None, None], {}, (), None, (), np.zeros(1))


def test_a_step_that_raises_the_square_is_halved(monkeypatch):
    bent, yaw = Bent(), ["camera_yaw_rad"]
    here = bent.near(None, vector_of({"camera_yaw_rad": 0.05}), yaw)
    info = here.counted_from(np.zeros(len(INDEX)))
    points = list(steps_of(bent, info, yaw, 12))
    losses = [here.c[0], *(point.c[0] for point in points)]
    assert all(after <= (1 + RISE) * before for before, after in pairwise(losses))
    assert points[-1].vector[INDEX["camera_yaw_rad"]] == pytest.approx(0.0, abs=1e-4)
    # without that guard it goes from bound to bound
    monkeypatch.setattr(search_module, "MAX_HALVINGS", 0)
    free = list(steps_of(bent, info, yaw, 12))
    assert abs(free[-1].vector[INDEX["camera_yaw_rad"]]) == BOUNDS["camera_yaw_rad"][1]


def test_what_changes_other_channels_is_no_rival(posed, solve, monkeypatch):
    """A camera's yaw and a payload explain as much, each in channels of its own."""
    library = ("camera_yaw", "payload", "gyro_scale")
    problem = posed({"camera_yaw_rad": 0.01, "payload_ratio": 0.25}, library, 40.0)
    fit, start, payload = solve(problem), problem.at(problem.simulation.vector), effect_named("payload")
    assert names(fit.causes) == {"camera_yaw", "payload"}
    # as if the yaw had been withdrawn
    assert rivals_of(problem, fit.info, start, [payload]) == {"payload": {}}
    monkeypatch.setattr(search_module, "SHARED", -1.0)
    rivals = rivals_of(problem, fit.info, start, [payload])["payload"]
    assert "camera_yaw" in rivals


# -- Values that one simulation has for all runs: the least square over all of them ------------------------


@pytest.fixture(scope="module")
def of_tracks(hide, pose):
    """Return a function that fits one track to runs with a track each."""

    def fitted(values):
        runs = []
        for i, value in enumerate(values):
            (run,) = hide({TRACK: value}, n=1, seed=i)
            runs.append(replace(run, run_id=f"run_{i}"))
        problem = pose(runs, ["effective_track"])
        start = problem.at(problem.simulation.vector)
        at = relinearize(problem, start, problem.library)
        return problem, cause_fit(problem, at, problem.library)

    return fitted


def test_it_leaves_the_least_square_where_runs_differ(of_tracks):
    problem, fit = of_tracks([0.3, 1.2, 0.4, 1.3, 0.5, 1.0])
    one = pooled(problem, fit)

    def square(value):
        info = problem.at(vector_of({TRACK: value}), (TRACK,), noise=fit.info.noise)
        return sum(float((white[-1] ** 2).sum()) for white in info.white)

    best = float(one.change[0])
    assert square(best) < min(square(0.93 * best), square(1.07 * best))
    assert square(best) <= square(float(fit.change[0]))
    # six runs determine a mean to 0.41 of their scatter, 0.4, at the best
    assert 0.08 < float(np.sqrt(one.cov[0, 0])) < 0.4


# -- Which effects fit as well in the place of a cause, by the losses and squares of their fits ------------


@pytest.mark.parametrize(
    ("behind", "square", "inflation", "alike", "is_rival"),
    [
        (RIVAL_LOSS - 1.0, 0.0, 1.0, 0.9, True),
        (RIVAL_LOSS + 1.0, 0.0, 1.0, 0.9, False),
        (RIVAL_LOSS + 1.0, 0.0, 1.0, 0.999, True),  # of twins more is allowed
        # one that leaves a larger square is none
        (-50.0, RIVAL_RISE * 1000.0 + RIVAL_LOSS - 1.0, 1.0, 0.9, True),
        (-50.0, RIVAL_RISE * 1000.0 + RIVAL_LOSS + 1.0, 1.0, 0.9, False),
        # losses count less where runs disagree on the cause
        (3.0 * RIVAL_LOSS, 0.0, 1.0, 0.9, False),
        (3.0 * RIVAL_LOSS, 0.0, 4.0, 0.9, True),
    ],
)
def test_an_effect_that_is_little_behind_is_a_rival(monkeypatch, behind, square, inflation, alike, is_rival):
    """The better of two judges counts: by one a cause that absorbs noise is ahead."""
    cause, other = effect_named("payload"), effect_named("motor_constant")
    info, start = (SimpleNamespace(vector=np.zeros(len(INDEX)), model_std=np.zeros(1)) for _ in range(2))

    def fit(problem, judge, parameters):
        own, at = parameters == names_of([cause]), vector_of({"motor_constant_ratio": 0.1})
        loss = 0.0 if own else behind + 100.0 * (judge is start)
        gram = np.diag([1e4, 1000.0 + square * (not own)])[None, None]
        return loss, Evidence(tuple(parameters), at, at, gram, {}, (), None, (), np.zeros(1))

    monkeypatch.setattr(search_module, "replace", lambda *_, **__: None)
    monkeypatch.setattr(search_module, "fit_again", fit)
    monkeypatch.setattr(search_module, "_near", lambda *_: [(other, alike)])
    monkeypatch.setattr(search_module, "wald_test", lambda *_: SimpleNamespace(inflation=inflation))
    rivals = rivals_of(None, info, start, [cause])[cause.name]
    assert list(rivals) == [other.name] * is_rival
    # its size counts beside the evidence: a motor constant of 0.1, where 0.5 is plausible, beside no payload
    expected = pytest.approx(behind / inflation + (1.96 * 0.2) ** 2)
    assert all(rival.behind == expected for rival in rivals.values())
    assert all((change[0], std[0]) == pytest.approx((0.1, 0.01)) for change, std, *_ in rivals.values())


@pytest.mark.parametrize(
    ("one", "first", "depends", "preferred"),
    [
        (90.0, 60.0, True, True),
        (75.0, 40.0, True, False),  # it leaves too much
        (90.0, 85.0, True, False),  # the first of the two is nearly as good by itself
        (90.0, 60.0, False, False),  # both are there without the other
    ],
)
def test_one_effect_that_does_nearly_as_much_as_two_that_need_each_other(
    monkeypatch, one, first, depends, preferred
):
    slip, lever, scale = (effect_named(name) for name in ("turning_slip", "lever_arm", "gyro_scale"))
    gains = {
        names_of([slip, lever]): 100.0,
        names_of([slip]): first,
        names_of([lever]): 3.0,
        names_of([scale]): one,
        (): 0.0,
    }

    def test_of(info, beside, effect):
        return SimpleNamespace(significant=effect is slip or not depends, inside=True)

    monkeypatch.setattr(search_module, "wald_test", test_of)
    info = SimpleNamespace(loss=lambda parameters: -gains[tuple(parameters)])
    found = search_module._one_for_two(info, (slip, lever, scale), [slip, lever])
    assert found == ((scale, (slip, lever)) if preferred else None)
