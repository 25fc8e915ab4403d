"""Logs of wheels and a receiver alone: a hidden track is named by the course over ground."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.explain.explain import explain
from pipelines.report.pages import markdown_text
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate


@pytest.mark.slow
def test_an_effective_track_is_named_without_imu_camera_or_lidar():
    robot, rng, runs = load_robot("husky"), np.random.default_rng(3), []
    time_s = np.arange(0.0, 20.0, 0.02)
    about = {"noise": spread_numbers("noise"), "effects": {"effective_track_ratio": 0.5}, "terrain": "field"}
    for i in range(8):
        phase = rng.uniform(0.0, 6.0, 3)
        turn = 0.5 * np.sin(0.5 * time_s + phase[1]) + 0.3 * np.sin(1.1 * time_s + phase[2])
        twist = np.column_stack([0.7 + 0.3 * np.sin(0.6 * time_s + phase[0]), 0.0 * time_s, turn])
        twist[:25] *= np.linspace(0.0, 1.0, 25)[:, None]
        run = simulate(robot, twist, Ground(), i, run_id=f"run_{i}", fixes=True, **about)
        runs.append(replace(run, streams={name: run.streams[name] for name in ("wheels", "gnss")}))
    explanation = explain(runs, robot)
    text = markdown_text(explanation.report)
    assert "yaw rate over ground" in text
    assert "from poses" not in text  # it has none
    causes = {cause.name: cause for cause in explanation.diagnosis.causes}
    assert set(causes) == {"effective_track"}
    (value,) = causes["effective_track"].parameters
    assert abs(value.value - 0.5) < 0.05
