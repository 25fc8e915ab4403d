import numpy as np
import pytest

from pipelines.models.novelty_file import novelty_bytes, read_novelty
from terrain.classify.novelty import NoveltyScore
from terrain.classify.novelty_numbers import novelty_scores
from terrain.errors import DataError


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(0)
    terrain = np.repeat([0, 1, 2], 40)
    X = rng.standard_normal((120, 12)) + 2.0 * rng.standard_normal((3, 12))[terrain]
    return NoveltyScore().fit(X, terrain.astype(str), np.repeat(np.arange(12), 10)), X


def test_saved_scores_are_the_same_bit_by_bit(fitted):
    score, X = fitted
    content = novelty_bytes(score.numbers_)
    np.testing.assert_array_equal(novelty_scores(read_novelty(content, 3), X), score.score(X))


def test_damaged_files_and_those_of_other_classes_are_refused(fitted):
    content = novelty_bytes(fitted[0].numbers_)
    for broken in (b"", b"PK", content[: len(content) // 2], content[:400] + b"\0" * 40 + content[440:]):
        with pytest.raises(DataError, match="cannot be read"):
            read_novelty(broken, 3)
    with pytest.raises(DataError, match="finite numbers"):
        read_novelty(content, 4)
