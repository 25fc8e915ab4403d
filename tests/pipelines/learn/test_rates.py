"""From which rates a model takes logs: those at which the band that tells terrains apart is still there."""

from functools import partial

import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier

from features.protocols import folds_of, samples_of
from features.recipes import feature_matrix, make_recipe
from features.windows import WindowRule
from pipelines.learn.evaluate import evaluate
from pipelines.learn.rates import RATIOS, LowerRate, at_lower_rates, least_rates, right_at
from terrain.classify.held_out import Examples
from terrain.records import RunLog, Stream

RATE_HZ, TIME_S = 50.0, np.arange(0.0, 16.0, 0.02)


def drawn_run(number, rng, band_hz):
    """A run whose terrain is distinguished by the size of one of two waves, that in the band."""
    terrain = "ice" if number % 2 else "mud"
    waves = sum(
        (3.0 if f == band_hz and terrain == "ice" else 1.0)
        * np.sin(2 * np.pi * f * TIME_S + rng.uniform(0, 6))
        for f in (3.0, 20.0)
    )
    values = waves + 0.1 * rng.standard_normal(TIME_S.size)
    imu = Stream(TIME_S, values[:, None], ("accel_z_mps2",))
    return RunLog(f"{number}", "husky", {"imu": imu}, ((0.0, 16.0, terrain),))


@pytest.mark.parametrize(
    ("band_hz", "least_hz"), [(3.0, {"imu": 0.25 * RATE_HZ}), (20.0, {"imu": 0.9 * RATE_HZ})]
)
def test_the_lowest_rate_has_the_band_that_tells_terrains_apart(band_hz, least_hz):
    rng = np.random.default_rng(3)
    runs = [drawn_run(number, rng, band_hz) for number in range(12)]
    samples = samples_of(runs, WindowRule(2.0, steady=None), ("imu",))
    # one split by the power of the band alone: what else a lower rate changes does not matter to it
    recipe = make_recipe(DecisionTreeClassifier(max_depth=1, max_features=1.0, random_state=0), ("imu",))
    features, tried = feature_matrix(recipe, samples.windows), list(at_lower_rates(recipe, samples.windows))
    names = [name.partition(" ")[0] for name in recipe[0].get_feature_names_out()]
    band = f"imu.accel_z.log_band_{int(band_hz / (RATE_HZ / 2) * 20) + 1}of20"
    column = [names.index(band)]
    assert [each.rate_hz for each in tried] == pytest.approx([ratio * RATE_HZ for ratio in RATIOS])
    folds = folds_of(samples)
    rows = [each.rows[:, column] for each in tried]
    asks = [
        partial(right_at, [each[fold.test] for each in rows], samples.terrain[fold.test]) for fold in folds
    ]
    examples = Examples(features[:, column], samples.terrain, samples.group)
    held_out = evaluate(recipe[-1], examples, folds, asks=asks)
    assert held_out.accuracies == [1.0]
    tested = np.concatenate([each.fold.test for each in held_out.results])
    lower_right = np.concatenate([each.found for each in held_out.results], axis=1)
    assert least_rates(
        tried, held_out.correct[0][tested], lower_right, samples.unit[tested]
    ) == pytest.approx(least_hz)


def test_what_cannot_be_shown_not_to_matter_is_not_accepted():
    tried = [LowerRate("imu", rate_hz, np.empty((40, 0))) for rate_hz in (45.0, 25.0)]
    right, unit = np.ones(40, dtype=bool), np.repeat(np.arange(8), 5).astype(str)
    one_run_lost = unit != "3"
    assert least_rates(tried, right, np.array([right, right]), unit) == {"imu": 25.0}
    assert (
        least_rates(tried, right, np.array([one_run_lost, right]), unit) == {}
    )  # none below one that matters
    assert (
        least_rates(tried, right, np.array([right, right]), np.full(40, "a")) == {}
    )  # one run shows nothing
