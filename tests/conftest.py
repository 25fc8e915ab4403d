"""What several test modules need: the measured data sets, and small runs with known content."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from terrain.records import Label, RunLog, Stream

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_configure():
    """Give linear algebra one thread a process, as the tests run in several.

    Of small matrices two processes with a thread a core take up to three times as long, as threads wait for
    one another.  What is loaded already is limited directly, the rest and the processes of tests by their
    environment.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    threadpool_limits(1)


@pytest.fixture(scope="session")
def measured():
    """Return a function that gives a path in ``$TERRAIN_DATA``, or in shared/datasets beside the repository.

    A test that asks for what is not there is skipped.
    """
    named = os.environ.get("TERRAIN_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "datasets"

    def there(name):
        if not (folder / name).exists():
            pytest.skip(f"measured data are not there: {folder / name} (set TERRAIN_DATA)")
        return folder / name

    return there


@pytest.fixture(scope="session")
def datasets_dir(measured):
    """Folder that holds borealtc/ and vulpi/."""
    borealtc, _ = measured("borealtc"), measured("vulpi")
    return borealtc.parent


def noisy_run(run_id="SNOW_01", terrain="SNOW", seed=0, duration_s=4.0):
    """Return a small husky run: IMU at 50 Hz, wheels at 10 Hz, all noise."""
    rng = np.random.default_rng(seed)
    streams = {}
    for name, rate_hz, channels in (
        (
            "imu",
            50.0,
            [
                f"{kind}_{axis}_{unit}"
                for kind, unit in (("gyro", "radps"), ("accel", "mps2"))
                for axis in "xyz"
            ],
        ),
        ("wheels", 10.0, ["speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a"]),
    ):
        n = round(duration_s * rate_hz)
        streams[name] = Stream(np.arange(n) / rate_hz, rng.standard_normal((n, len(channels))), channels)
    return RunLog(run_id, "husky", streams, (Label(0.0, duration_s, terrain),), source="noise")


COLUMNS = {
    "imu": ["wx", "wy", "wz", "ax", "ay", "az"],
    "pro": ["velL", "velR", "curL", "curR"],
}


def write_borealtc(run, folder):
    """Write a run in the BorealTC layout; its id is ``<CLASS>_<N>``."""
    terrain, _, number = run.run_id.rpartition("_")
    (folder / terrain).mkdir(parents=True, exist_ok=True)
    for prefix, stream in (("imu", run.streams["imu"]), ("pro", run.streams["wheels"])):
        with (folder / terrain / f"{prefix}_{number}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time", *COLUMNS[prefix]])
            writer.writerows(np.column_stack([stream.time_s, stream.values]).tolist())


@pytest.fixture
def make_run():
    return noisy_run


@pytest.fixture
def borealtc_dir(tmp_path):
    """A data set of three runs in the BorealTC layout."""
    folder = tmp_path / "logs"
    for seed, run_id in enumerate(["SNOW_01", "SNOW_02", "ICE_01"]):
        write_borealtc(noisy_run(run_id, run_id[:-3], seed), folder)
    return folder


@pytest.fixture
def edit():
    """Return a function that applies ``change(list of lines) -> list of lines`` to a text file."""

    def apply(path, change):
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return apply


# Machines that run tests are shared: a slow example is no fault.  Examples are the same in every run.
settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")
