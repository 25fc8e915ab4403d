"""Small models for the live chain: of a swerve robot with its filter, and of one without a description."""

import numpy as np
import pytest

from pipelines.classify.crossval import samples_of
from pipelines.classify.settings import CrossvalSettings
from pipelines.classify.train import model_info
from pipelines.models.model_files import TerrainModel
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run


def _trained(runs):
    settings = CrossvalSettings()
    windows = samples_of(runs, settings).cut.windows
    recipe = settings.new_recipe().fit(windows, windows.terrain.astype(str))
    return TerrainModel(recipe, model_info(runs, settings, windows, "drawn", ""))


@pytest.fixture(scope="session")
def trained():
    """What trains a model on labelled runs, with the default settings."""
    return _trained


@pytest.fixture(scope="session")
def swerve_model():
    """Trained on what a filter adds to simulated runs of two terrains."""
    robot = load_robot("agrimaro")
    runs = [
        simulate_run(robot, terrain, "survey", 5, number, duration_s=25.0)
        for terrain in ("grass", "tiles")
        for number in (1, 2)
    ]
    return _trained([enriched(estimate_run(run, robot, "vio15")) for run in runs])


@pytest.fixture(scope="session")
def two_drives():
    """Runs of a robot without a description on two terrains that differ in shaking."""
    rng = np.random.default_rng(1)
    runs = []
    for terrain, noise in (("a", 0.1), ("b", 2.0)):
        for number in range(3):
            time_s = np.arange(0, 12, 0.02)
            shaking = rng.normal(0, noise, (time_s.size, 1))
            speed = np.full((time_s.size, 1), 0.5)
            streams = {
                "imu": Stream(time_s, shaking, ("accel_z_mps2",)),
                "wheels": Stream(time_s, speed, ("speed_left_mps",)),
            }
            runs.append(RunLog(f"{terrain}{number}", "mower", streams, ((0.0, 12.0, terrain),)))
    return runs


@pytest.fixture(scope="session")
def mower_model(two_drives):
    return _trained(two_drives)
