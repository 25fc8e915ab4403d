"""The simulated drive that the benchmarks use, and a small model for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipelines.learn.model_file import TerrainModel, write_model
from pipelines.models.tracking import load_model
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.estimation.live.estimator import CHANNELS
from terrain.logs.replay import replay
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = "agrimaro"
STEP_RATE_HZ, IMU_RATE_HZ = 20.0, 100.0
DRIVE_S = 40.0
TRAINING_S = 25.0


def bench_drive(seed: int) -> RunLog:
    """Return a drive on grass at changing speeds."""
    return simulate_run(load_robot(ROBOT), "grass", "survey", seed, duration_s=DRIVE_S)


def bench_model(uri: str | None, seed: int) -> TerrainModel:
    """Return a model by its URI, or one that is trained on four short simulated runs."""
    if uri is not None:
        return load_model(uri)
    from pipelines.classify.train import model_info
    from pipelines.learn.protocols import samples_of
    from pipelines.learn.recipes import recipe_of
    from pipelines.learn.settings import RecipeSettings

    robot = load_robot(ROBOT)
    runs = [
        enriched(
            estimate_run(
                simulate_run(robot, soil, "survey", seed, number, duration_s=TRAINING_S), robot, "vio15"
            )
        )
        for soil in ("grass", "tiles")
        for number in (1, 2)
    ]
    settings = RecipeSettings(seed=seed)
    windows = samples_of(runs, settings).windows
    recipe = recipe_of(settings).fit(windows, windows.terrain.astype(str))
    return TerrainModel(recipe, model_info(runs, settings, windows, "simulated", ""))


def model_folder(uri: str | None, seed: int, into: Path) -> str:
    """Return what the service is given as its model: the URI, or the folder of the small model."""
    if uri is not None:
        return uri
    model = bench_model(None, seed)
    into.mkdir(parents=True, exist_ok=True)
    write_model(into, model)
    return str(into)


def sent_channels(run: RunLog) -> dict[str, list[str]]:
    """Return the streams that a robot sends of a run, with their channels."""
    return {name: list(run.streams[name].channels) for name in CHANNELS if name in run.streams}


def messages_of(
    run: RunLog, rate_hz: float = IMU_RATE_HZ, step_rate_hz: float = STEP_RATE_HZ
) -> Iterator[dict[str, Any]]:
    """Yield the messages of a robot: samples at one rate, of which some ask for a step.

    Parameters
    ----------
    run : drive
    rate_hz : of the messages
    step_rate_hz : of those that ask for a step
    """
    every = round(rate_hz / step_rate_hz)
    for k, sample in enumerate(replay(run, rate_hz)):
        streams = {
            name: [
                reading.time_s.tolist(),
                [[None if v != v else v for v in row] for row in reading.values.tolist()],
            ]
            for name, reading in sample.readings.items()
        }
        content: dict[str, Any] = {"type": "samples", "streams": streams, "time_s": float(sample.time_s)}
        if k % every == 0:
            content |= {"twist": sample.twist.tolist(), "step": True}
        yield content
