"""The extra on stiffness: figures from held-out probabilities whose mistakes are known."""

import numpy as np
import pytest

from pipelines.learn.checks import stiffness_figures
from pipelines.learn.evaluate import HeldOut
from pipelines.learn.protocols import grouped_samples
from pipelines.learn.recipes import feature_matrix, make_recipe

NAMES = {"ASPHALT": "ASPHALT", "GRASS": "CONCRETE", "GRAVEL": "SNOW"}
"""Two hard terrains and a soft one, in place of the names of the drawn runs."""


@pytest.fixture(scope="module")
def drawn(drive_all, settings):
    runs = drive_all(n_runs=4)
    samples = grouped_samples(runs, settings().rule)
    windows = samples.windows
    terrain = np.array([NAMES[name] for name in windows.terrain], dtype=object)
    windows = type(windows)(
        windows.values,
        windows.channels,
        windows.rate_hz,
        windows.length_s,
        windows.start_s,
        windows.run_id,
        terrain,
    )
    samples = samples._replace(windows=windows)
    return samples, feature_matrix(make_recipe("svm"), windows)


def held_out(samples, predicted, certainty=1.0):
    """Return probabilities of one repeat that put ``certainty`` on each predicted class."""
    classes = np.unique(samples.windows.terrain.astype(str))
    column = np.searchsorted(classes, predicted)
    rest = (1 - certainty) / (len(classes) - 1)
    probability = np.full((1, len(column), len(classes)), rest)
    probability[0, np.arange(len(column)), column] = certainty
    return HeldOut(classes, probability, np.zeros((1, len(column)), dtype=int), classes[column], [])


def test_a_wrong_class_of_the_right_level_costs_little(drawn):
    samples, features = drawn
    terrain = samples.windows.terrain.astype(str)
    right = stiffness_figures(held_out(samples, terrain), features, samples, 0)
    assert (right.accuracy, right.cost, right.soft_hard_ratio) == (1.0, 0.0, 0.0)
    paved = np.where(terrain == "ASPHALT", "CONCRETE", terrain)
    within = stiffness_figures(held_out(samples, paved), features, samples, 0)
    share = float(np.mean(terrain == "ASPHALT"))
    assert (within.accuracy, within.cost) == (1.0, pytest.approx(0.25 * share))
    snow = np.where(terrain == "ASPHALT", "SNOW", terrain)
    apart = stiffness_figures(held_out(samples, snow), features, samples, 0)
    assert apart.cost == apart.soft_hard_ratio == pytest.approx(share)
    assert apart.accuracy == pytest.approx(1 - share)
    assert apart.cost_ci[0] <= apart.cost <= apart.cost_ci[1]
    assert apart.levels == {"ASPHALT": "HARD", "CONCRETE": "HARD", "SNOW": "SOFT"}


def test_two_hard_classes_together_outweigh_a_more_probable_soft_one(drawn):
    samples, features = drawn
    terrain = samples.windows.terrain.astype(str)
    doubtful = stiffness_figures(held_out(samples, np.full(len(terrain), "SNOW"), 0.4), features, samples, 0)
    hard = float(np.mean(terrain != "SNOW"))
    assert doubtful.cost == pytest.approx(hard)
    assert doubtful.least_cost < doubtful.cost
    assert doubtful.gain == pytest.approx(doubtful.cost - doubtful.least_cost)


def test_clusters_are_those_of_the_runs(drawn):
    samples, features = drawn
    terrain = samples.windows.terrain.astype(str)
    clusters = stiffness_figures(held_out(samples, terrain), features, samples, 0).clusters
    assert -1.0 <= clusters.adjusted_rand <= 1.0
    assert clusters.interval[0] <= clusters.interval[1]


def test_without_a_known_level_there_are_no_figures(drawn, drive_all, settings):
    samples, features = drawn
    unknown = grouped_samples(drive_all(n_runs=2), settings().rule)  # GRASS and GRAVEL have no known level
    terrain = unknown.windows.terrain.astype(str)
    assert stiffness_figures(held_out(unknown, terrain), features, unknown, 0) is None
    hard = np.flatnonzero(samples.windows.terrain != "SNOW")
    paved = samples.of(hard)
    terrain = paved.windows.terrain.astype(str)
    assert stiffness_figures(held_out(paved, terrain), features[hard], paved, 0) is None
