"""The search on runs in which it is known what is there."""

from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy import search as search_module
from terrain.discrepancy.evidence import Nearby, Statistics, move_point
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import (
    RISE,
    RIVAL_LOSS,
    RIVAL_RISE,
    Problem,
    Refit,
    _found,
    names_of,
    pooled,
    relinearize,
    rivals_of,
    search,
    steps_of,
    with_rivals,
)
from terrain.discrepancy.selection import fit_change
from terrain.discrepancy.signals import signals_of
from terrain.effects import BOUNDS, INDEX, LIBRARY, effect_named, vector_of
from terrain.robots import load_robot

HUSKY = load_robot("husky")
HIDDEN = {"camera_latency_s": 0.15, "payload_ratio": 0.25, "camera_yaw_rad": 0.03}


def problem(hidden, library=None, built_in=None):
    simulation = simulation_of(HUSKY).with_effects(built_in or {})
    drives = rich_drives(np.random.default_rng(5), 6, 40.0)
    runs = hidden_runs(HUSKY, drives, np.random.SeedSequence(2), hidden)
    signals = tuple(signals_of(run, HUSKY) for run in runs)
    library = simulation.library if library is None else tuple(effect_named(name) for name in library)
    return Problem(signals, simulation, low_pass_of(signals), library)


def searched(asked):
    return search(asked, asked.at(asked.simulation.vector))


@pytest.fixture(scope="module")
def three():
    asked = problem(HIDDEN)
    return asked, searched(asked)


def test_three_causes_are_found_with_their_values_by_relinearisation(three):
    asked, found = three
    assert {cause.name for cause in found.causes} == {"camera_latency", "payload", "camera_yaw"}
    assert set(found.names) == set(HIDDEN)
    std = np.sqrt(np.diag(found.cov))
    off = found.change - [HIDDEN[name] for name in found.names]
    assert (np.abs(off) < 4 * std).all(), dict(zip(found.names, off / std, strict=True))
    # the latency is far from where sensitivities were taken first
    assert (
        abs(found.change[found.names.index("camera_latency_s")])
        > 20 * std[found.names.index("camera_latency_s")]
    )
    assert found.rivals == {}
    start = asked.at(asked.simulation.vector)
    assert with_rivals(asked, start, found).rivals == {cause.name: () for cause in found.causes}


def test_every_effect_has_evidence_and_only_causes_are_significant(three):
    asked, found = three
    assert set(found.tried) == {effect.name for effect in asked.library}
    significant = {name for name, each in found.tried.items() if each.significant}
    assert significant == {cause.name for cause in found.causes}


def test_changes_are_counted_from_the_simulation_that_was_given(three):
    _, found = three
    half = {name: 0.5 * value for name, value in HIDDEN.items()}
    again = searched(problem(HIDDEN, built_in=half))
    assert {cause.name for cause in again.causes} == {cause.name for cause in found.causes}
    std = np.sqrt(np.diag(found.cov))
    for name, value, own in zip(found.names, found.change, std, strict=True):
        change = again.change[again.names.index(name)]
        assert change + half[name] == pytest.approx(value, abs=own)
    at_fit = fit_change(again.info, again.names)[0]
    np.testing.assert_allclose(at_fit, again.change)


def test_a_set_of_causes_is_not_reached_twice(three, monkeypatch):
    """One comes, drives another out and goes itself: what is left was there before, and so it would go on."""
    asked, found = three
    first, second, third = (effect_named(name) for name in ("payload", "camera_yaw", "gyro_bias"))
    fits = []

    def refitted(problem, info, base, causes):
        fits.append({cause.name for cause in causes})
        return found.info

    def weakest(info, causes):
        others = [i for i, cause in enumerate(causes) if cause is not first]
        return others[0] if third in causes else None

    def following(info, base, causes, left, fit):
        return [each for each in (first, second, third) if each in left][:1]

    monkeypatch.setattr("terrain.discrepancy.search.relinearize", refitted)
    monkeypatch.setattr("terrain.discrepancy.search._weakest", weakest)
    monkeypatch.setattr("terrain.discrepancy.search._next", following)
    monkeypatch.setattr("terrain.discrepancy.search._better", lambda *_: None)
    held = search(asked, found.info)
    assert [cause.name for cause in held.causes] == ["payload", "camera_yaw"]
    assert fits == [
        {"payload"},
        {"payload", "camera_yaw"},
        {"payload", "camera_yaw", "gyro_bias"},
        {"payload", "gyro_bias"},
    ]


def test_without_its_entry_in_the_library_a_distinct_cause_stays_unexplained():
    names = ["camera_latency", "gyro_bias", "accel_bias", "scrub"]
    found = searched(problem({"camera_yaw_rad": 0.05}, names))
    assert found.causes == ()
    assert found.names == ()
    assert found.change.shape == (0,)


def test_an_offset_and_a_rate_of_a_clock_that_hide_each_other_are_found_as_a_pair():
    """Halfway through 40 s the two add up to nothing."""
    hidden = {"clock_offset_s": 0.06, "clock_rate_ratio": -0.003}
    found = searched(problem(hidden))
    assert {cause.name for cause in found.causes} == {"clock_offset", "clock_rate"}
    for name, value in zip(found.names, found.change, strict=True):
        std = np.sqrt(np.diag(found.cov))[found.names.index(name)]
        assert abs(value - hidden[name]) < 4 * std


def test_names_come_once_and_in_order():
    lever, payload = effect_named("lever_arm"), effect_named("payload")
    assert names_of([lever, payload, lever]) == ("lever_x_m", "lever_y_m", "payload_ratio")
    assert set(names_of(LIBRARY)) <= set(INDEX)
    assert names_of([]) == ()


LATE_AND_WIDE = {"camera_latency_s": 0.25, "effective_track_ratio": 1.5}


@pytest.mark.parametrize("seeds", [{}, {"camera_latency_s": 0.2}])
def test_a_large_lag_and_a_track_that_is_far_off_are_found_together(seeds):
    asked = problem(
        LATE_AND_WIDE, ("camera_latency", "effective_track", "camera_yaw", "lever_arm", "gyro_scale")
    )
    found = search(asked, asked.at(asked.simulation.vector), seeds)
    assert {cause.name for cause in found.causes} == {"camera_latency", "effective_track"}
    grown = [found.tried[name.removesuffix("_s").removesuffix("_ratio")].inflation for name in found.names]
    std = np.sqrt(np.diag(found.cov) * grown)
    for name, value, own in zip(found.names, found.change, std, strict=True):
        assert abs(value - LATE_AND_WIDE[name]) < 4 * own, name


def test_a_seed_that_is_wrong_is_dropped():
    asked = problem({"camera_yaw_rad": 0.03}, ("camera_latency", "camera_yaw", "gyro_scale"))
    found = search(asked, asked.at(asked.simulation.vector), {"camera_latency_s": 0.2})
    assert [cause.name for cause in found.causes] == ["camera_yaw"]


class Bent:
    """One parameter in place of a problem: its residual saturates, and Gauss and Newton overshoot."""

    TRUE, WIDTH, WEIGHT = 0.0, 0.02, 1e4

    def near(self, info, vector, names):
        x = (vector[INDEX[names[0]]] - self.TRUE) / self.WIDTH
        slope, residual = 1 / (1 + x**2) / self.WIDTH, -np.arctan(x)
        a, g = np.array([[slope**2]]), np.array([slope * residual])
        return Nearby(vector, self.WEIGHT * a, self.WEIGHT * g, self.WEIGHT * residual**2, ())

    def start(self, at):
        """Return the information at a point, changes counted from 0."""
        vector = move_point(np.zeros(len(INDEX)), ["camera_yaw_rad"], np.array([at]))
        here = self.near(None, vector, ["camera_yaw_rad"])
        return SimpleNamespace(
            a=here.a[None],
            g=(here.g + here.a @ [at])[None],
            origin=vector,
            origin_loss=here.c,
            places=lambda names: [0],
        )


def test_a_step_that_raises_the_square_is_halved(monkeypatch):
    bent, names = Bent(), ["camera_yaw_rad"]
    info, base = bent.start(0.05), np.zeros(len(INDEX))
    points = list(steps_of(bent, info, base, names, 12))
    losses = [info.origin_loss, *(point.c for point in points)]
    assert all(after <= (1 + RISE) * before for before, after in pairwise(losses))
    assert points[-1].vector[INDEX["camera_yaw_rad"]] == pytest.approx(0.0, abs=1e-4)
    # without that guard it goes from bound to bound
    monkeypatch.setattr("terrain.discrepancy.search.MAX_HALVINGS", 0)
    free = list(steps_of(bent, info, base, names, 12))
    assert abs(free[-1].vector[INDEX["camera_yaw_rad"]]) == BOUNDS["camera_yaw_rad"][1]


def test_what_changes_other_channels_is_no_rival(monkeypatch):
    """A camera's yaw and a payload explain as much, each in channels of its own."""
    library = ("camera_yaw", "payload", "gyro_scale")
    asked = problem({"camera_yaw_rad": 0.01, "payload_ratio": 0.25}, library)
    start = asked.at(asked.simulation.vector)
    found = search(asked, start)
    assert {cause.name for cause in found.causes} == {"camera_yaw", "payload"}
    alone = found._replace(causes=(effect_named("payload"),))  # as if the yaw had been withdrawn
    assert with_rivals(asked, start, alone).rivals == {"payload": ()}
    monkeypatch.setattr("terrain.discrepancy.search.SHARED", -1.0)
    assert "camera_yaw" in [each.effect.name for each in with_rivals(asked, start, alone).rivals["payload"]]


def test_a_track_of_half_is_found_though_straight_lines_take_it_for_less_than_none():
    asked = problem({"effective_track_ratio": -0.45})
    start = asked.at(asked.simulation.vector)
    linear, _ = fit_change(start, ["effective_track_ratio"])
    assert linear[0] < BOUNDS["effective_track_ratio"][0]
    found = searched(asked)
    assert [cause.name for cause in found.causes] == ["effective_track"]
    assert found.change[0] == pytest.approx(-0.45, abs=0.02)


# -- Values that one simulation has for all runs: the least square over all of them ------------------------

SIMULATION = simulation_of(HUSKY)
TRACK = "effective_track_ratio"


def fitted(values):
    """Return a problem of runs with a track each, and the fit of one track to them."""
    (track,) = library = (effect_named("effective_track"),)
    logs = []
    for i, value in enumerate(values):
        drives = rich_drives(np.random.default_rng(i), 1, 30.0)
        (run,) = hidden_runs(HUSKY, drives, np.random.SeedSequence(i), {TRACK: value})
        logs.append(replace(run, run_id=f"run_{i}"))
    signals = tuple(signals_of(run, HUSKY) for run in logs)
    problem = Problem(signals, SIMULATION, low_pass_of(signals), library)
    start = problem.at(SIMULATION.vector)
    return problem, _found(problem, relinearize(problem, start, start.vector, [track]), [track])


@pytest.fixture(scope="module")
def scattered():
    return fitted([0.3, 1.2, 0.4, 1.3, 0.5, 1.0])


def test_it_leaves_the_least_square_where_runs_differ(scattered):
    problem, found = scattered
    one = pooled(problem, found)
    assert found.names == (TRACK,)
    statistics = Statistics(found.info.noise, SIMULATION.scatter)

    def square(value):
        info = problem.at(vector_of({TRACK: value}), (TRACK,), statistics)
        return sum(float((white**2).sum()) for white in info.white_residual)

    best = float(one.change[0])
    assert square(best) < min(square(0.93 * best), square(1.07 * best))
    assert square(best) <= square(float(found.change[0]))
    # six runs determine a mean to 0.41 of their scatter, 0.4, at the best
    assert 0.08 < float(np.sqrt(one.cov[0, 0])) < 0.4


def test_runs_that_are_alike_keep_their_value():
    problem, found = fitted([0.5] * 4)
    assert pooled(problem, found) is found


# -- Which effects fit as well in the place of a cause, by the losses and squares of their fits ------------

CAUSE, OTHER = effect_named("payload"), effect_named("motor_constant")
SQUARE = 1000.0


@dataclass(frozen=True)
class Judge:
    """Evidence of which only the point is read."""

    vector: tuple = (0.0,)
    model_std: tuple = (0.0,)


@pytest.fixture
def fitted_rivals(monkeypatch):
    """Return a function that sets loss and square of the other effect's fit, and returns the rivals."""

    def found(behind, square, inflation=1.0):
        def fit(problem, judge, base, names):
            own = names == (CAUSE.parameters[0].name,)
            return Refit(0.0 if own else behind, SQUARE if own else square, np.array([0.1]), np.array([0.01]))

        monkeypatch.setattr(search_module, "fit_again", fit)
        monkeypatch.setattr(search_module, "_near", lambda *_: [OTHER])
        monkeypatch.setattr(search_module, "wald_test", lambda *_: SimpleNamespace(inflation=inflation))
        monkeypatch.setattr(search_module, "_allowed", lambda *_: RIVAL_LOSS)
        found = rivals_of(None, Judge(), Judge(), [CAUSE])
        return [each.effect.name for each in found[CAUSE.name]]

    return found


def test_an_effect_that_is_little_behind_is_a_rival(fitted_rivals):
    assert fitted_rivals(RIVAL_LOSS - 1.0, SQUARE) == [OTHER.name]
    assert fitted_rivals(RIVAL_LOSS + 1.0, SQUARE) == []


def test_an_effect_that_leaves_a_larger_square_is_no_rival(fitted_rivals):
    most = (1.0 + RIVAL_RISE) * SQUARE + RIVAL_LOSS
    assert fitted_rivals(-50.0, most - 1.0) == [OTHER.name]
    assert fitted_rivals(-50.0, most + 1.0) == []


def test_losses_count_less_where_runs_disagree_on_the_cause(fitted_rivals):
    assert fitted_rivals(3.0 * RIVAL_LOSS, SQUARE) == []
    assert fitted_rivals(3.0 * RIVAL_LOSS, SQUARE, inflation=4.0) == [OTHER.name]
