"""Training coverage of held-out windows: a run never covers itself, and what was never driven is asked for first."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.classify.coverage import (
    EDGE_STEP_MPS,
    MAX_SPEEDS,
    MIN_WIDTH_MPS,
    Manoeuvre,
    coverage_of,
    errors_left,
    expected_gain,
    fit_growth,
    held_out_support,
    manoeuvres,
    speed_edges,
)
from terrain.classify.folds import Fold
from terrain.classify.held_out import FoldResult, HeldOut
from terrain.classify.limits import Motion, SupportLevel

RUNS = [(name, speed) for speed in (0.2, 0.6) for name in ("ice", "mud") for _ in range(5)]


def evaluated(runs, folds=3, seed=0):
    """Return held-out outputs, runs and motions of 20 windows a run ``(class, speed)``.

    They are right mostly where another run drove the class so fast.
    """
    rng, number = np.random.default_rng(seed), np.repeat(np.arange(len(runs)), 20)
    terrain, n = np.array([runs[i][0] for i in number]), len(number)
    speed = np.array([runs[i][1] for i in number]) + rng.normal(0, 0.005, n)
    fold, run_id = number % folds, number.astype(str)

    def of(probability):
        results = []
        for k in range(folds):
            test = np.flatnonzero(fold == k)
            results.append(FoldResult(Fold(0, k, np.flatnonzero(fold != k), test), probability[test], {}))
        return HeldOut.of_folds(results, terrain), run_id, Motion(speed, np.zeros(n), np.zeros(n))

    classes = np.unique(terrain)
    seen = held_out_support(*of(np.full((n, len(classes)), 0.5)))[0][0] > 0
    right = rng.random(n) < np.where(seen, 0.9, 0.1)
    answer = np.where(right, np.searchsorted(classes, terrain), (np.searchsorted(classes, terrain) + 1) % 2)
    return of(np.where(np.arange(len(classes)) == answer[:, None], 0.9, 0.1))


def test_coverage_is_counted_among_other_runs_of_the_fold_only():
    held_out, run_id, motion = evaluated([*RUNS, ("ice", 1.5)])
    near, own, terrain = held_out_support(held_out, run_id, motion)[0][0], run_id == "20", held_out.truth
    assert (near[own] == 0).all()  # a run never supports itself
    assert (near[~own] > 0).all()
    for _, _, train, test in (result.fold for result in held_out.results):
        for row in test:
            beside = np.abs(motion.speed_mps[train] - motion.speed_mps[row]) < 0.1
            assert near[row] == len(np.unique(run_id[train][beside & (terrain[train] == terrain[row])]))


def test_the_terrain_that_was_driven_once_at_a_speed_is_asked_for_first():
    of_windows = evaluated([*RUNS, ("ice", 1.5), ("mud", 1.5), ("mud", 1.5), ("mud", 1.5)])
    found = SimpleNamespace(**coverage_of(*of_windows, 2.0, 0))
    first = found.next_drives[0]
    assert (first.terrain, first.windows, first.support_runs) == ("ice", 20, 1.0)
    assert first.regime.startswith("straight at ")
    assert "1.5" in first.regime
    assert first.request == f"ice, {first.regime}, at least 2 runs of 20 s"
    gains = [drive.gain for drive in found.next_drives]
    assert gains == sorted(gains, reverse=True)
    assert [row["support"] for row in found.accuracy_by_support] == [level.value for level in SupportLevel]
    never = found.accuracy_by_support[0]
    assert never["accuracy"] < 0.3
    assert never["windows_ratio"] == pytest.approx(20 / len(of_windows[1]))


@pytest.mark.parametrize("law", [(0.05, 0.7, 1.0), (0.0, 0.9, 0.5)])
def test_a_hidden_law_is_found(law):
    rng = np.random.default_rng(1)
    n_runs = rng.integers(0, 13, 60_000)
    right = rng.random(len(n_runs)) >= errors_left(law, n_runs)
    found = fit_growth(n_runs, right)
    np.testing.assert_allclose(errors_left(found, np.arange(13)), errors_left(law, np.arange(13)), atol=0.03)


def cells(ratio=0.2, n_windows=50.0, n_errors=20.0, held_out=2.0, runs=2.5):
    return [np.array([value]) for value in (ratio, n_windows, n_errors, held_out, runs)]


LAWS = st.tuples(st.floats(0, 0.3), st.floats(0.05, 0.7), st.floats(0.1, 2))


@given(LAWS, st.floats(0, 20), st.integers(1, 6))
def test_laws_of_a_gain(law, runs, added):
    """It is never negative nor more than the errors of its cell; these raise it, and support lowers it."""
    gain = expected_gain(law, *cells(runs=runs, held_out=runs), added)[0]
    assert 0 <= gain <= 0.2
    assert gain <= expected_gain(law, *cells(runs=runs, held_out=runs), added + 1)[0]
    gain = expected_gain(law, *cells())[0]
    assert expected_gain(law, *cells(n_errors=40.0))[0] > gain
    assert expected_gain(law, *cells(ratio=0.4))[0] == pytest.approx(2 * gain)
    assert expected_gain(law, *cells(runs=9.0))[0] < gain


@pytest.mark.parametrize("speeds", [(0.24, 0.39, 0.63, 0.79), (0.5,), (0.3, 2.0)])
def test_a_commanded_speed_is_not_cut_in_two(speeds):
    rng = np.random.default_rng(0)
    driven = np.concatenate([speed + rng.normal(0, 0.01, 200) for speed in speeds])
    edges = np.array(speed_edges(driven))
    number = np.searchsorted(edges[1:-1], driven, side="right")
    each = number.reshape(len(speeds), 200)
    assert all(np.mean(row == np.bincount(row).argmax()) > 0.98 for row in each)
    assert len(edges) <= MAX_SPEEDS + 1
    assert (np.diff(edges) >= EDGE_STEP_MPS - 1e-9).all()
    assert len(edges) == 2 or np.ptp(driven) > MIN_WIDTH_MPS


def test_what_a_robot_does():
    straight, curve, spin = Manoeuvre
    rows = [
        (0.5, 0.0, 0.0, straight),
        (0.5, 0.3, 0.2, curve),
        (0.3, 0.05, 1.0, spin),
        (0.5, np.nan, 0.05, straight),
        (0.5, np.nan, 0.4, curve),
        (0.1, 1.0, np.nan, spin),
        (0.5, 1.0, np.nan, curve),
        (0.5, np.nan, np.nan, straight),
    ]
    *motion, expected = map(np.array, zip(*rows, strict=True))
    assert manoeuvres(Motion(*motion)).tolist() == expected.tolist()
