"""Pairwise coupling: its plain form as an oracle, laws, and a hidden scale that is recovered."""

import numpy as np
import pytest
from scipy.special import expit

from terrain.classify.svm import (
    class_probabilities,
    fit_scale,
    pairs_of,
    probabilities_of_known,
)


def coupled_plainly(margins, k, scale):
    """Solve the system of the minimum under its constraint, window by window."""
    found = []
    for row in margins:
        r = np.zeros((k, k))
        for (a, b), margin in zip(pairs_of(k), row, strict=True):
            r[a, b], r[b, a] = expit(scale * margin), expit(-scale * margin)
        Q = -r.T * r
        np.fill_diagonal(Q, (r**2).sum(axis=0))
        system = np.block([[Q, np.ones((k, 1))], [np.ones((1, k)), np.zeros((1, 1))]])
        found.append(np.linalg.solve(system, np.eye(k + 1)[-1])[:k])
    return np.array(found)


@pytest.mark.parametrize("k", [2, 3, 5, 8])
def test_probabilities_are_those_of_the_plain_form(k):
    margins = np.random.default_rng(k).normal(0, 2, (60, k * (k - 1) // 2))
    found = class_probabilities(margins, k, 1.7)
    np.testing.assert_allclose(found, coupled_plainly(margins, k, 1.7), atol=1e-10)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    assert (found >= 0).all()


def test_consistent_pairs_give_back_the_probabilities_that_they_are_made_of():
    p = np.random.default_rng(0).dirichlet(np.ones(5), 40)
    margins = np.column_stack([np.log(p[:, a] / p[:, b]) for a, b in pairs_of(5)])
    np.testing.assert_allclose(class_probabilities(margins, 5, 1.0), p, atol=1e-6)


def test_the_order_of_the_classes_does_not_matter():
    rng = np.random.default_rng(1)
    full = rng.normal(size=(30, 4, 4))
    full = full - np.swapaxes(full, 1, 2)
    order = rng.permutation(4)

    def couple(margin):
        return class_probabilities(np.column_stack([margin[:, a, b] for a, b in pairs_of(4)]), 4, 2.0)

    np.testing.assert_allclose(couple(full[:, order][:, :, order]), couple(full)[:, order], atol=1e-12)


def test_extreme_margins_give_finite_probabilities():
    margins = np.array([[800.0, 800.0, -800.0], [-800.0, 800.0, 800.0], [1e300, -1e300, 0.0]])
    found = class_probabilities(margins, 3, 50.0)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    assert found[0].argmax() == 0
    assert found[0, 0] > 0.999


def test_a_hidden_scale_is_recovered_from_several_classes():
    rng = np.random.default_rng(2)
    margins = rng.normal(0, 1, (6000, 6))
    p = class_probabilities(margins, 4, 2.5)
    drawn = (rng.random((6000, 1)) > p.cumsum(axis=1)).sum(axis=1)
    assert fit_scale(margins, drawn, 4) == pytest.approx(2.5, rel=0.06)


def test_a_class_that_was_not_there_to_train_on_gets_no_probability():
    rng = np.random.default_rng(3)
    margins = rng.normal(size=(20, 6))
    margins[:10, [0, 3, 4]] = np.nan  # all pairs of class 1
    found = probabilities_of_known(margins, 4, 1.3)
    np.testing.assert_array_equal(found[:10, 1], 0.0)
    without = class_probabilities(margins[:10][:, [1, 2, 5]], 3, 1.3)
    np.testing.assert_allclose(found[:10][:, [0, 2, 3]], without)
    np.testing.assert_allclose(found[10:], class_probabilities(margins[10:], 4, 1.3))
    truth = found.argmax(axis=1)
    truth[:3] = 1  # of the absent class: these rows do not count
    others = np.arange(20) >= 3
    assert fit_scale(margins, truth, 4) == pytest.approx(fit_scale(margins[others], truth[others], 4))
