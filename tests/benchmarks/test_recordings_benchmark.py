"""How fast recordings of DRIVE and of a Robotino are read: ``pytest tests/benchmarks --benchmark-enable``.

Required: 100 MB of logs, unpacked, in 10 s on one core.
"""

import gzip

import numpy as np
import pytest

from pipelines.data.datasets import load_runs

MEGABYTE = 1e6
MIN_MEGABYTES_PER_S = 10.0


@pytest.fixture(scope="module")
def packed_recordings(measured, tmp_path_factory):
    """The measured recordings, each four times over as four sessions, and their size unpacked."""
    folder = tmp_path_factory.mktemp("recordings")
    n_bytes, n_files = 0, 0
    for path in sorted(measured("drive_recordings").glob("*/*.csv.gz")):
        packed = path.read_bytes()
        n_files += 4
        n_bytes += 4 * len(gzip.decompress(packed))
        (folder / path.parent.name).mkdir(exist_ok=True)
        for copy in range(4):
            (folder / path.parent.name / f"copy_{copy}_{path.name}").write_bytes(packed)
    return folder, n_bytes, n_files


def test_recordings_are_read_at_ten_megabytes_a_second(benchmark, packed_recordings):
    folder, n_bytes, n_files = packed_recordings
    runs = benchmark.pedantic(load_runs, args=(folder,), rounds=3, warmup_rounds=1)
    assert len({run.session for run in runs}) == n_files
    assert all(np.isfinite(run.streams["wheels"].values[:, :2]).all() for run in runs)
    if benchmark.enabled:
        assert n_bytes / MEGABYTE / benchmark.stats["min"] > MIN_MEGABYTES_PER_S


def test_runs_of_a_robotino_are_read_at_ten_megabytes_a_second(benchmark, measured):
    folder = measured("robotino")
    n_bytes = sum(len(gzip.decompress(path.read_bytes())) for path in folder.rglob("*.csv.gz"))
    runs = benchmark.pedantic(load_runs, args=(folder,), rounds=3, warmup_rounds=1)
    assert len(runs) > 100
    if benchmark.enabled:
        assert n_bytes / MEGABYTE / benchmark.stats["min"] > MIN_MEGABYTES_PER_S
