"""What is worth a question, and the sequence of grounds that labels are proposed from."""

import numpy as np

from terrain.classify.proposals import Proposal, questions, smoothed_classes


def test_doubt_is_of_what_is_improbable_unsupported_or_unknown():
    certain = Proposal("a", 0.0, 9.0, "ice", 0.99, 1.0, 0.0, 4)
    for changed in ({"confidence": 0.5}, {"supported_ratio": 0.0}, {"unknown_ratio": 1.0}):
        doubtful = certain._replace(run_id="b", **changed)
        assert questions([certain, doubtful], 1) == [1]
        assert not doubtful.taken_over(0.9)
    assert certain.taken_over(0.9)
    assert questions([certain], 5) == [0]
    assert questions([], 5) == []


def test_the_smoothed_sequence_is_the_best_of_all_of_them():
    rng = np.random.default_rng(0)
    probability, prior = rng.dirichlet(np.ones(3), 7), np.array([0.5, 0.3, 0.2])
    time_s = np.cumsum(rng.uniform(0.5, 8.0, 7))
    evidence = np.log(0.98 * probability / prior + 0.02)

    def score(path):
        kept = np.exp(-np.diff(time_s) / 20.0)
        same = np.diff(path) == 0
        return evidence[np.arange(7), path].sum() + np.log(np.where(same, kept, (1 - kept) / 2)).sum()

    every = np.array(np.meshgrid(*[range(3)] * 7)).reshape(7, -1).T
    best = every[np.argmax([score(path) for path in every])]
    assert smoothed_classes(probability, time_s, prior).tolist() == best.tolist()
    assert smoothed_classes(np.zeros((0, 3)), np.zeros(0), prior).tolist() == []
