"""Fingerprints in files give the pairs of runs that they give in memory, and leave nothing behind."""

import numpy as np
import pytest

from pipelines.feature_store.print_files import PrintFiles
from terrain.logs.duplicates import equal_codes, pairs_of
from terrain.logs.fingerprints import RunPrint


def drawn(seed, n_runs=30, n_codes=200):
    """Return fingerprints, many of which agree by chance; every third run has a piece of another."""
    rng = np.random.default_rng(seed)
    prints = []
    for place in range(n_runs):
        codes = rng.integers(0, 2**42 >> rng.integers(0, 36), n_codes)
        time_s = np.sort(rng.uniform(0.0, 100.0, n_codes))
        if place % 3 == 2:
            other = prints[rng.integers(place)]
            first = rng.integers(n_codes - 40)
            codes[:40], time_s[:40] = other.codes[first:][:40], 500.0 + other.time_s[first:][:40]
        digest = b"same" if place in (4, 17) else b""
        prints.append(RunPrint(codes, time_s, digest))
    return [*prints, RunPrint(np.empty(0, np.int64), np.empty(0), b"")]


def possible_pairs(prints):
    """Return the pairs, all fingerprints in memory at once."""
    run = np.repeat(np.arange(len(prints)), [len(each.codes) for each in prints])
    codes, time_s = (np.concatenate([each[i] for each in prints]) for i in (0, 1))
    return pairs_of(equal_codes(codes, run, time_s), [each.digest for each in prints])


@pytest.mark.parametrize("seed", range(5))
def test_the_pairs_are_those_found_in_memory(seed, tmp_path):
    prints = drawn(seed)
    with PrintFiles(tmp_path / "prints") as files:
        for each in prints:
            files.add(each)
        found = files.possible_pairs()
    assert found == possible_pairs(prints)
    assert len(found) >= 8
    assert (4, 17) in found
    assert not (tmp_path / "prints").exists()


def test_no_run_and_an_error_leave_nothing(tmp_path):
    with PrintFiles(tmp_path / "prints") as files:
        assert files.possible_pairs() == []
    (tmp_path / "prints").mkdir()
    (tmp_path / "prints" / "0").write_bytes(b"of a process that was killed")
    with pytest.raises(AttributeError), PrintFiles(tmp_path / "prints") as files:
        files.add(None)
    assert list(tmp_path.iterdir()) == []
