"""What several test modules need: the measured data sets, and small runs with known content."""

import csv
import os
import sys
from contextlib import suppress
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from terrain.kernels import cache_folder
from terrain.records import Label, RunLog, Stream

REPOSITORY = Path(__file__).resolve().parents[1]

sys.path.insert(
    0, str(REPOSITORY / "tests")
)  # studies are imported as ``studies.NAME``, as their runner does


def pytest_configure(config):
    """Give linear algebra one thread a process, as the tests run in several, and compile kernels first.

    Of small matrices two processes with a thread a core take up to three times as long, as threads wait for
    one another.  What is loaded already is limited directly, the rest and the processes of tests by their
    environment.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    threadpool_limits(1)
    for name in getattr(config, "workerinput", {}).get("kernels", ()):
        with suppress(Exception):  # what cannot run fails in its tests
            KERNELS[name]()


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node):
    """Have two processes of tests compile the kernels from either end, where there are none yet.

    Each then takes from the cache what the other has compiled, and no kernel is compiled by both.
    """
    if not any(cache_folder().glob("*.nbc")):
        backward = node.workerinput["workerid"] != "gw0"
        node.workerinput["kernels"] = list(KERNELS)[:: -1 if backward else 1]


def _import_live():
    import pipelines.live.pilot  # noqa: F401 - kernels with signatures are compiled when they are imported


def _simulate_plant():
    from terrain.robots import load_robot
    from terrain.simulation.run import simulate_run

    simulate_run(load_robot("agrimaro"), "grass", "straight", 0, duration_s=5.0)


def _explain_planar():
    from terrain.discrepancy.diagnose import diagnose
    from terrain.discrepancy.runs import Simulation
    from terrain.effects import effect_named
    from terrain.robots import load_robot
    from terrain.simulation.run import simulate_run

    husky = load_robot("husky")
    runs = [simulate_run(husky, "grass", "survey", 0, number, duration_s=20.0) for number in range(6)]
    diagnose(runs, Simulation(husky), [effect_named("effective_track")])


KERNELS = {"live": _import_live, "plant": _simulate_plant, "planar": _explain_planar}
"""What compiles most kernels; the first takes as long as the others together."""


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
def measured_runs(measured):
    """Return a function that gives the runs of a folder of measured logs, each read once."""
    from pipelines.data.datasets import load_runs

    read = cache(lambda folder, robot: load_runs(measured(folder), robot=robot))
    return lambda folder, robot=None: read(folder, robot)


@pytest.fixture(scope="session")
def datasets_dir(measured):
    """Folder that holds borealtc/ and vulpi/."""
    borealtc, _ = measured("borealtc"), measured("vulpi")
    return borealtc.parent


@pytest.fixture(scope="session", autouse=True)
def _configuration(tmp_path_factory):
    """Give the tests a configuration folder of their own: no module of a user's is trusted, and none becomes so."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("configuration")))
        yield


IMU = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
IMU_RATE_HZ, WHEEL_RATE_HZ = 50.0, 10.0

TERRAINS = {"ASPHALT": (0.7, 0.40, 2.0), "GRASS": (0.9, 0.46, 2.1), "GRAVEL": (1.2, 0.43, 2.0)}
"""Standard deviation of the vibration in m/s^2, how much of it is left after one sample, and current in A."""


def driven_run(
    run_id="SNOW_01",
    terrain="SNOW",
    seed=0,
    duration_s=24.0,
    speed_mps=0.6,
    start_s=0.0,
    level=None,
    smoothness=None,
    current_a=None,
    label=...,
):
    """Return a husky run driven straight on at one speed over a terrain with vibrations of its own.

    ``level``, ``smoothness`` and ``current_a`` replace what the terrain does; ``label`` what it is called.
    """
    rng = np.random.default_rng(seed)
    given, usual = (level, smoothness, current_a), TERRAINS.get(terrain, (1.0, 0.0, 2.0))
    level, smoothness, current_a = (b if a is None else a for a, b in zip(given, usual, strict=True))
    n_imu, n_wheels = round(duration_s * IMU_RATE_HZ), round(duration_s * WHEEL_RATE_HZ)
    level *= np.exp(0.08 * rng.standard_normal())  # no two runs are the same
    noise = rng.standard_normal((n_imu, len(IMU)))
    for i in range(1, n_imu):  # of unit variance at any smoothness
        noise[i] = smoothness * noise[i - 1] + np.sqrt(1 - smoothness**2) * noise[i]
    shaking = level * noise * [0.1, 0.1, 0.05, 1.0, 1.0, 1.0]
    imu = shaking + rng.normal(0, 0.05, len(IMU)) + [0, 0, 0, 0, 0, 9.81]
    speed = speed_mps + 0.01 * rng.standard_normal((n_wheels, 2))
    current = current_a * (1 + 0.2 * rng.standard_normal((n_wheels, 2)))
    streams = {
        "imu": Stream(start_s + np.arange(n_imu) / IMU_RATE_HZ, imu, IMU),
        "wheels": Stream(start_s + np.arange(n_wheels) / WHEEL_RATE_HZ, np.hstack([speed, current]), WHEELS),
    }
    name = terrain if label is ... else label
    labels = () if name is None else (Label(start_s, start_s + duration_s, name),)
    return RunLog(run_id, "husky", streams, labels, source="drawn")


def driven_runs(terrains=("ASPHALT", "GRASS", "GRAVEL"), n_runs=4, seed=0, **options):
    """Return ``n_runs`` runs of each terrain, each at a speed of its own."""
    rng = np.random.default_rng(seed)
    options = {"duration_s": 24.0} | options
    return [
        driven_run(
            f"{terrain}_{number}",
            terrain,
            int(rng.integers(2**31)),
            speed_mps=float(rng.uniform(0.3, 0.9)),
            **options,
        )
        for terrain in terrains
        for number in range(1, n_runs + 1)
    ]


@pytest.fixture(scope="session")
def drive():
    """Return the maker of one run, :func:`driven_run`."""
    return driven_run


@pytest.fixture(scope="session")
def drive_all():
    """Return the maker of a data set, :func:`driven_runs`."""
    return driven_runs


@pytest.fixture(scope="session")
def runs():
    """Twelve runs of three terrains that are easy to distinguish."""
    return driven_runs()


COLUMNS = {"imu": ["wx", "wy", "wz", "ax", "ay", "az"], "pro": ["velL", "velR", "curL", "curR"]}


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
    """Return the maker of a run of 4 s."""
    return partial(driven_run, duration_s=4.0)


@pytest.fixture
def borealtc_dir(tmp_path, make_run):
    """A data set of three runs in the BorealTC layout."""
    folder = tmp_path / "logs"
    for seed, run_id in enumerate(["SNOW_01", "SNOW_02", "ICE_01"]):
        write_borealtc(make_run(run_id, run_id[:-3], seed), folder)
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
