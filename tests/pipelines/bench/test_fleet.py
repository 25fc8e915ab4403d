"""The benchmark of a fleet: its runs, its figures, and that it measures what it states."""

import subprocess
import sys

import numpy as np
import pytest

from pipelines.bench.fleet import FleetPoint, bench_fleet, memory_growth, nonlinearity, speed_ups
from pipelines.bench.fleet_runs import TERRAINS, fleet_loaders, fleet_run, write_fleet_run
from pipelines.bench.memory import peak_memory, process_tree
from pipelines.bench.settings import FleetSettings
from pipelines.data.datasets import data_digest
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError


def test_a_run_depends_on_seed_and_number_only(tmp_path):
    assert data_digest([fleet_run(3, 7)]) == data_digest([fleet_run(3, 7)])
    assert data_digest([fleet_run(3, 7)]) != data_digest([fleet_run(4, 7)])
    write_fleet_run(3, tmp_path, 0)
    (load,) = fleet_loaders(tmp_path, 1)
    assert data_digest([load()]) == data_digest([fleet_run(3, 0)])


def test_terrains_differ_by_their_spectrum():
    """The vibration of a run has the colour of its terrain: its correlation from sample to sample."""
    for number, (_, colour) in enumerate(TERRAINS.values()):
        gyro = np.concatenate([fleet_run(0, number + 4 * k).streams["imu"].values[:, 0] for k in range(8)])
        assert np.corrcoef(gyro[1:], gyro[:-1])[0, 1] == pytest.approx(colour, abs=5 / np.sqrt(len(gyro)))


def test_a_law_that_is_linear_has_no_deviation_and_a_quadratic_one_has():
    assert nonlinearity([(1, n, 0.01 * n) for n in (10, 30, 100)]) == pytest.approx(0.0)
    assert nonlinearity([(1, n, 0.01 * n**2) for n in (10, 100)]) == pytest.approx(0.9)


def test_growth_and_speed_up_are_of_points_that_share_the_rest():
    points = [
        FleetPoint(10, 1, 1.0, 10.0, 1.0, 100.0),
        FleetPoint(100, 1, 10.0, 10.0, 10.0, 110.0),
        FleetPoint(10, 2, 0.6, 16.7, 1.1, 300.0),
        FleetPoint(100, 2, 5.0, 20.0, 10.0, 300.0),
    ]
    assert memory_growth(points) == pytest.approx(0.1)
    assert speed_ups(points) == {2: 2.0}
    assert speed_ups(points[2:]) == {}


def test_memory_of_processes_that_were_started_counts():
    code = "block = bytearray(200_000_000); print(len(block), flush=True); input()"
    with peak_memory() as peak:
        before_mb = peak.mb
        child = subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        child.stdout.readline()
        peak.sample()
        assert child.pid in process_tree(child.pid)
        child.communicate("\n")
    assert peak.mb - before_mb > 200.0


def test_a_small_fleet_is_measured_and_nothing_is_left(tmp_path):
    result = bench_fleet(FleetSettings(runs=20, workers=(1,), scratch=tmp_path))
    assert [point.n_runs for point in result.points] == [2, 6, 20]
    assert all(point.seconds > 0 and point.peak_mb > 0 for point in result.points)
    assert as_json(result)["points"][0]["n_workers"] == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("workers", ["0", "1,1", "", "x"])
def test_workers_that_are_not_accepted_are_one_sentence(workers):
    with pytest.raises(ConfigError, match="--workers is"):
        FleetSettings(workers=workers)
