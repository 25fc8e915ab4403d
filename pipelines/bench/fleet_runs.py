"""Runs of a generated fleet: cheap noise with the spectrum of its terrain, no simulated robot."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from pipelines.data.datasets import RunLoader
from terrain.logs.read import read_run
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream

RUN_S = 20.0
IMU_RATE_HZ, WHEEL_RATE_HZ = 50.0, 10.0
IMU = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")

TERRAINS = {"ASPHALT": (0.5, 0.2), "GRASS": (0.8, 0.5), "GRAVEL": (1.2, 0.0), "SAND": (0.7, 0.8)}
"""Vibration in m/s^2, and how much of it is left after one sample: level and colour of the noise."""


def fleet_run(seed: int, number: int) -> RunLog:
    """Return a run of the fleet; it depends on the seed and its number only.

    Examples
    --------
    >>> run = fleet_run(0, 2)
    >>> run.run_id, run.labels[0].terrain, len(run.streams["imu"])
    ('run_000002', 'GRAVEL', 1000)
    """
    rng = np.random.default_rng((seed, number))
    terrain = list(TERRAINS)[number % len(TERRAINS)]
    level_mps2, colour = TERRAINS[terrain]
    n_imu, n_wheels = round(RUN_S * IMU_RATE_HZ), round(RUN_S * WHEEL_RATE_HZ)
    imu = lfilter(
        [level_mps2 * rng.uniform(0.8, 1.25)], [1.0, -colour], rng.standard_normal((n_imu, 6)), axis=0
    )
    imu[:, 5] += 9.81
    wheels = 0.02 * rng.standard_normal((n_wheels, 4)) + np.array([1.0, 1.0, 4.0, 4.0]) * rng.uniform(
        0.4, 0.8
    )
    return RunLog(
        f"run_{number:06d}",
        "husky",
        {
            "imu": Stream(np.arange(n_imu) / IMU_RATE_HZ, imu, IMU),
            "wheels": Stream(np.arange(n_wheels) / WHEEL_RATE_HZ, wheels, WHEELS),
        },
        (Label(0.0, RUN_S, terrain),),
        source="generated fleet",
    )


def write_fleet_run(seed: int, folder: Path, number: int) -> None:
    """Write a run of the fleet as a run folder."""
    write_run(fleet_run(seed, number), folder)


def fleet_loaders(folder: Path, n_runs: int) -> list[RunLoader]:
    """Return what reads the first runs of a fleet that was written."""
    return [
        RunLoader(partial(read_run, folder / f"run_{number:06d}"), False, False, None)
        for number in range(n_runs)
    ]
