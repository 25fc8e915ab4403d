import numpy as np
import pytest

from terrain.classify.folds import Fold, split_runs
from terrain.classify.learning_curve import CURVE_DRAWS, drawn_folds, enough_runs, learning_curve


def test_the_curve_draws_that_many_runs_and_leaves_test_folds_alone():
    names = [f"{terrain}_{i}" for terrain, n in (("ICE", 5), ("MUD", 5), ("TAR", 1)) for i in range(n)]
    run_id = np.repeat(names, 10)
    terrain = np.array([name[:3] for name in run_id])
    rng = np.random.default_rng(0)
    folds = [Fold(0, i, *rows) for i, rows in enumerate(split_runs(terrain, run_id, 5, rng))]
    drawn_folds_, runs_per_class = drawn_folds(terrain, run_id, folds, 0)
    assert len(drawn_folds_) == 3 * CURVE_DRAWS * len(folds)  # 1, 2 and 3 of the 4 training runs of each fold
    for drawn in drawn_folds_:
        original = folds[drawn.number]
        assert np.array_equal(drawn.test, original.test)
        size = 1 + drawn.repeat // CURVE_DRAWS
        for name, n_runs in (("ICE", size), ("MUD", size), ("TAR", 1)):
            assert len(set(run_id[drawn.train][terrain[drawn.train] == name])) == n_runs
        whole = original.train[np.isin(run_id[original.train], run_id[drawn.train])]
        np.testing.assert_array_equal(drawn.train, whole)  # a run that is drawn is drawn whole
    draws = [
        {tuple(fold.train) for fold in drawn_folds_ if fold.repeat == draw} for draw in range(CURVE_DRAWS)
    ]
    assert draws[0] != draws[1]
    assert runs_per_class == pytest.approx([1.0, (2 + 2 + 1) / 3, (3 + 3 + 1) / 3, (4 + 4 + 1) / 3])
    curve = learning_curve(runs_per_class, [0.4, 0.6, 0.6, 0.8, 0.7, 0.7], 0.77)
    assert curve.accuracy == pytest.approx((0.5, 0.7, 0.7, 0.77))
    assert curve.accuracy_spread[:-1] == pytest.approx((0.02**0.5, 0.02**0.5, 0.0))
    assert curve.accuracy_spread[-1] is None


@pytest.mark.parametrize(("scale", "power"), [(0.3, 1.0), (0.2, 0.6), (0.4, 1.5)])
def test_enough_runs_of_a_known_law(scale, power):
    m = np.array([1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
    n_runs, statement = enough_runs(m, 0.95 - scale * m**-power)
    # Doubling m gains scale m^-power (1 - 2^-power); solved for a gain of one per cent.
    law = (100 * scale * (1 - 2.0**-power)) ** (1 / power)
    assert n_runs == pytest.approx(law, abs=1.05)
    assert statement.startswith("enough:" if n_runs <= 12 else "not enough yet:")


def test_a_curve_that_still_climbs_gives_no_number():
    m = np.array([1.0, 2.0, 3.0, 4.0])
    n_runs, statement = enough_runs(m, 0.1 + 0.1 * np.log2(m))
    assert n_runs is None
    assert statement.startswith("not enough yet: doubling the 4.0 runs per class would still gain")
    few = enough_runs(m[:3], m[:3] / 4)
    assert few == (None, "3 sizes are too few to estimate how many runs are enough")
    assert enough_runs(m, np.full(4, 0.8))[0] == 1
